"""The site as files that other programs open: PLY meshes and a Mitsuba scene for Sionna RT."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from ..common.outputs import explained_os_errors
from .materials import CONSTANT, material
from .mesh_scenes.mitsuba import TriangleScene
from .meshes import Mesh, site_meshes
from .site import Site

# Thickness given to ground in the export, a slab from which no echo of its second face returns.
HALF_SPACE_THICKNESS_M = 1.0


def export_scene(site: Site, folder: str | Path) -> list[Path]:
    """The site as ``scene.xml`` with ``meshes/*.ply``, which ``sionna.rt.load_scene`` opens.

    Parameters
    ----------
    site : Site
        Any. East is x, north is y, up is z. Trees stay out: to Sionna crowns are slabs and mirrors.
    folder : str or Path
        Made when missing; files of the same names are replaced.

    Returns
    -------
    list of Path
        The files written, the XML file first.
    """
    folder, parts = Path(folder), _parts(site)
    lines = ['<scene version="2.1.0">', f"<!-- {_comment(site)} -->"]
    lines += [_bsdf(name) for name in dict.fromkeys(name for _, name, _ in parts)]
    written = [folder / "scene.xml"]
    with explained_os_errors(folder):
        folder.mkdir(exist_ok=True)
        (folder / "meshes").mkdir(exist_ok=True)
        for title, name, mesh in parts:
            written.append(folder / "meshes" / f"{title}.ply")
            _write_ply(mesh, written[-1])
            lines.append(
                f'<shape type="ply" id={quoteattr("mesh-" + title)}>'
                f'<string name="filename" value="meshes/{title}.ply"/>'
                f'<boolean name="face_normals" value="true"/><ref id={quoteattr(_bsdf_id(name))} name="bsdf"/></shape>'
            )
        written[0].write_text("\n".join([*lines, "</scene>", ""]), encoding="utf-8")
    return written


def _parts(site: Site) -> list[tuple[str, str, Mesh]]:
    """Title, material and mesh of each part: those of a scene shape by shape, all else by material."""
    parts = [(f"all_{_plain(name)}", name, mesh) for name, mesh in site_meshes(site).items()]
    return parts if site.scene is None else [*_parts_of_scene(site.scene), *parts]


def _parts_of_scene(scene: TriangleScene) -> Iterator[tuple[str, str, Mesh]]:
    for number in np.unique(scene.shape):  # none of vegetation, which is a medium
        used, place = np.unique(scene.triangles[scene.shape == number], return_inverse=True)
        title = f"{number}_{_plain(scene.shapes[number].removeprefix('mesh-'))[:60]}"
        yield title, scene.materials[number], (scene.vertices_m[used], place.reshape(-1, 3))


def _plain(name: str) -> str:
    """A name as a file name and an identifier."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", name)


def _comment(site: Site) -> str:
    frame = site.frame
    text = f"{site.name}: x east, y north, z up [m] from {frame.latitude_deg:.8f}, {frame.longitude_deg:.8f}" + (
        f"; {site.credit}" if site.credit else ""
    )
    # two hyphens would end the XML comment
    return text.replace("--", "- -")


def _bsdf_id(name: str) -> str:
    if name == "vacuum":
        return "absorber"
    # Sionna takes an id that begins with mat-itu_ for a material of P.2040
    return f"mat-{_plain(name)}" if name.startswith(CONSTANT) else f"mat-itu_{_plain(name)}"


def _bsdf(name: str) -> str:
    what = material(name)
    thickness = {"thickness": HALF_SPACE_THICKNESS_M if what.thickness_m is None else what.thickness_m}
    if name.startswith(CONSTANT):
        values = {
            "relative_permittivity": what.relative_permittivity(1e9).real,
            "conductivity": what.conductivity_s_per_m(1e9),
        }
        return f'<bsdf type="radio-material" id="{_bsdf_id(name)}">' + _floats(values | thickness) + "</bsdf>"
    if name == "vacuum":
        return f'<bsdf type="absorber-radio-material" id="{_bsdf_id(name)}"/>'
    inner = f'<string name="type" value="{name.partition(" with ")[0]}"/>'
    inner += _floats(thickness)
    return f'<bsdf type="itu-radio-material" id="{_bsdf_id(name)}">{inner}</bsdf>'


def _floats(values: Mapping[str, float]) -> str:
    return "".join(f'<float name="{name}" value="{value:.9g}"/>' for name, value in values.items())


def _write_ply(mesh: Mesh, path: Path) -> None:
    """A binary little-endian PLY, float32 (0.1 mm at 2 km)."""
    vertices, triangles = mesh
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    # packed, as PLY wants it: a count of one byte, then three indices
    faces = np.empty(len(triangles), dtype=[("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, triangles
    path.write_bytes(head.encode() + vertices.astype("<f4").tobytes() + faces.tobytes())

"""Conversion of a Mitsuba scene to a site.yaml and of any site to a Mitsuba scene, and the ``antenna export`` job."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from ..common.errors import UsageError
from ..common.files import opened
from ..common.geodesy import SiteFrame
from ..common.outputs import OutputFile, OutputFolder, explained_os_errors, is_sealed, sealed
from ..common.text import counted
from ..site.antennas import read_gain_grid
from ..site.footprints import name_and_value, numbers_of, numbers_of_towers, site_yaml
from ..site.materials import CONSTANT, material
from ..site.mitsuba import Mesh, TriangleScene
from ..site.pattern_files import exported, read_cut_files, read_pattern_file
from ..site.scenes import GROUND_SHARE, bounds, ground_share, placed_scene, site_meshes
from ..site.site import Site
from ..site.siteyaml import SceneModel, SiteModel, build_site, inputs_of_site, load_site, site_model
from .options import JobOutcome

# Thickness of ground in the export [m]: a slab without an echo from its second face.
HALF_SPACE_THICKNESS_M = 1.0

_LOCAL_NOTE = (
    "this site has no georeference: latitude and longitude are relative to (0, 0), so flight logs do not match it"
)


def is_scene(path: Path) -> bool:
    """Check whether a file is the XML of a Mitsuba scene, whose first element is 'scene'."""
    try:
        with opened(path, "a map or a scene") as file:
            head = file.read(65536)
    except OSError:
        return False
    return path.suffix.lower() == ".xml" and b"<scene" in head and b"<osm" not in head


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneOptions:
    """Facts about a site that a Mitsuba scene does not contain.

    Parameters
    ----------
    origin : str, optional
        ``latitude,longitude[,ground height]`` of the scene's (0, 0, 0), or ``local``. Default: the origin of ``base``.
    base : str, optional
        Site from which towers and settings are taken.
    towers : sequence of str
        ``name=east,north,height`` [m]: antenna above up = 0 of the scene.
    materials : sequence of str
        ``id=material`` for materials of the scene without radio properties.
    turn_deg : float
        Rotation of the scene, counter-clockwise from above: 0 if x is east and y north.
    """

    origin: str | None = None
    base: str | None = None
    towers: Sequence[str] = ()
    materials: Sequence[str] = ()
    turn_deg: float = 0.0


def run_scene_import(path: Path, out: Path, facts: SceneOptions, *, force: bool = False) -> list[str]:
    """Write a site.yaml that names a Mitsuba scene, and return a description of each step.

    Parameters
    ----------
    path : Path
        The XML file, which is not copied.
    out : Path
        The site.yaml to write.
    facts : SceneOptions
    force : bool
        Replace a site.yaml that this tool did not write.

    Returns
    -------
    list of str
        One line per action.

    Raises
    ------
    UsageError
        If the position of the scene or of its towers is missing.
    """
    named = dict(name_and_value(text, "--material", "wall=concrete") for text in facts.materials)
    base = None if facts.base is None else site_model(facts.base)
    start = _origin(facts.origin, base)
    with OutputFile(out, own=is_sealed, inputs=[path], force=force) as output:
        scene = placed_scene(path, materials=named, turn_deg=facts.turn_deg)
        actions = [_summary(scene), *scene.notes]
        share = ground_share(scene)
        ground_plane = share < GROUND_SHARE
        if ground_plane:
            actions.append(
                f"the scene has no ground (level surfaces under {share:.0%} of its plan): a plane of medium_dry_ground "
                f"is added at its lowest point, up = {bounds(scene)[0][2]:g} m; scene.ground_plane: false omits it"
            )
        low, high = bounds(scene)
        content: dict[str, Any] = {} if base is None else base.model_dump(mode="json", exclude_defaults=True)
        for key in ("buildings", "dem", "tower_ground"):
            content.pop(key, None)
        content["name"] = path.stem if base is None else f"{base.name}, {path.stem}"
        content["origin"] = start
        content["scene"] = SceneModel(
            path=Path(os.path.relpath(path.resolve(), out.resolve().parent)).as_posix(),
            sha256=scene.sha256,
            turn_deg=facts.turn_deg,
            materials=named,
            ground_plane=ground_plane,
        ).model_dump(mode="json", exclude_defaults=True)
        if base is None or facts.towers:
            content["towers"] = _towers(
                facts.towers, SiteFrame(start["latitude_deg"], start["longitude_deg"]), low, high
            )
        content.setdefault("area_m", [round(float(v), 2) for v in (low[0], high[0], low[1], high[1])])
        if facts.origin == "local":
            content["notes"] = [*content.get("notes", []), _LOCAL_NOTE]
            actions.append(_LOCAL_NOTE)
        model = SiteModel.model_validate(content)
        site = build_site(model, out.resolve().parent)  # report inconsistent settings before the file is written
        actions = [*(note for note in site.notes if " mesh" in note), *actions]
        output.write(sealed(site_yaml(model, header=["made by 'aerpaw-cmp site import' from a scene", *actions])))
    return actions


def _summary(scene: TriangleScene) -> str:
    low, high = bounds(scene)
    size = " x ".join(f"{v:.0f}" for v in high - low)
    used = sorted({scene.materials[s] for s in set(scene.shape.tolist())})
    return f"{counted(len(scene.shapes), 'shape')}, {counted(len(scene), 'triangle')}, {size} m, of {', '.join(used)}"


def _origin(text: str | None, base: SiteModel | None) -> dict[str, Any]:
    if text == "local":
        return {"latitude_deg": 0.0, "longitude_deg": 0.0}
    if text is not None:
        values = numbers_of(text, (2, 3), "--origin", "--origin latitude,longitude[,ground height above sea level]")
        origin: dict[str, Any] = {"latitude_deg": values[0], "longitude_deg": values[1]}
        if not (abs(values[0]) <= 90 and abs(values[1]) <= 180):
            raise UsageError(
                f"--origin '{text}'", expected="latitude,longitude in degrees", cause="longitude before latitude"
            )
        if len(values) == 3:
            origin["ground"] = {"height_m": values[2], "reference": "orthometric"}
        return origin
    if base is not None:
        return base.origin.model_dump(mode="json", exclude_defaults=True)
    raise UsageError(
        "a Mitsuba scene does not contain its position on Earth",
        expected="--origin latitude,longitude[,height] of its point (0, 0, 0), or --base SITE that has its origin",
        cause="for a scene without a position: --origin local",
    )


def _towers(towers: Sequence[str], frame: SiteFrame, low: Any, high: Any) -> dict[str, Any]:
    if not towers:
        raise UsageError(
            "a Mitsuba scene has no towers",
            expected="--tower name=east,north,height (metres in the scene; may be repeated), or --base SITE",
            cause=f"the scene reaches from {low[0]:.0f} to {high[0]:.0f} m east, {low[1]:.0f} to {high[1]:.0f} m north",
        )
    by_name: dict[str, Any] = {}
    for name, (east, north, up) in numbers_of_towers(towers, "NAME=EAST,NORTH,HEIGHT, such as BS=10,20,25").items():
        latitude, longitude = frame.to_geographic(east, north)
        by_name[name] = {
            "latitude_deg": round(float(latitude), 10),
            "longitude_deg": round(float(longitude), 10),
            "antenna_height_m": up,
        }
    return by_name


def run_site_export(site: str, out: Path, *, force: bool = False) -> JobOutcome:
    """Write any site as ``scene.xml`` with PLY meshes, which ``sionna.rt.load_scene`` opens.

    Parameters
    ----------
    site : str
        site.yaml, or the name of a packaged site.
    out : Path
        Folder.
    force : bool
        Replace files that this tool did not write.

    Returns
    -------
    JobOutcome
        ``scene.xml`` is the first of its ``files``.
    """
    with OutputFolder(out, job="site export", inputs=inputs_of_site(site), force=force) as output:
        with output.filling() as folder:
            written = export_scene(load_site(site), folder)
        return JobOutcome(folder=out, files=output.placed(written))


def export_scene(site: Site, folder: str | Path) -> list[Path]:
    """Write a site as ``scene.xml`` with ``meshes/*.ply``, which ``sionna.rt.load_scene`` opens.

    Parameters
    ----------
    site : Site
        East is x, north is y, up is z. Trees are omitted, because Sionna treats crowns as slabs and mirrors.
    folder : str or Path
        Folder, which is created if missing. Files of the same names are replaced.

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
    """Return title, material and mesh of each part: one per shape of a scene, else one per material."""
    parts = [(f"all_{_plain(name)}", name, mesh) for name, mesh in site_meshes(site).items()]
    return parts if site.scene is None else [*_parts_of_scene(site.scene), *parts]


def _parts_of_scene(scene: TriangleScene) -> Iterator[tuple[str, str, Mesh]]:
    for number in np.unique(scene.shape):  # vegetation has no triangles, because it is a medium
        used, place = np.unique(scene.triangles[scene.shape == number], return_inverse=True)
        title = f"{number}_{_plain(scene.shapes[number].removeprefix('mesh-'))[:60]}"
        yield title, scene.materials[number], (scene.vertices_m[used], place.reshape(-1, 3))


def _plain(name: str) -> str:
    """Return a name that is valid as a file name and as an identifier."""
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
    # Sionna uses a material of P.2040 for an id that begins with mat-itu_
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
    """Write a binary little-endian PLY in float32 (0.1 mm at 2 km)."""
    vertices, triangles = mesh
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    # packed as PLY requires: a count of one byte, then three indices
    faces = np.empty(len(triangles), dtype=[("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, triangles
    path.write_bytes(head.encode() + vertices.astype("<f4").tobytes() + faces.tobytes())


def run_antenna_export(
    file: Path,
    out: Path,
    *,
    elevation: Path | None = None,
    variable: str | None = None,
    carrier_hz: float | None = None,
    force: bool = False,
) -> JobOutcome:
    """Write a pattern file in the format given by the ending of ``out``.

    Parameters
    ----------
    file : Path
        Any pattern that a flight file may name.
    out : Path
    elevation : Path, optional
        Second cut, if ``file`` is an azimuth cut.
    variable : str, optional
        Name of the gain grid in a .mat file.
    carrier_hz : float, optional
    force : bool
        Replace a file that this tool did not write.

    Returns
    -------
    JobOutcome
    """
    inputs = [file, *([] if elevation is None else [elevation])]
    with OutputFile(out, own=is_sealed, inputs=inputs, force=force) as output:
        if variable is not None or file.suffix == ".mat":
            if elevation is not None:
                raise UsageError("an elevation cut with a gain grid", expected="an azimuth cut as FILE", path=file)
            pattern = read_gain_grid(file, variable or "")
        elif elevation is not None:
            pattern = read_cut_files(file, elevation)
        else:
            pattern = read_pattern_file(file, carrier_hz=carrier_hz)
        text = exported(pattern, file.stem, out, carrier_hz)
        # MSI must begin with NAME, without a line before it
        output.write(text.encode("utf-8") if out.suffix == ".msi" else sealed(text))
    return JobOutcome(folder=out.parent, files=(out,))

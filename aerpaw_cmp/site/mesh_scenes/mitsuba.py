"""Triangles and radio materials of a Mitsuba scene, as Sionna RT reads them; without Mitsuba.

Read are shapes of type ``ply`` in the coordinates of the scene, as every scene of Sionna RT and of AERPAW has them, and
the materials ``itu-radio-material``, ``radio-material``, ``absorber-radio-material`` or any other whose id begins with
``itu_`` or ``mat-itu_``. A scene may name files in its own folder only.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ...common.counting import counted
from ...common.errors import InputError, UsageError, parsed
from ...common.files import inside, read_input
from ...common.units import FloatArray, IntArray
from ...common.xmlfiles import xml_root
from ..materials import CROWN, material, stated_name
from .meshfiles import RawMesh, read_mesh

# Of a slab without a stated thickness, as in Sionna RT.
_DEFAULT_THICKNESS_M = 0.1

_LARGEST_XML = 256 * 2**20
# Munich, a scene of Sionna's, has 40 000.
_MOST_TRIANGLES = 20_000_000

# Names and materials of meshes that are vegetation, as words: no street, no treehouse.
_VEGETATION = re.compile(
    r"(?<![a-z])(trees?|canop(y|ies)|crowns?|foliage|vegetation|lea(f|ves)|hedges?|bush(es)?|shrubs?|trunks?)(?![a-z])"
)


@dataclass(frozen=True, slots=True, eq=False)
class TriangleScene:
    """A scene as triangles.

    Parameters
    ----------
    vertices_m : (vertices, 3)
        East, north, up.
    triangles : (triangles, 3) int
        Indices of vertices.
    shape : (triangles,) int
        Index into ``shapes`` and ``materials``.
    shapes : tuple of str
        Names.
    materials : tuple of str
        Of each shape, as :func:`aerpaw_cmp.site.materials.material` knows them.
    notes : tuple of str
        What was repaired or not modelled.
    sha256 : str
        Of the scene's files.
    """

    vertices_m: FloatArray
    triangles: IntArray
    shape: IntArray
    shapes: tuple[str, ...]
    materials: tuple[str, ...]
    notes: tuple[str, ...] = ()
    sha256: str = ""

    def __len__(self) -> int:
        return len(self.triangles)


@dataclass(slots=True)
class _Reading:
    """Data collected so far."""

    path: Path
    folder: Path
    radio: dict[str, str]
    vertices: list[FloatArray] = field(default_factory=list)
    triangles: list[IntArray] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    materials: list[str] = field(default_factory=list)
    bent: int = 0
    total: int = 0
    skipped: dict[str, int] = field(default_factory=dict)
    digest: hashlib._Hash = field(default_factory=hashlib.sha256)


@parsed("a Mitsuba scene")
def read_scene(path: str | Path, materials: Mapping[str, str] | None = None) -> TriangleScene:
    """Read a Mitsuba scene.

    Parameters
    ----------
    path : str or Path
        The XML file.
    materials : mapping of str to str, optional
        Radio materials of those of the scene, by id, that are none: ``{"wall": "concrete"}``.

    Returns
    -------
    TriangleScene

    Raises
    ------
    InputError
        The XML or a mesh cannot be read, a file outside the scene's folder is named, there is no triangle.
    UsageError
        Materials that say nothing about radio.
    """
    path = Path(path)
    root, data = _root(path)
    parameters = dict(materials or {})
    for name in parameters.values():
        material(name)  # or say what is wrong with it
    radio, unknown, notes = _materials(root, parameters, path)
    reading = _Reading(path, path.parent.resolve(), radio)
    reading.digest.update(data)
    for shape in root.findall("./shape"):
        _add(reading, shape, unknown)
    if not reading.triangles:
        raise InputError("the scene has no triangle", expected="shapes of type ply", path=path)
    return _gathered(reading, notes)


def _gathered(reading: _Reading, notes: list[str]) -> TriangleScene:
    starts = np.cumsum([0, *(len(v) for v in reading.vertices)])
    triangles = [t + start for t, start in zip(reading.triangles, starts, strict=False)]
    if reading.bent:
        notes.append(f"{reading.bent} polygons are not flat: they were cut into triangles from their first corner")
    for kind, count in reading.skipped.items():
        notes.append(f"warning: {counted(count, 'shape')} of type '{kind}' left out; read is ply")
    return TriangleScene(
        vertices_m=np.concatenate(reading.vertices),
        triangles=np.concatenate(triangles),
        shape=np.repeat(np.arange(len(triangles)), [len(t) for t in triangles]),
        shapes=tuple(reading.names),
        materials=tuple(reading.materials),
        notes=tuple(notes),
        sha256=reading.digest.hexdigest(),
    )


def _root(path: Path) -> tuple[ElementTree.Element, bytes]:
    data = read_input(path, _LARGEST_XML, "a scene")
    root = xml_root(data, path, "a plain Mitsuba scene")
    if root.tag != "scene":
        raise InputError(f"XML of '{root.tag}'", expected="a Mitsuba scene ('scene')", path=path)
    if root.find(".//include") is not None:
        raise InputError("the scene includes another XML file", expected="one file: paste it in", path=path)
    return root, data


# ---------------------------------------------------------------- materials


def _materials(
    root: ElementTree.Element, parameters: Mapping[str, str], path: Path
) -> tuple[dict[str, str], dict[str, str], list[str]]:
    """Radio material by id; type by id of those that are none; notes."""
    radio: dict[str, str] = {}
    unknown: dict[str, str] = {}
    rough: list[str] = []
    # those of the scene first: a shape may carry one of its own without a name
    for number, bsdf in enumerate((*root.findall("./bsdf"), *root.findall(".//shape/bsdf"))):
        name = bsdf.get("id") or bsdf.get("name") or f"unnamed {number + 1}"
        bsdf.set("id", name)
        if name in parameters:
            radio[name] = parameters[name]
            continue
        material = _radio_material(bsdf, name, path)
        if material is None:
            unknown[name] = bsdf.get("type", "?")
        else:
            radio[name] = material
            if _float(bsdf, "scattering_coefficient", 0.0, path) > 0.0 and not _VEGETATION.search(name.lower()):
                rough.append(name)
    stray = sorted(set(parameters) - set(radio))
    if stray:
        raise UsageError(
            f"the scene has no material '{stray[0]}'", expected="one of " + ", ".join([*radio, *unknown]), path=path
        )
    notes = []
    if rough:
        notes.append(f"diffuse scattering of {', '.join(rough)} is not modelled: they reflect as smooth surfaces")
    return radio, unknown, notes


def _radio_material(bsdf: ElementTree.Element, name: str, path: Path) -> str | None:
    """Name of the radio material that a bsdf is, None where it says nothing about radio."""
    kind, plain = bsdf.get("type", ""), name.removeprefix("mat-")
    thickness = _float(bsdf, "thickness", _DEFAULT_THICKNESS_M, path)
    stated = bsdf.find("string[@name='type']")
    if kind == "itu-radio-material" or plain.startswith(("itu_", "itu-")):
        # Blender's exporter names materials so, and Sionna takes the name for the kind
        itu = plain[4:] if plain.startswith(("itu_", "itu-")) else plain
        if stated is not None:
            itu = stated.get("value", "")
        elif kind == "itu-radio-material" and itu == plain:
            raise InputError(f"the material '{name}' has no type", expected='<string name="type" .../>', path=path)
        try:
            return material(f"{itu} with thickness={thickness:.9g}").name
        except UsageError as error:
            raise InputError(f"material '{name}': {error.found}", expected=error.expected, path=path) from None
    if kind == "radio-material":
        permittivity = _float(bsdf, "relative_permittivity", 1.0, path)
        conductivity = _float(bsdf, "conductivity", 0.0, path)
        if permittivity < 1.0 or conductivity < 0.0 or thickness < 0.0:
            raise InputError(
                f"material '{name}': permittivity {permittivity:g}, conductivity {conductivity:g} S/m, "
                f"thickness {thickness:g} m",
                expected="a permittivity of at least 1 and no negative number",
                path=path,
            )
        return stated_name(permittivity, conductivity, thickness)
    return "vacuum" if kind == "absorber-radio-material" else None


def _float(parent: ElementTree.Element, name: str, default: float, path: Path) -> float:
    item = parent.find(f"float[@name='{name}']")
    text = str(default) if item is None else item.get("value", "")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"'{text[:60]}'", expected="a finite number", path=path)
    return value


# ---------------------------------------------------------------- shapes


def _add(reading: _Reading, shape: ElementTree.Element, unknown: Mapping[str, str]) -> None:
    kind = shape.get("type", "?")
    if kind != "ply":
        reading.skipped[kind] = reading.skipped.get(kind, 0) + 1
        return
    name = shape.get("id") or f"shape {len(reading.names) + 1}"
    # an empty transform moves nothing, and exporters write it
    if len(shape.find("transform[@name='to_world']") or ()):
        raise InputError(
            f"the shape '{name}' is moved by a to_world",
            expected="meshes in the coordinates of the scene, as Sionna RT's own",
            cause="apply the transform where the scene was made (Blender: Object, Apply), and export it anew",
            path=reading.path,
        )
    mesh = _mesh(reading, shape, name)
    reading.total += len(mesh.triangles)
    if reading.total > _MOST_TRIANGLES:
        raise InputError(
            f"more than {_MOST_TRIANGLES} triangles",
            expected="a scene that fits into memory",
            cause="a terrain or scan that is finer than a wavelength asks for: simplify it first",
            path=reading.path,
        )
    reading.vertices.append(mesh.vertices)
    reading.triangles.append(mesh.triangles)
    reading.names.append(name)
    reading.materials.append(_of_shape(reading, shape, name, unknown))
    reading.bent += mesh.bent


def _of_shape(reading: _Reading, shape: ElementTree.Element, name: str, unknown: Mapping[str, str]) -> str:
    """Radio material of a shape."""
    inner = shape.find("bsdf")
    # a shape may refer to media and emitters as well
    refs = [item.get("id", "") for item in shape.findall("ref") if item.get("name", "bsdf") == "bsdf"]
    which = inner.get("id", "") if inner is not None else (refs[0] if refs else "")
    # before its material is asked for: leaves often have one that says nothing about radio
    if _VEGETATION.search(f"{name} {which}".lower()):
        return CROWN
    if which in reading.radio:
        return reading.radio[which]
    if not which:
        raise InputError(
            f"the shape '{name}' has no material", expected='<ref id="..." name="bsdf"/>', path=reading.path
        )
    if which in unknown:
        others = "" if len(unknown) == 1 else f" and {len(unknown) - 1} more ({', '.join(list(unknown)[:6])})"
        raise UsageError(
            f"the material '{which}'{others} is of type '{unknown[which]}', which says nothing about radio",
            expected="itu-radio-material, radio-material, or an id such as 'mat-itu_concrete'",
            cause=f"say what it is: --material '{which}=concrete'",
            path=reading.path,
        )
    raise InputError(
        f"the shape '{name}' names the material '{which}', which the scene has not",
        expected="one of " + ", ".join([*reading.radio, *unknown][:20]),
        path=reading.path,
    )


def _mesh(reading: _Reading, shape: ElementTree.Element, name: str) -> RawMesh:
    item = shape.find("string[@name='filename']")
    wanted = "" if item is None else item.get("value", "")
    if not wanted:
        raise InputError(
            f"the shape '{name}' names no file", expected='<string name="filename" .../>', path=reading.path
        )
    place = inside(reading.folder, wanted, reading.path)
    if not place.is_file():
        raise InputError(
            f"the shape '{name}' names '{wanted}', which is not there",
            expected=f"a mesh below {reading.folder}",
            cause="the XML file was copied without its folder 'meshes'",
            path=reading.path,
        )
    mesh, data = read_mesh(place)
    # digests of digests: where one file ends cannot be shifted into the next
    reading.digest.update(hashlib.sha256(data).digest())
    return mesh

"""Scenes of meshes: PLY files, and Mitsuba scenes in the dialect of Sionna RT.

Triangles and radio materials of a Mitsuba scene are read without Mitsuba.

The reader supports shapes of type ``ply`` in the coordinates of the scene, as in all scenes of Sionna RT and AERPAW.
Supported materials are ``itu-radio-material``, ``radio-material``, ``absorber-radio-material``, or any other type if
the id begins with ``itu_`` or ``mat-itu_``. A scene may name only files in its own folder.

Meshes are binary PLY files of triangles, as in all scenes of Sionna RT.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from ..common.errors import InputError, UsageError, parsed, parsing
from ..common.files import inside, read_input
from ..common.kml import xml_root
from ..common.text import counted
from ..common.units import AnyArray, FloatArray, IntArray
from .materials import CROWN, material, stated_name

# Largest size of a PLY header.
_LARGEST_HEADER = 65_536

# Largest size of a mesh file in bytes.
_LARGEST_FILE = 2**30

# NumPy types of little endian
_TYPES = {
    "char": "<i1", "int8": "<i1", "uchar": "<u1", "uint8": "<u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip


# Meshes that can be read, as Sionna RT, Blender's exporter for Mitsuba and this program write them.
_MESH = "a binary PLY of triangles (little endian), as Mitsuba writes it"

# Vertices (n, 3) [m] and triangles (m, 3).
Mesh = tuple[FloatArray, IntArray]


def read_mesh(path: Path) -> tuple[Mesh, bytes]:
    """Return the mesh of a PLY file, and the bytes of the file (for a digest).

    Raises
    ------
    InputError
        If the file is not a mesh or is truncated, or a face refers to a missing vertex.
    """
    data = read_input(path, _LARGEST_FILE, "a mesh")
    with parsing(path, "a mesh"):
        return read_ply(data), data


def read_ply(data: bytes) -> Mesh:
    """Return vertices (n, 3) and triangles (m, 3) of a PLY file."""
    elements, place = _header(data)
    vertices, triangles = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    for name, count, fields in elements:
        record = np.dtype(fields)
        # check before an array is allocated, because a damaged header may state more entries than fit into memory
        if count < 0 or place + count * record.itemsize > len(data):
            raise InputError(
                f"the file ends before the {count} entries of '{name}' that its header declares",
                cause="it was cut off, its faces are not triangles, or the header is damaged",
            )
        rows = np.frombuffer(data, record, count, place)
        place += count * record.itemsize
        if name == "vertex":
            if any(axis not in (record.names or ()) or rows[axis].ndim > 1 for axis in "xyz"):
                raise InputError("its vertices have no x, y and z", expected="a PLY mesh")
            vertices = np.column_stack([rows[axis].astype(np.float64) for axis in "xyz"])
        elif name == "face":
            triangles = _triangles(rows)
    return _checked(vertices, triangles)


def _triangles(rows: AnyArray) -> IntArray:
    named = next((name for name in ("vertex_indices", "vertex_index") if name in (rows.dtype.names or ())), "")
    if not named or rows[named].ndim < 2 or rows.dtype[named].base.kind == "f":
        raise InputError("its faces list no vertices", expected="'vertex_indices' or 'vertex_index'")
    if (rows[f"length of {named}"] != 3).any():
        raise InputError("a face is not a triangle", expected=_MESH)
    return np.asarray(rows[named].astype(np.int64))


def _checked(vertices: FloatArray, triangles: IntArray) -> Mesh:
    """Return the mesh if every index refers to a vertex and every used vertex is finite."""
    wrong = triangles[(triangles < 0) | (triangles >= len(vertices))]
    if wrong.size:
        raise InputError(
            f"a face names vertex {wrong[0]}", expected=f"0 to {len(vertices) - 1}", cause="the file is damaged"
        )
    if not np.isfinite(vertices[triangles]).all():
        raise InputError("a vertex is not a finite number", expected="coordinates in metres")
    return vertices, triangles


# Name, number of entries and fields of an element. A list consists of its length and three items.
_Element = tuple[str, int, list[Any]]


def _header(data: bytes) -> tuple[list[_Element], int]:
    """Return the elements of a PLY file, and the position of the first byte after the header."""
    if not data.startswith(b"ply"):
        raise InputError("it does not begin with 'ply'", expected="a PLY mesh")
    end = data.find(b"end_header", 0, _LARGEST_HEADER)
    if end < 0:
        found = f"no 'end_header' in its first {_LARGEST_HEADER} bytes"
        raise InputError(found, expected="a PLY mesh", cause="a damaged file")
    kind = ""
    elements: list[_Element] = []
    for number, line in enumerate(data[:end].decode("latin-1").splitlines(), 1):
        words = line.split()
        try:
            match words:
                case ["format", kind, *_]:
                    pass
                case ["element", name, count]:
                    elements.append((name, int(count), []))
                case ["property", "list", length, item, name]:
                    elements[-1][2].extend([(f"length of {name}", _TYPES[length]), (name, _TYPES[item], (3,))])
                case ["property", item, name]:
                    elements[-1][2].append((name, _TYPES[item]))
        except (IndexError, KeyError, ValueError):
            raise InputError(f"the header has '{line.strip()[:60]}'", expected="a PLY header", line=number) from None
    if kind != "binary_little_endian":
        raise InputError(f"a PLY of format '{kind[:40]}'", expected=_MESH)
    return elements, data.find(b"\n", end) + 1


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Return the vertices and triangles of several meshes as one mesh."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    triangles = [faces + start for (_, faces), start in zip(meshes, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(triangles)


# Default thickness of a slab, as in Sionna RT.
_DEFAULT_THICKNESS_M = 0.1

_LARGEST_XML = 256 * 2**20
# Largest number of triangles of a scene. The scene Munich of Sionna RT has 40 000.
_MOST_TRIANGLES = 20_000_000

# Names and materials of vegetation, as complete words, so that "street" and "treehouse" do not match.
_VEGETATION = re.compile(
    r"(?<![a-z])(trees?|canop(y|ies)|crowns?|foliage|vegetation|lea(f|ves)|hedges?|bush(es)?|shrubs?|trunks?)(?![a-z])"
)


@dataclass(frozen=True, slots=True, eq=False)
class TriangleScene:
    """A scene of triangles.

    Parameters
    ----------
    vertices_m : (vertices, 3)
        East, north, up [m].
    triangles : (triangles, 3) int
        Indices of vertices.
    shape : (triangles,) int
        Index into ``shapes`` and ``materials``.
    shapes : tuple of str
        Names of the shapes.
    materials : tuple of str
        Material of each shape, by its name in :func:`aerpaw_cmp.site.materials.material`.
    notes : tuple of str
        Repairs, and parts that are not modelled.
    sha256 : str
        Digest of the files of the scene.
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


@parsed("a Mitsuba scene")
def read_scene(path: str | Path, materials: Mapping[str, str] | None = None) -> TriangleScene:
    """Read a Mitsuba scene.

    Parameters
    ----------
    path : str or Path
        XML file.
    materials : mapping of str to str, optional
        Radio materials for materials of the scene without radio properties, by id: ``{"wall": "concrete"}``.

    Returns
    -------
    TriangleScene

    Raises
    ------
    InputError
        If the XML or a mesh cannot be read, a file outside the folder of the scene is named, or there is no triangle.
    UsageError
        If materials have no radio properties.
    """
    path = Path(path)
    root, data = _root(path)
    parameters = dict(materials or {})
    for name in parameters.values():
        material(name)  # raises an error for an unknown material
    radio, unknown, notes = _materials(root, parameters)
    digest, parts, skipped = hashlib.sha256(data), list[_Part](), Counter[str]()
    for shape in root.findall("./shape"):
        if (kind := shape.get("type", "?")) != "ply":
            skipped[kind] += 1
            continue
        name = shape.get("id") or f"shape {len(parts) + 1}"
        mesh, content = read_mesh(_file_of(shape, name, path))
        # combine the digests of files, because a digest of their joined bytes would not notice bytes moved between
        # files
        digest.update(hashlib.sha256(content).digest())
        parts.append(_Part(name, _of_shape(shape, name, radio, unknown), mesh))
        if sum(len(part.mesh[1]) for part in parts) > _MOST_TRIANGLES:
            raise InputError(
                f"more than {_MOST_TRIANGLES} triangles",
                expected="a scene that fits into memory",
                cause="a terrain or scan with more detail than the wavelength requires: simplify it first",
            )
    if not parts:
        raise InputError("the scene has no triangle", expected="shapes of type ply")
    vertices, triangles = joined([part.mesh for part in parts])
    notes += [
        f"warning: {counted(n, 'shape')} of type '{kind}' left out: only ply is read" for kind, n in skipped.items()
    ]
    return TriangleScene(
        vertices_m=vertices,
        triangles=triangles,
        shape=np.repeat(np.arange(len(parts)), [len(part.mesh[1]) for part in parts]),
        shapes=tuple(part.name for part in parts),
        materials=tuple(part.material for part in parts),
        notes=tuple(notes),
        sha256=digest.hexdigest(),
    )


class _Part(NamedTuple):
    """One shape of a scene with its radio material."""

    name: str
    material: str
    mesh: Mesh


def _root(path: Path) -> tuple[ElementTree.Element, bytes]:
    data = read_input(path, _LARGEST_XML, "a scene")
    root = xml_root(data, path, "a plain Mitsuba scene")
    if root.tag != "scene":
        raise InputError(f"XML of '{root.tag}'", expected="a Mitsuba scene ('scene')")
    if root.find(".//include") is not None:
        raise InputError("the scene includes another XML file", expected="one file: paste it in")
    return root, data


# ---------------------------------------------------------------- materials


def _materials(
    root: ElementTree.Element, parameters: Mapping[str, str]
) -> tuple[dict[str, str], dict[str, str], list[str]]:
    """Return radio materials by id, the types of other materials by id, and notes."""
    radio: dict[str, str] = {}
    unknown: dict[str, str] = {}
    rough: list[str] = []
    # read the materials of the scene first, because a shape may contain a material without a name
    for number, bsdf in enumerate((*root.findall("./bsdf"), *root.findall(".//shape/bsdf"))):
        name = bsdf.get("id") or bsdf.get("name") or f"unnamed {number + 1}"
        bsdf.set("id", name)
        if name in parameters:
            radio[name] = parameters[name]
            continue
        material = _radio_material(bsdf, name)
        if material is None:
            unknown[name] = bsdf.get("type", "?")
        else:
            radio[name] = material
            if _float(bsdf, "scattering_coefficient", 0.0) > 0.0 and not _VEGETATION.search(name.lower()):
                rough.append(name)
    stray = sorted(set(parameters) - set(radio))
    if stray:
        raise UsageError(f"the scene has no material '{stray[0]}'", expected="one of " + ", ".join([*radio, *unknown]))
    notes = []
    if rough:
        notes.append(f"diffuse scattering of {', '.join(rough)} is not modelled: they reflect as smooth surfaces")
    return radio, unknown, notes


def _radio_material(bsdf: ElementTree.Element, name: str) -> str | None:
    """Return the name of the radio material of a bsdf, or None if it has no radio properties."""
    kind, plain = bsdf.get("type", ""), name.removeprefix("mat-")
    thickness = _float(bsdf, "thickness", _DEFAULT_THICKNESS_M)
    stated = bsdf.find("string[@name='type']")
    if kind == "itu-radio-material" or plain.startswith(("itu_", "itu-")):
        # Blender's exporter uses these prefixes, and Sionna RT derives the type of material from them
        itu = plain[4:] if plain.startswith(("itu_", "itu-")) else plain
        if stated is not None:
            itu = stated.get("value", "")
        elif kind == "itu-radio-material" and itu == plain:
            raise InputError(f"the material '{name}' has no type", expected='<string name="type" .../>')
        try:
            return material(f"{itu} with thickness={thickness:.9g}").name
        except UsageError as error:
            raise InputError(f"material '{name}': {error.found}", expected=error.expected) from None
    if kind == "radio-material":
        permittivity = _float(bsdf, "relative_permittivity", 1.0)
        conductivity = _float(bsdf, "conductivity", 0.0)
        if permittivity < 1.0 or conductivity < 0.0 or thickness < 0.0:
            raise InputError(
                f"material '{name}': permittivity {permittivity:g}, conductivity {conductivity:g} S/m, "
                f"thickness {thickness:g} m",
                expected="a permittivity of at least 1 and no negative number",
            )
        return stated_name(permittivity, conductivity, thickness)
    return "vacuum" if kind == "absorber-radio-material" else None


def _float(parent: ElementTree.Element, name: str, default: float) -> float:
    item = parent.find(f"float[@name='{name}']")
    text = str(default) if item is None else item.get("value", "")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"'{text[:60]}'", expected="a finite number")
    return value


# ---------------------------------------------------------------- shapes


def _of_shape(shape: ElementTree.Element, name: str, radio: Mapping[str, str], unknown: Mapping[str, str]) -> str:
    """Return the radio material of a shape."""
    inner = shape.find("bsdf")
    # a shape may also refer to media and emitters
    refs = [item.get("id", "") for item in shape.findall("ref") if item.get("name", "bsdf") == "bsdf"]
    which = inner.get("id", "") if inner is not None else (refs[0] if refs else "")
    # check the name before the material, because leaves often have a material without radio properties
    if _VEGETATION.search(f"{name} {which}".lower()):
        return CROWN
    if which in radio:
        return radio[which]
    if not which:
        raise InputError(f"the shape '{name}' has no material", expected='<ref id="..." name="bsdf"/>')
    if which in unknown:
        others = "" if len(unknown) == 1 else f" and {len(unknown) - 1} more ({', '.join(list(unknown)[:6])})"
        raise UsageError(
            f"the material '{which}'{others} is of type '{unknown[which]}', which has no radio properties",
            expected="itu-radio-material, radio-material, or an id such as 'mat-itu_concrete'",
            cause=f"a material of a renderer; name its radio material: --material '{which}=concrete'",
        )
    raise InputError(
        f"the shape '{name}' names the material '{which}', which is not in the scene",
        expected="one of " + ", ".join([*radio, *unknown][:20]),
    )


def _file_of(shape: ElementTree.Element, name: str, path: Path) -> Path:
    """Return the mesh file of a shape. The file must be in the folder of the scene."""
    # exporters write empty transforms, which have no effect
    if len(shape.find("transform[@name='to_world']") or ()):
        raise InputError(
            f"the shape '{name}' is moved by a to_world",
            expected="meshes in the coordinates of the scene, as Sionna RT's own",
            cause="apply the transform where the scene was made (Blender: Object, Apply), and export it again",
        )
    item, folder = shape.find("string[@name='filename']"), path.parent.resolve()
    wanted = "" if item is None else item.get("value", "")
    if not wanted:
        raise InputError(f"the shape '{name}' names no file", expected='<string name="filename" .../>')
    place = inside(folder, wanted, path)
    if not place.is_file():
        raise InputError(
            f"the shape '{name}' names '{wanted}', which is not there",
            expected=f"a mesh below {folder}",
            cause="the XML file was copied without its folder 'meshes'",
        )
    return place

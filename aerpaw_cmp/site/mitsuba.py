"""Scenes of meshes: PLY files, and Mitsuba scenes in the dialect of Sionna RT.

Triangles and radio materials of a Mitsuba scene are read without Mitsuba.

Supported are shapes of type ``ply`` in the coordinates of the scene, as in all scenes of Sionna RT and AERPAW, and the
materials ``itu-radio-material``, ``radio-material``, ``absorber-radio-material`` or any other whose id begins with
``itu_`` or ``mat-itu_``. A scene may name only files in its own folder.

Triangles come from PLY files in three formats (ASCII, and binary of both byte orders).

Polygons become fans of triangles. Polygons that are not flat are counted, because the fan then changes their shape.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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

# A polygon is not flat if a corner is farther than this from the plane of its first three corners [m].
_FLAT_M = 1e-3

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


# Vertices (n, 3) [m] and triangles (m, 3).
Mesh = tuple[FloatArray, IntArray]


@dataclass(frozen=True, slots=True)
class RawMesh:
    """The contents of a mesh file: vertices (n, 3), triangles (m, 3) int, and the number of bent polygons."""

    vertices: FloatArray
    triangles: IntArray
    bent: int = 0


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    properties: tuple[tuple[str, str, str], ...]
    """Name and type. For lists, the type of the length follows, otherwise an empty text."""


def read_mesh(path: Path) -> tuple[RawMesh, bytes]:
    """Return the mesh of a PLY file, and the bytes of the file (for a digest).

    Raises
    ------
    InputError
        If there is no such file, or it is too large or damaged.
    """
    data = read_input(path, _LARGEST_FILE, "a mesh")
    with parsing(path, "a mesh"):
        return check(read_ply(data)), data


def check(mesh: RawMesh) -> RawMesh:
    """Return the mesh if every index names a vertex and every used vertex is finite."""
    if len(mesh.triangles):
        low, high = int(mesh.triangles.min()), int(mesh.triangles.max())
        if low < 0 or high >= len(mesh.vertices):
            raise InputError(
                f"a face names vertex {low if low < 0 else high}",
                expected=f"0 to {len(mesh.vertices) - 1}",
                cause="the file is damaged",
            )
        if not np.isfinite(mesh.vertices[mesh.triangles.ravel()]).all():
            raise InputError("a vertex is not a finite number", expected="coordinates in metres")
    return mesh


def read_ply(data: bytes) -> RawMesh:
    """Read a PLY file."""
    kind, elements, start = _header(data)
    body = _Body(data, ">" if kind == "binary_big_endian" else "<", start)
    if kind == "ascii":  # convert words to numbers of one type, so that the rest is the same as for a binary file
        body = _Body(_numbers(data[start:].split()).tobytes(), "=", 0)
        elements = [replace(e, properties=tuple((n, "f8", k and "f8") for n, _, k in e.properties)) for e in elements]
    vertices: FloatArray = np.zeros((0, 3))
    triangles, bent = np.zeros((0, 3), dtype=np.int64), 0
    for element in elements:
        columns = body.read(element)
        if element.name == "vertex":
            vertices = _vertices(element, columns)
        elif element.name == "face":
            triangles, bent = _fans(_polygons(element, columns), vertices)
    return RawMesh(vertices, triangles, bent)


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    if not data.startswith(b"ply"):
        raise InputError("it does not begin with 'ply'", expected="a PLY mesh")
    end = data.find(b"end_header", 0, _LARGEST_HEADER)
    if end < 0:
        found = f"no 'end_header' in its first {_LARGEST_HEADER} bytes"
        raise InputError(found, expected="a PLY mesh", cause="a damaged file")
    start = data.find(b"\n", end) + 1
    kind = ""
    elements: list[_Element] = []
    for number, line in enumerate(data[:end].decode("latin-1").splitlines(), 1):
        words = line.split()
        try:
            kind = words[1] if words[:1] == ["format"] else kind
            _declare(words, elements)
        except (IndexError, KeyError, ValueError):
            raise InputError(f"the header says '{line.strip()[:60]}'", expected="a PLY header", line=number) from None
    # a negative count would read backwards
    if kind not in ("ascii", "binary_little_endian", "binary_big_endian") or any(e.count < 0 for e in elements):
        raise InputError(f"a PLY of format '{kind}'", expected="ascii or binary")
    return kind, elements, start


def _declare(words: list[str], elements: list[_Element]) -> None:
    """Read an element of the header, or a property of its last element. Other lines raise an error."""
    if words[:1] == ["element"]:
        elements.append(_Element(words[1], int(words[2]), ()))
    elif words[:1] == ["property"]:
        last = elements[-1]
        listed = words[1] == "list"
        item = (words[4], _TYPES[words[3]], _TYPES[words[2]]) if listed else (words[2], _TYPES[words[1]], "")
        elements[-1] = _Element(last.name, last.count, (*last.properties, item))


def _numbers(words: list[bytes]) -> FloatArray:
    try:
        return np.array(words, dtype=np.bytes_).astype(np.float64) if words else np.zeros(0)
    except ValueError as error:
        raise InputError(f"not a number: {error}") from None


@dataclass(slots=True)
class _Body:
    """The bytes after the header, which are read from ``place``."""

    data: bytes
    order: str
    place: int

    def take(self, kind: Any, count: int, element: _Element) -> AnyArray:
        """Return the next ``count`` items of a type."""
        # NumPy's default is the byte order of this machine
        what = np.dtype(kind).newbyteorder(self.order)
        if count < 0 or self.place + count * what.itemsize > len(self.data):
            raise InputError(
                f"the file ends before the {element.count} entries of '{element.name}' that its header promises",
                cause="it was cut off, or the header is damaged",
            )
        values = np.frombuffer(self.data, what, count, self.place)
        self.place += count * what.itemsize
        return values

    def read(self, element: _Element) -> dict[str, Any]:
        """Return the values of each property by row: an array, or a list of arrays if lists differ in length."""
        least = sum(np.dtype(length or kind).itemsize for _, kind, length in element.properties)
        begun = self.place
        if not element.count or not least:
            return {name: np.zeros((0, 1)) for name, *_ in element.properties}
        # a header that promises more than the file contains fails here, before memory is requested
        self.take(("V", least), element.count, element)
        self.place = begun
        # most meshes have only triangles: if all lists are as long as the first list, read them as one table
        first, fields = self._row(element), list[Any]()
        for i, ((_, kind, length), values) in enumerate(zip(element.properties, first, strict=True)):
            fields += [(f"length {i}", length)] if length else []
            fields.append((f"{i}", kind, (len(values),)))
        self.place, record = begun, np.dtype(fields)
        if begun + element.count * record.itemsize <= len(self.data):
            rows = self.take(record, element.count, element)
            if all((rows[f"length {i}"] == len(first[i])).all() for i, p in enumerate(element.properties) if p[2]):
                return {name: rows[f"{i}"] for i, (name, *_) in enumerate(element.properties)}
            self.place = begun
        several = [self._row(element) for _ in range(element.count)]
        return {name: [row[i] for row in several] for i, (name, *_) in enumerate(element.properties)}

    def _row(self, element: _Element) -> list[AnyArray]:
        """Return the values of the properties of the next entry."""
        return [
            self.take(kind, int(self.take(length, 1, element)[0]) if length else 1, element)
            for _, kind, length in element.properties
        ]


def _vertices(element: _Element, columns: dict[str, Any]) -> FloatArray:
    if not {"x", "y", "z"} <= set(columns) or any(length for *_, length in element.properties):
        raise InputError("its vertices have no x, y and z", expected="a PLY mesh")
    return np.column_stack([columns[axis][:, 0].astype(np.float64) for axis in "xyz"])


def _polygons(element: _Element, columns: dict[str, Any]) -> list[IntArray]:
    """Return the corners of the polygons, grouped by size."""
    lists = [name for name, _, length in element.properties if length]
    which = next((name for name in lists if name in ("vertex_indices", "vertex_index")), None)
    if which is None:
        raise InputError("its faces list no vertices", expected="'vertex_indices' or 'vertex_index'")
    corners, by_size = columns[which], dict[int, list[AnyArray]]()
    for row in [corners] if isinstance(corners, np.ndarray) else corners:
        by_size.setdefault(row.shape[-1], []).append(row.reshape(-1, row.shape[-1]))
    # replace a value that is not a number by an index that no vertex has
    polygons = {size: np.concatenate(rows) for size, rows in by_size.items() if size >= 3}
    return [np.where(np.abs(rows) < 2**53, rows, -1).astype(np.int64) for rows in polygons.values()]


def _fans(polygons: list[IntArray], vertices: FloatArray) -> tuple[IntArray, int]:
    """Return the triangles of polygons (n, 3), and the number of polygons that are not flat."""
    triangles: list[IntArray] = []
    bent = 0
    for group in polygons:
        corners = group.shape[1]
        if corners > 3:
            check(RawMesh(vertices, group))
            points = vertices[group]
            normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
            size = np.linalg.norm(normal, axis=1, keepdims=True)
            height = np.einsum("pki,pi->pk", points - points[:, :1], normal / np.where(size > 0.0, size, 1.0))
            bent += int((np.abs(height).max(axis=1) > _FLAT_M).sum())
        for k in range(1, corners - 1):
            # a fan around the first corner
            triangles.append(group[:, [0, k, k + 1]])
    return (np.concatenate(triangles) if triangles else np.zeros((0, 3), dtype=np.int64)), bent


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
        # combine digests, so that moving bytes from one file to the next changes the result
        digest.update(hashlib.sha256(content).digest())
        parts.append(_Part(name, _of_shape(shape, name, radio, unknown), mesh))
        if sum(len(part.mesh.triangles) for part in parts) > _MOST_TRIANGLES:
            raise InputError(
                f"more than {_MOST_TRIANGLES} triangles",
                expected="a scene that fits into memory",
                cause="a terrain or scan that is finer than a wavelength asks for: simplify it first",
            )
    if not parts:
        raise InputError("the scene has no triangle", expected="shapes of type ply")
    meshes = [part.mesh for part in parts]
    vertices, triangles = joined([(mesh.vertices, mesh.triangles) for mesh in meshes])
    if bent := sum(mesh.bent for mesh in meshes):
        notes.append(f"{bent} polygons are not flat: they were cut into triangles from their first corner")
    notes += [
        f"warning: {counted(n, 'shape')} of type '{kind}' left out: only ply is read" for kind, n in skipped.items()
    ]
    return TriangleScene(
        vertices_m=vertices,
        triangles=triangles,
        shape=np.repeat(np.arange(len(parts)), [len(mesh.triangles) for mesh in meshes]),
        shapes=tuple(part.name for part in parts),
        materials=tuple(part.material for part in parts),
        notes=tuple(notes),
        sha256=digest.hexdigest(),
    )


class _Part(NamedTuple):
    """One shape of a scene with its radio material."""

    name: str
    material: str
    mesh: RawMesh


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
        # the exporter of Blender uses such names, from which Sionna RT derives the type
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
    # check before its material, because leaves often have a material without radio properties
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
    """Return the mesh file of a shape, which is in the folder of the scene."""
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

"""Triangles of PLY and OBJ files; pure functions of bytes.

PLY in its three formats (ASCII, binary of either byte order), OBJ without its materials. Polygons become fans of
triangles; one that is not flat is counted, since how it is cut then decides its shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...common.errors import InputError, parsing
from ...common.files import read_input
from ...common.units import FloatArray, IntArray

# Bytes within which a PLY header ends; a longer one is no header.
_LARGEST_HEADER = 65_536

# Bytes of one mesh file.
_LARGEST_FILE = 2**30

# A polygon whose corners depart further [m] from the plane of its first three is not flat.
_FLAT_M = 1e-3

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class RawMesh:
    """Contents of a mesh file: vertices (n, 3), triangles (m, 3) int, and how many of its polygons were not flat."""

    vertices: FloatArray
    triangles: IntArray
    bent: int = 0


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    properties: tuple[tuple[str, str, str], ...]
    """(name, type, type of the list's length or "")"""


def read_mesh(path: Path) -> tuple[RawMesh, bytes]:
    """A PLY or OBJ file and its bytes (for a digest).

    Raises
    ------
    InputError
        No such file, too large, or damaged.
    """
    data = read_input(path, _LARGEST_FILE, "a mesh")
    with parsing(path, "a mesh"):
        return check(_read_obj(data, path) if path.suffix.lower() == ".obj" else read_ply(data, path), path), data


def check(mesh: RawMesh, path: Path) -> RawMesh:
    """The mesh, if every index names a vertex and every used vertex is a place."""
    if len(mesh.triangles):
        low, high = int(mesh.triangles.min()), int(mesh.triangles.max())
        if low < 0 or high >= len(mesh.vertices):
            raise InputError(
                f"a face names vertex {low if low < 0 else high}",
                expected=f"0 to {len(mesh.vertices) - 1}",
                cause="the file is damaged",
                path=path,
            )
        if not np.isfinite(mesh.vertices[mesh.triangles.ravel()]).all():
            raise InputError("a vertex is not a finite number", expected="coordinates in metres", path=path)
    return mesh


# ---------------------------------------------------------------- PLY


def read_ply(data: bytes, path: Path) -> RawMesh:
    """A PLY file."""
    kind, elements, start = _header(data, path)
    order = ">" if kind == "binary_big_endian" else "<"
    words = data[start:].split() if kind == "ascii" else []
    vertices: FloatArray = np.zeros((0, 3))
    triangles, bent = np.zeros((0, 3), dtype=np.int64), 0
    place = 0
    for element in elements:
        if element.name == "vertex":
            vertices, place = _vertices(element, data[start:], words, place, order, path)
        elif element.name == "face":
            polygons, place = _polygons(element, data[start:], words, place, order, path)
            triangles, bent = _fans(polygons, vertices, path)
        else:
            place = _skip(element, data[start:], words, place, order, path)
    return RawMesh(vertices, triangles, bent)


def _header(data: bytes, path: Path) -> tuple[str, list[_Element], int]:
    if not data.startswith(b"ply"):
        raise InputError("it does not begin with 'ply'", expected="a PLY mesh", path=path)
    end = data.find(b"end_header", 0, _LARGEST_HEADER)
    if end < 0:
        raise InputError(
            f"no 'end_header' in its first {_LARGEST_HEADER} bytes", expected="a PLY mesh", cause="a damaged file",
            path=path,
        )  # fmt: skip
    start = data.find(b"\n", end) + 1
    kind = ""
    elements: list[_Element] = []
    for number, line in enumerate(data[:end].decode("latin-1").splitlines(), 1):
        words = line.split()
        try:
            kind = words[1] if words[:1] == ["format"] else kind
            _declare(words, elements)
        except (IndexError, KeyError, ValueError):
            raise InputError(
                f"the header says '{line.strip()[:60]}'", expected="a PLY header", path=path, line=number
            ) from None
    if kind not in ("ascii", "binary_little_endian", "binary_big_endian") or any(e.count < 0 for e in elements):
        raise InputError(f"a PLY of format '{kind}'", expected="ascii or binary", path=path)
    return kind, elements, start


def _declare(words: list[str], elements: list[_Element]) -> None:
    """An element of the header, or a property of its last one; IndexError, KeyError, ValueError where it is neither."""
    if words[:1] == ["element"]:
        elements.append(_Element(words[1], int(words[2]), ()))
    elif words[:1] == ["property"]:
        last = elements[-1]
        listed = words[1] == "list"
        item = (words[4], _TYPES[words[3]], _TYPES[words[2]]) if listed else (words[2], _TYPES[words[1]], "")
        elements[-1] = _Element(last.name, last.count, (*last.properties, item))


def _cut_off(element: _Element, path: Path) -> InputError:
    return InputError(
        f"the file ends before the {element.count} entries of '{element.name}' that its header promises",
        cause="it was cut off, or the header is damaged",
        path=path,
    )


def _vertices(
    element: _Element, data: bytes, words: list[bytes], place: int, order: str, path: Path
) -> tuple[FloatArray, int]:
    names = [name for name, _, _ in element.properties]
    if not {"x", "y", "z"} <= set(names) or any(length for *_, length in element.properties):
        raise InputError("its vertices have no x, y and z", expected="a PLY mesh", path=path)
    if words:
        width = len(names)
        if place + width * element.count > len(words):
            raise _cut_off(element, path)
        table = _numbers(words[place : place + width * element.count], path).reshape(element.count, width)
        return table[:, [names.index(axis) for axis in "xyz"]].copy(), place + width * element.count
    record = np.dtype([(f"{i}", order + kind) for i, (_, kind, _) in enumerate(element.properties)])
    if place + record.itemsize * element.count > len(data):
        raise _cut_off(element, path)
    rows = np.frombuffer(data, dtype=record, count=element.count, offset=place)
    columns = [rows[f"{names.index(axis)}"].astype(np.float64) for axis in "xyz"]
    return np.column_stack(columns), place + record.itemsize * element.count


def _numbers(words: list[bytes], path: Path) -> FloatArray:
    try:
        return np.array(words, dtype=np.bytes_).astype(np.float64) if words else np.zeros(0)
    except ValueError as error:
        raise InputError(f"not a number: {error}", path=path) from None


def _polygons(
    element: _Element, data: bytes, words: list[bytes], place: int, order: str, path: Path
) -> tuple[list[IntArray], int]:
    """Corner indices of the polygons, as arrays (polygons, corners) of one number of corners each."""
    lists = [name for name, _, length in element.properties if length]
    which = next((name for name in lists if name in ("vertex_indices", "vertex_index")), None)
    if which is None:
        raise InputError("its faces list no vertices", expected="'vertex_indices' or 'vertex_index'", path=path)
    if not words:
        even = _even_polygons(element, data, place, order, which)
        if even is not None:
            return [even[0]], even[1]
    by_size: dict[int, list[list[int]]] = {}
    for _ in range(element.count):
        corners: list[int] = []
        for name, kind, length in element.properties:
            count, place = _read_count(data, words, place, order + length, element, path) if length else (1, place)
            values, place = _several(data, words, place, order + kind, int(count), element, path)
            corners = values if name == which else corners
        if len(corners) >= 3:
            by_size.setdefault(len(corners), []).append(corners)
    return [np.array(group, dtype=np.int64) for group in by_size.values()], place


def _even_polygons(element: _Element, data: bytes, place: int, order: str, which: str) -> tuple[IntArray, int] | None:
    """All polygons at once where all have as many corners as the first, as nearly every file has it."""
    first = place
    record: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for name, kind, length in element.properties:
        if length:
            if name != which or first >= len(data) or element.count == 0:
                return None
            corners = int(np.frombuffer(data, dtype=order + length, count=1, offset=first)[0]) if name == which else 0
            record += [("n", order + length), ("corners", order + kind, (corners,))]
        else:
            record.append((f"other {name}", order + kind))
        first = place + np.dtype(record).itemsize
    what = np.dtype(record)
    if place + what.itemsize * element.count > len(data):
        return None
    rows = np.frombuffer(data, dtype=what, count=element.count, offset=place)
    if not (rows["n"] == rows["n"][0]).all() or rows["n"][0] < 3:
        return None
    return rows["corners"].astype(np.int64).reshape(element.count, -1), place + what.itemsize * element.count


def _read_count(
    data: bytes, words: list[bytes], place: int, kind: str, element: _Element, path: Path
) -> tuple[int, int]:
    values, place = _several(data, words, place, kind, 1, element, path)
    return values[0], place


def _several(
    data: bytes, words: list[bytes], place: int, kind: str, count: int, element: _Element, path: Path
) -> tuple[list[int], int]:
    if words:
        if count < 0 or place + count > len(words):
            raise _cut_off(element, path)
        return [int(value) for value in _numbers(words[place : place + count], path)], place + count
    end = place + count * np.dtype(kind).itemsize
    if count < 0 or end > len(data):
        raise _cut_off(element, path)
    return np.frombuffer(data, dtype=kind, count=count, offset=place).astype(np.int64).tolist(), end


def _skip(element: _Element, data: bytes, words: list[bytes], place: int, order: str, path: Path) -> int:
    if not any(length for *_, length in element.properties):
        width = len(element.properties) if words else sum(np.dtype(k).itemsize for _, k, _ in element.properties)
        if place + width * element.count > len(words or data):
            raise _cut_off(element, path)
        return place + width * element.count
    for _ in range(element.count):
        for _, kind, length in element.properties:
            count, place = _read_count(data, words, place, order + length, element, path) if length else (1, place)
            _, place = _several(data, words, place, order + kind, int(count), element, path)
    return place


def _fans(polygons: list[IntArray], vertices: FloatArray, path: Path) -> tuple[IntArray, int]:
    """Triangles (n, 3) of polygons, and how many of those are not flat."""
    triangles: list[IntArray] = []
    bent = 0
    for group in polygons:
        corners = group.shape[1]
        if corners > 3:
            check(RawMesh(vertices, group), path)
            points = vertices[group]
            normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
            size = np.linalg.norm(normal, axis=1, keepdims=True)
            height = np.einsum("pki,pi->pk", points - points[:, :1], normal / np.where(size > 0.0, size, 1.0))
            bent += int((np.abs(height).max(axis=1) > _FLAT_M).sum())
        for k in range(1, corners - 1):
            triangles.append(group[:, [0, k, k + 1]])
    return (np.concatenate(triangles) if triangles else np.zeros((0, 3), dtype=np.int64)), bent


# ---------------------------------------------------------------- OBJ


def _corners(words: list[str], vertices: int) -> list[int]:
    """Vertices of a face, counted from 1, or back from the last where negative; ValueError where it is none."""
    numbers = [int(word.split("/")[0]) for word in words]
    if len(numbers) < 3:
        raise ValueError
    return [number - 1 if number > 0 else vertices + number for number in numbers]


def _read_obj(data: bytes, path: Path) -> RawMesh:
    """Vertices and faces of a Wavefront OBJ file; its normals, textures and materials are not read."""
    vertices: list[list[float]] = []
    faces: dict[int, list[list[int]]] = {}
    for number, line in enumerate(data.decode("latin-1").splitlines(), 1):
        words = line.split()
        try:
            if words[:1] == ["v"]:
                vertices.append([float(words[1]), float(words[2]), float(words[3])])
            if words[:1] == ["f"]:
                corners = _corners(words[1:], len(vertices))
                faces.setdefault(len(corners), []).append(corners)
        except (ValueError, IndexError):
            raise InputError(f"'{line.strip()[:60]}'", expected="an OBJ mesh", path=path, line=number) from None
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    triangles, bent = _fans([np.array(group, dtype=np.int64) for group in faces.values()], points, path)
    return RawMesh(points, triangles, bent)

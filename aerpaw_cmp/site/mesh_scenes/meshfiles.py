"""Triangles of PLY files in their three formats (ASCII, binary of either byte order); pure functions of bytes.

Polygons become fans of triangles; one that is not flat is counted, since how it is cut then decides its shape.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...common.errors import InputError, parsing
from ...common.files import read_input
from ...common.units import AnyArray, FloatArray, IntArray

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
    """A PLY file and its bytes (for a digest).

    Raises
    ------
    InputError
        No such file, too large, or damaged.
    """
    data = read_input(path, _LARGEST_FILE, "a mesh")
    with parsing(path, "a mesh"):
        return check(read_ply(data, path), path), data


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


def read_ply(data: bytes, path: Path) -> RawMesh:
    """A PLY file."""
    kind, elements, start = _header(data, path)
    body = _Body(data, ">" if kind == "binary_big_endian" else "<", start, path)
    if kind == "ascii":  # the words as numbers of one kind: from here on a binary file
        body = _Body(_numbers(data[start:].split(), path).tobytes(), "=", 0, path)
        elements = [replace(e, properties=tuple((n, "f8", k and "f8") for n, _, k in e.properties)) for e in elements]
    vertices: FloatArray = np.zeros((0, 3))
    triangles, bent = np.zeros((0, 3), dtype=np.int64), 0
    for element in elements:
        columns = body.read(element)
        if element.name == "vertex":
            vertices = _vertices(element, columns, path)
        elif element.name == "face":
            triangles, bent = _fans(_polygons(element, columns, path), vertices, path)
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
    # a negative count would read backwards
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


def _numbers(words: list[bytes], path: Path) -> FloatArray:
    try:
        return np.array(words, dtype=np.bytes_).astype(np.float64) if words else np.zeros(0)
    except ValueError as error:
        raise InputError(f"not a number: {error}", path=path) from None


@dataclass(slots=True)
class _Body:
    """Bytes behind the header, read from ``place`` on."""

    data: bytes
    order: str
    place: int
    path: Path

    def take(self, kind: Any, count: int, element: _Element) -> AnyArray:
        """The next ``count`` items of a type."""
        # numpy's own order is that of this machine
        what = np.dtype(kind).newbyteorder(self.order)
        if count < 0 or self.place + count * what.itemsize > len(self.data):
            raise InputError(
                f"the file ends before the {element.count} entries of '{element.name}' that its header promises",
                cause="it was cut off, or the header is damaged",
                path=self.path,
            )
        values = np.frombuffer(self.data, what, count, self.place)
        self.place += count * what.itemsize
        return values

    def read(self, element: _Element) -> dict[str, Any]:
        """Values of each property, a row an entry: an array, or a list of arrays where lists differ in length."""
        least = sum(np.dtype(length or kind).itemsize for _, kind, length in element.properties)
        begun = self.place
        if not element.count or not least:
            return {name: np.zeros((0, 1)) for name, *_ in element.properties}
        # a header that promises more than the file holds ends here, before memory is asked for it
        self.take(("V", least), element.count, element)  # or no row need be looked at
        self.place = begun
        # most meshes are triangles throughout: lists as long as the first are read as one table
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
        """Values of the properties of the next entry."""
        return [
            self.take(kind, int(self.take(length, 1, element)[0]) if length else 1, element)
            for _, kind, length in element.properties
        ]


def _vertices(element: _Element, columns: dict[str, Any], path: Path) -> FloatArray:
    if not {"x", "y", "z"} <= set(columns) or any(length for *_, length in element.properties):
        raise InputError("its vertices have no x, y and z", expected="a PLY mesh", path=path)
    return np.column_stack([columns[axis][:, 0].astype(np.float64) for axis in "xyz"])


def _polygons(element: _Element, columns: dict[str, Any], path: Path) -> list[IntArray]:
    """Corners of the polygons, those of one size together."""
    lists = [name for name, _, length in element.properties if length]
    which = next((name for name in lists if name in ("vertex_indices", "vertex_index")), None)
    if which is None:
        raise InputError("its faces list no vertices", expected="'vertex_indices' or 'vertex_index'", path=path)
    corners, by_size = columns[which], dict[int, list[AnyArray]]()
    for row in [corners] if isinstance(corners, np.ndarray) else corners:
        by_size.setdefault(row.shape[-1], []).append(row.reshape(-1, row.shape[-1]))
    # no index is as large: what is no number becomes one that no vertex has
    polygons = {size: np.concatenate(rows) for size, rows in by_size.items() if size >= 3}
    return [np.where(np.abs(rows) < 2**53, rows, -1).astype(np.int64) for rows in polygons.values()]


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
            # a fan from the first corner
            triangles.append(group[:, [0, k, k + 1]])
    return (np.concatenate(triangles) if triangles else np.zeros((0, 3), dtype=np.int64)), bent

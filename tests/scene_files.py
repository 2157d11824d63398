"""Mitsuba scenes of boxes, as files."""

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

# outward; corners by z, then y, then x
QUADS = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
PLY_HEAD = (
    "ply\nformat binary_little_endian 1.0\ncomment x\nelement vertex {}\nproperty double x\nproperty float s\n"
    "property double y\nproperty double z\nelement face {}\nproperty list uchar uint vertex_index\n"
    "property uchar red\nend_header\n"
)


def ply(points: Sequence[Sequence[float]], triangles: Sequence[Sequence[int]]) -> bytes:
    """Return a PLY file, with a property of vertices and one of faces that no scene needs."""
    head = PLY_HEAD.format(len(points), len(triangles)).encode()
    rows = b"".join(np.array([(x, 0.0, y, z)], "<f8, <f4, <f8, <f8").tobytes() for x, y, z in points)
    return head + rows + b"".join(bytes([len(f)]) + np.array(f, "<u4").tobytes() + b"\x07" for f in triangles)


def box(folder: Path, name: str, material: str, low: tuple[float, ...], high: tuple[float, ...]) -> str:
    """Write the PLY mesh of a box, or of a rectangle if it has no height. Return its element of the scene."""
    corners = [c[::-1] for c in itertools.product(*zip(low[::-1], high[::-1], strict=True))]
    quads = QUADS if low[2] < high[2] else ((0, 1, 3, 2),)
    triangles = [some for a, b, c, d in quads for some in ((a, b, c), (a, c, d))]
    (folder / f"{name}.ply").write_bytes(ply(corners, triangles))
    return (
        f'<shape type="ply" id="{name}"><string name="filename" value="{name}.ply"/>'
        f'<ref id="{material}" name="bsdf"/></shape>'
    )

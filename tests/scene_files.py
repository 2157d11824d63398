"""Mitsuba scenes of boxes, as files."""

import itertools
from pathlib import Path

QUADS = ("0 2 3 1", "4 5 7 6", "0 1 5 4", "2 6 7 3", "0 4 6 2", "1 3 7 5")  # outward; corners by z, then y, then x


def box(folder: Path, name: str, material: str, low: tuple[float, ...], high: tuple[float, ...]) -> str:
    """Write the PLY mesh of a box, or of a rectangle if it has no height. Return its element of the scene."""
    corners = [c[::-1] for c in itertools.product(*zip(low[::-1], high[::-1], strict=True))]
    quads = QUADS if low[2] < high[2] else ("0 1 3 2",)
    lines = [
        "ply", "format ascii 1.0", "element vertex 8", *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(quads)}", "property list uchar int vertex_indices", "end_header",
        *(" ".join(map(str, corner)) for corner in corners), *(f"4 {quad}" for quad in quads),
    ]  # fmt: skip
    (folder / f"{name}.ply").write_text("\n".join(lines) + "\n")
    return (
        f'<shape type="ply" id="{name}"><string name="filename" value="{name}.ply"/>'
        f'<ref id="{material}" name="bsdf"/></shape>'
    )

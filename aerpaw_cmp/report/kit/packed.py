"""Arrays of a page's script as one deflated block: integers with a step where a step is enough."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np

from ...common.units import AnyArray, FloatArray

# What stands for NaN in an array of each integer kind.
NONE = {"u1": 255, "u2": 65_535, "i2": -32_768}

# the most negative number stands for NaN, so the range is even about zero
LARGEST = 32_767


class PackedArrays:
    """Arrays of a page, each stored once, one after the other at multiples of eight bytes.

    Examples
    --------
    >>> arrays = PackedArrays()
    >>> arrays.add(np.array([1.5, 2.5]), "f4"), arrays.add(np.array([7]), "u1"), arrays.add(np.array([1.5, 2.5]), "f4")
    (0, 1, 0)
    >>> arrays.content()["arrays"]
    [['f4', 0, 2], ['u1', 8, 1]]
    """

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._table: list[tuple[str, int, int]] = []
        self._known: dict[tuple[str, bytes], int] = {}
        self._size = 0

    def add(self, values: AnyArray, kind: str = "f4") -> int:
        """Number under which the values stand, little endian; equal arrays share one."""
        raw = np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()
        key = (kind, raw)
        if key not in self._known:
            self._known[key] = len(self._table)
            self._table.append((kind, self._size, np.size(values)))
            # a typed array of JavaScript must begin at a multiple of its own size
            padded = raw + bytes(-len(raw) % 8)
            self._parts.append(padded)
            self._size += len(padded)
        return self._known[key]

    def add_steps(self, values: FloatArray, step: float) -> int:
        """Values as 16-bit multiples of ``step``; what is not finite is none."""
        return self.add(_steps_of(values, step), "i2")

    def content(self) -> dict[str, Any]:
        """``{"data": base64 of the deflated block, "arrays": [[kind, offset, length], ...]}``."""
        block = zlib.compress(b"".join(self._parts), 9)
        return {"data": base64.b64encode(block).decode("ascii"), "arrays": [list(entry) for entry in self._table]}


def _steps_of(values: FloatArray, step: float) -> AnyArray:
    """Values as multiples of ``step``, those beyond 16 bits at the end of the range; NaN and infinities are none.

    Examples
    --------
    >>> _steps_of(np.array([0.014, -1.0, np.nan]), 0.01).tolist()
    [1, -100, -32768]
    """
    array = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(array)
    with np.errstate(over="ignore"):
        scaled = np.rint(np.where(finite, array, 0.0) / step)
    return np.where(finite, np.clip(scaled, -LARGEST, LARGEST), NONE["i2"]).astype(np.int16)


def step_for(values: FloatArray, finest: float = 0.01) -> float:
    """Least step that holds all values in 16 bits: ``finest``, or that times a power of ten.

    Examples
    --------
    >>> step_for(np.array([-140.0, 30.0])), step_for(np.array([0.0, 5000.0]))
    (0.01, 1.0)
    """
    array = np.asarray(values, dtype=np.float64)
    reach = float(np.abs(array[np.isfinite(array)]).max(initial=0.0))
    # less a rounding of the logarithm: what fits exactly must not get a step ten times as coarse
    tens = int(np.ceil(np.log10(max(reach / (LARGEST * finest), 1.0)) - 1e-12))
    return float(finest * 10.0**tens)

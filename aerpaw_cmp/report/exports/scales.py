"""Colours of levels, residuals and ranks: of the lines in Google Earth."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from ...common.units import AnyArray, FloatArray, IntArray
from ...maps.kml import CLASS_COLOURS
from .points import Export

LEVELS = 10
"""Colours of a scale of numbers."""
OUT = CLASS_COLOURS[0]
"""Grey: no value."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scale:
    """Colours of one quantity: ``edges`` (m + 1,) between them, or none where its values are classes."""

    key: str
    title: str
    colours: tuple[str, ...]
    labels: tuple[str, ...]
    edges: FloatArray | None = None

    def bin_of(self, values: FloatArray) -> IntArray:
        """Number of each value's colour (n,); the last is out of coverage."""
        known = np.isfinite(values)
        if self.edges is None:
            number = np.clip(np.nan_to_num(values).astype(np.int64), 0, len(self.colours) - 2) - 1
            return np.where(known & (number >= 0), number, len(self.colours) - 1)
        number = np.searchsorted(self.edges[1:-1], np.nan_to_num(values), side="right")
        return np.where(known, number, len(self.colours) - 1)


RANKS = Scale(
    key="rank",
    title="Rank",
    colours=(*CLASS_COLOURS[1:5], OUT),
    labels=("rank 1", "rank 2", "rank 3", "rank 4", "no path or no report"),
)


def scales_of(export: Export) -> dict[str, dict[str, Scale]]:
    """By kind and column: levels share one scale, residuals another, ranks their classes."""
    scales: dict[str, dict[str, Scale]] = {}
    for points in export.sets:
        names = {c.name for c in points.columns}
        here = {c: RANKS for c in names if c == "measured_rank" or c.startswith("simulated_rank_k")}
        levels = sorted(names & {"calibrated_db", "simulated_dbm"})
        if levels:
            values = points.table[levels].to_numpy().ravel()
            here |= dict.fromkeys(levels, _level_scale(values[np.isfinite(values)]))
        if "residual_db" in names:
            apart = np.abs(points.table["residual_db"].to_numpy())
            here["residual_db"] = _residual_scale(apart[np.isfinite(apart)])
        scales[points.kind] = {c.name: here[c.name] for c in points.columns if c.name in here}
    return scales


def _level_scale(levels: FloatArray) -> Scale:
    """Steps of whole numbers between the 2nd and 98th percentile."""
    low, high = np.percentile(levels, [2, 98]) if len(levels) else (-100.0, -60.0)
    step = _round_step((high - low) / LEVELS)
    edges = (np.floor(low / step) + np.arange(LEVELS + 1)) * step
    return _numbers("level", "Level [dBm]", edges, "viridis")


def _residual_scale(apart: FloatArray) -> Scale:
    """Symmetric about zero, to the 98th percentile of the size."""
    most = float(np.percentile(apart, 98)) if len(apart) else 5.0
    step = _round_step(2 * most / (LEVELS - 1))
    edges = (np.arange(LEVELS) - (LEVELS - 1) / 2) * step
    return _numbers("residual", "Measured minus replayed [dB]", edges, "RdBu_r")


def _round_step(step: float) -> float:
    """The next step up of 1, 2, 5 times a power of ten."""
    if not step > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(step))
    return float(next(m for m in (1, 2, 5, 10) if m * power >= step * (1 - 1e-9)) * power)


def _numbers(key: str, title: str, edges: AnyArray, palette: str) -> Scale:
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    count = len(edges) - 1
    colours = [to_hex(colormaps[palette]((i + 0.5) / count)) for i in range(count)]
    labels = [f"{low:g} to {high:g}" for low, high in itertools.pairwise(edges)]
    labels[0], labels[-1] = f"below {edges[1]:g}", f"above {edges[-2]:g}"
    return Scale(
        key=key, title=title, colours=(*colours, OUT), labels=(*labels, "out of coverage"), edges=np.asarray(edges)
    )

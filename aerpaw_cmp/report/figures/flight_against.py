"""Figures of a prediction beside the flight that followed: levels with their intervals, reliability, sharpness."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ..content.against import Against, AgainstSeries
from ..kit.canvas import MEASURED, SIMULATED, FigureSpec, legend_below, subplots, time_axis
from ..names import safe_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Of the reliability plot.
SHARES = np.arange(0.1, 1.0, 0.1)


def against_specs(against: Against) -> Iterator[FigureSpec]:
    """Levels over time with their intervals, then reliability and sharpness."""
    for s in against.series:
        yield FigureSpec(
            f"against_{safe_name(s.name)}", "against",
            f"{s.name}: predicted before this flight",
            "Band: 90 % interval of one sample as it was predicted. Nothing of this flight was used.",
            partial(_over_time, s),
        )  # fmt: skip
    if not against.series:
        return
    yield FigureSpec(
        "against_reliability", "against", "Reliability and sharpness",
        "Left: share of samples inside intervals of a nominal share; on the diagonal intervals hold what they say. "
        "Right: standard deviations that were given; smaller is sharper.",
        partial(_reliability, against),
    )  # fmt: skip


def _over_time(s: AgainstSeries) -> Figure:
    fig, ax = subplots((9.2, 3.4))
    ax.fill_between(s.time_s, s.low_db, s.high_db, color=SIMULATED, alpha=0.22, linewidth=0, label="90 %")
    ax.plot(s.time_s, s.measured_db, ".", markersize=2, color=MEASURED, label="measured", rasterized=True)
    ax.plot(s.time_s, s.level_db, color=SIMULATED, linewidth=1.2, label="predicted")
    time_axis(ax, np.datetime64(0, "ns") if s.start is None else s.start)
    ax.set_ylabel("level [dB]")
    legend_below(ax, 3)
    return fig


def _reliability(against: Against) -> Figure:
    fig, (coverage, right) = subplots((9.2, 3.6), 1, 2)
    coverage.plot([0, 100], [0, 100], color="0.6", linewidth=1)
    for s in against.series:
        coverage.plot(100 * SHARES, [100 * s.coverage(share) for share in SHARES], "o-", markersize=3, label=s.name)
        right.hist(s.sd_db, bins=30, histtype="step", label=s.name)
    coverage.set(xlabel="nominal [%]", ylabel="observed [%]")
    coverage.legend(fontsize=8)
    right.set(xlabel="standard deviation of one sample [dB]", ylabel="samples")
    return fig

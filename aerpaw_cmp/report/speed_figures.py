"""Speed against error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .canvas import TOWER, figure, plain_ticks
from .data import SpeedRow
from .names import k_key

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# --- speed against error ------------------------------------------------------------------------


def rank_changes(speed: Sequence[SpeedRow]) -> bool:
    """Whether any setting gives any link another rank; with one antenna at each end none can."""
    return any(share > 0 for row in speed for share in row.rank_disagreement.values())


def pareto(speed: Sequence[SpeedRow]) -> Figure:
    """Seconds against the largest RSS error and against rank disagreement, with the front of the best."""
    ks = sorted({k for row in speed for k in row.rank_disagreement}) if rank_changes(speed) else []
    fig = figure((9.2, 4.6))
    axes = fig.subplots(1, 2 if ks else 1, squeeze=False)[0]
    pareto_axes(axes[0], speed, [row.rss_max_error_db for row in speed], "Largest RSS error [dB]")
    axes[0].set_yscale("symlog", linthresh=0.01)  # an error of exactly zero has its place
    plain_ticks(axes[0].yaxis)
    errors = [row.rss_max_error_db for row in speed if np.isfinite(row.rss_max_error_db)]
    axes[0].set_ylim(-0.0015, 3.0 * max([0.01, *errors]))
    if ks:
        values = [100 * row.rank_disagreement.get(ks[-1], float("nan")) for row in speed]
        pareto_axes(axes[1], speed, values, f"Links with another rank at K = {k_key(ks[-1])} [%]")
        top = 1.1 * max([1.0, *(value for value in values if np.isfinite(value))])
        axes[1].set_ylim(-0.05 * top, top)
    handles, labels = axes[0].get_legend_handles_labels()
    keys = pareto_keys(speed)
    fig.legend([*handles, *keys], [*labels, *(key.get_label() for key in keys)], loc="outside lower center", ncols=3)
    return fig


def pareto_keys(speed: Sequence[SpeedRow]) -> list[Any]:
    """Legend entries for what the size of a marker says, and for the ring around the reference."""
    from matplotlib.lines import Line2D

    sizes = {row.samples: row.samples_label for row in speed if row.samples is not None}
    keys = [
        Line2D([], [], marker="o", linestyle="none", markersize=marker_size(n), markerfacecolor="none",
               markeredgecolor="black", label=f"{sizes[n]} samples per source")
        for n in sorted(sizes)
    ]  # fmt: skip
    if any(row.reference for row in speed):
        keys.append(Line2D([], [], label="reference", **REFERENCE_RING))
    return keys


REFERENCE_RING: dict[str, Any] = {
    "marker": "o", "markersize": 14, "markerfacecolor": "none", "markeredgecolor": "black", "markeredgewidth": 1.0,
    "linestyle": "none",
}  # fmt: skip


def marker_size(samples: int | None) -> float:
    """Size of a marker [point], growing with the logarithm of the samples.

    Examples
    --------
    >>> marker_size(None), marker_size(1000), marker_size(1_000_000)
    (8.0, 5.0, 11.0)
    """
    return 8.0 if samples is None else float(np.clip(5.0 + 2.0 * (np.log10(max(samples, 1)) - 3.0), 3.0, 13.0))


def pareto_axes(ax: Axes, rows: Sequence[SpeedRow], error: Sequence[float], label: str) -> None:
    """One plane of seconds against error: a line per setting, markers that grow with the number of samples.

    Parameters
    ----------
    ax : Axes
    rows : sequence of SpeedRow
    error : sequence of float
        One per row; NaN is not drawn.
    label : str
        Of the error axis.
    """
    markers, colours = "osD^v<>P", ("#111111", "#56B4E9", "#D55E00", "#009E73", "#CC79A7", "#0072B2")
    families: dict[str, list[int]] = {}
    for index, row in enumerate(rows):
        families.setdefault(row.family, []).append(index)
    for number, (family, members) in enumerate(families.items()):
        look: dict[str, Any] = {"color": colours[number % len(colours)], "marker": markers[number % len(markers)]}
        members = sorted(members, key=lambda i: rows[i].samples or 0)
        ax.plot(
            [rows[i].seconds for i in members], [error[i] for i in members], linewidth=0.8, markersize=7,
            markeredgecolor="black", markevery=[], label=family, zorder=3, **look,
        )  # fmt: skip
        for i in members:  # a large marker below a small one, so that both are seen where they fall together
            ax.plot(
                rows[i].seconds, error[i], markersize=marker_size(rows[i].samples), markeredgecolor="black",
                markeredgewidth=0.7, alpha=0.85, zorder=4.0 - 0.05 * marker_size(rows[i].samples), **look,
            )  # fmt: skip
            if rows[i].reference:
                ax.plot(rows[i].seconds, error[i], zorder=4.5, **REFERENCE_RING)
    front = pareto_front([row.seconds for row in rows], error)
    if len(front) > 1:
        ax.plot(
            [rows[i].seconds for i in front], [error[i] for i in front], color=TOWER, linestyle=(0, (3, 2)),
            linewidth=1.6, label="not beaten in both", zorder=2,
        )  # fmt: skip
    ax.set_xscale("log")
    plain_ticks(ax.xaxis)
    ax.margins(x=0.08)
    ax.set_xlabel("Time for the same links [s]")
    ax.set_ylabel(label)


def pareto_front(seconds: Sequence[float], error: Sequence[float]) -> list[int]:
    """Indices of rows that no other row beats in both, by rising seconds.

    Examples
    --------
    >>> pareto_front([1.0, 2.0, 3.0], [5.0, 6.0, 1.0])
    [0, 2]
    """
    best, front = float("inf"), []
    for index in sorted(range(len(seconds)), key=lambda i: (seconds[i], error[i])):
        if np.isfinite(error[index]) and error[index] < best:
            best = error[index]
            front.append(index)
    return front

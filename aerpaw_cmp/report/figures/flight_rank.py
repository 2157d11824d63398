"""Figures of the rank: maps, histograms, time, confusion, agreement."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...common.units import FloatArray
from ...compare.rank import RankFit
from ...compare.result import RankResult
from ...site.site import Site
from ..content.flight import RANKS, ReportData, start_of
from ..kit.canvas import (
    RANK_MARKER,
    SIMULATED,
    TOWER,
    WAYPOINT,
    colour_bar,
    dots,
    draw_out_of_coverage,
    draw_site,
    draw_waypoints,
    frame_around,
    legend_below,
    legend_of,
    plain_ticks,
    plan_shape,
    rank_colour,
    seconds_since,
    subplots,
    time_axis,
)
from ..names import k_key
from ..words.flight import count

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# --- rank ---------------------------------------------------------------------------------------


def _rank_map(ax: Axes, site: Site, east: FloatArray, north: FloatArray, rank: FloatArray, title: str) -> None:
    """Ranks at their positions: colour and marker differ; 0 is Z, NaN is left out.

    Parameters
    ----------
    ax : Axes
    site : Site
    east, north : (n,)
        Positions [m].
    rank : (n,)
        0 to 4; NaN unknown.
    title : str
    """
    draw_site(ax, site)
    for value in (0, *RANKS):
        at = rank == value
        number = int(at.sum())
        if not number:
            continue
        style: dict[str, Any] = {"color": "black", "linewidths": 0.8}
        if value:
            style = {"facecolor": rank_colour(value), "edgecolors": "#222222", "linewidths": 0.25}
        ax.scatter(
            east[at], north[at], s=14, marker=RANK_MARKER[value], rasterized=True, **style,
            label=f"{'Z: no path' if value == 0 else f'rank {value}'} ({count(number)})",
            zorder=3.0 + 1.0 / number,  # the rarer a rank, the higher it lies: a few points must not vanish under many
        )  # fmt: skip
    ax.set_title(title)
    handles, labels = legend_of(ax, lambda label: label.startswith(("rank", "Z")))
    if handles:
        ax.legend(
            handles, labels, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, markerscale=1.6,
            columnspacing=1.0,
        )  # fmt: skip


def rank_maps(data: ReportData, panel: RankResult) -> Figure:
    """Measured rank and the rank of every K along the flight."""
    maps = [("Measured (reported RI)", panel.measured)]
    maps += [(f"Ray tracing, K = {k_key(k)}", rank.astype(float)) for k, rank in panel.rank.items()]
    columns = 2 if len(maps) > 1 else 1
    rows = -(-len(maps) // columns)
    east, north, _ = panel.position_m.T
    shape = plan_shape(east, north)
    fig, axes = subplots((9.2, rows * (3.9 / shape + 1.1)), rows, columns, squeeze=False)
    for ax, (title, rank) in zip(axes.ravel(), maps, strict=False):
        _rank_map(ax, data.site, east, north, rank, title)
        frame_around(ax, east, north, shape=shape)
    for ax in axes.ravel()[len(maps) :]:
        ax.set_visible(False)
    return fig


def rank_histograms(panel: RankResult) -> Figure:
    """Shares of rank 1 to 4, measured beside every K, with intervals where known."""
    fig, ax = subplots((9.2, 3.4))
    reported = int(np.isfinite(panel.measured).sum())
    score = panel.score
    series = [(f"measured ({count(reported)} samples)", score.histogram, score.histogram_ci95)]
    series += [(_at_label(k, fit), fit.histogram, fit.histogram_ci95) for k, fit in score.simulated.items()]
    width = 0.8 / len(series)
    from matplotlib import colormaps

    for number, (label, shares, intervals) in enumerate(series):
        at = np.array(RANKS) + (number - (len(series) - 1) / 2) * width
        shade = SIMULATED if number == 0 else colormaps["cividis"](0.25 + 0.75 * number / max(len(series) - 1, 1))
        share = np.nan_to_num(shares)
        ax.bar(
            at, 100 * share, width * 0.92, color=shade, edgecolor="black", linewidth=0.6, label=label,
            hatch=("", "///", "xxx", "...", "---", "\\\\\\")[number % 6],
        )  # fmt: skip
        low, high = np.array(intervals, dtype=np.float64).T
        spread = 100 * np.stack([share - low, high - share]).clip(min=0)
        if np.isfinite(spread).any():
            ax.errorbar(at, 100 * share, spread, fmt="none", ecolor="#D55E00", elinewidth=1.3, capsize=2.5)
    ax.set_xticks(RANKS, [f"{r}" for r in RANKS])
    ax.set(xlabel="Channel rank", ylabel="Share of the samples in coverage [%]")
    ax.grid(axis="x", visible=False)
    legend_below(ax)
    return fig


def _at_label(k: float, fit: RankFit) -> str:
    """Legend entry of one K."""
    distance = "" if not np.isfinite(fit.total_variation) else f" (total variation {fit.total_variation:.2f})"
    return f"K = {k_key(k)}{distance}"


def rank_over_time(data: ReportData, panel: RankResult) -> Figure:
    """Measured rank and the rank of every K over time, one row each; SINR and singular values under them."""
    start = start_of(data)
    seconds = seconds_since(panel.time, start)
    rows = 1 + len(panel.rank)
    below = [1.3] * (panel.sinr_db is not None) + [2.2]
    ratios = [1.0] * rows + below
    fig, axes = subplots((9.2, 1.1 * sum(ratios) + 0.5), len(ratios), 1, sharex=True, height_ratios=ratios)
    draw_measured_rank(axes[0], seconds, panel)
    for ax, (k, rank) in zip(axes[1:], panel.rank.items(), strict=False):
        ax.plot(
            seconds, np.where(rank == 0, np.nan, rank), linestyle="none", marker="|", markersize=7, rasterized=True,
            color=SIMULATED, label=f"K = {k_key(k)}",
        )  # fmt: skip
        draw_out_of_coverage(ax, seconds, rank == 0, "Z: no path")
    for number, ax in enumerate(axes[:rows]):
        draw_waypoints(ax, data.moments, start, names=number == 0)
        ax.set_yticks(RANKS)
        ax.set(ylim=(0.5, 4.5), ylabel="Rank")
        ax.legend(*legend_of(ax, lambda label: label != "waypoint"), loc="center left", bbox_to_anchor=(1.0, 0.5))
    if panel.sinr_db is not None:
        dots(axes[rows], seconds, panel.sinr_db, color="#0072B2", label="SINR")
        axes[rows].set_ylabel("SINR [dB]")
        axes[rows].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), markerscale=4)
    draw_singular_values(axes[-1], seconds, panel)
    time_axis(axes[-1], start)
    return fig


def draw_measured_rank(ax: Axes, seconds: FloatArray, panel: RankResult) -> None:
    """Reported ranks as ticks; those held over from an earlier report are smaller and grey."""
    held_over = ~panel.score.staleness.fresh
    for mask, label, colour, size in (
        (~held_over, "measured", "#0072B2", 7),
        (held_over, "measured, held over", "#9A9A9A", 4),
    ):
        if mask.any():
            ax.plot(
                seconds[mask], panel.measured[mask], linestyle="none", marker="|", markersize=size, color=colour,
                rasterized=True, label=label,
            )  # fmt: skip


def draw_singular_values(ax: Axes, seconds: FloatArray, panel: RankResult) -> None:
    """Singular values relative to the largest, with every threshold K."""
    values = panel.singular_ratio_db
    for column, colour in enumerate(("#111111", "#0072B2", "#9AD0F0")[: values.shape[1]]):
        dots(ax, seconds, values[:, column], color=colour, label=f"σ{chr(0x2082 + column)}/σ₁")
    for number, k in enumerate(panel.rank):
        level = -20 * np.log10(k)
        ax.axhline(
            level, color=TOWER, linewidth=0.9, linestyle=(0, (5, 2)), label="thresholds 1/K" if not number else None
        )
        ax.annotate(
            f"K = {k_key(k)}",
            (0.004, level),
            xycoords=ax.get_yaxis_transform(),
            fontsize=7,
            va="bottom",
            color=TOWER,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.6},
            zorder=6,
        )
    lowest = [-20 * np.log10(k) for k in panel.rank] + values[np.isfinite(values)].tolist()
    ax.set_ylim(max(min(lowest, default=-20.0) - 6.0, -110.0), 2.0)  # below -110 dB lies nothing but rounding
    ax.set_ylabel("Singular value\nover largest [dB]")
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), markerscale=4)


def draw_counts(ax: Axes, counts: FloatArray) -> Any:
    """A matrix of counts (rows, columns), coloured by each one's share of its row [%]; a row without any stays white.

    Parameters
    ----------
    ax : Axes
    counts : (rows, columns)

    Returns
    -------
    matplotlib.image.AxesImage
        For a colour bar.
    """
    total = counts.sum(axis=1, keepdims=True)
    share = 100 * np.divide(counts, total, out=np.full(counts.shape, np.nan), where=total > 0)
    for (row, column), number in np.ndenumerate(counts):
        colour = "white" if share[row, column] < 55 else "black"
        ax.text(column, row, count(int(number)), ha="center", va="center", fontsize=8, color=colour)
    ax.grid(visible=False)
    return ax.imshow(share, cmap="cividis", vmin=0, vmax=100, aspect="auto")


def confusion(panel: RankResult) -> Figure:
    """Measured rank against simulated rank for every K, as counts and shares of the measured rank."""
    fits = panel.score.simulated
    fig, (axes,) = subplots((9.2, 3.3), 1, len(fits), sharey=True, squeeze=False)
    image = None
    for ax, (k, fit) in zip(axes, fits.items(), strict=True):
        table = np.asarray(fit.confusion[1:], dtype=float)  # no report is no row
        image = draw_counts(ax, table)
        ax.plot(RANKS, range(len(RANKS)), "s", markersize=25, markerfacecolor="none", markeredgecolor=TOWER,
                markeredgewidth=1.2, clip_on=False, label="equal")  # fmt: skip
        ax.set_xticks(range(5), ["Z", "1", "2", "3", "4"])
        ax.set_yticks(range(4), [f"{r}" for r in RANKS])
        ax.set_xlabel("Simulated rank")
        samples = count(int(table.sum()))
        equal = f": equal in {100 * fit.agreement:.0f} % of {samples}" if np.isfinite(fit.agreement) else ""
        ax.set_title(f"K = {k_key(k)}{equal}")
    axes[0].set_ylabel("Measured rank")
    if image is not None:
        colour_bar(fig, image, list(axes), "Share of the measured rank [%]")
    return fig


def agreement_curve(panel: RankResult) -> Figure:
    """Agreement and total variation against continuous K."""
    curve, best = panel.score.curve, panel.score.best_k
    fig, ax = subplots((9.2, 3.4))
    ax.semilogx(curve.k, curve.agreement, color=SIMULATED, linewidth=1.3, label="agreement by pose (higher is better)")
    ax.semilogx(
        curve.k, curve.total_variation, color="#D55E00", linestyle=(0, (5, 2)), linewidth=1.3,
        label="total variation of the histograms (lower is better)",
    )  # fmt: skip
    if np.isfinite(curve.best_k_interval).all():
        ax.axvspan(*curve.best_k_interval, color="#DDDDDD", hatch="///", alpha=0.6, label="95 % interval of the best K")
    if np.isfinite(best):
        ax.axvline(best, color=TOWER, linewidth=1.2, label=f"best K = {best:.3g}")
    for number, k in enumerate(panel.rank):
        ax.axvline(k, color=WAYPOINT, linestyle=":", linewidth=0.9, label="K of the report" if number == 0 else None)
    ax.set_ylim(0.0, 1.02)
    plain_ticks(ax.xaxis)
    ax.set(xlabel="K (ratio of singular values)", ylabel="Agreement, total variation")
    fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return fig

"""Figures of a report, in order, with their captions; those of serving cells and of a prediction beside the flight."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ...common.units import AnyArray
from ...compare.result import RankResult, RssResult
from ...compare.serving import ServingComparison
from ..against import Against, AgainstSeries
from ..canvas import (
    MEASURED,
    POINTS_PER_CLOUD,
    SIMULATED,
    TOWER,
    FigureSpec,
    colour_bar,
    legend_below,
    subplots,
    time_axis,
)
from ..data import ReportData, Track
from ..names import safe_name
from ..words import count, learned_on
from . import rank as rank_figures
from . import rss as rss_figures
from .rank import draw_counts

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def figure_specs(data: ReportData) -> list[FigureSpec]:
    """Every figure that the data allow, in reading order; where two names became one file name, a number is added."""
    used: dict[str, int] = {}
    result = []
    for spec in _figures(data):
        times = used[spec.name] = used.get(spec.name, 0) + 1
        result.append(spec if times == 1 else replace(spec, name=f"{spec.name}_{times}"))
    return result


def _figures(data: ReportData) -> Iterator[FigureSpec]:
    scored = [panel for panel in data.rss if len(panel.time) and panel.score.n]
    if scored:
        yield FigureSpec(
            "overview", "overview", "Where and when the prediction fails",
            f"{scored[0].name}. Left: the flight coloured by the residual, measured minus ray tracing after the "
            "offset. Right: level over time.",
            partial(rss_figures.overview, data, scored[0]),
        )  # fmt: skip
    if data.track is not None and len(data.track.time):
        yield from _track_specs(data, data.track)
    for panel in data.rss:
        if len(panel.time):
            yield from _rss_specs(data, panel)
    if any(np.isfinite(row.rmse_heldout_db) for row in data.ladder):
        yield FigureSpec(
            "ladder", "ladder", "Models from the simplest to the richest",
            "RMSE on held-out segments, a line per tower and channel. Whiskers: 95 % interval of the difference to the "
            "best model on the same samples. Filled: the recommended model.",
            partial(rss_figures.ladder, data.ladder),
        )  # fmt: skip
    if data.serving is not None and data.serving.n:
        yield serving_spec(data.serving)
    for rank in data.rank:
        if len(rank.time):
            yield from _rank_specs(data, rank)
    if data.against is not None:
        yield from against_specs(data.against)


def _track_specs(data: ReportData, track: Track) -> Iterator[FigureSpec]:
    present = [word for word, some in (("buildings", data.site.buildings), ("forests", data.site.forests)) if some]
    invented = (
        f" {' and '.join(present).capitalize()} are illustrative: they do not exist and show the method."
        if data.site.illustrative and present
        else ""
    )
    yield FigureSpec(
        "trajectory", "flight", "Where the UAV flew",
        f"Left: the site with its towers. Right: the flight, coloured by height.{invented}",
        partial(rss_figures.trajectory, data, track),
    )  # fmt: skip
    dotted = " Dotted lines are waypoints." if data.waypoints else ""
    yield FigureSpec(
        "altitude", "flight", "Height over time",
        f"Height of the UAV above the ground at the site origin.{dotted}",
        partial(rss_figures.altitude, data, track),
    )  # fmt: skip


def _band_words(panel: RssResult) -> str:
    """Sentences on what the band of learned antennas is made of, and whether it holds on this flight."""
    bars = panel.further.error_bars
    if not bars:
        return ""
    parts = ", ".join(f"{what} {bars[name]:.1f} dB" for name, what in SPREAD_PARTS.items())
    inside = bars.get("inside_90")
    return f" Band: 90 % interval of a sample about the prediction; its standard deviation joins {parts}." + (
        "" if inside is None else f" It holds {100 * inside:.0f} % of the samples of this flight."
    )


SPREAD_PARTS = {
    "gain_sd_db": "the learned gain",
    "own_sd_db": "the flight's own nuisance",
    "noise_sd_db": "noise",
    "fading_sd_db": "fading within the average",
}


_HATCHED = "Hatched spans marked Z have no path in the simulation and are not scored. "


def _rss_specs(data: ReportData, panel: RssResult) -> Iterator[FigureSpec]:
    stem = f"{safe_name(panel.tower)}_{safe_name(panel.channel)}"
    section = f"rss/{panel.tower}/{panel.channel}"
    drawn = f" Of {count(len(panel.time))} samples {count(POINTS_PER_CLOUD)} are drawn, and every extreme."
    yield FigureSpec(
        f"rss_{stem}", section, f"{panel.name}: RSS over time",
        "Top: the measurement after its offset, the ray tracing, and the baselines, each baseline moved to its own "
        "best fit. " + _HATCHED * bool(panel.simulated_out_of_coverage.any())
        + "Bottom: residual; dashed lines are plus and minus one RMSE." + _band_words(panel)
        + drawn * (len(panel.time) > POINTS_PER_CLOUD),
        partial(rss_figures.rss_over_time, data, panel),
    )  # fmt: skip
    score = panel.further.detection
    if score is not None and score.reliability:
        yield FigureSpec(
            f"rss_detection_{stem}", section, f"{panel.name}: is the probability of detection calibrated?",
            "Fifths of the predicted probability against the share that the receiver detected; on the diagonal the "
            f"forecast is calibrated. Brier score {score.brier:.3f}, constant forecast {score.constant_brier:.3f}; log "
            f"score {score.log_score:.3f}, constant {score.constant_log_score:.3f} ({learned_on(score)}).",
            partial(rss_figures.detection_reliability, score),
        )  # fmt: skip


def _rank_specs(data: ReportData, panel: RankResult) -> Iterator[FigureSpec]:
    stem, section = safe_name(panel.tower), f"rank/{panel.tower}"
    if panel.probability is not None:
        # it stands under the table of the result
        yield FigureSpec(
            f"rank_forecast_{stem}", "forecast", f"{panel.tower}: rank forecast along the flight",
            "Probability of each rank by the fitted receiver (means), above the reported ranks.",
            partial(rank_figures.rank_forecast, data, panel),
        )  # fmt: skip
    yield FigureSpec(
        f"rank_histogram_{stem}", section, f"{panel.tower}: how often each rank",
        "Shares of rank 1 to 4 among samples in coverage, measured beside every K. Whiskers: 95 % intervals.",
        partial(rank_figures.rank_histograms, panel),
    )  # fmt: skip
    yield FigureSpec(
        f"rank_map_{stem}", section, f"{panel.tower}: rank along the flight",
        "Rank at every sample. Colour and marker give the rank; crosses marked Z had no path in the simulation.",
        partial(rank_figures.rank_maps, data, panel),
        page=False,
    )  # fmt: skip
    yield FigureSpec(
        f"rank_time_{stem}", section, f"{panel.tower}: rank over time",
        "Each row is one source. The lowest plot shows the singular values that decide the rank.",
        partial(rank_figures.rank_over_time, data, panel),
    )  # fmt: skip
    if panel.score.simulated:
        yield FigureSpec(
            f"rank_confusion_{stem}", section, f"{panel.tower}: which ranks are mistaken for which",
            "Counts; colour is the share of each measured rank (rows). Frames: equal ranks. Z: no path in the "
            "simulation.",
            partial(rank_figures.confusion, panel),
            page=False,
        )  # fmt: skip
    if np.isfinite(panel.score.curve.agreement).any():
        yield FigureSpec(
            f"rank_k_{stem}", section, f"{panel.tower}: which K explains the modem",
            "Agreement by pose and distance between the histograms as the threshold K varies. The best K is the one of "
            "the highest agreement.",
            partial(rank_figures.agreement_curve, panel),
            page=False,
        )  # fmt: skip


# --- serving cells ---------------------------------------------------------------------------------------------------

# Cells with a row of their own; the others stand together.
MOST_CELLS = 16

OTHER, NONE = "others", "no path"


def shown_confusion(serving: ServingComparison, most: int = MOST_CELLS) -> tuple[list[str], AnyArray]:
    """Names and counts (cells, cells + 1) of a matrix that can be read; the last column: no cell predicted.

    Cells that neither served nor were predicted are left out. Of more than ``most``, those of fewest samples are added
    up as "others"; that row and column meet in hits and misses alike, so their cell has no frame.
    """
    counts = np.asarray(serving.confusion)
    weight = counts.sum(axis=1) + counts[:, :-1].sum(axis=0)
    order = [int(i) for i in np.argsort(-weight, kind="stable") if weight[i] > 0]
    first, few = sorted(order[:most]), sorted(order[most:])
    names = [serving.cells[i] for i in first]
    columns = np.column_stack([counts[:, first], counts[:, few].sum(axis=1)] if few else [counts[:, first]])
    columns = np.column_stack([columns, counts[:, -1]])
    table = columns[first]
    if few:
        table, names = np.vstack([table, columns[few].sum(axis=0)]), [*names, OTHER]
    return names, table


def confusion(serving: ServingComparison) -> Any:
    """Cell that served against cell predicted strongest: counts, coloured by their share of the row."""
    names, table = shown_confusion(serving)
    longest = max((len(name) for name in names), default=0)
    fig, ax = subplots((min(9.2, 3.6 + 0.62 * len(names) + 0.05 * longest), 1.9 + 0.42 * len(names)))
    image = draw_counts(ax, table.astype(np.float64))
    for row, name in enumerate(names):
        if name != OTHER:
            ax.add_patch(_frame(row))
    ax.set_xticks(range(len(names) + 1), [*names, NONE], rotation=45 if len(names) > 4 else 0,
                  ha="right" if len(names) > 4 else "center", fontsize=8)  # fmt: skip
    ax.set_yticks(range(len(names)), names, fontsize=8)
    ax.set(xlabel="Cell predicted strongest", ylabel="Cell that served")
    colour_bar(fig, image, [ax], "Share of the cell that served [%]")
    return fig


def _frame(place: int) -> Any:
    """The frame of a hit."""
    from matplotlib.patches import Rectangle

    return Rectangle((place - 0.47, place - 0.46), 0.94, 0.92, fill=False, edgecolor=TOWER, linewidth=1.4)


def serving_spec(serving: ServingComparison) -> FigureSpec:
    """The matrix with its words."""
    return FigureSpec(
        "serving_confusion",
        "serving",
        "Which cell serves",
        f"Counts of {count(serving.n)} samples; colour is the share of each cell that served (rows). Framed: "
        f"the cell predicted strongest served, {100 * serving.hit_share:.0f} % of all; always naming the cell that "
        f"served most hits {100 * serving.majority_share:.0f} %. Levels are as simulated, without offsets.",
        lambda: confusion(serving),
    )


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

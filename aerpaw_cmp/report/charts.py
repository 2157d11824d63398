"""Charts that the script of a page draws, and the confusion matrix of serving cells.

A chart has marks (:func:`~aerpaw_cmp.report.canvas.mark`) over two axes. Dots may have whiskers from ``low`` to
``high``. ``rows`` are names that replace the numbers on the ordinate. :func:`chart_figure` draws the same marks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.kml import CLASS_COLOURS
from ..common.units import AnyArray
from ..compare.ladder import ModelRow
from ..compare.level import DetectionScore, ServingComparison
from ..compare.result import RankResult
from .canvas import draw_marks, mark, seconds_since, subplots
from .flight_data import RANKS, ReportData, start_of
from .flight_words import learned_on

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Number of means along the flight, about one per pixel.
_FORECAST_COLUMNS = 600


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """A chart of a page: its section, its text, and the content that the script draws."""

    section: str
    title: str
    caption: str
    content: Mapping[str, Any]


def chart_figure(panels: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw charts of one kind, by their titles, in one figure with at most three per row."""
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    fig, axes = subplots((9.2, 0.6 + 3.2 * rows), rows, columns, squeeze=False)
    for ax in axes.flat[len(panels) :]:
        ax.set_visible(False)
    for ax, (title, content) in zip(axes.flat, panels.items(), strict=False):
        draw_marks(ax, content["marks"])
        ax.set(title=title, xlabel=content["x"]["label"], ylabel=content["y"]["label"])
        ax.set_ylim(*content["y"].get("ends", ax.get_ylim()))
    curves = [ax.get_legend_handles_labels() for ax in axes.flat[: len(panels)]]
    if all(names == curves[0][1] for _, names in curves):
        fig.legend(*curves[0], loc="outside lower center", ncols=6)
    else:
        for ax in axes.flat[: len(panels)]:
            ax.legend(loc="best", fontsize=7.5)
    return fig


def charts_of(data: ReportData) -> list[Chart]:
    """Return all charts that the data allow, in the order of the page."""
    charts = []
    for panel in data.rss:
        score = panel.further.detection
        if score is not None and score.reliability:
            charts.append(Chart(
                section=f"rss/{panel.tower}/{panel.channel}",
                title=f"{panel.name}: is the predicted probability of detection correct?",
                caption="Share that the receiver detected, per fifth of the predicted probability. On the line, "
                f"the forecast is calibrated. Brier score {score.brier:.3f}, this flight's own share "
                f"{score.constant_brier:.3f}; log score {score.log_score:.3f}, own share "
                f"{score.constant_log_score:.3f} ({learned_on(score)}).",
                content=_detection(score),
            ))  # fmt: skip
    scored = [row for row in data.models if np.isfinite(row.rmse_heldout_db)]
    if scored:
        shown = [row for row in data.models if row.distinct]
        charts.append(Chart(
            section="ladder", title="Models from the simplest to the most complex",
            caption="RMSE on held-out areas, over all channels. Whiskers: 95 % interval of the difference from the "
            "best model on the same samples.",
            content=_errors(shown),
        ))  # fmt: skip
    charts += [
        Chart(
            section="forecast", title=f"{rank.tower}: rank forecast along the flight",
            caption="Probability of each rank by the fitted receiver (means).", content=_forecast(data, rank),
        )
        for rank in data.rank if rank.probability is not None
    ]  # fmt: skip
    return charts


def _errors(models: Sequence[ModelRow]) -> dict[str, Any]:
    """Return a chart with one row per model: its RMSE on held-out areas."""
    of = [(i, row) for i, row in enumerate(models) if np.isfinite(row.rmse_heldout_db)]
    rmse, apart = (
        np.array([getattr(row, key) for _, row in of]) for key in ("rmse_heldout_db", "difference_to_best_db")
    )
    low, high = np.array([row.difference_to_best_ci95_db for _, row in of]).T + rmse - apart
    dots = mark("dots", "RMSE, all channels", rmse, np.array([float(i) for i, _ in of]), low=low, high=high)
    names = [f"{number}  {row.model}" for number, row in enumerate(models, 1)]
    chosen = next((i for i, row in of if row.recommended), -1)
    return {"rows": names, "chosen": chosen, "x": {"label": "RMSE on held-out areas [dB]"}, "marks": [dots]}


def _detection(score: DetectionScore) -> dict[str, Any]:
    """Return a chart of the share of detected samples against the predicted probability."""
    said, seen, _ = 100.0 * np.array(score.reliability, dtype=np.float64).T
    ends = np.array([0.0, 100.0])
    return {
        "x": {"label": "Predicted probability of detection [%]", "ends": [0, 100]},
        "y": {"label": "Detected samples [%]", "ends": [0, 100]},
        "marks": [mark("dots", "fifths of the samples", said, seen), mark("line", "calibrated", ends, ends)],
    }


def _forecast(data: ReportData, panel: RankResult) -> dict[str, Any]:
    """Return a chart of the probability of each rank along the flight, as stacked bands."""
    assert panel.probability is not None
    start = start_of(data)
    seconds = seconds_since(panel.time, start)
    known = np.isfinite(panel.probability).all(axis=1)
    order = np.flatnonzero(known)[np.argsort(seconds[known], kind="stable")]
    parts = [part for part in np.array_split(order, min(_FORECAST_COLUMNS, max(len(order), 1))) if len(part)]
    at = np.array([seconds[part].mean() for part in parts])
    means = np.array([panel.probability[part].mean(axis=0) for part in parts]).reshape(-1, len(RANKS))
    edges = 100.0 * np.column_stack([np.zeros(len(at)), means.cumsum(axis=1)])
    return {
        "x": {"label": "", "start": str(start.astype("datetime64[ms]"))},
        "y": {"label": "Probability [%]", "ends": [0, 100]},
        "marks": [
            mark("band", f"rank {rank}", at, low=edges[:, i], high=edges[:, i + 1], colour=CLASS_COLOURS[rank])
            for i, rank in enumerate(RANKS)
        ],
    }


# Largest number of cells in the table of serving cells.
MOST_CELLS = 16


def shown_confusion(serving: ServingComparison) -> tuple[list[str], AnyArray]:
    """Return the names of cells and a readable confusion matrix (cells, cells + 1), whose last column is "no path".

    Only the :data:`MOST_CELLS` cells with the most samples are included, and no cell that neither served nor was
    predicted.
    """
    counts = np.asarray(serving.confusion)
    weight = counts.sum(axis=1) + counts[:, :-1].sum(axis=0)
    most = np.sort(np.argsort(-weight, kind="stable")[: min(MOST_CELLS, np.count_nonzero(weight))])
    return [serving.cells[i] for i in most], counts[np.ix_(most, np.append(most, -1))]

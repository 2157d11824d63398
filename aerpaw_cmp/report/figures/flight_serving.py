"""Figure of the serving cells: which cell served, and which one the replay predicts strongest."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...common.units import AnyArray
from ...compare.level.serving import ServingComparison
from ..kit.canvas import TOWER, FigureSpec, colour_bar, subplots
from ..words.flight import count
from .flight_rank import draw_counts

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

"""The matrix of serving cells as a figure: its cells, its words, and that it reaches the page."""

import dataclasses

import numpy as np
import pytest

from aerpaw_cmp.compare.level.serving import compare_serving
from aerpaw_cmp.report.figures import flight as figures
from aerpaw_cmp.report.figures.flight_serving import confusion, serving_spec, shown_confusion
from aerpaw_cmp.report.kit import canvas
from aerpaw_cmp.report.pages import flight as html


@pytest.fixture
def serving():
    """Three cells of which the third never serves; the prediction takes it for the second at times."""
    level = [[-70, -80, -99], [-70, -80, -99], [-90, -75, -99], [-90, -85, -80], [np.nan] * 3]
    return compare_serving([0, 1, 1, 1, 0], level, ["LW1 PCI 1", "LW2 PCI 2", "LW3 PCI 3"])


def test_counts_stand_in_the_row_that_served_and_the_column_predicted(serving):
    with canvas.style():
        fig = confusion(serving)
    ax = fig.axes[0]
    texts = {(round(t.get_position()[1]), round(t.get_position()[0])): t.get_text() for t in ax.texts}
    assert texts[0, 0] == "1"  # LW1 served, LW1 predicted
    assert texts[0, 3] == "1"  # LW1 served, nothing predicted
    assert (texts[1, 0], texts[1, 1], texts[1, 2]) == ("1", "1", "1")
    assert [t.get_text() for t in ax.get_yticklabels()] == ["LW1 PCI 1", "LW2 PCI 2", "LW3 PCI 3"]
    assert ax.get_xlabel() == "Cell predicted strongest"
    assert ax.get_ylabel() == "Cell that served"
    assert len(ax.patches) == 3


def test_words_are_those_of_the_numbers(serving):
    spec = serving_spec(serving)
    assert "5 samples" in spec.caption
    assert "40 % of all" in spec.caption  # 2 of 5
    assert "most hits 60 %" in spec.caption  # LW2 served 3 of 5


def test_many_cells_are_gathered_without_losing_a_sample():
    rng = np.random.default_rng(0)
    n, cells = 4000, 60
    served = np.minimum(rng.geometric(0.1, n) - 1, cells - 1)
    comparison = compare_serving(served, rng.normal(-80, 5, (n, cells)), [f"c{i}" for i in range(cells)])
    names, table = shown_confusion(comparison)
    assert len(names) == 17
    assert names[-1] == "others"
    assert table.shape == (17, 18)
    assert table.sum() == n
    named = [int(name[1:]) for name in names[:-1]]
    assert np.trace(table[:16, :16]) == sum(comparison.confusion[i, i] for i in named)
    with canvas.style():
        assert len(confusion(comparison).axes[0].patches) == 16  # "others" has no frame


def test_it_stands_in_the_report(report_data, serving):
    data = dataclasses.replace(report_data, serving=serving)
    specs = [p for p in figures.figure_specs(data) if p.section == "serving"]
    assert [p.name for p in specs] == ["serving_confusion"]
    pictures = [canvas.render(p, ("png",)) for p in specs]
    page = html.page(data, pictures, [])
    assert 'id="figure-serving_confusion"' in page
    assert "The prediction is no better than that." in page
    assert 'id="serving"' not in html.page(report_data, [], [])

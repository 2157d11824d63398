"""Charts of the page's script show the given numbers. The table of serving cells."""

import dataclasses
import re

import numpy as np
import pytest

from aerpaw_cmp.compare.ladder import ModelRow
from aerpaw_cmp.compare.level import DetectionScore, compare_serving
from aerpaw_cmp.report import flight as html
from aerpaw_cmp.report.charts import charts_of, shown_confusion
from aerpaw_cmp.report.flight import models_card
from benchmarks.fabricated import with_numbers


@pytest.fixture
def serving():
    """Return three cells, of which the third never serves. The prediction sometimes confuses it with the second."""
    level = [[-70, -80, -99], [-70, -80, -99], [-90, -75, -99], [-90, -85, -80], [np.nan] * 3]
    return compare_serving([0, 1, 1, 1, 0], level, ["LW1 PCI 1", "LW2 PCI 2", "LW3 PCI 3"])


def test_counts_stand_in_the_row_that_served_and_the_column_predicted(report_data, serving):
    names, table = shown_confusion(serving)
    assert names == ["LW1 PCI 1", "LW2 PCI 2", "LW3 PCI 3"]
    assert table.tolist() == [[1, 0, 0, 1], [1, 1, 1, 0], [0, 0, 0, 0]]  # the last column: nothing predicted
    page = html.page(dataclasses.replace(report_data, serving=serving), [])
    first = page[page.index(f'<tr><th scope="row">{names[1]}</th>', page.index('id="serving"')) :]
    cells = re.findall(r'<td class="n">(\d+)</td>', first[: first.index("</tr>")])
    assert list(map(int, cells)) == table[1].tolist()
    assert "The prediction is no better than that." in page
    assert 'id="serving"' not in html.page(report_data, [])


def test_the_cells_with_the_most_samples_are_shown():
    rng = np.random.default_rng(0)
    n, cells = 4000, 60
    served = np.minimum(rng.geometric(0.1, n) - 1, cells - 1)
    comparison = compare_serving(served, rng.normal(-80, 5, (n, cells)), [f"c{i}" for i in range(cells)])
    names, table = shown_confusion(comparison)
    assert len(names) == 16
    assert table.shape == (16, 17)
    shown = [int(name[1:]) for name in names]
    assert shown == sorted(shown)
    np.testing.assert_array_equal(table[:, :-1], comparison.confusion[np.ix_(shown, shown)])
    np.testing.assert_array_equal(table[:, -1], comparison.confusion[shown, -1])
    assert set(range(5)) <= set(shown), "the cells that serve most"


def test_models_have_a_dot_for_each_score_and_whiskers_of_the_difference(report_data):
    models = [
        ModelRow(model=model, rmse_heldout_db=rmse, difference_to_best_db=rmse - 3.0, n=100, seconds=seconds,
                 difference_to_best_ci95_db=(rmse - 3.5, rmse - 2.75), recommended=model == "rich",
                 fastest_sufficient=model == "rich", distinct=True)
        for model, rmse, seconds in (("free space", 5.0, 0.1), ("opaque", np.nan, 0.5), ("rich", 3.0, 2.0))
    ]  # fmt: skip
    ladder = [dataclasses.replace(row, tower="LW1", channel="A") for row in models]
    data = dataclasses.replace(report_data, models=tuple(models), ladder=tuple(ladder))
    (chart,) = charts_of(data)
    (mark,) = chart.content["marks"]
    assert (chart.content["rows"], chart.content["chosen"]) == (["1  free space", "2  opaque", "3  rich"], 2)
    np.testing.assert_allclose(mark["x"], [5.0, 3.0])  # a model without a score has no dot
    np.testing.assert_allclose(mark["low"] - mark["x"], -0.5)
    np.testing.assert_allclose(mark["high"] - mark["x"], 0.25)
    np.testing.assert_array_equal(mark["y"], [0, 2])
    card = models_card(data)
    assert [row[0] for row in card.tables[0].rows] == ["1", "2", "3"]
    assert len(card.parts[0].tables[0].rows) == 1  # one channel


def test_the_bands_of_a_forecast_are_its_probabilities_one_upon_the_other(report_data):
    panel = report_data.rank[0]
    certain = np.arange(len(panel.time)) < len(panel.time) // 2
    said = np.where(certain[:, None], [0.0, 1.0, 0.0, 0.0], [0.1, 0.2, 0.3, 0.4])
    data = dataclasses.replace(report_data, rank=(dataclasses.replace(panel, probability=said),))
    (chart,) = charts_of(data)
    heights = [(mark["high"] - mark["low"])[[0, -1]] for mark in chart.content["marks"]]
    np.testing.assert_allclose(heights, [[0, 10], [100, 20], [0, 30], [0, 40]], atol=1e-9)
    assert chart.content["marks"][-1]["high"].max() == pytest.approx(100.0)


def test_the_reliability_of_a_detection_is_drawn_where_it_was_scored(report_data):
    score = DetectionScore(
        reliability=((0.1, 0.12, 50), (0.5, 0.45, 80), (0.9, 0.93, 200)), brier=0.11, constant_brier=0.2,
        log_score=0.3, constant_log_score=0.6, n=330, n_detected=230, floor_db=-15.0, rmse_db=9.0, offset_db=1.0,
        detected_rmse_db=7.0, free_space_rmse_db=9.9, learned_on="other flights",
    )  # fmt: skip
    assert charts_of(report_data) == []
    scored = with_numbers(report_data.rss[0], detection=score)
    (chart,) = charts_of(dataclasses.replace(report_data, rss=(scored, *report_data.rss[1:])))
    assert "Brier score 0.110, this flight's own share 0.200" in chart.caption
    assert "(learned on other flights)" in chart.caption
    dots = chart.content["marks"][0]
    np.testing.assert_allclose([dots["x"], dots["y"]], [[10, 50, 90], [12, 45, 93]])

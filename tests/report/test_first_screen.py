"""The verdict of the first screen, and its numbers, against records whose answer is known."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from aerpaw_cmp.compare.field_difference import FieldAudit
from aerpaw_cmp.report.first_screen import headlines, pooled_db, verdict


def test_pooled_error_is_that_of_all_samples_together():
    rng = np.random.default_rng(2)
    one, two = rng.normal(0, 3, 400), rng.normal(0, 7, 100)
    parts = [np.sqrt((part**2).mean()) for part in (one, two)]
    assert pooled_db(parts, [400, 100]) == pytest.approx(np.sqrt((np.concatenate([one, two]) ** 2).mean()))


def with_errors(data, rmse_db, baseline_db):
    """The report with these errors in every channel."""
    panels = tuple(
        dataclasses.replace(
            panel,
            rmse_db=rmse_db,
            baselines=tuple(dataclasses.replace(b, rmse_db=baseline_db + i) for i, b in enumerate(panel.baselines)),
        )
        for panel in data.rss
    )
    return dataclasses.replace(data, rss=panels)


def test_worse_than_the_best_baseline_is_the_first_thing_said(report_data):
    data = with_errors(report_data, 8.5, 7.9)
    first = verdict(data)[0]
    name = {"free_space": "free space", "two_ray": "two-ray ground"}[data.rss[0].baselines[0].name]
    assert first.startswith(f"Ray tracing is WORSE than {name}")
    assert "8.5 dB" in first
    assert "7.9 dB" in first
    assert "WORSE" not in verdict(with_errors(report_data, 3.0, 7.9))[0]
    alike = verdict(with_errors(report_data, 3.01, 3.0))[0]  # both print as 3.0
    assert "WORSE" not in alike
    assert ", 0.0 dB against" in alike


@pytest.mark.parametrize(("ours", "other"), [(2.84, 2.98), (2.96, 2.94), (3.04, 3.96), (3.0, 3.0), (2.849, 2.951)])
def test_the_numbers_of_the_first_sentence_add_up(report_data, ours, other):
    said = verdict(with_errors(report_data, ours, other))[0].replace("\u2212", "-")
    total, difference, baseline = (float(number) for number in re.findall(r"([-+]?\d+\.\d+) dB", said))
    assert total - baseline == pytest.approx(difference, abs=1e-9)
    assert difference == pytest.approx(ours - other, abs=0.05)


def test_at_most_four_numbers_each_with_something_beside_it(report_data):
    found = headlines(report_data)
    assert 2 <= len(found) <= 4
    assert all(one.value and one.beside for one in found)


def test_doubts_are_said(report_data):
    engine = report_data.engine
    broken = dataclasses.replace(engine.audit, fields=FieldAudit(failures=("power of a path",)))
    data = dataclasses.replace(report_data, synthetic=False, engine=dataclasses.replace(engine, audit=broken))
    assert "the audit of the field failed 1 times" in verdict(data)[1]
    assert any(one.value == "1 failed" for one in headlines(data))
    none = dataclasses.replace(report_data, engine=dataclasses.replace(engine, audit=None))
    assert "not audited" in verdict(none)[1]


def test_nothing_to_score(report_data):
    panels = tuple(dataclasses.replace(panel, n=0, rmse_db=np.nan) for panel in report_data.rss)
    first, _ = verdict(dataclasses.replace(report_data, rss=panels, rank=()))
    assert first.startswith("Nothing could be compared")

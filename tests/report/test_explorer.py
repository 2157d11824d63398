"""The data of the linked views: the script gets the numbers of the record."""

import base64
import dataclasses
import json
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.report import canvas, explorer, packed, page
from aerpaw_cmp.report.flight_data import Source
from aerpaw_cmp.site.site import Trees


def array(content, number):
    kind, offset, length = content["packed"]["arrays"][number]
    block = zlib.decompress(base64.b64decode(content["packed"]["data"]))
    return np.frombuffer(block, dtype=f"<{kind}", count=length, offset=offset)


def test_arrays_come_back_as_they_were(report_data):
    content = json.loads(page.as_json(explorer.payload(report_data)))
    for series, panel in zip(content["rss"], report_data.rss, strict=True):
        assert array(content, series["measured"]) == pytest.approx(panel.measured_db, nan_ok=True, rel=1e-6)
        assert array(content, series["models"][0]["level"]) == pytest.approx(panel.simulated_dbm, nan_ok=True, rel=1e-6)
        assert [m["name"] for m in series["models"][1:]] == ["free space", "two-ray ground"]
        assert series["of"] == len(panel.time)
        assert np.diff(array(content, series["time"])).min() >= 0
    for series, rank in zip(content["rank"], report_data.rank, strict=True):
        assert array(content, series["measured"]) == pytest.approx(rank.measured, nan_ok=True)
        distance = [fit.total_variation for fit in rank.score.simulated.values()]
        assert distance[series["best"]] == min(distance)


def test_equal_arrays_are_stored_once(report_data):
    panel = report_data.rss[0]
    twice = dataclasses.replace(report_data, rss=(panel, dataclasses.replace(panel, channel="copy")))
    alone = dataclasses.replace(report_data, rss=(panel,))
    assert len(explorer.payload(twice)["packed"]["arrays"]) == len(explorer.payload(alone)["packed"]["arrays"])


def test_a_sample_names_its_log_and_line(report_data):
    panel = report_data.rss[0]
    n = len(panel.time)
    source = Source(files=("a.txt", "b.txt"), file=np.arange(n) % 2, line=np.arange(n) + 7)
    content = explorer.payload(dataclasses.replace(report_data, rss=(panel,), sources={panel.name: source}))
    series = content["rss"][0]
    assert series["files"] == ["a.txt", "b.txt"]
    assert array(content, series["line"])[3] == 10
    assert array(content, series["file"])[3] == 1


def test_long_series_are_thinned_with_their_extremes(report_data):
    panel = report_data.rss[0]
    n = 120_000
    rng = np.random.default_rng(1)
    level = rng.normal(-80, 5, n)
    level[77_777] = -10.0
    long = dataclasses.replace(
        panel, time=panel.time[0] + np.arange(n) * np.timedelta64(100, "ms"), measured_db=level, geometry={}, baselines={},
        simulated_dbm=np.resize(panel.simulated_dbm, n), position_m=np.resize(panel.position_m, (n, 3)),
    )  # fmt: skip
    content = explorer.payload(dataclasses.replace(report_data, rss=(long,), rank=()))
    series = content["rss"][0]
    shown = array(content, series["measured"])
    assert series["of"] == n
    assert 10_000 < len(shown) <= explorer.POINTS + 2
    assert shown.max() == np.float32(-10.0)
    assert shown.min() == np.float32(level.min())
    assert len(page.as_json(content)) < 8e6


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1e3, 1e3) | st.just(float("nan")), min_size=1, max_size=300), st.integers(4, 80))
def test_extremes_stay(values, limit):
    array = np.array(values)
    pick = canvas.keep_extremes([array], limit)
    assert (np.diff(pick) > 0).all()
    assert len(pick) <= max(limit, 2) + 2
    if np.isfinite(array).any():
        assert np.nanmax(array[pick]) == np.nanmax(array)
        assert np.nanmin(array[pick]) == np.nanmin(array)


def test_a_pose_shows_the_probability_of_each_rank(report_data):
    panel = report_data.rank[0]
    share = np.linspace(0.0, 1.0, len(panel.time))
    ranked = dataclasses.replace(panel, probability=np.column_stack([1 - share, share, 0 * share, 0 * share]))
    content = explorer.payload(dataclasses.replace(report_data, rank=(ranked,)))
    _, second_rank, *_ = content["rank"][0]["probability"]
    assert second_rank["name"] == "probability_rank2"
    np.testing.assert_allclose(array(content, second_rank["values"]), share, atol=1e-6)


def test_a_plan_of_a_place_without_a_map_says_so(report_data):
    site = report_data.site
    bare = dataclasses.replace(
        site, buildings=(), forests=(), trees=Trees.none(), opaque_trees=Trees.none(), scene=None
    )
    assert (site.mapped, bare.mapped) == (True, False)
    assert packed.scene(site)["credit"] == site.credit
    assert packed.scene(bare)["credit"] == "no map here"

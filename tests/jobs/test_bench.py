"""The definitions of the ratios of ``bench``. Times are not tested."""

import pytest

from aerpaw_cmp.jobs import bench


def _rows(missed):
    """Rows of the image engine and of Sionna, by the number of paths that Sionna misses."""
    sionna = [
        {"engine": "sionna", "depth": 2, "samples": n, "missing_paths": paths, "search_seconds": n / 100.0}
        for n, paths in missed.items()
    ]
    image = [{"engine": "image", "depth": depth, "search_seconds": 2.0 + depth} for depth in (1, 2)]
    return [*image, *sionna]


def test_equal_error_is_the_fewest_samples_that_find_as_many_paths():
    ratios = bench.path_search_ratios(_rows({1_000: 43, 10_000: 0, 100_000: 0, 1_000_000: 0}))
    assert ratios["equal_error"]["samples"] == 10_000
    assert ratios["equal_error"]["ratio"] == pytest.approx(100.0 / 4.0)  # by the image engine at the same depth
    assert ratios["1e6"]["ratio"] == pytest.approx(10_000.0 / 4.0)


def test_where_only_the_most_samples_find_all_that_is_equal_error():
    ratios = bench.path_search_ratios(_rows({1_000: 10, 10_000: 3}))
    assert ratios["equal_error"]["samples"] == 10_000
    assert bench.path_search_ratios(_rows({})) == {}


def test_bench_tells_a_ratio_to_each_peer_of_the_contract(monkeypatch):
    pytest.importorskip("pykrige")
    kriging, ingest, rows = bench.kriging_vs_pykrige, bench.ingest_vs_pandas, _rows({1_000_000: 0})
    monkeypatch.setattr(bench, "speed_against_error", lambda *_, **__: rows)
    monkeypatch.setattr(bench, "kriging_vs_pykrige", lambda: kriging(100))
    monkeypatch.setattr(bench, "ingest_vs_pandas", lambda: ingest(500))
    result = bench.run_bench(poses=2)
    assert {"path_search_image_vs_sionna_1e6", "kriging_vs_pykrige", "ingest_vs_pandas"} <= set(result["ratios"])
    for row in (result["details"][name] for name in ("kriging_vs_pykrige", "ingest_vs_pandas")):
        assert row["ratio"] == pytest.approx(row["seconds_peer"] / row["seconds_ours"])

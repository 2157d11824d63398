"""The definitions of the ratios of ``bench``. Times are not tested."""

import pytest

from aerpaw_cmp.jobs import bench


def test_equal_error_is_the_fewest_samples_that_find_as_many_paths(monkeypatch):
    missed = {1_000: 43, 10_000: 0, 100_000: 0, 1_000_000: 0}
    ran = []

    def search(poses, samples, **_):
        ran.append(samples)
        return {"ratio": samples / 100.0, "extra_paths": missed[samples], "samples": samples}

    monkeypatch.setattr(bench, "path_search", search)
    ratios = bench.path_search_ratios()
    assert ratios["equal_error"]["samples"] == 10_000
    assert ratios["equal_error"]["ratio"] < ratios["at"]["1e+06"]["ratio"]
    assert ran == [1_000_000, 1_000, 10_000]  # no more than is needed


def test_where_only_the_most_samples_find_all_that_is_equal_error(monkeypatch):
    monkeypatch.setattr(
        bench, "path_search", lambda _poses, samples, **_: {"ratio": 1.0, "extra_paths": 10 // len(str(samples))}
    )
    assert bench.path_search_ratios(samples=(1_000, 10_000_000_000))["equal_error"]["extra_paths"] == 0


def test_bench_tells_a_ratio_to_each_peer_of_the_contract(monkeypatch):
    pytest.importorskip("pykrige")
    kriging, ingest, searched = bench.kriging_vs_pykrige, bench.ingest_vs_pandas, {"ratio": 2.0}
    monkeypatch.setattr(bench, "path_search_ratios", lambda: {"equal_error": searched, "at": {"1e+06": searched}})
    monkeypatch.setattr(bench, "kriging_vs_pykrige", lambda: kriging(100))
    monkeypatch.setattr(bench, "ingest_vs_pandas", lambda: ingest(500))
    result = bench.run_bench(poses=2, samples=())
    assert {"path_search_image_vs_sionna_1e6", "kriging_vs_pykrige", "ingest_vs_pandas"} <= set(result["ratios"])
    for row in (result["details"][name] for name in ("kriging_vs_pykrige", "ingest_vs_pandas")):
        assert row["ratio"] == pytest.approx(row["seconds_peer"] / row["seconds_ours"])

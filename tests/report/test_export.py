import dataclasses
import json

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.compare.result import EngineResult
from aerpaw_cmp.report import columns as export
from aerpaw_cmp.report import flight, texts
from benchmarks.fabricated import with_numbers


def joined(columns, series):
    frames = [
        pd.DataFrame({**export._times(time, slice(None)), **values}, index=range(len(time))).round(export.DECIMALS)
        for time, values in export.tables(columns, series)[1]
    ]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=export.header(columns))


def rss_frame(series):
    return joined(export.RSS, series)


def rank_frame(series):
    return joined(export.RANK, series)


def test_metrics_hold_the_contract(report_data):
    m = json.loads(json.dumps(flight.metrics(report_data), allow_nan=False))
    for key in ("flight", "versions", "inputs", "rss", "rank", "rt", "stages"):
        assert key in m
    assert {"path", "sha256", "reader", "lines", "accepted", "rejected"} <= set(m["inputs"][0])
    channel = m["rss"]["LW1"]["USRP2"]
    panel = report_data.rss[1]
    assert channel["offset_db"] == panel.score.offset_db
    assert channel["rmse_ci95_db"] == list(panel.score.rmse_ci95_db)
    assert channel["baselines"]["two_ray"] == {
        "offset_db": panel.baselines["two_ray"].offset_db,
        "rmse_db": panel.baselines["two_ray"].rmse_db,
    }
    assert {"n", "n_out_of_coverage", "at_search_edge", "correlation", "lag_s"} <= set(channel)
    rank = m["rank"]["LW1"]
    assert list(rank["simulated"]) == ["10", "100", "1000"]
    assert list(rank["measured"]["histogram"]) == ["1", "2", "3", "4"]
    assert sum(rank["measured"]["histogram"].values()) == pytest.approx(1.0)
    assert {"histogram", "out_of_coverage", "agreement", "total_variation", "wasserstein"} <= set(
        rank["simulated"]["100"]
    )
    assert m["rt"]["audit"]["rank_disagreement"]["1000"] == 0.005
    assert m["stages"]["replay_s"] == 0.71


def test_nan_is_null_and_extra_metrics_are_merged(report_data):
    bad = with_numbers(
        report_data.rss[0],
        rmse_db=float("nan"),
        correlation=float("-inf"),
        intervals=dataclasses.replace(report_data.rss[0].score.intervals, rmse_db=(float("nan"), 1.0)),
        n_flagged={"when": np.datetime64("2024-01-01"), "mask": np.array([True])},
    )
    data = dataclasses.replace(
        report_data,
        rss=(bad,),
        extra_metrics={"rss": {"LW1": {"USRP1": {"repeat_db": np.float32(3.0)}}}, "new": {1: (np.int8(2), None)}},
    )
    m = json.loads(json.dumps(flight.metrics(data), allow_nan=False))
    channel = m["rss"]["LW1"]["USRP1"]
    assert channel["rmse_db"] is None
    assert channel["correlation"] is None
    assert channel["rmse_ci95_db"] == [None, 1.0]
    assert channel["repeat_db"] == 3.0
    assert channel["n"] == bad.score.n, "merging must not drop what was there"
    assert channel["n_flagged"]["when"] == "2024-01-01"
    assert channel["n_flagged"]["mask"] == [True]
    assert m["new"] == {"1": [2, None]}


def test_key_order_does_not_depend_on_the_order_of_versions(report_data):
    a = dataclasses.replace(report_data, versions={"b": "1", "a": "2"})
    b = dataclasses.replace(report_data, versions={"a": "2", "b": "1"})
    assert json.dumps(flight.metrics(a)) == json.dumps(flight.metrics(b))


def test_rss_csv_comes_back_as_it_went(report_data, tmp_path):
    path = tmp_path / "rss.csv"
    rss_frame(report_data.rss).to_csv(path, index=False)
    back = pd.read_csv(path, parse_dates=["time_utc"])
    assert [c for c in export.header(export.RSS) if c not in back.columns] == []
    for panel in report_data.rss:
        rows = back[(back.tower == panel.tower) & (back.channel == panel.channel)]
        assert len(rows) == len(panel.time)
        np.testing.assert_allclose(rows.measured_db, panel.measured_db, atol=6e-5)
        np.testing.assert_allclose(rows.residual_db, panel.residual_db, atol=6e-5)
        np.testing.assert_allclose(rows.two_ray_dbm, panel.baselines["two_ray"].level_dbm, atol=6e-5)
        np.testing.assert_array_equal(rows.simulated_out_of_coverage == 1, panel.simulated_out_of_coverage)
        late = np.abs(rows.time_utc.dt.tz_localize(None).to_numpy() - panel.time)
        assert late.max() <= np.timedelta64(500, "us")
    # the columns agree with each other, as a reader of the file alone would compute them
    np.testing.assert_allclose(back.calibrated_db - back.simulated_dbm, back.residual_db, atol=2e-4)


@pytest.mark.parametrize("rows", [1, 7, 50_000])
def test_tables_written_in_pieces_are_the_tables(report_data, rows, monkeypatch):
    """Panels of other lengths, columns and times: the pieces joined are what the whole table would be as text."""
    monkeypatch.setattr(export, "_ROWS", rows)

    def few(panel, n):
        cut = {
            f.name: value[:n] if isinstance(value := getattr(panel, f.name), np.ndarray) and len(value) == len(panel.time)
            else value
            for f in dataclasses.fields(panel)
        }  # fmt: skip
        nothing = {"geometry": {}, "baselines": {}} if hasattr(panel, "geometry") else {"rank": {}}
        return dataclasses.replace(panel, **{**cut, **nothing})

    bare = [dataclasses.replace(few(p, 9), time=p.time[:9] - p.time[0]) for p in report_data.rss]
    for panels in ([], bare, [few(report_data.rss[0], 0), *bare], list(report_data.rss[:1]) if rows > 1 else bare):
        text = rss_frame(panels).to_csv(index=False, lineterminator="\n")
        assert "".join(export.csv_text(export.RSS, panels)) == text
    rank = report_data.rank[0]
    longer, shorter = few(rank, 11), dataclasses.replace(few(rank, 5), probability=np.full((5, 4), 0.25))
    for ranks in ([], [longer, shorter], [shorter, longer]):
        text = rank_frame(ranks).to_csv(index=False, lineterminator="\n")
        assert "".join(export.csv_text(export.RANK, ranks)) == text


def test_relative_times_are_no_times_of_day(report_data):
    panel = report_data.rss[0]
    start = panel.time[0] - np.datetime64("1969-12-31T23:57:00", "ns")
    table = rss_frame([dataclasses.replace(panel, time=panel.time - start), panel])
    relative, absolute = table[: len(panel.time)], table[len(panel.time) :]
    assert (relative.time_utc == "").all()
    assert absolute.time_utc.str.startswith("20").all()
    np.testing.assert_allclose(relative.time_s.to_numpy(), absolute.time_s.to_numpy())
    np.testing.assert_allclose(
        absolute.time_s.to_numpy(), (panel.time - panel.time.min()) / np.timedelta64(1, "s"), atol=1e-4
    )


def test_rank_csv_keeps_no_csi_apart_from_no_path(report_data, tmp_path):
    path = tmp_path / "rank.csv"
    rank_frame(report_data.rank).to_csv(path, index=False)
    assert ".0," not in path.read_text().splitlines()[1].split(",", 5)[5], "ranks are integers in the file"
    back = pd.read_csv(path)
    panel = report_data.rank[0]
    np.testing.assert_array_equal(back.measured_rank.isna(), np.isnan(panel.measured))
    np.testing.assert_array_equal(back["simulated_rank_k10"], panel.rank[10.0])
    assert (back["simulated_rank_k10"] == 0).sum() == panel.score.simulated[10.0].out_of_coverage


def test_panels_with_different_baselines_share_one_table(report_data):
    bare = dataclasses.replace(report_data.rss[0], baselines={}, channel="bare")
    frame = rss_frame([bare, report_data.rss[1]])
    assert frame[frame.channel == "bare"].free_space_dbm.isna().all()
    assert frame[frame.channel == "USRP2"].free_space_dbm.notna().all()


@pytest.mark.parametrize(
    ("stored", "text"),
    [
        ("2024-07-02T15:00:00.999999999", "2024-07-02T15:00:01.000Z"),
        ("2024-07-02T15:00:00.0004", "2024-07-02T15:00:00.000Z"),
        ("1969-12-31T23:59:59.9996", "1970-01-01T00:00:00.000Z"),
        ("NaT", ""),
    ],
)
def test_time_is_rounded_not_cut(stored, text):
    assert texts.iso_time([np.datetime64(stored, "ns")]).tolist() == [text]


def test_no_engine_no_audit(report_data):
    assert flight.metrics(dataclasses.replace(report_data, engine=None))["rt"] is None
    bare = dataclasses.replace(report_data, engine=EngineResult(engine="sionna", links=1, seconds=1.0))
    assert flight.metrics(bare)["rt"]["audit"] is None


def test_rank_csv_holds_what_a_receiver_decides_by(report_data):
    """Check the level and the ratios of singular values. They are empty if there is no path, and never infinite."""
    panel = report_data.rank[0]
    level, sigma = np.full(len(panel.time), -80.0), np.tile([1.0, 10**-0.625], (len(panel.time), 1))
    level[1], sigma[2, 1] = np.nan, 0.0
    with np.errstate(divide="ignore"):
        table = rank_frame([dataclasses.replace(panel, level_dbm=level, sigma=sigma)])
    assert table["level_dbm"].isna().to_numpy().nonzero()[0].tolist() == [1]
    assert table["sigma2_over_sigma1_db"].isna().to_numpy().nonzero()[0].tolist() == [2]
    assert table["sigma2_over_sigma1_db"][0] == -12.5

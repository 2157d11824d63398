"""rss.nc and rank.nc are read with xarray and compared with the CSV files."""

import dataclasses
import io
import sys

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.jobs.run import ReportOptions, run_report
from aerpaw_cmp.report.columns import RANK, RSS, csv_text
from aerpaw_cmp.report.samples_netcdf import write_netcdf
from tests.frames import thinned

xarray = pytest.importorskip("xarray")


@pytest.fixture(scope="module")
def data(report_data):
    """Two series of different length with an unknown position, a name in Latin-1, and a rank without CSI."""
    first, last = thinned(report_data.rss[0], 60), thinned(report_data.rss[2], 70, tower='LW<4> "ö"')
    place = np.array(first.position_m)
    place[7] = np.nan
    rank = dataclasses.replace(thinned(report_data.rank[0], 10), level_dbm=np.linspace(-90, -50, 100))
    return dataclasses.replace(
        report_data, rss=(dataclasses.replace(first, position_m=place), last), rank=(rank,), synthetic=True
    )


@pytest.mark.parametrize(("kind", "columns"), [("rss", RSS), ("rank", RANK)])
def test_a_file_has_the_samples_of_its_table(data, tmp_path, cf_faults, kind, columns):
    write_netcdf(data, tmp_path)
    table = pd.read_csv(io.StringIO("".join(csv_text(columns, getattr(data, kind)))))
    numbers = [name for name in table.select_dtypes("number") if name != "time_s"]
    assert len(numbers) > 6
    with xarray.open_dataset(tmp_path / f"{kind}.nc", decode_coords="all") as book:
        labels = [name for name in ("tower", "channel") if name in table]
        parts = {key: part.reset_index() for key, part in table.groupby(labels)}
        assert len(parts) == len(getattr(data, kind))
        for key, part in parts.items():
            whole = book.sel(dict(zip(labels, key, strict=True)))
            assert np.isfinite(whole["up_m"].values[len(part) :]).sum() == 0
            one = whole.isel(obs=slice(len(part)))
            for name in numbers:
                np.testing.assert_allclose(one[name.replace(".", "p")], part[name], atol=1e-9, err_msg=name)
            times = pd.to_datetime(part["time_utc"]).dt.tz_localize(None).to_numpy()
            assert np.abs(one["time"].values - times).max() <= np.timedelta64(1, "ms")
            if kind == "rss":
                assert str(one["unit"].values) == part["unit"][0]
            known = part["east_m"].notna().to_numpy()
            assert np.isfinite(one["latitude"].values).tolist() == known.tolist()
            places = data.site.frame.to_local(one["latitude"].values[known], one["longitude"].values[known])
            np.testing.assert_allclose(places[0], part["east_m"][known], atol=2e-3)
        level = book["simulated_dbm" if kind == "rss" else "level_dbm"]
        assert level.attrs["units"] == "0.1 lg(re 1 mW)"
        if kind == "rank":
            assert book["simulated_rank_k10"].attrs["flag_meanings"].split()[:2] == ["no_path", "rank_1"]
            assert np.isnan(book["measured_rank"].values).any()
    assert cf_faults(tmp_path / f"{kind}.nc") == []


def test_relative_times_are_named_as_such(data, tmp_path):
    first = data.rss[0]
    moved = dataclasses.replace(first, time=first.time - first.time.min() + np.datetime64(0, "ns"))
    assert [path.name for path in write_netcdf(dataclasses.replace(data, rss=(moved,), rank=()), tmp_path)] == [
        "rss.nc"
    ]
    with xarray.open_dataset(tmp_path / "rss.nc") as book:
        assert "not real" in book["time"].attrs["comment"]


def test_a_missing_library_is_named_before_the_computation(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "netCDF4", None)
    with pytest.raises(UsageError, match=r"netCDF4.*aerpaw-cmp\[geo\]"):
        run_report(tmp_path / "flight.yaml", ReportOptions(netcdf=True))

"""samples.kmz is read back with a reader of others and compared with the CSVs."""

import dataclasses
import zipfile
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.compare.gains import NO_SPREAD, StatedSpread
from aerpaw_cmp.maps.export import Scale
from aerpaw_cmp.report import columns as export
from aerpaw_cmp.report import kmz
from tests.frames import thinned

ODD = 'LW<4> & "ö"'


@pytest.fixture(scope="module")
def data(report_data):
    """A short flight: a name that must be escaped, a position that is unknown, levels out of coverage, no CSI."""
    first, last = thinned(report_data.rss[0], 60), thinned(report_data.rss[2], 60, tower=ODD)
    place = np.array(first.position_m)
    place[7] = np.nan
    stated = StatedSpread(gain_sd_db=np.full(len(first.time), 2.5), spread=NO_SPREAD)
    first = dataclasses.replace(first, position_m=place, unit="dBm", stated=stated)
    rank = dataclasses.replace(thinned(report_data.rank[0], 10), level_dbm=np.linspace(-90, -50, 100))
    track = thinned(report_data.track, 30)
    return dataclasses.replace(
        report_data, track=track, rss=(first, last), rank=(rank,), synthetic=True, title="Flight <1> & more"
    )


@pytest.fixture(scope="module")
def frames(data, tmp_path_factory):
    """rss.csv and rank.csv as a user reads them, with where each sample is."""
    by_kind = {}
    for kind, pieces in (
        ("rss", export.csv_text(export.RSS, data.rss)),
        ("rank", export.csv_text(export.RANK, data.rank)),
    ):
        path = tmp_path_factory.mktemp("csv") / f"{kind}.csv"
        path.write_text("".join(pieces), encoding="utf-8")
        table = pd.read_csv(path)
        table["time"] = pd.to_datetime(table["time_utc"]).astype("datetime64[ns, UTC]")
        by_kind[kind] = table
    return by_kind


FRAME = SiteFrame(35.7275, -78.6960)


def same(table, column, values, *, atol=1e-9):
    np.testing.assert_allclose(
        np.asarray(values, dtype=float), table[column].to_numpy(float), rtol=0, atol=atol, err_msg=column
    )


def same_places(table, latitude, longitude, atol=2e-3):
    """Convert back to metres with the site's projection, from the values in the file."""
    east, north = FRAME.to_local(np.asarray(latitude, dtype=float), np.asarray(longitude, dtype=float))
    same(table, "east_m", east, atol=atol)
    same(table, "north_m", north, atol=atol)


def same_times(table, times):
    seconds = (
        pd.to_datetime(pd.Series(list(times)), utc=True).astype("datetime64[ns, UTC]")
        - table["time"].reset_index(drop=True)
    ).dt.total_seconds()
    assert seconds.abs().max() < 2e-3


def valid_kml(folder, text):
    """Against the schema of the OGC."""
    from fastkml import validator

    (folder / "doc.kml").write_text(text, encoding="utf-8")
    try:
        return bool(validator.validate(file_to_validate=folder / "doc.kml"))
    except AssertionError:
        return False


def test_an_independent_reader_finds_what_the_csvs_hold(data, frames, tmp_path):
    fastkml = pytest.importorskip("fastkml")
    with zipfile.ZipFile(kmz.write_kmz(data, tmp_path)) as archive:
        assert archive.namelist()[0] == "doc.kml"
        text = archive.read("doc.kml").decode()
        legends = [name for name in archive.namelist() if name.startswith("legends/")]
    book = fastkml.KML.from_string(text.split("?>\n", 1)[1])
    assert valid_kml(tmp_path, text)
    document = book.features[0]
    folders = {f.name: f for f in document.features if isinstance(f, fastkml.Folder)}
    towers = folders.pop("Towers")
    assert [p.name for p in towers.features] == list(data.site.towers)
    assert towers.features[0].geometry.coords[0][:2] == pytest.approx((-78.6960, 35.7275), abs=1e-6)
    table = frames["rss"].query("channel == 'USRP1' and tower == 'LW1'").reset_index(drop=True)
    assert "gx:Track" in text
    lines = folders["LW1 USRP1, Residual"].features
    spans = [line for line in lines if isinstance(line, fastkml.Placemark)]
    at = np.concatenate(
        [np.array(line.geometry.coords)[: -1 if i < len(spans) - 1 else None] for i, line in enumerate(spans)]
    )
    known = table[table["east_m"].notna()].reset_index(drop=True)
    same_places(known, at[:, 1], at[:, 0], atol=0.02)
    same(known, "up_m", at[:, 2], atol=0.06)
    same_times(known.iloc[[0, -1]], [spans[0].times.begin.dt, spans[-1].times.end.dt])
    worst = known["residual_db"].abs().max()
    said = [
        float(number)
        for line in spans
        if line.name.endswith(" dB")
        for number in line.name.removesuffix(" dB").split(" to ")
    ]
    assert max(map(abs, said)) == pytest.approx(worst, abs=0.06), "the largest residual is there"
    styles = {style.id for style in document.styles}
    assert {
        line.style_url.url.removeprefix("#")
        for f in folders.values()
        for line in f.features
        if isinstance(line, fastkml.Placemark)
    } <= styles
    assert sorted(legends) == ["legends/level.png", "legends/rank.png", "legends/residual.png"]
    assert f"{ODD} USRP1, Residual" in folders


# --- what else may happen --------------------------------------------------------------------------------------------


def test_logs_without_a_time_of_day_are_named_as_such(data, tmp_path, monkeypatch):
    monkeypatch.setattr(Scale, "legend", lambda *_: {})
    epoch = np.datetime64(0, "ns")

    def moved(panel):
        return dataclasses.replace(panel, time=epoch + (panel.time - panel.time[0]))

    relative = dataclasses.replace(
        data, rss=tuple(map(moved, data.rss)), rank=tuple(map(moved, data.rank)), track=moved(data.track)
    )
    with zipfile.ZipFile(kmz.write_kmz(relative, tmp_path)) as archive:
        text = archive.read("doc.kml").decode()
    assert "TimeSpan" not in text
    assert "no origin" in text


def lines_of(data, folder):
    with zipfile.ZipFile(kmz.write_kmz(data, folder)) as archive:
        text = archive.read("doc.kml").decode()
    assert valid_kml(folder, text)
    return {part.partition("</name>")[0]: part.count("<LineString>") for part in text.split("<Folder><name>")[1:]}


def test_a_flight_with_rank_alone_and_one_with_nothing(data, tmp_path, monkeypatch):
    pytest.importorskip("fastkml")
    monkeypatch.setattr(Scale, "legend", lambda *_: {})
    ranks = lines_of(dataclasses.replace(data, rss=()), tmp_path)
    assert list(ranks) == ["Towers", "LW1, Rank reported", *(f"LW1, Rank replayed, K = {k}" for k in (10, 100, 1000))]
    assert all(ranks[name] for name in ranks if name != "Towers")
    assert lines_of(dataclasses.replace(data, rss=(), rank=(), track=None), tmp_path) == {"Towers": 0}
    nan = np.full(len(data.rss[0].time), np.nan)
    silent = dataclasses.replace(
        data.rss[0], measured_db=nan, simulated_dbm=nan, position_m=np.full((len(nan), 3), np.nan)
    )
    levels = lines_of(dataclasses.replace(data, rss=(silent,), rank=()), tmp_path)
    assert set(levels.values()) == {0}
    assert len(levels) == 4


def test_same_flight_same_kmz(data, tmp_path):
    first, second = (kmz.write_kmz(data, tmp_path).read_bytes() for _ in range(2))
    assert first == second


def test_a_long_flight_is_thinned_with_its_extremes(data, tmp_path, monkeypatch):
    monkeypatch.setattr(kmz, "POINTS", 600)
    panel = data.rss[0]
    level = np.array(panel.measured_db)
    level[61] += 60.0  # one sample among many
    changed = dataclasses.replace(data, rss=(dataclasses.replace(panel, measured_db=level), data.rss[1]))
    with zipfile.ZipFile(kmz.write_kmz(changed, tmp_path)) as archive:
        text = archive.read("doc.kml").decode()
    largest = float(np.nanmax(level + panel.score.offset_db - panel.simulated_dbm))
    assert f"{largest:.1f} dB</name>" in text
    assert "Thinned to about" in text
    lines = text.split("LW1 USRP1, Residual")[1].split("</Folder>")[0]
    assert lines.count(" ") < 600


def test_a_line_of_several_levels_names_the_lowest_and_the_highest():
    item = SimpleNamespace(unit="dB")
    assert kmz._label(item, np.array([-80.0, np.nan, -70.0, -75.0]), 0) == "-80.0 to -70.0 dB"
    assert kmz._label(item, np.array([-80.0, np.nan, -80.0]), 0) == "-80.0 dB"


def test_every_rank_has_its_own_colour():
    """Rank 4 had the colour and the name of rank 3."""
    numbers = kmz.RANKS.bin_of(np.array([1.0, 2.0, 3.0, 4.0, 0.0, np.nan]))
    assert [kmz.RANKS.labels[i] for i in numbers[:4]] == ["rank 1", "rank 2", "rank 3", "rank 4"]
    assert {kmz.RANKS.labels[i] for i in numbers[4:]} == {"out of coverage"}

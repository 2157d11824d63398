"""``predict`` on the sample flight, whose levels and offsets are known."""

import dataclasses
import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.compare.gains import LinkSamples
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs import predict, sources
from aerpaw_cmp.jobs.calibrate import observe
from aerpaw_cmp.jobs.calibrate_rank import rank_samples
from aerpaw_cmp.jobs.flight_run import run_flight
from aerpaw_cmp.jobs.referee import judge, read_foreign
from aerpaw_cmp.jobs.sources import TargetOptions, Targets, find_targets, named_flights
from aerpaw_cmp.maps.grid import Grid
from aerpaw_cmp.propagation.geometry import Link, rotation_from_aircraft, single_element
from aerpaw_cmp.propagation.replay import trace
from aerpaw_cmp.report.flight import referee_card
from aerpaw_cmp.report.prediction import prediction_metrics, write_prediction
from aerpaw_cmp.report.texts import coded
from aerpaw_cmp.site.siteyaml import load_site
from tests.json_page import unlisted

SAMPLE = Path(__file__).parents[2] / "sample_logs" / "flight.yaml"
POINTS = """east_m,north_m,height_m,yaw_deg
-300,150,30,20
-300,150,,20
-210,330,50,
5000,5000,40,0
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The sample flight with the logs of two towers, and a renamed copy of it."""
    folder = tmp_path_factory.mktemp("flight")
    for name in ("LW1", "LW2", "UAV"):
        shutil.copytree(SAMPLE.parent / name, folder / name)
    wanted = [line for line in SAMPLE.read_text().splitlines() if not re.search("path: LW[345]/", line)]
    text = "\n".join(wanted)
    (folder / "a.yaml").write_text(text)
    (folder / "b.yaml").write_text(text.replace("name: sample", "name: copy"))
    (folder / "points.csv").write_text(POINTS)
    return folder


@pytest.fixture(scope="module")
def prediction(small):
    return predict.predict(small / "points.csv", named_flights([small / "a.yaml", small / "b.yaml"]))


def rows(prediction, point):
    table = prediction.table
    return table[(table["point"] == point) & (table["channel"] != "rank")]


def test_a_copy_of_a_flight_counts_once(prediction):
    assert prediction.page.flights == ["sample"]
    assert any("counted once" in text for text in prediction.page.warnings)


def test_points_without_a_position_and_outside_are_flagged(prediction):
    assert set(rows(prediction, 1)["flag"]) == {"no_position"}
    assert rows(prediction, 1)["level_db"].isna().all()
    assert set(rows(prediction, 3)["flag"]) == {"outside_flown"}
    assert set(rows(prediction, 0)["flag"]) == {""}
    near, far = (rows(prediction, k)["sd_db"].to_numpy() for k in (0, 3))
    assert (far > near).all()
    assert any("1 of 4 points without a position" in text for text in prediction.page.warnings)
    assert "67 % of the points are outside the flown area" in prediction.page.warnings[0]  # of three with a position
    shares = [series["share_outside_flown"] for series in prediction_metrics(prediction.page)["series"].values()]
    np.testing.assert_allclose(shares, 2 / 3)


def test_levels_of_a_known_flight_without_a_position_are_counted(small, tmp_path):
    """40 of the flight's 326 s have no fix: an eighth of the levels."""
    folder = shutil.copytree(small, tmp_path / "flight")
    (log,) = (folder / "UAV").glob("*vehicleOut.txt")
    lines = log.read_text().splitlines()
    lines[100:140] = [re.sub(r"^(\d+),[^,]+,[^,]+", r"\1,nan,nan", line) for line in lines[100:140]]
    log.write_text("\n".join(lines) + "\n")
    _, said = observe([flight.load(None) for flight in named_flights([folder / "a.yaml"])])
    counts = [int(text.split(": ")[2].split(" %")[0]) for text in said if "have no position and are ignored" in text]
    assert len(counts) == 4  # two towers of two channels
    assert all(11 <= count <= 14 for count in counts)
    _, said = observe([flight.load(None) for flight in named_flights([small / "a.yaml"])])
    assert not any("no position" in text for text in said)


def test_columns_are_those_of_the_contract(prediction):
    contract = ["time_s", "east_m", "north_m", "height_m", "tower", "channel", "level_db", "sd_db", "q05_db", "q95_db"]
    assert set(contract) <= set(prediction.table.columns)
    levels = prediction.table[prediction.table["level_db"].notna()]
    assert ((levels["q05_db"] < levels["level_db"]) & (levels["level_db"] < levels["q95_db"])).all()
    by_point = levels.groupby(["point", "channel"], observed=True)["p_serving"].sum()
    np.testing.assert_allclose(by_point, 1.0, atol=2e-3)


@pytest.mark.parametrize("each", [1, 2, 8, 40])
def test_fading_and_the_noise_of_means_add_up_to_the_variance_of_samples(each):
    """Planted: independent fading of 3 dB, with a number of samples per mean over 4 s."""
    n = 800 * each
    level_db, unit = 3.0 * np.random.default_rng(5).normal(size=n), np.tile([1.0, 0.0, 0.0], (n, 1))
    known = LinkSamples(
        flight="a", tower="LW1", channel="rss", time_s=np.arange(n) * (4.0 / each), position_m=unit, at_uav=unit,
        at_tower=unit, residual_db=level_db,
    )  # fmt: skip
    means = known.binned(4.0)
    correction = SimpleNamespace(channels={"LW1.rss": SimpleNamespace(rows=means)})
    fading = sources.Flown(correction, {"LW1.rss": SimpleNamespace(samples=[known])}).fading("LW1.rss")
    assert fading.total_db(means.residual_db.std()) == pytest.approx(level_db.std(), rel=0.01)


@pytest.mark.parametrize(("flights", "wider_db"), [(1, 3.0), (2, 0.0)])
def test_errors_between_blocks_count_outside_the_flown_places_of_a_single_flight(flights, wider_db, monkeypatch):
    """Errors on held-out flights, which scale the standard deviation of several flights, have them already."""
    here, away = np.zeros((1, 3)), np.array([[500.0, 0.0, 0.0]])
    samples = [SimpleNamespace(flight=str(k), antenna="LW1.rss", position_m=here) for k in range(flights)]
    field = SimpleNamespace(
        over_headings=lambda *_, **__: (np.zeros(1), np.full(1, 2.0)), channels={"LW1.rss": None},
        sd_factor=1.0, model=SimpleNamespace(offset_sd_db=0.0),
    )  # fmt: skip
    monkeypatch.setattr(sources, "between_blocks_db", lambda _: 3.0)
    flown = sources.Flown(field, {"LW1.rss": SimpleNamespace(samples=samples)})
    near, far = (flown.levels([SimpleNamespace(antenna="LW1.rss", position_m=place)])[1][0] for place in (here, away))
    assert near == 2.0
    assert far == pytest.approx(np.hypot(2.0, wider_db))


def test_a_notebook_shows_first_words_and_points(prediction):
    shown = prediction._repr_html_()
    assert "Expect an RMSE of " in shown
    assert shown.count("<tr") == 11  # the heads and ten points


def test_no_flight_that_shares_a_tower_is_one_message(small):
    other = small / "other.yaml"
    text = (small / "a.yaml").read_text().replace("node: LW1", "node: LW4").replace("node: LW2", "node: LW5")
    other.write_text(text)
    with pytest.raises(UsageError, match="needs LW4, LW5"):
        predict.predict(other, named_flights([small / "a.yaml"]))
    with pytest.raises(UsageError, match="the site is not named"):
        predict.predict(small / "points.csv", [])


def test_points_of_a_spreadsheet_may_have_decimal_commas(tmp_path):
    commas, points = tmp_path / "commas.csv", tmp_path / "points.csv"
    commas.write_text("east_m;north_m;height_m;yaw_deg\n-300,5;150;30;20,5\n10;20;30;\n")
    points.write_text("east_m;north_m;height_m;yaw_deg\n-300.5;150;30;20.5\n10;20;30;\n")
    for path in (commas, points):
        targets = find_targets(path, load_site("lake_wheeler"), TargetOptions())
        assert targets.position_m.tolist() == [[-300.5, 150.0, 30.0], [10.0, 20.0, 30.0]]
        assert targets.yaw_deg[0] == 20.5


def test_a_file_without_positions_is_refused(tmp_path):
    (tmp_path / "p.csv").write_text("east_m,north_m,height_m\n,,\n")
    with pytest.raises(InputError, match="no point has a position"):
        find_targets(tmp_path / "p.csv", load_site("lake_wheeler"), TargetOptions())


def test_a_table_of_points_is_refused_before_all_of_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "MOST_POINTS", 100)
    (tmp_path / "p.csv").write_text("east_m,north_m,height_m\n" + "1,2,30\n" * 1000)
    read, rows = pd.read_csv, []

    def counted(*args, **options):
        table = read(*args, **options)
        rows.append(len(table))
        return table

    monkeypatch.setattr(pd, "read_csv", counted)
    with pytest.raises(InputError, match=r"p\.csv: more than 2000000 points"):
        find_targets(tmp_path / "p.csv", load_site("lake_wheeler"), TargetOptions())
    assert rows == [101]


def test_files_agree_with_each_other(tmp_path, prediction, cf_faults):
    files, _ = write_prediction(prediction.page, tmp_path)
    table = pd.read_csv(tmp_path / "prediction.csv")
    levels = table[table["channel"] != "rank"]
    np.testing.assert_allclose(levels["level_db"], prediction.table["level_db"][: len(levels)], atol=1e-3)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert unlisted("predict", metrics) == []
    assert metrics["trained_on"] == list(prediction.page.trained_on)
    expected = np.sqrt((levels["slow_sd_db"] ** 2).mean())
    assert metrics["sentence"].startswith(f"Expect an RMSE of {expected:.1f} dB over 4 s means")
    assert coded(metrics["sentence"]) in files[0].read_text()
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("netCDF4")
    with xarray.open_dataset(tmp_path / "prediction.nc") as book:
        assert {"tower", "channel"} <= set(book.indexes)
        for (tower, channel), part in levels.groupby(["tower", "channel"]):
            level = book.level_db.sel(tower=tower, channel=channel)
            np.testing.assert_allclose(level, part["level_db"], atol=1e-3)
    assert cf_faults(tmp_path / "prediction.nc") == []


@pytest.fixture(scope="module")
def flown(small):
    """The flight with its comparison, by which predictions are scored."""
    data = load_data(load_flight(small / "a.yaml"), small)
    return data, run_flight(data, audit=False).result


@pytest.fixture
def said(flown, tmp_path):
    """A prediction that is 2 dB above each level of LW1 USRP1 and states 3 dB, at the poses of the flight."""
    data, result = flown
    levels = next(o for o in observe([data])[0] if o.samples.antenna == "LW1.USRP1")
    level = levels.samples.residual_db + levels.free_space_db + 2.0
    place = dict(zip(("east_m", "north_m", "height_m"), levels.samples.position_m.T, strict=True))
    time_s = np.arange(float(len(level)))  # the flight waits: one position has several predicted levels
    frame = pd.DataFrame({"time_s": time_s, **place, "yaw_deg": levels.heading_deg, "tower": "LW1", "channel": "USRP1", "level_db": level,
                          "sd_db": 3.0, "q05_db": level - 4.935, "q95_db": level + 4.935})  # fmt: skip
    frame.to_csv(tmp_path / "prediction.csv", index=False)
    about = {"trained_on": ["0" * 64], "marks": [], "series": {"LW1 USRP1": {"unit": "dB re full scale"}}}
    (tmp_path / "metrics.json").write_text(json.dumps(about))
    return data, tmp_path, lambda: judge(read_foreign(tmp_path, data), data, result)


def test_a_flown_route_is_scored_by_what_was_said(said):
    _, folder, scored = said
    verdict = scored()
    series = verdict["levels"]["LW1"]["USRP1"]
    card = series["cards"][folder.name]
    # the flight waits at its waypoints: there a sample is scored by a neighbour's level
    assert card["bias_db"] == pytest.approx(-2.0, abs=0.3)
    assert series["unmatched"] == 0
    assert card["rmse_db"] == pytest.approx(np.hypot(card["bias_db"], card["rmse_offset_db"]), abs=1e-6)
    assert 0.9 < card["coverage_90"] < 1.0
    stated = f"As predicted, without an offset: RMSE {card['rmse_db']:.1f} dB; the 90 % band contains"
    assert stated in verdict["sentence"]


def test_levels_of_a_first_prediction_count_for_every_channel_after_an_offset(said):
    """Ray tracing before any flight predicts dBm, and calls its channel ``level``."""
    _, folder, scored = said
    frame = pd.read_csv(folder / "prediction.csv").assign(channel="level")
    pd.concat([frame, frame.assign(channel="rank", level_db=np.nan)]).to_csv(folder / "prediction.csv", index=False)
    about = json.loads((folder / "metrics.json").read_text()) | {"series": {"LW1 level": {"unit": "dBm"}}}
    (folder / "metrics.json").write_text(json.dumps(about))
    levels = scored()["levels"]
    assert list(levels) == ["LW1"]
    cards = {channel: entry["cards"][folder.name] for channel, entry in levels["LW1"].items()}
    assert set(cards) == {"USRP1", "USRP2"}
    assert all(card["bias_db"] is None for card in cards.values())
    assert cards["USRP1"]["offset_db"] == pytest.approx(2.0, abs=0.3)


def test_a_neighbour_stands_for_the_rank_of_a_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points as dense as a million over 640 m x 640 m x 30 m, of which 50 000 are ranked."""
    site, rng, count = load_site("lake_wheeler"), np.random.default_rng(0), 4000
    place = np.column_stack([rng.uniform(-25, 25, count), rng.uniform(-175, -125, count), rng.uniform(35, 65, count)])
    targets = Targets(
        kind="points", name="", position_m=place, yaw_deg=np.full(count, 90.0), time_s=np.arange(float(count))
    )
    receivers = predict._receivers([], "lake_wheeler", site)
    ranks = []
    for most in (count, count // 13):
        monkeypatch.setattr(predict, "MOST_RANKED", most)
        ((_, rows, p),) = predict._ranks(targets, receivers, site, lambda *_: None)
        assert rows.tolist() == list(range(count))
        ranks.append(p)
    assert 0.0 < np.abs(ranks[0] - ranks[1]).max() < 0.1
    assert np.mean(ranks[0].argmax(axis=1) != ranks[1].argmax(axis=1)) < 0.05


def test_headings_are_ranked_alike_one_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    site, count = load_site("lake_wheeler"), 40
    place = np.random.default_rng(1).uniform((-300, -300, 30), (300, 300, 60), (count, 3))
    targets = Targets(
        kind="points", name="", position_m=place, yaw_deg=np.full(count, np.nan), time_s=np.arange(float(count))
    )
    receivers, ranks, steps = predict._receivers([], "lake_wheeler", site), [], []
    for most in (count * predict.HEADINGS, count):  # the second leaves no room for all headings at once
        monkeypatch.setattr(predict, "MOST_RANKED", most)
        said: list[str] = []
        ((_, _, p),) = predict._ranks(targets, receivers, site, lambda text, *_, said=said: said.append(text))
        ranks.append(p)
        steps.append(len(said))
    assert steps == [1, predict.HEADINGS]
    np.testing.assert_allclose(*ranks, atol=1e-9)


@pytest.mark.parametrize("levels", [True, False])
def test_predicted_ranks_are_scored_where_they_were_flown(said, levels):
    data, folder, scored = said
    ranked = rank_samples(data, data.rank[0])
    keep = np.isfinite(ranked.rank) & (ranked.rank >= 1)
    place = dict(zip(("east_m", "north_m", "height_m"), ranked.poses.position_m[keep].T, strict=True))
    right = ranked.rank[keep].astype(int)
    p = np.full((len(right), 4), 0.1)
    p[np.arange(len(right)), right - 1] = 0.7
    said_ranks = pd.DataFrame({**place, "yaw_deg": np.nan, "tower": ranked.tower, "channel": "rank",
                               **dict(zip(predict.RANKS, p.T, strict=True))})  # fmt: skip
    table = pd.read_csv(folder / "prediction.csv")
    pd.concat([table if levels else table[:0], said_ranks]).to_csv(folder / "prediction.csv", index=False)
    verdict = scored()
    ranks = verdict["rank"][ranked.tower]
    assert ranks["scores"][folder.name]["kappa"] > 0.9  # at waypoints, a neighbour's rank stands for its own
    assert ranks["log_score"] == pytest.approx(-np.log(0.7), abs=0.1)
    assert ranks["constant_log_score"] > ranks["log_score"]
    assert len(verdict["levels"]) == int(levels)


def test_a_prediction_that_learned_from_the_flight_is_refused(said):
    data, folder, _ = said
    about = json.loads((folder / "metrics.json").read_text())
    (digest,) = (f.sha256 for f in data.files if f.path.endswith("LW1/USRP1_power_log.txt"))
    (folder / "metrics.json").write_text(json.dumps({**about, "trained_on": [digest]}))
    for place in (folder, folder / "prediction.csv"):
        with pytest.raises(UsageError, match="this flight's own log"):
            read_foreign(place, data)


def test_ray_tracing_has_no_score_where_its_antennas_were_learned_from_the_flight(said, flown):
    data, folder, _ = said
    result = flown[1]
    rss = [dataclasses.replace(r, further=dataclasses.replace(r.further, trained_on=("0" * 64,))) for r in result.rss]
    verdict = judge(read_foreign(folder, data), data, dataclasses.replace(result, rss=tuple(rss)))
    series = verdict["levels"]["LW1"]["USRP1"]
    assert "free space" in series["cards"]
    assert not {"ray tracing (this report)"} & {*series["cards"], *series["differences"]}
    assert "Ray tracing has no score there" in verdict["sentence"]
    assert any("Ray tracing has no score on LW1 USRP1: its antennas" in text for text in verdict["remarks"])


def both_channels(folder: Path) -> pd.DataFrame:
    """The prediction of one channel, for two channels."""
    table = pd.read_csv(folder / "prediction.csv")
    (folder / "metrics.json").unlink()
    return pd.concat([table.assign(channel=channel) for channel in ("USRP1", "USRP2")])


def test_means_are_over_the_channels_that_all_models_have(said, flown):
    """Ray tracing learned from one of two channels, so a mean over both channels is not comparable with its score."""
    data, folder, _ = said
    both_channels(folder).to_csv(folder / "prediction.csv", index=False)
    rss = [
        dataclasses.replace(r, further=dataclasses.replace(r.further, trained_on=("0" * 64,)))
        if (r.tower, r.channel) == ("LW1", "USRP1")
        else r
        for r in flown[1].rss
    ]
    verdict = judge(read_foreign(folder, data), data, dataclasses.replace(flown[1], rss=tuple(rss)))
    assert set(verdict["levels"]["LW1"]) == {"USRP1", "USRP2"}
    means, cards = verdict["means"], verdict["levels"]["LW1"]["USRP2"]["cards"]
    assert [row["model"] for row in means] == list(cards)
    assert {row["channels"] for row in means} == {1}
    for row in means:
        assert row["rmse_offset_db"] == cards[row["model"]]["rmse_offset_db"]
    assert f"RMSE {cards[folder.name]['rmse_offset_db']:.1f} dB after one offset" in verdict["sentence"]
    assert "(1 channel)" in verdict["sentence"]
    assert any("The means are over LW1 USRP2 only" in text for text in verdict["remarks"])


def in_dbm(data, result):
    """Return the flight as if its logs were in dBm."""
    rss = tuple(dataclasses.replace(s, unit="dBm") for s in data.rss)
    return dataclasses.replace(data, rss=rss), dataclasses.replace(
        result, rss=tuple(dataclasses.replace(r, unit="dBm") for r in result.rss)
    )


def test_the_band_of_a_path_loss_is_mirrored(said, flown):
    """The lower end of a loss is the upper end of a level."""
    data, result = in_dbm(*flown)
    table = pd.read_csv(said[1] / "prediction.csv")
    (item,) = (r for r in result.rss if (r.tower, r.channel) == ("LW1", "USRP1"))
    loss = next(s.link for s in data.rss if s.tower == "LW1").transmit_power_dbm - table["level_db"]
    table = table.drop(columns=["level_db", "sd_db"])
    table.assign(path_loss_db=loss, q05_db=loss - 1.0, q95_db=loss + 9.0).to_csv(said[1] / "loss.csv", index=False)
    verdict = judge(read_foreign(said[1] / "loss.csv", data), data, result)
    card = verdict["levels"]["LW1"]["USRP1"]["cards"]["loss.csv"]
    # the levels are 2 dB above the measurement, so most measured levels are 1 to 9 dB below the level of the file
    assert card["bias_db"] == pytest.approx(-2.0, abs=0.3)
    assert card["n"] == np.isfinite(item.measured_db[item.posed]).sum()
    assert card["coverage_90"] > 0.9
    assert card["crps_db"] is None


def test_offset_slope_and_floor_of_each_node_of_an_emulator(said, flown):
    """Compare the table of nodes with NumPy: levels of half the slope that end at a floor."""
    data, folder, _ = said
    (item,) = (r for r in flown[1].rss if (r.tower, r.channel) == ("LW1", "USRP1"))
    heard = item.posed & np.isfinite(item.measured_db)
    emulated = np.maximum(0.5 * item.simulated_dbm + 20.0, np.quantile(0.5 * item.simulated_dbm[heard] + 20.0, 0.1))
    time = pd.to_datetime(item.time[heard]).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    pd.DataFrame({"time_utc": time, "tower": "LW1", "channel": "USRP1", "level_db": emulated[heard]}).to_csv(
        folder / "twin.csv", index=False
    )
    given = read_foreign(folder / "twin.csv", data)
    verdict = judge(given, data, flown[1])
    (node,) = verdict["nodes"]
    measured, level = item.measured_db[heard], emulated[heard]
    assert node["series"] == "LW1 USRP1"
    assert node["offset_db"] == pytest.approx(np.mean(level - measured), abs=1e-6)
    assert node["slope"] == pytest.approx(np.polyfit(level, measured, 1)[0], abs=1e-6)
    assert node["floor_db"] == pytest.approx(level.min(), abs=1e-9)
    page = str(referee_card(SimpleNamespace(extra_metrics={"referee": [verdict]})))
    assert "The prediction at each channel" in page
    loss = pd.read_csv(folder / "twin.csv").assign(path_loss_db=data.rss[0].link.transmit_power_dbm - emulated[heard])
    loss.drop(columns="level_db").to_csv(folder / "loss.csv", index=False)
    (lossy,) = judge(read_foreign(folder / "loss.csv", data), data, flown[1])["nodes"]
    assert lossy == pytest.approx(node)  # a loss has the floor of its level
    assert str(node["offset_db"]) in page


def test_a_missing_level_is_an_outage_without_a_common_reference_too(said, flown):
    """The log is in dB re full scale, the prediction in dBm."""
    data, folder, _ = said
    item = flown[1].rss[0]
    level = np.where(np.arange(len(item.time)) % 10, item.simulated_dbm, np.nan)
    times = pd.to_datetime(item.time).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    gaps = pd.DataFrame({"time_utc": times, "tower": item.tower, "channel": item.channel, "level_dbm": level})
    gaps.to_csv(folder / "gaps.csv", index=False)
    cards = judge(read_foreign(folder / "gaps.csv", data), data, flown[1])["levels"][item.tower][item.channel]["cards"]
    heard, reached = np.isfinite(item.measured_db), np.isfinite(level)
    assert cards["gaps.csv"]["outages_invented"] == (item.posed & heard & ~reached).sum() > 50
    assert cards["gaps.csv"]["outages_missed"] == (item.posed & ~heard & reached).sum()
    lowest = cards["gaps.csv"]["exceedance"][0]
    measured = np.where(heard, item.measured_db, -np.inf)[item.posed]
    assert lowest["measured"] == pytest.approx(np.mean(measured >= lowest["threshold_db"]))
    assert cards["free space"]["n"] == cards["gaps.csv"]["n"]


def test_a_channel_with_too_few_predictions_is_named(said, flown):
    data, folder, _ = said
    table = both_channels(folder)
    few = table[(table["channel"] == "USRP1") | (np.arange(len(table)) % 40 == 0)]
    few.assign(east_m=few["east_m"].where(few["channel"] == "USRP1", 9e3)).to_csv(folder / "few.csv", index=False)
    verdict = judge(read_foreign(folder / "few.csv", data), data, flown[1])
    assert list(verdict["levels"]["LW1"]) == ["USRP1"]
    assert any("few.csv: fewer than 20 samples of LW1 USRP2 have both levels" in s for s in verdict["remarks"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.assign(sd_db=0.0), "sd_db of 0 or less"),
        (lambda f: f.assign(sd_db=-3.0), "sd_db of 0 or less"),
        (lambda f: f.rename(columns={"q05_db": "q95_db", "q95_db": "q05_db"}), "q05_db above q95_db.*swapped"),
        (lambda f: f.assign(rank=7), "ranks that are not 0 to 4"),
        (lambda f: f.assign(p_rank1=0.9, p_rank2=0.9, p_rank3=0.0, p_rank4=0.0), "another sum than 1"),
        (lambda f: f.assign(level_db=f["level_db"].map("{:.1f}".format).str.replace(".", ",")), "no level or rank, but"),
        (lambda f: f.assign(level_db=f["level_db"].where(f.index % 9 > 0, -999.0)), "a level of -999 to .*fill value"),
        (lambda f: f.assign(level_db="n/a"), "no level or rank: all cells are empty"),
        (lambda f: f[:0], "no level or rank: all cells are empty"),
        (lambda f: f.assign(tower=np.nan), "towers without names; expected towers of the flight"),
        (lambda f: f.assign(time_utc=1748786400), "times that cannot be read, such as 1748786400; expected ISO 8601 in UTC"),
        (lambda f: f.assign(time_utc="1677-01-01T00:00:00Z"), "times that cannot be read, such as 1677-01-01"),
        (lambda f: f.assign(Tower="LW1"), "several columns of one quantity"),
        (lambda f: f.rename(columns={"height_m": "alt"}), "without a time and without a position .*alt"),
        (lambda f: f.rename(columns={"level_db": "level_dbm"}).assign(level_dbm=61.0), "missing sign"),
    ],
)  # fmt: skip
def test_numbers_that_cannot_be_are_refused(change, words, said):
    data, folder, _ = said
    change(pd.read_csv(folder / "prediction.csv")).to_csv(folder / "bad.csv", index=False)
    with pytest.raises(InputError, match=words):
        read_foreign(folder / "bad.csv", data)


def test_a_table_with_semicolons_names_its_separator(said):
    data, folder, _ = said
    pd.read_csv(folder / "prediction.csv").to_csv(folder / "bad.csv", index=False, sep=";")
    with pytest.raises(InputError, match="a separator that is not a comma"):
        read_foreign(folder / "bad.csv", data)


def test_an_emulator_that_did_not_fly_is_named(said, flown, tmp_path):
    data, result = flown
    shutil.copytree(Path(__file__).parents[1] / "predictions" / "emulator", tmp_path / "twin")
    log = tmp_path / "twin" / "2026-05-22_vehicleOut.txt"
    rows = [line.split(",", 4) for line in log.read_text().splitlines()]
    log.write_text("".join(f"{row[0]},-78.6962747,35.7274823,-0.113,{row[4]}\n" for row in rows))
    with pytest.raises(InputError, match=r"no predicted position is in the air .* an emulated vehicle did not fly"):
        judge(read_foreign(tmp_path / "twin", data), data, result)


def test_the_parts_of_a_lost_lock_replace_the_normal_distribution(said):
    _, folder, scored = said
    before = scored()["levels"]["LW1"]["USRP1"]["cards"][folder.name]["crps_db"]
    table = pd.read_csv(folder / "prediction.csv")
    parts = {"locked_db": table["level_db"], "lost_db": table["level_db"] - 60.0}
    table.assign(p_lock=0.5, **parts, locked_sd_db=3.0, lost_sd_db=3.0).to_csv(folder / "prediction.csv", index=False)
    # half of the probability is 60 dB too low: the score rises by about a quarter of the distance minus half of it
    assert scored()["levels"]["LW1"]["USRP1"]["cards"][folder.name]["crps_db"] == pytest.approx(before + 15.0, abs=2.0)
    # without one of its columns, the distribution is normal
    table.assign(p_lock=0.5, **parts, locked_sd_db=3.0).to_csv(folder / "prediction.csv", index=False)
    assert scored()["levels"]["LW1"]["USRP1"]["cards"][folder.name]["crps_db"] == pytest.approx(before)


def test_a_prediction_that_learned_from_the_flight_refuses_half_of_it(said, prediction):
    """Half of the log has another digest. Its readings match the fingerprints in the prediction."""
    data, folder, _ = said
    halves = [
        dataclasses.replace(s, time=s.time[: len(s.time) // 2], measured_db=s.measured_db[: len(s.time) // 2])
        for s in data.rss
    ]
    data = dataclasses.replace(data, rss=tuple(halves), rank=())
    about = json.loads((folder / "metrics.json").read_text())
    marks = prediction_metrics(prediction.page)["marks"]
    (folder / "metrics.json").write_text(json.dumps({**about, "marks": marks}))
    with pytest.raises(UsageError, match="this flight's own logs"):
        read_foreign(folder, data)


def test_a_prediction_of_another_place_is_no_score(said):
    data, folder, scored = said
    table = pd.read_csv(folder / "prediction.csv")
    table.assign(north_m=table["north_m"] + 5000.0).to_csv(folder / "prediction.csv", index=False)
    with pytest.raises(InputError, match="a prediction of another route") as refused:
        scored()
    assert "within 5 m" in str(refused.value)
    table.assign(channel=np.arange(len(table)) % 2).to_csv(folder / "prediction.csv", index=False)
    with pytest.raises(InputError, match="other names for the channels: 0, 1; the flight has USRP1, USRP2"):
        scored()
    about = json.loads((folder / "metrics.json").read_text())
    for damaged in ({}, {**about, "marks": None}):
        (folder / "metrics.json").write_text(json.dumps(damaged))
        with pytest.raises(InputError, match="cannot be read"):
            read_foreign(folder, data)


def test_a_grid_has_its_heights_one_after_the_other():
    site = load_site("lake_wheeler")
    targets = find_targets(Path("lake_wheeler"), site, TargetOptions(heights_m=(30.0, 50.0), spacing_m=300.0))
    half = len(targets) // 2
    assert half == len(targets.grid)
    assert set(targets.position_m[:half, 2]) == {30.0}
    assert np.isnan(targets.yaw_deg).all()


def test_a_planned_flight_faces_its_course_and_leans_into_it(prediction):
    targets = find_targets(SAMPLE, load_site("lake_wheeler"), TargetOptions())
    east = targets.position_m[:, 0]
    leg = (targets.time_s > 30) & (targets.time_s < 40)
    step = np.diff(targets.position_m[leg][:, :2], axis=0)[0]
    assert targets.yaw_deg[leg][0] == pytest.approx(np.degrees(np.arctan2(step[0], step[1])) % 360.0, abs=1e-6)
    assert east.min() < -375
    seen = prediction.sources["LW1.USRP1"].targets(targets.position_m[leg], targets.yaw_deg[leg], targets.up[leg])
    down = 0.6 * np.linalg.norm(step) * np.ones(leg.sum())  # nose down, as all nine field flights were logged
    leaning = rotation_from_aircraft(0 * down, -down, targets.yaw_deg[leg])
    at_uav = np.einsum("nji,nj->ni", leaning, -seen.at_tower)
    np.testing.assert_allclose(seen.at_uav, at_uav, atol=1e-3)


@pytest.mark.parametrize(("attitude", "leans"), [("logged", True), ("level", False)])
def test_a_flown_route_leans_where_the_settings_take_its_attitude(tmp_path, attitude, leans):
    text = re.sub(r"(?s)  plan:.*?(?=site:)", "", SAMPLE.read_text()).replace("rt: {", f"rt: {{attitude: {attitude}, ")
    (tmp_path / "flown.yaml").write_text(text)
    site = load_site("lake_wheeler")
    up = find_targets(tmp_path / "flown.yaml", site, TargetOptions(), logs_root=SAMPLE.parent).up
    assert (np.degrees(np.arccos(up[:, 2].min())) > 3.0) == leans


def test_corrected_levels_are_brought_to_the_raw_replay_by_the_planted_offset(prediction):
    targets = dataclasses.replace(prediction.targets, heights_m=(30.0,))
    on_grid = dataclasses.replace(prediction, targets=targets)
    (levels,) = predict._map_levels(on_grid, prediction.sources["LW1.USRP1"], len(targets))
    level = rows_of(prediction, "LW1", "USRP1")["level_db"].to_numpy()
    np.testing.assert_allclose((levels.corrected_dbm - level)[[0, 2, 3]], 12.3, atol=0.7)
    raw = trace("lake_wheeler", Link(3.3e9, {"LW1": single_element()}, single_element()), [[-300.0, 150.0, 30.0]])
    assert levels.raw_dbm[0] == pytest.approx(raw.rss_dbm[0, 0], abs=1e-6)
    maps = predict.CorrectedMaps(levels=(levels,), ranks={}, prediction=prediction.page)
    row = Grid(np.arange(len(level), dtype=float), np.zeros(1), 1.0)
    assert [layer.column for layer in maps.layers(row)] == [
        f"rss_{kind}_h030m_LW1_USRP1" for kind in ("corrected", "raw", "sd")
    ]


def rows_of(prediction, tower, channel):
    table = prediction.table
    return table[(table["tower"] == tower) & (table["channel"] == channel)]


@pytest.mark.parametrize("text", ["east_m,north_m,height_m,yaw_deg\n1,2,30,\n1,2,30,90\n",
                                  "lat,lon,alt,yaw_deg\n35.7275,-78.696,30,\n35.7276,-78.696,30,90\n"])  # fmt: skip
def test_a_heading_that_is_given_counts_then_that_of_the_route_else_all(tmp_path, text):
    (tmp_path / "p.csv").write_text(text)
    given, own = (
        find_targets(tmp_path / "p.csv", load_site("lake_wheeler"), TargetOptions(heading_deg=heading)).yaw_deg
        for heading in (200.0, None)
    )
    assert set(given) == {200.0}
    assert np.isnan(own[0])
    assert own[-1] == 90.0


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("-78.696,35.7275,30\n-78.696,35.7285,40\n", "latitude and longitude are swapped"),
        ("35.7275,78.696,30\n35.7285,78.696,40\n", "the sign of the longitude is wrong"),
        ("35.7275,-78.696,30\n35.7285,-78.696,-40\n", "1 of 2 points below the site's ground"),
    ],
)
def test_a_route_that_cannot_be_flown_here_is_a_question(
    rows: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "route.csv").write_text(rows)
    call = ["predict", str(tmp_path / "route.csv"), "--site", "lake_wheeler", "-o", str(tmp_path / "out")]
    assert main(call) == 3
    assert message in capsys.readouterr().err


def test_towers_of_a_table_column_are_those_that_are_predicted(tmp_path: Path) -> None:
    """The flight file does not name a tower, because each row of its log does."""
    rows = [
        f"2025-01-01T12:{i // 60:02}:{i % 60:02}Z,{35.7275 + 1e-5 * i:.6f},-78.696,{min(8 * i, 40)},{tower},{-70 - 0.1 * i:.1f}"
        for i in range(120)
        for tower in ("LW1", "LW3")
    ]
    (tmp_path / "table.csv").write_text("\n".join(["time,latitude,longitude,altitude_m,tower,rsrp_dbm", *rows]))
    flight = tmp_path / "flight.yaml"
    flight.write_text("flight: {name: f}\nsite: {file: lake_wheeler}\nlogs: [{path: table.csv, timezone: UTC}]\n")
    made = predict.predict(flight, [], TargetOptions(carrier_hz=3.3e9))
    assert {source.tower for source in made.sources.values()} == {"LW1", "LW3"}

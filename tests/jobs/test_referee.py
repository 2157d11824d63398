"""Predictions of other programs, scored on the sample flight as ours is."""

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray
import yaml

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import AerpawCmpError
from aerpaw_cmp.flight.data import FlightData, load_data
from aerpaw_cmp.flight.gains import load_with_learned
from aerpaw_cmp.jobs import referee
from aerpaw_cmp.report.flight import prediction_card

PREDICTIONS = Path(__file__).parents[1] / "predictions"
pytestmark = pytest.mark.usefixtures("blank_pictures")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sample flight and the table of its report."""
    place = tmp_path_factory.mktemp("flight")
    assert main(["sample", "-o", str(place / "s"), "-q"]) == 0
    shutil.copyfile(place / "s" / "flight.yaml", place / "s" / "all.yaml")
    plan = yaml.safe_load((place / "s" / "flight.yaml").read_text())
    del plan["flight"]["plan"]
    # two towers and no ranks: each report takes a third of the time
    plan["logs"] = [
        log for log in plan["logs"] if log.get("node") in ("LW1", "LW3", None) and "modem" not in log["path"]
    ]
    (place / "s" / "flight.yaml").write_text(yaml.safe_dump(plan))
    words = ["report", str(place / "s" / "flight.yaml"), "-o", str(place / "r"), "--audit", "none", "-q"]
    assert main(words) == 0
    table = pd.read_csv(place / "r" / "rss.csv")
    table[table["tower"].isin(["LW1", "LW3"])].to_csv(place / "rss.csv", index=False)
    return place


def flight_data(path: Path) -> FlightData:
    return load_data(load_with_learned(path), path.parent)


def ours(flight: Path) -> pd.DataFrame:
    return pd.read_csv(flight / "rss.csv")


def scored(flight: Path, *files: Path, near: str = "5", code: int = 0) -> list[dict]:
    out = flight / "out"
    words = ["report", str(flight / "s" / "flight.yaml"), "-o", str(out), "--audit", "none", "-q", "--force"]
    assert main([*words, "--against-distance", near, *(w for file in files for w in ("--against", str(file)))]) == code
    cards = json.loads((out / "card.json").read_text())
    assert json.loads((out / "metrics.json").read_text())["referee"] == cards
    return cards


def refused(flight: Path, file: Path, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    words = ["report", str(flight / "s" / "flight.yaml"), "-o", str(flight / "no"), "--audit", "none", "-q", "--force"]
    assert main([*words, "--against", str(file)]) == 3
    assert not (flight / "no").exists()
    return " ".join(capsys.readouterr().err.split())


@pytest.fixture(scope="module")
def data(flight: Path) -> FlightData:
    return flight_data(flight / "s" / "flight.yaml")


def unread(file: Path, data: FlightData) -> str:
    """Return the message about a file that the command refuses, without the command, which reads the flight again."""
    with pytest.raises(AerpawCmpError) as caught:
        referee.read_foreign(file, data)
    return " ".join(str(caught.value).split())


@pytest.fixture(scope="module")
def cards(flight: Path) -> dict[str, dict]:
    """The scores of several predictions in one report, by the names of their files."""
    table = ours(flight)
    noise_db = np.random.default_rng(5).normal(0.0, 8.0, len(table))
    noisy = table[["time_utc", "tower", "channel"]].assign(level_db=table["measured_db"] + noise_db, sd_db=8.0)
    first = table.query("tower == 'LW1' and channel == 'USRP1'")
    half = first.iloc[: len(first) // 2]
    half = half[["time_utc", "tower"]].assign(level_dbm=half["simulated_dbm"]).drop_duplicates("time_utc")
    place = first.dropna(subset=["east_m", "simulated_dbm"])
    place = place[["east_m", "north_m"]].assign(height_m=place["up_m"], level_dbm=place["simulated_dbm"])
    place = place.drop_duplicates(["east_m", "north_m", "height_m"])
    # a climb passes the height of the cruise in feet, so that some samples have a prediction by chance
    feet = place.assign(tower="LW1", height_m=place["height_m"] / 0.3048)
    above = place.assign(tower="LW1", height_m=place["height_m"] + 12.0)
    emulated = table[table["channel"] == "USRP1"].rename(columns={"up_m": "height_m"})
    floored = emulated[["east_m", "north_m", "height_m", "tower"]].assign(
        level_db=np.maximum(0.5 * emulated["simulated_dbm"] - 10.0, -45.0)
    )
    files = {
        "noisy.csv": noisy, "half.csv": half, "feet.csv": pd.concat([feet, feet.assign(tower="LW9")]),
        "above.csv": above, "floored.csv": floored.drop_duplicates(["east_m", "north_m", "height_m", "tower"]),
    }  # fmt: skip
    for name, frame in files.items():
        frame.to_csv(flight / name, index=False)
    words = ["--link", "USRP2", "--step", "0.5", "-q"]
    assert main(["channel", str(flight / "s" / "flight.yaml"), "-o", str(flight / "h"), *words]) == 0
    # the twin is the sample flown again by the simulator: its noise differs, its offsets and floors do not
    plan = flight / "s" / "twin.yaml"
    plan.write_text((flight / "s" / "all.yaml").read_text().replace("seed: 7", "seed: 8"))
    assert main(["simulate", str(plan), "-o", str(flight / "twin"), "-q"]) == 0
    made = scored(flight, *map(flight.joinpath, files), flight / "h" / "channel.nc", flight / "twin")
    return {card["prediction"]: card for card in made}


def test_a_copy_of_our_levels_in_three_formats_scores_as_ours_do(flight: Path) -> None:
    table = ours(flight)
    by_time = table[["time_utc", "tower", "channel"]].assign(level_dbm=table["simulated_dbm"])
    by_time.to_csv(flight / "matlab.csv", index=False)
    place = table[["east_m", "north_m", "up_m", "tower"]].rename(columns={"up_m": "height_m"})
    loss = place.assign(path_loss_db=30.0 - table["simulated_dbm"]).dropna()
    loss.drop_duplicates(["east_m", "north_m", "height_m", "tower"]).to_csv(flight / "loss.csv", index=False)
    wide = by_time[by_time["channel"] == "USRP1"].pivot(index="time_utc", columns="tower", values="level_dbm")
    times = pd.to_datetime(wide.index.to_numpy()).tz_localize(None)
    for clock, letters in (("time", {"dtype": "S1"}), ("time_utc", {})):  # rows of characters, or texts
        axes = {clock: times, "tower": wide.columns}
        given = xarray.Dataset({"level_dbm": ((clock, "tower"), wide.to_numpy())}, axes)
        given.to_netcdf(flight / f"{clock}.nc", encoding={"tower": letters})
    names = ["matlab.csv", "loss.csv", "time.nc", "time_utc.nc"]
    cards = scored(flight, *(flight / name for name in names), near="0.01")
    assert [card["prediction"] for card in cards] == names
    for card in cards:
        assert set(card["levels"]) == {"LW1", "LW3"}
        for channels in card["levels"].values():
            for entry in channels.values():
                theirs, mine = entry["cards"][card["prediction"]], entry["cards"]["ray tracing (this report)"]
                assert theirs["n"] > 300
                assert theirs["rmse_offset_db"] == pytest.approx(mine["rmse_offset_db"], abs=0.15)
                assert entry["differences"]["ray tracing (this report)"]["verdict"] != "worse"
    page = (flight / "out" / "report.html").read_text()
    assert all(f"{card['prediction']}: RMSE" in page for card in cards)
    assert cards[0]["fitted_on_this_flight"] == ["the offset of each model and channel"]


def test_noise_is_significantly_worse_and_its_band_covers(cards: dict[str, dict]) -> None:
    entry = cards["noisy.csv"]["levels"]["LW1"]["USRP1"]
    score = entry["cards"]["noisy.csv"]
    assert score["rmse_db"] == pytest.approx(8.0, abs=0.8)
    assert score["coverage_90"] == pytest.approx(0.9, abs=0.04)
    assert score["crps_db"] == pytest.approx(8.0 / np.sqrt(np.pi), rel=0.12)
    assert entry["differences"]["ray tracing (this report)"]["verdict"] == "worse"
    assert "significantly worse" in cards["noisy.csv"]["sentence"]


def test_half_a_route_is_counted_as_unmatched(cards: dict[str, dict]) -> None:
    entry = cards["half.csv"]["levels"]["LW1"]["USRP1"]
    assert entry["unmatched"] > 0.2 * entry["matched"]
    assert "at other times have none" in cards["half.csv"]["sentence"]


def test_a_refused_file_does_not_prevent_the_score_of_another(flight: Path, cards: dict[str, dict]) -> None:
    half = pd.read_csv(flight / "half.csv")
    half.assign(level_dbm=1e-9).to_csv(flight / "watt.csv", index=False)
    half.assign(time_utc="2031" + half["time_utc"].str[4:]).to_csv(flight / "late.csv", index=False)
    (card,) = scored(flight, *(flight / f"{name}.csv" for name in ("watt", "late", "half")), code=1)
    assert card == cards["half.csv"]
    metrics = json.loads((flight / "out" / "metrics.json").read_text())
    linear, late = metrics["referee_refused"]
    assert "watt.csv: a median level_dbm of 1e-09" in linear
    assert "late.csv: fewer than 20 samples" in late
    assert {linear, late} < set(metrics["warnings"])


def test_files_in_the_manner_of_three_programs_are_scored(flight: Path) -> None:
    """A table of MATLAB, a radio map of Sionna RT and the logs of an emulator, with invented numbers."""
    names = "matlab_sigstrength.csv", "sionna_radio_map.npz", "emulator"
    matlab, sionna, emulator = scored(flight, *(PREDICTIONS / name for name in names), near="12")
    assert [card["prediction"] for card in (matlab, sionna, emulator)] == list(names)
    for card in (matlab, sionna):
        assert set(card["levels"]) == {"LW1", "LW3"}
        entry = card["levels"]["LW1"]["USRP1"]
        assert entry["matched"] >= 100
        assert entry["unmatched"] > 0
        # free space and 2 dB of noise: a little worse than free space itself
        free_space = entry["cards"]["free space"]["rmse_offset_db"]
        assert free_space < entry["cards"][card["prediction"]]["rmse_offset_db"] < free_space + 2.0
        assert entry["cards"][card["prediction"]]["bias_db"] is None
    assert set(emulator["levels"]) == {"LW1"}
    assert [card["remarks"][-1] for card in (matlab, emulator)] == [
        "No bias is stated, because levels and log have no common reference "
        f"({name}; log: dB re full scale)." for name in ("matlab_sigstrength.csv: level_dbm", "emulator: dB")
    ]  # fmt: skip
    node = emulator["levels"]["LW1"]["USRP1"]["cards"]["emulator"]
    assert node["bias_db"] is None
    assert 0.3 < node["slope"] < 1.3  # 24 dB per decade were written, the sample falls by about 20
    page = (flight / "out" / "report.html").read_text()
    assert "Share of samples at or above a threshold" in page


def test_heights_in_feet_and_unknown_towers_are_named_beside_the_score(cards: dict[str, dict]) -> None:
    assert cards["feet.csv"]["remarks"][1:] == [
        "feet.csv: the flight has no log of LW9; not scored.",
        "feet.csv: most samples have no prediction. Likely cause: heights in feet.",
    ]
    _, remark = cards["above.csv"]["remarks"]
    assert "another height datum: the predicted positions are 12 m above the flight" in remark


def test_the_channel_of_the_flight_scores_as_the_replay_with_its_transmit_power(cards: dict[str, dict]) -> None:
    """Learned antennas of the site are not part of the channel: their level_db has another unit for each tower."""
    card = cards["channel.nc"]
    assert card["remarks"][0] == "The levels of channel.nc are those of H, with 40 dBm transmitted."
    scores = card["levels"]["LW3"]["USRP2"]["cards"]
    replayed = scores["ray tracing (this report)"]
    for key in ("offset_db", "rmse_offset_db"):
        assert scores["channel.nc"][key] == pytest.approx(replayed[key], abs=0.15)


def test_a_prediction_of_two_ranks_has_no_others(flight: Path) -> None:
    """The variables of a NetCDF file have any case, and so has their unit."""
    data = flight_data(flight / "s" / "all.yaml")
    times = pd.to_datetime(ours(flight)["time_utc"]).drop_duplicates().dt.tz_localize(None).to_numpy()
    dims, chance = ("step",), np.full(len(times), 0.5)
    variables = {"TIME": (dims, times), "TOWER": "LW1", "P_RANK1": (dims, chance), "P_RANK2": (dims, chance)}
    xarray.Dataset(variables).to_netcdf(flight / "two.nc")
    given = referee.read_foreign(flight / "two.nc", data)
    assert given.timed
    assert given.table.filter(like="p_rank").drop_duplicates().values.tolist() == [[0.5, 0.5, 0.0, 0.0]]


def test_levels_of_a_twin_have_offset_slope_and_floor(cards: dict[str, dict]) -> None:
    levels = cards["floored.csv"]["levels"]
    assert levels["LW3"]["USRP1"]["floor_db"] == -45.0
    assert levels["LW1"]["USRP1"]["cards"]["floored.csv"]["slope"] > 1.5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.assign(tower="BS1"), "towers BS1; expected towers of the flight: LW1"),
        (lambda f: f.assign(level_dbm=np.nan), "no level or rank: all cells are empty"),
        (lambda f: f.assign(level_dbm="weak").iloc[1:], "no level or rank, but weak"),
        (lambda f: f.rename(columns={"level_dbm": "rss"}), "'rss' has another unit, or no unit in its name"),
        (lambda f: f.rename(columns={"level_dbm": "level_w"}), "'level_w' has another unit, or no unit in its name"),
        (lambda f: f.assign(level_dbm=10 ** (f["level_dbm"] / 10)), "watts or milliwatts"),
        (lambda f: f.assign(time_utc=f["time_utc"].str.replace("T14", "T18")), "another time zone, +4 h"),
        (lambda f: f.rename(columns={"time_utc": "time"}).assign(time="2025-06-01 14:00:00"), "times without a zone"),
        (lambda f: pd.concat([f, f.assign(level_dbm=-50.0)]), "with several levels at one time"),
        (lambda f: f.assign(p_rank1=40.0, p_rank2=60.0), "Likely cause: percent, or counts of samples"),
        (lambda f: f.drop(columns="tower"), "no column tower"),
        (lambda f: f.drop(columns="time_utc"), "Likely cause: other names of columns, or no values"),
        (
            lambda f: f.drop(columns="time_utc").assign(latitude_deg=-78.696, longitude_deg=35.7275, height_m=30.0),
            "latitude and longitude are swapped",
        ),
        (
            lambda f: f.drop(columns="time_utc").assign(east_m=708000.0, north_m=3955000.0, height_m=30.0),
            "map coordinates (UTM)",
        ),
        (lambda f: f.rename(columns={"level_dbm": "path_loss_db"}), "a path gain; its negative is the loss"),
        (lambda f: f.assign(level_db=10 ** (f.pop("level_dbm") / 10)), "a linear gain or power in watts"),
        (lambda f: f.assign(sd_db=np.where(np.arange(len(f)) % 2, 6.0, np.nan)), "levels with and without sd_db"),
        (
            lambda f: f[["time_utc", "tower"]].assign(p_rank1=-0.2, p_rank2=1.2),
            "p_rank1 to p_rank4 below 0, or with another sum than 1",
        ),
        (
            lambda f: f.assign(time_utc=f["time_utc"].where(f.index % 2 > 0, "01-Jun-2025 14:00:00")),
            "times that cannot be read, such as 01-Jun-2025",
        ),
        (
            # a part of the route
            lambda f, p: f.join(p.add([0.0, 0.0, 95.0])).drop(columns="time_utc").drop_duplicates(p.columns).head(130),
            "another height datum: the predicted positions are 95 m above the flight",
        ),
    ],
)  # fmt: skip
def test_a_prediction_that_cannot_be_scored_is_one_message(
    change, words: str, flight: Path, data: FlightData, capsys: pytest.CaptureFixture[str]
) -> None:
    table = ours(flight).query("channel == 'USRP1' and tower == 'LW1'").dropna(subset=["east_m", "simulated_dbm"])
    place = table[["east_m", "north_m"]].assign(height_m=table["up_m"])
    frame = table[["time_utc", "tower"]].assign(level_dbm=table["simulated_dbm"])
    change(frame, *([place] if change.__code__.co_argcount > 1 else [])).to_csv(flight / "bad.csv", index=False)
    # times and heights are compared with those of the scored samples
    late = words.startswith("another")
    assert words in (refused(flight, flight / "bad.csv", capsys) if late else unread(flight / "bad.csv", data))


def test_damaged_files_are_one_message(flight: Path, data: FlightData, capsys: pytest.CaptureFixture[str]) -> None:
    for name, content in (
        ("empty.csv", b""), ("cut.nc", b"\x89HDF\r\n\x1a\n" + b"\0" * 60), ("old.nc", b"CDF\x01" + b"\0" * 60),
        ("zip.npz", b"PK\x03\x04" + b"\0" * 30), ("words.csv", b"\xff\xfe\0\0"),
    ):  # fmt: skip
        (flight / name).write_bytes(content)
        assert name in unread(flight / name, data)
    said = refused(flight, flight / "empty.csv", capsys)
    assert "Next: correct empty.csv (docs/referee.md lists the columns) and run the same command" in said
    assert "gone.csv" in unread(flight / "gone.csv", data)
    (flight / "empty").mkdir()
    assert "the folder contains no log that a reader recognises" in unread(flight / "empty", data)
    centre = np.zeros((2, 2, 3))
    np.savez(flight / "db.npz", path_gain=np.full((1, 2, 2), -90.0), cell_centers=centre, tx_names=np.array(["LW1"]))
    assert "a path_gain below 0; expected a linear gain, 0 or more" in unread(flight / "db.npz", data)
    with zipfile.ZipFile(flight / "sheet.xlsx", "w") as book:
        book.writestr("xl/workbook.xml", "<workbook/>")
    assert "an Excel workbook; save the sheet as CSV" in unread(flight / "sheet.xlsx", data)
    xarray.Dataset({"rss": ("time", np.zeros(3)), "tower": "LW1"}).to_netcdf(flight / "rss.nc")
    assert "(columns: time, rss, tower)" in unread(flight / "rss.nc", data)


def test_a_prediction_with_too_many_rows_is_refused_in_every_format(
    flight: Path, data: FlightData, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Short rows of 250 MB took 3.4 GB of memory: a limit of the bytes alone bounds nothing."""
    monkeypatch.setattr(referee, "_MOST_ROWS", 30)
    rows = "".join(f"{k},0,30,LW1,-60\n" for k in range(31))
    (flight / "many.csv").write_text("east_m,north_m,height_m,tower,level_dbm\n" + rows + "this row is not read\n")
    centre = np.zeros((4, 8, 3))
    np.savez(flight / "many.npz", path_gain=np.ones((1, 4, 8)), cell_centers=centre, tx_names=np.array(["LW1"]))
    cells = {"east_m": ("cell", np.zeros(31)), "north_m": ("cell", np.zeros(31)), "height_m": ("cell", np.zeros(31))}
    xarray.Dataset({**cells, "level_dbm": ("cell", np.zeros(31)), "tower": ("cell", ["LW1"] * 31)}).to_netcdf(
        flight / "many.nc"
    )
    for name in ("many.csv", "many.npz", "many.nc"):
        assert "more than 30 rows" in unread(flight / name, data)


def test_the_logs_of_an_emulated_flight_are_a_prediction(cards: dict[str, dict]) -> None:
    score = cards["twin"]["levels"]["LW1"]["USRP1"]["cards"]["twin"]
    assert score["slope"] == pytest.approx(1.0, abs=0.15)
    assert score["n"] > 300


def test_the_folder_of_the_flight_itself_is_no_prediction(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "logs of the scored flight itself" in refused(flight, flight / "s", capsys)


def test_the_page_states_the_log_score_of_predicted_ranks_beside_their_own_row() -> None:
    score = {"kappa": 0.2, "total_variation": 0.1, "agreement": 0.5}
    ranks = {"matched": 30, "log_score": 1.25, "constant_log_score": 1.5}
    scores = {"ours.csv": score, "ray tracing, K = 10": score}
    card = prediction_card({
        "prediction": "ours.csv", "sentence": "", "remarks": [], "means": [], "levels": {}, "nodes": [],
        "rank": {"LW1": {**ranks, "scores": scores}},
    })  # fmt: skip
    (table,) = (table for table in card.tables if table.rows)
    assert list(table.columns)[-2:] == ["Log score", "Log score of the mean"]
    assert [row[-2:] for row in table.rows] == [(1.25, 1.5), (None, None)]

"""The calibrate command on simulated flights: planted antennas come back, replay in a report, refusals."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import yaml

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.yamlfile import dump_yaml
from aerpaw_cmp.compare.calibration import BASELINES, SPLITS, mean_rmse
from aerpaw_cmp.compare.gains import NO_SPREAD
from aerpaw_cmp.flight.settings import ArraySettings, FlightFile, LinkSettings, joined
from aerpaw_cmp.jobs import calibrate as job
from aerpaw_cmp.jobs.calibrate import load_calibration, observe, read_flights, recipe_of
from aerpaw_cmp.jobs.calibration_files import learned_settings
from aerpaw_cmp.jobs.options import RunOptions
from aerpaw_cmp.jobs.run import calibrate_command, run_calibrate
from aerpaw_cmp.site.antennas import TR38901
from aerpaw_cmp.site.learned import read_sphere_csv
from tests.jobs.calibrated import YAW_DEG, calibrated, past_sector_antenna, settings
from tests.json_page import unlisted
from tests.real_logs import REAL
from tests.simulated import write_yaml

pytestmark = pytest.mark.usefixtures("few_pictures")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = past_sector_antenna(tmp_path_factory.mktemp("calibrate"))
    write_yaml(place / "aside_calibration.yaml", {"calibration": "aside", "flights": ["aside.yaml"]})
    return place


@pytest.fixture(scope="module")
def shares() -> list[float]:
    """Shares of the scores that the progress bar has shown."""
    return []


@pytest.fixture(scope="module")
def metrics(folder: Path, shares: list[float]) -> dict:
    def progress(text: str, fraction: float | None = None, /) -> None:
        if text == "scores" and fraction is not None:
            shares.append(fraction)

    out = folder / "calibrated.yaml"
    run_calibrate(folder / "calibration.yaml", RunOptions(out=out, progress=progress))
    return json.loads((folder / "calibrated" / "metrics.json").read_text())


def test_the_progress_of_the_scores_rises_to_one(metrics: dict, shares: list[float]) -> None:
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    assert len(shares) > 5


def test_scores_are_those_of_what_was_left_out(metrics: dict) -> None:
    assert unlisted("calibrate", metrics) == []
    assert {r["flight"] for r in metrics["scores"]["flight_left_out"]} == {"first", "second"}
    assert metrics["scores"]["campaign_left_out"] == []  # there is one
    assert metrics["strengths"]["model"]["campaigns"] == []  # its scales are those of the model
    for split in set(SPLITS) - {"campaign_left_out"}:
        assert len(metrics["scores"][split]) == 2, split
        for row in metrics["scores"][split]:
            assert set(row) >= {"flight", "tower", "channel", "rmse_db", "rmse_4s_db", *BASELINES, "n"}
            assert min(row[name] for name in BASELINES) > 0.0
    for row in metrics["scores"]["flight_left_out"]:
        assert row["rmse_db"] < 0.6 * row["free_space_rmse_db"]
        assert 0.8 < row["inside_90"] <= row["inside_95"]
        assert row["rmse_shared_offset_db"] >= row["rmse_db"]  # the flight's own offset is the best one
    assert len(metrics["words"]) >= 3
    assert metrics["stages"]["fit_s"] > 0


def test_flight_files_by_themselves_are_learned_from_as_a_list_of_them_is(folder: Path) -> None:
    listed = load_calibration(folder / "calibration.yaml")
    typed = load_calibration(folder / "first.yaml", [folder / "second.yaml"])
    assert typed.calibration == "first"
    assert [Path(name).name for name in typed.flights] == listed.flights
    assert main(["calibrate", *(str(folder / name) for name in listed.flights), "--dry-run"]) == 0
    again = calibrate_command(Path("May 1/flight.yaml"), [Path("2/flight.yaml")], "s.yaml")
    assert again == 'aerpaw-cmp calibrate "May 1/flight.yaml" 2/flight.yaml --into-site s.yaml'


def test_the_planted_antenna_is_in_the_file(folder: Path, metrics: dict) -> None:
    """In the directions of the flights, the file is the sector antenna at its yaw within its standard deviation."""
    learned = read_sphere_csv(folder / "calibrated" / "LW1.USRP1.tower.csv")
    azimuth = np.radians(np.arange(0.0, 360.0, 10.0))
    theta = np.full(len(azimuth), np.radians(82.0))
    e_theta, _ = TR38901().field(theta, azimuth - np.radians(YAW_DEG))
    error = learned.gain_dbi(theta, azimuth) - 20 * np.log10(np.abs(e_theta))
    sd = learned.gain_sd_db(theta, azimuth)
    looked = sd < np.median(sd)
    error -= error[looked].mean()
    assert np.mean(np.abs(error[looked]) < 2 * sd[looked]) >= 0.9
    assert (folder / "calibrated" / "LW1.USRP1.tower.msi").read_text().startswith("NAME LW1.USRP1.tower")


def test_a_flight_kept_aside_replays_with_the_learned_antennas(folder: Path, metrics: dict) -> None:
    del metrics
    learned = yaml.safe_load((folder / "calibrated.yaml").read_text())
    path = write_yaml(folder / "aside_learned.yaml", settings("aside", {"model": "iso"}, link=learned["link"]))
    rmse = {}
    for name, file in (("iso", folder / "aside.yaml"), ("learned", path)):
        out = folder / f"report_{name}"
        assert main(["report", str(file), "-o", str(out), "--audit", "none", "--figures", "none"]) == 0
        channel = json.loads((out / "metrics.json").read_text())["rss"]["LW1"]["USRP1"]
        rmse[name] = channel["rmse_db"]
        table = pd.read_csv(out / "rss.csv")
        assert ("simulated_sd_db" in table) == (name == "learned")
        assert (channel.get("simulated_sd_db") is None) == (name == "iso")
    assert rmse["learned"] < 0.6 * rmse["iso"]
    parts = [table[f"{name}_sd_db"] for name in ("gain", "own", "noise", "fading")]
    known = table.dropna(subset=["simulated_sd_db"])
    assert len(known) > 100
    assert (min(part.min() for part in parts)) > 0
    np.testing.assert_allclose(known["simulated_sd_db"] ** 2, sum(part[known.index] ** 2 for part in parts), atol=1e-2)
    bars = channel["error_bars"]
    scored = known.dropna(subset=["residual_db"])
    half = (scored["simulated_high_dbm"] - scored["simulated_low_dbm"]) / 2
    assert bars["inside_90"] == pytest.approx(np.mean(scored["residual_db"].abs() < half), abs=0.01)


def test_a_report_has_the_level_of_the_fit_itself(folder: Path, metrics: dict) -> None:
    """Antenna files, the gain towards both ends in their comments, and the replay against the fit along the flight."""
    del metrics
    report = pd.read_csv(folder / "report_learned" / "rss.csv")
    calibration, _ = calibrated(folder / "calibration.yaml")
    (aside,) = observe(read_flights(load_calibration(folder / "aside_calibration.yaml"), folder, None)[0])[0]
    gain, sd = calibration.learned.predict(aside.samples)
    level = report.dropna(subset=["residual_db"])
    assert len(level) == len(gain) > 100
    difference = level["simulated_dbm"].to_numpy() - (gain + aside.free_space_db)
    assert difference.std() < 0.15
    pair = calibration.learned.fit.predict(aside.samples, ("pair",))[0]
    assert (difference - pair).std() > difference.std()
    assert np.median(np.abs(level["gain_sd_db"].to_numpy() / sd - 1.0)) < 0.1


def refusal(folder: Path, capsys: pytest.CaptureFixture[str], content: dict, code: int = 2) -> str:
    path = write_yaml(folder / "bad.yaml", content)
    assert main(["calibrate", str(path), "-o", str(folder / "bad_out.yaml")]) == code
    text = capsys.readouterr().err
    assert "Traceback" not in text
    assert not (folder / "bad_out.yaml").exists()
    return text


def test_bad_input_is_one_message(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = {"calibration": "bad", "flights": ["first.yaml", "second.yaml"]}
    assert "'fligths'" in refusal(folder, capsys, {"calibration": "bad", "fligths": ["first.yaml"]})
    assert "named twice" in refusal(folder, capsys, base | {"flights": ["first.yaml", "first.yaml"]})
    other = settings("second", {"model": "iso"})
    other["logs"][1]["channel"] = "USRP2"
    write_yaml(folder / "other.yaml", other)
    assert "share no tower and channel" in refusal(folder, capsys, base | {"flights": ["first.yaml", "other.yaml"]})
    high = settings("second", {"model": "iso"})
    high["link"]["rss"]["carrier_hz"] = 3.7e9
    write_yaml(folder / "high.yaml", high)
    carriers = "at 3.3 GHz (first) and 3.7 GHz (second); "
    assert carriers in refusal(folder, capsys, base | {"flights": ["first.yaml", "high.yaml"]})
    assert main(["calibrate", *(str(folder / f"{name}.yaml") for name in ("first", "high"))]) == 2
    assert "Next: fix the flight files and run the same command" in capsys.readouterr().err
    assert "gone.yaml" in refusal(folder, capsys, base | {"flights": ["first.yaml", "gone.yaml"]}, 3)


def test_a_misspelt_site_gets_no_memory(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It got one of its own, which no report reads, after the whole fit."""
    calibration = str(folder / "calibration.yaml")
    for name in ("my_sit.yaml", "no_folder/site.yaml"):
        arguments = ["calibrate", calibration, "--into-site", str(folder / name), "-o", str(folder / "unwritten.yaml")]
        assert main(arguments) in (2, 3)
        assert name in capsys.readouterr().err
    assert not list(folder.glob("*sit.learned"))
    assert not (folder / "unwritten.yaml").exists()


def test_one_flight_is_learned_and_not_scored(folder: Path) -> None:
    path = write_yaml(folder / "single.yaml", {"calibration": "single", "flights": ["first.yaml"]})
    calibration, _ = calibrated(path)
    assert not any(calibration.scores.values())
    assert any("only one flight" in text for text in calibration.warnings)


@pytest.mark.field
def test_dataset12_each_way(tmp_path: Path) -> None:
    """Learn everything except the offset from the other flight: RMSE 3.53 dB, free space 6.37 dB."""
    from aerpaw_cmp.compare import calibration
    from aerpaw_cmp.jobs.calibrate import load_calibration, observe, read_flights

    flights = [str(Path(__file__).parents[1] / "field" / f"dataset12_{h}m.yaml") for h in (40, 70)]
    grid = {"model": "gain_grid", "file": "antennas/rad_pat.mat"}
    patterns = {"uav": grid | {"variable": "SA3300"}, "tower": grid | {"variable": "RMWB3300_normal"}}
    path = write_yaml(tmp_path / "c.yaml", {"calibration": "d12", "flights": flights, "patterns": patterns})
    stated = load_calibration(path)
    flown, *_ = read_flights(stated, tmp_path, REAL)
    observed, _ = observe(flown)
    scores = calibration.flight_left_out(observed, recipe_of(stated, observed, REAL))
    assert mean_rmse(scores) < 3.75
    assert mean_rmse(scores, "rmse_4s_db") < 3.0
    assert mean_rmse(scores, "free_space_rmse_db") == pytest.approx(6.37, abs=0.05)


def test_towers_with_one_channel_keep_their_own_antennas(tmp_path: Path) -> None:
    """Use the SNR of four towers in one log.

    Each tower has an entry, and a channel with a single tower has one antenna for all.
    """
    antennas = ("LW1.snr", "LW2.snr", "LW1.A")
    series = SimpleNamespace(link=LinkSettings(carrier_hz=3.3e9))
    calibration = SimpleNamespace(
        fit=SimpleNamespace(antennas=antennas), first_series=lambda _: (None, series), pair_term=None,
        learned=SimpleNamespace(spread=lambda _: NO_SPREAD),
    )  # fmt: skip
    files = {f"{antenna}.{end}.csv": f"{antenna} {end}" for antenna in antennas for end in ("uav", "tower")}
    learned = tmp_path / "calibrated.yaml"
    learned.write_text(dump_yaml(learned_settings(calibration, "calibrated", files, "aerpaw-cmp calibrate c.yaml")))
    flight = FlightFile.model_validate({"flight": "f", "logs": []})
    channels = joined(flight, learned).link.channels

    def file(array: ArraySettings) -> str:
        return Path(str(array.antenna.file)).name

    assert {name: file(array) for name, array in channels["snr"].towers.items()} == {
        "LW1": "LW1.snr.tower.csv", "LW2": "LW2.snr.tower.csv"
    }  # fmt: skip
    assert file(channels["A"].tower) == "LW1.A.tower.csv"


def test_a_scored_flight_past_an_antenna_of_no_training_flight_is_a_remark(monkeypatch: pytest.MonkeyPatch) -> None:
    def series(antenna: str) -> SimpleNamespace:
        return SimpleNamespace(samples=SimpleNamespace(flight="new", antenna=antenna))

    known, other = series("LW1"), series("LW2")
    monkeypatch.setattr(job, "counted_once", lambda flights: (flights, []))
    monkeypatch.setattr(job, "observe", lambda flights: (flights[0], []))
    monkeypatch.setattr(job.calibration, "score_with", lambda _learned, scored, _observed: tuple(scored))
    scores, remarks = job._score_further([[known, other]], [], None, [series("LW1")])
    assert (scores, remarks) == ((known,), ["new: nothing was learned about LW2"])

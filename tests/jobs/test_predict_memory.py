"""Prediction from the learned models of a site: known tables, and a flight that is not named, with a known offset."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.compare.gains import Spread, offset_sd_db
from aerpaw_cmp.jobs import predict
from aerpaw_cmp.jobs.sources import Stored, TargetOptions, named_flights
from aerpaw_cmp.site.learned import (
    Entry,
    Errors,
    LearnedLevel,
    LearnedLock,
    LearnedSpread,
    folder_of,
    read_learned,
    sphere_csv,
    store_entry,
)
from aerpaw_cmp.site.siteyaml import load_site
from tests.jobs.calibrated import OFFSET_DB, past_sector_antenna
from tests.learned_entries import learned_entry, learned_series, learned_tables

pytestmark = pytest.mark.usefixtures("few_pictures")

SPREAD = Spread(own_sd_db=1.0, noise_sd_db=2.0, fading_sd_db=3.0, fading_kurtosis=0.0, bin_s=4.0)
MARK = "3497f" + "07e7" * 40
LEVEL = LearnedLevel(offset_db=-7.0, sd_db=1.5, transmit_power_dbm=30.0, unit="dBm")


def table(gain_db: float, sd_db: tuple[float, float], note: str = "") -> bytes:
    """Return a gain of ``gain_db`` times the cosine of the azimuth.

    ``sd_db`` contains the standard deviations in front of the antenna and behind it.
    """
    azimuth = np.radians(np.arange(0.0, 360.0, 5.0))
    ahead = np.cos(azimuth) >= 0
    sd = np.broadcast_to(np.where(ahead, *sd_db), (37, 72))
    return sphere_csv(np.broadcast_to(gain_db * np.cos(azimuth) - 1.0, (37, 72)), sd, (note,) if note else ()).encode()


def copied(folder: Path) -> Path:
    """The packaged site without its memory."""
    packaged = Path(str(folder_of("lake_wheeler"))).with_suffix(".yaml")
    place = folder / "mine.yaml"
    place.write_bytes(packaged.read_bytes())
    return place


def entry(level: LearnedLevel | None, lock: LearnedLock | None = None) -> Entry:
    errors = Errors(series=2, rmse_db=3.7, rmse_4s_db=3.0, free_space_rmse_db=6.1, inside_90=0.9)
    series = learned_series("A", sd_db=1.0, level=level, lock=lock, spread=LearnedSpread(**asdict(SPREAD)))
    return learned_entry(series, errors=errors)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a site with one learned channel at LW1: cosines of 4 dB and 2 dB at its ends."""
    place = copied(tmp_path_factory.mktemp("memory"))
    files = learned_tables("A", t=table(4.0, (1.0, 5.0)), u=table(2.0, (0.5, 0.5), f"marks: {MARK}"))
    store_entry(place, "planted", entry(LEVEL), files)
    tower = load_site("lake_wheeler").towers["LW1"].position_m
    ends = (300.0, 90.0), (300.0, 270.0), (-300.0, 90.0), (9000.0, 90.0)
    rows = [(tower[0] + away, tower[1], tower[2], yaw) for away, yaw in ends]
    pd.DataFrame(rows, columns=["east_m", "north_m", "height_m", "yaw_deg"]).to_csv(place.parent / "p.csv", index=False)
    return place


def test_levels_are_free_space_and_the_remembered_gains(site: Path) -> None:
    said = predict.predict(site.parent / "p.csv", [], TargetOptions(site=str(site)))
    levels = said.table[said.table["channel"] == "A"][:3]
    assert list(said.table["flag"]) == ["", "", "outside_flown", "outside_flown"]  # behind the tower, and off the site
    free = 30.0 - 20 * np.log10(4 * np.pi * 300.0 * 3.3e9 / 299_792_458.0)
    # the tower sees the UAV in the east, east and west; the nose points away from the tower, at it, and at it
    expected = free - 7.0 - 2 * 1.0 + np.array([4.0 - 2.0, 4.0 + 2.0, -4.0 + 2.0])
    np.testing.assert_allclose(levels["level_db"], expected, atol=0.02)
    near, far = (1.0**2 + 0.5**2), (5.0**2 + 0.5**2)
    slow = np.sqrt(np.array([near, near, far]) + 1.0**2 + 2.0**2 + 1.5**2)
    np.testing.assert_allclose(levels["slow_sd_db"], slow, atol=0.01)
    np.testing.assert_allclose(levels["sd_db"], np.hypot(slow, 3.0), atol=0.01)
    assert said.page.trained_on == ("a" * 64,)
    assert said.page.marks == (MARK,)  # report --against knows a copy of the training log by them
    assert any("expect an RMSE of 3.7 dB on another flight, free space 6.1 dB" in text for text in said.page.notes)
    assert said.page.verdict.startswith(f"Expect an RMSE of {np.sqrt(np.mean(said.table['slow_sd_db'] ** 2)):.1f} dB")
    assert said.page.units == {"LW1 A": "dBm"}


def test_a_receiver_that_loses_its_lock_is_forecast_in_two_parts(site: Path, tmp_path: Path) -> None:
    """Draw each sample as locked or not, and its level about the line of that part.

    The offset of the flight is unknown.
    """
    lock = LearnedLock(
        gain_db=-92.0, per_db=0.4, share=0.7, locked_db=-70.0, locked_per_db=0.8, locked_sd_db=2.0, lost_db=-85.0,
        lost_per_db=0.3, lost_sd_db=4.0, flights=3, brier=0.1, constant_brier=0.2, log_score=0.4,
        constant_log_score=0.6, floor_db=-80.0, floor_rmse_db=3.0, free_space_floor_rmse_db=5.0,
    )  # fmt: skip
    place = copied(tmp_path)
    store_entry(place, "planted", entry(LEVEL, lock), learned_tables("A", t=table(4.0, (1, 1)), u=table(2.0, (1, 1))))
    points = site.parent / "p.csv"
    plain, said = (predict.predict(points, [], TargetOptions(site=str(at))) for at in (site, place))
    levels, before = (x.table[x.table["channel"] == "A"] for x in (said, plain))
    random, n = np.random.default_rng(3), 200_000
    assert len(levels) == 4
    for (_, row), level in zip(levels.iterrows(), before["level_db"], strict=True):
        above = level + 7.0 - 30.0 + 92.0  # path gain, less that of half the locks
        p = 1.0 / (1.0 + np.exp(-0.4 * above))
        in_lock = random.random(n) < p
        sample = np.where(
            in_lock,
            random.normal(-70.0 + 0.8 * above, np.hypot(2.0, LEVEL.sd_db), n),
            random.normal(-85.0 + 0.3 * above, 4.0, n),
        )
        assert row["p_lock"] == pytest.approx(p, abs=1e-3)
        assert [row["q05_db"], row["level_db"], row["q95_db"]] == pytest.approx(
            np.quantile(sample, [0.05, 0.5, 0.95]), abs=0.25
        )
        assert row["sd_db"] == pytest.approx(np.sqrt(np.mean((sample - row["level_db"]) ** 2)), rel=0.02)
    assert levels["p_lock"][:3].between(0.1, 0.9).all()  # both parts count
    assert f"in lock for {100 * levels['p_lock'].mean():.0f} % of them" in said.page.verdict
    assert "4 s" not in said.page.verdict
    assert "p_lock" not in plain.table
    assert main(["predict", str(points), "--site", str(place), "-o", str(tmp_path / "out")]) == 0
    written = pd.read_csv(tmp_path / "out" / "prediction.csv")
    np.testing.assert_allclose(written["p_lock"][:4], levels["p_lock"], atol=1e-4)
    assert "P(lock)" in (tmp_path / "out" / "prediction.html").read_text(encoding="utf-8")
    numbers = json.loads((tmp_path / "out" / "metrics.json").read_text())["series"]["LW1 A"]
    assert numbers["mean_p_lock"] == pytest.approx(levels["p_lock"].mean(), abs=1e-3)


def test_an_unknown_heading_adds_the_spread_of_the_gain_over_headings(site: Path) -> None:
    points = pd.read_csv(site.parent / "p.csv").assign(yaw_deg=np.nan)
    points.to_csv(site.parent / "open.csv", index=False)
    said = predict.predict(site.parent / "open.csv", [], TargetOptions(site=str(site)))
    known = predict.predict(site.parent / "p.csv", [], TargetOptions(site=str(site)))
    any_heading, one_heading = (x.table[x.table["channel"] == "A"].iloc[0] for x in (said, known))
    # eight headings: the cosine has mean 0 and variance 1/2
    assert any_heading["level_db"] - one_heading["level_db"] == pytest.approx(2.0, abs=0.02)
    assert any_heading["slow_sd_db"] ** 2 - one_heading["slow_sd_db"] ** 2 == pytest.approx(2.0**2 / 2, abs=0.05)


def test_a_site_without_learned_levels_is_predicted_by_the_prior_and_says_so(tmp_path: Path) -> None:
    place = copied(tmp_path)
    assert predict.predict(place, []).page.chosen["base"] == "prior"
    store_entry(place, "old", entry(None), learned_tables("A", t=table(4.0, (1, 1)), u=table(2.0, (1, 1))))
    page = predict.predict(place, []).page
    assert page.chosen["base"] == "prior"
    assert any("have no level" in text for text in page.warnings)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site that learned from two flights past a sector antenna, and a third flight that it never saw."""
    place = past_sector_antenna(tmp_path_factory.mktemp("flown"))
    copied(place)
    words = ["calibrate", str(place / "calibration.yaml"), "--into-site", str(place / "mine.yaml")]
    assert main([*words, "-o", str(place / "calibrated.yaml")]) == 0
    return place


def test_a_flight_is_predicted_before_it_from_the_memory_alone(flown: Path) -> None:
    """Known offsets are added to the measurement: 12 and 9 dB are stored, 4 dB are flown."""
    level = read_learned(flown / "mine.yaml").entries["planted"].series[0].level
    assert level is not None
    # two flights whose offsets differ by 3 dB; a new offset differs from their mean by the SD times sqrt(1 + 1 / 2)
    assert level.sd_db == pytest.approx(np.sqrt(1.5) * offset_sd_db(3.0**2 / 2, 1), abs=0.4)
    out, asked = flown / "before", ["--site", str(flown / "mine.yaml")]
    assert main(["predict", str(flown / "aside.yaml"), *asked, "-o", str(out)]) == 0
    assert main(["report", str(flown / "aside.yaml"), "--against", str(out), "--audit", "none", "-o",
                 str(flown / "report")]) == 0  # fmt: skip
    (verdict,) = json.loads((flown / "report" / "card.json").read_text())
    ((entry,),) = (channels.values() for channels in verdict["levels"].values())
    score = entry["cards"]["before"]
    mean = (OFFSET_DB["first"] + OFFSET_DB["second"]) / 2
    assert score["bias_db"] == pytest.approx(mean - OFFSET_DB["aside"], abs=1.0)
    assert score["rmse_offset_db"] < 3.0
    trained = json.loads((out / "metrics.json").read_text())["trained_on"]
    assert set(trained) == set(read_learned(flown / "mine.yaml").entries["planted"].trained_on)


def test_remembered_antennas_stand_beside_other_bases_but_not_on_their_own_flights(flown: Path) -> None:
    known = {name: predict.predict(flown / "aside.yaml", named_flights([flown / f"{name}.yaml"]),
                               TargetOptions(site=str(flown / "mine.yaml"))) for name in ("aside", "first")}  # fmt: skip
    bases = {name: {row["base"] for row in said.page.candidates} for name, said in known.items()}
    assert "learned antennas of the site" in bases["aside"]
    assert "learned antennas of the site" not in bases["first"]
    assert not isinstance(known["first"].model, Stored)


def test_a_calibration_file_names_its_flights(flown: Path) -> None:
    paths = [flight.path.name for flight in named_flights([flown / "calibration.yaml", flown / "aside.yaml"])]
    assert paths == ["first.yaml", "second.yaml", "aside.yaml"]

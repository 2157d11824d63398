"""P(lock) of a predicted level: learned on flights, scored on those left out, used for a flight that is unseen."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import expit

from aerpaw_cmp.common.units import BoolArray, FloatArray
from aerpaw_cmp.compare.calibration import Learned, Observed, Recipe, flight_left_out, learn
from aerpaw_cmp.compare.gains import GainModel, LinkSamples, Term
from aerpaw_cmp.compare.level import DetectionForecast, learn_detection
from aerpaw_cmp.flight.data import RssSeries
from aerpaw_cmp.flight.drafting.proposals import lock_elsewhere
from aerpaw_cmp.flight.gains import with_learned
from aerpaw_cmp.flight.rows import LOCK_FLOOR_DB
from aerpaw_cmp.flight.settings import FlightFile
from aerpaw_cmp.jobs import calibrate
from aerpaw_cmp.jobs.calibrate import learned_locks, lock_words
from aerpaw_cmp.site.learned import LearnedLock, read_learned, store_entry
from tests.learned_entries import learned_entry, learned_series, learned_tables

MODEL = GainModel(terms=(Term("mast", "antenna", 0.5, 3.0),), bin_s=4.0)
RECIPE = Recipe(MODEL)
HALF_DB, PER_DB, SENT_DBM, REFERENCE_DB = -95.0, 0.4, 40.0, 80.0


def flight(name: str, seed: int, losing: bool = True) -> Observed:
    """Circles about a rover that move away: 4 dB of cosine gain, a lock that is lost about 95 dB of path loss."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, 1200.0)
    azimuth, reach = 2 * np.pi * time / 300.0 + seed, 200.0 + time
    line = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(len(time), 0.3)], axis=1)
    unit = line / np.linalg.norm(line, axis=1, keepdims=True)
    path_db = -38.0 - 20.0 * np.log10(reach)
    gain_db = 4.0 * np.cos(azimuth)
    level_db = path_db + gain_db
    locked = random.random(len(time)) < expit(PER_DB * (level_db - HALF_DB))
    measured = np.where(locked, level_db + REFERENCE_DB + random.normal(0.0, 2.0, len(time)), -28.0)
    samples = LinkSamples(
        flight=name, tower="ROVER", channel="power", time_s=time, position_m=reach[:, None] * line, at_uav=-unit,
        at_tower=unit, residual_db=measured - path_db - SENT_DBM, floor_db=LOCK_FLOOR_DB - path_db - SENT_DBM,
    )  # fmt: skip
    lock = locked.astype(np.float64) if losing else np.ones(len(time))
    return Observed(samples, path_db + SENT_DBM, np.zeros(len(time)), locked=lock, sent_dbm=SENT_DBM)


def locks_of(observed: list[Observed]) -> dict[str, LearnedLock]:
    fits: dict[str, Learned] = {}
    flight_left_out(observed, RECIPE, fits)
    return learned_locks(observed, RECIPE, fits)


def test_the_planted_lock_is_recovered_and_beats_the_share_on_flights_left_out() -> None:
    locks = locks_of([flight(name, seed) for seed, name in enumerate("abc")])
    lock = locks["ROVER.power"]
    assert lock.gain_db == pytest.approx(HALF_DB, abs=1.5)  # relative to the path gain, not to 40 dBm
    assert lock.per_db == pytest.approx(PER_DB, rel=0.35)
    assert lock.flights == 3
    assert 2.0 < lock.locked_sd_db < 3.0
    # what locks is no stronger than the rest here: the level in lock follows the path gain, 80 dB above it
    assert lock.locked_db == pytest.approx(lock.gain_db + REFERENCE_DB, abs=0.5)
    assert lock.locked_per_db == pytest.approx(1.0, abs=0.1)
    assert (lock.lost_db, lock.lost_per_db, lock.lost_sd_db) == pytest.approx((-28.0, 0.0, 0.5), abs=1e-6)
    assert lock.brier < 0.7 * lock.constant_brier
    assert lock.log_score < 0.7 * lock.constant_log_score
    assert lock.floor_rmse_db < 0.8 * lock.free_space_floor_rmse_db  # 2 dB of noise plus 4 dB of cosine
    assert f"{lock.brier:.3f}" in lock_words(lock)


def test_a_forecast_that_is_scored_knows_nothing_of_the_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither P(lock) nor its gains were fitted on the flight that it is scored on."""
    taught: list[set[str]] = []
    calls: list[list[float]] = []

    def learn_from(series: Sequence[LinkSamples], recipe: Recipe) -> Learned:
        learned = learn(series, recipe)
        return replace(learned, mounts={s.flight: None for s in series})  # type: ignore[misc]

    def levels(flights: Sequence[tuple[FloatArray, BoolArray]]) -> DetectionForecast | None:
        calls.append([float(level.mean()) for level, _ in flights])
        return learn_detection(flights)

    monkeypatch.setattr(calibrate, "learn", learn_from)
    monkeypatch.setattr(calibrate, "learn_detection", levels)
    observed = [flight(name, seed) for seed, name in enumerate("abc")]
    for pair, learned in calibrate._without_pairs(observed, RECIPE).items():
        assert set(learned.mounts) == set("abc") - set(pair)
        taught.append(set(pair))
    assert len(taught) == 6
    locks_of(observed)
    assert [len(each) for each in calls] == [3, 2, 2, 2]
    assert not set(calls[0]) & {level for each in calls[1:] for level in each}  # of gains that knew one flight less


def test_one_flight_or_a_receiver_that_keeps_its_lock_teaches_nothing() -> None:
    assert learned_locks([flight("a", 1)], RECIPE, {}) == {}
    assert learned_locks([flight("a", 1), flight("b", 2)], RECIPE, {}) == {}  # nothing is left for a score
    assert locks_of([flight(name, 1, losing=False) for name in "abc"]) == {}


def test_what_a_site_remembers_of_the_lock_is_used_with_its_airframe_alone(tmp_path: Path) -> None:
    lock = LearnedLock(
        gain_db=-95.0, per_db=0.1, share=0.7, locked_db=-15.0, locked_per_db=0.7, locked_sd_db=7.0, lost_db=-27.0, lost_per_db=0.5, lost_sd_db=8.0, flights=3, brier=0.13, constant_brier=0.2, log_score=0.42,
        constant_log_score=0.6, floor_db=-15.0, floor_rmse_db=8.2, free_space_floor_rmse_db=10.3,
    )  # fmt: skip
    entry = learned_entry(learned_series("power", tower="ROVER", carrier_hz=3.32e9, lock=lock))
    store_entry(tmp_path / "mine.yaml", "afar", entry, learned_tables("power"))
    assert read_learned(tmp_path / "mine.yaml").entries["afar"].series[0].lock == lock

    def known(antennas: dict[str, str], receiver: str = "", log: str = "b" * 64) -> LearnedLock | None:
        content = {"flight": "f", "antennas": antennas, "logs": [{"path": "a.txt", "receiver": receiver}]}
        settings, files = with_learned(FlightFile.model_validate(content), tmp_path), (SimpleNamespace(sha256=log),)
        data = SimpleNamespace(settings=settings, folder=tmp_path, site_place=tmp_path / "mine.yaml", files=files)
        time, level = np.arange(3).astype("datetime64[s]"), np.zeros(3)
        series = RssSeries("N", "power", "dB", time, level, data.settings.link.rss, "", np.zeros(3, np.int64), level)
        return lock_elsewhere(data, series)

    assert known({"uav": "mine/afar_uav"}) == lock
    assert known({}) is None
    # the lock is a property of the receiver, also with the airframe of another campaign
    assert known({}, "afar") == lock
    assert known({}, "another") is None
    assert known({}, "afar", log="a" * 64) is None  # learned from this very log

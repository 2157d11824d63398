"""Health of a receiver: what held-out flights store, and steps and levels of a later flight judged by it."""

import dataclasses

import numpy as np
import pytest

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.compare.health import HeldOut, Judged, learned_health, level_of, step_of
from aerpaw_cmp.site.learned import LearnedHealth, LearnedLevel, LearnedSeries, LearnedSpread

TIME_S = np.arange(0.0, 840.0, 0.5)
SPREAD = LearnedSpread(own_sd_db=1.0, noise_sd_db=1.0, fading_sd_db=1.0, fading_kurtosis=0.0, bin_s=4.0)


def errors(seed: int, *, sd_db: float = 2.5, memory_s: float = 11.0, white_db: float = 2.0) -> FloatArray:
    """Errors of a healthy flight: an Ornstein-Uhlenbeck process and white noise."""
    draw, keep = np.random.default_rng(seed), np.exp(-0.5 / memory_s)
    slow = np.zeros(len(TIME_S))
    slow[0] = draw.normal(0.0, sd_db)
    for i in range(1, len(slow)):
        slow[i] = keep * slow[i - 1] + draw.normal(0.0, sd_db * np.sqrt(1.0 - keep**2))
    return slow + draw.normal(0.0, white_db, len(slow))


def held_out(seed: int, floor_db: float = -np.inf) -> HeldOut:
    """A flight at 5 m/s along a line, predicted without it."""
    predicted = -60.0 - 20.0 * np.log10(100.0 + TIME_S)
    place = np.column_stack([5.0 * TIME_S, 0.0 * TIME_S, np.full(len(TIME_S), 40.0)])
    return HeldOut(
        time_s=TIME_S, place_m=place, measured_db=predicted + 12.0 + errors(seed), predicted_db=predicted,
        floor_db=floor_db, locked=(errors(seed + 50) > -2.0).astype(np.float64),
    )  # fmt: skip


HEALTH = learned_health([held_out(seed) for seed in (1, 2, 3)], {"b": [2.4, 2.7, 2.6]})


def learned_series(channel: str = "a", health: LearnedHealth = HEALTH) -> LearnedSeries:
    """A learned antenna of LW1 with the health of its channel."""
    return LearnedSeries(
        tower="LW1", channel=channel, carrier_hz=3.3e9, tower_file="t", uav_file="u", known_file="k",
        tower_known_file="tk", spread=SPREAD, sd_db=1.0, health=health,
        level=LearnedLevel(offset_db=12.0, sd_db=1.7, transmit_power_dbm=40.0, unit="dBm"),
    )  # fmt: skip


def judged(seed: int, name: str = "LW1 a") -> Judged:
    """A later flight whose offset is the usual one."""
    return Judged(
        name=name, time_s=TIME_S, error_db=12.0 + errors(seed), learned=learned_series(name.split()[1]), unit="dBm",
        transmit_power_dbm=40.0,
    )  # fmt: skip


def both(seeds: tuple[int, int], change_db: FloatArray | float, *, channels: int = 2) -> list[Judged]:
    """Two channels, the first one or both of them with a change of the level."""
    of = [judged(seeds[0]), judged(seeds[1], "LW1 b")]
    return [dataclasses.replace(c, error_db=c.error_db + change_db * (i < channels)) for i, c in enumerate(of)]


def test_held_out_flights_store_the_parts_of_their_error() -> None:
    assert HEALTH.slow_sd_db == pytest.approx(2.5, abs=0.5)
    assert 6.0 < HEALTH.correlation_s < 18.0
    assert HEALTH.correlation_m == pytest.approx(5.0 * HEALTH.correlation_s, rel=0.3)  # flown at 5 m/s
    assert 0.3 < HEALTH.white_sd_db < 1.3  # the noise of 4 s means: 2 dB over the root of 8
    assert HEALTH.rmse_db == pytest.approx(np.hypot(2.45, 2.0 / np.sqrt(2.0)), abs=0.4)
    assert HEALTH.step_chi2 < 20.0
    assert HEALTH.run_s == 0.0
    assert HEALTH.channel_difference_sd_db["b"] == pytest.approx(np.sqrt((2.0 + 0.0467) / 4.0), abs=0.01)
    assert HEALTH.below_lock_share is not None
    assert 0.1 < HEALTH.below_lock_share < 0.4


def test_the_longest_run_of_equal_readings_is_stored() -> None:
    flight = held_out(1)
    level = flight.measured_db.copy()
    level[100:141] = level[100]
    assert dataclasses.replace(flight, measured_db=level).longest_run_s == 20.0


def test_errors_below_the_floor_do_not_count() -> None:
    flight = held_out(1, floor_db=-100.0)
    assert np.nanstd(flight.error_db) < 0.8 * np.std(flight.measured_db - flight.predicted_db)


@pytest.mark.parametrize("seed", range(10, 30))
def test_a_healthy_flight_has_neither_a_step_nor_an_odd_level(seed: int) -> None:
    channels = both((seed, seed + 100), 0.0)
    assert step_of(channels) is None
    assert level_of(channels) is None


@pytest.mark.parametrize("seed", range(10, 16))
def test_a_step_of_7_db_is_found_on_one_of_two_channels(seed: int) -> None:
    step = step_of(both((seed, seed + 100), 7.0 * (TIME_S > 420.0), channels=1))
    assert step is not None
    assert abs(step.at_s - 420.0) < 40.0
    assert step.sizes_db["LW1 a"] == pytest.approx(7.0, abs=2.0)
    assert abs(step.sizes_db["LW1 b"]) < 2.5


@pytest.mark.parametrize("seed", range(10, 16))
@pytest.mark.parametrize(
    "change_db",
    [10.0 * TIME_S / TIME_S[-1], 6.0 * np.sin(TIME_S / 30.0), 12.0 * np.exp(-0.5 * ((TIME_S - 400.0) / 40.0) ** 2)],
    ids=["creeping gain", "swinging gain", "a loss of two minutes"],
)
def test_other_changes_of_the_level_are_not_called_a_step(seed: int, change_db: FloatArray) -> None:
    assert step_of(both((seed, seed + 100), change_db)) is None


def test_what_healthy_flights_show_is_not_called_a_step() -> None:
    channels = both((11, 111), 4.0 * (TIME_S > 420.0))
    assert step_of(channels) is not None
    restless = HEALTH.model_copy(update={"step_chi2": 60.0})
    assert step_of([dataclasses.replace(c, learned=c.learned.model_copy(update={"health": restless}))
                    for c in channels]) is None  # fmt: skip


@pytest.mark.parametrize("size_db", [-6.0, 6.0])
def test_a_channel_is_off_the_usual_difference_of_channels(size_db: float) -> None:
    off = level_of(both((12, 112), size_db, channels=1))
    assert off is not None
    assert off.name == "LW1 a"
    assert off.difference_db == pytest.approx(size_db, abs=1.5)
    # another gain of the whole receiver is within the spread of the offset
    assert level_of(both((12, 112), 4.0)) is None
    other = [dataclasses.replace(c, unit="dB") for c in both((12, 112), size_db, channels=1)]
    assert level_of(other) is None

"""Radio clock against telemetry clock: likelihood, verdict, and what is done with it."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from aerpaw_cmp.compare.result import CANNOT_TELL, OK, SHIFTED
from aerpaw_cmp.flight import replay as flight_replay
from aerpaw_cmp.flight.clock import (
    EVIDENCE_NAT,
    STAMPS_S,
    Along,
    ClockChannel,
    _averaged,
    _Bins,
    _finer,
    _gain_features,
    _judged,
    _likelihood,
    _Parts,
    _shown_without,
    judge_clock,
)

STEP_S = 0.1
GRID = np.arange(0.0, 500.0, STEP_S)


CORNERS = np.array([[(-1) ** i * 180.0 + 12.0 * (i % 3), -190.0 + 32.0 * i, 42.0 + 6.0 * (i % 4)] for i in range(12)])
REACHED_S = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(CORNERS, axis=0), axis=1) / 8.2)])


def flown(t):
    """Return a zigzag with sharp turns next to and above a tower: position (n, 3) [m]."""
    return np.column_stack([np.interp(t, REACHED_S, CORNERS[:, axis]) for axis in range(3)])


def along(**models) -> Along:
    place = flown(GRID)
    distance = np.linalg.norm(place, axis=1)
    unit = place / distance[:, None]
    ahead = flown(GRID + 0.5)[:, :2] - flown(GRID - 0.5)[:, :2]
    nose = np.arctan2(ahead[:, 1], ahead[:, 0])
    back = -unit
    body = np.column_stack([
        back[:, 0] * np.cos(nose) + back[:, 1] * np.sin(nose),
        -back[:, 0] * np.sin(nose) + back[:, 1] * np.cos(nose),
        back[:, 2],
    ])  # fmt: skip
    levels = models or {"free space": -20 * np.log10(distance)}
    return Along(
        start_s=0.0, step_s=STEP_S, predicted_db=levels, distance_m=distance, directions=np.column_stack([unit, body])
    )


ALONG = along()


def channel(lag_s=0.0, seed=0, *, gain_db=6.0, memory_db=2.0, name="one", t=None, known=ALONG) -> ClockChannel:
    """Levels of a receiver that shows ``lag_s`` more, with antenna gains that no model knows and slow shadowing."""
    rng = np.random.default_rng(seed)
    t = np.arange(20.0, 480.0, 0.5) if t is None else t
    features = np.column_stack([_gain_features(known.directions[:, 3 * k : 3 * k + 3], (0.5,)) for k in (0, 1)])
    gain = features @ rng.normal(0, gain_db / np.sqrt(2), features.shape[1])
    shade = np.zeros(len(t))
    keeps = np.exp(-np.diff(t) / 4.0)
    for i in range(1, len(t)):
        shade[i] = keeps[i - 1] * shade[i - 1] + np.sqrt(1 - keeps[i - 1] ** 2) * rng.normal(0, memory_db)
    level = np.interp(t, GRID, next(iter(known.predicted_db.values())) + gain) + shade + rng.normal(0, 1.0, len(t))
    return ClockChannel(name=name, time_s=t + lag_s, measured_db=level + 40.0, along=known)


@pytest.mark.parametrize("lag_s", [-8.0, -1.5, 1.0, 4.2])
def test_a_planted_lag_is_found_although_no_gain_is_known(lag_s):
    clock = judge_clock([channel(lag_s, 1), channel(lag_s, 2, name="two")])
    assert clock.verdict == SHIFTED
    low, high = clock.ci95_s
    assert low <= lag_s <= high
    assert abs(clock.radio_minus_telemetry_s - lag_s) < 0.5
    assert set(clock.channels_s) == {"one", "two"}


def test_channels_at_the_same_times_are_judged_like_channels_at_other_times() -> None:
    """A nanosecond between the times of two channels separates their systems of equations, but changes no result."""
    free_space = ALONG.predicted_db["free space"]
    one, two = (
        channel(1.0, seed, name=name, known=along(first=slope * free_space, second=free_space + height))
        for seed, name, slope, height in ((1, "one", 1.1, flown(GRID)[:, 2]), (2, "two", 1.4, 0.0))
    )
    together = judge_clock([one, two])
    apart = judge_clock([one, dataclasses.replace(two, time_s=two.time_s + 1e-9)])
    assert together.against_zero_nat == pytest.approx(apart.against_zero_nat, abs=1e-3)
    assert (together.channels_s, together.ci95_s, together.n) == (apart.channels_s, apart.ci95_s, apart.n)


def test_two_loggers_at_one_tower_have_no_common_clock():
    clock = judge_clock([channel(0.0, 1), channel(4.0, 2, name="two")])
    assert (clock.verdict, clock.correction_s) == (CANNOT_TELL, 0.0)
    assert clock.reason.startswith("its channels have different clocks, one 0.0 s, two +")


@pytest.mark.parametrize(("held_s", "lag_s", "verdict"), [(12.0, 0.0, CANNOT_TELL), (2.0, 8.0, SHIFTED)])
def test_readings_that_are_repeated_are_late_although_the_clock_is_right(held_s, lag_s, verdict):
    """A lag that is longer than the age of the readings is one of the clock."""
    known = channel(lag_s, 1)
    period = np.floor(known.time_s / held_s)
    held = dataclasses.replace(known, measured_db=known.measured_db[np.searchsorted(period, period)])
    clock = judge_clock([held])
    assert clock.verdict == verdict
    assert clock.reason.startswith("levels are repeated for up to 10 s") == (verdict == CANNOT_TELL)
    assert bool(clock.correction_s) == (verdict == SHIFTED)


def test_clocks_that_agree_are_ok_and_their_intervals_hold():
    """Twelve flights: a shift is never called where there is none, and at most one interval misses."""
    inside = 0
    for seed in range(12):
        clock = judge_clock([channel(0.0, seed)])
        assert clock.verdict != SHIFTED
        inside += clock.ci95_s[0] <= 0.0 <= clock.ci95_s[1]
    assert inside >= 11


@pytest.mark.parametrize("lag_s", [-0.4, 0.0, 0.4])
def test_a_clock_is_ok_where_its_interval_holds_zero_and_only_there(lag_s):
    clock = judge_clock([channel(lag_s, 3, gain_db=12.0, memory_db=0.3)])
    low, high = clock.ci95_s
    assert clock.verdict == (OK if low <= 0.0 <= high else SHIFTED)
    assert (clock.verdict == SHIFTED) == (lag_s != 0.0)
    assert clock.correction_s == pytest.approx(lag_s, abs=0.15)


def beside_a_tower(seed, spoilt):
    """200 s straight past a tower, 0.5 dB of noise, true lag 0: a GPS jump of 500 m, 20 s of frozen track, or a dip."""
    rng, grid, t = np.random.default_rng(seed), np.arange(0.0, 200.0, STEP_S), np.arange(0.0, 200.0)
    away = rng.uniform(50.0, 200.0)
    north = rng.uniform(-600.0, -100.0) + rng.uniform(4.0, 9.0) * grid
    place = np.column_stack([np.full(len(grid), away), north, np.full(len(grid), 30.0)])
    level = -20.0 * np.log10(np.linalg.norm(place, axis=1))
    measured, at = np.interp(t, grid, level) + rng.normal(0.0, 0.5, len(t)), int(rng.integers(300, 1500))
    if spoilt == "jump":
        place[at - 10 : at + 11, 0] += 50.0 * (10.0 - np.abs(np.arange(-10, 11)))
    elif spoilt == "frozen":
        place[at : at + 200] = place[at]
    elif spoilt == "dip":
        measured[at // 10] -= 25.0
    distance = np.linalg.norm(place, axis=1)
    unit = place / distance[:, None]
    return ClockChannel(name="one", time_s=t, measured_db=measured, along=Along(
        start_s=0.0, step_s=STEP_S, predicted_db={"free space": -20.0 * np.log10(distance)}, distance_m=distance,
        directions=np.column_stack([unit, -unit]),
    ))  # fmt: skip


@pytest.mark.parametrize(("spoilt", "seeds"), [("jump", (13,)), ("frozen", (3, 4, 7)), ("dip", (1,))])
def test_no_single_place_of_a_flight_shifts_its_clock(spoilt, seeds):
    for seed in seeds:
        clock = judge_clock([beside_a_tower(seed, spoilt)])
        assert clock.verdict != SHIFTED
        assert clock.ci95_s[0] <= 0.0 <= clock.ci95_s[1]


@pytest.mark.parametrize(("begin", "end", "shown"), [(0.41, 0.59, False), (0.2, 0.8, True)])
def test_a_shift_that_less_than_a_fifth_of_the_flight_supports_is_not_shown(
    begin: float, end: float, shown: bool
) -> None:
    """Each second of one part of the flight supports the shift with 1 nat. The other seconds contain no evidence."""
    mean_s = np.arange(1000.0)
    evidence = (mean_s >= 1000.0 * begin) & (mean_s < 1000.0 * end)

    def likelihood(lags: Any, _parts: Any, kept: Any) -> Any:
        return (evidence & kept).sum() * (lags == 1.5)[None, None, :].astype(float)

    bins: Any = [SimpleNamespace(mean_s=mean_s, likelihood=likelihood)]
    assert _shown_without(bins, [[]], 1.5) is shown


def test_a_lone_dip_moves_no_estimate():
    lone = channel(1.5, 2)
    dipped = np.where(np.arange(len(lone.time_s)) // 2 == 200, lone.measured_db - 40.0, lone.measured_db)
    usual, moved = (judge_clock([c]) for c in (lone, dataclasses.replace(lone, measured_db=dipped)))
    assert (usual.verdict, moved.verdict) == (SHIFTED, SHIFTED)
    assert moved.radio_minus_telemetry_s == pytest.approx(usual.radio_minus_telemetry_s, abs=0.1)
    assert moved.ci95_s == pytest.approx(usual.ci95_s, abs=0.15)


def test_a_flat_level_says_nothing_of_the_clock():
    rng = np.random.default_rng(4)
    lone = channel(0.0, 4)
    floor = dataclasses.replace(lone, measured_db=rng.normal(-60.0, 0.3, len(lone.time_s)))
    clock = judge_clock([floor])
    assert clock.verdict == CANNOT_TELL
    assert "is constant although" in clock.reason
    other = channel(3.0, 5, name="other")
    dead = dataclasses.replace(lone, measured_db=np.full(len(lone.time_s), -120.0))
    alone = judge_clock([other])
    for silent in (floor, dead):  # they do not change a channel that varies
        assert judge_clock([silent, other]) == alone


def test_series_of_one_file_or_one_tower_share_a_clock():
    logs = [SimpleNamespace(path=path) for path in ("a.csv", "b.txt", "c.txt")]
    towers = (("LW1", (0,)), ("LW4", (0,)), ("LW2", (1,)), ("LW4", (2,)), ("LW3", ()))
    rss = [SimpleNamespace(tower=tower, log=np.array(log, dtype=np.int64)) for tower, log in towers]
    data = SimpleNamespace(settings=SimpleNamespace(logs=logs), rss=rss)
    assert [sorted(group) for group in flight_replay.same_computer(data)] == [[2], [0, 1, 3], [4]]


def test_channels_with_different_models_are_judged_by_those_that_both_have():
    level = ALONG.predicted_db["free space"]
    known = along(**{"free space": level, "replay": level})
    clock = judge_clock([channel(2.0, 1, known=known), channel(2.0, 2, name="two")])
    assert (clock.model, clock.verdict) == ("free space", SHIFTED)


def test_a_level_of_noise_says_nothing():
    t = np.arange(20.0, 480.0, 0.5)
    noise = ClockChannel(name="one", time_s=t, measured_db=np.random.default_rng(4).normal(0, 3, len(t)), along=ALONG)
    clock = judge_clock([noise])
    assert clock.verdict == CANNOT_TELL
    assert "hardly depends on the position" in clock.reason
    assert clock.correction_s == 0.0


def test_too_few_samples_and_gaps_of_the_telemetry():
    few = judge_clock([channel(t=np.arange(100.0, 130.0, 0.5))])
    assert few.verdict == CANNOT_TELL
    assert np.isnan(few.radio_minus_telemetry_s)
    assert few.ci95_s == (-15.0, 15.0)
    holes = ALONG.distance_m.copy()
    holes[2000:2400] = np.nan
    broken = dataclasses.replace(
        ALONG, distance_m=holes, directions=np.where(np.isnan(holes)[:, None], np.nan, ALONG.directions)
    )
    complete, part = channel(2.0, 5), dataclasses.replace(channel(2.0, 5), along=broken)
    clock = judge_clock([part])
    assert clock.n == judge_clock([complete]).n - 70  # 40 s of gap, 15 s of lag on either side
    assert clock.verdict == SHIFTED


def test_a_track_of_one_pose_and_a_level_that_never_changes_are_no_fault():
    """A table with one time has no position before or after a given time.

    A constant level leaves nothing to explain.
    """
    instant = dataclasses.replace(
        ALONG, distance_m=ALONG.distance_m[:1], directions=ALONG.directions[:1],
        predicted_db={name: level[:1] for name, level in ALONG.predicted_db.items()},
    )  # fmt: skip
    assert judge_clock([dataclasses.replace(channel(), along=instant)]).verdict == CANNOT_TELL
    flat = dataclasses.replace(channel(), measured_db=np.full(920, -50.0))
    with np.errstate(divide="raise", invalid="raise"):
        assert judge_clock([flat]).verdict == CANNOT_TELL


def test_a_lag_outside_the_window_is_not_passed_off_as_a_result():
    clock = judge_clock([channel(6.0, 6, gain_db=12.0, memory_db=0.5)], window_s=5.0)
    assert clock.verdict == CANNOT_TELL
    assert "increase rss.advanced.lag_window_s" in clock.reason
    assert -5.0 <= clock.ci95_s[0] <= clock.radio_minus_telemetry_s <= clock.ci95_s[1] <= 5.0


def test_the_model_that_explains_the_level_is_chosen():
    ripple = 4.0 * np.sin(GRID / 3.0)
    free = ALONG.predicted_db["free space"]
    known = along(wrong=free + 4.0 * np.sin(GRID / 2.1), right=free + ripple, none=free)
    levels = dataclasses.replace(channel(1.2, 7), along=known)
    rippled = levels.measured_db + np.interp(levels.time_s - 1.2, GRID, ripple)
    clock = judge_clock([dataclasses.replace(levels, measured_db=rippled)])
    assert clock.model == "right"
    assert abs(clock.radio_minus_telemetry_s - 1.2) < 0.25


def test_the_likelihood_is_that_of_a_multivariate_normal():
    """Compute the likelihood a second time with the dense covariance, with the scale maximised by hand.

    Differences over gains and lags agree.
    """
    rng = np.random.default_rng(8)
    t = np.sort(rng.uniform(0, 90, 80))
    features = np.column_stack([np.ones(80), np.log10(50 + t), rng.normal(0, 1, (80, 9))])
    y = rng.normal(0, 3, 80)
    gains = (0.3, 1.7)
    parts = [_Parts(6.0, 0.4, gain) for gain in gains]
    computed = _likelihood(np.column_stack([features, y])[:, None], t, 1, parts)[:, 0, 0]
    expected = []
    for gain in gains:
        spread = np.array([1e3, 1e3, *[gain] * 9])
        k = (features * spread**2) @ features.T + np.exp(-np.abs(t[:, None] - t) / 6.0) + 0.4**2 * np.eye(80)
        scale = y @ np.linalg.solve(k, y) / 80
        expected.append(multivariate_normal(np.zeros(80), scale * k, allow_singular=True).logpdf(y))
    constant = -0.5 * 80 * (1 + np.log(2 * np.pi))
    np.testing.assert_allclose(computed + constant, expected, atol=1e-4)


def test_features_of_a_gain_have_its_covariance():
    rng = np.random.default_rng(9)
    unit = rng.normal(size=(400, 3)) * [0.6, 0.6, 0.2] + [0, 0, 1.0]
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    features = _gain_features(unit, (0.3, 0.6))
    squared = ((unit[:, None] - unit) ** 2).sum(axis=-1)
    covariance = 0.5 * (np.exp(-squared / 0.18) + np.exp(-squared / 0.72))
    assert np.abs(features @ features.T - covariance).max() < 0.04
    assert features.shape[1] < 64


@pytest.mark.parametrize(
    ("peaks", "verdict"),
    [
        ({0.0: 0.0}, OK),
        ({3.0: 0.0}, SHIFTED),
        ({3.0: 0.0, 0.5: -3.9}, CANNOT_TELL),  # a lag near zero is possible
        ({3.0: 0.0, 0.5: -4.1}, SHIFTED),
        ({3.0: 0.0, -2.0: -3.0}, CANNOT_TELL),  # zero lies inside the interval
        ({0.0: 0.0, 1.5: -3.0}, CANNOT_TELL),
        ({15.0: 0.0}, CANNOT_TELL),  # at the edge
        ({0.0: 0.0, 0.5: -1.0, -0.5: -1.0}, OK),
    ],
)
def test_the_verdict_follows_from_the_lags_that_are_left(peaks, verdict):
    lags = np.arange(-15.0, 15.01, 0.5)
    total = np.full((1, len(lags)), -30.0)
    for lag, value in peaks.items():
        total[0, np.argmin(np.abs(lags - lag))] = value
    clock = _judged(lags, total[:, None], ["one"], 15.0)
    assert clock.verdict == verdict
    assert clock.radio_minus_telemetry_s in peaks
    assert -15.0 <= clock.ci95_s[0] <= clock.radio_minus_telemetry_s <= clock.ci95_s[1] <= 15.0


def test_a_jittering_attitude_makes_no_sharp_optimum():
    """The likelihood of lags 0.1 s apart: an airframe that rolls by 6 degrees every tenth of a second changes little."""
    rng = np.random.default_rng(8)
    jitter = ALONG.directions.copy()
    jitter[:, 3:] += rng.normal(0.0, 0.1, (len(GRID), 3))
    shaken = dataclasses.replace(ALONG, directions=jitter)
    t = np.arange(20.0, 480.0, 1 / 30.0)
    shaken_channel = channel(0.0, 9, gain_db=12.0, memory_db=0.5, t=t, known=shaken)
    bins = _Bins.of(shaken_channel, list(shaken.predicted_db), shaken.features(), 15.0)
    assert bins is not None
    value = bins.likelihood(np.arange(-0.6, 0.61, 0.1), [[_Parts(5.0, 0.1, 1.0)]])[0, 0]
    assert value.max() - value[0] > 4.0  # the lag is seen
    assert np.abs(np.diff(value, 2)).max() < 0.25 * np.ptp(value)  # and no lag stands out from its neighbours


def test_ratios_do_not_vote_on_the_clock_where_levels_do(monkeypatch):
    """The sounder's quality saturates. Combined with the level, it gave +14.8 s for an injected lag of 5 s."""
    monkeypatch.setattr(flight_replay, "_along", lambda *_: [ALONG])
    monkeypatch.setattr(flight_replay, "_clock_levels", lambda _, series: series.measured_db)
    track = SimpleNamespace(start_ns=0, end_ns=10**9)
    time = np.zeros(3, "datetime64[ns]")
    series = [
        SimpleNamespace(tower="LW1", channel=c, unit=u, time=time, measured_db=np.zeros(3), settings_key="one")
        for c, u in (("power", "dB re full scale"), ("quality", "dB"))
    ]
    data = SimpleNamespace(track=track, nodes={}, link_of=lambda _: SimpleNamespace(carrier_hz=3.3e9))
    assert [c.name for c in flight_replay.clock_channels(data, series)] == ["power"]
    assert [c.name for c in flight_replay.clock_channels(data, series[1:])] == ["quality"]


def replayed_times(monkeypatch, start_s, end_s):
    """Return the times [s] of the predictions for the clock of a flight."""
    replayed = []
    monkeypatch.setattr(
        flight_replay, "_along", lambda _data, _series, instants, _step: replayed.append(instants) or [ALONG]
    )
    monkeypatch.setattr(flight_replay, "_clock_levels", lambda *_: np.zeros(1))
    series = SimpleNamespace(tower="LW1", channel="one", unit="dBm", time=np.zeros(1, "M8[ns]"), settings_key="one")
    track = SimpleNamespace(start_ns=int(start_s * 1e9), end_ns=int(end_s * 1e9))
    data = SimpleNamespace(track=track, nodes={}, link_of=lambda _: SimpleNamespace(carrier_hz=3.3e9))
    flight_replay.clock_channels(data, [series])
    (instants,) = replayed
    return instants.astype(np.int64) * 1e-9


def test_a_telemetry_of_one_row_is_replayed_at_its_time(monkeypatch):
    assert list(replayed_times(monkeypatch, 5, 5)) == [5.0]


def test_a_short_flight_is_replayed_finely_and_a_long_one_at_no_more_times_than_half_an_hour(monkeypatch):
    """Lags are reported to 0.1 s. The processor time of a flight is that of its times."""
    minute, half_hour, ten_hours = (replayed_times(monkeypatch, 0, end_s) for end_s in (60, 1800, 36_000))
    assert 0.02 <= np.diff(minute).min() <= np.diff(minute).max() <= 0.1
    assert len(ten_hours) < 1.2 * len(half_hour)
    assert ten_hours[-1] > 35_990


def test_a_lag_is_excluded_only_where_no_model_explains_it():
    """Two models of the same likelihood, one of them sharp at 9 s: AFAR 328 loc 3, whose node the levels placed."""
    lags = np.arange(-15.0, 15.01, 0.5)
    shifted, agreeing = (np.full(len(lags), -30.0) for _ in range(2))
    shifted[lags == 9.0], agreeing[np.abs(lags) <= 0.5] = 0.0, -0.2
    assert _judged(lags, np.stack([shifted, agreeing])[None], ["one"], 15.0).verdict == CANNOT_TELL
    assert _judged(lags, np.stack([shifted, agreeing - 5.0])[None], ["one"], 15.0).verdict == SHIFTED


def test_a_mirrored_likelihood_has_the_mirrored_interval():
    lags = np.arange(-15.0, 15.01, 0.5)
    total = -0.8 * (lags - 3.0)[None] ** 2 - np.array([[0.1], [2.3]]) * np.abs(lags)
    there, back = (_judged(lags, own[:, None], ["one", "two"], 15.0) for own in (total, total[:, ::-1]))
    assert back.radio_minus_telemetry_s == -there.radio_minus_telemetry_s
    assert back.ci95_s == (-there.ci95_s[1], -there.ci95_s[0])
    assert back.channels_s == {name: -lag for name, lag in there.channels_s.items()}
    assert (back.verdict, back.against_zero_nat) == (there.verdict, there.against_zero_nat)
    alone = np.full((1, len(lags)), -30.0)
    alone[0, 36] = 0.0  # 3 s alone: as far as the nearest lags that are excluded, and what stamps are off
    assert _judged(lags, alone[:, None], ["one"], 15.0).ci95_s == (2.5 - STAMPS_S, 3.5 + STAMPS_S)


def test_half_a_second_is_no_shift_on_any_grid():
    """Lags are multiples of a tenth, which no float holds: 0.5 s is as good as 0."""
    lags = np.arange(-150, 151) * 0.1
    for sign in (1.0, -1.0):
        total = np.full((1, 301), -30.0)
        for lag, value in ((3.0, 0.0), (0.5, -3.9)):
            total[0, np.argmin(np.abs(lags - sign * lag))] = value
        assert _judged(lags, total[:, None], ["one"], 15.0).against_zero_nat == pytest.approx(3.9)


@pytest.mark.parametrize("width", [0.4, 3.0, 10.0, 12.6])
def test_a_running_mean_moves_nothing_in_time(width: float) -> None:
    """The mean of a straight line is the line. A mean that is half a step early would shift every clock."""
    line = np.arange(60.0)[:, None] * [1.0, -3.0]
    np.testing.assert_allclose(_averaged(line, width)[8:-8], line[8:-8], atol=1e-9)
    peak = (np.arange(60.0) == 30.0)[:, None] * [1.0, 2.0]
    share = np.array([np.clip(width / 2 + 0.5 - abs(k - 30), 0.0, 1.0) for k in range(60)])  # of a row that lies within
    share /= share.sum()
    np.testing.assert_allclose(_averaged(peak, width), np.outer(share, [1.0, 2.0]), atol=1e-12)
    line[33] = np.nan
    around = _averaged(line, width)
    assert np.isnan(around[33]).all()
    known = [k for k in range(60) if k != 33]
    means = [
        np.average(line[known, 0], weights=np.clip(width / 2 + 0.5 - np.abs(np.array(known) - k), 0, 1)) for k in known
    ]
    np.testing.assert_allclose(around[known, 0][8:-8], means[8:-8], atol=1e-9)


def small_bins(t: np.ndarray, window_s: float = 5.0, start_s: float = 0.0, rows: int = 30_000) -> _Bins | None:
    """Bins of levels sin t over tables whose columns are known: a constant, the time, and a level that is the time."""
    at = start_s + 0.1 * np.arange(rows)
    table = Along(
        start_s=start_s, step_s=0.1, predicted_db={"m": at}, distance_m=at + 1.0, directions=np.ones((rows, 6))
    )
    sine = ClockChannel(name="one", time_s=t, measured_db=np.sin(t), along=table)
    return _Bins.of(sine, ["m"], np.column_stack([np.ones(rows), at]), window_s)


def test_bins_are_seconds_or_nine_hundredths_and_eight_instants_of_each_are_asked() -> None:
    assert small_bins(np.arange(10.0, 69.0)) is None
    sixty = small_bins(np.arange(10.0, 70.0))
    assert sixty is not None
    assert len(sixty.mean_s) == 60
    long = small_bins(np.arange(0.0, 2700.0, 0.5) + 10.0)
    assert long is not None
    assert len(long.mean_s) == pytest.approx(900, abs=1)
    np.testing.assert_allclose(np.diff(long.mean_s)[1:-1], 3.0, atol=0.26)
    dense = small_bins(np.arange(20.0, 100.0, 1 / 30.0)[np.random.default_rng(1).permutation(2400)])
    assert dense is not None
    np.testing.assert_array_equal(np.diff(np.append(dense.first, len(dense.at_s))), 8)  # every fourth of thirty
    np.testing.assert_allclose(dense.at_s[:8], 20.0 + np.arange(8) * 4 / 30)
    columns = dense.systems(np.array([1.5]))[:, 0]
    features, residual = columns[:, :-1], columns[:, -1:]
    asked = dense.at_s.reshape(-1, 8).mean(axis=1) - 1.5
    np.testing.assert_allclose(features[:, 1], dense.mean_s - 1.5, atol=1e-6)
    expected = dense.mean_db[:, 0] - asked
    np.testing.assert_allclose(residual[:, 0], expected - expected.mean(), atol=1e-9)


@pytest.mark.parametrize(("first", "last", "count"), [(5.0, 75.0, 71), (4.9, 74.9, 70), (5.0, 93.0, 88)])
def test_samples_whose_lags_the_telemetry_does_not_reach_take_no_part(first: float, last: float, count: int) -> None:
    """Telemetry from 100 s to 197.9 s of its clock: a window of 5 s on either side lies within it, a row beyond it."""
    bins = small_bins(100.0 + np.arange(first, last + 0.01), start_s=100.0, rows=980)
    assert bins is not None
    assert len(bins.at_s) == count


def test_a_channel_without_levels_does_not_prevent_the_test_of_the_others() -> None:
    heard = channel(1.0, seed=1)
    silent = dataclasses.replace(channel(seed=2, name="two"), measured_db=np.full(len(heard.time_s), np.nan))
    both, alone = judge_clock([heard, silent]), judge_clock([heard])
    assert (both.verdict, both.radio_minus_telemetry_s) == (alone.verdict, alone.radio_minus_telemetry_s)
    assert judge_clock([silent]).verdict == CANNOT_TELL


@pytest.mark.parametrize(("bend", "finest"), [(30.0, 0.02), (0.01, 0.5)])
def test_lags_are_tried_finely_where_one_stands_out(bend: float, finest: float) -> None:
    lags = np.arange(-30, 31) * 0.5

    def likelihood(some: np.ndarray) -> np.ndarray:
        return np.stack([-bend * (some - 1.234) ** 2, -bend * (some - 1.234) ** 2 - 50.0])[None]

    tried, own = _finer(lags, likelihood, 15.0)
    np.testing.assert_array_equal(own, likelihood(tried))
    assert set(np.round(lags, 6)) <= set(np.round(tried, 6))
    assert len(np.unique(np.round(tried, 6))) == len(tried)
    near = tried[np.abs(tried - 1.234) < (0.3 if bend > 1 else 2.0)]
    assert np.diff(near) == pytest.approx(finest)
    assert np.abs(tried).max() <= 15.0
    edge, _ = _finer(lags, lambda some: -30.0 * (some - 15.0)[None, None] ** 2, 15.0)
    assert (edge.max(), np.diff(edge)[-1]) == (15.0, pytest.approx(0.02))


def test_an_optimum_between_two_excluded_lags_is_found() -> None:
    """Two lags explain a level about equally well, and the second is between two excluded lags."""
    lags = np.arange(-30, 31) * 0.5

    def likelihood(some: np.ndarray) -> np.ndarray:
        return np.maximum(-40.0 * some**2, -3.0 - 40.0 * (some - 3.25) ** 2)[None, None]

    assert (likelihood(lags[np.abs(lags - 3.25) < 1.0]) < -EVIDENCE_NAT).all()
    tried, own = _finer(lags, likelihood, 15.0)
    assert own[0, 0, np.abs(tried - 3.25) < 0.02].max() > -EVIDENCE_NAT
    assert _judged(tried, own, ["one"], 15.0).ci95_s[1] > 3.25

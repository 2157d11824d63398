"""What judges a clock, step by step against plain loops, and every threshold on both of its sides."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from aerpaw_cmp.compare.result import APPLIED, ESTIMATED, NOT_APPLIED
from aerpaw_cmp.compare.statistics import paired_difference
from aerpaw_cmp.flight import clock, lag
from aerpaw_cmp.flight.clock import ClockChannel, HeldOutBlocks, clock_trap, judge_clock
from aerpaw_cmp.flight.lag import DRIFT_LIMIT, combine_lags, fit_lag, no_lag, sample, symmetric
from tests.flight.test_lag import two_ray_flight

LATE_S, DRIFT = 1.3, 6e-5
ZERO_NS = 1_740_000_000_000_000_000


@pytest.fixture(scope="module")
def flight():
    """Two channels over 700 s on one radio clock that is late and drifts, and the estimate of it."""
    level = two_ray_flight(700)
    t = np.arange(0, 700, 0.2)
    late = LATE_S + DRIFT * (t - 350.0)
    channels = []
    for noise_db, name in ((1.5, "one"), (4.0, "two")):
        heard = level(t) + np.random.default_rng(int(noise_db)).normal(0, noise_db, len(t))
        channels.append(ClockChannel(name=name, times=t + late, measured_db=heard, predictor=level))
    estimate = judge_clock(channels, window_s=3.0, model="two rays")
    start = estimate.start_ns
    sampled = {
        c.name: sample(c.times, c.measured_db, c.predictor, window_s=3.0, resolution_s=0.05, origin_ns=start)
        for c in channels
    }
    return SimpleNamespace(channels=channels, estimate=estimate, sampled=sampled, lags=symmetric(3.0, 0.1), t=t)


def off(estimate, t):
    """How late the radio's clock is at seconds t after its first sample."""
    return estimate.radio_minus_telemetry_s + estimate.drift_s_per_s * (t - estimate.reference_s)


def seen(s, at):
    return np.interp(at, s.prediction.times(), s.prediction.level, left=np.nan, right=np.nan)


def test_the_estimate_is_the_planted_clock(flight):
    e = judge_clock(flight.channels, window_s=3.0, model="two rays")
    assert e.as_dict() == flight.estimate.as_dict()
    assert e.verdict == "ok", e.reason
    first = flight.channels[0].times[0]
    assert e.start_ns == round(first * 1e9)
    t = flight.channels[0].times
    np.testing.assert_allclose(off(e, t - first), LATE_S + DRIFT * (flight.t - 350.0), atol=4e-3)
    np.testing.assert_allclose(e.correction_s(t), off(e, t - first), atol=1e-9)
    assert (e.model, e.window_s, e.n) == ("two rays", 3.0, sum(len(s.t) for s in flight.sampled.values()))
    assert e.drift_ci95_s_per_s[0] < DRIFT < e.drift_ci95_s_per_s[1]
    assert set(e.channels_s) == {"one", "two"}
    for value in e.channels_s.values():
        assert value == pytest.approx(LATE_S, abs=0.02)


def test_channels_are_counted_from_the_earliest_instant_of_all(flight):
    late = replace(
        flight.channels[1], times=flight.channels[1].times[500:], measured_db=flight.channels[1].measured_db[500:]
    )
    both = judge_clock([late, flight.channels[0]], window_s=3.0)
    assert both.start_ns == flight.estimate.start_ns
    np.testing.assert_allclose(
        both.correction_s(flight.channels[0].times), flight.estimate.correction_s(flight.channels[0].times), atol=0.02
    )


def test_instants_without_a_time_do_not_count(flight):
    one = flight.channels[0]
    stamps = (np.round(one.times * 1e9).astype(np.int64) + ZERO_NS).astype("datetime64[ns]")
    stamps[[0, 7]] = np.datetime64("NaT")
    level = one.predictor

    def predictor(asked):
        return level((asked.astype("datetime64[ns]").astype(np.int64) - ZERO_NS) * 1e-9)

    found = judge_clock([replace(one, times=stamps, predictor=predictor)], window_s=3.0)
    assert found.start_ns == stamps[1].astype(np.int64)
    assert found.n == len(stamps) - 2
    assert found.radio_minus_telemetry_s == pytest.approx(LATE_S, abs=0.02)
    none = judge_clock([replace(one, times=np.full(len(stamps), np.datetime64("NaT")), predictor=predictor)])
    assert (none.verdict, none.start_ns) == ("failed", 0)


def test_what_is_explained_is_a_share_of_the_variance_of_means_over_seconds(flight):
    left = total = 0.0
    for s in flight.sampled.values():
        predicted = seen(s, s.t - off(flight.estimate, s.t))
        seconds = {}
        for t, m, p in zip(s.t, s.measured_db, predicted, strict=True):
            if np.isfinite(p):
                seconds.setdefault(int(t // 1), []).append((m, m - p))
        means = np.array([np.mean(rows, axis=0) for rows in seconds.values()])
        n = sum(map(len, seconds.values()))
        total += n * means[:, 0].var()
        left += n * means[:, 1].var()
    found = clock._explained_share(list(flight.sampled.values()), flight.estimate)
    assert found == flight.estimate.explained == pytest.approx(1 - left / total, rel=1e-9)
    assert 0.5 < found < 1.0
    s = flight.sampled["one"]
    faint = replace(s, measured_db=1e-5 * s.measured_db)
    assert clock._explained_share([faint], flight.estimate) < -1e5  # however little varies, it is a share of that
    assert np.isnan(clock._explained_share([replace(s, measured_db=np.full(len(s.t), -60.0))], flight.estimate))


def test_halves_are_fitted_apart_with_the_drift_taken_off(flight):
    e = flight.estimate
    middle = (min(s.t[0] for s in flight.sampled.values()) + max(s.t[-1] for s in flight.sampled.values())) / 2
    expected = []
    for first in (True, False):
        fits = []
        for s in flight.sampled.values():
            part = s.t <= middle if first else s.t > middle
            moved = s.t[part] - e.drift_s_per_s * (s.t[part] - e.reference_s)
            fits.append(fit_lag(moved, s.measured_db[part], s.prediction, flight.lags, 1.0, False))
        expected.append(combine_lags(fits, limit_s=1.0).radio_minus_telemetry_s)
    halves = clock._halves(list(flight.sampled.values()), e, flight.lags, 1.0)
    assert e.halves_s == tuple(half.radio_minus_telemetry_s for half in halves) == tuple(expected)
    assert e.halves_s == pytest.approx((LATE_S, LATE_S), abs=0.02)
    assert e.drift_s_per_s == pytest.approx(DRIFT, rel=0.1)
    tiny = replace(
        flight.sampled["one"], t=flight.sampled["one"].t[:40], measured_db=flight.sampled["one"].measured_db[:40]
    )
    first, second = clock._halves([tiny], e, flight.lags, 1.0)  # twenty samples each: too few
    assert first.verdict == second.verdict == "failed"
    assert (first.reason, first.n, first.ci95_s) == ("too few samples", 0, (-3.0, 3.0))
    enough = replace(tiny, t=s.t[:60], measured_db=s.measured_db[:60])  # thirty each
    assert [half.n for half in clock._halves([enough], e, flight.lags, 1.0)] == [30, 30]


def test_free_patterns_are_terms_at_the_instants_of_the_prediction(flight):
    """Terms that are asked in the kind of the times, every so-manieth sample, lags a quarter of a second apart."""
    e, one = flight.estimate, flight.channels[0]
    asked = []

    def terms(times):
        asked.append(times)
        return np.column_stack([np.sin(np.asarray(times, dtype=np.float64) / 50.0), np.cos(np.asarray(times) / 80.0)])

    free = clock._with_free_patterns([replace(one, terms=terms), flight.channels[1]], flight.sampled, e, 1.0)
    s = flight.sampled["one"]
    instants = e.start_ns * 1e-9 + s.prediction.times()
    np.testing.assert_allclose(asked[0], instants, rtol=0, atol=1e-6)
    every = int(np.ceil(len(s.t) / 1000))
    assert every > 1
    moved = s.t[::every] - e.drift_s_per_s * (s.t[::every] - e.reference_s)
    beside = s.prediction.beside(terms(instants))
    expected = fit_lag(moved, s.measured_db[::every], beside, symmetric(3.0, 0.25), 1.0, False)
    assert free.radio_minus_telemetry_s == pytest.approx(expected.radio_minus_telemetry_s, abs=1e-6)
    np.testing.assert_allclose(free.curve_lag_s, np.arange(-12, 13) * 0.25)
    assert free.radio_minus_telemetry_s == pytest.approx(LATE_S, abs=0.05)
    assert clock._with_free_patterns(flight.channels, flight.sampled, e, 1.0) is None
    assert clock._with_free_patterns([replace(one, terms=terms, name="silent")], flight.sampled, e, 1.0) is None


def test_instants_are_of_the_kind_that_is_asked_with():
    seconds = np.array([0.0, 1.25])
    made = clock._instants(np.array([0.0]), 5_000_000_000, seconds)
    np.testing.assert_allclose(made, [5.0, 6.25], rtol=0, atol=1e-12)
    stamps = clock._instants(np.array(["2025-01-01"], dtype="datetime64[ns]"), ZERO_NS, seconds)
    assert stamps.dtype == np.dtype("datetime64[ns]")
    assert (stamps.astype(np.int64) - ZERO_NS).tolist() == [0, 1_250_000_000]


def by_hand_held_out(sampled, e, lags, blocks, most=2000):
    """Blocks kept out one after the other: lag and offsets from the rest, errors on the block."""
    first, last = min(s.t[0] for s in sampled), max(s.t[-1] for s in sampled)
    cuts = [first + (last - first) * k / blocks for k in range(1, blocks)]
    tables = []
    for s in sampled:
        every = int(np.ceil(len(s.t) / most))
        t, m = s.t[::every], s.measured_db[::every]
        drift = e.drift_s_per_s * (t - e.reference_s)
        residual = np.array([m - seen(s, t - drift - shift) for shift in lags])
        plain = m - seen(s, t)
        ok = np.isfinite(residual).all(axis=0) & np.isfinite(plain)
        place = np.array([sum(x >= cut for cut in cuts) for x in t])
        tables.append((t[ok], residual[:, ok], plain[ok], place[ok]))
    second, corrected, uncorrected, improved = [], [], [], 0
    zero = len(lags) // 2
    for block in range(blocks):
        cost = np.zeros(len(lags))
        for _, residual, _, place in tables:
            others = residual[:, place != block]
            spread = others.var(axis=1)
            cost += spread / spread[zero]
        best, gain = int(np.argmin(cost)), 0.0
        for t, residual, plain, place in tables:
            inside = place == block
            a = (residual[best, inside] - residual[best, ~inside].mean()) ** 2
            b = (plain[inside] - plain[~inside].mean()) ** 2
            gain += b.sum() - a.sum()
            second += t[inside].tolist()
            corrected += a.tolist()
            uncorrected += b.tolist()
        improved += gain > 0
    of_second = {}
    for t, a, b in zip(second, corrected, uncorrected, strict=True):
        of_second.setdefault(int(t // 1), []).append((a, b))
    roots = np.array([np.sqrt(np.mean(of_second[key], axis=0)) for key in sorted(of_second)])
    return improved, paired_difference(roots[:, 0], roots[:, 1], free_offset=False)


def test_blocks_kept_out_are_scored_with_what_the_others_say(flight):
    e = flight.estimate
    odd, even = (list(flight.sampled.values()) for _ in range(2))
    even = [replace(s, t=s.t[: len(s.t) // 2 * 2], measured_db=s.measured_db[: len(s.t) // 2 * 2]) for s in even]
    odd = [replace(s, t=s.t[:-1], measured_db=s.measured_db[:-1]) for s in even]
    shorter = [even[0], replace(even[1], t=even[1].t[:2500], measured_db=even[1].measured_db[:2500])]
    for sampled in (odd, even, shorter):  # every second sample of them is taken
        found = clock._held_out(sampled, e, flight.lags)
        improved, paired = by_hand_held_out(sampled, e, flight.lags, 10)  # 700 s: ten at most
        assert found.blocks == 10
        assert found.improved == improved
        assert found.paired.difference_db == pytest.approx(paired.difference_db, rel=1e-9)
        assert found.paired.rmse_db == pytest.approx(paired.rmse_db, rel=1e-9)
        assert found.paired.other_rmse_db == pytest.approx(paired.other_rmse_db, rel=1e-9)
        assert found.paired.n == paired.n
        assert paired.difference_db < 0 < improved
    assert e.held_out.as_dict() == clock._held_out(list(flight.sampled.values()), e, flight.lags).as_dict()


def test_blocks_kept_out_of_a_clock_that_is_right_gain_nothing(flight):
    """The lags of the search say nothing then; some blocks are worse: both ways count them alike."""
    level = two_ray_flight(250)
    t = np.arange(0, 250, 0.5)
    heard = level(t) + np.random.default_rng(9).normal(0, 6, len(t))
    s = sample(t, heard, level, window_s=3.0, resolution_s=0.05)
    e = replace(flight.estimate, drift_s_per_s=2e-5, reference_s=100.0)
    found = clock._held_out([s], e, flight.lags)
    improved, paired = by_hand_held_out([s], e, flight.lags, 4)
    assert (found.blocks, found.improved) == (4, improved)
    assert improved < 4
    assert found.paired.difference_db == pytest.approx(paired.difference_db, rel=1e-9)


# --- the order of the checks, and their thresholds ---------------------------------------------------------------------


LAGS = symmetric(12.0, 0.1)


def alone(value, verdict="ok"):
    return replace(
        no_lag("", 100, 12.0, LAGS), radio_minus_telemetry_s=value, verdict=verdict, evidence=np.full(len(LAGS), 50.0)
    )


def blocks(difference, improved=10):
    """Ten blocks kept out, the error changed by so much."""
    rng = np.random.default_rng(0)
    a = np.abs(rng.normal(3.0, 0.1, 400))
    paired = replace(paired_difference(a + difference, a, free_offset=False), difference_db=difference)
    return HeldOutBlocks(blocks=10, improved=improved, paired=paired)


@pytest.fixture
def checked(flight, monkeypatch):
    """The checks of a made-up estimate, whatever the flight: everything agrees unless it is told otherwise."""

    def judged(*, own=None, halves=(2.0, 2.0), free=2.0, held_out=None, **estimate):
        e = replace(
            flight.estimate,
            **{
                "radio_minus_telemetry_s": 2.0, "ci95_s": (1.9, 2.1), "drift_s_per_s": 0.0, "explained": 0.8,
                "verdict": "ok", "reason": "", "halves_s": (), "free_patterns_s": float("nan"), "held_out": None,
            } | estimate,
        )  # fmt: skip
        monkeypatch.setattr(clock, "_halves", lambda *_: tuple(map(alone, halves)))
        monkeypatch.setattr(clock, "_with_free_patterns", lambda *_: None if free is None else alone(free))
        monkeypatch.setattr(clock, "_held_out", lambda *_: held_out or blocks(-0.5))
        fits = {name: alone(value) for name, value in (own or {"one": 2.0}).items()}
        return clock._checked(e, flight.channels, flight.sampled, fits, LAGS, 1.0)

    return judged


def test_where_all_agree_the_clock_is_believed(checked):
    found = checked()
    assert (found.verdict, found.reason) == ("ok", "")
    assert found.halves_s == (2.0, 2.0)
    assert found.free_patterns_s == 2.0
    assert found.held_out.improved == 10
    assert np.isnan(checked(free=None).free_patterns_s)
    assert checked(free=None).verdict == "ok"


@pytest.mark.parametrize(
    ("given", "verdict", "words"),
    [
        ({"explained": 0.499}, "ambiguous", "explains 50 % of the level's variance; 50 % are wanted"),
        ({"explained": 0.5}, "ok", ""),
        ({"explained": -0.2}, "ambiguous", "explains 0 % of the level"),
        ({"drift_s_per_s": 0.94 * DRIFT_LIMIT}, "ok", ""),
        ({"drift_s_per_s": 0.96 * DRIFT_LIMIT}, "ambiguous", "drift lies at the edge"),
        ({"drift_s_per_s": -0.96 * DRIFT_LIMIT}, "ambiguous", "drift lies at the edge"),
        ({"own": {"one": 2.4, "two": 1.6}}, "ok", ""),
        ({"own": {"one": 2.0, "two": 2.6}}, "ambiguous", "channel two alone gives +2.6 s"),
        ({"halves": (1.4, 2.0)}, "ambiguous", "the first half of the flight alone gives +1.4 s"),
        ({"halves": (2.5, 2.6)}, "ambiguous", "the second half of the flight alone gives +2.6 s"),
        ({"free": 2.6}, "ambiguous", "with the antennas' patterns free it is +2.6 s"),
        ({"held_out": blocks(0.31, 3)}, "ambiguous", "lowers the error of 3 of 10 blocks kept out, by -0.31 dB in all"),
        ({"ci95_s": (-0.1, 4.0)}, "agree", "no difference that matters"),
        ({"ci95_s": (0.0, 4.0)}, "agree", "no difference that matters"),
        ({"ci95_s": (-4.0, 0.0)}, "agree", "no difference that matters"),
        ({"explained": 0.4, "drift_s_per_s": DRIFT_LIMIT}, "ambiguous", "explains 40 %"),
        ({"drift_s_per_s": DRIFT_LIMIT, "own": {"one": 9.0}}, "ambiguous", "drift"),
        ({"own": {"one": 9.0}, "halves": (9.0, 9.0)}, "ambiguous", "channel one"),
        ({"halves": (9.0, 8.0), "free": 9.0}, "ambiguous", "first half"),
        ({"free": 9.0, "held_out": blocks(0.3)}, "ambiguous", "patterns"),
    ],
)  # fmt: skip
def test_the_first_check_that_fails_gives_the_reason(checked, given, verdict, words):
    found = checked(**given)
    assert found.verdict == verdict
    assert words in found.reason
    assert (found.reason == "") == (words == "")


@pytest.mark.parametrize(
    ("late", "better", "verdict"),
    [
        (0.04, True, "agree"), (-0.04, True, "agree"),  # no telemetry resolves that
        (0.05, True, "agree"), (0.06, True, "ok"), (-0.06, True, "ok"),
        (0.19, False, "agree"), (-0.19, False, "agree"),  # and that moves nothing
        (0.2, False, "agree"), (0.21, False, "ambiguous"), (-0.21, False, "ambiguous"),
    ],
)  # fmt: skip
def test_a_difference_must_matter_and_help(checked, late, better, verdict):
    found = checked(
        radio_minus_telemetry_s=late, ci95_s=(late - 0.01, late + 0.01), own={"one": late}, halves=(late, late), free=late,
        held_out=blocks(-0.5 if better else 0.5, 10 if better else 0),
    )  # fmt: skip
    assert found.verdict == verdict


@pytest.mark.parametrize("apply", [True, False])
@pytest.mark.parametrize("verdict", ["ok", "agree", "ambiguous", "failed"])
def test_only_a_clock_that_is_shown_is_applied_and_only_where_that_is_asked(flight, verdict, apply):
    e = replace(flight.estimate, verdict=verdict, reason="" if verdict == "ok" else "because")
    result = e.result("LW1", apply=apply)
    assert result.applied == (
        APPLIED
        if apply and verdict == "ok"
        else NOT_APPLIED
        if apply and verdict in ("ambiguous", "failed")
        else ESTIMATED
    )
    assert result.reason == "by the two rays" + ("" if verdict == "ok" else ": because")
    assert (result.receiver, result.verdict) == ("LW1", verdict)
    assert result.radio_minus_telemetry_s == e.radio_minus_telemetry_s
    assert result.ci95_s == e.ci95_s
    assert result.drift_s_per_s == e.drift_s_per_s
    assert result.checks["n"] == e.n
    assert result.checks["held_out"]["improved"] == e.held_out.improved
    assert "start_ns" not in result.checks
    assert replace(e, held_out=None).as_dict()["held_out"] is None


@pytest.mark.parametrize(
    ("of", "improved", "better"), [(10, 8, True), (10, 7, False), (4, 4, True), (4, 3, False), (6, 5, False)]
)
def test_more_blocks_than_chance_would_have_it(of, improved, better):
    """By the sign test: 8 of 10 at 5.5 %, 7 of 10 at 17 %, 4 of 4 at 6.3 %, 5 of 6 at 10.9 %."""
    unsure = replace(blocks(-0.2).paired, verdict="no difference")
    assert HeldOutBlocks(blocks=of, improved=improved, paired=unsure).better == better
    worse = replace(unsure, difference_db=0.1)
    assert not HeldOutBlocks(blocks=of, improved=of, paired=worse).better
    assert not HeldOutBlocks(blocks=of, improved=of, paired=replace(unsure, difference_db=0.0)).better
    assert HeldOutBlocks(blocks=of, improved=0, paired=replace(unsure, verdict="better")).better


def test_a_drift_is_looked_for_from_ten_minutes_of_all_channels_together():
    level = two_ray_flight(640)
    made = []
    for start, seed in ((0.0, 1), (250.0, 2)):
        t = np.arange(start, start + 380.0, 0.5)
        heard = level(t) + np.random.default_rng(seed).normal(0, 2, len(t))
        made.append(ClockChannel(name=str(seed), times=t + 1.0, measured_db=heard, predictor=level))
    assert np.isfinite(judge_clock(made, window_s=3.0).drift_ci95_s_per_s).all()  # 630 s from first to last
    assert np.isnan(judge_clock(made[:1], window_s=3.0).drift_ci95_s_per_s).all()
    assert np.isnan(judge_clock(made, window_s=3.0, drift=False).drift_ci95_s_per_s).all()


def test_ten_minutes_are_counted_between_samples_that_have_a_level():
    level = two_ray_flight(640)
    t = np.arange(0, 600.5, 0.5)
    assert t[-1] == 600.0
    heard = level(t) + np.random.default_rng(1).normal(0, 2, len(t))

    def fitted(heard):
        found = judge_clock([ClockChannel(name="a", times=t, measured_db=heard, predictor=level)], window_s=3.0)
        return bool(np.isfinite(found.drift_ci95_s_per_s).all())

    assert fitted(heard)
    assert not fitted(np.where(t < 0.5, np.nan, heard))
    assert not fitted(np.where(t > 599.5, np.nan, heard))


def test_a_channel_without_enough_samples_takes_no_part(flight):
    short = replace(
        flight.channels[1], times=flight.channels[1].times[:20], measured_db=flight.channels[1].measured_db[:20]
    )
    with_it = judge_clock([flight.channels[0], short], window_s=3.0)
    without = judge_clock([flight.channels[0]], window_s=3.0)
    assert with_it.as_dict() == without.as_dict()
    nothing = judge_clock([short], window_s=3.0, model="m")
    assert (nothing.verdict, nothing.reason, nothing.model) == ("failed", "too few samples (20)", "m")
    assert nothing.ci95_s == (-3.0, 3.0)


# --- whole hours -------------------------------------------------------------------------------------------------------


HOUR = 3600.0


@pytest.mark.parametrize(
    ("radio", "telemetry", "hours"),
    [
        ((0.0, 600.0), (14 * HOUR, 14 * HOUR + 600.0), 14.0),
        ((0.0, 600.0), (14.5 * HOUR, 14.5 * HOUR + 600.0), None),
        ((0.0, 600.0), (-14 * HOUR, -14 * HOUR + 600.0), -14.0),
        ((0.0, 600.0), (5.5 * HOUR, 5.5 * HOUR + 600.0), 5.5),
        ((0.0, 600.0), (HOUR + 301.0, HOUR + 1000.0), None),  # less than half of the shorter is shared
        ((0.0, 600.0), (HOUR + 299.0, HOUR + 1000.0), 1.0),
        ((0.0, 600.0), (301.0, 1000.0), None),  # half is not shared, and no shift is better
        ((0.0, 600.0), (299.0, 1000.0), None),
        ((0.0, 2.25 * HOUR), (2 * HOUR, 4.25 * HOUR), 2.0),  # 0.25 h are shared as they are
        ((0.0, 10 * HOUR), (10.75 * HOUR, 12.25 * HOUR), 3.0),  # 2.5 h bring as much: whole hours go first
        ((0.0, 10 * HOUR), (10.0 * HOUR, 10.4 * HOUR), 1.0),  # 0.5 h would do, too
        ((0.0, 0.0), (HOUR, HOUR), None),
        ((0.0, 1.0), (HOUR + 0.4, HOUR + 5.0), 1.0),  # a log of a second
        ((0.0, 1.0), (HOUR + 0.6, HOUR + 5.0), None),
    ],
)
def test_a_shift_of_hours_is_the_nearest_whole_one_that_brings_most_together(radio, telemetry, hours):
    trap = clock_trap(radio, telemetry)
    assert (None if trap is None else trap.hours) == hours
    if trap is not None:
        moved = [t + trap.hours * HOUR for t in radio]
        assert trap.shifted_overlap_s == pytest.approx(min(moved[1], telemetry[1]) - max(moved[0], telemetry[0]))
        assert trap.overlap_s == pytest.approx(max(0.0, min(radio[1], telemetry[1]) - max(radio[0], telemetry[0])))
        assert trap.overlap_s < 0.5 * min(radio[1] - radio[0], telemetry[1] - telemetry[0])


def test_the_offset_of_the_zone_on_that_day_names_the_mistake():
    noon = 1_721_060_000.0  # 15 July 2024, 16:13 UTC: EDT is four hours
    span = (noon, noon + 600.0)
    early, late = ((noon + k * 4 * HOUR, noon + k * 4 * HOUR + 600.0) for k in (-1, 1))
    assert "radio times are local time (America/New_York)" in clock_trap(early, span, "America/New_York").explanation
    assert "telemetry times are local time" in clock_trap(late, span, "America/New_York").explanation
    hour = (noon + HOUR, noon + HOUR + 600.0)
    assert "daylight saving" in clock_trap(hour, span, "America/New_York").explanation
    assert (
        clock_trap(hour, span).explanation
        == "the clocks differ by -1 h: a time zone was taken into account in one log only"
    )


def test_a_zone_without_an_offset_is_no_reason_for_hours():
    noon = 1_721_060_000.0
    span = (noon, noon + 600.0)
    for zone in ("UTC", "Africa/Abidjan"):
        for late in (-HOUR, HOUR):
            trap = clock_trap((noon + late, noon + late + 600.0), span, zone)
            assert trap.explanation == "one hour: daylight saving taken into account in one log only"


def test_the_middle_sample_belongs_to_the_first_half():
    level = two_ray_flight(260)
    t = np.arange(0, 401) * 0.5  # the middle is a sample: 100 s
    heard = level(t - 0.4) + np.random.default_rng(15).normal(0, 1, len(t))
    s = lag.sample(t, heard, level, window_s=3.0, resolution_s=0.05)
    assert (s.t[0] + s.t[-1]) / 2 in s.t
    lags = symmetric(3.0, 0.1)
    e = SimpleNamespace(drift_s_per_s=0.0, reference_s=0.0)
    expected = [fit_lag(s.t[part], heard[part], s.prediction, lags, 1.0, False) for part in (t <= 100.0, t > 100.0)]
    halves = clock._halves([s], e, lags, 1.0)
    assert [h.radio_minus_telemetry_s for h in halves] == [x.radio_minus_telemetry_s for x in expected]
    assert [h.n for h in halves] == [201, 200]

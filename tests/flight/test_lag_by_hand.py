"""The search for a lag against a second way to its numbers: plain loops, SciPy's splines and minimisers."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize, root

from aerpaw_cmp.flight import lag
from aerpaw_cmp.flight.lag import DRIFT_LIMIT, combine_lags, estimate_lag, fit_lag
from tests.flight.test_lag import patterned_flight, two_ray_flight

LAGS = np.round(np.arange(-120, 121) * 0.1, 9)


class ByHand:
    """Costs of lags and drifts of one record, one after the other."""

    def __init__(self, t, m, prediction, most=6000):
        every = int(np.ceil(len(t) / most))
        self.t, self.m, self.prediction = t[::every], m[::every], prediction
        self.middle = (t[0] + t[-1]) / 2
        self.least = max(30, len(self.t) // 2)

    def residual(self, shift, rate=0.0):
        at = self.t - shift - rate * (self.t - self.middle)
        known = self.prediction.times()
        return self.m - np.interp(at, known, self.prediction.level, left=np.nan, right=np.nan)

    def whitened(self, residual, phi):
        r = residual[np.isfinite(residual)]
        r = r - np.sum(r) / len(r)
        return r[1:] - phi * r[:-1]

    def cost(self, residual, phi):
        if np.isfinite(residual).sum() < self.least:
            return np.inf
        w = self.whitened(residual, phi)
        return float(np.mean((w - np.mean(w)) ** 2))

    def phi(self, residual):
        r = residual[np.isfinite(residual)]
        r = r - np.mean(r)
        return min(max(float(np.sum(r[1:] * r[:-1]) / np.sum(r * r)), 0.0), 0.99)


def likelihood_ratios(cost, whitened):
    """Twice the logarithm of the likelihood against the best, for as many independent samples as blocks show."""
    w = whitened - np.mean(whitened)
    size = max(4, round(2 * len(w) ** (1 / 3)))
    count = len(w) // size
    sums = [np.sum(w[i * size : (i + 1) * size]) for i in range(count)]
    inflation = sum(s * s for s in sums) / len(w) / np.mean(w * w)
    return len(w) / max(inflation, 1.0) * np.log(cost / np.min(cost[:-1]))


@pytest.fixture(scope="module")
def record():
    """A level on 6500 samples of 1300 s, 1.37 s late, with fading that remembers."""
    from scipy.signal import lfilter

    level = two_ray_flight(1300)
    t = np.arange(0, 1300, 0.2)
    noise = lfilter([1], [1, -0.8], np.random.default_rng(3).normal(0, 1.2, len(t)))
    sampled = lag.sample(t, level(t - 1.37) + noise, level, window_s=12.0, resolution_s=0.05)
    return SimpleNamespace(t=sampled.t, m=sampled.measured_db, prediction=sampled.prediction)


@pytest.fixture
def fit(record):
    return fit_lag(record.t, record.m, record.prediction, LAGS, 1.0, True)


def test_the_curve_is_the_spread_of_the_residual_at_every_lag(record, fit):
    hand = ByHand(record.t, record.m, record.prediction)
    curve = [np.sqrt(hand.cost(hand.residual(shift), 0.0)) for shift in LAGS]
    np.testing.assert_allclose(fit.curve_rmse_db, curve, rtol=1e-9)
    assert fit.rmse_unshifted_db == pytest.approx(curve[120], rel=1e-9)
    assert fit.reference == hand.middle
    assert fit.n == len(record.t)
    assert fit.window_s == 12.0


def test_the_evidence_is_that_of_whitened_residuals_over_lags_and_drifts(record, fit):
    hand = ByHand(record.t, record.m, record.prediction)
    plain = [hand.cost(hand.residual(shift), 0.0) for shift in LAGS]
    phi = hand.phi(hand.residual(LAGS[int(np.argmin(plain))]))
    assert 0.3 < phi < 0.6
    span = record.t[-1] - record.t[0]
    step = 2 * 0.1 / span  # the lag at the ends changes by one lag step
    assert step < DRIFT_LIMIT
    count = int(DRIFT_LIMIT / step + 1e-9)
    rates = [k * step for k in range(-count, count + 1)]
    table = np.array([[hand.cost(hand.residual(shift, rate), phi) for shift in LAGS] for rate in rates])
    still = table[len(rates) // 2]
    best = int(np.argmin(still))  # no drift where none shows
    assert len(hand.t) * np.log(still.min() / table.min()) < 10.83
    constant = hand.cost(hand.m, phi)
    cost = np.append(table.min(axis=0), constant)
    ratio = likelihood_ratios(cost, hand.whitened(hand.residual(LAGS[best]), phi))
    np.testing.assert_allclose(fit.evidence, ratio[:-1], rtol=1e-8, atol=1e-8)
    assert fit.verdict == "ok"


def test_the_lag_and_the_drift_are_where_the_whitened_residual_has_nothing_left_of_their_slopes(record, fit):
    """SciPy's spline through level and slope, its solver of equations, and the memory at the scan's optimum."""
    t, m, known = record.t, record.m, record.prediction.times()
    spline = CubicHermiteSpline(known, record.prediction.level, np.gradient(record.prediction.level, known))
    slope = spline.derivative()
    middle, half = (t[0] + t[-1]) / 2, 0.5 * (t[-1] - t[0])
    along = np.stack([np.ones(len(t)), (t - middle) / half])

    def residual(x):
        return m - spline(t - x @ along)

    hand = ByHand(t, m, record.prediction)
    phi = hand.phi(hand.residual(LAGS[int(np.argmin(fit.curve_rmse_db))]))
    coarse = LAGS[np.argsort([hand.cost(hand.residual(shift), phi) for shift in LAGS])[:5]]
    fine = [shift + 0.01 * k for shift in coarse for k in range(-6, 7)]
    start = np.array([fine[int(np.argmin([hand.cost(hand.residual(shift), phi) for shift in fine]))], 0.0])
    phi = hand.phi(residual(start))

    def whitened(x):
        r, jacobian = residual(x), slope(t - x @ along) * along
        columns = np.vstack([r, jacobian])
        columns = columns[:, 1:] - phi * columns[:, :-1]
        return columns - columns.mean(axis=1, keepdims=True)

    options = {"xatol": 1e-7, "fatol": 1e-6, "maxiter": 2000}
    least = minimize(lambda x: np.sum(whitened(x)[0] ** 2), start, method="Nelder-Mead", options=options).x
    best = root(lambda x: whitened(x)[1:] @ whitened(x)[0], least, tol=1e-12).x
    assert np.abs(least - best).max() < 2e-5  # which is the bottom of the valley
    assert fit.radio_minus_telemetry_s == pytest.approx(best[0], abs=2e-6)
    assert fit.drift_s_per_s * half == pytest.approx(best[1], abs=2e-6)
    left = residual(best)
    left = left - np.mean(left[1:] - phi * left[:-1]) / (1 - phi)
    assert fit.rmse_db == pytest.approx(float(np.sqrt(np.mean(left**2))), rel=1e-6)
    width = lag._sandwich(whitened(best)[0], whitened(best)[1:])
    low, high = fit.drift_interval_s_per_s
    assert (high - low) / 2 == pytest.approx(width[1] / half, rel=1e-4)
    assert (high + low) / 2 == pytest.approx(fit.drift_s_per_s, abs=1e-15)
    reach = np.hypot(width[0], 0.05 * 0.05)  # the prediction is sampled every 0.05 s
    possible = LAGS[fit.evidence <= 3.84]
    low, high = fit.ci95_s
    assert low == pytest.approx(min(fit.radio_minus_telemetry_s - reach, possible.min()), abs=1e-6)
    assert high == pytest.approx(max(fit.radio_minus_telemetry_s + reach, possible.max()), abs=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_no_step_leads_out_of_a_narrow_valley(seed):
    """Steep fades and residuals that remember: whole Gauss-Newton steps go from one side to the other, and up."""
    from scipy.signal import lfilter

    level = two_ray_flight(650)
    t, late = np.arange(0, 650, 0.05), 1.37 + 0.013 * seed
    noise = lfilter([1], [1, -0.8], np.random.default_rng(seed).normal(0, 1.8, len(t)))
    sampled = lag.sample(t, level(t - late) + noise, level, window_s=6.0, resolution_s=0.05)
    fit = fit_lag(sampled.t, sampled.measured_db, sampled.prediction, lag.symmetric(6.0, 0.1), 1.0, True)
    assert fit.radio_minus_telemetry_s == pytest.approx(late, abs=2.5e-3)
    assert fit.ci95_s[0] <= late <= fit.ci95_s[1]
    assert abs(fit.drift_s_per_s) < 1e-5


def test_free_terms_take_what_they_explain_at_every_lag():
    level, predictor, _ = patterned_flight(1)
    t = np.arange(0, 300, 0.25)
    measured = level(t - 0.8) + np.random.default_rng(4).normal(0, 2, len(t))
    sampled = lag.sample(t, measured, predictor, window_s=3.0, resolution_s=0.05)
    lags = lag.symmetric(3.0, 0.1)
    fit = fit_lag(sampled.t, sampled.measured_db, sampled.prediction, lags, 1.0, False)
    known, columns = sampled.prediction.times(), np.column_stack([sampled.prediction.level, sampled.prediction.terms])
    curve = []
    for shift in lags:
        at = sampled.t - shift
        seen = np.column_stack([np.interp(at, known, column) for column in columns.T])
        design = np.column_stack([np.ones(len(at)), seen[:, 1:]])[1:]
        y = sampled.measured_db - seen[:, 0]
        solved = np.linalg.lstsq(design, y[1:], rcond=None)[0]
        left = y - np.column_stack([np.ones(len(at)), seen[:, 1:]]) @ solved
        left = left - left.mean()
        curve.append(np.std(left[1:]))
    np.testing.assert_allclose(fit.curve_rmse_db, curve, rtol=1e-6)
    assert fit.radio_minus_telemetry_s == pytest.approx(0.8, abs=0.1)
    assert np.isnan(fit.drift_interval_s_per_s).all()
    assert fit.drift_s_per_s == 0.0


def test_interpolation_is_that_of_numpy_and_of_hermite_splines():
    rng = np.random.default_rng(5)
    level = rng.normal(0, 5, 60)
    prediction = lag._Prediction(-2.0, 0.25, level[:, None])
    known = prediction.times()
    assert known[[0, -1]].tolist() == [-2.0, -2.0 + 59 * 0.25]
    t = rng.uniform(-2.0, known[-1] - 0.26, 500)
    np.testing.assert_allclose(prediction.at(t), np.interp(t, known, level), rtol=0, atol=1e-12)
    spline = CubicHermiteSpline(known, level, np.gradient(level, 0.25))
    np.testing.assert_allclose(prediction.smooth_at(t), [spline(t), spline.derivative()(t)], rtol=0, atol=1e-9)
    outside = np.array([-2.0 - 1e-9, known[-1] + 1e-9, 99.0])
    assert np.isnan(prediction.at(outside)).all()
    assert np.isnan(prediction.smooth_at(outside)).all()
    assert prediction.smooth_at(known[7:8])[0] == level[7:8]
    assert prediction.at(known[:1]) == level[:1]
    terms = rng.normal(size=(60, 3))
    terms[30] = np.nan
    beside = prediction.beside(terms)
    assert np.isnan(beside.level[30])
    assert np.isfinite(np.delete(beside.level, 30)).all()
    t = t[np.abs(t - known[30]) > 0.25]
    np.testing.assert_allclose(
        beside.terms_at(t), np.column_stack([np.ones(len(t)), *(np.interp(t, known, c) for c in terms.T)]), atol=1e-12
    )
    assert np.isnan(beside.terms_at(known[29:30] + 0.01)[:, 1:]).all()


def test_instants_that_every_shift_reaches_have_no_gap_within_it():
    level = np.zeros(101)
    level[50] = np.nan  # at 10 s
    prediction = lag._Prediction(0.0, 0.2, level[:, None])
    t = np.array([0.9, 1.0, 5.0, 8.79, 9.0, 10.0, 11.0, 11.21, 19.0, 19.1])
    reached = [1.0 <= x <= 19.0 and abs(x - 10.0) > 1.0 + 1e-9 for x in t.tolist()]
    reached[3] = reached[7] = True
    assert prediction.common(t, 1.0).tolist() == reached


def test_a_record_shorter_than_what_a_lag_needs_costs_infinitely_much():
    rows = np.random.default_rng(6).normal(size=(4, 40))
    assert np.isinf(lag._costs(rows, 0.2, 41)).all()
    assert np.isfinite(lag._costs(rows, 0.2, 40)).all()
    assert lag._costs(rows, 0.2, 40).tolist() == [lag._cost(row, 0.2, 40) for row in rows]
    rows[1, 7] = np.nan
    assert np.isinf(lag._costs(rows, 0.2, 40)).tolist() == [False, True, False, False]


def test_samples_are_sorted_and_those_without_time_or_level_left_out():
    level = two_ray_flight(60)
    t = np.arange(0, 60, 0.5)
    measured = level(t)
    order = np.random.default_rng(7).permutation(len(t))
    gaps = measured.copy()
    gaps[[3, 8]] = np.nan
    sampled = lag.sample(t[order] + 1e4, gaps[order], lambda x: level(x - 1e4), window_s=2.0, resolution_s=0.1)
    first = t[order][0]  # the zero of the seconds is the first instant that was logged
    kept = np.delete(t, [3, 8])
    assert np.all(np.diff(sampled.t) > 0)
    np.testing.assert_allclose(sampled.t, kept - first, atol=1e-6)
    np.testing.assert_allclose(sampled.measured_db, np.delete(measured, [3, 8]))
    known = sampled.prediction.times()
    assert known[0] == pytest.approx(sampled.t[0] - 4.0 - DRIFT_LIMIT * 59.5, abs=1e-6)
    assert known[-1] >= sampled.t[-1] + 4.0
    np.testing.assert_allclose(sampled.prediction.level, level(known + first), atol=1e-5)
    given = lag.sample(t, measured, level, window_s=2.0, resolution_s=0.1, origin_ns=-5_000_000_000)
    np.testing.assert_allclose(given.t, t + 5.0, atol=1e-9)
    assert lag.sample(t[:29], measured[:29], level, window_s=2.0, resolution_s=0.1) == "too few samples (29)"
    assert not isinstance(lag.sample(t[:30], measured[:30], level, window_s=2.0, resolution_s=0.1), str)


def test_a_short_flight_keeps_what_has_a_prediction_without_a_lag():
    """Where few samples can be shifted by the whole window all count that have a prediction as they are."""
    t = np.arange(0, 100, 0.5)
    measured = np.sin(t)

    def predictor(x):
        return np.where((x > 20) & (x < 60), np.sin(x), np.nan)

    wide = lag.sample(t, measured, predictor, window_s=12.0, resolution_s=0.1)  # 40 s less 24: 16 % of all
    inside = (t > 20.15) & (t < 59.85)
    assert len(wide.t) == inside.sum()
    narrow = lag.sample(t, measured, predictor, window_s=1.0, resolution_s=0.1)
    assert len(narrow.t) < inside.sum()
    assert narrow.t[0] >= 21.1
    assert narrow.t[-1] <= 58.9
    nothing = lag.sample(t, measured, lambda x: np.full(len(x), np.nan), window_s=1.0, resolution_s=0.1)
    assert "do not overlap" in nothing


def test_drifts_are_tried_by_steps_of_a_lag_at_the_ends():
    rates = lag._rates(1800.0, 0.1)
    step = 0.2 / 1800.0
    assert rates[1] - rates[0] == pytest.approx(step)
    assert rates.max() == pytest.approx(step * int(DRIFT_LIMIT / step))
    assert rates[len(rates) // 2] == 0.0
    assert lag._rates(100.0, 0.1).tolist() == [-DRIFT_LIMIT, 0.0, DRIFT_LIMIT]


def test_costs_that_are_equal_go_to_the_lag_nearest_zero():
    lags = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    assert lag.best_of(np.array([1.0, 2.0, 3.0, 1.0, 1.0]), lags) == 3
    assert lag.best_of(np.array([1.0, np.nan, 3.0, 1.0 + 1e-9, 1.0]), lags) == 0
    assert lag.best_of(np.array([1.0, 2.0, 3.0, 1.0 + 1e-13, 2.0]), lags) == 3


def test_a_finer_grid_is_searched_around_the_five_best_of_the_scan():
    lags = lag.symmetric(2.0, 0.1)
    cost = np.abs(lags - 0.5) + 1.0
    asked = []

    def costs_at(tried):
        asked.append(tried)
        return np.abs(tried - 0.537) + 1.0

    cost[3] = np.nan
    assert lag._between(cost, lags, costs_at) == pytest.approx(0.54, abs=1e-9)
    around = np.unique(np.round(asked[0], 6))
    np.testing.assert_allclose(around, np.round(np.arange(24, 77) * 0.01, 6), atol=1e-6)


RATIO = np.where(np.abs(LAGS - 2.0) < 0.25, 0.0, 50.0)
JUDGED = [
    # lag, width, ratio, limit, verdict, word of the reason, interval
    (2.0, 0.5, RATIO, 1.0, "ok", "", (1.5, 2.5)),
    (2.0, 0.1, RATIO, 1.0, "ok", "", (1.8, 2.2)),
    (2.0, 1.1, RATIO, 1.0, "ambiguous", "too wide", (0.9, 3.1)),
    (2.0, 1.1, RATIO, 1.2, "ok", "", (0.9, 3.1)),
    (10.4, 0.1, np.where(np.abs(LAGS - 10.4) < 0.25, 0.0, 50.0), 1.0, "failed", "near the edge", (10.2, 10.6)),
    (10.3, 0.1, np.where(np.abs(LAGS - 10.3) < 0.25, 0.0, 50.0), 1.0, "ok", "", (10.1, 10.5)),
    (-10.4, 0.1, np.where(np.abs(LAGS + 10.4) < 0.25, 0.0, 50.0), 1.0, "failed", "near the edge", (-10.6, -10.2)),
    (2.0, 0.1, np.where(np.abs(LAGS + 5.0) < 0.05, 10.8, RATIO), 1.0, "ambiguous", "such as -5.0 s", (1.8, 2.2)),
    (2.0, 0.1, np.where(np.abs(LAGS + 5.0) < 0.05, 10.9, RATIO), 1.0, "ok", "", (1.8, 2.2)),
    (2.0, 0.1, np.where(np.abs(LAGS - 3.0) < 0.05, 5.0, RATIO), 1.0, "ok", "", (1.8, 2.2)),
    (2.0, 0.1, np.where(np.abs(LAGS - 3.1) < 0.05, 5.0, RATIO), 1.0, "ambiguous", "such as +3.1 s", (1.8, 2.2)),
    (0.0, 0.1, np.full(len(LAGS), 1.0), 1.0, "ambiguous", "hardly depends on the lag", (-12.0, 12.0)),
    (11.9, 20.0, np.full(len(LAGS), 10.0), 1.0, "ambiguous", "hardly depends on the lag", None),
]


@pytest.mark.parametrize(("at", "width", "ratio", "limit", "verdict", "word", "interval"), JUDGED)
def test_a_verdict_follows_from_the_width_of_the_valley_and_from_its_rivals(
    at, width, ratio, limit, verdict, word, interval
):
    if interval is None:  # nothing within 3.84 but the best itself
        ratio = ratio.copy()
        ratio[-2] = 0.0
        interval = (-8.1, 12.0)
    said = lag._judge(at, width, ratio, LAGS, limit)
    assert said[0] == verdict
    assert word in said[1]
    assert (said[1] == "") == (verdict == "ok")
    assert said[2] == pytest.approx(interval, abs=1e-9)


def made_fit(place, evidence, *, half=0.3, n=100, rmse=3.0, drift=0.0, verdict="ok"):
    return lag.LagFit(
        radio_minus_telemetry_s=place,
        ci95_s=(place - half, place + half),
        drift_s_per_s=drift,
        drift_interval_s_per_s=(drift - 1e-6, drift + 1e-6),
        verdict=verdict,
        reason="",
        reference=70.0,
        n=n,
        rmse_db=rmse,
        rmse_unshifted_db=2.0 * rmse,
        window_s=12.0,
        curve_lag_s=LAGS,
        curve_rmse_db=np.full(len(LAGS), rmse),
        evidence=evidence,
    )


def test_evidence_of_channels_adds_up_to_seven_tenths_and_errors_by_samples():
    one = made_fit(1.0, 100.0 * (LAGS - 1.0) ** 2, half=0.2, n=300, rmse=3.0, drift=2e-6)
    two = made_fit(1.2, 400.0 * (LAGS - 1.2) ** 2, half=0.1, n=100, rmse=5.0, drift=3e-6)
    both = combine_lags([one, two])
    total = 0.7 * (one.evidence + two.evidence)
    np.testing.assert_allclose(both.evidence, total - total.min(), atol=1e-9)
    assert both.n == 400
    assert both.rmse_db == pytest.approx(np.sqrt((300 * 9 + 100 * 25) / 400))
    assert both.rmse_unshifted_db == pytest.approx(2 * both.rmse_db)
    np.testing.assert_allclose(both.curve_rmse_db, both.rmse_db)
    # the sharpest is within a step of the best of the sum (1.16: 1.2 on the grid), and finer than it
    assert both.radio_minus_telemetry_s == 1.2
    assert both.drift_s_per_s == 3e-6
    assert both.drift_interval_s_per_s == two.drift_interval_s_per_s
    assert (both.reference, both.window_s, both.verdict) == (70.0, 12.0, "ok")
    possible = LAGS[both.evidence <= 3.84]
    assert both.ci95_s == pytest.approx((min(1.1, possible.min()), max(1.3, possible.max())))


def test_a_sharp_fit_far_from_the_best_of_all_gives_way_to_it():
    sharp = made_fit(4.0, 10.0 * (LAGS - 4.0) ** 2, half=0.05)
    strong = made_fit(1.0, 1000.0 * (LAGS - 1.0) ** 2, half=0.2)
    both = combine_lags([sharp, strong])
    assert both.radio_minus_telemetry_s == pytest.approx(1.0, abs=0.051)
    assert both.ci95_s[1] - both.ci95_s[0] >= 0.1 - 1e-9  # a step of the grid: no sharper than that
    # fits that agree within half a step are believed, wherever the grid has its least value
    shifted = 1000.0 * (LAGS - 2.0) ** 2
    agreeing = combine_lags([made_fit(1.02, shifted, half=0.05), made_fit(1.05, shifted, half=0.2)])
    assert agreeing.radio_minus_telemetry_s == 1.02
    apart = combine_lags([made_fit(1.02, shifted, half=0.05), made_fit(1.08, shifted, half=0.2)])
    assert apart.radio_minus_telemetry_s == pytest.approx(2.0)
    doubtful = combine_lags([made_fit(1.0, shifted, half=0.005, verdict="ambiguous"), made_fit(1.0, shifted)])
    assert doubtful.ci95_s[1] - doubtful.ci95_s[0] >= 0.1 - 1e-9


def test_evidence_without_end_does_not_drown_the_other_channel():
    one = made_fit(1.0, np.where(np.abs(LAGS - 1.0) < 0.05, 0.0, np.inf), half=0.2)
    two = made_fit(1.0, 50.0 * (LAGS - 1.0) ** 2, half=0.3)
    both = combine_lags([one, two])
    assert np.isfinite(both.evidence).all()
    assert both.evidence.max() == pytest.approx(0.7 * (1e6 + two.evidence.max()))
    assert both.radio_minus_telemetry_s == 1.0


def test_times_are_corrected_by_subtracting_lag_and_drift():
    fit = made_fit(1.5, LAGS * 0, drift=1e-4)
    t = np.array([1000.0, 1100.0, 1300.0])
    late = 1.5 + 1e-4 * (np.array([0.0, 100.0, 300.0]) - 70.0)
    np.testing.assert_allclose(fit.apply(t), t - late, atol=1e-12)
    stamps = np.datetime64("2025-03-02T12:00:00", "ns") + (t * 1e9).astype("timedelta64[ns]")
    moved = (stamps - fit.apply(stamps)) / np.timedelta64(1, "s")
    np.testing.assert_allclose(moved, late, atol=1e-9)


def test_a_drift_needs_ten_minutes_unless_it_is_asked_for():
    level = two_ray_flight(700)
    for span, fitted in ((590.0, False), (601.0, True)):
        t = np.arange(0, span, 0.5)
        measured = level(t) + np.random.default_rng(8).normal(0, 2, len(t))
        assert np.isfinite(estimate_lag(t, measured, level).drift_interval_s_per_s).all() == fitted
        assert np.isfinite(estimate_lag(t, measured, level, drift=True).drift_interval_s_per_s).all()
        assert np.isnan(estimate_lag(t, measured, level, drift=False).drift_interval_s_per_s).all()
    coarse = estimate_lag(t, measured, level, resolution_s=0.5)
    assert coarse.curve_lag_s[1] - coarse.curve_lag_s[0] == pytest.approx(0.5)
    assert estimate_lag(t, measured, level, resolution_s=0.02).curve_lag_s[1] - coarse.curve_lag_s[0] > 0
    assert dataclasses.replace(coarse, n=5).as_dict()["n"] == 5


@pytest.mark.parametrize("drifting", [False, True])
def test_a_free_term_moves_with_the_lag_and_its_coefficient_is_that_of_least_squares(drifting):
    """One term: lag, drift and coefficient at once, by SciPy's solver on the whitened residual."""
    level = two_ray_flight(300)
    t = np.arange(0, 300, 0.1)

    def term(x):
        return np.cos(2 * np.pi * np.asarray(x) / 41.0)

    from scipy.signal import lfilter

    noise = lfilter([1], [1, -0.6], np.random.default_rng(12).normal(0, 0.8, len(t)))
    heard = level(t - 0.83) + 4.0 * term(t - 0.83) - 20.0 + noise
    sampled = lag.sample(t, heard, lambda x: np.column_stack([level(x), term(x)]), window_s=3.0, resolution_s=0.05)
    t, m, prediction = sampled.t, sampled.measured_db, sampled.prediction
    middle, half = (t[0] + t[-1]) / 2, 0.5 * (t[-1] - t[0])
    start = np.array([0.83, 0.0])[: 1 + drifting]
    (late, rate), (width, rate_width), rmse = lag._refine(t, m, prediction, middle, start)
    known = prediction.times()
    spline = CubicHermiteSpline(known, prediction.level, np.gradient(prediction.level, known))
    along = np.stack([np.ones(len(t)), (t - middle) / half])[: 1 + drifting]

    def parts(x):
        at = t - x @ along
        design = np.column_stack([np.ones(len(t)), np.interp(at, known, prediction.terms[:, 0])])
        return (
            m - spline(at),
            design,
            spline.derivative()(at),
            np.interp(at, known, np.gradient(prediction.terms[:, 0], known)),
        )

    y, design, *_ = parts(np.array([0.83, 0.0])[: 1 + drifting])
    left = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
    phi = float(left[1:] @ left[:-1] / (left @ left)) if abs(left.mean()) < 1e-9 else np.nan

    def whitened(x):
        y, design, slope, moved = parts(x)
        base = design[1:] - phi * design[:-1]
        coefficient = np.linalg.lstsq(base, y[1:] - phi * y[:-1], rcond=None)[0]
        columns = np.vstack([y, (slope + moved * coefficient[1]) * along])
        columns = columns[:, 1:] - phi * columns[:, :-1]
        return columns - (base @ np.linalg.lstsq(base, columns.T, rcond=None)[0]).T, y - design @ coefficient

    best = root(lambda x: whitened(x)[0][1:] @ whitened(x)[0][0], start, tol=1e-12).x
    assert late == pytest.approx(best[0], abs=2e-6)
    assert late == pytest.approx(0.83, abs=0.01)
    expected = lag._sandwich(whitened(best)[0][0], whitened(best)[0][1:])
    assert width == pytest.approx(expected[0], rel=1e-3)
    assert rmse == pytest.approx(float(np.sqrt(np.mean(whitened(best)[1] ** 2))), rel=1e-6)
    if drifting:
        assert rate * half == pytest.approx(best[1], abs=2e-6)
        assert rate_width == pytest.approx(expected[1] / half, rel=1e-3)
    else:
        assert (rate, np.isnan(rate_width)) == (0.0, True)


def test_a_valley_that_is_not_there_leaves_the_place_of_the_scan():
    """A flat level has no bottom: Gauss-Newton would walk away."""
    t = np.arange(0, 100, 0.5)
    prediction = lag._Prediction(-20.0, 0.1, (1e-6 * np.sin(np.arange(1400) / 40.0))[:, None])
    heard = np.random.default_rng(13).normal(0, 3, len(t))
    (late, rate), _, rmse = lag._refine(t, heard, prediction, 50.0, np.array([1.23, 1e-5]))
    assert (late, rate) == (1.23, pytest.approx(1e-5))
    assert rmse == pytest.approx(np.std(heard), rel=0.02)


def test_terms_of_direction_are_harmonics_of_where_each_end_sees_the_other():
    azimuth, elevation, relative = np.radians([[10.0, 200.0], [5.0, 40.0], [300.0, 77.0]])
    terms = lag.direction_terms([10.0, 200.0], [5.0, 40.0], [300.0, 77.0])
    expected = [
        elevation, elevation**2, np.cos(azimuth), np.sin(azimuth), np.cos(2 * azimuth), np.sin(2 * azimuth),
        np.cos(relative), np.sin(relative), np.cos(2 * relative), np.sin(2 * relative),
        np.cos(relative) * elevation, np.sin(relative) * elevation,
    ]  # fmt: skip
    np.testing.assert_allclose(terms, np.transpose(expected), atol=1e-15)
    # a UAV 30 m north, 30 m east and up of the tower, its nose to the north: the tower is behind it, to the left
    place, position = np.array([[100.0, 50.0, 10.0]]), np.array([[130.0, 80.0, 10.0 + np.hypot(30.0, 30.0)]])
    np.testing.assert_allclose(
        lag.terms_from(place, position, np.array([0.0])), lag.direction_terms([45.0], [45.0], [225.0]), atol=1e-12
    )
    np.testing.assert_allclose(
        lag.terms_from(place, position, np.array([90.0])), lag.direction_terms([45.0], [45.0], [135.0]), atol=1e-12
    )


def test_the_prediction_is_asked_at_its_own_instants_to_the_nanosecond():
    t = np.arange(0, 1000, 0.5)
    sampled = lag.sample(t, np.sin(t), lambda x: x, window_s=2.0, resolution_s=0.1)
    np.testing.assert_allclose(sampled.prediction.level, sampled.prediction.times(), rtol=0, atol=2e-9)
    stamps = np.datetime64("2025-03-02T12:00:00", "ns") + (t * 1e9).astype("timedelta64[ns]")
    asked = []

    def predictor(x):
        asked.append(x)
        return np.zeros(len(x))

    sampled = lag.sample(stamps, np.sin(t), predictor, window_s=2.0, resolution_s=0.1)
    since = (asked[0] - stamps[0]) / np.timedelta64(1, "ns")
    np.testing.assert_allclose(since, sampled.prediction.times() * 1e9, rtol=0, atol=1.0)


def test_what_is_shown_of_a_fit_leaves_its_curves_out():
    fit = made_fit(1.0, LAGS**2)
    assert "curve" not in repr(fit)
    assert "evidence" not in repr(fit)
    assert f"verdict={fit.verdict!r}" in repr(fit)


def test_evidence_does_not_depend_on_the_unit_of_the_level():
    rng = np.random.default_rng(16)
    cost, runs = np.array([1.0, 2.0, 3.0]), np.repeat(rng.normal(size=400), 20)
    for unit in (1e-3, 1e3):
        np.testing.assert_allclose(
            lag._likelihood_ratios(cost * unit**2, runs * unit), lag._likelihood_ratios(cost, runs), rtol=1e-9
        )
    assert lag._likelihood_ratios(np.array([0.0, 0.0, 1.0]), runs).tolist() == [0.0, 0.0, np.inf]
    assert lag._likelihood_ratios(np.array([1.0, np.inf, 1.0]), runs).tolist() == [0.0, np.inf, 0.0]
    np.testing.assert_allclose(lag._likelihood_ratios(cost, np.zeros(50)), 50 * np.log(cost), rtol=1e-12)


@pytest.mark.parametrize(("drift", "kept"), [(1.1, True), (1.5, False), (-1.5, False)])
def test_a_drift_well_beyond_the_search_is_not_followed(drift, kept):
    level = two_ray_flight(700)
    t = np.arange(0, 700, 0.2)
    late = 0.5 + drift * DRIFT_LIMIT * (t - t[-1] / 2)
    heard = level(t - late) + np.random.default_rng(17).normal(0, 0.5, len(t))
    s = lag.sample(t, heard, level, window_s=3.0, resolution_s=0.05)
    (found, rate), _, _ = lag._refine(
        s.t, s.measured_db, s.prediction, (s.t[0] + s.t[-1]) / 2, np.array([0.5, drift * DRIFT_LIMIT * 0.98])
    )
    if kept:
        assert rate == pytest.approx(drift * DRIFT_LIMIT, rel=0.01)
        assert found == pytest.approx(0.5, abs=0.01)
    else:
        assert (found, rate) == (0.5, pytest.approx(drift * DRIFT_LIMIT * 0.98, rel=1e-12))


def test_thirty_samples_are_enough_for_a_fit_and_say_nothing_of_an_overlap():
    level = two_ray_flight(60)
    for n, words in ((29, "too few samples (29)"), (30, "")):
        t = np.arange(n) * 2.0
        fit = estimate_lag(t, level(t - 0.3), level, window_s=2.0)
        assert words in fit.reason
        assert (fit.n, "overlap" in fit.reason) == (n * (n >= 30), False)
    assert fit.radio_minus_telemetry_s == pytest.approx(0.3, abs=0.05)


def test_terms_that_are_all_but_alike_take_no_direction_of_noise():
    """What tells them apart by a ten-millionth is rounding: it must not be fitted."""
    rng = np.random.default_rng(18)
    wave, noise = np.cos(np.arange(400) / 9.0), rng.normal(size=400)
    terms = np.stack([np.ones(400), wave, wave + 1e-7 * noise], axis=1)[None]
    y = (5.0 * wave + 3.0 * noise)[None]
    for phi in (0.0, 0.5):
        for left in (lag._without_terms(y, terms, phi)[0], y[0] - lag._explained(y[0], terms[0], phi)):
            assert np.std(left) == pytest.approx(np.std(3.0 * noise), rel=0.02)
            assert np.corrcoef(left, noise)[0, 1] > 0.99


def test_memory_is_taken_as_099_at_most_and_as_none_where_neighbours_differ():
    walk = np.cumsum(np.random.default_rng(19).normal(size=20_000))
    assert lag._phi(walk) == 0.99
    assert lag._phi(np.tile([1.0, -1.0], 500)) == 0.0
    assert lag._phi(np.full(50, 3.0)) == 0.0
    gap = np.where(np.arange(20_000) % 7 == 0, np.nan, walk)
    assert lag._phi(gap) == 0.99


def test_a_lag_that_leaves_less_than_half_of_the_samples_is_no_candidate():
    t = np.arange(0, 100, 0.5)
    prediction = lag._Prediction(0.0, 0.1, (10 * np.sin(np.arange(601) / 13.0))[:, None])  # 0 to 60 s
    heard = np.interp(t - 1.0, prediction.times(), prediction.level) + np.random.default_rng(20).normal(0, 0.1, 200)
    fit = fit_lag(t, heard, prediction, LAGS, 1.0, False)
    share = [np.mean((t - shift >= 0) & (t - shift < 60.0)) for shift in LAGS]
    assert 0.45 < min(share) < 0.5 < max(share)
    assert (np.isinf(fit.curve_rmse_db) == (np.array(share) < 0.5)).all()
    assert np.isinf(fit.evidence[np.array(share) < 0.5]).all()
    assert fit.radio_minus_telemetry_s == pytest.approx(1.0, abs=0.01)


def test_the_limits_are_those_that_the_documents_state():
    """docs/statistics.md: rivals beyond 1 s, at 0.1 % significance; drifts up to 10 ms per minute, from ten minutes on."""
    from scipy.stats import chi2

    assert lag.LAG_LIMIT_S == 1.0
    assert pytest.approx(10e-3 / 60.0) == lag.DRIFT_LIMIT
    assert pytest.approx(chi2.ppf(0.999, 1), abs=0.01) == lag._RIVAL
    assert lag.DRIFT_FROM_S == 600.0


def test_a_record_without_noise_is_no_trouble():
    """A simulation on another one: the residual is zero to the last digit at the true lag, with and without drifts tried."""
    t = np.arange(0, 1300, 0.5)
    prediction = lag._Prediction(-20.0, 0.5, (10 * np.sin(np.arange(2700) / 13.0) + np.arange(2700) % 7)[:, None])
    heard = prediction.at(t - 1.0)
    for drifting in (False, True):
        fit = fit_lag(t, heard, prediction, LAGS[::5], 1.0, drifting)
        assert (fit.verdict, fit.drift_s_per_s) == ("ok", pytest.approx(0.0, abs=1e-12))
        assert fit.radio_minus_telemetry_s == pytest.approx(1.0, abs=1e-9)
        assert fit.rmse_db < 1e-9

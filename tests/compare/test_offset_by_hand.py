"""Offsets against brute force: likelihoods of censored samples, trimmed windows, pooled means, edges and ties."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import norm

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.compare.offset import (
    ReferencePower,
    censored_offset,
    difference_moments,
    expected_offset_db,
    grid_offset,
    identifiable_range,
    nearest_offset,
    offset_curve,
    offset_grid,
    pooled_moments,
    read_reference_powers,
    reference_power_dbm,
    trimmed_offset,
)

NAN = float("nan")


def pooled_offsets(pairs, per="link"):
    """One offset for all sequences of a group."""
    return pooled_moments({key: difference_moments(*levels) for key, levels in pairs.items()}, per)


def tobit_by_hand(full, above, below):
    """Mean and standard deviation of most likelihood, by SciPy's distribution and simplex."""

    def negative(x):
        mean, sigma = x[0], math.exp(x[1])
        likely = norm.logpdf(full, mean, sigma).sum()
        return -(likely + norm.logsf(above, mean, sigma).sum() + norm.logcdf(below, mean, sigma).sum())

    options = {"xatol": 1e-9, "fatol": 1e-12, "maxiter": 20_000, "maxfev": 20_000}
    start = [np.mean(full), math.log(np.std(full) + 0.1)]
    best = minimize(negative, start, method="Nelder-Mead", options=options).x
    return best[0], math.exp(best[1])


@pytest.mark.parametrize("sides", ["measured", "simulated", "both"])
@pytest.mark.parametrize("share", [0.1, 0.6])
@pytest.mark.parametrize("seed", [1])
def test_the_censored_fit_is_that_of_most_likelihood(seed, share, sides):
    """Below either floor or both, few samples or most: the mean is far from that of the pairs that are known."""
    rng = np.random.default_rng(seed)
    simulated = rng.uniform(-100, -60, 400)
    measured = simulated + 20.0 + rng.normal(0, 7, 400)
    measured_floor = np.quantile(measured, share) if sides != "simulated" else -300.0
    simulated_floor = np.quantile(simulated, share) if sides != "measured" else -300.0
    fit = censored_offset(
        measured, simulated, measured_floor_db=measured_floor, simulated_floor_db=simulated_floor, step_db=1e-5,
        span_db=(-60.0, 20.0),
    )  # fmt: skip
    low_m, low_s = measured <= measured_floor, simulated <= simulated_floor
    full = (simulated - measured)[~low_m & ~low_s]
    above = (simulated - measured_floor)[low_m & ~low_s]
    below = (simulated_floor - measured)[~low_m & low_s]
    mean, sigma = tobit_by_hand(full, above, below)
    assert fit.offset_db == pytest.approx(mean, abs=2e-3)
    assert fit.sigma_db == pytest.approx(sigma, abs=2e-3)
    assert (fit.n, fit.n_measured_below, fit.n_simulated_below, fit.n_both_below) == (
        len(full), len(above), len(below), int((low_m & low_s).sum()),
    )  # fmt: skip
    assert not fit.at_edge
    if share > 0.5:
        assert abs(full.mean() - mean) > 1.0 or sides == "both"


def test_levels_that_are_all_alike_leave_a_spread_of_a_thousandth():
    fit = censored_offset([-60.0] * 5, [-50.0] * 5, measured_floor_db=-100, simulated_floor_db=-100)
    assert fit.offset_db == 10.0
    assert fit.sigma_db == pytest.approx(1e-3, rel=1e-6)
    spread = censored_offset([-60.0, -60.4], [-50.0] * 2, measured_floor_db=-100, simulated_floor_db=-100)
    assert spread.sigma_db == pytest.approx(0.2, rel=1e-4)


@pytest.mark.parametrize("difference", [50.0, -50.0, 49.9, -49.9, 0.0])
def test_every_fit_tells_the_edge_of_its_grid(difference):
    edge = abs(difference) == 50.0
    measured, simulated = np.zeros(10), np.full(10, difference) + np.tile([-0.01, 0.01], 5)
    assert grid_offset(measured, simulated).at_edge == edge
    assert trimmed_offset(measured, simulated).at_edge == edge
    assert trimmed_offset(measured, simulated).offset_db == difference
    assert censored_offset(measured, simulated, measured_floor_db=-99, simulated_floor_db=-99).at_edge == edge
    (shared,) = pooled_offsets({("f", "t", "c"): (measured, simulated)}, "all").values()
    assert (shared.at_edge, shared.offset_db) == (edge, difference)


def test_nothing_known_is_no_number_and_no_edge():
    for fit in (
        grid_offset([NAN], [1.0]), trimmed_offset([NAN], [1.0]),
        *pooled_offsets({("f", "t", "c"): ([NAN], [1.0])}).values(),
    ):  # fmt: skip
        assert np.isnan([fit.offset_db, fit.rmse_db]).all()
        assert (fit.n, fit.at_edge) == (0, False)
    none = censored_offset([NAN], [1.0], measured_floor_db=-9, simulated_floor_db=-9)
    assert np.isnan([none.offset_db, none.sigma_db]).all()
    assert (none.n, none.n_measured_below, none.n_simulated_below, none.n_both_below, none.at_edge) == (
        0,
        1,
        0,
        0,
        False,
    )


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("keep", [0.51, 0.7, 0.95, 1.0])
def test_the_trimmed_fit_is_that_of_the_smallest_residuals_at_every_offset(keep, seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(5, 40))
    measured, simulated = rng.normal(-60, 4, n), rng.normal(-57, 4, n) + 15 * (rng.random(n) < 0.2)
    kept = math.ceil(keep * n - 1e-9)
    grid = np.arange(-100, 101) / 2
    brute = [np.sqrt(np.mean(np.sort((measured + o - simulated) ** 2)[:kept])) for o in grid]
    fit = trimmed_offset(measured, simulated, keep=keep, step_db=0.5)
    assert fit.n == kept
    assert fit.rmse_db == pytest.approx(min(brute), abs=1e-9)
    assert fit.offset_db == grid[int(np.argmin(brute))]


def test_ties_of_the_trimmed_fit_go_to_the_offset_nearer_zero():
    # half a step either way of an even pair is as good
    assert trimmed_offset(np.zeros(2), [2.0, 3.0], keep=1.0, step_db=1.0).offset_db == 2.0
    assert trimmed_offset(np.zeros(2), [-2.0, -3.0], keep=1.0, step_db=1.0).offset_db == -2.0
    for wrong in (0.5, 1.01, NAN):
        with pytest.raises(ValueError, match="keep must be above"):
            trimmed_offset([0.0], [1.0], keep=wrong)


@pytest.mark.parametrize(
    ("per", "axes"), [("link", (0, 1, 2)), ("tower", (1,)), ("channel", (2,)), ("flight", (0,)), ("all", ())]
)
def test_pooled_offsets_are_those_of_all_pairs_of_the_group(per, axes):
    rng = np.random.default_rng(4)
    pairs = {
        (f, t, c): (rng.normal(-60, 3, n), rng.normal(-55, 3, n) + 3 * i)
        for i, (f, t, c, n) in enumerate(
            [("f1", "A", "x", 7), ("f1", "A", "y", 3), ("f1", "B", "x", 11), ("f2", "A", "x", 5), ("f2", "B", "y", 2)]
        )
    }
    pairs = {("f0", "C", "z"): ([NAN], [0.0]), **pairs, ("f2", "B", "x"): ([NAN], [0.0])}
    fits = pooled_offsets(pairs, per)
    assert list(fits) == list(pairs)
    for key, (measured, simulated) in pairs.items():
        mates = [p for k, p in pairs.items() if [k[a] for a in axes] == [key[a] for a in axes]]
        together = grid_offset(np.concatenate([m for m, _ in mates]), np.concatenate([s for _, s in mates]))
        fit = fits[key]
        if np.isnan(together.offset_db):
            assert np.isnan(fit.offset_db)
            continue
        assert fit.offset_db == together.offset_db
        assert fit.at_edge == together.at_edge
        if np.isfinite(measured).any():
            assert fit.rmse_db == pytest.approx(
                float(np.sqrt(np.mean((np.asarray(measured) + fit.offset_db - simulated) ** 2)))
            )
            assert fit.n == len(measured)
        else:
            assert (fit.n, np.isnan(fit.rmse_db)) == (0, True)
    moments = {key: difference_moments(*levels) for key, levels in pairs.items()}
    again = pooled_moments(moments, per)
    assert str(again) == str(fits)


def test_the_curve_and_the_range_that_it_leaves():
    measured, simulated = np.array([-60.0, -61.0, NAN]), np.array([-55.0, -54.0, 0.0])
    offsets, curve = offset_curve(measured, simulated, step_db=0.5, span_db=(0.0, 12.0))
    np.testing.assert_allclose(curve, [np.sqrt(((o - 5) ** 2 + (o - 7) ** 2) / 2) for o in offsets])
    assert identifiable_range(offsets, curve) == (6.0, 6.0)
    within = [o for o, c in zip(offsets, curve, strict=True) if c <= curve.min() + 1.0]
    assert identifiable_range(offsets, curve, excess_db=1.0) == (within[0], within[-1])
    assert np.isnan(offset_curve([NAN], [1.0])[1]).all()
    assert np.isnan(identifiable_range(*offset_curve([NAN], [1.0]))).all()


@pytest.mark.parametrize(
    ("step", "first", "last"), [(0.1, -50.0, 50.0), (0.25, -50.0, 50.0), (0.3, -49.8, 49.8), (3.0, -48.0, 48.0)]
)
def test_the_grid_is_the_multiples_of_its_step(step, first, last):
    grid = offset_grid(step)
    assert (grid[0], grid[-1]) == pytest.approx((first, last), abs=1e-12)
    assert len(grid) == round((last - first) / step) + 1
    k = np.round(grid / step)
    np.testing.assert_allclose(grid, k * step, rtol=1e-15)
    if step in (0.1, 0.25):
        assert (grid == k / round(1 / step)).all()  # each correctly rounded
    with pytest.raises(ValueError, match="no multiple"):
        offset_grid(3.0, (1.0, 2.0))
    with pytest.raises(ValueError, match="must be finite"):
        offset_grid(-0.1)
    with pytest.raises(ValueError, match="must be finite"):
        offset_grid(0.1, (-50.0, math.inf))
    assert offset_grid(0.1, (0.3, 0.3)).tolist() == [0.3]
    assert nearest_offset(np.array([-1.0, 0.0, 1.0]), 0.5, 1.0) == 1
    assert nearest_offset(np.array([-1.0, 0.0, 1.0]), -0.5, 1.0) == 1
    assert nearest_offset(np.array([-1.0, 0.0, 1.0]), 0.6, 1.0) == 2


def test_powers_between_and_beyond_the_carriers_of_the_table():
    one = ReferencePower(
        "lw1", "rx", "ch0", False, 30.0, np.array([3.3e9, 3.4e9, 3.5e9]), np.array([-10.0, NAN, -14.0])
    )
    assert one.at(3.35e9) == pytest.approx(-11.0)
    assert one.at(3.3e9) == -10.0
    assert np.isnan(one.at(3.29e9))
    assert np.isnan(one.at(3.51e9))
    none = ReferencePower("lw1", "rx", "ch0", False, 30.0, np.array([3.3e9]), np.array([NAN]))
    assert np.isnan(none.at(3.3e9))


def test_a_setting_is_found_by_all_its_words_and_the_nearest_gain_within_half_a_decibel(tmp_path):
    path = tmp_path / "refs.csv"
    rows = [
        "LW1,RX,CH0,0,30.0,-10",
        "lw1,rx,ch0,0,30.6,-11",
        "lw1,rx,ch0,1,30.0,-40",
        "lw1,tx,ch0,0,30.0,5",
        "lw1,rx,ch1,0,30.0,-20",
    ]
    path.write_text("Node,Category,Channel,PA_Enabled,Gain,Freq_3.4GHz\n" + "\n".join(rows) + "\n")
    table = read_reference_powers(path)
    assert [(one.node, one.category, one.channel, one.amplifier, one.gain_db) for one in table[:1]] == [
        (
            "lw1",
            "rx",
            "ch0",
            False,
            30.0,
        )
    ]
    assert table[0].frequencies_hz.tolist() == [3.4e9]

    def power(gain=30.0, **other):
        given = {"node": "lw1", "category": "rx", "channel": "CH0", "frequency_hz": 3.4e9} | other
        return reference_power_dbm(table, gain_db=gain, **given)

    assert [power(), power(30.29), power(30.31), power(31.1)] == [-10.0, -10.0, -11.0, -11.0]
    assert np.isnan([power(31.11), power(29.49), power(channel="ch2"), power(node="lw2")]).all()
    assert (power(29.5), power(amplifier=True), power(category="tx"), power(channel="ch1")) == (
        -10.0,
        -40.0,
        5.0,
        -20.0,
    )
    assert expected_offset_db(
        receiver_reference_dbm=-11.0, transmitter_reference_dbm=2.0, simulated_transmit_dbm=7.0
    ) == pytest.approx(-11.0 - 2.0 + 7.0)


@pytest.mark.parametrize(
    "header",
    [
        "Node,Category,Channel,PA,Gain,Freq_3.4GHz", "Node,Category,Channel,PA_Enabled,Gain",
        "Node,Category,Channel,PA_Enabled,Gain,Freq_3.4GHz,Note", "Node,Category,Channel,PA_Enabled,Gain,Freq_3.4",
        "Node,Category,Channel,PA_Enabled,Gain,3.4GHz",
    ],
)  # fmt: skip
def test_a_header_that_is_wrong_in_one_place_is_refused(tmp_path, header):
    path = tmp_path / "refs.csv"
    path.write_text(header + "\nlw1,rx,ch0,0,30.0,-10\n")
    with pytest.raises(InputError, match="no table of reference powers"):
        read_reference_powers(path)


@pytest.mark.parametrize("step", [0.001, 0.02, 2.0])
def test_the_trimmed_fit_is_the_best_of_its_grid_whatever_its_step(step):
    rng = np.random.default_rng(8)
    measured, simulated = rng.normal(0, 1, 30), rng.normal(0.7, 1, 30)
    grid = offset_grid(step, (-3.0, 5.0))
    brute = [np.mean(np.sort((measured + o - simulated) ** 2)[:21]) for o in grid]
    fit = trimmed_offset(measured, simulated, keep=0.7, step_db=step, span_db=(-3.0, 5.0))
    assert fit.offset_db == grid[int(np.argmin(brute))]

"""The residual field: closed forms, a second way in plain loops, planted fields whose intervals contain."""

import dataclasses
import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.compare import field_gp
from aerpaw_cmp.compare.field_gp import FieldFit, FieldModel, Rows, fit_field

STILL = FieldModel(
    place_sd_db=3.0, length_m=40.0, height_m=20.0, turn=math.inf, offset_sd_db=0.0, drift_sd_db=0.0, noise_sd_db=1e-4
)
MOVING = FieldModel(
    place_sd_db=2.5, length_m=60.0, height_m=25.0, turn=0.8, offset_sd_db=1.5, drift_sd_db=1.2, drift_s=90.0
)


def rows_at(position, time=None, flight=0, direction=None):
    position = np.atleast_2d(np.asarray(position, dtype=float))
    n = len(position)
    return Rows(
        position_m=position,
        direction=np.tile([1.0, 0.0, 0.0], (n, 1)) if direction is None else np.asarray(direction, dtype=float),
        time_s=np.zeros(n) if time is None else np.asarray(time, dtype=float),
        flight=np.full(n, flight) if np.isscalar(flight) else np.asarray(flight),
    )


def flights(generator, count=2, each=150):
    """A lawnmower per flight, at its own height, with a turning nose."""
    parts = []
    for flight in range(count):
        t = 4.0 * np.arange(each)
        leg = (t // 80.0).astype(int)
        east = np.where(leg % 2 == 0, t % 80.0, 80.0 - t % 80.0) * 6.0
        position = np.column_stack([east, leg * 45.0, np.full(each, 30.0 + 10.0 * flight)])
        yaw = np.pi * (leg % 2) + generator.normal(0.0, 0.2, each)
        direction = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(each)])
        parts.append(rows_at(position, t, np.full(each, flight), direction))
    return Rows.joined(parts)


def plain_covariance(m, a, b, i, j, noise=True):
    """One entry by the formula of the module text, with the unknown mean."""
    d = math.dist(a.position_m[i, :2], b.position_m[j, :2])
    chord = math.dist(a.direction[i], b.direction[j])
    k = m.place_sd_db**2 * math.exp(-d / m.length_m - abs(a.position_m[i, 2] - b.position_m[j, 2]) / m.height_m)
    k *= math.exp(-(chord**2) / (2.0 * m.turn**2))
    k += field_gp.MEAN_SD_DB**2
    if a.flight[i] == b.flight[j]:
        k += m.offset_sd_db**2 + m.drift_sd_db**2 * math.exp(-abs(a.time_s[i] - b.time_s[j]) / m.drift_s)
    return k + (m.noise_sd_db**2 if noise and a is b and i == j else 0.0)


def test_two_points_are_ordinary_kriging_in_closed_form():
    rows, target = rows_at([[0, 0, 10], [30, 0, 10]]), rows_at([[10, 0, 10]], flight=-1)
    mean, sd = FieldFit(STILL, rows, np.array([1.0, 4.0])).predict(target)
    near, far, between = (math.exp(-d / 40.0) for d in (10.0, 20.0, 30.0))
    first = 0.5 + (near - far) / (2.0 * (1.0 - between))
    error = 9.0 * (1 + first**2 + (1 - first) ** 2 + 2 * first * (1 - first) * between
                   - 2 * first * near - 2 * (1 - first) * far)  # fmt: skip
    assert mean[0] == pytest.approx(first * 1.0 + (1 - first) * 4.0, abs=5e-3)  # the mean is free to 100 dB
    assert sd[0] == pytest.approx(math.sqrt(error), rel=2e-3)


def test_far_away_the_prior_is_left():
    rows = flights(np.random.default_rng(1))
    value = np.random.default_rng(2).normal(5.0, 1.0, len(rows))
    target = rows_at([[90_000.0, 0, 30]], time=[9e6], flight=-1)
    mean, sd = FieldFit(MOVING, rows, value).predict(target, ("place", "drift"))
    assert mean[0] == pytest.approx(0.0, abs=1e-6)
    assert sd[0] == pytest.approx(math.hypot(2.5, 1.2), abs=1e-6)
    level, more = FieldFit(MOVING, rows, value).predict(target)
    assert level[0] == pytest.approx(5.0, abs=1.5)
    assert more[0] > math.hypot(2.5, 1.2, 1.5)  # the mean of two flights is known to some dB only


def test_agrees_with_plain_loops():
    generator = np.random.default_rng(3)
    rows = flights(generator, each=12)
    value = generator.normal(0.0, 2.0, len(rows))
    targets = rows_at(
        generator.uniform(0, 300, (5, 3)), [1, 2, 3, 4, 5.0], [0, 1, -1, -1, 0], np.eye(3)[[0, 1, 2, 0, 1]]
    )
    matrix = np.array([[plain_covariance(MOVING, rows, rows, i, j) for j in range(24)] for i in range(24)])
    across = np.array([[plain_covariance(MOVING, targets, rows, i, j) for j in range(24)] for i in range(5)])
    prior = np.array([plain_covariance(MOVING, targets, targets, i, i, noise=False) for i in range(5)])
    mean, sd = FieldFit(MOVING, rows, value).predict(targets)
    np.testing.assert_allclose(mean, across @ np.linalg.solve(matrix, value), atol=1e-6)
    np.testing.assert_allclose(sd**2, prior - np.diag(across @ np.linalg.solve(matrix, across.T)), atol=1e-6)
    assert np.array_equal(FieldFit(MOVING, rows).predict(targets)[1], sd)  # a planned flight has no values


def test_headings_that_count_alike_are_the_mean_of_single_headings_and_hold_their_spread():
    generator = np.random.default_rng(8)
    rows = flights(generator, each=60)
    yaw = np.radians(np.arange(8) * 45.0)
    nose = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(8)])
    place = np.column_stack([generator.uniform(0, 300, (40, 2)), np.full(40, 35.0)])
    targets = rows_at(place, flight=-1)
    alike = dataclasses.replace(targets, direction=np.tile(nose, (40, 1, 1)))
    value = drawn(generator, MOVING, rows)
    fit = FieldFit(MOVING, rows, value)
    single = [fit.predict(dataclasses.replace(targets, direction=np.tile(n, (40, 1)))) for n in nose]
    mean, sd = fit.predict(alike)
    np.testing.assert_allclose(mean, np.mean([m for m, _ in single], axis=0), atol=1e-9)
    # on average over fields, the variance for a random heading equals the variance for all headings together
    together = np.mean([s**2 for _, s in single], axis=0)
    square = np.zeros(40)
    for _ in range(60):
        again = FieldFit(MOVING, rows, drawn(generator, MOVING, rows))
        square += np.var(
            [again.predict(dataclasses.replace(targets, direction=np.tile(n, (40, 1))))[0] for n in nose], axis=0
        )
    np.testing.assert_allclose(sd**2, together + square / 60, rtol=0.12)


def test_nan_targets_are_nan_and_take_nothing_from_their_neighbours():
    rows = flights(np.random.default_rng(6), each=20)
    value = np.ones(len(rows))
    targets = rows_at([[0, 0, 30], [np.nan, 0, 30], [60, 0, 30]], flight=-1)
    mean, sd = FieldFit(MOVING, rows, value).predict(targets)
    assert np.isnan(mean[1])
    assert np.isnan(sd[1])
    assert np.array_equal(mean[[0, 2]], FieldFit(MOVING, rows, value).predict(targets.part([0, 2]))[0])
    with pytest.raises(InputError, match="no sample"):
        FieldFit(MOVING, rows.part(slice(0, 0)), value[:0])


def drawn(generator, model, rows):
    matrix = field_gp.covariance(model, rows, rows, ("place", "offset", "drift"))
    matrix[np.diag_indices(len(rows))] += model.noise_sd_db**2
    return np.linalg.cholesky(matrix) @ generator.normal(size=len(rows)) + 7.0


def test_slope_of_the_likelihood_by_differences():
    generator = np.random.default_rng(7)
    rows = flights(generator, each=40)
    value, apart = drawn(generator, MOVING, rows), field_gp._Pairs.of(rows, rows)
    names = tuple(field_gp.BOUNDS)
    _, slope = field_gp._likelihood(MOVING, apart, value, names)
    for name, partial in zip(names, slope, strict=True):
        up, down = (
            field_gp._likelihood(
                dataclasses.replace(MOVING, **{name: getattr(MOVING, name) * math.exp(e)}), apart, value, names
            )[0]
            for e in (1e-4, -1e-4)
        )
        assert partial == pytest.approx((up - down) / 2e-4, rel=1e-4, abs=1e-5), name


def test_planted_fields_are_recovered_with_intervals_that_hold():
    generator = np.random.default_rng(8)
    inside, errors, plain, strengths = [], [], [], []
    for _ in range(6):
        rows = flights(generator, count=3, each=120)
        value = drawn(generator, MOVING, rows)
        asked = rows.flight == 2
        model = fit_field([(rows.part(~asked), value[~asked])])
        fit = FieldFit(model, rows.part(~asked), value[~asked])
        mean, sd = fit.predict(dataclasses.replace(rows.part(asked), flight=np.full(120, -1)))
        error, sd = value[asked] - mean, np.hypot(sd, model.noise_sd_db)
        inside.append(np.mean(np.abs(error) < 1.645 * sd))
        errors.append(error.std())
        plain.append(value[asked].std())
        strengths.append((model.place_sd_db, model.noise_sd_db))
    assert 0.80 < np.mean(inside) < 0.97
    assert np.mean(errors) < 0.95 * np.mean(plain)
    place, noise = np.median(strengths, axis=0)
    assert 1.6 < place < 3.6
    assert 1.2 < noise < 1.8


def test_white_noise_makes_no_field():
    generator = np.random.default_rng(9)
    rows = flights(generator, each=150)
    model = fit_field([(rows, generator.normal(0.0, 2.0, len(rows)))])
    assert model.noise_sd_db == pytest.approx(2.0, abs=0.3)
    assert math.hypot(model.place_sd_db, model.drift_sd_db) < 1.0


def test_long_flights_are_thinned_to_whole_stretches_from_end_to_end():
    rows = rows_at(np.arange(6000.0).reshape(2000, 3), time=np.arange(2000.0))
    some, value = field_gp._evenly(rows, np.arange(2000.0))
    assert np.array_equal(some.time_s, value)
    runs = np.split(value, np.flatnonzero(np.diff(value) > 1) + 1)
    assert [len(run) for run in runs] == [field_gp.FIT_ROWS // 7] * 7
    assert (value[0], value[-1]) == (0.0, 1999.0)
    gaps = [b[0] - a[-1] for a, b in itertools.pairwise(runs)]
    assert max(gaps) - min(gaps) <= 1.0
    assert field_gp._evenly(some, value)[0] is some


def test_scales_are_sought_within_their_limits_from_the_usual_ones_on(monkeypatch):
    """The bounds: 12 dB, lengths of 10 to 300 m, heights of 5 to 100 m, correlation times of 3 s to 10 minutes."""
    limits = {"place_sd_db": (0.05, 12), "length_m": (10, 300), "height_m": (5, 100), "turn": (0.2, 5),
              "drift_sd_db": (0.05, 12), "drift_s": (3, 600), "noise_sd_db": (0.2, 12)}  # fmt: skip
    asked = []
    monkeypatch.setattr(
        "scipy.optimize.minimize",
        lambda _, first, **how: asked.append((first, how["bounds"])) or SimpleNamespace(x=first),
    )
    rows = flights(np.random.default_rng(1), each=20)
    model = fit_field([(rows, np.zeros(40))], FieldModel(length_m=900.0, noise_sd_db=0.01))
    ((first, bounds),) = asked[:1]
    np.testing.assert_allclose(bounds, np.log(list(limits.values())))
    assert np.exp(first) == pytest.approx([2.0, 300.0, 30.0, 0.7, 1.5, 60.0, 0.2])
    assert (model.length_m, model.noise_sd_db) == pytest.approx((300.0, 0.2))
    with pytest.raises(InputError, match="fewer than three"):
        fit_field([(rows.part(slice(0, 2)), np.zeros(2))])
    fit_field([(rows.part(slice(0, 3)), np.zeros(3))])


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_offset_of_a_new_flight_is_in_its_band_where_offsets_vary_little_or_much(count):
    """The SD between flights is drawn with a median of 1.5 dB, and a factor of three for one standard deviation."""
    random, held = np.random.default_rng(6), []
    flat = np.zeros((count, 3))
    rows = Rows(position_m=flat, direction=flat, time_s=np.zeros(count), flight=np.arange(count))
    for _ in range(1500):
        between_db = 1.5 * 3.0 ** np.clip(random.normal(), -3.0, 3.0)
        known, other, new = random.normal(0.0, between_db, (3, count))
        stated = field_gp._offset_sd_of([(rows, known), (rows, other)], 1.5) * np.sqrt(1.0 + 1.0 / count)
        held.append((between_db > 1.5, abs(new[0] - known.mean()) <= norm.ppf(0.95) * stated))
    much, inside = np.array(held).T
    assert inside.mean() == pytest.approx(0.9, abs=0.02)
    if count > 1:
        assert min(inside[much].mean(), inside[~much].mean()) > 0.83
        assert field_gp._offset_sd_of([(rows, np.zeros(count))] * 2, 1.5) < 0.5, "equal offsets"


def test_rows_above_the_limit_are_selected_evenly(monkeypatch):
    rows = flights(np.random.default_rng(4), each=60)
    value, targets = (
        np.random.default_rng(5).normal(size=len(rows)),
        rows_at([[50.0, 20, 35], [200, 90, 35]], flight=-1),
    )
    some = np.arange(0, 120, 7)
    monkeypatch.setattr(field_gp, "_MOST_ROWS", len(some))
    for all_rows, selected in zip(
        FieldFit(MOVING, rows, value).predict(targets), FieldFit(MOVING, rows.part(some), value[some]).predict(targets),
        strict=True,
    ):  # fmt: skip
        assert np.array_equal(all_rows, selected)

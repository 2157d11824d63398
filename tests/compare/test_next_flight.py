"""The standard deviation that a planned flight leaves: against the dense solution, and as a ranking of true errors."""

import dataclasses

import numpy as np
from scipy.spatial.distance import cdist
from scipy.stats import spearmanr

from aerpaw_cmp.compare.field_gp import FieldModel, FlownFlights, rms_db
from aerpaw_cmp.compare.gains import GainModel, LinkSamples, Term, fit_gain
from tests.compare.test_direction_gain import drawn

TERMS = (Term("body", "all", 0.6, 2.5), Term("mast", "antenna", 0.5, 3.0))
MODEL = GainModel(TERMS, own_sd_db=1.0, own_length_m=20.0, noise_sd_db=1.0, bin_s=1.0)


def flight(name, seed, yaw_deg, *, n=80, reach=300.0):
    """Return a random walk over waypoints at one heading, seen by one tower, without levels."""
    rng = np.random.default_rng(seed)
    corner, at = rng.uniform(-reach, reach, (6, 2)), np.linspace(0, 5, n)
    position = np.stack([np.interp(at, np.arange(6), corner[:, k]) for k in (0, 1)] + [np.full(n, 50.0)], axis=1)
    ray = position - [0.0, 0.0, 10.0]
    mast = ray / np.linalg.norm(ray, axis=1)[:, None]
    turn = np.radians(yaw_deg)
    c, s = np.cos(turn), np.sin(turn)
    body = -np.stack([c * mast[:, 0] + s * mast[:, 1], -s * mast[:, 0] + c * mast[:, 1], mast[:, 2]], axis=1)
    return LinkSamples(name, "T", "A", 2.0 * np.arange(n), position, body, mast, np.zeros(n))


def joined(parts):
    columns = {k: np.concatenate([getattr(p, k) for p in parts]) for k in ("position_m", "at_uav", "at_tower")}
    count = len(columns["position_m"])
    return LinkSamples("target", "T", "A", np.arange(float(count)), residual_db=np.zeros(count), **columns)


TARGET = joined([flight("t", 70 + k, 90.0 * k, n=40) for k in range(4)])


def gains(left, right):
    body, mast = (cdist(getattr(left, k), getattr(right, k)) for k in ("at_uav", "at_tower"))
    return 2.5**2 * np.exp(-body / 0.6) + 3.0**2 * np.exp(-mast / 0.5)


def test_expected_deviation_is_the_dense_posterior_of_both_flights():
    known, route = flight("a", 1, 0.0), flight("b", 2, 90.0)
    field = FieldModel(place_sd_db=2.0, length_m=40.0, height_m=30.0, turn=0.5, offset_sd_db=0.1, drift_sd_db=0.1)
    sd_db = FlownFlights(series=[known], model=MODEL, field=field).sd_db([route], {"T.A": TARGET})["T.A"]
    rows = [known, route]
    own = np.zeros((160, 160))
    for k, s in enumerate(rows):
        at = slice(80 * k, 80 * k + 80)
        own[at, at] = np.exp(-cdist(s.position_m, s.position_m) / 20.0) + 1e4 + np.eye(80)
    covariance = np.block([[gains(a, b) for b in rows] for a in rows]) + own
    across = np.concatenate([gains(TARGET, s) for s in rows], axis=1)
    posterior = gains(TARGET, TARGET) - across @ np.linalg.solve(covariance, across.T)
    about = np.eye(len(TARGET)) - 1.0 / len(TARGET)
    gain = np.diag(about @ posterior @ about)

    def place(left, right):
        d, up = (
            cdist(left.position_m[:, :2], right.position_m[:, :2]),
            cdist(left.position_m[:, 2:], right.position_m[:, 2:]),
        )
        return 4.0 * np.exp(-d / 40.0 - up / 30.0 - cdist(left.at_uav, right.at_uav, "sqeuclidean") / 0.5)

    both = joined(rows)
    same = np.kron(np.eye(2), np.ones((80, 80)))
    apart = np.abs(np.concatenate([s.time_s for s in rows])[:, None] - np.concatenate([s.time_s for s in rows])[None])
    rest = 1e4 + 0.01 * same + 0.01 * same * np.exp(-apart / 60.0) + 1.5**2 * np.eye(160)
    field_variance = 4.0 - np.diag(place(TARGET, both) @ np.linalg.solve(place(both, both) + rest, place(both, TARGET)))
    np.testing.assert_allclose(sd_db, np.sqrt(gain + field_variance), atol=0.03)


def test_levels_of_the_route_and_of_known_flights_change_nothing():
    known, route = flight("a", 1, 0.0), flight("b", 2, 90.0)
    loud = dataclasses.replace(known, residual_db=np.linspace(-30, 30, 80))
    quiet_sd, loud_sd = (
        FlownFlights(series=[s], model=MODEL).sd_db([route], {"T.A": TARGET})["T.A"] for s in (known, loud)
    )
    np.testing.assert_array_equal(quiet_sd, loud_sd)


def test_nobody_has_flown_and_an_antenna_that_no_route_sees():
    nothing = FlownFlights(series=[], model=MODEL).sd_db([], {"T.A": TARGET})
    np.testing.assert_allclose(nothing["T.A"], np.hypot(2.5, 3.0))
    other = dataclasses.replace(TARGET, channel="B")
    sd = FlownFlights(series=[flight("a", 1, 0.0)], model=MODEL).sd_db([], {"T.B": other})["T.B"]
    np.testing.assert_allclose(sd, np.hypot(2.5, 3.0))


def test_ranking_follows_the_true_error_on_fields_of_known_covariance():
    """Candidates differ in heading and extent. Each is flown in simulated worlds, and then the target is predicted."""
    known = flight("a", 1, 0.0)
    routes = [flight("b", 10 + k, 45.0 * k, reach=60.0 + 40.0 * k) for k in range(7)]
    routes += [flight("b", 20, 0.0, n=20), flight("b", 1, 0.0), flight("b", 22, 180.0, n=30)]
    expected = [rms_db(FlownFlights(series=[known], model=MODEL).sd_db([r], {"T.A": TARGET})) for r in routes]
    squares = np.zeros(len(routes))
    rng = np.random.default_rng(5)
    for _ in range(20):
        uav, mast = (drawn(t.length, t.sd_db, int(rng.integers(1 << 30))) for t in TERMS)

        def level(s, uav=uav, mast=mast):
            return uav(s.at_uav) + mast(s.at_tower)

        def measured(s, level=level):
            root = np.linalg.cholesky(np.exp(-cdist(s.position_m, s.position_m) / 20.0) + 1e-9 * np.eye(len(s)))
            return dataclasses.replace(
                s,
                residual_db=level(s) + root @ rng.normal(size=len(s)) + rng.normal(size=len(s)) + rng.uniform(-20, 20),
            )

        first, truth = measured(known), level(TARGET)
        for k, route in enumerate(routes):
            error = truth - fit_gain([first, measured(route)], MODEL).mean(TARGET)
            squares[k] += error.var() / 20
    assert spearmanr(expected, squares).statistic > 0.85
    np.testing.assert_allclose(np.sqrt(squares), expected, rtol=0.12)  # and the size is the error's

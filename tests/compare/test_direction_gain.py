"""Gain over direction: harmonics and kernel in closed form, planted patterns found again, approximation, refusals."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.compare import direction_gain
from aerpaw_cmp.compare.direction_gain import (
    PLACE_TERM,
    TOWER_TERMS,
    UAV_TERMS,
    GainModel,
    LinkSamples,
    Term,
    fit_gain,
    pair_knots,
    shared_knots,
)
from aerpaw_cmp.compare.gain_choice import choose_and_fit
from aerpaw_cmp.compare.mount import fit_mounts
from aerpaw_cmp.compare.sphere import even_directions, gaussian_features, gaussian_spectrum, harmonics_on_sphere
from aerpaw_cmp.propagation.arrays import rotation_from_aircraft, rotation_from_yaw_pitch_roll

RNG = np.random.default_rng(5)
TERMS = (Term("body", "all", 0.5, 2.5), Term("mast", "antenna", 0.4, 3.0))
MODEL = GainModel(TERMS, own_sd_db=1.0, own_length_m=20.0, noise_sd_db=1.0, bin_s=2.0)


def drawn(length: float, sd_db: float, seed: int):
    """A function on the sphere from the process itself."""
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=gaussian_features(np.eye(3)[:1], length).shape[1])
    return lambda d: sd_db * gaussian_features(d, length) @ weights


def planted(name: str, seed: int, gains, *, n: int = 500, height: float = 50.0, channels=("A", "B"), world=False):
    """A flight over waypoints at random, with its heading; residual = planted gains + offset + shadowing + noise."""
    rng = np.random.default_rng(seed)
    corner = rng.uniform(-300, 300, (9, 2))
    at = np.linspace(0, 8, n)
    east, north = (np.interp(at, np.arange(9), corner[:, k]) for k in (0, 1))
    position = np.stack([east, north, height + 5 * np.sin(at)], axis=1)
    yaw = np.interp(at, np.arange(9), rng.uniform(0, 360, 9))
    rotation = rotation_from_aircraft(3 * np.sin(5 * at), 4 * np.cos(3 * at), yaw)
    ray = position - [0.0, 0.0, 10.0]
    mast = ray / np.linalg.norm(ray, axis=1)[:, None]
    body = np.einsum("nji,nj->ni", rotation, -mast)
    shadow = np.linalg.cholesky(np.exp(-cdist(position, position) / 20.0) + 1e-9 * np.eye(n))
    out = []
    for channel in channels:
        seen = -mast if world else body
        level = gains["uav"](seen) + gains[channel](mast) + rng.uniform(-50, 50)
        level = level + shadow @ rng.normal(size=n) + rng.normal(size=n)
        out.append(LinkSamples(name, "LW1", channel, np.arange(n) * 2.0, position, body, mast, level))
    return out


GAINS = {"uav": drawn(0.5, 2.5, 1), "A": drawn(0.4, 3.0, 2), "B": drawn(0.4, 3.0, 3)}
TRAIN = [s for k in range(3) for s in planted(f"f{k}", 10 + k, GAINS, height=40.0 + 15 * k)]
TEST = planted("kept aside", 99, GAINS, height=48.0)


def rmse(values):
    return float(np.std(values))


def test_harmonics_are_orthonormal_and_obey_the_addition_theorem():
    from scipy.special import eval_legendre

    d = even_directions(4000)
    y = harmonics_on_sphere(d, 12)
    assert np.allclose(4 * np.pi / len(d) * y.T @ y, np.eye(y.shape[1]), atol=2e-3)
    cosine = d[:50] @ d[50:100].T
    for n in range(13):
        part = slice(n * n, (n + 1) ** 2)
        sums = y[:50, part] @ y[50:100, part].T
        assert np.allclose(sums, (2 * n + 1) / (4 * np.pi) * eval_legendre(n, cosine), atol=1e-12)


@pytest.mark.parametrize("length", [0.2, 0.35, 0.9])
def test_features_give_the_gaussian_kernel_of_the_chord(length):
    one, other = even_directions(80), even_directions(91)
    exact = np.exp(-cdist(one, other, "sqeuclidean") / (2 * length**2))
    assert np.abs(gaussian_features(one, length) @ gaussian_features(other, length).T - exact).max() < 2e-3
    assert 0.999 < sum(gaussian_spectrum(length)) <= 1.0 + 1e-12


@pytest.mark.parametrize(("own_sd", "noise_sd"), [(1.0, 1.0), (3.0, 1.7)])
def test_fit_equals_the_exact_gaussian_process(own_sd, noise_sd):
    """Against the dense textbook solution with the exact kernel, no harmonics."""
    train = [s.part(np.arange(0, len(s), 3)) for s in TRAIN[:2]]
    model = dataclasses.replace(MODEL, bin_s=1.0, own_sd_db=own_sd, noise_sd_db=noise_sd)
    fit = fit_gain(train, model)
    body, mast = (np.concatenate([getattr(s, k) for s in train]) for k in ("at_uav", "at_tower"))
    where = np.concatenate([s.position_m for s in train])
    series = np.repeat([0, 1], [len(s) for s in train])
    same = series[:, None] == series[None]

    def kernel(b1, m1, s1, b2, m2, s2):
        k = 2.5**2 * np.exp(-cdist(b1, b2, "sqeuclidean") / 0.5)
        return k + 3.0**2 * np.exp(-cdist(m1, m2, "sqeuclidean") / 0.32) * (s1[:, None] == s2[None])

    own = (own_sd**2 * np.exp(-cdist(where, where) / 20.0) + 1e4) * same + noise_sd**2 * np.eye(len(where))
    y = np.concatenate([s.residual_db - s.residual_db.mean() for s in train])
    weights = np.linalg.solve(kernel(body, mast, series, body, mast, series) + own, y)
    for i, test in enumerate(TEST):
        exact = kernel(test.at_uav, test.at_tower, np.full(len(test), i), body, mast, series) @ weights
        found = fit.predict(test)[0]
        assert np.abs((found - found.mean()) - (exact - exact.mean())).max() < 0.05


PAIR = Term("pair", "antenna", 0.5, 2.0)


def test_gain_towards_both_ends_equals_the_exact_gaussian_process():
    """Mean and standard deviation of one antenna against the dense solution, on and off the flown pairs."""
    train = [TRAIN[0].part(np.arange(0, 500, 3)), TRAIN[2].part(np.arange(0, 500, 3))]
    model = dataclasses.replace(MODEL, terms=(*TERMS, PAIR), bin_s=1.0)
    fit = fit_gain(train, model)
    test = dataclasses.replace(TEST[0].part(np.arange(0, 500, 7)), at_uav=TEST[0].at_uav[::7] * [-1.0, 1.0, 1.0])

    def kernel(one, other):
        body, mast = (cdist(getattr(one, k), getattr(other, k), "sqeuclidean") for k in ("at_uav", "at_tower"))
        pair = PAIR.sd_db**2 * np.exp(-(body + mast) / 0.5)
        return 2.5**2 * np.exp(-body / 0.5) + 3.0**2 * np.exp(-mast / 0.32) + pair

    blocks = [[kernel(one, other) for other in train] for one in train]
    whole = np.block(blocks)
    start = 0
    for s in train:
        at = slice(start, start + len(s))
        whole[at, at] += np.exp(-cdist(s.position_m, s.position_m) / 20.0) + 1e4 + np.eye(len(s))
        start += len(s)
    y = np.concatenate([s.residual_db - s.residual_db.mean() for s in train])
    # predictions are about the mean over the training bins
    seen = np.concatenate([kernel(test, s) for s in train], axis=1)
    inside = np.block(blocks)
    centred = seen - inside.mean(axis=0)
    exact = centred @ np.linalg.solve(whole, y)
    variance = np.diag(kernel(test, test)) - 2.0 * seen.mean(axis=1) + inside.mean()
    variance = variance - np.einsum("ij,ij->i", centred, np.linalg.solve(whole, centred.T).T)
    gain, sd = fit.predict(test)
    assert np.abs(gain - exact).max() < 0.08
    assert np.abs(sd - np.sqrt(variance)).max() < 0.05
    assert np.ptp(sd) > 1.0  # some pairs are known and some are not


def test_knots_leave_no_more_than_their_share():
    at = np.concatenate([TRAIN[0].at_uav, TRAIN[0].at_tower], axis=1)
    for share in (0.1, 1e-3):
        knots = pair_knots(at, 0.35, share)
        k = np.exp(-cdist(at, knots, "sqeuclidean") / (2 * 0.35**2))
        left = 1.0 - np.einsum("ij,ij->i", k, np.linalg.solve(pair_kernel(knots), k.T).T)
        assert left.max() < share + 1e-6
        assert len(knots) < 0.7 * len(at)
    assert len(pair_knots(at, 0.35, 1e-3, most=20)) == 20


def pair_kernel(knots):
    return np.exp(-cdist(knots, knots, "sqeuclidean") / (2 * 0.35**2)) + 1e-9 * np.eye(len(knots))


def test_planted_interaction_is_learned_and_shared_knots_change_little():
    wave = lambda s: 3.0 * np.sin(4.0 * s.at_uav[:, 0] + 3.0 * s.at_tower[:, 1])  # noqa: E731
    train, test = (
        [dataclasses.replace(s, residual_db=s.residual_db + wave(s)) for s in part] for part in (TRAIN, TEST)
    )
    model = dataclasses.replace(MODEL, terms=(*TERMS, PAIR))
    fit, without = fit_gain(train, model), fit_gain(train, MODEL)
    for s in test:
        assert rmse(s.residual_db - fit.mean(s)) < 0.95 * rmse(s.residual_db - without.mean(s))
    shared = fit_gain(train[:4], model, shared_knots(train, model))
    some = test[0].part(np.arange(0, 500, 11))
    np.testing.assert_allclose(shared.predict(some), fit_gain(train[:4], model).predict(some), rtol=0, atol=0.1)


def test_planted_gains_lie_within_their_own_sd_where_flights_have_looked():
    fit = fit_gain(TRAIN, MODEL)
    inside, count = 0, 0
    for frame, antenna, truth in (
        ("body", "LW1.A", GAINS["uav"]),
        ("mast", "LW1.A", GAINS["A"]),
        ("mast", "LW1.B", GAINS["B"]),
    ):
        seen = fit.seen(frame, antenna)
        gain, sd = fit.gain(frame, antenna, seen)
        # zero is the mean over the bins of this antenna's flights
        own = np.concatenate([s.binned(MODEL.bin_s).at_uav if frame == "body" else s.binned(MODEL.bin_s).at_tower
                              for s in TRAIN if s.antenna == antenna])  # fmt: skip
        error = gain - (truth(seen) - truth(own).mean())
        inside += (np.abs(error) < 2.0 * sd).sum()
        count += len(seen)
        assert rmse(error) < 0.5 * rmse(truth(seen))
    assert inside / count > 0.90  # of the directions seen, within two of its own standard deviations
    assert inside / count < 0.999  # and the sd is not simply large


def test_gain_is_a_guess_where_no_flight_has_looked():
    fit = fit_gain(TRAIN, MODEL)
    below, beside = np.array([[0.0, 0.0, -1.0]]), fit.seen("mast", "LW1.A")[:50]
    assert fit.gain("mast", "LW1.A", below)[1][0] > 2.5  # the prior's 3 dB
    assert fit.gain("mast", "LW1.A", beside)[1].mean() < 1.5


def test_flight_kept_aside_is_predicted_and_a_turned_body_is_not():
    fit = fit_gain(TRAIN, MODEL)
    for test in TEST:
        clean = test.residual_db - test.residual_db.mean()
        turned = dataclasses.replace(test, at_uav=test.at_uav * [-1.0, -1.0, 1.0])
        gain, sd = fit.predict(test)
        assert rmse(clean - gain) < 0.65 * rmse(clean)
        assert rmse(clean - gain) < rmse(clean - fit.predict(turned)[0])
        assert np.isfinite(sd).all()
        assert (sd > 0).all()


def test_shadowing_of_one_flight_is_not_learned_as_antenna():
    """Flights without any antenna gain: what is learned must stay small, and without the nuisance it does not."""
    flat = {k: (lambda d: np.zeros(len(d))) for k in GAINS}
    flights = [s for k in range(2) for s in planted(f"f{k}", 30 + k, flat)]
    strong = [dataclasses.replace(s, residual_db=s.residual_db * 3) for s in flights]
    model = dataclasses.replace(MODEL, own_sd_db=3.0, noise_sd_db=3.0)
    with_own = fit_gain(strong, model).predict(strong[0])[0]
    without = fit_gain(strong, dataclasses.replace(model, own_sd_db=1e-3)).predict(strong[0])[0]
    assert rmse(with_own) < 0.7 * rmse(without)


def test_place_field_stays_apart_from_the_antennas():
    places = lambda p: 4.0 * np.sin(p[:, 0] / 60.0)  # noqa: E731
    flights = [dataclasses.replace(s, residual_db=s.residual_db + places(s.position_m)) for s in TRAIN]
    fit = fit_gain(flights, dataclasses.replace(MODEL, terms=(*TERMS, PLACE_TERM)))
    field = fit.predict(flights[0], ("place",))[0]
    assert np.corrcoef(field, places(flights[0].position_m))[0, 1] > 0.7
    whole = fit.predict(flights[0])[0]
    assert np.allclose(whole, field + fit.predict(flights[0], ("body", "mast"))[0], atol=1e-9)


def test_choice_of_spread_uses_the_training_flights_alone_and_scales_to_them():
    loud = [dataclasses.replace(s, residual_db=s.residual_db * 3.0) for s in TRAIN]
    once, thrice = choose_and_fit(TRAIN, MODEL)[0], choose_and_fit(loud, MODEL)[0]
    assert thrice.spread == once.spread
    assert thrice.scale == pytest.approx(3.0 * once.scale)
    assert set(once.left_out_rmse_db) == {0.5, 1.0, 2.0, 4.0}
    assert once.spread == min(once.left_out_rmse_db, key=once.left_out_rmse_db.get)
    assert choose_and_fit(TRAIN[:2], MODEL)[0].left_out_rmse_db == {}  # one flight: nothing to choose by


def test_mounts_are_found_together():
    """A dipole-like figure of eight at each end, turned by known angles."""
    pattern = lambda d: 6.0 * d[:, 0] + 3.0 * (d[:, 0] ** 2 - d[:, 1] ** 2)  # noqa: E731

    def turn(yaw, pitch, roll):
        return rotation_from_yaw_pitch_roll(*np.radians([yaw, pitch, roll]))

    truth = {"uav": 250.0, "A": 40.0, "B": 130.0}
    gains = {k: (lambda d, a=a: pattern(d @ turn(a, 0.0, 0.0))) for k, a in truth.items()}
    flights = [s for k in range(2) for s in planted(f"f{k}", 50 + k, gains)]
    found = fit_mounts(flights, {"uav": pattern, "LW1.A": pattern, "LW1.B": pattern}, turn)
    for name, fit in found.items():
        true = truth[name.removeprefix("LW1.")]
        assert abs((fit.azimuth_deg - true + 180) % 360 - 180) <= 10
        assert fit.identified
        assert fit.azimuth_sd_deg < 30
        assert fit.probability.sum() == pytest.approx(1.0)


def test_a_pattern_without_azimuth_leaves_its_mount_open():
    flat = lambda d: 5.0 * d[:, 2]  # noqa: E731

    def turn(yaw, pitch, roll):
        return rotation_from_yaw_pitch_roll(*np.radians([yaw, pitch, roll]))

    found = fit_mounts(TRAIN, {"uav": flat}, turn)["uav"]
    assert not found.identified
    assert np.allclose(found.probability, 1 / len(found.grid_deg), atol=1e-6)


def test_unknown_antenna_and_empty_flights_are_told():
    fit = fit_gain(TRAIN, MODEL)
    with pytest.raises(UsageError, match=r"LW1\.C"):
        fit.predict(dataclasses.replace(TEST[0], channel="C"))
    silent = dataclasses.replace(TEST[0], residual_db=np.full(len(TEST[0]), np.nan))
    with pytest.raises(InputError, match="no sample"):
        fit_gain([silent], MODEL)
    many = [dataclasses.replace(TEST[0], channel=f"C{i}") for i in range(30)]
    with pytest.raises(UsageError, match="unknowns"):
        fit_gain(many, GainModel(UAV_TERMS + TOWER_TERMS))


def test_directions_that_are_not_known_are_not_predicted():
    fit = fit_gain(TRAIN, MODEL)
    lost = TEST[0].at_uav.copy()
    lost[:7] = np.nan
    gain, sd = fit.predict(dataclasses.replace(TEST[0], at_uav=lost))
    assert np.isnan(gain[:7]).all()
    assert np.isnan(sd[:7]).all()
    assert np.isfinite(gain[7:]).all()


def test_what_is_kept_changes_nothing():
    """Fits of other flights, of other strengths and with other knots in between: the numbers of a first fit."""
    model = dataclasses.replace(MODEL, terms=(*TERMS, PLACE_TERM))
    wanted = []
    for kept in (False, True):
        found = []
        for series, tried in ((TRAIN, model), (TRAIN[:2], model), (TRAIN, MODEL), (TRAIN[2:], MODEL), (TRAIN, model)):
            if not kept:
                for store in (
                    direction_gain._equations,
                    direction_gain._features_of_directions,
                    direction_gain._mean_features_of_directions,
                ):
                    store.clear()
                direction_gain._last_sum.clear()
            for factor in (1.0, 1.9):
                scaled = dataclasses.replace(tried, own_sd_db=factor, noise_sd_db=factor)
                fit = fit_gain(series, scaled)
                found += [fit.log_evidence, *fit.mean(series[0].part(np.arange(0, 30, 7)))]
        wanted.append(found)
    np.testing.assert_allclose(wanted[1], wanted[0], rtol=1e-9)


def test_the_evidence_is_that_of_the_dense_covariance_at_any_noise():
    """The difference of two strengths against Gaussian densities of the whole covariance."""
    found, dense = [], []
    for own_sd, noise_sd in ((1.0, 1.0), (2.4, 1.7)):
        model = dataclasses.replace(MODEL, own_sd_db=own_sd, noise_sd_db=noise_sd)
        found.append(fit_gain(TRAIN[:1], model).log_evidence)
        s = TRAIN[0].binned(model.bin_s)
        whole = 2.5**2 * np.exp(-cdist(s.at_uav, s.at_uav, "sqeuclidean") / 0.5)
        whole += 3.0**2 * np.exp(-cdist(s.at_tower, s.at_tower, "sqeuclidean") / 0.32)
        whole += own_sd**2 * np.exp(-cdist(s.position_m, s.position_m) / 20.0) + (100.0 * noise_sd) ** 2
        whole[np.diag_indices(len(s))] += noise_sd**2
        y = s.residual_db - s.residual_db.mean()
        dense.append(-0.5 * (y @ np.linalg.solve(whole, y) + np.linalg.slogdet(whole)[1]))
    assert found[1] - found[0] == pytest.approx(dense[1] - dense[0], abs=1.0)
    assert abs(dense[1] - dense[0]) > 20.0


@pytest.mark.parametrize("terms", [(TERMS[1],), (TERMS[1], PLACE_TERM)])
def test_antennas_without_a_shared_term_are_fits_of_their_own(terms):
    model = dataclasses.replace(MODEL, terms=terms)
    both = fit_gain(TRAIN, model)
    alone = [fit_gain([s for s in TRAIN if s.channel == channel], model) for channel in "AB"]
    shared = dataclasses.replace(model, terms=(*terms, Term("body", "all", 0.9, 1e-5)))  # solved as one
    np.testing.assert_allclose(fit_gain(TRAIN, shared).predict(TEST[0]), both.predict(TEST[0]), rtol=0, atol=1e-4)
    assert both.log_evidence == pytest.approx(sum(one.log_evidence for one in alone), rel=1e-9)
    for one, samples in zip(alone, TEST, strict=True):
        some = samples.part(np.arange(0, len(samples), 9))
        np.testing.assert_allclose(both.predict(some), one.predict(some), rtol=0, atol=1e-6)
        np.testing.assert_allclose(both.mean(some), both.predict(some)[0], rtol=0, atol=1e-6)
        assert both.average(some) == pytest.approx(both.mean(some).mean(), abs=1e-6)

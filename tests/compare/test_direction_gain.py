"""Gain over direction: the dense solution written out, planted patterns learned again, strengths, mounts, refusals."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.compare import gains as direction_gain
from aerpaw_cmp.compare.gains import GainModel, LinkSamples, Term, chosen_fit, fit_gain, fit_mounts
from aerpaw_cmp.propagation.geometry import rotation_from_aircraft, rotation_from_yaw_pitch_roll

RNG = np.random.default_rng(5)
TERMS = (Term("body", "all", 0.5, 2.5), Term("mast", "antenna", 0.4, 3.0))
MODEL = GainModel(TERMS, own_sd_db=1.0, own_length_m=20.0, noise_sd_db=1.0, bin_s=2.0)


def drawn(length: float, sd_db: float, seed: int):
    """A function of directions from the process itself: waves whose number is Cauchy, as of ``exp(-chord / length)``."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(1000, 3)) / np.abs(rng.normal(size=(1000, 1))) / length
    phase = rng.uniform(0.0, 2.0 * np.pi, 1000)
    return lambda d: sd_db * np.sqrt(2.0 / 1000) * np.cos(d @ waves.T + phase).sum(axis=1)


def planted(name: str, seed: int, gains, *, n: int = 500, height: float = 50.0, channels=("A", "B"), world=False):
    """Simulate a flight over random waypoints with its headings.

    The residual is the sum of planted gains, offset, shadowing and noise.
    """
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
TEST = planted("held out", 99, GAINS, height=48.0)


@pytest.fixture(scope="module")
def learned():
    return fit_gain(TRAIN, MODEL)


def rmse(values):
    return float(np.std(values))


def turn(yaw, pitch, roll):
    return rotation_from_yaw_pitch_roll(*np.radians([yaw, pitch, roll]))


@pytest.mark.parametrize(("own_sd", "noise_sd"), [(1.0, 1.0), (3.0, 1.7)])
def test_fit_equals_the_exact_gaussian_process(own_sd, noise_sd):
    """Against the textbook solution, written out."""
    train = [s.part(np.arange(0, len(s), 3)) for s in TRAIN[:2]]
    model = dataclasses.replace(MODEL, bin_s=1.0, own_sd_db=own_sd, noise_sd_db=noise_sd)
    fit = fit_gain(train, model)
    body, mast = (np.concatenate([getattr(s, k) for s in train]) for k in ("at_uav", "at_tower"))
    where = np.concatenate([s.position_m for s in train])
    series = np.repeat([0, 1], [len(s) for s in train])
    same = series[:, None] == series[None]

    def kernel(b1, m1, s1, b2, m2, s2):
        k = 2.5**2 * np.exp(-cdist(b1, b2) / 0.5)
        return k + 3.0**2 * np.exp(-cdist(m1, m2) / 0.4) * (s1[:, None] == s2[None])

    own = (own_sd**2 * np.exp(-cdist(where, where) / 20.0) + 1e4 * noise_sd**2) * same + noise_sd**2 * np.eye(
        len(where)
    )
    y = np.concatenate([s.residual_db - s.residual_db.mean() for s in train])
    weights = np.linalg.solve(kernel(body, mast, series, body, mast, series) + own, y)
    for i, test in enumerate(TEST):
        exact = kernel(test.at_uav, test.at_tower, np.full(len(test), i), body, mast, series) @ weights
        predicted = fit.predict(test)[0]
        assert np.abs((predicted - predicted.mean()) - (exact - exact.mean())).max() < 1e-6


PAIR = Term("pair", "antenna", 0.5, 2.0)


def test_gain_towards_both_ends_equals_the_exact_gaussian_process():
    """Mean and standard deviation of one antenna against the dense solution, on and off the flown pairs."""
    train = [TRAIN[0].part(np.arange(0, 500, 3)), TRAIN[2].part(np.arange(0, 500, 3))]
    model = dataclasses.replace(MODEL, terms=(*TERMS, PAIR), bin_s=1.0)
    fit = fit_gain(train, model)
    test = dataclasses.replace(TEST[0].part(np.arange(0, 500, 7)), at_uav=TEST[0].at_uav[::7] * [-1.0, 1.0, 1.0])

    def kernel(left, right):
        body, mast = (cdist(getattr(left, k), getattr(right, k)) for k in ("at_uav", "at_tower"))
        pair = PAIR.sd_db**2 * np.exp(-(body**2 + mast**2) / 0.5)
        return 2.5**2 * np.exp(-body / 0.5) + 3.0**2 * np.exp(-mast / 0.4) + pair

    blocks = [[kernel(left, right) for right in train] for left in train]
    covariance = np.block(blocks)
    start = 0
    for s in train:
        at = slice(start, start + len(s))
        covariance[at, at] += np.exp(-cdist(s.position_m, s.position_m) / 20.0) + 1e4 + np.eye(len(s))
        start += len(s)
    y = np.concatenate([s.residual_db - s.residual_db.mean() for s in train])
    # predictions are about the mean over the training bins
    seen = np.concatenate([kernel(test, s) for s in train], axis=1)
    inside = np.block(blocks)
    centred = seen - inside.mean(axis=0)
    exact = centred @ np.linalg.solve(covariance, y)
    variance = np.diag(kernel(test, test)) - 2.0 * seen.mean(axis=1) + inside.mean()
    variance = variance - np.einsum("ij,ij->i", centred, np.linalg.solve(covariance, centred.T).T)
    gain, sd = fit.predict(test)
    np.testing.assert_allclose(gain, exact, rtol=0, atol=1e-6)
    np.testing.assert_allclose(sd, np.sqrt(variance), rtol=0, atol=1e-6)
    assert np.ptp(sd) > 1.0  # some pairs are known and some are not


def test_planted_gains_lie_within_their_own_sd_where_flights_have_looked(learned):
    inside, count = 0, 0
    for frame, antenna, truth in (
        ("body", "LW1.A", GAINS["uav"]),
        ("mast", "LW1.A", GAINS["A"]),
        ("mast", "LW1.B", GAINS["B"]),
    ):
        seen = learned.seen(frame, antenna)
        gain, sd = learned.gain(frame, antenna, seen)
        # zero is the mean over the bins of this antenna's flights
        own = np.concatenate([s.binned(MODEL.bin_s).at_uav if frame == "body" else s.binned(MODEL.bin_s).at_tower
                              for s in TRAIN if s.antenna == antenna])  # fmt: skip
        error = gain - (truth(seen) - truth(own).mean())
        inside += (np.abs(error) < 2.0 * sd).sum()
        count += len(seen)
        assert rmse(error) < 0.5 * rmse(truth(seen))
    assert inside / count > 0.90  # share of the directions seen that are within two standard deviations
    assert inside / count < 0.999  # and the sd is not simply large


def test_gain_is_a_guess_where_no_flight_has_looked(learned):
    below, flown = np.array([[0.0, 0.0, -1.0]]), learned.seen("mast", "LW1.A")[:50]
    assert learned.gain("mast", "LW1.A", below)[1][0] > 2.5  # the prior's 3 dB
    assert learned.gain("mast", "LW1.A", flown)[1].mean() < 1.5


@pytest.mark.parametrize(("planted_factor", "chosen"), [(1.0, 1.0), (0.3, 0.5)])
def test_strength_of_the_towers_gains_is_the_likelier_and_all_scale_to_the_data(planted_factor, chosen):
    gains = {k: (lambda d, g=g, f=planted_factor if k != "uav" else 1.0: f * g(d)) for k, g in GAINS.items()}
    flights = [s for k in range(2) for s in planted(f"f{k}", 10 + k, gains, n=250, height=40.0 + 15 * k)]
    once = chosen_fit(flights, MODEL)
    assert once.model.terms[1].sd_db / once.model.terms[0].sd_db == pytest.approx(chosen * 3.0 / 2.5)
    loud = chosen_fit([dataclasses.replace(s, residual_db=s.residual_db * 3.0) for s in flights], MODEL)
    assert loud.model.noise_sd_db == pytest.approx(3.0 * once.model.noise_sd_db)
    again = fit_gain(flights, once.model)
    levels = np.concatenate([row.residual_db - row.residual_db.mean() for row in again.rows])
    assert levels @ again._weights == pytest.approx(len(levels) - len(again.rows))
    assert again.log_evidence == pytest.approx(once.log_evidence, rel=1e-9)
    some = TEST[0].part(np.arange(0, 500, 9))
    np.testing.assert_allclose(again.predict(some), once.predict(some), rtol=0, atol=1e-6)


def test_many_flights_are_learned_over_longer_means(monkeypatch):
    monkeypatch.setattr(direction_gain, "MOST_ROWS", 900)
    fit = fit_gain(TRAIN, MODEL)
    assert 500 < sum(map(len, fit.rows)) <= 900
    assert fit.model.bin_s == 8.0
    for test in TEST:
        assert rmse(test.residual_db - fit.mean(test)) < 0.75 * rmse(test.residual_db)


def test_mounts_are_found_together():
    """A dipole-like figure of eight at each end, turned by known angles."""
    pattern = lambda d: 6.0 * d[:, 0] + 3.0 * (d[:, 0] ** 2 - d[:, 1] ** 2)  # noqa: E731

    truth = {"uav": 250.0, "A": 40.0, "B": 130.0}
    gains = {k: (lambda d, a=a: pattern(d @ turn(a, 0.0, 0.0))) for k, a in truth.items()}
    flights = [s for k in range(2) for s in planted(f"f{k}", 50 + k, gains)]
    mounts = fit_mounts(flights, {"uav": pattern, "LW1.A": pattern, "LW1.B": pattern})
    assert set(mounts) == {"uav", "LW1.A", "LW1.B"}
    for name, fit in mounts.items():
        true = truth[name.removeprefix("LW1.")]
        assert abs((fit.azimuth_deg - true + 180) % 360 - 180) <= 10
        assert fit.identified
        assert fit.azimuth_sd_deg < 30
        assert fit.probability.sum() == pytest.approx(1.0)


def test_probabilities_of_mounts_by_trying_all_pairs():
    """Compute a least-squares fit of 4 s levels about the patterns (10 dB each), for a mast weighted over azimuths."""
    pattern = lambda d: 9.0 * d[:, 0] + 4.0 * d[:, 1] ** 2  # noqa: E731

    (flight,) = planted("f", 57, {"uav": pattern, "A": pattern}, n=60, channels=("A",))
    mounts = fit_mounts([flight], {"uav": pattern, "LW1.A": pattern})
    bins = flight.binned(4.0)
    centred = lambda x: x - x.mean()  # noqa: E731
    ends = [
        np.array([centred(pattern(at @ turn(a, 0, 0))) for a in range(0, 360, 10)])
        for at in (bins.at_uav, bins.at_tower)
    ]
    left = centred(bins.residual_db) - ends[0][:, None] - ends[1]
    log = -0.5 * (left**2).sum(axis=2) / 10.0**2
    uav = np.exp(log.max(axis=1) - log.max())
    mast = np.exp(log - log.max(axis=1, keepdims=True))
    uav /= uav.sum()
    assert 0.05 < uav.max() < 0.95
    np.testing.assert_allclose(mounts["uav"].probability, uav, atol=1e-9)
    np.testing.assert_allclose(mounts["LW1.A"].probability, uav @ (mast / mast.sum(axis=1, keepdims=True)), atol=1e-9)
    assert (mounts["uav"].azimuth_deg / 10, mounts["LW1.A"].azimuth_deg / 10) == np.unravel_index(
        log.argmax(), log.shape
    )
    for fit in mounts.values():  # the circular standard deviation, and what is left beyond 45 degrees
        off = np.radians(fit.grid_deg - fit.azimuth_deg)
        length = np.hypot(fit.probability @ np.cos(off), fit.probability @ np.sin(off))
        assert fit.azimuth_sd_deg == pytest.approx(max(np.degrees(np.sqrt(-2 * np.log(length))), 10 / np.sqrt(12)))
        assert fit.identified == (fit.probability[np.cos(off) < np.cos(np.radians(45.0)) - 1e-9].sum() < 0.05)


def test_a_pattern_without_azimuth_leaves_its_mount_open():
    flat = lambda d: 5.0 * d[:, 2]  # noqa: E731

    mount = fit_mounts(TRAIN, {"uav": flat})["uav"]
    assert not mount.identified
    assert np.allclose(mount.probability, 1 / len(mount.grid_deg), atol=1e-6)


def test_unknown_antenna_and_empty_flights_are_told(learned):
    with pytest.raises(UsageError, match=r"LW1\.C"):
        learned.predict(dataclasses.replace(TEST[0], channel="C"))
    silent = dataclasses.replace(TEST[0], residual_db=np.full(len(TEST[0]), np.nan))
    with pytest.raises(InputError, match="no sample"):
        fit_gain([silent], MODEL)


def test_directions_that_are_not_known_are_not_predicted(learned):
    lost = TEST[0].at_uav.copy()
    lost[:7] = np.nan
    gain, sd = learned.predict(dataclasses.replace(TEST[0], at_uav=lost))
    assert np.isnan(gain[:7]).all()
    assert np.isnan(sd[:7]).all()
    assert np.isfinite(gain[7:]).all()
    part = dataclasses.replace(TEST[0], at_uav=lost)
    np.testing.assert_allclose(learned.mean(part), gain, atol=1e-9)


def test_the_evidence_is_that_of_the_dense_covariance_at_any_noise():
    """The difference of two strengths against Gaussian densities of the whole covariance."""
    evidence, dense = [], []
    for own_sd, noise_sd in ((1.0, 1.0), (2.4, 1.7)):
        model = dataclasses.replace(MODEL, own_sd_db=own_sd, noise_sd_db=noise_sd)
        evidence.append(fit_gain(TRAIN[:1], model).log_evidence)
        s = TRAIN[0].binned(model.bin_s)
        covariance = 2.5**2 * np.exp(-cdist(s.at_uav, s.at_uav) / 0.5)
        covariance += 3.0**2 * np.exp(-cdist(s.at_tower, s.at_tower) / 0.4)
        covariance += own_sd**2 * np.exp(-cdist(s.position_m, s.position_m) / 20.0) + (100.0 * noise_sd) ** 2
        covariance[np.diag_indices(len(s))] += noise_sd**2
        y = s.residual_db - s.residual_db.mean()
        dense.append(-0.5 * (y @ np.linalg.solve(covariance, y) + np.linalg.slogdet(covariance)[1]))
    assert evidence[1] - evidence[0] == pytest.approx(dense[1] - dense[0], abs=1e-6)
    assert abs(dense[1] - dense[0]) > 20.0


def test_antennas_without_a_shared_term_are_fits_of_their_own():
    model = dataclasses.replace(MODEL, terms=(TERMS[1], PAIR))
    both = fit_gain(TRAIN, model)
    alone = [fit_gain([s for s in TRAIN if s.channel == channel], model) for channel in "AB"]
    assert both.log_evidence == pytest.approx(sum(fit.log_evidence for fit in alone), rel=1e-9)
    for fit, samples in zip(alone, TEST, strict=True):
        some = samples.part(np.arange(0, len(samples), 9))
        np.testing.assert_allclose(both.predict(some), fit.predict(some), rtol=0, atol=1e-6)
        np.testing.assert_allclose(both.mean(some), both.predict(some)[0], rtol=0, atol=1e-6)


def test_bins_are_means_from_the_first_sample_on_and_directions_stay_of_length_one():
    time = 7.3 + np.arange(40) * 0.5
    angle = time / 5.0
    ray = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    level = np.sin(time)
    level[3] = np.nan
    ray_lost = ray.copy()
    ray_lost[5] = np.nan
    flown = LinkSamples("a", "LW1", "A", time, 100.0 * ray, ray_lost, -ray, level, floor_db=level)
    bins = flown.binned(4.0)
    assert bins.floor_db is None
    for k in range(5):
        some = [i for i in range(40) if 4 * k <= time[i] - time[0] < 4 * k + 4 and i not in (3, 5)]
        assert bins.residual_db[k] == pytest.approx(level[some].mean())
        assert bins.time_s[k] == pytest.approx(time[some].mean())
        assert bins.position_m[k] == pytest.approx(100.0 * ray[some].mean(axis=0))
        for name, sign in (("at_uav", 1), ("at_tower", -1)):
            mean = sign * ray[some].mean(axis=0)
            assert getattr(bins, name)[k] == pytest.approx(mean / np.linalg.norm(mean))
    assert len(bins) == 5
    assert len(flown.part(np.isnan(level)).binned(4.0)) == 0


def test_planted_interaction_is_learned():
    wave = lambda s: 3.0 * np.sin(4.0 * s.at_uav[:, 0] + 3.0 * s.at_tower[:, 1])  # noqa: E731
    train, test = (
        [dataclasses.replace(s, residual_db=s.residual_db + wave(s)) for s in part] for part in (TRAIN, TEST)
    )
    model = dataclasses.replace(MODEL, terms=(*TERMS, PAIR))
    fit, without = fit_gain(train, model), fit_gain(train, MODEL)
    for s in test:
        assert rmse(s.residual_db - fit.mean(s)) < 0.95 * rmse(s.residual_db - without.mean(s))


def test_flight_kept_aside_is_predicted_and_a_turned_body_is_not(learned):
    for test in TEST:
        clean = test.residual_db - test.residual_db.mean()
        turned = dataclasses.replace(test, at_uav=test.at_uav * [-1.0, -1.0, 1.0])
        gain, sd = learned.predict(test)
        assert rmse(clean - gain) < 0.75 * rmse(clean)
        assert rmse(clean - gain) < rmse(clean - learned.predict(turned)[0])
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

"""Balance of the ends, nuisance and noise: planted strengths, and errors of flights left out by explicit fits."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from aerpaw_cmp.compare.direction_gain import GainModel, LinkSamples, Term, fit_gain
from aerpaw_cmp.compare.gain_choice import choose_and_fit
from aerpaw_cmp.compare.sphere import gaussian_features

TERMS = (Term("body", "all", 0.5, 2.5), Term("mast", "antenna", 0.4, 3.0))
MODEL = GainModel(TERMS, own_sd_db=2.0, own_length_m=20.0, noise_sd_db=1.5, bin_s=4.0)


def drawn(length: float, sd_db: float, rng: np.random.Generator):
    weights = rng.normal(size=gaussian_features(np.eye(3)[:1], length).shape[1])
    return lambda d: sd_db * gaussian_features(d, length) @ weights


def campaign(seed: int, *, tower: float = 1.0, length_m: float = 20.0, flights: int = 3, n: int = 240):
    """Flights over waypoints at random whose ends, nuisance and noise are as the model has them, but for two factors."""
    rng = np.random.default_rng(seed)
    uav, masts = drawn(0.5, 2.5, rng), {c: drawn(0.4, 3.0 * tower, rng) for c in "AB"}
    out = []
    for flight in range(flights):
        corner, at = rng.uniform(-400, 400, (9, 2)), np.linspace(0, 8, n)
        east, north = (np.interp(at, np.arange(9), corner[:, k]) for k in (0, 1))
        position = np.stack([east, north, 40.0 + 10.0 * flight + 0 * at], axis=1)
        ray = position - [0.0, 0.0, 10.0]
        mast = ray / np.linalg.norm(ray, axis=1)[:, None]
        turn = np.radians(np.interp(at, np.arange(9), rng.uniform(0, 360, 9)))
        c, s = np.cos(turn), np.sin(turn)
        body = -np.stack([c * mast[:, 0] + s * mast[:, 1], -s * mast[:, 0] + c * mast[:, 1], mast[:, 2]], axis=1)
        root = np.linalg.cholesky(np.exp(-cdist(position, position) / length_m) + 1e-9 * np.eye(n))
        for channel in "AB":
            level = uav(body) + masts[channel](mast) + 2.0 * root @ rng.normal(size=n) + 1.5 * rng.normal(size=n)
            level = level + rng.uniform(-30, 30)
            out.append(LinkSamples(f"f{flight}", "T", channel, 4.0 * np.arange(n), position, body, mast, level))
    return out


@pytest.mark.parametrize(("tower", "length_m", "factors"), [(1.0, 20.0, (1.0, 1.0)), (0.25, 80.0, (0.5, 2.0))])
def test_planted_balance_and_length_of_the_nuisance_are_the_likeliest(tower, length_m, factors):
    for seed in (1, 2, 3):
        found = choose_and_fit(campaign(seed, tower=tower, length_m=length_m, flights=2), MODEL)[0].log_evidence
        assert max(found, key=found.get) == factors


def test_errors_left_out_are_those_of_explicit_fits():
    series = campaign(4, n=150)
    choice, fit = choose_and_fit(series, MODEL)
    for spread, error in choice.left_out_rmse_db.items():
        back = choice.scale * choice.spread / spread  # from the strengths chosen to those tried
        terms = tuple(dataclasses.replace(t, sd_db=t.sd_db / choice.scale) for t in choice.model.terms)
        own_sd_db, noise_sd_db = choice.model.own_sd_db / back, choice.model.noise_sd_db / back
        model = dataclasses.replace(choice.model, terms=terms, own_sd_db=own_sd_db, noise_sd_db=noise_sd_db)
        square, count = 0.0, 0
        for flight in ("f0", "f1", "f2"):
            other = fit_gain([s for s in series if s.flight != flight], model)
            for s in series:
                if s.flight == flight:
                    left = s.residual_db - other.mean(s)
                    square, count = square + ((left - left.mean()) ** 2).sum(), count + len(s)
        assert error == pytest.approx(np.sqrt(square / count), abs=0.01)
    again = fit_gain(series, choice.model)
    assert again.common_scale == pytest.approx(1.0)
    assert again.log_evidence == pytest.approx(fit.log_evidence, rel=1e-9)
    np.testing.assert_allclose(again.predict(series[0])[1], fit.predict(series[0])[1], rtol=1e-9)
    np.testing.assert_allclose(again.mean(series[0]), fit.mean(series[0]), atol=1e-9)


def test_evidence_is_that_of_the_whole_fit():
    series = campaign(5, flights=2)
    found = choose_and_fit(series, MODEL)[0].log_evidence
    whole = {}
    for (tower, longer), _ in found.items():
        terms = (TERMS[0], dataclasses.replace(TERMS[1], sd_db=3.0 * tower))
        fit = fit_gain(series, dataclasses.replace(MODEL, terms=terms, own_length_m=20.0 * longer)).scaled()
        whole[tower, longer] = fit.log_evidence + len(series) * np.log(fit.model.noise_sd_db / 1.5)
    difference = {k: found[k] - whole[k] for k in found}
    assert np.ptp(list(difference.values())) < 0.2
    assert np.ptp(list(found.values())) > 5.0

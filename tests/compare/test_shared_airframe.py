"""One airframe in several campaigns: its gain is shared, each campaign has its noise, and levels decide where it fits."""

import dataclasses

import numpy as np
import pytest

from aerpaw_cmp.compare.calibration import Observed, Recipe, campaign_left_out, learn
from aerpaw_cmp.compare.gains import FlightEvidence, GainModel, GainProcess, LinkSamples, Term, gain_covariance, rotated
from tests.compare.test_direction_gain import drawn, planted

GAINS = {"uav": drawn(1.0, 3.2, 1), "A": drawn(0.5, 3.4, 2), "B": drawn(0.5, 3.4, 3), "C": drawn(0.5, 3.4, 4)}
STRANGER = GAINS | {"uav": drawn(1.0, 3.2, 17)}


def campaign(name: str, channel: str, seeds: range, gains=GAINS, *, noise_db: float = 0.0, airframe: str = "m"):
    """Flights of a campaign with one channel and more or less noise."""
    rng, out = np.random.default_rng(seeds.start), list[LinkSamples]()
    for seed in seeds:
        (s,) = planted(f"{name}{seed}", seed, gains, channels=(channel,))
        level = s.residual_db + rng.normal(0.0, noise_db, len(s))
        out.append(dataclasses.replace(s, residual_db=level, campaign=name, airframe=airframe))
    return out


QUIET, LOUD = campaign("quiet", "A", range(20, 23)), campaign("loud", "B", range(30, 32), noise_db=6.0)


def test_each_port_of_a_campaign_has_the_error_of_its_own_levels() -> None:
    """The fit has one noise per campaign. The stated error of a port with more noise is larger."""
    noisy = [dataclasses.replace(s, flight=f"n{s.flight}", campaign="quiet") for s in LOUD]
    learned = learn([*QUIET, *noisy, *campaign("other", "C", range(40, 42))], Recipe(GainModel()))
    errors = [learned.spread(some[0].antenna) for some in (QUIET, LOUD)]
    assert errors[1].noise_sd_db > 1.4 * errors[0].noise_sd_db


def rmse(values) -> float:
    return float(np.std(values))


def observed(series):
    return [Observed(s, np.zeros(len(s)), np.zeros(len(s))) for s in series]


def process(series) -> GainProcess:
    """The airframe that flights taught."""
    fit, antenna = learn(series, Recipe(GainModel())).fit, series[0].antenna
    at = fit.seen("body", antenna)[::3]
    return GainProcess(
        gain_db=lambda d: fit.gain("body", antenna, d)[0],
        sd_db=lambda d: fit.gain("body", antenna, d)[1],
        directions=at,
        covariance_db2=fit.covariance("body", antenna, at),
    )


TAUGHT = process(QUIET)


def test_each_campaign_has_the_noise_of_its_own_levels() -> None:
    model = learn([*QUIET, *LOUD], Recipe(GainModel())).model
    assert model.scales_db("loud")[1] > 1.5 * model.scales_db("quiet")[1]


def test_campaigns_share_the_airframe_and_nothing_across_airframes_or_bands() -> None:
    body = Term("body", "all", 1.0, 2.0)
    first, second = QUIET[0].part(np.arange(5)), LOUD[0].part(np.arange(5))
    own = gain_covariance([body], [first], [dataclasses.replace(second, campaign="quiet")])
    np.testing.assert_allclose(gain_covariance([body], [first], [second]), 0.9 * own)
    assert not gain_covariance([body], [first], [dataclasses.replace(second, airframe="other")]).any()


def test_a_campaign_is_predicted_by_the_airframe_of_another() -> None:
    every = observed([*QUIET, *campaign("next", "C", range(40, 42))])
    right = [s for s in campaign_left_out(every, Recipe(GainModel())) if s.flight.startswith("next")]
    turned = [s for s in campaign_left_out(every, Recipe(GainModel()), 180.0) if s.flight.startswith("next")]
    assert len(right) == len(turned) == 2
    for a, b in zip(right, turned, strict=True):
        assert a.rmse_db < a.free_space_rmse_db - 0.3
        assert b.rmse_db > a.rmse_db + 0.5
    alone = observed([*QUIET, *campaign("next", "C", range(40, 42), airframe="other")])
    assert campaign_left_out(alone, Recipe(GainModel())) == ()


@pytest.mark.parametrize("turn", [0.0, 90.0, 180.0, 270.0])
def test_an_airframe_fits_flights_of_its_own_and_no_rotated_ones(turn: float) -> None:
    flights = campaign("next", "C", range(40, 42))
    some = [dataclasses.replace(s, at_uav=rotated(s.at_uav, turn)) for s in flights]
    odds = FlightEvidence(some).of_airframe(TAUGHT)
    assert odds.fits == (turn == 0.0)


def test_an_airframe_does_not_fit_flights_of_another() -> None:
    for seed in range(50, 56):
        odds = FlightEvidence(campaign("next", "C", range(seed, seed + 2), STRANGER)).of_airframe(TAUGHT)
        assert not odds.fits


def test_a_flight_without_levels_has_no_evidence() -> None:
    bare = [dataclasses.replace(s, residual_db=np.full(len(s), np.nan)) for s in QUIET]
    assert not FlightEvidence(bare).of_airframe(TAUGHT).fits

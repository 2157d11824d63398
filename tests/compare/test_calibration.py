"""Splits of a calibration: nothing is scored where it was learned, many flights in groups, offsets shared or own."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from aerpaw_cmp.compare import calibration
from aerpaw_cmp.compare.calibration import Observed, Recipe, flight_left_out, flights_of, groups_of, spread_flights
from aerpaw_cmp.compare.direction_gain import GainModel, LinkSamples, Term

MODEL = GainModel(terms=(Term("mast", "antenna", 0.5, 3.0),), bin_s=4.0)
RECIPE = Recipe(model=MODEL, rotation=lambda *_: np.eye(3), mount=False)


def observed(flight: str, offset_db: float = 0.0, seed: int = 0) -> Observed:
    """A circle about the mast whose antenna has 4 dB of cosine gain over azimuth."""
    time = np.arange(0.0, 400.0, 2.0)
    azimuth = 2 * np.pi * time / 400.0 + seed
    line = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(len(time), 0.3)], axis=1)
    unit = line / np.linalg.norm(line, axis=1, keepdims=True)
    noise = np.random.default_rng(seed).normal(0.0, 0.5, len(time))
    samples = LinkSamples(
        flight=flight,
        tower="LW1",
        channel="USRP1",
        time_s=time,
        position_m=200.0 * line,
        at_uav=-unit,
        at_tower=unit,
        residual_db=4.0 * np.cos(azimuth) + noise + offset_db,
    )
    return Observed(samples, np.full(len(time), -60.0), np.zeros(len(time)))


def test_an_offset_of_one_flight_shows_only_where_offsets_are_shared() -> None:
    flights = [observed("a", seed=1), observed("b", seed=2), observed("c", offset_db=6.0, seed=3)]
    found = {s.flight: s for s in flight_left_out(flights, RECIPE)}
    assert all(s.rmse_db < 1.0 < 2.0 < s.free_space_rmse_db for s in found.values())
    assert found["c"].rmse_shared_offset_db == pytest.approx(np.hypot(found["c"].rmse_db, 6.0), abs=0.3)
    assert found["a"].rmse_shared_offset_db == pytest.approx(np.hypot(found["a"].rmse_db, 3.0), abs=0.3)
    assert all(s.constant_rmse_db == pytest.approx(s.free_space_rmse_db) for s in found.values())  # one distance
    level = [dataclasses.replace(o, samples=dataclasses.replace(o.samples)) for o in flights[:2]]
    assert all(s.rmse_shared_offset_db < s.rmse_db + 0.1 for s in flight_left_out(level, RECIPE))


def test_many_flights_are_left_out_in_groups_and_none_is_learned_from_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    flights = [observed(f"f{k:02d}", seed=k) for k in range(14)]
    learned_from: list[set[str]] = []
    really = calibration.learn

    def spied(series, *rest):
        learned_from.append({s.flight for s in series})
        return really(series, *rest)

    monkeypatch.setattr(calibration, "learn", spied)
    kept: dict[str, calibration.Learned] = {}
    found = flight_left_out(flights, RECIPE, kept)
    assert {s.flight for s in found} == set(kept) == set(flights_of(flights))
    assert len(learned_from) == calibration.MOST_GROUPS
    groups = groups_of(flights_of(flights))
    for group, used in zip(groups, learned_from, strict=True):
        assert used == set(flights_of(flights)) - set(group)
    assert sorted(name for group in groups for name in group) == flights_of(flights)


def test_few_flights_are_left_out_one_by_one_and_many_are_sampled_over_the_season() -> None:
    assert groups_of(["a", "b", "c"]) == [["a"], ["b"], ["c"]]
    assert spread_flights(["a", "b"]) == ["a", "b"]
    names = [f"{k}" for k in range(20)]
    some = spread_flights(names)
    assert len(some) == len(set(some)) == calibration.MOST_SCORED
    assert (some[0], some[-1]) == ("0", "19")


def test_the_mean_alone_is_that_of_the_prediction() -> None:
    arc = np.arange(70)  # the mean over it is not that over the circle
    learned = calibration.learn([observed(name, seed=1).samples.part(arc) for name in "ab"], RECIPE)
    other = observed("c", seed=3).samples
    lost = dataclasses.replace(other, at_uav=np.where(np.arange(len(other))[:, None] < 5, np.nan, other.at_uav))
    np.testing.assert_allclose(learned.mean(lost), learned.predict(lost)[0], rtol=0, atol=1e-9)
    assert learned.mean_error(lost) == pytest.approx(np.nanmean(lost.residual_db - learned.mean(lost)), abs=1e-9)
    assert np.isnan(learned.mean(lost)).sum() == 5

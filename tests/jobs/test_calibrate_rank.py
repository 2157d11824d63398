"""A receiver and the geometry of its antennas, planted and learned again."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.jobs.calibrate_rank import (
    FittedReceiver,
    RankCalibration,
    RankGrid,
    RankSamples,
    Timing,
    Tried,
    features_of,
    read_receiver,
)
from aerpaw_cmp.jobs.compare_flight import fitted_receiver
from aerpaw_cmp.propagation import drivers
from aerpaw_cmp.propagation.geometry import (
    Link,
    Poses,
    rotation_from_aircraft,
    tower_comparison_array,
    uav_comparison_array,
)

SETTINGS = RankGrid(
    yaw_step_deg=45, uav_slant_deg=((45, -45, -45, 45), (0, 90, 0, 90)), ground=(0.2,), thin=2, members=3
)


def flight(seed: int) -> RankSamples:
    """Fly a zigzag around the tower at 30 m, with ranks that tests add later."""
    rng = np.random.default_rng(seed)
    azimuth, far = rng.uniform(0, 2 * np.pi, 400), rng.uniform(60, 350, 400)
    at = np.column_stack([far * np.cos(azimuth), far * np.sin(azimuth), rng.uniform(25, 35, 400)])
    link = Link(3.4e9, {"T": tower_comparison_array()}, uav_comparison_array(0.0882), uav_transmits=False)
    poses = Poses(at, np.tile(np.eye(3), (400, 1, 1)))
    return RankSamples(
        flight=f"f{seed}", tower="T", tower_m=np.array([0.0, 0.0, 12.0]), poses=poses, rank=np.zeros(400), link=link,
        time_s=np.arange(400.0),
    )  # fmt: skip


def by_medians(ratio):
    """Planted rank: stream i counts where the ratios of streams 2 .. i all exceed their medians."""
    return 1.0 + np.cumprod(ratio > np.median(ratio, axis=0), axis=-1).sum(axis=-1)


@pytest.fixture(scope="module")
def tried() -> Tried:
    flights = [flight(1), flight(2)]
    truth = Tried.of(flights, SETTINGS).geometries[5]
    planted = []
    for flown in flights:
        ratio = features_of([truth], flown)[0][:, :3]
        rank = by_medians(ratio)
        flip = np.random.default_rng(7).random(400) < 0.05
        planted.append(dataclasses.replace(flown, rank=np.where(flip, 1.0 + (rank % 4), rank)))
    return Tried.of(planted, SETTINGS)


def test_the_planted_geometry_is_found_and_forecasts_the_other_flight(tried: Tried) -> None:
    fitted = tried.fit([0])
    assert tried.geometries[5] in fitted.geometries
    other = tried.samples[1]
    p, said = fitted.forecast(other)
    assert p.sum(axis=1) == pytest.approx(1.0)
    assert np.mean(said == other.rank) > 0.7


def test_a_receiver_survives_its_file(tried: Tried, tmp_path: Path) -> None:
    fitted = tried.fit([0, 1])
    path = tmp_path / "receiver.json"
    path.write_text(RankCalibration(receivers={"T": fitted}, scores={}, warnings=()).text(), encoding="utf-8")
    data = SimpleNamespace(folder=tmp_path, settings=SimpleNamespace(rank=SimpleNamespace(receiver="receiver.json")))
    with pytest.raises(InputError, match="no receiver at U"):
        fitted_receiver(data, "U")
    again = fitted_receiver(data, "T")
    assert again.geometries == fitted.geometries
    assert again.flights == ("f1", "f2")
    np.testing.assert_array_equal(again.forecast(tried.samples[0])[0], fitted.forecast(tried.samples[0])[0])


def legs() -> RankSamples:
    """Straight legs at 10 m/s past the tower, twice a second, so that neighbours in time are neighbours in place."""
    at = np.arange(0.0, 4000.0, 5.0)
    leg, along = np.divmod(at, 500.0)
    east, north = -60.0 - 40.0 * leg, np.where(leg % 2 == 0, along - 250.0, 250.0 - along)
    position = np.column_stack([east, north, np.full(len(at), 30.0)])
    start = flight(1)
    poses = Poses(position, np.tile(np.eye(3), (len(at), 1, 1)))
    return dataclasses.replace(start, poses=poses, rank=np.zeros(len(at)), time_s=0.1 * at)


@pytest.mark.parametrize(("shift_s", "average_s"), [(4.0, 0.0), (2.0, 12.0)])
def test_planted_delay_and_mean_of_the_reports_are_found(shift_s: float, average_s: float) -> None:
    settings = RankGrid(
        yaw_step_deg=90, uav_slant_deg=((45, -45, -45, 45),), ground=(0.2,), thin=1, members=1,
        shift_s=(0, 2, 4), average_s=(0, 12),
    )  # fmt: skip
    bare = legs()
    truth = Tried.of([bare], settings).geometries[1]
    planted = Timing(shift_s=shift_s, average_s=average_s)
    ratio = features_of([truth], bare, planted)[0][:, :3]
    rank = by_medians(ratio)
    fitted = Tried.of([dataclasses.replace(bare, rank=rank)], settings).fit([0])
    assert (fitted.timing.shift_s, fitted.timing.average_s) == (shift_s, average_s)
    again = FittedReceiver.from_dict("T", fitted.as_dict())
    assert again.timing.shift_s == shift_s
    assert again.timing.average_s == average_s


@pytest.mark.parametrize("text", ["", "[]", '{"format": "other"}', '{"format": "aerpaw-cmp receiver 1"}'])
def test_another_file_is_one_message(text: str, tmp_path: Path) -> None:
    path = tmp_path / "receiver.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="cannot be read"):
        read_receiver(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_receiver(tmp_path / "nowhere.json")


def test_channels_of_a_mount_are_evaluated_once_in_whatever_order(monkeypatch):
    flown, slants = flight(0), [(45.0, -45.0, -45.0, 45.0), (0.0, 90.0, 0.0, 90.0)]
    every = drivers.every_geometry([(0.0, 0.0, 0.0), (30.0, 0.0, 90.0)], [slants[0]], slants, [0.0, 0.5])
    mixed = [every[i] for i in (0, 6, 3, 5, 1, 7)]
    alone = np.concatenate([features_of([g], flown) for g in mixed])
    calls = []
    columns = drivers.geometry
    monkeypatch.setattr(drivers, "geometry", lambda *a: calls.append(1) or columns(*a))
    np.testing.assert_allclose(features_of(mixed, flown), alone, rtol=1e-12)
    assert len(calls) == 4  # two mounts, direct and off the ground
    features_of([g for g in mixed if g.ground == 0.0], flown)
    assert len(calls) == 6


def test_turns_of_the_uav_are_those_of_its_heading(tried: Tried) -> None:
    fitted, flown = tried.fit([0]), flight(3)
    level = np.zeros(400)
    each = [
        fitted.forecast(dataclasses.replace(flown, poses=Poses(
            flown.poses.position_m, rotation_from_aircraft(level, level, level + heading)
        )))[0]
        for heading in (0.0, 45.0, 250.0)
    ]  # fmt: skip
    north = dataclasses.replace(flown, poses=Poses(flown.poses.position_m, rotation_from_aircraft(level, level, level)))
    assert np.abs(each[0] - each[1]).max() > 1e-3
    np.testing.assert_allclose(fitted.forecast(north, (0.0, 45.0, 250.0))[0], np.mean(each, axis=0), atol=1e-9)

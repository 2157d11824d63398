"""The gain towards both ends at once: kept in the comments of a file, interpolated, and used only with its own UAV."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.flight.gains import learned_gain, pair_db
from aerpaw_cmp.propagation.geometry import Array, Link, Poses, rotation_from_aircraft, single_element
from aerpaw_cmp.site.learned import PairGain, SpherePattern, read_pair

RNG = np.random.default_rng(3)
SHA = {"one": "a" * 64, "other": "b" * 64}


def unit(n: int) -> np.ndarray:
    d = RNG.normal(size=(n, 3))
    return np.asarray(d / np.linalg.norm(d, axis=1)[:, None])


def planted(n: int = 40) -> PairGain:
    """Values on directions at least some tenths of a chord apart."""
    at = np.concatenate([unit(n), unit(n)], axis=1)
    return PairGain(
        directions=at, gain_db=RNG.normal(size=n), sd_db=RNG.uniform(0.8, 1.2, n), length=0.35, prior_sd_db=1.5
    )


def pattern(pair: PairGain | None, trained_on: str) -> SpherePattern:
    sphere = SpherePattern("a", np.zeros((19, 36)), np.full((19, 36), 2.0), notes=f"# trained_on: {trained_on}")
    sphere.pair = pair
    return sphere


def array(sphere: SpherePattern) -> Array:
    return dataclasses.replace(single_element(), patterns=(sphere,))


def test_a_file_gives_back_what_was_written(tmp_path: Path) -> None:
    pair = planted()
    path = tmp_path / "a.csv"
    path.write_text(pair.table(("trained_on: x",)))
    read = read_pair(path, pair.length, pair.prior_sd_db)
    np.testing.assert_allclose(read.directions, pair.directions, atol=2e-3)
    gain, sd = read.at(pair.directions, np.full(40, 9.0))
    assert np.abs(gain - pair.gain_db).max() < 0.03
    assert np.abs(sd - pair.sd_db).max() < 0.3


def test_far_from_every_direction_both_ends_count_alone() -> None:
    pair = dataclasses.replace(planted(1), directions=np.array([[1.0, 0, 0, 0, 1.0, 0]]))
    gain, sd = pair.at(np.array([[-1.0, 0, 0, 0, 1.0, 0]]), np.array([2.0]))
    assert abs(gain[0]) < 1e-3
    assert sd[0] == pytest.approx(np.hypot(2.0, 1.5), rel=1e-3)


@pytest.mark.parametrize("damage", ["1,2,3,4,nan,1", "1,2,3", "1,2,3,4,x,1"])
def test_a_damaged_table_is_refused(damage: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(planted(3).table(()) + damage + "\n")
    with pytest.raises(InputError):
        read_pair(path, 0.35, 1.5)


def test_it_counts_along_the_direct_line_and_only_between_ends_learned_together() -> None:
    yaw, tower_m = np.array([0.0, 70.0, 200.0]), np.array([[10.0, -20.0, 12.0]])
    poses = Poses(RNG.uniform((-200, -200, 60), (200, 200, 460), (3, 3)), rotation_from_aircraft(0 * yaw, 0 * yaw, yaw))
    ray = poses.position_m - tower_m
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    body = np.stack([r.T @ -v for r, v in zip(poses.rotation, ray, strict=True)])
    pair = dataclasses.replace(
        planted(3), directions=np.concatenate([body, ray], axis=1), gain_db=np.array([1.0, -2.0, 0.5])
    )
    both = {
        which: Link(3.3e9, {"LW1": array(pattern(pair, SHA["one"]))}, array(pattern(None, SHA[which]))) for which in SHA
    }
    np.testing.assert_allclose(pair_db(both["one"], poses, tower_m), [1.0, -2.0, 0.5], atol=0.05)
    gain = learned_gain(both["other"], poses, tower_m)
    assert gain is not None
    np.testing.assert_array_equal(gain.pair_db, 0.0)
    np.testing.assert_allclose(gain.sd_db, np.hypot(2.0, 2.0))
    assert learned_gain(Link(3.3e9, {"LW1": single_element()}, single_element()), poses, tower_m) is None

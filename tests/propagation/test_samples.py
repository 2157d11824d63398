import numpy as np
import pytest

from aerpaw_cmp.common.units import spread_out
from aerpaw_cmp.propagation.engines import FIRST, MOST, enough_samples
from aerpaw_cmp.propagation.geometry import Faces, PathSet

FACES = Faces(np.eye(3), np.zeros(3), ("concrete",) * 3, ("a", "b", "c"))


def paths_over(*faces):
    sequence = np.array([[-1], *([f] for f in faces)])
    zero = np.zeros(len(sequence), dtype=np.int64)
    return PathSet(zero, zero, (sequence >= 0).sum(axis=1), sequence, np.zeros((len(sequence), 1, 3)))


def pilot_that_sees(thresholds):
    asked = []

    def pilot(samples):
        asked.append(samples)
        return paths_over(*(face for face, least in enumerate(thresholds) if samples >= least))

    return pilot, asked


def test_rays_are_raised_until_two_pilots_agree():
    pilot, asked = pilot_that_sees([0, 100_000])
    choice = enough_samples(pilot, FACES, 50)
    assert asked == [10_000, 40_000]  # the second face needs more than both: agreement is not a proof
    pilot, asked = pilot_that_sees([20_000, 100_000])
    choice = enough_samples(pilot, FACES, 50)
    assert asked == [10_000, 40_000, 160_000, 640_000]
    assert choice.samples == 640_000
    assert choice.reason == "160 000 and 640 000 rays per tower found the same 3 paths at 50 poses"


def test_pilots_that_never_agree_end_and_say_so():
    calls = []

    def pilot(samples):
        calls.append(samples)
        return paths_over(*range(len(calls) % 2))

    choice = enough_samples(pilot, FACES, 9)
    assert choice.samples == MOST
    assert "still found other paths" in choice.reason
    assert calls[0] == FIRST


@pytest.mark.parametrize("count", [1, 7, 100])
def test_spread_takes_both_ends(count):
    known = np.arange(40) * 3
    some = known[spread_out(len(known), count)]
    assert len(some) == min(count, 40)
    assert some[0] == 0
    assert count == 1 or some[-1] == 117

"""Why a series would not be compared: the first of the reasons that holds, or none."""

from types import SimpleNamespace

import numpy as np
import pytest

from aerpaw_cmp.flight.drafting import draft

TRACK = SimpleNamespace(pose_at=np.asarray, why_not=lambda _: "most are after telemetry")


@pytest.mark.parametrize(
    ("counts", "track", "words"),
    [
        ((0, 0, 0), TRACK, "no sample has a value"),
        ((10, 10, 10), TRACK, ""),
        ((10, 5, 1), TRACK, ""),
        ((10, 5, 0), TRACK, "all of 5 samples below minimum_height_m"),
        ((10, 4, 4), TRACK, "4 of 10 samples within the telemetry: most are after telemetry"),
        ((10, 4, 0), TRACK, "0 of 10 samples within the telemetry: most are after telemetry"),
        ((10, 0, 0), None, "0 of 10 samples within the telemetry: there are no positions"),
    ],
)
def test_a_loss_has_its_first_reason(counts: tuple[int, int, int], track: object, words: str) -> None:
    reason = draft._loss(SimpleNamespace(track=track), np.zeros(3), counts)  # type: ignore[arg-type]
    assert reason.startswith(words)
    assert bool(reason) == bool(words)


def test_values_positions_and_heights_are_counted_one_after_the_other() -> None:
    value = np.array([1.0, np.nan, 2.0, 3.0, 4.0])
    known = np.array([True, True, False, True, True])
    place = np.column_stack([np.zeros((5, 2)), [50.0, 50.0, 50.0, 20.0, 30.0]])
    assert draft._counts(place, known, value, 30.0) == (4, 3, 2)
    assert draft._counts(place, known, value, None) == (4, 3, 3)

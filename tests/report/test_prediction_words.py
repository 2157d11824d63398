"""Sentences of a prediction: each follows from an interval on what was left out, or on the flight that followed."""

from typing import Any

import numpy as np
import pytest

from aerpaw_cmp.compare.judge.verdicts import Verdict
from aerpaw_cmp.compare.learning.correction import OFF, Correction
from aerpaw_cmp.compare.learning.field_gp import FieldModel
from aerpaw_cmp.report.words.prediction import FIELD, FLOWN, after_flight, first_words

FREE, LEARNED, WITH_FIELD = ("free space", OFF), ("learned", OFF), ("learned", "field of 2 dB, 30 m")


def correction(key: tuple[str, str], errors: dict[tuple[str, str], float], sd: float) -> Correction:
    """Independent errors of 600 samples with these standard deviations, all stated as ``sd``."""
    unit = np.random.default_rng(6).standard_normal((3, 600))
    held: dict[tuple[str, str], Any] = {
        name: (size * draw, np.full(600, sd)) for (name, size), draw in zip(errors.items(), unit, strict=True)
    }
    return Correction(
        base=key[0], predictor=lambda s: (np.zeros(len(s)), np.zeros(len(s))), title=key[1], model=FieldModel(),
        channels={}, flights=("a", "b"), crps_db=dict(errors), rmse_db=dict(errors), held_out=held,
    )  # fmt: skip


def test_a_model_that_beats_free_space_is_called_better_with_its_interval() -> None:
    errors = {FREE: 6.0, LEARNED: 3.0, WITH_FIELD: 3.1}
    words = first_words(correction(LEARNED, errors, 3.0), outside=0.1, expected_db=4.2)
    assert words.startswith(
        "Expect an RMSE of 4.2 dB over 4 s means at these points on a new flight. "  # its offset and places count
        "On flights left out, each about its own mean: 3.0 dB; free space 6.0 dB."
    )
    assert "The model is significantly better than free space (\N{MINUS SIGN}" in words
    assert "90 % intervals hold " in words
    assert "too narrow" not in words
    assert "too wide" not in words
    assert "The residual field is off" in words
    assert "outside the flown places" not in words


def test_equal_models_are_called_neither_better_nor_worse() -> None:
    words = first_words(
        correction(LEARNED, {FREE: 3.0, LEARNED: 3.0, WITH_FIELD: 3.0}, 3.0), outside=0.0, expected_db=4.2
    )
    assert "is not significant (95 %)" in words
    assert "better" not in words
    assert "worse" not in words


@pytest.mark.parametrize(("sd", "said"), [(1.5, "too narrow: errors are 2.0 times"), (6.0, "too wide: errors are 0.5")])
def test_intervals_that_do_not_hold_are_named_with_the_ratio(sd: float, said: str) -> None:
    words = first_words(
        correction(LEARNED, {FREE: 6.0, LEARNED: 3.0, WITH_FIELD: 3.0}, sd), outside=0.0, expected_db=4.2
    )
    assert said in words


def test_a_field_that_helps_is_on_for_a_stated_gain() -> None:
    words = first_words(
        correction(WITH_FIELD, {FREE: 6.0, LEARNED: 4.0, WITH_FIELD: 2.0}, 3.0), outside=0.5, expected_db=4.2
    )
    assert "The residual field is on: it lowers the CRPS by " in words
    assert "50 % of the points lie outside the flown places. Next: `aerpaw-cmp plan`" in words
    assert set(FIELD) == {"better", "worse", "off"}


def test_free_space_is_not_compared_with_itself() -> None:
    words = first_words(
        correction(FREE, {FREE: 3.0, ("free space", "field of 2 dB, 30 m"): 3.2, LEARNED: 4.0}, 3.0), 0.0, 4.2
    )
    assert "than free space" not in words
    assert "Model: free space." in words


@pytest.mark.parametrize("cause", FLOWN)
def test_the_flight_that_followed_is_said_by_the_gravest_cause(cause: str) -> None:
    scores = {"rmse_db": 4.0, "rmse_4s_db": 3.0, "own_offset_rmse_db": 3.5, "coverage_90": 0.7}
    stated = [Verdict(), Verdict(cause=cause, effect=2.0, interval=(1.5, 2.5), where="LW1 USRP1")]
    words = after_flight({"LW1 USRP1": scores}, stated)
    assert "hold 70 % of the samples" in words
    assert FLOWN[cause][0].split("{")[0] in words
    assert ("LW1 USRP1" in words) == (cause in ("narrow", "wide", "biased"))

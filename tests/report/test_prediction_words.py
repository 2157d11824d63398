"""Sentences of a prediction: each follows from an interval on held-out data, or on the later flight."""

import re
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from aerpaw_cmp.compare.calibration import OFF, Correction
from aerpaw_cmp.compare.field_gp import FieldModel
from aerpaw_cmp.report.prediction import FIELD, cautions, first_sentences, notes
from tests.report.shown import MOST_WORDS

FREE, LEARNED, WITH_FIELD = ("free space", OFF), ("learned", OFF), ("learned", "field of 2 dB, 30 m")


def correction(
    key: tuple[str, str], errors: dict[tuple[str, str], float], sd: float, flights: tuple[str, ...] = ("a", "b", "c")
) -> Correction:
    """Independent errors of 600 samples with these standard deviations, all stated as ``sd``."""
    unit = np.random.default_rng(6).standard_normal((3, 600))
    held: dict[tuple[str, str], Any] = {
        name: (size * draw, np.full(600, sd)) for (name, size), draw in zip(errors.items(), unit, strict=True)
    }
    return Correction(
        base=key[0], predictor=lambda s: (np.zeros(len(s)), np.zeros(len(s))), title=key[1], model=FieldModel(),
        channels={}, flights=flights, crps_db=dict(errors), rmse_db=dict(errors), held_out=held,
        held_out_parts=tuple((name, 600 // len(flights)) for name in flights),
    )  # fmt: skip


def test_a_model_that_beats_free_space_is_called_better_with_its_interval() -> None:
    errors = {FREE: 6.0, LEARNED: 3.0, WITH_FIELD: 3.1}
    chosen = correction(LEARNED, errors, 3.0)
    words, listed = first_sentences(chosen, 0.1, 4.2, 7.5), " ".join(notes(chosen))
    said = re.fullmatch(
        r"Expect an RMSE of 4\.2 dB over 4 s means at these points on a new flight \(any heading\); 90 % of the samples lie "
        r"within ±7\.5 dB\. On held-out flights it is (\d\.\d) dB better than free space \[(\d\.\d), (\d\.\d)\] \(95 %\)\.",
        words,
    )  # its offset and places count
    assert said is not None
    assert float(said[2]) < float(said[1]) < float(said[3])
    error, sd = chosen.held_out[LEARNED]
    inside = 100.0 * np.mean(np.abs(error) <= norm.ppf(0.95) * sd)
    assert f"90 % intervals contain {inside:.0f} % of the held-out samples." in listed
    assert "The residual field (a spatial correction) is off" in listed
    # what holds is no warning, nor is what the prediction was learned from
    assert cautions(chosen, 0.1) == []


def test_equal_models_are_called_neither_better_nor_worse() -> None:
    words = first_sentences(correction(LEARNED, {FREE: 3.0, LEARNED: 3.0, WITH_FIELD: 3.0}, 3.0), 0.0, 4.2, 7.5)
    assert "is not significant (95 %)" in words
    assert "better" not in words
    assert "worse" not in words


def test_points_without_a_path_have_no_expected_error() -> None:
    words = first_sentences(None, 0.0, float("nan"), float("nan"))
    assert words.startswith("No level is predicted: no path reaches any of the points.")
    assert "nan" not in words


def test_two_flights_give_no_interval_as_in_a_calibration() -> None:
    """However many samples they have: 600 independent ones would bound the difference to some tenths of a decibel."""
    errors = {FREE: 6.0, LEARNED: 3.0, WITH_FIELD: 3.1}
    words = first_sentences(correction(LEARNED, errors, 3.0, ("a", "b")), 0.0, 4.2, 7.5)
    assert re.search(r"differs from that of free space by −?-?[23]\.\d dB; an interval requires three flights", words)
    assert "95 %" not in words
    single = first_sentences(correction(LEARNED, errors, 3.0, ("a",)), 0.0, 4.2, 7.5)
    assert "On held-out blocks of the flight it is" in single
    assert "(95 %)" in single


@pytest.mark.parametrize(("sd", "said"), [(1.5, "too narrow: errors are 2.0 times"), (6.0, "too wide: errors are 0.5")])
def test_intervals_that_do_not_hold_are_named_with_the_ratio(sd: float, said: str) -> None:
    chosen = correction(LEARNED, {FREE: 6.0, LEARNED: 3.0, WITH_FIELD: 3.0}, sd)
    assert said in " ".join(cautions(chosen, 0.0))
    assert ("Next: add a flight of this area." in first_sentences(chosen, 0.0, 4.2, 7.5)) == (sd < 3.0)


def test_a_field_that_helps_is_on_for_a_stated_gain() -> None:
    chosen = correction(WITH_FIELD, {FREE: 6.0, LEARNED: 4.0, WITH_FIELD: 2.0}, 3.0)
    assert cautions(chosen, 0.5)[0] == "50 % of the points are outside the flown area."
    assert "The residual field (a spatial correction) is on: it lowers the CRPS by " in " ".join(notes(chosen))
    assert first_sentences(chosen, 0.5, 4.2, 7.5).endswith(
        "Next: `aerpaw-cmp plan` finds the flight that reduces the standard deviation most."
    )
    assert set(FIELD) == {"better", "worse", "off"}


def test_free_space_is_not_compared_with_itself() -> None:
    chosen = correction(FREE, {FREE: 3.0, ("free space", "field of 2 dB, 30 m"): 3.2, LEARNED: 4.0}, 3.0)
    assert "than free space" not in first_sentences(chosen, 0.0, 4.2, 7.5)
    assert "Model: free space." in notes(chosen)


@pytest.mark.parametrize("outside", [0.0, 0.9])
@pytest.mark.parametrize("sd", [1.5, 3.0, 6.0])
@pytest.mark.parametrize("free_db", [2.0, 3.0, 12.0])
def test_a_first_paragraph_has_one_error_one_step_and_sixty_words_at_most(
    outside: float, sd: float, free_db: float
) -> None:
    chosen = correction(LEARNED, {FREE: free_db, LEARNED: 3.0, WITH_FIELD: 3.1}, sd)
    for words in (first_sentences(source, outside, 14.2, 17.5) for source in (chosen, None)):
        assert len(words.split()) <= MOST_WORDS
        assert words.count("RMSE") == 1
        assert words.count("Next: ") <= 1

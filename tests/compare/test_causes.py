"""The likely cause of an error: named where it was planted, silent where nothing was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aerpaw_cmp.compare.causes import LevelEvidence, likely_cause
from benchmarks.planted_causes import TROUBLES, flight


def test_each_planted_trouble_is_named_and_a_sound_flight_is_left_alone() -> None:
    """Four flights of each kind: at most two of the 28 troubled ones are misnamed, no sound flight is accused."""
    wrong = []
    for number in range(4 * len(TROUBLES)):
        trouble = TROUBLES[number % len(TROUBLES)]
        named = likely_cause(flight(trouble, np.random.default_rng([11, number]))).name
        wrong += [(trouble, named)] if named != trouble else []
    assert len(wrong) <= 2, wrong
    assert "none" not in [planted for planted, _ in wrong]


def _evidence(seed: int = 3) -> LevelEvidence:
    return flight("none", np.random.default_rng([5, seed]))


@pytest.mark.parametrize("lag_s", [-4.0, 3.0, 6.0])
def test_a_clock_comes_back_with_its_sign_and_interval(lag_s: float) -> None:
    """The radio's clock shows later times by the lag: its samples show what was lag seconds ago."""
    sound = _evidence()
    late = np.interp(sound.time_s - lag_s, sound.time_s, sound.predicted_db)
    noise = sound.measured_db - sound.predicted_db
    cause = likely_cause(replace(sound, measured_db=late + noise))
    assert cause.name == "clock"
    assert cause.estimate == pytest.approx(lag_s, abs=1.0)
    assert cause.ci95[0] < cause.estimate < cause.ci95[1]  # never narrower than the steps that were tried
    confirmed = likely_cause(replace(sound, measured_db=late + noise, clock_confirmed=True))
    assert confirmed.name != "clock"


@pytest.mark.parametrize("step_db", [-7.0, 7.0])
def test_a_gain_step_comes_back_with_instant_size_and_interval(step_db: float) -> None:
    sound = _evidence()
    at = sound.time_s[len(sound.time_s) // 3]
    cause = likely_cause(replace(sound, measured_db=sound.measured_db + step_db * (sound.time_s > at)))
    assert cause.name == "gain step"
    assert float(cause.where) == pytest.approx(at, abs=3.0)
    assert cause.ci95[0] < step_db < cause.ci95[1]
    assert cause.rmse_with_db < cause.rmse_db


def test_slow_fading_alone_is_no_step_and_no_loss() -> None:
    """A first-order process of 4 dB over 20 s wanders as far as a step does."""
    generator = np.random.default_rng(8)
    accused = 0
    for seed in range(20):
        sound = _evidence(seed)
        n, keep = len(sound.time_s), np.exp(-0.1 / 20.0)
        white, walk = generator.standard_normal(n) * 4.0 * np.sqrt(1 - keep**2), np.zeros(n)
        for i in range(1, n):
            walk[i] = keep * walk[i - 1] + white[i]
        accused += likely_cause(replace(sound, measured_db=sound.predicted_db + walk - 40.0)).name != "none"
    assert accused <= 2


def test_too_few_samples_and_no_samples_accuse_nobody() -> None:
    sound = _evidence()
    silent = replace(sound, measured_db=np.full(len(sound.time_s), np.nan))
    assert likely_cause(silent).name == "none"
    short = np.arange(len(sound.time_s)) < 400  # 40 s
    assert likely_cause(replace(sound, measured_db=np.where(short, sound.measured_db + 9.0, np.nan))).name == "none"

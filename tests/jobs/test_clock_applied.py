"""``rss.lag: apply`` corrects a clock only where its verdict is "ok", and says before anything else where it did not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aerpaw_cmp.flight.clock import ClockEstimate
from aerpaw_cmp.flight.replay import _clock_of, telemetry_time
from aerpaw_cmp.report.build import clock_warnings, clocks_of, metrics_beyond_panels

TIME = np.datetime64("2024-07-15T15:48:16", "ns") + (np.arange(100) * 1e9).astype("timedelta64[ns]")
SERIES: Any = SimpleNamespace(tower="LW1", time=TIME)


def estimate(verdict: str, **more: Any) -> ClockEstimate:
    """A radio that shows 2.5 s more."""
    keys: dict[str, Any] = {
        "radio_minus_telemetry_s": 2.5, "ci95_s": (2.3, 2.7), "drift_s_per_s": 0.0, "drift_ci95_s_per_s": (np.nan, np.nan),
        "reference_s": 50.0, "start_ns": int(TIME[0].astype(np.int64)), "verdict": verdict,
        "reason": "" if verdict == "ok" else "told", "model": "replay", "explained": 0.7, "halves_s": (2.4, 2.6),
        "channels_s": {"USRP1": 2.5}, "free_patterns_s": 2.5, "held_out": None, "n": 100, "window_s": 15.0,
    }  # fmt: skip
    return ClockEstimate(**{**keys, **more})


def result(clock: Any) -> Any:
    further = SimpleNamespace(clock=clock.result)
    return SimpleNamespace(
        rss=[SimpleNamespace(further=further, residual_by={}, tower="LW1", channel=c) for c in "ab"],
        pairs=(),
        ladder=(),
        serving=None,
    )


@pytest.mark.parametrize("verdict", ["ok", "agree", "ambiguous", "failed"])
@pytest.mark.parametrize("apply", [True, False])
def test_only_ok_is_applied(verdict: str, apply: bool) -> None:
    clock = _clock_of(SERIES, estimate(verdict), apply=apply)
    used = apply and verdict == "ok"
    shift = (TIME - telemetry_time(TIME, clock)) / np.timedelta64(1, "s")
    np.testing.assert_allclose(shift, 2.5 if used else 0.0)
    written = metrics_beyond_panels(result(clock))["clock"]
    assert set(written) == {"LW1"}
    assert {
        "radio_minus_telemetry_s": 2.5,
        "ci95_s": [2.3, 2.7],
        "verdict": verdict,
        "applied": used,
    }.items() <= written["LW1"].items()


def test_a_correction_that_was_asked_for_and_not_made_is_said() -> None:
    (text,) = clock_warnings(result(_clock_of(SERIES, estimate("ambiguous"), apply=True)))
    assert "NOT corrected" in text
    assert "told" in text
    (text,) = clock_warnings(result(_clock_of(SERIES, estimate("ok"), apply=True)))
    assert "it was corrected" in text
    (text,) = clock_warnings(result(_clock_of(SERIES, estimate("ok"), apply=False)))
    assert "rss.lag: apply would" in text
    assert clock_warnings(result(_clock_of(SERIES, estimate("agree"), apply=True))) == ()


def test_channels_of_a_receiver_share_a_clock() -> None:
    assert len(clocks_of(result(_clock_of(SERIES, estimate("ok"), apply=False)))) == 1

"""``rss.lag: apply`` corrects a clock whose difference is shown, and says before anything else where it did not."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aerpaw_cmp.compare.result import ESTIMATED, Cause, FlightResult
from aerpaw_cmp.flight.clock import ClockEstimate
from aerpaw_cmp.flight.replay import _clock_of, telemetry_time
from aerpaw_cmp.report.flight import clock_metrics
from aerpaw_cmp.report.flight_data import clock_warnings

TIME = np.datetime64("2024-07-15T15:48:16", "ns") + (np.arange(100) * 1e9).astype("timedelta64[ns]")
SERIES: Any = SimpleNamespace(tower="LW1", time=TIME)


def estimate(verdict: str, **more: Any) -> ClockEstimate:
    """A radio that shows 2.5 s more."""
    keys: dict[str, Any] = {
        "radio_minus_telemetry_s": 2.5, "ci95_s": (2.3, 2.7), "verdict": verdict,
        "reason": "flat level" if verdict == "cannot tell" else "", "window_s": 15.0, "channels_s": {"USRP1": 2.5},
    }  # fmt: skip
    return ClockEstimate(**{**keys, **more})


@pytest.mark.parametrize("verdict", ["ok", "shifted", "cannot tell"])
@pytest.mark.parametrize("apply", [True, False])
def test_an_estimate_that_is_told_from_zero_is_applied(verdict: str, apply: bool) -> None:
    clock = _clock_of(SERIES, estimate(verdict), apply=apply)
    used = apply and verdict != "cannot tell"
    shift = (TIME - telemetry_time(TIME, clock)) / np.timedelta64(1, "s")
    np.testing.assert_allclose(shift, 2.5 if used else 0.0)
    written = clock_metrics(clock.result)
    assert {
        "radio_minus_telemetry_s": 2.5,
        "ci95_s": (2.3, 2.7),
        "verdict": verdict,
        "applied": used,
    }.items() <= written.items()


def test_an_interval_that_holds_zero_is_not_applied() -> None:
    clock = _clock_of(SERIES, estimate("ok", ci95_s=(-0.1, 2.7)), apply=True)
    assert clock.result.applied == ESTIMATED
    assert clock.applied_s == 0.0


def test_a_correction_that_was_asked_for_and_not_made_is_said() -> None:
    (text,) = clock_warnings({"LW1": _clock_of(SERIES, estimate("cannot tell"), apply=True).result})
    assert "not corrected: flat level" in text
    (text,) = clock_warnings({"LW1": _clock_of(SERIES, estimate("shifted"), apply=True).result})
    assert "2.50 s ahead of the telemetry clock" in text
    assert "it was corrected" in text
    (text,) = clock_warnings({"LW1": _clock_of(SERIES, estimate("shifted"), apply=False).result})
    assert "Set rss.lag: apply" in text
    (text,) = clock_warnings({"LW1": _clock_of(SERIES, estimate("cannot tell"), apply=False).result})
    assert "could not be checked: flat level" in text
    assert clock_warnings({"LW1": _clock_of(SERIES, estimate("ok", ci95_s=(-0.3, 0.2)), apply=True).result}) == ()


def test_channels_of_a_receiver_share_a_clock() -> None:
    clock = _clock_of(SERIES, estimate("ok"), apply=False).result
    channels: Any = [SimpleNamespace(further=SimpleNamespace(clock=clock)) for _ in "ab"]
    assert FlightResult(rss=tuple(channels)).clocks == {"LW1": clock}


def test_towers_of_one_computer_have_one_sentence() -> None:
    clock, other = (
        _clock_of(SERIES, estimate("shifted", ci95_s=ends), apply=False).result for ends in ((2, 3), (1, 3))
    )
    first, second = clock_warnings({"LW1": clock, "LW2": other, "LW4": clock})
    assert first.startswith("LW1, LW4: the radio clock is 2.50 s ahead")
    assert second.startswith("LW2: ")


def test_a_clock_that_is_the_likely_cause_has_one_sentence() -> None:
    clocks = {name: _clock_of(SERIES, estimate("shifted"), apply=False).result for name in ("LW1", "LW2")}
    cause = Cause(name="clock", sentence="the radio clock gains 2.0 %", next_step="", channels=("LW1 USRP1",))
    (text,) = clock_warnings(clocks, cause)
    assert text.startswith("LW2: ")

"""The one thing to do next with a flight, where anything that is known changes its result."""

from __future__ import annotations

from ...compare.judge.causes import OF_DIRECTION, Cause
from ...compare.result import FlightResult
from ...flight.data import FlightData
from .ladder import FlightLadder


def unrivalled(cause: Cause | None, climbed: FlightLadder | None) -> Cause | None:
    """The likely cause; None of a function of direction where the recommended model gains as much as it does."""
    if cause is None or cause.name not in OF_DIRECTION or climbed is None or climbed.recommended is None:
        return cause
    at, rmse_db = climbed.ladder.recommended, climbed.ladder.rmse_db
    assert at is not None
    return None if rmse_db[-1] - rmse_db[at] >= cause.rmse_db - cause.rmse_with_db else cause


def next_step(data: FlightData, result: FlightResult, climbed: FlightLadder | None) -> str | None:
    """The step against the likely cause, else a model that is better than the one as set, else a calibration.

    Parameters
    ----------
    data : FlightData
    result : FlightResult
    climbed : FlightLadder, optional

    Returns
    -------
    str or None
        A clause; None for a training flight, and where antennas learned on other flights are used already.
    """
    if result.likely_cause is not None:
        return result.likely_cause.next_step
    if any(panel.further.trained_on for panel in result.series):
        return None
    if climbed is not None and climbed.recommended is not None:
        return "`report --recommend FILE` writes settings significantly better than these"
    if result.rss and not data.settings.antennas:
        return "`aerpaw-cmp calibrate` with two flights of this site"
    return None

"""The one thing to do next with a flight, where anything that is known changes its result."""

from __future__ import annotations

import math

import numpy as np

from ...compare.flight_verdict import is_one_place
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
    """A wider search of the offset, the step against the likely cause, or a model that is better than the one as set.

    Parameters
    ----------
    data : FlightData
    result : FlightResult
    climbed : FlightLadder, optional

    Returns
    -------
    str or None
        A clause; without any of these that of the comparison, and None for a training flight.
    """
    beyond = [panel for panel in result.rss if panel.score.at_edge]
    if beyond:
        # the offset is added to the measurement; ten further decibels, so that no edge is touched again
        missing = [float(np.nanmedian(panel.simulated_dbm - panel.measured_db)) for panel in beyond]
        low, high = data.settings.rss.span_db
        ends = (
            min(low, *(10 * math.floor(m / 10) - 10 for m in missing)),
            max(high, *(10 * math.ceil(m / 10) + 10 for m in missing)),
        )
        return f"`rss: {{span_db: [{ends[0]:.0f}, {ends[1]:.0f}]}}`"
    if result.likely_cause is not None:
        return result.likely_cause.next_step or None
    if any(panel.further.trained_on for panel in result.series):
        return None
    if is_one_place(result.rss):
        return "a flight along a route"
    if climbed is not None and climbed.recommended is not None:
        return "`report --recommend FILE` writes settings significantly better than these"
    return result.next_step

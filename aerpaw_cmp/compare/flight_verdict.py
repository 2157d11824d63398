"""Ray tracing against the best baseline over all channels of a flight at once."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from .result import FlightVerdict, RssResult
from .statistics.intervals import corrected, pooled_difference
from .statistics.memory import FEWEST


def with_corrected_verdicts(panels: Sequence[RssResult]) -> list[RssResult]:
    """Channels whose verdicts against each baseline are corrected for the number of channels."""
    rows = [dict(panel.further.compared_with) for panel in panels]
    for name in dict.fromkeys(name for row in rows for name in row):
        members = [row for row in rows if name in row]
        for row, pair in zip(members, corrected([row[name] for row in members]), strict=True):
            row[name] = pair
    return [
        replace(panel, further=replace(panel.further, compared_with=row))
        for panel, row in zip(panels, rows, strict=True)
    ]


def scored(panels: Iterable[RssResult]) -> list[RssResult]:
    """Channels with enough samples for a sentence about their error."""
    return [panel for panel in panels if panel.score.n >= FEWEST and math.isfinite(panel.score.rmse_db)]


def baseline_errors(panels: Sequence[RssResult]) -> dict[str, float]:
    """Pooled RMSE [dB] of each baseline that all of these channels have."""
    errors = {}
    for name in panels[0].baselines if panels else ():
        known = [panel.baselines[name].rmse_db for panel in panels if name in panel.baselines]
        if len(known) == len(panels) and all(map(math.isfinite, known)):
            errors[name] = pooled_db(known, [panel.score.n for panel in panels])
    return errors


def pooled_db(rmse_db: Sequence[float], n: Sequence[int]) -> float:
    """Root of the mean square error over all samples of several series, each after its own offset [dB]."""
    weight = np.asarray(n, dtype=np.float64)
    return float(np.sqrt((weight * np.asarray(rmse_db) ** 2).sum() / weight.sum()))


def flight_verdict(panels: Sequence[RssResult]) -> FlightVerdict | None:
    """Ray tracing against the baseline with the smallest error, over all scored channels at once."""
    panels = scored(panels)
    errors = baseline_errors(panels)
    if not errors:
        return None
    best = min(errors, key=lambda name: errors[name])
    pair = pooled_difference([(p.time, p.residual_db, p.calibrated_db - p.baselines[best].level_dbm) for p in panels])
    return FlightVerdict(
        against=best, difference_db=pair.difference_db, ci95_db=pair.difference_ci95_db, channels=len(panels)
    )

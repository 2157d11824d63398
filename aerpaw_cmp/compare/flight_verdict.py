"""Ray tracing against the best baseline over all channels of a flight at once."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from ..common.units import FloatArray
from .level.detection import DetectionScore, floored_fit
from .result import FlightVerdict, RssResult
from .statistics.intervals import corrected, is_flat, middle_span, pooled_difference
from .statistics.memory import FEWEST


def with_corrected_verdicts(panels: Sequence[RssResult]) -> list[RssResult]:
    """Channels whose verdicts against each baseline are corrected for the number of channels."""
    rows = [dict(panel.further.compared_with) for panel in panels]
    for name in dict.fromkeys(name for row in rows for name in row):
        members = [i for i, row in enumerate(rows) if name in row]
        # a log that was copied to another channel counts once
        measured = [panels[i].measured_db.tobytes() for i in members]
        for i, pair in zip(members, corrected([rows[i][name] for i in members], measured), strict=True):
            rows[i][name] = pair
    return [
        replace(panel, further=replace(panel.further, compared_with=row))
        for panel, row in zip(panels, rows, strict=True)
    ]


def scored(panels: Iterable[RssResult]) -> list[RssResult]:
    """Channels with an offset and enough samples for a sentence, without copies and, where one lives, the dead."""
    some = [p for p in without_copies(panels) if not p.score.at_edge]
    enough = [p for p in some if p.score.n >= FEWEST and math.isfinite(p.score.rmse_db)]
    return [panel for panel in enough if not is_dead(panel)] or enough


def without_copies(panels: Iterable[RssResult]) -> list[RssResult]:
    """Channels, and of some with the same levels the first."""
    return list({panel.measured_db.tobytes(): panel for panel in reversed(list(panels))}.values())[::-1]


# Fading alone makes a received level vary by more [dB], also where no model does.
_DEAD_DB = 1.0


def is_dead(panel: RssResult) -> bool:
    """True of a level whose middle 80 % span less than a decibel, and little of what is predicted: a dead input."""
    known = panel.posed & np.isfinite(panel.measured_db) & np.isfinite(panel.simulated_dbm)
    if not known.any():
        return False
    measured_db = panel.measured_db[known]
    return middle_span(measured_db) < _DEAD_DB and is_flat(measured_db, [panel.simulated_dbm[known]])


def is_one_place(panels: Iterable[RssResult]) -> bool:
    """True of levels that no model lets vary by a decibel, as where a UAV hovers: each fits as a constant does."""
    every = [[panel.simulated_dbm, *(b.level_dbm for b in panel.baselines.values())] for panel in scored(panels)]
    levels = [level[np.isfinite(level)] for models in every for level in models if np.isfinite(level).any()]
    return bool(levels) and max(map(middle_span, levels)) < _DEAD_DB


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


def lock_lost(panel: RssResult) -> DetectionScore | None:
    """The score of a receiver whose log says when it was in lock; None of others, and of one that never lost it."""
    score = panel.further.detection
    return score if score is not None and score.locks else None


def flight_verdict(panels: Sequence[RssResult]) -> FlightVerdict | None:
    """Ray tracing against the baseline with the smallest error, over all scored channels at once.

    A receiver that lost its lock is judged on all its samples, lower levels counted as its floor.
    """
    panels = scored(panels)
    residuals = [_residuals(panel) for panel in panels]
    errors = {name: _rms([of[name] for of in residuals]) for name in set.intersection(*map(set, residuals or [{}]))}
    best = min((name for name in errors if name != _RAY), key=lambda name: errors[name], default="")
    if not best:
        return None
    channels = [(panel.time, of[_RAY], of[best]) for panel, of in zip(panels, residuals, strict=True)]
    pair = pooled_difference(channels, free_offset=not any(map(lock_lost, panels)))
    return FlightVerdict(
        against=best, rmse_db=errors[_RAY], baseline_rmse_db=errors[best], difference_db=pair.difference_db,
        ci95_db=pair.difference_ci95_db, channels=len(panels),
    )  # fmt: skip


_RAY = "ray tracing"


def _residuals(panel: RssResult) -> dict[str, FloatArray]:
    """Residuals (n,) of ray tracing and of each baseline after its own offset, where a path is simulated [dB]."""
    models = {_RAY: (panel.simulated_dbm, panel.score.offset_db)}
    models |= {name: (model.level_dbm, model.offset_db) for name, model in panel.baselines.items()}
    known, score = panel.posed & np.isfinite(panel.simulated_dbm), lock_lost(panel)
    if score is None:
        every = {name: panel.measured_db + offset - level for name, (level, offset) in models.items()}
    else:
        floor = score.floor_db
        measured = np.where(known, np.fmax(panel.measured_db, floor), np.nan)
        every = {
            name: measured - np.maximum(level - floored_fit(measured, level, floor).offset_db, floor)
            for name, (level, _) in models.items()
        }
    return {name: np.where(known, of, np.nan) for name, of in every.items() if np.isfinite(of).any()}


def _rms(values: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.nanmean(np.concatenate(values) ** 2)))

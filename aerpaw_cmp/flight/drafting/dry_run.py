"""Number of samples of a flight that a report would score, and why not more, before anything is replayed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...common.counting import counted
from ...common.errors import InputError, UsageError, one_line
from ...common.units import BoolArray, FloatArray
from ...logs.ingest import IngestedFile
from ..data import FlightData, Times, gather, rank_positions
from ..settings import FlightFile


@dataclass(frozen=True, slots=True, kw_only=True)
class DryRun:
    """Outcome of a dry run.

    Parameters
    ----------
    samples : int
        Levels and ranks with a position, a value and the height that the settings ask for.
    refused : str
        The message with which a report would stop; empty where it would not.
    lost : tuple of str
        Per series of which none, or less than half, is compared: which, and the reason.
    data : FlightData or None
        The gathered flight; None if the report would stop.
    """

    samples: int = 0
    refused: str = ""
    lost: tuple[str, ...] = ()
    data: FlightData | None = None

    @property
    def reason(self) -> str:
        """Reason why nothing would be scored; empty where something is."""
        return "" if self.samples else self.refused or "; ".join(self.lost)


def dry_run(settings: FlightFile, folder: Path, files: Sequence[IngestedFile]) -> DryRun:
    """Gather a flight as a report does, by :func:`~aerpaw_cmp.flight.data.gather`, and count what could be scored."""
    try:
        data = gather(settings, folder, files)
    except (InputError, UsageError) as error:
        return DryRun(refused=one_line(str(error)))
    lost: dict[str, str] = {}
    samples = 0
    for rss in data.rss:
        pose = data.poses_at(rss.time)
        counts = _counts(pose.position_m, pose.valid, rss.measured_db, settings.rss.minimum_height_m)
        samples += counts[-1]
        lost[f"{rss.tower} {rss.channel}"] = _loss(data, rss.time, counts)
    for rank in data.rank:
        counts = _counts(*rank_positions(rank, data.track), rank.rank, settings.rank.minimum_height_m)
        samples += counts[-1]
        lost[f"rank of {rank.tower}"] = _loss(data, rank.time, counts)
    return DryRun(samples=samples, lost=tuple(f"{name}: {why}" for name, why in lost.items() if why), data=data)


def _counts(place: FloatArray, known: BoolArray, value: FloatArray, lowest_m: float | None) -> tuple[int, int, int]:
    """Samples with a value; those of them with a position; those of them that are high enough."""
    valued = np.isfinite(value)
    placed = valued & known
    high = placed if lowest_m is None else placed & (place[:, 2] >= lowest_m)
    return int(valued.sum()), int(placed.sum()), int(high.sum())


def _loss(data: FlightData, time: Times, counts: tuple[int, int, int]) -> str:
    """Give the reason why none, or less than half, of the values of a series is compared; empty for others."""
    valued, placed, high = counts
    if not valued:
        return "no sample holds a value (out of coverage, or no report)"
    if high and placed >= 0.5 * valued:
        return ""
    if placed and placed >= 0.5 * valued:
        return f"all of {counted(placed, 'sample')} below minimum_height_m"
    why = "there are no positions" if data.track is None else data.track.why_not(data.track.pose_at(time))
    return f"{high} of {counted(valued, 'sample')} within the telemetry: {why}"

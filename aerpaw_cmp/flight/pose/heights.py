"""Heights of tracks: over the ground under them, and those of logs that write latitude and longitude alone."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...common.errors import UsageError
from ...common.units import MINIMUM_HEIGHT_M, BoolArray, FloatArray
from ...logs.ingest import IngestedFile
from ...logs.records import Stream
from ..settings import LogSettings

Ground = Callable[[FloatArray, FloatArray], FloatArray]
"""Up of the ground [m] at easts and norths (n,)."""

# Heights above take-off drift by this much in a flight [m]: real ones end at -3.9 m after landing.
_DRIFT_M = 5.0


def raised(up_m: FloatArray, ground_m: FloatArray, takeoff_m: float) -> tuple[FloatArray, BoolArray]:
    """Heights of poses over the ground under them, and which poses lie below it.

    A little below ground that is about as high as the take-off point is the drift of the height; all else below
    ground cannot have been flown: the ground or the heights are wrong.

    Parameters
    ----------
    up_m, ground_m : (n,)
        Of the poses and of the ground under them [m].
    takeoff_m : float
        Up of the take-off point [m].

    Returns
    -------
    (n,), (n,) bool

    Examples
    --------
    >>> raised(np.array([-2.0, -20.0, 8.0]), np.zeros(3), 0.0)
    (array([  0.5, -20. ,   8. ]), array([False,  True, False]))
    """
    drift = np.where(ground_m <= takeoff_m + _DRIFT_M, _DRIFT_M, 0.0)
    buried = up_m < ground_m - drift
    return np.where(buried, up_m, np.fmax(up_m, ground_m + MINIMUM_HEIGHT_M)), buried


_IN_NAME = re.compile(r"(?<![A-Za-z0-9.])(\d{1,3}) ?(?:m|meters|metres)(?![A-Za-z0-9])")


def lacks_height(stream: Stream) -> bool:
    """Check whether a stream has positions and no altitude in any row."""
    frame = stream.frame
    if "latitude_deg" not in frame or not frame["latitude_deg"].notna().any():
        return False
    return "altitude_m" not in frame or not bool(frame["altitude_m"].notna().any())


def at_height(log: LogSettings, file: IngestedFile) -> IngestedFile:
    """A log whose positions without altitude are all at the ``height_m`` that the flight file gives.

    Parameters
    ----------
    log : LogSettings
    file : IngestedFile
        What was read of it.

    Returns
    -------
    IngestedFile
        The same where no height is given.

    Raises
    ------
    UsageError
        If a height is given and every stream with positions has altitudes of its own.
    """
    if log.height_m is None:
        return file
    streams = [
        replace(s, frame=s.frame.assign(altitude_m=float(log.height_m))) if lacks_height(s) else s
        for s in file.result.streams
    ]
    if all(after is before for after, before in zip(streams, file.result.streams, strict=True)):
        raise UsageError(
            f"{log.path}: 'height_m' acts on nothing",
            expected="a log with positions and no altitude",
            cause="the log has altitudes of its own, or no positions",
        )
    note = f"no altitude in the log: {log.height_m:g} m above take-off in all of it, as height_m says"
    # the reader asked for what is answered here
    warnings = [text for text in file.result.warnings if not text.startswith("no column is known as a height")]
    return replace(file, result=replace(file.result, streams=tuple(streams), warnings=(*warnings, note)))


def height_in_name(path: str) -> float | None:
    """The height [m] that the name of a log's file tells, if it tells one alone.

    Examples
    --------
    >>> height_in_name("urban/60m.csv"), height_in_name("run2_120m_5G.csv"), height_in_name("phone.csv")
    (60.0, 120.0, None)
    """
    # as a set: 'flight_60m_60m' tells one height, '40m_to_60m' none
    heights = {float(text) for text in _IN_NAME.findall(Path(path).stem.replace("_", " "))}
    return heights.pop() if len(heights) == 1 else None

"""Heights of tracks whose log has none: phones and drive-test programs write latitude and longitude alone."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from ..common.errors import UsageError
from ..logs.ingest import IngestedFile
from ..logs.records import Stream
from .settings import LogSettings

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
    warnings = [text for text in file.result.warnings if not text.startswith("the log has no altitude")]
    return replace(file, result=replace(file.result, streams=tuple(streams), warnings=(*warnings, note)))


def height_in_name(path: str) -> float | None:
    """The height [m] that the name of a log's file tells, if it tells one alone.

    Examples
    --------
    >>> height_in_name("urban/60m.csv"), height_in_name("run2_120m_5G.csv"), height_in_name("phone.csv")
    (60.0, 120.0, None)
    """
    heights = {float(text) for text in _IN_NAME.findall(Path(path).stem.replace("_", " "))}
    return heights.pop() if len(heights) == 1 else None

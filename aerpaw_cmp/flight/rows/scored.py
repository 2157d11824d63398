"""Rows of a log that a comparison scores: those that no flag voids."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pandas as pd

from ...common.errors import InputError
from ...common.units import BoolArray
from ...logs.limits import UNSCORED
from ...logs.records import Stream


def unscored(frame: pd.DataFrame) -> BoolArray:
    """Rows (n,) that carry a flag of :data:`~aerpaw_cmp.logs.limits.UNSCORED`."""
    flag = frame["flag"].to_numpy(dtype=object)
    out = np.zeros(len(flag), dtype=np.bool_)
    # one by one: few rows have a flag
    for i in np.flatnonzero(flag != ""):
        out[i] = any(word in UNSCORED for word in str(flag[i]).split(";"))
    return out


def without_values(stream: Stream, path: str) -> InputError | None:
    """Return the error of a series of which no row can be scored; None if a row can.

    A phone writes -1 for each level of a network that it does not receive: its other series are still good.
    """
    try:
        frame, _ = scored_rows(stream, path)
    except InputError as error:
        return error
    value = frame["rss_db" if stream.kind == "rss" else "rank"]
    if value.notna().any() or not len(frame):
        return None
    return InputError(
        f"{stream.kind} {stream.name!r} has no value in any row",
        expected="a number",
        cause="a column that the program left empty",
        path=path,
    )


def scored_rows(stream: Stream, path: str) -> tuple[pd.DataFrame, dict[str, int]]:
    """The rows that are scored, and how many the others are per flag.

    Parameters
    ----------
    stream : Stream
    path : str
        Of its log, for the message.

    Raises
    ------
    InputError
        If no row is left.
    """
    frame = stream.frame
    void = unscored(frame)
    if not void.any():
        return frame, {}
    words = Counter(w for text in frame["flag"][void] for w in str(text).split(";") if w in UNSCORED)
    if void.all():
        raise InputError(
            f"every row of {stream.kind} {stream.name!r} is flagged {', '.join(words)}",
            expected="values that can be, see docs/formats.md",
            cause="another unit, or exchanged columns",
            path=path,
        )
    return frame[~void], dict(words)

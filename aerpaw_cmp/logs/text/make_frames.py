"""Frames of the record model from plain arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from ...common.counting import counted
from ...common.jsonable import named
from ...common.units import AnyArray
from ..readers import ReadOptions
from ..records import COLUMNS, Attribute, Kind

_INTEGERS = ("fix", "satellites")


def frame(
    kind: Kind, time: AnyArray, line: AnyArray, flag: AnyArray, values: Mapping[str, AnyArray], *, own: bool = False
) -> pd.DataFrame:
    """Frame of a kind; columns that the log does not have are NaN (``fix`` and ``satellites``: -1).

    Its columns are copies, each an array of its own: streams of one log share their times.

    Parameters
    ----------
    kind : Kind
    time : (n,)
        datetime64[ns], UTC.
    line : (n,)
        Of the file, from 1.
    flag : (n,)
        Reasons, empty where there is none.
    values : mapping of str to (n,)
        Columns of the kind that the log has.
    own : bool
        Whether the arrays are given away: a log of 1 GB has no room for copies.

    Returns
    -------
    pandas.DataFrame
    """
    array = np.asarray if own else np.array
    count = len(time)
    content: dict[str, Any] = {
        "time": array(time, dtype="datetime64[ns]"),
        "line": array(line, dtype=np.int64),
        # object, not pandas' string type: no scan of the column, the same on every pandas
        "flag": pd.Series(array(flag, dtype=object), dtype=object, copy=False),
    }
    for name in COLUMNS[kind]:
        if name in _INTEGERS:
            content[name] = array(values[name], dtype=np.int64) if name in values else np.full(count, -1)
        else:
            content[name] = array(values[name], dtype=np.float64) if name in values else np.full(count, np.nan)
    for name, column in values.items():
        if name not in content:
            # a copy: the same array may serve several streams
            content[name] = np.array(column)
    columns: pd.DataFrame = pd.DataFrame(content, copy=False)
    return columns


def attributes(options: ReadOptions, **extra: Attribute | None) -> dict[str, Attribute]:
    """Attributes from the options, then those of the reader; what is unknown is left out."""
    merged: dict[str, Attribute | None] = {**named(options, "node channel frequency_hz timezone"), **extra}
    return {name: value for name, value in merged.items() if value is not None}


def steps_back(records: pd.DataFrame) -> int:
    """Number of places where the clock of a log runs backwards."""
    time = records["time"].to_numpy()
    # NaT compares as False
    return int(np.count_nonzero(time[1:] < time[:-1]))


def back_in_time(places: int) -> list[str]:
    """Warning where there are any."""
    return [f"time steps back at {counted(places, 'place')}"] if places else []

"""Comparison of data frames, and shorter records. The slow assertion of pandas runs only if the frames differ."""

import dataclasses
from typing import Any

import numpy as np
import pandas as pd

from aerpaw_cmp.logs.records import ReadResult


def assert_same_frame(left: pd.DataFrame, right: pd.DataFrame, **how: Any) -> None:
    """Compare like ``pandas.testing.assert_frame_equal``, with its options."""
    if not left.equals(right):
        pd.testing.assert_frame_equal(left, right, **how)


def assert_same_result(left: ReadResult, right: ReadResult) -> None:
    """Two results of one log: the account, warnings and every record."""
    for name in ("reader", "lines", "accepted", "blank", "rejected", "reasons", "warnings"):
        assert getattr(left, name) == getattr(right, name), name
    assert [(s.kind, s.name, dict(s.attributes)) for s in left.streams] == [
        (s.kind, s.name, dict(s.attributes)) for s in right.streams
    ]
    for a, b in zip(left.streams, right.streams, strict=True):
        assert_same_frame(a.frame, b.frame)


def thinned(record: Any, every: int, **change: Any) -> Any:
    """Return every n-th sample of a record."""
    cut: dict[str, Any] = {
        f.name: value[::every]
        for f in dataclasses.fields(record)
        if isinstance(value := getattr(record, f.name), np.ndarray) and len(value) == len(record.time)
    }
    if baselines := getattr(record, "baselines", {}):
        cut["baselines"] = {n: dataclasses.replace(b, level_dbm=b.level_dbm[::every]) for n, b in baselines.items()}
    if hasattr(record, "rank"):
        cut["rank"] = {k: rank[::every] for k, rank in record.rank.items()}
    return dataclasses.replace(record, **cut, **change)

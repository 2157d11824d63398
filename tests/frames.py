"""Frames compared: told apart by pandas' own assertion, which takes milliseconds, only where they are not the same."""

from typing import Any

import pandas as pd

from aerpaw_cmp.logs.records import ReadResult


def assert_same_frame(one: pd.DataFrame, other: pd.DataFrame, **how: Any) -> None:
    """As ``pandas.testing.assert_frame_equal``, whose options these are."""
    if not one.equals(other):
        pd.testing.assert_frame_equal(one, other, **how)


def assert_same_result(one: ReadResult, other: ReadResult) -> None:
    """Two results of one log: the account, warnings and every record."""
    for name in ("reader", "lines", "accepted", "blank", "rejected", "reasons", "warnings"):
        assert getattr(one, name) == getattr(other, name), name
    assert [(s.kind, s.name, dict(s.attributes)) for s in one.streams] == [
        (s.kind, s.name, dict(s.attributes)) for s in other.streams
    ]
    for a, b in zip(one.streams, other.streams, strict=True):
        assert_same_frame(a.frame, b.frame)

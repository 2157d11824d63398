"""Frames compared: told apart by pandas' own assertion, which takes milliseconds, only where they are not the same."""

from __future__ import annotations

from typing import Any

import pandas as pd


def assert_same_frame(one: pd.DataFrame, other: pd.DataFrame, **how: Any) -> None:
    """As ``pandas.testing.assert_frame_equal``, whose options these are."""
    if not one.equals(other):
        pd.testing.assert_frame_equal(one, other, **how)

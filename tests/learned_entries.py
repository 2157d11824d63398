"""Learned antennas of invented sites for tests: entries, and the tables that they name."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from aerpaw_cmp.site.learned import DirectionCovariance, Entry, LearnedSeries, LearnedSpread, sphere_csv

SPREAD = LearnedSpread(own_sd_db=0.0, noise_sd_db=0.0, fading_sd_db=0.0, fading_kurtosis=0.0, bin_s=4.0)
ENDS = {"t": "tower_file", "u": "uav_file", "k": "known_file", "m": "tower_known_file"}


def learned_series(channel: str = "A", **more: Any) -> LearnedSeries:
    """A series at LW1 whose tables are CHANNEL.t, CHANNEL.u, CHANNEL.k and CHANNEL.m."""
    usual: dict[str, Any] = {"tower": "LW1", "carrier_hz": 3.3e9, "sd_db": 1.5, "spread": SPREAD}
    files = {field: f"{channel}.{end}.csv.gz" for end, field in ENDS.items()}
    return LearnedSeries(channel=channel, **{**usual, **files, **more})


def learned_entry(*series: LearnedSeries, **more: Any) -> Entry:
    """An entry of two flights."""
    usual: dict[str, Any] = {
        "command": "aerpaw-cmp calibrate c.yaml --into-site s.yaml", "made": "2026-01-02", "flights": ["a", "b"],
        "flown": ["2025-06-01"], "trained_on": ["a" * 64],
    }  # fmt: skip
    return Entry(series=list(series), **{**usual, **more})


def learned_tables(channel: str = "A", notes: tuple[str, ...] = (), **tables: bytes) -> Mapping[str, bytes]:
    """Tables of a series by name: flat ones but for those that ``t`` and ``u`` give."""
    notes = ("aerpaw-cmp calibrate: c", *notes)
    flat = sphere_csv(np.zeros((7, 8)), np.ones((7, 8)), notes).encode()
    known = DirectionCovariance(directions=np.eye(3), covariance_db2=np.eye(3)).table(notes).encode()
    return {f"{channel}.{end}.csv.gz": tables.get(end, known if end in "km" else flat) for end in ENDS}

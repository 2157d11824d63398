"""Names of columns, keys and files, and instants as text."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..common.jsonable import number_key

# Columns of rss.csv, followed by one ``<baseline>_dbm`` per baseline.
RSS_COLUMNS: dict[str, str] = {
    "time_utc": "instant of the sample, ISO 8601, UTC; empty: the log has relative times and no origin was given",
    "time_s": "seconds after the first sample of this tower and channel",
    "tower": "name of the tower",
    "channel": "name of the channel",
    "unit": "unit of measured_db",
    "east_m": "UAV position, metres east of the site origin",
    "north_m": "metres north",
    "up_m": "metres above the ground at the origin",
    "measured_db": "as logged; empty: no signal",
    "calibrated_db": "measured_db plus the offset of this tower and channel",
    "simulated_dbm": "ray tracing; empty: no path",
    "residual_db": "calibrated_db minus simulated_dbm",
    "measured_out_of_coverage": "1: the log has no signal here",
    "simulated_out_of_coverage": "1: the ray tracing has no path here",
}

# Columns of rank.csv, followed by one ``simulated_rank_k<K>`` per K (0: no path), then what a receiver decides by:
# ``level_dbm`` and ``sigma<i>_over_sigma1_db``, 20 log10 of the ratio of singular values (empty: no path, or zero);
# with ``rank.receiver`` also ``probability_rank<r>``.
RANK_COLUMNS: dict[str, str] = {
    "time_utc": "instant of the report, ISO 8601, UTC; empty: the log has relative times and no origin was given",
    "time_s": "seconds after the first report of this tower",
    "tower": "name of the tower",
    "east_m": "UAV position, metres east of the site origin",
    "north_m": "metres north",
    "up_m": "metres above the ground at the origin",
    "measured_rank": "reported rank 1 to 4; empty: no CSI",
}


# K as a key of metrics.json and of rank.csv.
k_key = number_key


def iso_time(time: Any) -> Any:
    """Instants as ISO 8601 text with milliseconds and ``Z``; empty where not a time."""
    instants = np.asarray(time, dtype="datetime64[ns]")
    # half a unit added: numpy truncates, and a stored 0.9999999 s must not lose a millisecond
    text = np.datetime_as_string((instants + np.timedelta64(500_000, "ns")).astype("datetime64[ms]"), timezone="UTC")
    return np.where(np.isnat(instants), "", text)


def safe_name(text: str) -> str:
    """A part of a file name from any text.

    Examples
    --------
    >>> safe_name("LW1 USRP1"), safe_name("../a b"), safe_name("")
    ('LW1_USRP1', 'a_b', '_')
    """
    return re.sub(r"[^A-Za-z0-9.-]+", "_", text).strip("._")[:80] or "_"


def links_of(by_tower: Mapping[str, Mapping[str, Any]]) -> dict[tuple[str, str], Any]:
    """Numbers by tower and channel, of ``rss`` in metrics.json."""
    return {(tower, name): numbers for tower, channels in by_tower.items() for name, numbers in channels.items()}

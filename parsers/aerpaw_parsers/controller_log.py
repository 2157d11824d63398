"""Console of the AADM controller (stdout through ``ts``): blocks ``[Controller-->UAV] SNR:`` then ``n:value`` lines.

Value lines under ``Download:`` have the same form but are not levels. All other lines count as comments. There is one
SNR stream per tower number, ``LW<n>``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from aerpaw_cmp.common.units import BoolArray, IntArray
from aerpaw_cmp.readers import NUMBER, TIME, ZONE, LineFormat, Rows, Stream, match, snr_stream, split, text_reader

_STAMP = rb"^\[(?P<time>" + TIME + ZONE + rb")\] "
_VALUE = re.compile(_STAMP + rb"(?P<tower>\d{1,2}):(?P<snr>" + NUMBER + rb"|nan|-?inf)[ \t]*\r?$", re.MULTILINE)
_BLOCK = re.compile(_STAMP + rb"[^\n]{0,40}?\[Controller-->UAV\] (?P<what>SNR|Download):[ \t]*\r?$", re.MULTILINE)


def _no_level(data: bytes, row: IntArray) -> BoolArray:
    """Return the mask of value lines in blocks without levels, according to the last heading before each line."""
    heads, kinds = match(split(data), _BLOCK)
    of_levels = np.array([False] + [kind[1] == b"SNR" for kind in kinds], dtype=bool)
    return np.asarray(~of_levels[np.searchsorted(heads, row)])


def _streams(rows: Rows) -> Iterator[Stream | None]:
    tower, level = rows.number("tower"), rows.number("snr")
    for number in np.unique(tower[np.isfinite(tower)]).astype(int).tolist():
        yield snr_stream(rows, f"LW{number}", level, tower == number)


READER = text_reader(
    "controller_log", "AADM controller console: SNR of each tower", kinds=("rss",),
    sample="[2025-01-01 12:00:07.000002] 1:-1.250000",
    streams=_streams, lines=LineFormat(
        row=_VALUE, mark=re.compile(rb"^\[[^\n]{0,80}\[(?:Controller-->UAV|UAV-->Controller)\]", re.MULTILINE),
        torn=re.compile(_STAMP + rb"\d{1,2}:"), skip=_no_level,
    ),
)  # fmt: skip

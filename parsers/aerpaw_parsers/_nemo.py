"""What the two Nemo formats share: relative milliseconds, and the rank of the scheduled PDSCH."""

from __future__ import annotations

import numpy as np

from aerpaw_cmp.common.units import AnyArray, FloatArray
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.records import Stream

from . import _frames, _lines, _time

NO_RANK = "no_rank_in_row"
MOST_MS = 9.0e12
"""Relative times beyond about 285 years would leave the range of datetime64[ns]."""


def stream(
    lines: _lines.Lines,
    rows: AnyArray,
    relative_ms: FloatArray,
    values: dict[str, AnyArray],
    options: ReadOptions,
    reader: str,
) -> tuple[Stream, list[str]]:
    """Rank stream from relative times; without ``time_origin`` they count from 1970-01-01."""
    warnings: list[str] = []
    origin = _time.origin_ns(options, needed_by=reader)
    if origin is None:
        warnings.append("the times are relative and no time_origin is given: they count from 1970-01-01T00:00")
    time = (np.round(relative_ms * 1e6).astype(np.int64) + (origin or 0)).astype("datetime64[ns]")
    flag = _lines.flags(len(rows))
    raw = values["ri_raw"]
    missing = np.isnan(raw)
    _lines.add_flag(flag, missing, NO_RANK)
    odd = ~missing & ~((raw >= 1) & (raw <= 8))
    _lines.add_flag(flag, odd & (raw != 0), "rank_out_of_range")
    _lines.add_flag(flag, odd & (raw == 0), "no_csi")
    values["rank"] = np.where(missing | odd, np.nan, raw)
    if lines.unterminated:
        _lines.add_flag(flag, rows == len(lines) - 1, _lines.UNTERMINATED)
    frame = _frames.frame("rank", time, rows + 1, flag, values)
    attributes = _frames.attributes(
        options, ri_base="one", source="scheduled PDSCH rank", clock="relative" if origin is None else "utc"
    )
    return Stream("rank", options.channel or "pdsch_rank", frame, attributes), warnings + _frames.steps_back(frame)

"""Common parts of the readers of Keysight Nemo exports: head of the compact CSV, and rank of the scheduled PDSCH."""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.logs.records import Stream
from aerpaw_cmp.logs.text import rows as _rows

_NAMES = b"index rel_time_ms lat lon alt_m pdsch_rank nr_rsrp_dbm nr_sinr_db wb_cqi".split()
HEADER = re.compile(rb"(?:\xef\xbb\xbf)?" + b", ?".join(_NAMES) + rb"[ \t]*\r?")
_NO_RANK = "no_rank_in_row"


def sniff(head: bytes) -> bool:
    """Check whether the first line is the header."""
    return HEADER.fullmatch(head[:400].split(b"\n", 1)[0]) is not None


def pdsch_rank(rows: _rows.Rows, values: dict[str, FloatArray]) -> Stream | None:
    """Stream of the scheduled rank; ``values`` holds ``ri_raw`` and what stands beside it."""
    raw = values["ri_raw"]
    missing = np.isnan(raw)
    odd = ~missing & ~((raw >= 1) & (raw <= 8) & (raw == np.round(raw)))
    rows.mark(missing, _NO_RANK)
    rows.mark(odd & (raw != 0), "rank_out_of_range")
    rows.mark(odd & (raw == 0), "no_csi")
    values["rank"] = np.where(missing | odd, np.nan, raw)
    clock = "relative" if rows.relative else "utc"
    name = rows.options.channel or "pdsch_rank"
    return rows.stream("rank", name, values, ri_base="one", source="scheduled PDSCH rank", clock=clock)

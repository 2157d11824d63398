"""CSV of a Keysight Nemo phone: ``index,rel_time_ms,lat,lon,alt_m,pdsch_rank,nr_rsrp_dbm,nr_sinr_db,wb_cqi``.

Times are milliseconds relative to an origin that is not in the file. The rank is the rank of the scheduled PDSCH,
counted from one. Most rows have only a rank, or only RSRP, SINR and CQI. RSRP, SINR and CQI are also separate streams.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from aerpaw_cmp.readers import NUMBER, FloatArray, LineFormat, Rows, Stream, text_reader

from . import _cells

_NAMES = b"index rel_time_ms lat lon alt_m pdsch_rank nr_rsrp_dbm nr_sinr_db wb_cqi".split()
_HEADER = re.compile(rb"(?:\xef\xbb\xbf)?" + b", ?".join(_NAMES) + rb"[ \t]*\r?")
_COLUMNS = ("latitude_deg", "longitude_deg", "altitude_m", "ri_raw", "rsrp_dbm", "sinr_db", "cqi")
_LEVELS = (("rsrp_dbm", "nr_rsrp"), ("sinr_db", "nr_sinr"), ("cqi", "wb_cqi"))
_CELL = r", ?(?P<%s>" + NUMBER.decode() + "|nan|NaN|)"
_ROW = re.compile(
    rb"^\d{1,12}(?:\.0{0,20})?, ?(?P<time>" + NUMBER + rb")"
    + "".join(_CELL % name for name in _COLUMNS).encode() + rb"[ \t]*\r?$",
    re.MULTILINE,
)  # fmt: skip


def pdsch_rank(rows: Rows, values: dict[str, FloatArray]) -> Stream | None:
    """Return the stream of the scheduled rank from ``ri_raw`` and further columns in ``values``."""
    raw = values["ri_raw"]
    missing = np.isnan(raw)
    odd = ~missing & ~((raw >= 1) & (raw <= 8) & (raw == np.round(raw)))
    rows.mark(missing, "no_rank_in_row")
    rows.mark(odd & (raw != 0), "rank_out_of_range")
    rows.mark(odd & (raw == 0), "no_csi")
    values["rank"] = np.where(missing | odd, np.nan, raw)
    clock = "relative" if rows.relative else "utc"
    name = rows.options.channel or "pdsch_rank"
    return rows.stream("rank", name, values, ri_base="one", source="scheduled PDSCH rank", clock=clock)


def _streams(rows: Rows) -> Iterator[Stream | None]:
    values = {name: rows.number(name) for name in _COLUMNS}
    levels = [
        _cells.named(rows, name, values[column], where=np.isfinite(values[column]), about={"rat": "nr"})
        for column, name in _LEVELS
    ]  # read before pdsch_rank, which flags rows without a rank
    place = {name: values[name] for name in ("latitude_deg", "longitude_deg", "altitude_m")}
    track = rows.stream("telemetry", "phone", place, where=np.isfinite(place["latitude_deg"]), source="Nemo rows")
    yield pdsch_rank(rows, dict(values))
    yield from levels
    yield track


READER = text_reader(
    "nemo_csv", "Keysight Nemo NR rank and level, CSV with relative times", kinds=("rank", "rss", "kpi", "telemetry"),
    sample="12,-1500.0,35.7280001,-78.6960002,30.5,2.0,-81.5,28.0,12.0", streams=_streams,
    lines=LineFormat(row=_ROW, header=_HEADER, fields=9, otherwise="a field is not a number", clock="relative_ms"),
)  # fmt: skip

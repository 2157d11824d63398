"""Samples as a MATLAB 5 file: structs of column vectors."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from ...common.errors import UsageError
from ...common.units import AnyArray
from .samples import Export, SampleSet, Series, latitude_longitude

LARGEST = 2**31 - 2**20
"""Bytes of one variable of a MATLAB 5 file, a little below its limit."""


def write_mat(export: Export, folder: Path) -> list[Path]:
    """``samples.mat``: ``about``, ``towers``, ``units``, and ``rss`` and ``rank`` with one element per link.

    Raises
    ------
    UsageError
        If a variable would be larger than the format takes.
    """
    from scipy.io import savemat

    towers = export.site.towers.values()
    content: dict[str, Any] = {
        "about": {
            "name": export.name,
            "title": export.title,
            "remarks": " ".join(export.remarks),
            "time": "time_posix_s counts seconds since 1970-01-01 UTC: datetime(x, 'ConvertFrom', 'posixtime')",
            "has_clock": export.clock,
            "synthetic": export.synthetic,
            **export.attributes,
        },
        "towers": {
            "name": _cells([t.name for t in towers]),
            "latitude_deg": np.array([t.latitude_deg for t in towers]),
            "longitude_deg": np.array([t.longitude_deg for t in towers]),
            "position_m": np.array([t.position_m for t in towers]).reshape(-1, 3),
        },
    }
    for samples in export.sets:
        content[samples.kind] = _structs(export, samples)
        content[f"{samples.kind}_units"] = {_field(c.name): c.shown_unit or "1" for c in samples.columns}
        largest = len(samples) * (len(samples.columns) + 7) * 8
        if largest > LARGEST:
            raise UsageError(
                f"{samples.kind} has {len(samples)} samples, {largest / 2**30:.1f} GiB: too many for a MATLAB 5 file",
                expected="another format, such as parquet or netcdf (which MATLAB reads, too)",
            )
    buffer = io.BytesIO()
    savemat(buffer, content, long_field_names=True, do_compression=True, oned_as="column")
    path = folder / "samples.mat"
    path.write_bytes(buffer.getbuffer())
    return [path]


def _field(name: str) -> str:
    """A name that MATLAB takes.

    Examples
    --------
    >>> _field("simulated_rank_k12.5")
    'simulated_rank_k12_5'
    """
    return re.sub(r"\W", "_", name)[:63]


def _cells(texts: list[str]) -> AnyArray:
    cells = np.empty((len(texts), 1), dtype=object)
    cells[:, 0] = texts
    return cells


def _structs(export: Export, samples: SampleSet) -> AnyArray:
    """A struct array (1, links)."""
    tables = [_struct(export, samples, series) for series in samples.series]
    array = np.empty((1, len(tables)), dtype=[(name, object) for name in tables[0]])
    for i, table in enumerate(tables):
        array[0, i] = tuple(table.values())
    return array


def _struct(export: Export, samples: SampleSet, series: Series) -> dict[str, Any]:
    latitude, longitude = latitude_longitude(export.site.frame, series.east_m, series.north_m)
    seconds = series.time.astype(np.int64) / 1e9
    missing = np.full(len(series), np.nan)
    table: dict[str, Any] = {
        "flight": series.flight,
        "tower": series.tower,
        "channel": series.channel,
        "unit": series.unit,
        "time_posix_s": np.where(np.isnat(series.time), np.nan, seconds),
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "east_m": series.east_m,
        "north_m": series.north_m,
        "up_m": series.up_m,
    }
    table |= {_field(c.name): series.values.get(c.name, missing) for c in samples.columns}
    return {
        name: value if isinstance(value, str) else np.asarray(value, dtype=np.float64)[:, None]
        for name, value in table.items()
    }

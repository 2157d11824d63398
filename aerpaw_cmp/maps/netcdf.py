"""Maps as one NetCDF file after CF-1.11: arrays over foliage, tower, K, height, y and x.

Values are rounded to 0.01 dB, more than the site's data hold. The maps in which the nearest tower serves are
variables of their own (``..._joint``): what ``serving_tower`` picks from the maps by tower.

NetCDF needs netCDF4: ``pip install aerpaw-cmp[geo]``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..common.cf import CONVENTIONS, DB, DBM, site_crs, write_text
from ..common.errors import UsageError
from ..common.geodesy import SiteFrame
from ..common.units import AnyArray, FloatArray
from .job import HIGHEST_RANK, RATIO_LIMIT_DB, MapResult

_PLANE = ("y", "x")


def write_netcdf(
    path: str | Path, maps: Mapping[str, MapResult], frame: SiteFrame, *, title: str, generated: str, version: str
) -> Path:
    """NetCDF-CF with dimensions foliage, tower, k, height, y, x; made in memory, then written.

    Parameters
    ----------
    path : path
        The file; replaced where it exists.
    maps : mapping of str to MapResult
        By foliage mode; all of one grid, one list of towers, heights and K.
    frame : SiteFrame
        From local metres to latitude and longitude.
    title : str
        Attribute of the file.
    generated, version : str
        When the maps were made (ISO 8601), and by which version.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    UsageError
        If netCDF4 is not installed.
    """
    try:
        import netCDF4
    except ImportError as missing:
        raise UsageError(
            f"NetCDF needs {missing.name}, which is not installed",
            expected="pip install 'aerpaw-cmp[geo]', or another format",
        ) from None
    # HDF5 ends the process where a disk is full
    book = netCDF4.Dataset("maps", "w", memory=1 << 20)
    book.setncatts(
        {
            "Conventions": CONVENTIONS,
            "title": title,
            "source": f"aerpaw-cmp {version}: ray tracing",
            "history": f"{generated} written by aerpaw-cmp {version}",
            "institution": "not stated",
            "references": "https://arxiv.org/abs/2502.10324",
            "comment": "A missing level has no path or lies below the threshold. A rank of 0 is a code: no path.",
        }
    )
    first = next(iter(maps.values()))
    _axes(book, first, tuple(maps), frame)
    _levels(book, maps)
    _ranks(book, maps)
    target = Path(path)
    target.write_bytes(book.close())
    return target


# --- coordinates ----------------------------------------------------------------------------------------------------


def _axes(book: Any, maps: MapResult, modes: Sequence[str], frame: SiteFrame) -> None:
    book.createDimension("foliage", len(modes))
    book.createDimension("tower", len(maps.tower_names))
    _axis(book, "k", np.array(maps.ks), {"long_name": "singular-value ratio K of the rank", "units": "1"})
    for name, heights, what in (
        ("height", maps.rss_altitudes_m, "levels"),
        ("height_of_rank", maps.rank_altitudes_m, "ranks"),
    ):
        _axis(
            book,
            name,
            np.array(heights),
            {"standard_name": "height", "long_name": f"height above ground of the {what}", "units": "m",
             "positive": "up", "axis": "Z"},
        )  # fmt: skip
    for name, values, what in (("y", maps.grid.north_m, "north"), ("x", maps.grid.east_m, "east")):
        _axis(
            book,
            name,
            values,
            {
                "standard_name": f"projection_{name}_coordinate",
                "long_name": f"{what} of the site origin",
                "units": "m",
                "axis": name.upper(),
            },
        )
    write_text(book, "foliage_mode", ("foliage",), np.array(modes, dtype=object), "how trees act")
    names = np.array(maps.tower_names, dtype=object)
    write_text(book, "tower_name", ("tower",), names, "name of the tower")
    for i, (name, what) in enumerate((("tower_x", "east"), ("tower_y", "north"), ("tower_height", "above the ground"))):
        variable = book.createVariable(name, "f8", ("tower",))
        variable.setncatts({"long_name": f"array centre of the tower, {what} at the site origin", "units": "m"})
        variable[:] = maps.towers_m[:, i]
    points = maps.grid.points_m
    latitude, longitude = frame.to_geographic(points[:, 0], points[:, 1])
    for name, values, unit in (("latitude", latitude, "degrees_north"), ("longitude", longitude, "degrees_east")):
        variable = book.createVariable(name, "f8", _PLANE, zlib=True, fill_value=False)
        variable.setncatts({"standard_name": name, "long_name": f"WGS84 {name}", "units": unit})
        variable[:] = maps.grid.raster(values)
    crs = book.createVariable("crs", "i4")
    crs.setncatts({name: value for name, value in site_crs(frame).to_cf().items() if value is not None})
    crs.long_name = "site frame"
    crs[...] = 0
    serving = _codes(book, "serving_tower", _PLANE, maps.tower_names, "nearest tower, which serves here")
    serving[:] = maps.grid.raster(maps.serving).astype(np.int8)


def _axis(book: Any, name: str, values: FloatArray, attributes: Mapping[str, str]) -> None:
    book.createDimension(name, len(values))
    variable = book.createVariable(name, "f8", (name,), fill_value=False)
    variable.setncatts(dict(attributes))
    variable[:] = values


# --- maps -----------------------------------------------------------------------------------------------------------

_LABELS = "foliage_mode latitude longitude"
_MAPPING = "crs"


def _levels(book: Any, maps: Mapping[str, MapResult]) -> None:
    kinds: tuple[tuple[str, str, Callable[[MapResult], FloatArray]], ...] = (
        ("rss_siso", "received level, one element at both ends", lambda m: m.rss_siso_dbm),
        ("rss_mimo", "received level, arrays at both ends", lambda m: m.rss_mimo_dbm),
    )
    for name, meaning, part in kinds:
        _write(
            book=book,
            maps=maps,
            name=name,
            between=("tower", "height"),
            meaning=meaning,
            unit=DBM,
            shown="dBm",
            part=part,
        )


def _ranks(book: Any, maps: Mapping[str, MapResult]) -> None:
    kinds: tuple[tuple[str, str, Callable[[MapResult], FloatArray]], ...] = (
        ("spread", "largest over second singular value", lambda m: m.spread_db),
        ("condition", "largest over last singular value", lambda m: m.condition_db),
    )
    for name, meaning, part in kinds:
        said = f"{meaning}, at most {RATIO_LIMIT_DB:g} dB"
        _write(
            book=book,
            maps=maps,
            name=name,
            between=("tower", "height_of_rank"),
            meaning=said,
            unit=DB,
            shown="dB",
            part=_limited(part),
        )
    meanings = ("out_of_coverage", *(f"rank_{i}" for i in range(1, HIGHEST_RANK + 1)))
    for joint in (False, True):
        by_tower = () if joint else ("tower",)
        dimensions = ("foliage", *by_tower, "k", "height_of_rank", *_PLANE)
        said = "channel rank" + (", nearest tower" if joint else "")
        variable = _codes(book, "rank_joint" if joint else "rank", dimensions, meanings, said)
        variable.coordinates = _LABELS if joint else f"{_LABELS} tower_name"
        for i, one in enumerate(maps.values()):
            # (height, K, tower, n) to (tower, K, height, n)
            values = np.moveaxis(one.ranks(), 1, 0) if joint else np.moveaxis(one.rank, (2, 1, 0), (0, 1, 2))
            variable[i] = _plane(one, values)


def _limited(part: Callable[[MapResult], FloatArray]) -> Callable[[MapResult], FloatArray]:
    return lambda maps: np.minimum(part(maps), RATIO_LIMIT_DB)


def _plane(maps: MapResult, values: AnyArray) -> AnyArray:
    """The last axis, positions in index order, as y and x."""
    return np.asarray(values).reshape(*values.shape[:-1], *maps.grid.shape)


def _write(
    book: Any, maps: Mapping[str, MapResult], name: str, between: tuple[str, ...], meaning: str, unit: str, shown: str,
    part: Callable[[MapResult], FloatArray],
) -> None:  # fmt: skip
    """A quantity by tower and height, and beside it that of the nearest tower."""
    for joint in (False, True):
        dimensions = tuple(d for d in between if not joint or d != "tower")
        variable = book.createVariable(
            f"{name}_joint" if joint else name, "f4", ("foliage", *dimensions, *_PLANE),
            zlib=True, complevel=4, shuffle=True, fill_value=np.float32(np.nan),
        )  # fmt: skip
        variable.setncatts(
            {
                "long_name": meaning + (", nearest tower" if joint else ""),
                "units": unit,
                "comment": f"unit: {shown}",
                "coordinates": _LABELS if joint else f"{_LABELS} tower_name",
                "grid_mapping": _MAPPING,
            }
        )
        for i, one in enumerate(maps.values()):
            values = np.moveaxis(part(one), 1, 0)  # tower, height, n
            if joint:
                values = values[one.serving, :, np.arange(len(one.grid))].T
            variable[i] = np.round(_plane(one, values), 2)


def _codes(book: Any, name: str, dimensions: tuple[str, ...], meanings: Sequence[str], long_name: str) -> Any:
    """A variable of classes 0, 1, ..."""
    variable = book.createVariable(name, "i1", dimensions, zlib=True, complevel=4, fill_value=False)
    variable.setncatts(
        {
            "long_name": long_name,
            "flag_values": np.arange(len(meanings), dtype=np.int8),
            # all that CF allows in a meaning
            "flag_meanings": " ".join(re.sub(r"[^A-Za-z0-9_.+@-]", "_", one) or "_" for one in meanings),
            "grid_mapping": _MAPPING,
        }
    )
    return variable

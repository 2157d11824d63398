"""Predictions of any program as one table: CSV, NetCDF, a radio map in .npz, or the logs of an emulated flight.

Columns of a CSV and variables of a NetCDF file: ``time`` or ``time_utc``, or ``east_m north_m height_m``, or
``latitude_deg longitude_deg height_m``; ``tower``; one of ``level_dbm``, ``level_db``, ``path_loss_db``; optionally
``channel``, ``sd_db``, ``q05_db`` and ``q95_db``, ``rank``, ``p_rank1`` to ``p_rank4``. docs/referee.md has examples.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ...common.counting import counted
from ...common.errors import InputError, parsing
from ...common.files import LARGEST_TABLE, read_input
from ...common.native import read as read_native
from ...common.units import AnyArray, FloatArray
from ...flight.data import FlightData, load_data
from ...flight.drafting.draft import DraftOptions, drafts
from ...flight.settings import FlightFile
from ...flight.training import flight_logs
from ...logs.ingest import ingest
from ...logs.readers import ReadOptions
from ...propagation.field.sum import mean_pair_power, rss_dbm
from ...site.site import Site
from ..learning.calibrate import observe

QUANTITIES = ("level_dbm", "level_db", "path_loss_db")
RANKS = ("p_rank1", "p_rank2", "p_rank3", "p_rank4")
_PLACE = ("east_m", "north_m", "height_m")
_GEOGRAPHIC = ("latitude_deg", "longitude_deg", "height_m")
_OPTIONAL = ("sd_db", "q05_db", "q95_db", "rank", *RANKS)

_WANTED = (
    "time_utc, or east_m, north_m, height_m, or latitude_deg, longitude_deg, height_m; tower; level_dbm, level_db or "
    "path_loss_db (docs/referee.md has an example)"
)

# A file of more bytes is refused.
_MOST_BYTES = 4 * LARGEST_TABLE

# A prediction whose positions lie farther from the site is one of another place [m].
_FAR_M = 50_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeignPrediction:
    """A prediction of another program.

    Parameters
    ----------
    path : Path
        The file or folder.
    program : str
        What wrote it, as far as the file says.
    quantity : str
        One of :data:`QUANTITIES`; empty if only ranks are predicted.
    table : DataFrame
        One row per prediction: ``time`` (datetime64[ns], NaT if unknown), ``east_m north_m height_m`` in the site
        frame (NaN if unknown), ``tower``, ``channel`` (empty: every channel of the tower), ``level`` [dB or dBm], and
        those of ``sd_db q05_db q95_db rank p_rank1..4`` that the file has.
    remarks : tuple of str
        Sentences on how the file was read.
    """

    path: Path
    program: str
    quantity: str
    table: pd.DataFrame
    remarks: tuple[str, ...] = ()

    @property
    def timed(self) -> bool:
        """True if the rows are matched by time, else by position."""
        return bool(self.table["time"].notna().any())


def read_foreign(path: Path, data: FlightData) -> ForeignPrediction:
    """Return the prediction that a file or folder holds.

    Parameters
    ----------
    path : Path
        CSV, NetCDF, .npz, or a folder with the logs of an emulated flight.
    data : FlightData
        The flight that is scored: its site, time zone and towers.

    Returns
    -------
    ForeignPrediction

    Raises
    ------
    InputError
        If the file is damaged, or lacks a position, a tower, or a level with its unit.
    """
    if (path / "prediction.csv").is_file():  # a folder of 'predict'
        path = path / "prediction.csv"
    if path.is_dir():
        return _emulated(path, data)
    content = read_input(path, _MOST_BYTES, "a prediction: CSV, NetCDF, .npz, or a folder")
    if content[:8] == b"\x89HDF\r\n\x1a\n":
        frame, program, remarks = _netcdf(content, path)
    elif content[:4] == b"PK\x03\x04":
        frame, program, remarks = _radio_map(content, path)
    elif content[:3] == b"CDF":
        raise InputError("a NetCDF file of version 3", expected="NetCDF 4 ('nccopy -k nc4 IN OUT')", path=path)
    else:
        frame, program, remarks = _csv(content, path)
    quantity, table = _checked(frame, path, data.site)
    _check_towers(table, data, path)
    return ForeignPrediction(path=path, program=program, quantity=quantity, table=table, remarks=tuple(remarks))


# --- formats -------------------------------------------------------------------------------------------------------


def _csv(content: bytes, path: Path) -> tuple[pd.DataFrame, str, list[str]]:
    with parsing(path, "a CSV with a header: " + _WANTED, cause="another format"):
        frame = pd.read_csv(io.BytesIO(content), comment="#", skipinitialspace=True, low_memory=False)
    frame.columns = [str(name).strip().lower() for name in frame.columns]
    return frame, "CSV", []


def _netcdf(content: bytes, path: Path) -> tuple[pd.DataFrame, str, list[str]]:
    """Variables along the dimensions of the level, one row per element."""
    with parsing(path, "a NetCDF file"):
        arrays, notes = read_native("netcdf", content)
    program = str(notes["attributes"].get("source", "NetCDF"))
    dims = {name: notes["dims"][name][: values.ndim] for name, values in arrays.items()}
    arrays = {name.lower(): values for name, values in arrays.items()}
    dims = {name.lower(): names for name, names in dims.items()}
    if "tower_name" in arrays:  # of an older channel.nc
        arrays["tower"], dims["tower"] = arrays["tower_name"], dims["tower_name"]
    if "height_m" not in arrays and "up_m" in arrays:
        arrays["height_m"], dims["height_m"] = arrays["up_m"], dims["up_m"]
    remarks: list[str] = []
    if "h_real" in arrays and not set(arrays) & set(QUANTITIES):
        h = arrays["h_real"] + 1j * arrays["h_imag"]
        power_dbm = float(notes["attributes"].get("transmit_power_dbm", 0.0))
        arrays["level_dbm"] = rss_dbm(mean_pair_power(h), power_dbm)
        dims["level_dbm"] = dims["h_real"][:-2]
        remarks.append(f"The levels of {path.name} are those of H, with {power_dbm:g} dBm transmitted.")
    main = next((name for name in (*QUANTITIES, "rank", RANKS[0]) if name in arrays), None)
    if main is None:
        raise InputError("no variable with a level", expected=_WANTED, path=path)
    shape = dict(zip(dims[main], arrays[main].shape, strict=True))
    if "series" in shape and "series" in arrays:  # tower and channel in one name, as 'predict' writes them
        words = [str(name).partition(" ") for name in arrays["series"]]
        for name, values in (("tower", [w[0] for w in words]), ("channel", [w[2] for w in words])):
            arrays[name], dims[name] = np.array(values, dtype=np.str_), ["series"]
    columns = {}
    known = ("time", "time_utc", "tower", "channel", *_PLACE, *_GEOGRAPHIC, *QUANTITIES, *_OPTIONAL)
    for name in (name for name in known if name in arrays and set(dims[name]) <= set(shape)):
        order = [dims[name].index(dim) for dim in shape if dim in dims[name]]
        place = [size if dim in dims[name] else 1 for dim, size in shape.items()]
        columns[name] = np.broadcast_to(arrays[name].transpose(order).reshape(place), tuple(shape.values())).ravel()
    unit = str(notes["units"].get("time", ""))
    if "time" in columns and columns["time"].dtype.kind in "fiu":
        columns.pop("time") if " since " not in unit else columns.update(time=_since(columns["time"], unit, path))
    return pd.DataFrame(columns), program, remarks


def _since(values: AnyArray, unit: str, path: Path) -> AnyArray:
    """Return times of a CF unit such as ``seconds since 2025-06-10T14:00:00Z``."""
    word, _, start = unit.partition(" since ")
    sizes = {"second": 1.0, "minute": 60.0, "hour": 3600.0, "day": 86400.0}
    sizes |= {"s": 1.0, "ms": 1e-3, "millisecond": 1e-3, "microsecond": 1e-6, "nanosecond": 1e-9}
    with parsing(path, "a time unit such as 'seconds since 2025-06-10T14:00:00Z'"):
        origin = pd.Timestamp(start)
        origin = origin.tz_localize("UTC") if origin.tzinfo is None else origin.tz_convert("UTC")
        name = word.strip().lower()
        size = sizes.get(name) or sizes[name.rstrip("s")]
        nanoseconds = np.round(np.asarray(values, dtype=np.float64) * size * 1e9)
        stamps = origin.value + np.nan_to_num(nanoseconds).astype(np.int64)
        return np.asarray(pd.DatetimeIndex(stamps.astype("datetime64[ns]"), tz="UTC"))


def _radio_map(content: bytes, path: Path) -> tuple[pd.DataFrame, str, list[str]]:
    """A radio map as ``np.savez(path_gain=..., cell_centers=..., tx_names=...)`` of Sionna RT writes it."""
    with parsing(path, "an .npz with path_gain, cell_centers, tx_names"), np.load(io.BytesIO(content)) as book:
        missing = {"path_gain", "cell_centers", "tx_names"} - set(book.files)
        if missing:
            raise InputError(
                f"no array {', '.join(sorted(missing))}", expected="path_gain, cell_centers, tx_names", path=path
            )
        if sum(info.file_size for info in book.zip.infolist()) > _MOST_BYTES:
            raise InputError("the arrays are too large", expected=f"at most {_MOST_BYTES >> 20} MiB", path=path)
        gain, centre, names = (np.asarray(book[name]) for name in ("path_gain", "cell_centers", "tx_names"))
    if gain.ndim != 3 or centre.shape != (*gain.shape[1:], 3) or names.shape != gain.shape[:1]:
        raise InputError(
            f"shapes {gain.shape}, {centre.shape}, {names.shape}",
            expected="path_gain (towers, rows, columns), cell_centers (rows, columns, 3), tx_names (towers,)",
            path=path,
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        loss = -10.0 * np.log10(gain.astype(np.float64).reshape(len(names), -1))
    loss[~np.isfinite(loss)] = np.nan
    columns = dict(zip(_PLACE, np.tile(centre.reshape(-1, 3), (len(names), 1)).T.astype(np.float64), strict=True))
    table = pd.DataFrame(
        {**columns, "tower": np.repeat(names.astype(str), loss.shape[1]), "path_loss_db": loss.ravel()}
    )
    remark = "The cell centres of the radio map are taken as east, north and up of the site [m]."
    return table, "radio map (.npz)", [remark]


def _emulated(folder: Path, data: FlightData) -> ForeignPrediction:
    """Levels and positions of the logs of an emulated flight, matched by position."""
    if (folder / "flight.yaml").is_file():
        from ...flight.gains.memory import load_with_learned

        settings, home = load_with_learned(folder / "flight.yaml"), folder
    else:
        settings, home = _drafted(folder, data), folder
    twin = load_data(settings, home)
    if set(flight_logs(twin)) & set(flight_logs(data)):
        raise InputError(
            "logs of the scored flight itself",
            expected="logs of an emulated flight",
            cause="the folder of the real flight was named",
            path=folder,
        )
    observed, _ = observe([twin])
    parts = []
    for o in observed:
        samples = o.samples
        level = samples.residual_db + o.free_space_db
        place = dict(zip(_PLACE, samples.position_m.T, strict=True))
        parts.append(pd.DataFrame({**place, "tower": samples.tower, "channel": samples.channel, "level_db": level}))
    if not parts:
        raise InputError("no level with a position", expected="levels and telemetry of an emulated flight", path=folder)
    table = pd.concat(parts, ignore_index=True)
    heard = {(s.tower, s.channel) for s in data.rss}
    if not heard & set(zip(table["tower"], table["channel"], strict=True)):
        table["channel"] = ""  # the emulator names its channels in another way
    # a hover has many levels at one position: their mean is what the emulator predicts there
    table = table.groupby(["tower", "channel", *_PLACE], as_index=False, sort=False)["level_db"].mean()
    quantity, table = _checked(table, folder, data.site)
    _check_towers(table, data, folder)
    remark = f"{folder.name} is an emulated flight: {counted(len(table), 'level')} with a position."
    return ForeignPrediction(path=folder, program="emulated flight", quantity=quantity, table=table, remarks=(remark,))


def _drafted(folder: Path, data: FlightData) -> FlightFile:
    """The flight file that a draft of the folder proposes for the site of the scored flight."""
    from ...common.yamlfile import parse_yaml

    site = str(data.site_place) if not Path(data.site_place).is_file() else str(Path(data.site_place).resolve())
    timezone = data.settings.timezone
    options = DraftOptions(timezone=timezone, site=site)
    files = ingest([folder], options=ReadOptions(timezone=timezone))
    if not files:
        raise InputError("no log", expected="power logs and telemetry of an emulated flight", path=folder)
    text = drafts(files, folder, options)[0].text
    return parse_yaml(text, FlightFile)


# --- checks --------------------------------------------------------------------------------------------------------


def _checked(frame: pd.DataFrame, path: Path, site: Site) -> tuple[str, pd.DataFrame]:
    """Return the quantity and the table under the names of :class:`ForeignPrediction`."""
    quantities = [name for name in QUANTITIES if name in frame]
    if len(quantities) > 1:
        raise InputError(f"columns {', '.join(quantities)}", expected="one of them", path=path)
    if not quantities and not {"rank", *RANKS} & set(frame):
        near = [
            str(name) for name in frame if str(name).lower() in ("level", "rss", "rsrp", "rssi", "power", "path_gain")
        ]
        raise InputError(
            f"no column of a level with its unit (columns: {', '.join(map(str, frame))})",
            expected="level_dbm, level_db (the unit of the log) or path_loss_db",
            cause=f"the unit of {near[0]!r} is not in its name" if near else None,
            path=path,
        )
    if "tower" not in frame:
        raise InputError(f"no column tower (columns: {', '.join(map(str, frame))})", expected=_WANTED, path=path)
    quantity = quantities[0] if quantities else ""
    table = pd.DataFrame({"tower": frame["tower"].astype(str).str.strip()})
    table["channel"] = frame["channel"].astype(str).str.strip().replace({"nan": ""}) if "channel" in frame else ""
    table["time"] = _times(frame, path)
    table[list(_PLACE)] = _places(frame, path, site)
    if table["time"].isna().all() and table["east_m"].isna().all():
        raise InputError("rows without a time and without a position", expected=_WANTED, path=path)
    for name in (quantity, *_OPTIONAL):
        if name in frame:
            table["level" if name == quantity else name] = _numbers(frame[name])
    if "level" not in table:
        table["level"] = np.nan
    _check_levels(table["level"].to_numpy(np.float64), quantity, path)
    _check_repeats(table, path)
    return quantity, table


def _numbers(column: Any) -> Any:
    return pd.to_numeric(column, errors="coerce").astype(np.float64)


def _times(frame: pd.DataFrame, path: Path) -> Any:
    """Times (n,) as naive UTC datetime64[ns]; NaT without a column of times."""
    name = next((name for name in ("time_utc", "time") if name in frame), None)
    if name is None:
        return pd.Series(pd.NaT, index=frame.index, dtype="datetime64[ns]")
    column = frame[name]
    numeric = pd.api.types.is_numeric_dtype(column)
    text = not numeric and not pd.api.types.is_datetime64_any_dtype(column)
    if name == "time" and text and not column.astype(str).str.contains(r"Z$|[+-]\d\d:?\d\d$").all():
        raise InputError(
            f"times without a zone, such as {column.iloc[0]!r}", expected="a column time_utc, or times that end in Z",
            path=path,
        )  # fmt: skip
    if numeric:
        raise InputError(
            f"times as numbers ({column.iloc[0]})", expected="ISO 8601, such as 2025-06-10T14:00:00Z", path=path
        )
    stamps = pd.to_datetime(column, utc=True, errors="coerce", format="ISO8601")
    if stamps.isna().all():
        raise InputError(f"no time that can be read ({column.iloc[0]!r})", expected="ISO 8601 in UTC", path=path)
    return stamps.dt.tz_localize(None).astype("datetime64[ns]")


def _places(frame: pd.DataFrame, path: Path, site: Site) -> AnyArray:
    """East, north, up (n, 3) in the site frame [m]; NaN without columns of positions."""
    if set(_PLACE) <= set(frame):
        place = np.column_stack([_numbers(frame[name]) for name in _PLACE])
    elif set(_GEOGRAPHIC) <= set(frame):
        latitude, longitude, height = (np.asarray(_numbers(frame[name])) for name in _GEOGRAPHIC)
        with np.errstate(invalid="ignore"):
            east, north = site.frame.to_local(latitude, longitude)
            swapped = site.frame.to_local(np.clip(longitude, -90, 90), latitude)
        if np.nanmin(np.hypot(east, north)) > _FAR_M:
            exchanged = np.nanmin(np.hypot(*swapped)) <= _FAR_M
            raise InputError(
                f"the nearest position is {np.nanmin(np.hypot(east, north)) / 1000:.0f} km from the site",
                expected="latitude_deg, longitude_deg near the site",
                cause="latitude and longitude are swapped" if exchanged else "a prediction of another place",
                path=path,
            )
        place = np.column_stack([east, north, height + site.takeoff_ground_m])
    else:
        return np.full((len(frame), 3), np.nan)
    if np.nanmin(np.hypot(place[:, 0], place[:, 1]), initial=np.inf) > _FAR_M:
        raise InputError(
            "every position is more than 50 km from the site's origin", expected="metres east and north of the origin",
            cause="map coordinates (UTM) instead of metres from the origin", path=path,
        )  # fmt: skip
    return place


def _check_levels(level: FloatArray, quantity: str, path: Path) -> None:
    """Refuse levels that cannot have the unit of their column."""
    known = level[np.isfinite(level)]
    if not len(known) or not quantity:
        return
    middle, what = float(np.median(known)), f"a median {quantity} of {np.median(known):.3g}"
    if quantity == "level_dbm" and known.min() > 0.0 and known.max() < 1.0:
        raise InputError(
            what, expected="levels in dBm", cause="watts or milliwatts; 10 log10(P / 1 mW) is the level", path=path
        )
    if quantity == "level_dbm" and middle > 60.0:
        raise InputError(what, expected="received levels in dBm", cause="a path loss (path_loss_db)", path=path)
    if quantity == "path_loss_db" and middle < 0.0:
        raise InputError(what, expected="a loss, above 0", cause="a path gain; its negative is the loss", path=path)


def _check_repeats(table: pd.DataFrame, path: Path) -> None:
    """Refuse two rows of one tower, channel and time (or position) with different levels."""
    key = ["tower", "channel", *(["time"] if table["time"].notna().any() else list(_PLACE))]
    repeated = table.duplicated([*key, "level"], keep="first")
    distinct = table[~repeated]
    twice = distinct.duplicated(key, keep=False) & distinct["level"].notna()
    if twice.any():
        row = distinct[twice].iloc[0]
        where = row["time"] if "time" in key else tuple(round(float(row[name]), 1) for name in _PLACE)
        raise InputError(
            f"{counted(int(twice.sum()), 'row')} with another level at the same place: tower {row['tower']}, {where}",
            expected="one row per tower, channel and time or position",
            cause="two channels or two heights without their column",
            path=path,
        )


def _check_towers(table: pd.DataFrame, data: FlightData, path: Path) -> None:
    """Refuse a prediction without any tower of the flight."""
    ours, theirs = {s.tower for _, s in data.series}, set(table["tower"])
    if not ours & theirs:
        shown: Sequence[str] = sorted(theirs)[:8]
        raise InputError(
            f"towers {', '.join(shown)}", expected=f"towers of the flight: {', '.join(sorted(ours))}",
            cause="other names for the same towers; rename them in the file", path=path,
        )  # fmt: skip


def split_by_series(table: pd.DataFrame, tower: str, channel: str) -> pd.DataFrame:
    """Return the rows of a tower that count for one of its channels."""
    part: pd.DataFrame = table[(table["tower"] == tower) & table["channel"].isin(["", channel])]
    own: pd.DataFrame = part[part["channel"] == channel]
    return part if own.empty else own

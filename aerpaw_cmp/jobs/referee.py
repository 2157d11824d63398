"""Predictions of any program, scored on one flight together with ray tracing and the baselines.

``report flight.yaml --against FILE``. A prediction is read as one table: CSV, NetCDF, a radio map in .npz, the output
folder of ``predict``, or the logs of an emulated flight. Samples are matched to predictions by time if the file has
times, else by position. Every model is scored on the samples that the prediction covers, so that the cards can be
compared. docs/referee.md lists the columns and has examples.
"""

from __future__ import annotations

import io
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ..common.content import KEY, MARKS
from ..common.errors import AerpawCmpError, InputError, UsageError, about_file, parsing
from ..common.files import LARGEST_TABLE, read_bounded, read_input
from ..common.jsonable import json_object
from ..common.native import read as read_native
from ..common.outputs import file_digest
from ..common.text import counted
from ..common.units import FOOT_M, AnyArray, BoolArray, FloatArray, db_from_power
from ..common.yamlfile import parse_yaml
from ..compare import referee
from ..compare.level import detection_floor_db, nearest_in_time, nearest_points
from ..compare.rank import MAX_RANK, compare_ranks
from ..compare.receiver import score_forecast
from ..compare.result import BASELINE_TITLE, FlightResult, RankResult, RssResult
from ..compare.statistics import FEWEST, paired_difference
from ..flight.clock import clock_trap
from ..flight.data import FlightData, load_data
from ..flight.drafting.draft import DraftOptions, drafts
from ..flight.gains import load_with_learned
from ..flight.settings import FlightFile
from ..flight.training import flight_logs, is_training_data
from ..logs.ingest import ingest
from ..logs.readers import ReadOptions
from ..propagation.field.sum import mean_pair_power, rss_dbm
from ..site.site import Site
from ..site.siteyaml import why_far
from .calibrate import observe
from .options import AGAINST_DISTANCE_M, RANKS

QUANTITIES = ("level_dbm", "level_db", "path_loss_db")
_PLACE = ("east_m", "north_m", "height_m")
_GEOGRAPHIC = ("latitude_deg", "longitude_deg", "height_m")
_LEVELS = ("level", "q05_db", "q95_db", "locked_db", "lost_db")
_NUMBERS = ("sd_db", "q05_db", "q95_db", "rank", "yaw_deg", "time_s", *RANKS, *referee.LOCK)
_COLUMNS = ("time", "time_utc", "tower", "channel", *_PLACE, *_GEOGRAPHIC[:2], *QUANTITIES, *_NUMBERS)

_EXPECTED = (
    "time_utc, or east_m, north_m, height_m, or latitude_deg, longitude_deg, height_m; tower; level_dbm, level_db or "
    "path_loss_db (docs/referee.md has an example)"
)

# A file of more bytes, or with more rows (towers times positions), is refused: a row needs 200 bytes of memory.
_MOST_BYTES, _MOST_ROWS = 4 * LARGEST_TABLE, 5_000_000

# A prediction is refused if all its positions are farther than this from the site's origin [m].
_FAR_M = 50_000.0

# A larger level or loss [dB] is a fill value: no radio link loses 400 dB.
_MOST_DB = 400.0

# Positions that are all closer than this to the height of the take-off ground are not a flight [m].
_ON_GROUND_M = 3.0

# A table, and fields of its :class:`ForeignPrediction`.
Read = tuple[pd.DataFrame, dict[str, Any]]

# Scores of channels (see :func:`_series`) or of models.
Entries = Sequence[Mapping[str, Any]]

# A sample is scored by the nearest predicted time within this [s], or within half of the time step of the prediction.
_NEAR_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeignPrediction:
    """A prediction that was read.

    Parameters
    ----------
    path : Path
        The file or folder.
    quantity : str
        One of :data:`QUANTITIES`, as in the file. Empty if only ranks are predicted.
    table : DataFrame
        One row per prediction.

        - ``time``: datetime64[ns], NaT if unknown.
        - ``east_m north_m height_m``: position in the site frame, NaN if unknown.
        - ``tower``, and ``channel`` (empty: every channel of the tower).
        - ``level`` [dB or dBm]. A path loss is its negative, and so are the columns of its distribution.
        - ``sd_db q05_db q95_db rank yaw_deg time_s p_rank1..4``, and the parts ``p_lock locked_db lost_db locked_sd_db
          lost_sd_db`` of a receiver that can lose its lock. NaN if the file does not have them.
    sha256 : str
        Digest of the file. Empty for a folder of logs.
    remarks : tuple of str
        Sentences on how the file was read.
    unit : str
        Unit of ``level_db``. Empty if the levels have the unit of the log.
    near_m : float
        Largest distance between a sample and its predicted position.
    """

    path: Path
    quantity: str
    table: pd.DataFrame
    sha256: str = ""
    remarks: tuple[str, ...] = ()
    unit: str = ""
    near_m: float = AGAINST_DISTANCE_M

    @property
    def timed(self) -> bool:
        """True if the rows are matched by time, false if by position."""
        return bool(self.table["time"].notna().any())


def read_foreign(path: Path, data: FlightData, near_m: float = AGAINST_DISTANCE_M) -> ForeignPrediction:
    """Read the prediction in a file or folder.

    Parameters
    ----------
    path : Path
        CSV, NetCDF, .npz, the output folder of ``predict``, or a folder with the logs of an emulated flight.
    data : FlightData
        The flight that is scored: its site, time zone, towers and logs.
    near_m : float
        Largest distance between a sample and its predicted position.

    Returns
    -------
    ForeignPrediction

    Raises
    ------
    InputError
        If the file is damaged, or has no position, no tower, or no level with its unit.
    UsageError
        If ``predict`` learned the prediction from the logs of the flight.
    """
    tables = (path / name for name in ("prediction.csv", "prediction.nc"))
    file = next((table for table in tables if table.is_file()), path)
    with about_file(path):
        if file.is_dir():
            digest, (frame, about) = "", _emulated(path, data)
        else:
            content = read_input(file, _MOST_BYTES, "a prediction: CSV, NetCDF, .npz, or a folder")
            if content.startswith(b"CDF"):
                raise InputError("a NetCDF file of version 3", expected="NetCDF 4 ('nccopy -k nc4 IN OUT')")
            read = next((reader for start, reader in _READERS.items() if content.startswith(start)), _csv)
            digest, (frame, about) = file_digest(file), read(content, file)
        if file.name.startswith("prediction.") and (file.parent / "metrics.json").is_file():
            about["unit"] = _predicted_unit(file.parent / "metrics.json", data)
        quantity, table = _checked(frame, data)
    return ForeignPrediction(path=path, quantity=quantity, table=table, sha256=digest, near_m=near_m, **about)


def possible(score: Callable[[Any], Any], predictions: Iterable[Any]) -> tuple[list[Any], list[str]]:
    """Return the results of the predictions that can be scored, and a message for each other prediction.

    If none can be scored, the first error is raised.
    """
    results, errors = list[Any](), list[AerpawCmpError]()
    for prediction in predictions:
        try:
            results.append(score(prediction))
        except AerpawCmpError as error:
            errors.append(error)
    if errors and not results:
        raise errors[0]
    return results, [f"{error}. This prediction was not scored." for error in errors]


def _predicted_unit(path: Path, data: FlightData) -> str:
    """Return the unit of the levels of ``predict`` from its metrics.json, or an empty text for several units.

    Raises
    ------
    UsageError
        If the prediction was learned from logs of the flight, or from changed copies of them.
    """
    with parsing(path, "metrics.json of 'aerpaw-cmp predict'", any_shape=True):
        about = json.loads(read_bounded(path, LARGEST_TABLE))
        learned, marks = list(about[KEY]), list(map(str, about[MARKS]))
        units = {str(series["unit"]) for series in about["series"].values()}
    if is_training_data(data, learned, marks):
        expected = "a prediction made before the flight, or from other flights"
        raise UsageError("the prediction learned from this flight's own logs", expected=expected, path=path.parent)
    return units.pop() if len(units) == 1 else ""


# --- formats -------------------------------------------------------------------------------------------------------
# Each function returns a table with the column names of the file, and the fields ``remarks`` or ``unit`` of the
# prediction, if they differ from their defaults.


def _csv(content: bytes, path: Path) -> Read:
    with parsing(path, "a CSV with a header: " + _EXPECTED, cause="another format"):
        frame = pd.read_csv(
            io.BytesIO(content), comment="#", skipinitialspace=True, low_memory=False, nrows=_MOST_ROWS + 1
        )
    _check_rows(len(frame))
    frame.columns = [str(name).strip().lower() for name in frame.columns]
    return frame, {}


def _check_rows(rows: int) -> None:
    """Refuse a prediction with more than :data:`_MOST_ROWS` rows, before a table is created."""
    if rows > _MOST_ROWS:
        expected = "fewer positions or times; positions far from the route are not needed"
        raise InputError(f"the prediction has more than {_MOST_ROWS} rows", expected=expected)


def _netcdf(content: bytes, path: Path) -> Read:
    """Read variables along the dimensions of the level, one row per element."""
    with parsing(path, "a NetCDF file"):
        values, notes = read_native("netcdf", content)
    about: dict[str, Any] = {}
    # dimensions and values of each variable by its name
    known = {name.lower(): (notes["dims"][name][: array.ndim], array) for name, array in values.items()}
    if "up_m" in known:
        known.setdefault("height_m", known["up_m"])
    if "h_real" in known:
        # ignore level_db of channel.nc: its unit may differ between towers, and it may have been learned from this
        # flight
        known.pop("level_db", None)
        power_dbm = float(notes["attributes"].get("transmit_power_dbm", 0.0))
        (dims, real), (_, imaginary) = known["h_real"], known["h_imag"]
        known["level_dbm"] = dims[:-2], rss_dbm(mean_pair_power(real + 1j * imaginary), power_dbm)
        about = {"remarks": (f"The levels of {path.name} are those of H, with {power_dbm:g} dBm transmitted.",)}
    main = next((name for name in (*QUANTITIES, "rank", RANKS[0]) if name in known), None)
    if main is None:
        return pd.DataFrame(columns=list(known)), {}
    dims, array = known[main]
    _check_rows(array.size)
    at = dict(zip(dims, np.indices(array.shape).reshape(len(dims), -1), strict=True))
    columns = {
        name: array[tuple(at[dim] for dim in dims)]
        for name, (dims, array) in known.items()
        if name in _COLUMNS and set(dims) <= set(at)
    }
    clock = "time_utc" if "time_utc" in columns else "time"
    if clock in columns and columns[clock].dtype.kind in "fiu":
        columns["time_s"] = columns.pop(clock)
        units = {name.lower(): unit for name, unit in notes["units"].items()}
        size, since, start = str(units.get(clock, "")).partition(" since ")
        if since:
            with parsing(path, "a time unit such as 'seconds since 2025-06-10T14:00:00Z'"):
                after = pd.to_timedelta(columns["time_s"], unit=size.strip().lower())  # type: ignore[call-overload]
                columns["time"] = np.asarray(pd.to_datetime(start, utc=True) + after)
    return pd.DataFrame(columns), about


def _radio_map(content: bytes, path: Path) -> Read:
    """Read a radio map of Sionna RT, saved with ``np.savez(path_gain=..., cell_centers=..., tx_names=...)``."""
    needed = ("path_gain", "cell_centers", "tx_names")
    with parsing(path, f"an .npz with {', '.join(needed)}"), np.load(io.BytesIO(content)) as book:
        if missing := set(needed) - set(book.files):
            cause = "an Excel workbook; save the sheet as CSV" if "xl/workbook.xml" in book.files else None
            raise InputError(f"no array {', '.join(sorted(missing))}", expected=", ".join(needed), cause=cause)
        if sum(info.file_size for info in book.zip.infolist()) > _MOST_BYTES:
            raise InputError("the arrays are too large", expected=f"at most {_MOST_BYTES >> 20} MiB")
        gain, centre, names = (np.asarray(book[name]) for name in needed)
    if gain.ndim != 3 or centre.shape != (*gain.shape[1:], 3) or names.shape != gain.shape[:1]:
        raise InputError(
            f"shapes {gain.shape}, {centre.shape}, {names.shape}",
            expected="path_gain (towers, rows, columns), cell_centers (rows, columns, 3), tx_names (towers,)",
        )
    if (gain < 0.0).any():
        raise InputError("a path_gain below 0", expected="a linear gain, 0 or more", cause="a gain in dB")
    _check_rows(gain.size)
    places = np.tile(centre.reshape(-1, 3), (len(names), 1)).astype(np.float64)
    towers = np.repeat(names.astype(str), gain[0].size)
    remark = "The cell centres of the radio map are taken as east, north and up of the site [m]."
    frame = pd.DataFrame(places, columns=list(_PLACE)).assign(tower=towers, path_loss_db=-db_from_power(gain.ravel()))
    return frame, {"remarks": (remark,)}


def _emulated(folder: Path, data: FlightData) -> Read:
    """Read levels and positions from the logs of an emulated flight, which are matched by position."""
    own = folder / "flight.yaml"
    twin = load_data(load_with_learned(own) if own.is_file() else _drafted(folder, data), folder)
    if set(flight_logs(twin)) & set(flight_logs(data)):
        raise InputError("logs of the scored flight itself", expected="logs of an emulated flight")
    every = pd.concat(
        pd.DataFrame(o.samples.position_m, columns=list(_PLACE)).assign(
            tower=o.samples.tower, channel=o.samples.channel, level_db=o.samples.residual_db + o.free_space_db
        )
        for o in observe([twin])[0]
    )
    # a hover has many levels at one position, so use their mean as the prediction of the emulator
    frame = every.groupby(["tower", "channel", *_PLACE], as_index=False, sort=False).mean()
    return frame, {"unit": ", ".join(sorted({s.unit for s in twin.rss}))}


def _drafted(folder: Path, data: FlightData) -> FlightFile:
    """Return the flight file that a draft of the folder proposes for the site of the scored flight."""
    site = str(data.site_place) if not Path(data.site_place).is_file() else str(Path(data.site_place).resolve())
    timezone = data.settings.timezone
    files = ingest([folder], options=ReadOptions(timezone=timezone))
    return parse_yaml(drafts(files, folder, DraftOptions(timezone=timezone, site=site))[0].text, FlightFile)


# Reader by the first bytes of a file. Files with other bytes are read as CSV.
_READERS = {b"\x89HDF\r\n\x1a\n": _netcdf, b"PK\x03\x04": _radio_map}


# --- checks --------------------------------------------------------------------------------------------------------


def _checked(frame: pd.DataFrame, data: FlightData) -> tuple[str, pd.DataFrame]:
    """Return the quantity, and the table with the column names of :class:`ForeignPrediction`."""
    names = [str(name) for name in frame]
    columns, quantities = f"(columns: {', '.join(names)})", [name for name in QUANTITIES if name in names]
    if len(set(names)) < len(names) or len(quantities) > 1:
        raise InputError(f"several columns of one quantity {columns}", expected="one of them")
    if not quantities and not {"rank", *RANKS} & set(names):
        near = [name for name in names if name.split("_")[0] in ("level", "rss", "rsrp", "rssi", "power", "path")]
        cause = f"{near[0]!r} has another unit, or no unit in its name" if near else None
        raise InputError(
            f"no column of a level with its unit {columns}",
            expected="level_dbm, level_db (the unit of the log) or path_loss_db",
            cause="a separator that is not a comma" if len(names) == 1 else cause,
        )
    if "tower" not in names:
        raise InputError(f"no column tower {columns}", expected=_EXPECTED)
    quantity = quantities[0] if quantities else ""
    given = frame.reindex(columns=list(_COLUMNS))
    table: pd.DataFrame = given[list(_NUMBERS)].apply(_numbers)
    # a rank whose column is missing, such as rank 3 of a pair of antennas, has the probability 0
    ranked = table[list(RANKS)].notna().any(axis=1)
    table.loc[ranked, list(RANKS)] = table.loc[ranked, list(RANKS)].fillna(0.0)
    for name in ("tower", "channel"):
        table[name] = given[name].astype("string").fillna("").str.strip().astype(object)
    table["level"] = _numbers(given[quantity]) if quantity else np.nan
    if not table[["level", "rank", *RANKS]].notna().any(axis=None):
        cells = [cell for name in (*QUANTITIES, "rank", *RANKS) if name in names for cell in frame[name].dropna()]
        first = f", but {cells[0]}" if cells else ": all cells are empty"
        raise InputError(f"no level or rank{first}", expected="numbers with a decimal point")
    table["time"] = _times(given)
    table[list(_PLACE)] = _places(given, data.site)
    if table["time"].isna().all() and table["east_m"].isna().all():
        found, cause = f"rows without a time and without a position {columns}", "other names of columns, or no values"
        raise InputError(found, expected=_EXPECTED, cause=cause)
    _check_numbers(table, quantity)
    if quantity == "path_loss_db":
        # a large loss is a low level, so swap the ends of the band
        table = table.rename(columns={"q05_db": "q95_db", "q95_db": "q05_db"})
        table[list(_LEVELS)] *= -1.0
    _check_repeats(table)
    _check_names(table, data)
    return quantity, table


def _numbers(column: Any) -> Any:
    """Return numbers (n,). NaN for texts, and for the infinite levels that programs write for no signal."""
    return pd.to_numeric(column, errors="coerce").astype(np.float64).replace([-np.inf, np.inf], np.nan)


def _times(given: pd.DataFrame) -> Any:
    """Return times (n,) as naive UTC datetime64[ns]. NaT if there is no column of times."""
    name = "time_utc" if given["time_utc"].notna().any() else "time"
    column = given[name].dropna()
    text, numeric = column.astype(str), pd.api.types.is_numeric_dtype(column)
    stamps = pd.to_datetime(text, utc=True, errors="coerce", format="ISO8601")
    stamps = stamps.where(stamps.dt.year.between(1700, 2200))  # datetime64[ns] cannot store other years
    zoned = text.str.contains(r"Z$|[+-]\d\d:?\d\d$") | (name == "time_utc")
    for wrong, found, expected in (
        (text[stamps.isna() | numeric], "that cannot be read", "ISO 8601 in UTC, such as 2025-06-10T14:00:00Z"),
        (text[~zoned], "without a zone", "a column time_utc, or times that end in Z"),
    ):
        if len(wrong):
            raise InputError(f"{counted(len(wrong), 'time')} {found}, such as {wrong.iloc[0]}", expected=expected)
    return stamps.dt.tz_localize(None).astype("datetime64[ns]").reindex(given.index)


def _places(given: pd.DataFrame, site: Site) -> AnyArray:
    """Return east, north, up (n, 3) in the site frame [m]. NaN if there are no columns of positions."""
    place, geographic = (given[list(names)].apply(_numbers).to_numpy().T for names in (_PLACE, _GEOGRAPHIC))
    latitude, longitude, height = geographic
    cause = "map coordinates (UTM) instead of metres from the origin"
    if np.isfinite(latitude).any():
        place = np.stack([*site.frame.to_local(latitude, longitude), height + site.takeoff_ground_m])
        cause = why_far(latitude[0], longitude[0], site.frame)
    away_m = float(np.nanmin(np.hypot(place[0], place[1]), initial=np.inf))
    if _FAR_M < away_m < np.inf:
        found = f"the nearest position is {away_m / 1000:.0f} km from the site's origin"
        raise InputError(found, expected=f"positions within {_FAR_M / 1000:.0f} km", cause=cause)
    return np.asarray(np.where(np.isfinite(place).all(axis=0), place, np.nan).T)


def _check_numbers(table: pd.DataFrame, quantity: str) -> None:
    """Refuse numbers that cannot have the meaning of their column."""
    level, shares = table["level"].dropna(), table[list(RANKS)].dropna()
    middle = level.median()
    median = f"a median {quantity} of {middle:.3g}"
    linear = len(level) > 0 and level.min() > 0.0 and level.max() < 1.0
    loss = "a loss above 0 dB" if quantity == "path_loss_db" else f"received levels as {quantity}"
    for wrong, found, expected, cause in (
        (level.abs().max() > _MOST_DB, f"a level of {level.min():g} to {level.max():g} dB",
         "an empty cell where nothing is received", "a fill value for no signal"),
        (linear, median, loss, "a linear gain or power in watts or milliwatts; 10 log10(gain), or 10 log10(P / 1 mW), "
         "is in decibels"),
        (quantity == "level_dbm" and middle > 30.0, median, loss, "a path loss (path_loss_db), or a missing sign"),
        (quantity == "path_loss_db" and middle < 0.0, median, loss, "a path gain; its negative is the loss"),
        ((table["sd_db"] <= 0.0).any(), "sd_db of 0 or less", "standard deviations above 0 dB", None),
        (table["sd_db"].notna().any() and (table["sd_db"].isna() & table["level"].notna()).any(),
         "levels with and without sd_db", "sd_db in each row that has a level, or in none", None),
        ((table["q05_db"] > table["q95_db"]).any(), "q05_db above q95_db", "the lower end in q05_db", "swapped names"),
        (not table["rank"].dropna().isin(range(MAX_RANK + 1)).all(), "ranks that are not 0 to 4",
         "1 to 4, or 0 without a channel", None),
        ((shares < 0.0).any(axis=None) or (abs(shares.sum(axis=1) - 1.0) > 0.01).any(),
         "p_rank1 to p_rank4 below 0, or with another sum than 1", "probabilities", "percent, or counts of samples"),
    ):  # fmt: skip
        if wrong:
            raise InputError(found, expected=expected, cause=cause)


def _check_repeats(table: pd.DataFrame) -> None:
    """Refuse rows of one tower, channel and time (else position and heading) with different levels.

    A route can pass a position several times: ``time_s`` after an unknown start distinguishes the passes.
    """
    key = ["tower", "channel", *(["time"] if table["time"].notna().any() else [*_PLACE, "yaw_deg", "time_s"])]
    distinct = table.dropna(subset="level").drop_duplicates([*key, "level"])
    twice = distinct[distinct.duplicated(key, keep=False)]
    if len(twice):
        first = twice[key].iloc[0].drop("channel").dropna()
        at = ", ".join(f"{name} {f'{v:.2f}' if isinstance(v, float) else v}" for name, v in first.items())
        raise InputError(
            f"{counted(len(twice), 'row')} with several levels at one {'time' if 'time' in key else 'position'}: {at}",
            expected="one row per tower, channel and time or position",
            cause="channels, heights or headings without a column that distinguishes them, or random fading",
        )


def _check_names(table: pd.DataFrame, data: FlightData) -> None:
    """Refuse a prediction without any tower of the flight, and use levels of an unknown channel for all channels.

    A program that predicts one channel per tower may have another name for it.
    """
    ours, theirs = {s.tower for _, s in data.series}, sorted(set(table["tower"]))
    if ours.isdisjoint(theirs):
        found = f"towers {', '.join(theirs[:8]) or 'without names'}"
        cause = "other names for the same towers; rename them in the file"
        raise InputError(found, expected=f"towers of the flight: {', '.join(sorted(ours))}", cause=cause)
    named = table.loc[table["level"].notna(), ["tower", "channel"]].drop_duplicates()
    if named["tower"].is_unique and not named["channel"].isin([s.channel for s in data.rss]).any():
        table.loc[table["channel"].isin(named["channel"]), "channel"] = ""


# --- scores --------------------------------------------------------------------------------------------------------


def judge(given: ForeignPrediction, data: FlightData, result: FlightResult) -> dict[str, Any]:
    """Score a prediction on a flight.

    Parameters
    ----------
    given : ForeignPrediction
    data : FlightData
    result : FlightResult
        Levels and ranks by ray tracing, and baselines, at the same samples.

    Returns
    -------
    dict
        The entry of ``referee`` in metrics.json and of card.json.

    Raises
    ------
    InputError
        If no prediction is near a sample.
    """
    series = {item.name: entry for item in result.rss if (entry := _series(given, item, data))}
    ranks = {item.tower: r for item in result.rank if (r := _ranks(given, item, data))}
    if not series and not ranks:
        raise InputError(
            f"fewer than {FEWEST} samples of the flight have a prediction nearby",
            expected=f"positions within {given.near_m:g} m, or times within the step of the prediction",
            cause=_why_none(given, data, result),
            path=given.path,
        )
    name, predicted, every = given.path.name, set(given.table["tower"]), list(series.values())
    # compare only models with all channels: means over different channels are not comparable
    models: Mapping[str, Any] = max((entry["cards"] for entry in every), key=len, default={})
    common = {link: entry for link, entry in series.items() if entry["cards"].keys() >= models.keys()}
    means = [_means(model, [entry["cards"][model] for entry in common.values()]) for model in models]
    remarks = [*given.remarks]
    if relative := sorted({entry["unit"] for entry in every if entry["cards"][name]["bias_db"] is None}):
        units = f"{name}: {given.unit or given.quantity}; log: {', '.join(relative)}"
        remarks.append(f"No bias is stated, because levels and log have no common reference ({units}).")
    if unknown := sorted(predicted - {s.tower for _, s in data.series}):
        remarks.append(f"{name}: the flight has no log of {', '.join(unknown)}; not scored.")
    if sum(s["unmatched"] - s["matched"] for s in every) > 0 and (cause := _wrong_heights(given, data, result)):
        remarks.append(f"{name}: most samples have no prediction. Likely cause: {cause}.")
    if series and (few := [item.name for item in result.rss if item.tower in predicted and item.name not in series]):
        remarks.append(f"{name}: fewer than {FEWEST} samples of {', '.join(few)} have both levels; not scored.")
    if trained := [item.name for item in result.rss if item.training and item.name in series]:
        remarks.append(f"Ray tracing has no score on {', '.join(trained)}: its antennas were learned from this flight.")
    if len(common) < len(series):
        remarks.append(f"The means are over {', '.join(common)} only: not all models predict the other channels.")
    return json_object(
        prediction=name,
        sha256=given.sha256,
        fitted_on_this_flight=["the offset of each model and channel"],
        sentence=_sentence(given, every, list(common.values()), means) if series else f"{name}: ranks only.",
        remarks=remarks,
        means=means,
        levels={s["tower"]: {o["channel"]: o for o in every if o["tower"] == s["tower"]} for s in every},
        nodes=[
            {"series": link, "offset_db": card["offset_db"], "slope": card["slope"], "floor_db": entry["floor_db"]}
            for link, entry, card in ((link, entry, entry["cards"][name]) for link, entry in series.items())
        ],
        rank=ranks,
    )


def _means(model: str, cards: Entries) -> dict[str, Any]:
    """Return the mean scores of a model over channels. NaN if the number is missing for a channel."""
    values = np.array([[card[key] for key in referee.AVERAGED] for card in cards], dtype=np.float64)
    return {"model": model, "channels": len(cards), **dict(zip(referee.AVERAGED, values.mean(axis=0), strict=True))}


def _sentence(given: ForeignPrediction, series: Entries, common: Entries, means: Entries) -> str:
    """Return the result in words: both errors, the significance of their difference, and the number of samples."""
    mean, errors = means[0], {row["model"]: row["rmse_offset_db"] for row in means}
    text = f"{given.path.name}: RMSE {mean['rmse_offset_db']:.1f} dB after one offset per channel"
    if referee.OURS in errors:
        verdicts = Counter(entry["differences"][referee.OURS].verdict for entry in common)
        decided = [f"significantly {kind} on {verdicts[kind]}" for kind in ("better", "worse") if verdicts[kind]]
        verdict = f"It is {' and '.join(decided)}" if decided else "The difference is not significant on any channel"
        text += f", ray tracing {errors[referee.OURS]:.1f} dB on the same samples"
        text += f" ({counted(len(common), 'channel')}). {verdict} (95 %)."
    else:
        text += ". Ray tracing has no score there."
    if np.isfinite(mean["rmse_db"]):
        inside = f"; the 90 % band contains {100 * mean['coverage_90']:.0f} % of the samples"
        text += f" As predicted, without an offset: RMSE {mean['rmse_db']:.1f} dB"
        text += f"{inside if np.isfinite(mean['coverage_90']) else ''}."
    matched, lost = (sum(entry[key] for entry in series) for key in ("matched", "unmatched"))
    if not lost:
        return f"{text} All {counted(matched, 'sample')} have a prediction."
    where = "other times" if given.timed else f"positions more than {given.near_m:g} m from it (--against-distance)"
    return f"{text} {counted(matched, 'sample')} have a prediction; {counted(lost, 'sample')} at {where} have none."


def _series(given: ForeignPrediction, item: RssResult, data: FlightData) -> dict[str, Any] | None:
    """Return the scores of one tower and channel. None if too few samples have a prediction.

    ``matched`` and ``unmatched`` count the samples with and without a prediction nearby. ``floor_db`` is the detection
    floor that is visible in the predicted levels, for example of an emulated receiver. ``cards`` (of all models with
    enough levels, on the same samples; the prediction first, then ray tracing and the baselines) and ``differences``
    (RMSE of the prediction minus that of the model, each after one offset) are by model.
    """
    part = split_by_series(given.table, item.tower, item.channel)
    if given.quantity == "path_loss_db":
        link = next(s.link for s in data.rss if (s.tower, s.channel) == (item.tower, item.channel))
        part = part.assign(**{key: link.transmit_power_dbm + part[key] for key in _LEVELS})
    heading_deg = item.geometry.get("heading_deg")
    predicted, near = predicted_at(given, part, item.time, item.position_m, heading_deg)
    near &= item.posed
    level, heard = predicted["level"], np.isfinite(item.measured_db)
    scored = near & heard & np.isfinite(level)
    if scored.sum() < FEWEST:
        return None
    same = near & (np.isfinite(level) | ~heard)
    name = given.path.name
    absolute = given.unit in ("", item.unit) if given.quantity == "level_db" else item.unit == "dBm"
    # for each model: its columns, whether its levels have the reference of the log, and the samples that it covers
    models = {name: (predicted, absolute, near)}
    if not item.training:  # otherwise its antennas were learned from these samples
        models[referee.OURS] = {"level": item.simulated_dbm}, item.unit == "dBm", same
    models |= {BASELINE_TITLE[key]: ({"level": of.level_dbm}, False, same) for key, of in item.baselines.items()}
    seconds = (item.time - item.time[0]) / np.timedelta64(1, "s")
    thresholds = referee.measured_thresholds(item.measured_db[near], ratio=item.unit == "dB")
    cards = {
        key: referee.level_card(seconds, item.measured_db, columns, on, thresholds, absolute=same_reference)
        for key, (columns, same_reference, on) in models.items()
        if (np.isfinite(columns["level"]) & heard & on).sum() >= FEWEST
    }
    errors = {key: np.where(scored, item.measured_db - models[key][0]["level"], np.nan) for key in cards}
    theirs = errors.pop(name)
    return {
        "tower": item.tower, "channel": item.channel, "unit": item.unit,
        "matched": int(near.sum()), "unmatched": int((item.posed & ~near).sum()),
        "floor_db": detection_floor_db(part["level"].to_numpy(np.float64), within_db=0.05),
        "cards": cards,
        "differences": {key: paired_difference(theirs, of, place_m=item.position_m) for key, of in errors.items()},
    }  # fmt: skip


def split_by_series(table: pd.DataFrame, tower: str, channel: str) -> pd.DataFrame:
    """Return the rows of a tower that apply to one of its channels."""
    part: pd.DataFrame = table[(table["tower"] == tower) & table["channel"].isin(["", channel])]
    own: pd.DataFrame = part[part["channel"] == channel]
    return part if own.empty else own


def predicted_at(
    given: ForeignPrediction, part: pd.DataFrame, time: Any, position_m: FloatArray, heading_deg: Any
) -> tuple[dict[str, FloatArray], BoolArray]:
    """Return the numbers that are predicted for samples.

    Parameters
    ----------
    given : ForeignPrediction
    part : DataFrame
        Rows of the prediction for the tower and channel of the samples.
    time : (n,) datetime64[ns]
    position_m : (n, 3)
    heading_deg : (n,), optional
        Headings of the UAV.

    Returns
    -------
    numbers : dict of str to (n,)
        Values by column of the prediction. NaN if no prediction is near.
    near : (n,) bool
        True if a prediction is near.
    """
    part, names = part[(part["time"] if given.timed else part["east_m"]).notna()], ("level", *_NUMBERS)
    if part.empty:
        return {name: np.full(len(time), np.nan) for name in names}, np.zeros(len(time), dtype=np.bool_)
    if given.timed:
        known = part["time"].to_numpy("datetime64[ns]")
        index, apart = nearest_in_time(time, known)
        steps_s = np.diff(np.unique(known)) / np.timedelta64(1, "s")
        most_s = max(_NEAR_S, 0.51 * float(np.median(steps_s)) if len(steps_s) else 0.0)
        near = np.asarray(apart / np.timedelta64(1, "s") <= most_s)
    else:
        nose_deg = None if heading_deg is None else (heading_deg, part["yaw_deg"].to_numpy(np.float64))
        index, near = nearest_points(position_m, part[list(_PLACE)].to_numpy(np.float64), given.near_m, nose_deg)
    return {name: np.where(near, part[name].to_numpy(np.float64)[index], np.nan) for name in names}, near


def _ranks(given: ForeignPrediction, item: RankResult, data: FlightData) -> dict[str, Any] | None:
    """Return kappa, total variation and agreement of predicted ranks and of ray tracing, on the same samples.

    If the prediction has probabilities, ``log_score`` and ``constant_log_score`` are also returned.
    """
    ranked = given.table[["rank", *RANKS]].notna().any(axis=1)
    part = given.table[(given.table["tower"] == item.tower) & ranked]
    heading_deg = data.poses_at(item.time).heading_deg if data.track is not None else None
    predicted, near = predicted_at(given, part, item.time, item.position_m, heading_deg)
    p = np.column_stack([predicted[name] for name in RANKS])
    stated, rank = np.isfinite(p).all(axis=1), predicted["rank"]
    rank = np.where(np.isnan(rank) & stated, np.nan_to_num(p).argmax(axis=1) + 1.0, rank)
    scored = near & np.isfinite(rank) & np.isfinite(item.measured) & (item.measured > 0)
    if scored.sum() < FEWEST:
        return None
    best = max(item.rank, key=lambda k: item.score.simulated[k].agreement)
    measured = item.measured[scored]
    named = {given.path.name: rank, f"ray tracing, K = {best:g}": item.rank[best]}
    scores = {name: compare_ranks(measured, ranks[scored]) for name, ranks in named.items()}
    constant = p[stated].sum(axis=0) / max(stated.sum(), 1)
    forecast = score_forecast(measured, p[scored], rank[scored], constant)
    entry = {"tower": item.tower, "matched": len(measured), "unmatched": int((~near).sum()), "scores": scores}
    return entry | {key: getattr(forecast, key) for key in ("log_score", "constant_log_score")}


def _why_none(given: ForeignPrediction, data: FlightData, result: FlightResult) -> str:
    """Return the likely cause if no sample is near a prediction: channels, time zone, day, ground, datum or route."""
    ours, theirs = ({s.channel for s in result.rss}, set(given.table["channel"]) - {""})
    if theirs and ours.isdisjoint(theirs):
        return f"other names for the channels: {', '.join(sorted(theirs))}; the flight has {', '.join(sorted(ours))}"
    if given.timed:
        return _other_time(given, result)
    above_m = given.table["height_m"].max() - data.site.takeoff_ground_m
    if above_m < _ON_GROUND_M:
        highest = f"at most {above_m:.1f} m above the take-off ground"
        return f"no predicted position is in the air ({highest}), so an emulated vehicle did not fly"
    other = "a prediction of another route; --against-distance allows larger distances"
    return _wrong_heights(given, data, result) or other


def _wrong_heights(given: ForeignPrediction, data: FlightData, result: FlightResult) -> str | None:
    """Return the likely error of the predicted heights, if its correction brings predictions near the samples."""
    if given.timed:
        return None
    flown = np.vstack([s.position_m[np.isfinite(s.position_m).all(axis=1)] for s in result.series])
    points, flat = given.table[list(_PLACE)].dropna().to_numpy(), np.array([1.0, 1.0, 0.0])
    index, near = nearest_points(flown * flat, points * flat, given.near_m)
    apart_m = float(np.median((points[index] - flown)[near, 2])) if near.any() else 0.0
    datum = (
        f"another height datum: the predicted positions are {abs(apart_m):.0f} m "
        f"{'above' if apart_m > 0 else 'below'} the flight, whose heights count from the ground at the origin (up) or "
        "from take-off (with latitude and longitude)"
    )
    ground = data.site.takeoff_ground_m * (1.0 - flat)
    corrected = {datum: points - apart_m * (1.0 - flat), "heights in feet": ground + (points - ground) * [1, 1, FOOT_M]}
    shares = {cause: nearest_points(flown, at, given.near_m)[1].mean() for cause, at in corrected.items()}
    cause = max(corrected, key=shares.__getitem__)
    more = shares[cause] - nearest_points(flown, points, given.near_m)[1].mean()
    # a map may cover only a part of the route, but routes that only cross are no evidence of wrong heights
    return cause if more > max(0.5 * near.mean(), 0.1) else None


def _other_time(given: ForeignPrediction, result: FlightResult) -> str:
    """Return the likely cause if no sample is near a predicted time."""
    flown = np.concatenate([item.time for item in result.series])
    theirs = given.table["time"].dropna().to_numpy("datetime64[ns]")
    (begin, end), (first, last) = (np.array([t.min(), t.max()], "datetime64[s]") for t in (theirs, flown))
    trap = clock_trap((begin, end), (first, last))
    cause = "another flight, or too few times" if trap is None else f"another time zone, {-trap.hours:+g} h"
    return f"{cause}: predicted {begin} to {end}, flown {first} to {last} (UTC)"

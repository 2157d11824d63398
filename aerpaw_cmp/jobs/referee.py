"""Predictions of other programs, scored on one flight together with ours and the baselines.

``report flight.yaml --against FILE``. A prediction of any program is read as one table: CSV, NetCDF, a radio map in
.npz, or the logs of an emulated flight. Samples are matched to predictions by time where the file has times, else by
position. Every model is scored on the samples that the file predicts, so that the cards can be compared.
docs/referee.md lists the columns and has examples.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ..common.errors import InputError, parsing
from ..common.files import LARGEST_TABLE, read_input
from ..common.jsonable import json_safe
from ..common.native import read as read_native
from ..common.outputs import file_digest
from ..common.text import counted
from ..common.units import AnyArray, BoolArray, FloatArray, IntArray
from ..compare.level import nearest_in_time
from ..compare.rank import agreement, cohen_kappa, histogram, total_variation
from ..compare.receiver import score_forecast
from ..compare.referee import (
    LevelCard,
    PredictedLevel,
    detection_floor_db,
    level_card,
    measured_thresholds,
    nearest_points,
)
from ..compare.result import BASELINE_TITLE, FlightResult, RankResult, RssResult
from ..compare.statistics import PairedDifference, paired_difference
from ..flight.data import FlightData, load_data
from ..flight.drafting.draft import DraftOptions, drafts
from ..flight.settings import FlightFile
from ..flight.training import flight_logs
from ..logs.ingest import ingest
from ..logs.readers import ReadOptions
from ..propagation.field.sum import mean_pair_power, rss_dbm
from ..site.site import Site
from .calibrate import observe
from .options import AGAINST_DISTANCE_M

QUANTITIES = ("level_dbm", "level_db", "path_loss_db")
RANKS = ("p_rank1", "p_rank2", "p_rank3", "p_rank4")
_PLACE = ("east_m", "north_m", "height_m")
_GEOGRAPHIC = ("latitude_deg", "longitude_deg", "height_m")
_OPTIONAL = ("sd_db", "q05_db", "q95_db", "rank", "yaw_deg", *RANKS)

_WANTED = (
    "time_utc, or east_m, north_m, height_m, or latitude_deg, longitude_deg, height_m; tower; level_dbm, level_db or "
    "path_loss_db (docs/referee.md has an example)"
)

# A file of more bytes, or with more rows (towers times positions), is refused: a row needs 200 bytes of memory.
_MOST_BYTES, _MOST_ROWS = 4 * LARGEST_TABLE, 5_000_000

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
        Program that wrote the file, if it is known.
    quantity : str
        One of :data:`QUANTITIES`; empty if only ranks are predicted.
    table : DataFrame
        One row per prediction: ``time`` (datetime64[ns], NaT if unknown), ``east_m north_m height_m`` in the site
        frame (NaN if unknown), ``tower``, ``channel`` (empty: every channel of the tower), ``level`` [dB or dBm], and
        those of ``sd_db q05_db q95_db rank yaw_deg p_rank1..4`` that the file has.
    remarks : tuple of str
        Sentences on how the file was read.
    unit : str
        Unit of ``level_db``; empty for the unit of the log.
    """

    path: Path
    program: str
    quantity: str
    table: pd.DataFrame
    remarks: tuple[str, ...] = ()
    unit: str = ""

    def absolute(self, unit: str) -> bool:
        """Check whether the levels need no offset to be compared with a log in a unit."""
        if self.quantity == "level_db":
            return self.unit in ("", unit)
        return (self.quantity, unit) == ("level_dbm", "dBm")

    @property
    def timed(self) -> bool:
        """True if the rows are matched by time, else by position."""
        return bool(self.table["time"].notna().any())


def read_foreign(path: Path, data: FlightData) -> ForeignPrediction:
    """Read the prediction in a file or folder.

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
        If the file is damaged, or has no position, no tower, or no level with its unit.
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
        frame = pd.read_csv(
            io.BytesIO(content), comment="#", skipinitialspace=True, low_memory=False, nrows=_MOST_ROWS + 1
        )
    _check_rows(len(frame), path)
    frame.columns = [str(name).strip().lower() for name in frame.columns]
    return frame, "CSV", []


def _check_rows(rows: int, path: Path) -> None:
    """Refuse a prediction with more than :data:`_MOST_ROWS` rows before its table is made.

    Raises
    ------
    InputError
    """
    if rows > _MOST_ROWS:
        raise InputError(
            f"the prediction has more than {_MOST_ROWS} rows",
            expected=f"at most {_MOST_ROWS} rows (towers times positions or times)",
            cause="a map of a larger area, or finer than the flight needs; leave out what lies far from its route",
            path=path,
        )


def _netcdf(content: bytes, path: Path) -> tuple[pd.DataFrame, str, list[str]]:
    """Read variables along the dimensions of the level, one row per element."""
    with parsing(path, "a NetCDF file"):
        arrays, notes = read_native("netcdf", content)
    program = str(notes["attributes"].get("source", "NetCDF"))
    dims = {name: notes["dims"][name][: values.ndim] for name, values in arrays.items()}
    arrays = {name.lower(): values for name, values in arrays.items()}
    dims = {name.lower(): names for name, names in dims.items()}
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
    _check_rows(math.prod(shape.values()), path)
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
    size, _, start = unit.partition(" since ")
    with parsing(path, "a time unit such as 'seconds since 2025-06-10T14:00:00Z'"):
        elapsed = pd.to_timedelta(np.asarray(values, dtype=np.float64), unit=size.strip().lower())  # type: ignore[call-overload]
        return np.asarray(pd.to_datetime(start, utc=True) + elapsed)


def _radio_map(content: bytes, path: Path) -> tuple[pd.DataFrame, str, list[str]]:
    """Read a radio map of Sionna RT, saved with ``np.savez(path_gain=..., cell_centers=..., tx_names=...)``."""
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
    _check_rows(gain.size, path)
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
    """Read levels and positions from the logs of an emulated flight, which are matched by position."""
    if (folder / "flight.yaml").is_file():
        from ..flight.gains import load_with_learned

        settings = load_with_learned(folder / "flight.yaml")
    else:
        settings = _drafted(folder, data)
    twin = load_data(settings, folder)
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
    units, ours = (sorted({s.unit for s in of.rss}) for of in (twin, data))
    remarks = [f"{folder.name} is an emulated flight: {counted(len(table), 'level')} with a position."]
    if units != ours:
        remarks.append(f"Its levels are in {', '.join(units)}, those of the flight in {', '.join(ours)}: no bias.")
    return ForeignPrediction(
        path=folder, program="emulated flight", quantity=quantity, table=table, remarks=tuple(remarks),
        unit=units[0] if len(units) == 1 else "several units",
    )  # fmt: skip


def _drafted(folder: Path, data: FlightData) -> FlightFile:
    """Return the flight file that a draft of the folder proposes for the site of the scored flight."""
    from ..common.yamlfile import parse_yaml

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
    """Return times (n,) as naive UTC datetime64[ns]. NaT without a column of times."""
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
    """Return east, north, up (n, 3) in the site frame [m]. NaN without columns of positions."""
    if set(_PLACE) <= set(frame):
        place = np.column_stack([_numbers(frame[name]) for name in _PLACE])
        cause = "map coordinates (UTM) instead of metres from the origin"
    elif set(_GEOGRAPHIC) <= set(frame):
        latitude, longitude, height = (np.asarray(_numbers(frame[name])) for name in _GEOGRAPHIC)
        place = np.column_stack([*site.frame.to_local(latitude, longitude), height + site.takeoff_ground_m])
        swapped = np.hypot(*site.frame.to_local(np.clip(longitude, -90.0, 90.0), latitude))
        near = np.nanmin(swapped, initial=np.inf) <= _FAR_M
        cause = "latitude and longitude are swapped" if near else "a prediction of another area"
    else:
        return np.full((len(frame), 3), np.nan)
    away_m = float(np.nanmin(np.hypot(place[:, 0], place[:, 1]), initial=np.inf))
    if _FAR_M < away_m < np.inf:
        raise InputError(
            f"the nearest position is {away_m / 1000:.0f} km from the site's origin",
            expected=f"positions within {_FAR_M / 1000:.0f} km", cause=cause, path=path,
        )  # fmt: skip
    return place


def _check_levels(level: FloatArray, quantity: str, path: Path) -> None:
    """Refuse levels that cannot have the unit of their column."""
    known = level[np.isfinite(level)]
    if not len(known) or not quantity:
        return
    middle, cause = float(np.median(known)), None
    if known.min() > 0.0 and known.max() < 1.0:
        cause = "a linear gain or power in watts or milliwatts; 10 log10(gain), or 10 log10(P / 1 mW), is in decibels"
    elif quantity == "level_dbm" and middle > 60.0:
        cause = "a path loss (path_loss_db)"
    elif quantity == "path_loss_db" and middle < 0.0:
        cause = "a path gain; its negative is the loss"
    if cause is not None:
        what = "a loss above 0 dB" if quantity == "path_loss_db" else f"received levels as {quantity}"
        raise InputError(f"a median {quantity} of {middle:.3g}", expected=what, cause=cause, path=path)


def _check_repeats(table: pd.DataFrame, path: Path) -> None:
    """Refuse two rows of one tower, channel and time (or position) with different levels."""
    place = [*_PLACE, *({"yaw_deg"} & set(table))]
    key = ["tower", "channel", *(["time"] if table["time"].notna().any() else place)]
    repeated = table.duplicated([*key, "level"], keep="first")
    distinct = table[~repeated]
    twice = distinct.duplicated(key, keep=False) & distinct["level"].notna()
    if twice.any():
        row = distinct[twice].iloc[0]
        where = row["time"] if "time" in key else tuple(round(float(row[name]), 1) for name in _PLACE)
        raise InputError(
            f"{counted(int(twice.sum()), 'row')} with several levels at one position: tower {row['tower']}, {where}",
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


# A sample is scored by the nearest predicted time within this [s], and at least half of the prediction's step.
_NEAR_S = 0.5

# Fewer matched samples get no card.
FEWEST = 20

OURS = "ray tracing (this report)"


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesVerdict:
    """The cards of one tower and channel.

    Parameters
    ----------
    tower, channel, unit : str
    matched, unmatched : int
        Samples of the flight with and without a prediction nearby.
    floor_db : float or None
        Detection floor that the predicted levels show (an emulated receiver).
    cards : mapping of str to LevelCard
        The prediction first, then ours and the baselines, on the same samples. A model with too few levels has none.
    differences : mapping of str to PairedDifference
        RMSE of the prediction minus that of ours and of each baseline, each after one offset, with its interval.
    """

    tower: str
    channel: str
    unit: str
    matched: int
    unmatched: int
    floor_db: float | None
    cards: Mapping[str, LevelCard]
    differences: Mapping[str, PairedDifference]


@dataclass(frozen=True, slots=True, kw_only=True)
class RankVerdict:
    """Predicted ranks of one tower and ours, on the same samples.

    ``scores`` has kappa, total variation and agreement by model; ``log_score`` and ``constant_log_score`` are those of
    probabilities, if the prediction has them.
    """

    tower: str
    matched: int
    unmatched: int
    scores: Mapping[str, Mapping[str, float]]
    log_score: float | None = None
    constant_log_score: float | None = None


# Numbers of a card in the tables, with their heads.
_HEADS = {
    "bias_db": "bias dB", "rmse_db": "RMSE dB", "rmse_offset_db": "RMSE after offset dB", "rmse_1s_db": "RMSE 1 s dB",
    "correlation": "correlation", "crps_db": "CRPS dB", "coverage_90": "inside 90 %",
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """One prediction against one flight."""

    name: str
    sha256: str
    program: str
    series: tuple[SeriesVerdict, ...]
    ranks: tuple[RankVerdict, ...] = ()
    remarks: tuple[str, ...] = ()

    def metrics(self) -> dict[str, Any]:
        """Return the entry of ``referee`` in metrics.json and of card.json."""
        levels: dict[str, dict[str, SeriesVerdict]] = {}
        for item in self.series:
            levels.setdefault(item.tower, {})[item.channel] = item
        heads = "prediction minus model dB", "95 % low", "95 % high"
        result: dict[str, Any] = json_safe({
            "prediction": self.name,
            "sha256": self.sha256,
            "program": self.program,
            "fitted_on_this_flight": ["the offset of each model and channel"],
            "sentence": self.sentence(),
            "remarks": self.remarks,
            "means": self.means(),
            "levels": levels,
            "rank": {item.tower: item for item in self.ranks},
            "table": {"columns": ("series", "model", "n", *_HEADS.values(), *heads), "rows": list(self._rows())},
        })  # fmt: skip
        return result

    def means(self) -> list[dict[str, Any]]:
        """Return the means over channels of each model. None for a number that is missing for a channel."""
        rows = []
        for model in dict.fromkeys(name for item in self.series for name in item.cards):
            cards = [item.cards[model] for item in self.series if model in item.cards]
            row: dict[str, Any] = {"model": model, "channels": len(cards)}
            for key in _HEADS:
                values = [getattr(card, key) for card in cards]
                row[key] = None if None in values else float(np.mean(values))
            rows.append(row)
        return rows

    def _rows(self) -> Iterator[tuple[Any, ...]]:
        """Yield one row per series and model for page and card.json."""
        for item in self.series:
            for name, card in item.cards.items():
                pair = item.differences.get(name)
                apart = (None,) * 3 if pair is None else (pair.difference_db, *pair.difference_ci95_db)
                yield f"{item.tower} {item.channel}", name, card.n, *(getattr(card, key) for key in _HEADS), *apart

    def sentence(self) -> str:
        """Return the result in two sentences: both errors, and whether the difference is significant."""
        if not self.series:
            return f"{self.name}: ranks only."
        lost = sum(s.unmatched for s in self.series)
        matched = counted(sum(s.matched for s in self.series), "sample")
        extent = f"All {matched} have a prediction."
        if lost:
            extent = f"{matched} have a prediction, {counted(lost, 'sample')} have none."
        both = [s for s in self.series if OURS in s.differences]
        if not both:
            rmse_db = np.mean([s.cards[self.name].rmse_offset_db for s in self.series])
            return (
                f"{self.name}: RMSE {rmse_db:.1f} dB after one offset per channel. Ray tracing has no level there. "
                f"{extent}"
            )
        theirs, mine = (np.mean([s.cards[name].rmse_offset_db for s in both]) for name in (self.name, OURS))
        words = {kind: sum(s.differences[OURS].verdict == kind for s in both) for kind in ("better", "worse")}
        decided = " and ".join(f"significantly {kind} on {n}" for kind, n in words.items() if n)
        return (
            f"{self.name}: RMSE {theirs:.1f} dB after one offset per channel, ray tracing {mine:.1f} dB on the same "
            f"samples ({counted(len(both), 'channel')}). It is "
            f"{decided or 'on no channel significantly different from ray tracing'} (95 %). {extent}"
        )


def judge(
    given: ForeignPrediction, data: FlightData, result: FlightResult, near_m: float = AGAINST_DISTANCE_M
) -> Verdict:
    """Score a prediction of another program on a flight.

    Parameters
    ----------
    given : ForeignPrediction
    data : FlightData
    result : FlightResult
        Ours: levels, baselines and ranks at the same samples.
    near_m : float
        Largest distance between a sample and its predicted position.

    Returns
    -------
    Verdict

    Raises
    ------
    InputError
        If none of the predictions is near a sample.
    """
    name = given.path.name
    series = [s for item in result.rss if given.quantity and (s := _series(given, item, data, near_m)) is not None]
    ranks = [r for tower in result.rank if (r := _ranks(given, tower, near_m)) is not None]
    if not series and not ranks:
        raise InputError(
            f"fewer than {FEWEST} samples of the flight have a prediction nearby",
            expected="a time within the step of the prediction" if given.timed else f"positions within {near_m:g} m",
            cause=_why_none(given, result),
            path=given.path,
        )
    remarks = list(given.remarks)
    lost = sum(s.unmatched for s in series)
    if series and lost > 0.1 * sum(s.matched + s.unmatched for s in series):
        where = "times" if given.timed else "positions"
        remarks.append(
            f"{name}: {counted(lost, 'sample')} lie outside the {where} of the prediction and are not scored."
        )
    digest = "" if given.path.is_dir() else file_digest(given.path)
    return Verdict(
        name=name, sha256=digest, program=given.program, series=tuple(series), ranks=tuple(ranks),
        remarks=tuple(remarks),
    )  # fmt: skip


def _series(given: ForeignPrediction, item: RssResult, data: FlightData, near_m: float) -> SeriesVerdict | None:
    part = split_by_series(given.table, item.tower, item.channel)
    heading_deg = item.geometry.get("heading_deg")
    predicted, near = predicted_at(given, part, item.time, item.position_m, heading_deg, near_m)
    near &= item.posed
    name, absolute = given.path.name, given.absolute(item.unit)
    level = predicted["level"]
    if given.quantity == "path_loss_db":
        link = next(s.link for s in data.rss if (s.tower, s.channel) == (item.tower, item.channel))
        level = link.transmit_power_dbm - level
    scored = near & np.isfinite(level) & np.isfinite(item.measured_db)
    if scored.sum() < FEWEST:
        return None
    models = {
        name: PredictedLevel(
            level_db=level, sd_db=predicted.get("sd_db"), low_db=predicted.get("q05_db"),
            high_db=predicted.get("q95_db"), absolute=absolute,
        ),
        OURS: PredictedLevel(level_db=item.simulated_dbm, absolute=item.unit == "dBm"),
    }  # fmt: skip
    models |= {
        BASELINE_TITLE[key]: PredictedLevel(level_db=model.level_dbm, absolute=False)
        for key, model in item.baselines.items()
    }
    seconds = (item.time - item.time[0]) / np.timedelta64(1, "s")
    thresholds = measured_thresholds(item.measured_db[near], ratio=item.unit == "dB")
    rows = near if absolute else scored
    cards, errors = {}, {}
    for key, model in models.items():
        same = rows if key == name else rows & (np.isfinite(level) | ~np.isfinite(item.measured_db))
        if (np.isfinite(model.level_db) & np.isfinite(item.measured_db) & same).sum() >= FEWEST:
            cards[key] = level_card(seconds, item.measured_db, model, thresholds, same)
            errors[key] = np.where(scored, item.measured_db - model.level_db, np.nan)
    return SeriesVerdict(
        tower=item.tower, channel=item.channel, unit=item.unit, matched=int(near.sum()),
        unmatched=int((item.posed & ~near).sum()), floor_db=detection_floor_db(part["level"].to_numpy(np.float64)),
        cards=cards,
        differences={
            key: paired_difference(errors[name], error, place_m=item.position_m)
            for key, error in errors.items() if key != name
        },
    )  # fmt: skip


def predicted_at(
    given: ForeignPrediction, part: pd.DataFrame, time: Any, position_m: FloatArray, heading_deg: Any, near_m: float
) -> tuple[dict[str, FloatArray], BoolArray]:
    """Return the numbers that are predicted for samples.

    Parameters
    ----------
    given : ForeignPrediction
    part : DataFrame
        Its rows for the tower and channel of the samples.
    time : (n,) datetime64[ns]
    position_m : (n, 3)
    heading_deg : (n,), optional
        Headings of the nose.
    near_m : float
        Largest distance between a sample and its predicted position.

    Returns
    -------
    numbers : dict of str to (n,)
        By column of the prediction. NaN if no prediction is near.
    near : (n,) bool
        True if a prediction is near.
    """
    part = part[(part["time"] if given.timed else part["east_m"]).notna()]
    if part.empty:
        near: BoolArray = np.zeros(len(time), dtype=np.bool_)
        return {"level": np.full(len(time), np.nan)}, near
    if given.timed:
        index, near = _nearest_times(time, part["time"].to_numpy("datetime64[ns]"))
    else:
        yaw_deg = part["yaw_deg"].to_numpy(np.float64) if "yaw_deg" in part else None
        points = part[list(_PLACE)].to_numpy(np.float64)
        index, near = nearest_points(position_m, heading_deg, points, yaw_deg, near_m)
    names = [name for name in ("level", *_OPTIONAL) if name in part]
    return {name: np.where(near, part[name].to_numpy(np.float64)[index], np.nan) for name in names}, near


def _nearest_times(time: Any, known: Any) -> tuple[IntArray, BoolArray]:
    """Return the nearest predicted time (n,) of each sample, and whether it is near (n,)."""
    index, apart = nearest_in_time(time, known)
    steps = np.diff(np.unique(known)) / np.timedelta64(1, "s")
    most_s = max(_NEAR_S, 0.51 * float(np.median(steps)) if len(steps) else 0.0)
    return index, np.asarray(apart / np.timedelta64(1, "s") <= most_s)


def _ranks(given: ForeignPrediction, item: RankResult, near_m: float) -> RankVerdict | None:
    part = given.table[given.table["tower"] == item.tower]
    predicted, near = predicted_at(given, part, item.time, item.position_m, None, near_m)
    p = np.column_stack([predicted[name] for name in RANKS]) if set(RANKS) <= set(predicted) else None
    if "rank" in predicted:
        rank = predicted["rank"]
    elif p is not None:
        rank = np.where(np.isfinite(p).all(axis=1), np.nan_to_num(p).argmax(axis=1) + 1.0, np.nan)
    else:
        return None
    scored = near & np.isfinite(rank) & np.isfinite(item.measured) & (item.measured > 0)
    if scored.sum() < FEWEST:
        return None
    best = max(item.rank, key=lambda k: item.score.simulated[k].agreement)
    models = {given.path.name: rank, f"ray tracing, K = {best:g}": item.rank[best].astype(np.float64)}
    measured = item.measured[scored]
    scores = {
        key: {
            "kappa": cohen_kappa(measured, ranks[scored]),
            "total_variation": total_variation(histogram(measured), histogram(ranks[scored])),
            "agreement": agreement(measured, ranks[scored]),
        }
        for key, ranks in models.items()
    }
    log_score = constant = None
    if p is not None:
        stated = scored & np.isfinite(p).all(axis=1)
        forecast = score_forecast(item.measured[stated], p[stated], rank[stated], np.nanmean(p, axis=0))
        log_score, constant = forecast.log_score, forecast.constant_log_score
    return RankVerdict(
        tower=item.tower, matched=int(scored.sum()), unmatched=int((~near).sum()), scores=scores,
        log_score=log_score, constant_log_score=constant,
    )  # fmt: skip


def _why_none(given: ForeignPrediction, result: FlightResult) -> str | None:
    """Return the likely cause if no sample is near a prediction: another time zone, day, route or height datum."""
    if not result.series:
        return None
    if not given.timed:
        flown, points = (
            place[np.isfinite(place).all(axis=1)]
            for place in (np.vstack([s.position_m for s in result.series]), given.table[list(_PLACE)].to_numpy())
        )
        index, near = nearest_points(flown * [1, 1, 0], None, points * [1, 1, 0], None, 50.0)
        apart_m = float(np.median((points[index] - flown)[near, 2])) if near.mean() > 0.5 else 0.0
        if abs(apart_m) > 10.0:
            return (
                f"another height datum: the predicted positions are {abs(apart_m):.0f} m "
                f"{'above' if apart_m > 0 else 'below'} the flight, whose heights count from the ground at the origin "
                "(up) or from take-off (with latitude and longitude)"
            )
        return "a prediction of another route; --against-distance allows larger distances"
    flown = np.concatenate([item.time for item in result.series])
    theirs = given.table["time"].dropna().to_numpy("datetime64[ns]")
    apart_h = float((np.median(theirs.astype(np.int64)) - np.median(flown.astype(np.int64))) / 3.6e12)
    spans = f"predicted {theirs.min()} to {theirs.max()}, flown {flown.min()} to {flown.max()} (UTC)"
    hours = round(apart_h * 2) / 2
    if 0.5 <= abs(hours) <= 14.0 and abs(apart_h - hours) < 0.25:
        return f"another time zone, {hours:+g} h: {spans}"
    return f"another flight: {spans}"

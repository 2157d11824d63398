"""Tables with named columns: exports of drive-test programs, phones, autopilots and DJI. All use the same dictionary.

The name of a column contains its quantity (RSRP, RSRQ, PCI, ARFCN, rank, ...), the radio access (LTE, NR) and the role
of the cell (serving, or the n-th neighbour). Levels with a PCI become one stream per cell, such as ``lte_pci110``; its
column ``serving`` is 1 while that cell serves. Other quantities become streams of kind ``kpi``. RI becomes a rank
stream (from one), and positions become the telemetry stream ``phone``.

A table of positions without a level (converted vehicleOut, ArduPilot exports, AirData) is read in the same way by
``pose_csv``, with the telemetry stream ``vehicle``. Units in brackets (``[ft]``, ``[MPH]``) are converted. Times
without a zone are local unless the name of the column contains UTC or GPS. ``aadm_snr`` is AADM's table of the SNR of
several towers, ``time,snr_lw1,snr_lw2,...``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import compress

import numpy as np
import pandas as pd

from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray
from aerpaw_cmp.logs.rows import Rows, checked_ranks, snr_stream
from aerpaw_cmp.readers import Attribute, InputError, Reader, ReadOptions, ReadResult, Stream, counted, dictionary

from . import _cells, _identity, _pose, _sheet, ardupilot_bin, nemo_csv, quectel_ri, rtklib_pos, vehicle_out

_IsHeader = Callable[[list[str]], bool]
# A tower of AERPAW in the name of a column, and its channel.
_TOWER = re.compile(r"\b(lw|cc) ?([1-5])\b(?: ?(usrp) ?(\d)\b)?")


def is_header(names: list[str]) -> bool:
    """Check whether there is a time and a level, ratio or rank among the names."""
    return len(names) > 1 and _has_time(names) and has_radio(names)


def is_track_header(names: list[str]) -> bool:
    """Check whether the names contain a position and a time, but no quantity of a radio."""
    known = _quantities(names)
    return ({*_pose.PLACE[:2]} <= known or "grid" in known) and _has_time(names) and not has_radio(names)


def has_radio(names: list[str]) -> bool:
    """Check whether there is a level, a ratio or a rank of the channel among the names."""
    return any(
        what is not None and (what.quantity.role in ("rss", "rank") or what.quantity.name in ("SINR", "RSRQ"))
        for what, *_ in dictionary.described(names)[1]
    )


def _quantities(names: list[str]) -> set[str]:
    # sniffers test every line at the beginning of a file, so use the slower ``described`` only for headers of known
    # programs
    of_program = dictionary.program([*map(dictionary.plain, names)]) is not None
    known = [what for what, *_ in dictionary.described(names)[1]] if of_program else map(dictionary.meaning, names)
    return {what.quantity.name for what in known if what is not None}


def _has_time(names: list[str]) -> bool:
    """Check whether a name means a time, a date, or GPS weeks."""
    known = _quantities(names)
    return bool(known & {"time", "date"} or {"gps_week", "gps_seconds"} <= known or _sheet.has_date_in_parts(names))


# Readers of specific tables that pass the same test. These readers know units that are not in the names.
_NARROWER = (nemo_csv, quectel_ri, ardupilot_bin, rtklib_pos, vehicle_out)


def _is_table(head: bytes, header: _IsHeader) -> bool:
    """Check whether a file begins with a header of this kind and is not of a more specific format."""
    narrower = _SNR_OF_TOWERS.match(head) or any(module.READER.sniff(head) for module in _NARROWER)
    return not narrower and _sheet.starts(head, header)


# The header of AADM's table of SNR, ``time,snr_lw1,snr_lw2``.
_SNR_OF_TOWERS = re.compile(rb"(?i)(?:\xef\xbb\xbf)?time(?:,snr_[a-z0-9]{1,12}){1,16}[ \t]*\r?\n")


@dataclass
class _Cell:
    """The columns of one cell: the serving cell or the n-th other cell of one device or SIM."""

    rat: str
    place: str
    columns: dict[str, int] = field(default_factory=dict)  # column by field of a reading
    ports: list[int] = field(default_factory=list)  # levels of single ports, in addition to the level of the cell
    marks: list[int] = field(default_factory=list)  # identities other than the PCI
    quantity: str = "RSRP"  # quantity of the level

    @property
    def serving(self) -> bool:
        return self.place.startswith(("serving", "scell", *_OWNERS))

    @property
    def measured(self) -> list[int]:
        """The columns that are not identities."""
        return [column for name, column in self.columns.items() if name not in _IDENTITY]


_IDENTITY, _PCI = ("pci", "arfcn"), next(row for row in dictionary.QUANTITIES if row.name == "PCI")
# Columns become separate series if they repeat a cell of the same row in more than this share of the rows.
_TWICE = 0.3
# Prefixes of places with a secondary carrier, which is always a separate cell.
_SECONDARY = ("scell", "secondary")
# Prefixes of devices and SIMs, whose cells are separate series.
_OWNERS = ("sim", "slot", "dev", "modem", "phone", "ue")


def _places(sheet: _sheet.Sheet) -> tuple[list[_Cell], list[int], list[int]]:
    """Return the cells of the table, the columns of other quantities, and the columns of ranks."""
    cells: dict[tuple[str, str], _Cell] = {}
    fields: dict[tuple[str, str], dict[str, list[int]]] = {}
    others, marks = [], []
    ranks: dict[bool, list[int]] = {True: [], False: []}  # means and other ranks
    for i, meaning in enumerate(sheet.meanings):
        if meaning is not None and meaning.quantity.role == "mark":
            marks.append((i, meaning))
        if meaning is None or meaning.quantity.role not in ("rss", "rank", "kpi", "cell"):
            continue
        name, role = _FIELDS.get(meaning.quantity.name), meaning.quantity.role
        if meaning.indirect or sheet.unit(i) == "%" or (name is None and role in ("rss", "kpi")):
            others.append(i)
        elif role == "rank":
            ranks[meaning.part == "mean"].append(i)
        elif name is not None:
            place = (meaning.rat, meaning.place)
            fields.setdefault(place, {}).setdefault(name, []).append(i)
    for place, columns in fields.items():
        cells[place] = cell = _Cell(*place)
        for name, listed in columns.items():
            if len(listed) > 1 and name not in _IDENTITY:
                filled = [i for i in listed if np.isfinite(sheet.numbers(i)).any()]
                listed = sorted(filled or listed[:1], key=lambda i: _preference(sheet, i))
            cell.columns[name], *second = listed
            if name == "rsrp_dbm":
                cell.ports = [i for i in second if _part(sheet, i) != "mean"]
            others += [i for i in second if i not in cell.ports and name not in _IDENTITY]  # read as KPIs
    others += ranks[True] if ranks[False] else []
    with_rsrp = {place for (_, place), cell in cells.items() if "rsrp_dbm" in cell.columns}
    for cell in cells.values():
        cell.marks = [i for i, mark in marks if mark.place == cell.place and mark.rat in ("", cell.rat)]
        apart = cell.marks or ("pci" in cell.columns and cell.place != "serving")
        if "rssi_dbm" in cell.columns and cell.place not in with_rsrp and apart:
            cell.columns["rsrp_dbm"], cell.quantity = cell.columns.pop("rssi_dbm"), "RSSI"
    if sheet.find("neighbouring") is not None and (common := cells.get(("", "serving"))) is not None:
        of_row = {name: column for name, column in common.columns.items() if name in _IDENTITY}
        for cell in cells.values():  # with one cell per row, the identity applies to all levels of the row
            cell.columns = {**of_row, **cell.columns}
    placed = _completed(cells, others)
    if len(placed) == 1:
        placed[0].place = "serving"  # a single column such as 'rsrp1' is the serving cell
    return placed, others, ranks[False] or ranks[True]


_FIELDS = {quantity: name for name, quantity in _cells.QUANTITIES.items()}


def _part(sheet: _sheet.Sheet, column: int) -> str:
    """Return the part of the level in a column, ``mean`` also for a statistic of another level, or ``raw``."""
    own = sheet.meanings[column]
    if own is None or own.part or own.quantity.role != "rss" or own.indirect:
        return own.part if own else ""
    named = {m.place for m in sheet.meanings if m and (m.quantity.name == "PCI" or m.quantity.role == "mark")}
    like = {i: m for i, m in enumerate(sheet.meanings) if m and (m.quantity, m.rat) == (own.quantity, own.rat)}
    # a raw level next to a calibrated one has an unknown offset
    if dictionary.has("raw", sheet.plain[column]) and any(dictionary.has("calibrated", sheet.plain[i]) for i in like):
        return "raw"
    free = [i for i, what in like.items() if what.place in {"serving", *({*_UNNAMED} - named)}]
    raw = [i for i in free if column in free and _cells.is_statistic_of(sheet.numbers(i), sheet.numbers(column))]
    if raw:
        text = f"its values are a statistic of {sheet.names[raw[0]]!r}, such as a mean: read as a KPI"
        sheet.notes[column] = f"column {sheet.names[column]!r}: {text}"
    return "mean" if raw else ""


def _preference(sheet: _sheet.Sheet, column: int) -> tuple[bool, bool, bool, int]:
    """Return a sort key that prefers columns that are neither means nor single ports, then plain names, many values."""
    known = sheet.numbers(column)
    count = len(np.unique(known[np.isfinite(known)]))
    part = _part(sheet, column)
    return part in ("mean", "raw"), part == "port", _MORE.sub("", sheet.plain[column]).strip() != "", -count


def _completed(cells: dict[tuple[str, str], _Cell], others: list[int]) -> list[_Cell]:
    """Return the cells with a level, and add identities without a radio access to the only cell with their role.

    Neighbours without a radio access in their names get the radio access of the table if there is only one. Levels of
    neighbours without a PCI become KPIs.
    """
    for (rat, role), cell in list(cells.items()):
        if "rsrp_dbm" in cell.columns:
            continue
        levels = {key: home for key, home in cells.items() if "rsrp_dbm" in home.columns}
        homes = [home for key, home in levels.items() if key[1] == role and (not rat or key[0] in ("", rat))]
        # the PCI may belong to a single level such as 'rsrp1' or 'RSRP[0]'
        if "pci" in cell.columns and role == "serving" and not homes:
            homes = [home for home in levels.values() if home.place[0] != "n" and (not rat or home.rat in ("", rat))]
        if {*cell.columns} == {"arfcn"} and role == "serving" and not homes:
            homes = [home for home in levels.values() if not rat or home.rat in ("", rat)]
            for home in homes:  # the carrier of a scan applies to all cells of the row
                home.columns = {**cell.columns, **home.columns}
        elif len(homes) == 1:
            (home,) = homes
            home.rat = home.rat or rat
            twice = [name for name in cell.columns if name in home.columns and name not in _IDENTITY]
            others += [cell.columns[name] for name in twice]
            home.columns, home.marks = {**cell.columns, **home.columns}, home.marks or cell.marks
            del cells[(rat, role)]
    named, several = {cell.rat for cell in cells.values()} - {""}, len(cells) > 1
    for key, cell in list(cells.items()):
        if len(named) == 1 and not cell.serving:
            cell.rat = cell.rat or next(iter(named))
        nameless = "pci" not in cell.columns and not cell.marks and cell.place != "serving" and several
        if "rsrp_dbm" not in cell.columns or nameless:
            others += cell.measured
            del cells[key]
    return list(cells.values())


def _readings(
    sheet: _sheet.Sheet, cells: list[_Cell], more: Sequence[list[str]], known: dict[str, dict[str, Attribute]]
) -> pd.DataFrame:
    technology = sheet.find("technology")
    of_row = np.array([] if technology is None else [_rat(text) for text in sheet.texts(technology)], dtype=object)
    idle, tables = _idle(sheet), []
    for cell in cells:
        level = sheet.numbers(cell.columns["rsrp_dbm"])
        values = {name: _or_nan(sheet, cell.columns.get(name), len(level)) for name in _FIELDS.values()}
        none = np.isnan(values["rsrp_dbm"]) & ~(values["pci"] > 0) if cell.rat == "nr" or not cell.serving else False
        # tables with mostly impossible numbers were refused above, so an impossible number is a single damaged cell
        pci = np.where(dictionary.impossible(_PCI, values["pci"]), np.nan, values["pci"])
        rat = of_row if technology is not None and not cell.rat else cell.rat
        about = {
            "row": np.arange(len(level)), "rat": rat, "rsrp_dbm": level, "serving": cell.serving & ~idle,
            "more": more[cell.rat == "nr"] if cell.place == "serving" else "",
            "mark": _identity.labels(sheet, cell.marks, known),
            "carrier": "" if cell.place.startswith(("serving", "n")) else cell.place.replace(" ", "_"),
            "column": "" if cell.place == "serving" and not cell.marks else cell.place.replace(" ", "_"),
        }  # fmt: skip
        # omit rows without a level, and NR cells and neighbours with neither RSRP nor PCI
        tables.append(pd.DataFrame({**values, **about, "pci": pci})[np.isfinite(level) & ~np.asarray(none)])
    joined: pd.DataFrame = pd.concat(tables) if tables else pd.DataFrame(columns=list(_cells.Reading._fields))
    return _marked(joined) if tables else joined


def _marked(readings: pd.DataFrame) -> pd.DataFrame:
    """Return readings whose ``more`` contains an identity other than the PCI, or else the column of the level.

    If there is a PCI, such an identity is used only if one PCI has two of them.
    """
    known, marks = readings["pci"].notna(), readings["mark"]
    # carriers of a mast often share a PCI, and two phones may share a cell
    cell = ["row", "rat", "pci", "arfcn", "mark"]
    twice = readings.assign(arfcn=readings["arfcn"].fillna(-1)).duplicated(cell, keep=False)
    share = (twice & known).groupby(readings["carrier"]).mean()
    apart = share[share.gt(np.where(share.index.str.startswith(_SECONDARY), 0.0, _TWICE))].index
    carriers = readings["carrier"].where(readings["carrier"].isin(apart), "")
    both = (known & marks.ne("")).to_numpy()
    if not _identity.dividing_columns({0: marks.tolist()}, both, readings["pci"].astype(str).tolist()):
        marks = marks.where(~known, "")
    marks = marks.where(known | marks.ne(""), readings["column"])
    more = ["_".join(filter(None, names)) for names in zip(readings["more"], carriers, marks, strict=True)]
    marked: pd.DataFrame = readings.assign(more=more)
    return marked


# A table is a scan if several cells serve at more than this share of the times.
_SCANNED = 0.3


def _of_one_phone(readings: pd.DataFrame, time: AnyArray) -> pd.DataFrame:
    """Return readings without ``serving`` where several cells serve at one time: a phone has one serving cell."""
    claims = readings[readings["serving"].astype(bool)]
    claims = claims.assign(time=time[claims["row"].to_numpy(np.int64)])
    of_time = claims.groupby(["time", "rat"])[["row", "pci", "arfcn"]].nunique()
    several = of_time[(of_time["row"] > 1) & (of_time[["pci", "arfcn"]] > 1).any(axis=1)].index
    if len(several) < _SCANNED * len(of_time):  # a few such times are handovers within a second
        return readings
    keys = pd.MultiIndex.from_arrays([time[readings["row"].to_numpy(np.int64)], readings["rat"]])
    doubted: pd.DataFrame = readings.assign(serving=readings["serving"].astype(bool) & ~keys.isin(several))
    return doubted


def _idle(sheet: _sheet.Sheet) -> BoolArray:
    """Return the rows whose cell does not serve, in tables with one cell per row."""
    idle = np.zeros(len(sheet), dtype=bool)
    for name, words in dictionary.IDLE.items():
        if (column := sheet.find(name)) is not None:
            idle |= np.array([text.lower() in words for text in sheet.texts(column)], dtype=bool)
    return idle


def _rat(technology: str) -> str:
    """Return the radio access of a technology as programs name it."""
    word = technology.strip().lower()
    return "nr" if re.search(r"5g|nr", word) else "lte" if re.search(r"4g|lte", word) else ""


def _or_nan(sheet: _sheet.Sheet, column: int | None, count: int) -> FloatArray:
    if column is None:
        return np.full(count, np.nan)
    meaning, values = sheet.meanings[column], sheet.numbers(column)
    assert meaning is not None
    return np.where(dictionary.is_none(meaning.quantity, values), np.nan, values)


def _read(data: bytes, options: ReadOptions, *, header: _IsHeader, reader: str, **track: str) -> ReadResult:
    """Return cells, ranks, KPIs and the track of a table.

    Raises
    ------
    InputError
        If there is no header with a time, or the only positions are on a local grid.
    UsageError
        If the zone of the clock is unknown.
    """
    sheet = _sheet.read(data, header)
    rows = _sheet.rows(sheet, options, reader=reader)
    grid = sheet.find("grid")
    if track and sheet.find("latitude_deg") is None and grid is not None:
        raise InputError(
            f"positions on a grid, such as column {sheet.names[grid]!r} (NED, ENU, UTM)",
            expected="columns of latitude and longitude",
            cause="an export in local coordinates, whose origin the table does not contain",
        )
    return of_sheet(rows, sheet, **track)


def of_sheet(rows: Rows, sheet: _sheet.Sheet, *, track: str = "phone", source: str = "table of a phone") -> ReadResult:
    """Return the streams of a table whose columns the dictionary knows, for each device and network.

    Parameters
    ----------
    rows : Rows
    sheet : Sheet
    track, source : str
        Name of the telemetry, and the source of its positions.

    Returns
    -------
    ReadResult
    """
    _settle_names(sheet)
    streams: list[Stream | None] = []
    for device, of_device, table in _identity.parts(rows, sheet, "device"):
        name = f"{track}_{device}" if device else track
        streams.append(_pose.from_sheet(of_device, table, name=name, source=source))
        measured = any(meaning and meaning.quantity.role in ("rss", "rank", "kpi") for meaning in table.meanings)
        for network, part, cells in _identity.parts(of_device, table, "network") if measured else ():
            suffix = "_".join(word for word in (network, device) if word)
            streams += [_renamed(stream, suffix) for stream in of_radio(part, cells)]
    levels = [stream for stream in streams if stream is not None and stream.kind in ("rss", "rank")]
    if all(stream.attributes.get("quantity") == "SNR" for stream in levels):
        rows.warnings += _sheet.way_to_level(sheet)
    rows.warnings += sheet.remarks()
    return rows.result(streams)


def of_radio(rows: Rows, sheet: _sheet.Sheet) -> list[Stream | None]:
    """Return the levels, ranks and KPIs of a table."""
    cells, others, ranks = _places(sheet)
    of_row = (sheet.find(name) for name in ("technology", "serving", "neighbouring"))
    sheet.used |= {*others, *ranks, *(i for i in of_row if i is not None)}
    sheet.used |= {i for cell in cells for i in (*cell.columns.values(), *cell.ports, *cell.marks)}
    serving = next((cell.columns for cell in cells if cell.place == "serving"), {})
    identities = [sheet.texts(serving[name]) for name in _IDENTITY if name in serving]
    base = ["\t".join(row) for row in zip(*identities, strict=True)] or [""] * len(sheet)
    about: dict[str, dict[str, Attribute]] = {}
    # if there is an 'nr_cell_id', 'cell_id' is the identity of the LTE cell
    more = [_identity.cell_names(sheet, base, about, nr=nr) for nr in (False, True)]
    owned: dict[tuple[str, ...], list[_Cell]] = {}
    for cell in cells:
        owner = cell.place if cell.place.startswith(_OWNERS) else ""
        unit = written if (written := sheet.unit_read(cell.columns["rsrp_dbm"])).startswith("dB") else "dBm"
        owned.setdefault((owner, "", cell.quantity, unit), []).append(cell)
        for port in cell.ports:  # the level of a port is a separate series of the same cell
            of_port = {name: i for name, i in cell.columns.items() if name in _IDENTITY} | {"rsrp_dbm": port}
            key = (owner, _short(sheet, port), cell.quantity, unit)
            owned.setdefault(key, []).append(replace(cell, columns=of_port))
    several = len({owner for owner, *_ in owned}) > 1
    levels = [
        _renamed(stream, "_".join(word for word in (owner if several else "", port) if word))
        for (owner, port, quantity, unit), part in owned.items()
        for stream in _cells.streams(
            rows, _of_one_phone(_readings(sheet, part, more, about), rows.time), source="drive test", more=about,
            quantity=quantity, unit=unit,
        )
    ]  # fmt: skip
    _name_others(rows, sheet, cells, others)
    rows.warnings += () if rows.options.unit else _assumed_units(sheet)
    ranks = [i for i in ranks if not _numbers_cells(rows, sheet, i)]
    columns = [*ranks, *others, *_event_columns(sheet, cells)]
    direct = [what.quantity.role for what in sheet.meanings if what is not None and not what.indirect]
    # without a level or rank, the ratio to the noise is used as the level
    alone = not {"rss", "rank"} & {*direct} and not _of_a_scheduler(rows, sheet) and not _sheet.unread_levels(sheet)
    shown: list[Stream | None] = []
    for i in columns:
        # in a table with levels, the rank belongs to the serving cell, which changes
        of_cells = "rss" not in direct if i in ranks else _is_level(sheet, i, alone)
        parts = _identity.parts(rows, sheet, *_keys(sheet, i), found=False) if of_cells else [("", rows, sheet)]
        for label, part, inner in parts:
            shown.append(_renamed(_rank(part, inner, i) if i in ranks else _other(part, inner, i, alone), label))
    return [*levels, *shown]


def _keys(sheet: _sheet.Sheet, column: int) -> list[str]:
    """Return the quantities by which the levels of a column are divided into series.

    Names include the radio access only if there are several.
    """
    technology = sheet.find("technology")
    texts = () if technology is None else compress(sheet.texts(technology), np.isfinite(sheet.numbers(column)))
    return ["PCI", "ARFCN", *(["technology"] if len({*map(_rat, texts)}) > 1 else [])]


def _is_level(sheet: _sheet.Sheet, column: int, alone: bool) -> bool:
    meaning = sheet.meanings[column]
    if meaning is None or meaning.indirect or meaning.place != "serving" or _is_statistic(sheet, column):
        return False
    return meaning.quantity.role == "rss" or (alone and meaning.quantity.name == "SINR")


def _is_statistic(sheet: _sheet.Sheet, column: int) -> bool:
    """Check whether a column repeats a level in another form: a mean, or raw values of a calibrated level."""
    own = sheet.meanings[column]
    if own is None or not own.part:
        return _part(sheet, column) != ""
    others = (what for what in sheet.meanings if what is not None and what is not own and not what.indirect)
    return any(
        (m.quantity, m.rat, m.place) == (own.quantity, own.rat, own.place)
        for m in others if not m.part or m.quantity.name == "RSRP"
    )  # fmt: skip


def _of_a_scheduler(rows: Rows, sheet: _sheet.Sheet) -> bool:
    """Check whether a base station wrote the table, with only columns of the uplink."""
    words = {word for name in sheet.plain for word in name.split()}
    if not (words & {"ul", "uplink", "pusch", "pucch"}) or words & {"dl", "downlink", "pdsch", "csi"}:
        return False
    if not words & {"rnti", "ue", "nprb", "prb", "prbs"}:
        return False
    rows.warnings.append("the table is from an uplink scheduler: its SNRs are not levels of the downlink")
    return True


def _numbers_cells(rows: Rows, sheet: _sheet.Sheet, column: int) -> bool:
    """Check whether the ranks at most times are 1, 2, 3 ..: an order of cells, such as the order of a scanner."""
    table = pd.DataFrame({"time": rows.time, "rank": sheet.numbers(column)}).dropna()
    of_time = table.groupby("time")["rank"].agg(["size", "nunique", "min", "max"])
    listed = (of_time["size"] > 1) & (of_time[["nunique", "max"]].eq(of_time["size"], axis=0)).all(axis=1)
    if not len(listed) or (listed & of_time["min"].eq(1)).mean() <= _NUMBERED:
        return False
    rows.warnings.append(f"column {sheet.names[column]!r} numbers the rows of each time: not a rank of the channel")
    return True


# Places of levels that no name of a neighbour, carrier, device or tower describes.
_UNNAMED = ("serving", *(f"cell{i}" for i in range(100)))
# Smallest share of times at which an order of cells is complete.
_NUMBERED = 0.8


def _short(sheet: _sheet.Sheet, column: int) -> str:
    """Return a short name for a column: its name without the words for the quantity and the radio access."""
    return "_".join(_SHARED.sub(" ", sheet.plain[column]).split()) or f"column{column + 1}"


# Words that occur in the names of all levels of a cell, and further words for a measured level.
_SHARED = re.compile(r"\b(\w*rsrp|dbm|lte|nr|4g|5g|serving)\b")
_MORE = re.compile(rf"{_SHARED.pattern}|\b(rssi|raw|meas(ured)?|inst|cell|ss|current)\b")


def _name_others(rows: Rows, sheet: _sheet.Sheet, cells: list[_Cell], others: list[int]) -> None:
    """Report which of several columns of a cell's level was read, and how the others were read."""
    for cell in cells:
        level, known = sheet.names[cell.columns["rsrp_dbm"]], np.isfinite(sheet.numbers(cell.columns["rsrp_dbm"]))
        if "pci" in cell.columns and (text := _identity.mostly_empty(sheet, cell.columns["pci"], known)):
            rows.warnings.append(text)
        of_cell = [i for i in others if (m := sheet.meanings[i]) and (m.rat, m.place) == (cell.rat, cell.place)]
        means = [i for i in of_cell if _part(sheet, i) == "mean"]
        if _part(sheet, cell.columns["rsrp_dbm"]) == "mean":
            text = f"the level of the cell is {level!r}, a mean or a percentile: no other column has the measured level"
            rows.warnings.append(text)
        for listed, what in ((cell.ports, "separate series"), (means, "KPIs")):
            if listed:
                shown = ", ".join(repr(sheet.names[i]) for i in listed)
                rows.warnings.append(f"the level of the cell is {level!r}; read as {what}: {shown}")
    alike: dict[tuple[str, str], list[str]] = {}
    for i in (*(cell.columns["rsrp_dbm"] for cell in cells if not cell.marks), *others):
        m = sheet.meanings[i]
        if m and m.quantity.role == "rss" and m.place in _UNNAMED and not (m.indirect or _part(sheet, i)):
            alike.setdefault((m.quantity.name, m.rat), []).append(sheet.names[i])
    for names in alike.values():
        # if a header repeats a name, the second column is called "RSRP 2"
        if len(names) > 1 and not all(re.search(r"\d", name) for name in names):
            text = "are separate series: the table does not specify whose levels they are"
            rows.warnings.append(f"{' and '.join(map(repr, names))} {text}")


def _assumed_units(sheet: _sheet.Sheet) -> Iterator[str]:
    """Yield a sentence about each level without a unit if the assumed unit may be wrong."""
    levels = [i for i, what in enumerate(sheet.meanings) if what and what.quantity.role == "rss" and not what.indirect]
    for i in levels if not sheet.program else ():
        what, known = sheet.meanings[i], sheet.numbers(i)[np.isfinite(sheet.numbers(i))]
        # a program that also writes RSRP has RSSI in dBm; the only level of a table may be relative to full scale
        doubtful = len(levels) == 1 or (len(known) and np.median(known) > _NEAR_FULL_SCALE)
        if what and len(known) and not sheet.unit_read(i) and {"RSSI": doubtful, "power": True}.get(what.quantity.name):
            text = f"no unit is written: read as {what.quantity.unit}; the first level is {known[0]:g}"
            yield f"column {sheet.names[i]!r}: {text}. If this is wrong, use --unit"


# A higher median RSSI is not plausible for a receiver in the field [dBm].
_NEAR_FULL_SCALE = -25.0


def _renamed(stream: Stream | None, suffix: str) -> Stream | None:
    if stream is None or not suffix:
        return stream
    about = {**stream.attributes, "part": suffix}
    if "channel" in about:
        about["channel"] = f"{about['channel']}_{suffix}"
    return replace(stream, name=f"{stream.name}_{suffix}", attributes=about)


def _event_columns(sheet: _sheet.Sheet, cells: list[_Cell]) -> Iterator[int]:
    """Yield columns of a serving cell with values in rows without its level, as in Nemo's rows of events."""
    for cell in cells:
        if cell.serving:
            silent = np.isnan(sheet.numbers(cell.columns["rsrp_dbm"]))
            yield from (i for i in cell.measured if np.isfinite(sheet.numbers(i)[silent]).any())


def _settle_names(sheet: _sheet.Sheet) -> None:
    """Divide G-NetTrack's ``Level`` into columns: RSRP on 4G and 5G, RSCP on 3G, RxLev on 2G.

    The column ``LTERSSI`` of this app is in dBm, but older phones write steps from 0, which are ignored.
    """
    if sheet.program is None or "level" not in sheet.program.words:
        return
    # values of 0 and above are not dBm but index steps that older phones write
    if (rssi := sheet.named("lterssi")) is not None:
        sheet.silence(sheet.numbers(rssi) >= 0, [rssi])
    technology, levels = sheet.find("technology"), [i for i in map(sheet.named, ("level", "qual")) if i is not None]
    texts = [] if technology is None else sheet.texts(technology)
    unlike = np.array([not _rat(text) for text in texts], dtype=bool)
    for name, older in (("RSCP", r"(?i)3g|umts|hspa|wcdma"), ("RxLev", r"(?i)2g|gsm|gprs|edge")):
        mine = [re.search(older, text) is not None and its for text, its in zip(texts, unlike, strict=True)]
        if any(mine):
            sheet.add(name, [cells[levels[0]] if its else "" for cells, its in zip(sheet.cells, mine, strict=True)])
    if unlike.any():
        sheet.silence(unlike, levels)


def _rank(rows: Rows, sheet: _sheet.Sheet, column: int) -> Stream | None:
    ri = sheet.numbers(column)
    flag, zero = rows.flag.copy(), dictionary.has("from_zero", sheet.plain[column])
    none = (ri == 0) & (not zero)
    values = {"rank": checked_ranks(ri + zero, flag, none=none, means=True), "ri_raw": ri}
    name, cqi = re.sub(r"\W+", "_", sheet.plain[column]), sheet.find("CQI")
    # rows without a report have no CQI either, and are few, whereas ranks that count from 0 are often 0
    doubtful = none if cqi is None else none & (sheet.numbers(cqi) > 0)
    few = _MOST_IDLE * len(ri) if cqi is None else none.sum() / 2
    if doubtful.sum() > max(few, 1) and np.nanmax(ri, initial=0) < _MOST_PORTS:
        text = f"0 in {counted(int(doubtful.sum()), 'row')}, read as no report: do its ranks count from 0?"
        rows.warnings.append(f"column {sheet.names[column]!r}: {text} If so, use --map and --ri-base zero")
    source = "scheduled PDSCH rank" if "pdsch" in name else "CSI report"
    return rows.stream(
        "rank", name, values, where=np.isfinite(ri), flag=flag, ri_base=("one", "zero")[zero], source=source
    )


# Largest share of rows without a report, and the largest number of receive ports of a phone or modem.
_MOST_IDLE, _MOST_PORTS = 0.1, 4


def _other(rows: Rows, sheet: _sheet.Sheet, column: int, alone: bool) -> Stream | None:
    values, name = sheet.numbers(column), sheet.plain[column]
    meaning, tower = sheet.meanings[column], _TOWER.search(dictionary.without_unit(name)[0])
    about = {"node": f"{tower[1]}{tower[2]}".upper()} if tower else {}
    if tower and tower[3]:
        about["channel"] = f"{tower[3]}{tower[4]}".upper()
    if meaning is not None and meaning.place.startswith("cell") and "cell" in name:
        # 'cell 2 rsrp' belongs to another cell, whereas 'rsrp 2' is a second level of the same cell
        about |= {"cell": meaning.place, "part": meaning.place}
    if tower and name == f"snr {tower[0]}":
        return snr_stream(rows, about["node"], values)
    where, unit = np.isfinite(values), sheet.unit_read(column)
    if _is_statistic(sheet, column):
        about["statistic"] = "raw" if _part(sheet, column) == "raw" else "mean"
    return _cells.named(rows, name, values, unit=unit, where=where, about=about, alone=alone)


READERS = (
    Reader(
        name="drive_test", kinds=("rss", "rank", "kpi", "telemetry"),
        title="drive-test export, CSV (Nemo, XCAL, TEMS, QualiPoc, G-NetTrack): cells by PCI, rank, KPIs, positions",
        sample="Time,Latitude,Longitude,Physical cell identity (LTE pcell),RSRP (LTE pcell)",
        sniff=partial(_is_table, header=is_header), read=partial(_read, header=is_header, reader="drive_test"),
    ),
    Reader(
        name="pose_csv", kinds=("telemetry", "kpi"),
        title="positions and attitude, CSV with named columns (converted vehicleOut, ArduPilot export, DJI, AirData)",
        sample="timestamp,Lat,Lng,Alt,Roll,Pitch,Yaw", sniff=partial(_is_table, header=is_track_header),
        read=partial(
            _read, header=is_track_header, reader="pose_csv", track="vehicle", source="table of positions"
        ),
    ),
    Reader(
        name="aadm_snr", kinds=("rss",), title="SNR of several towers, CSV (AADM)", sample="time,snr_lw1,snr_lw2",
        sniff=lambda head: _SNR_OF_TOWERS.match(head) is not None,
        read=partial(_read, header=is_header, reader="aadm_snr"),
    ),
)  # fmt: skip

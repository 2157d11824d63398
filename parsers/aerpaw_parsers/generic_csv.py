"""Any CSV with a header and columns that the user maps: ``columns: {time: Time, rss_db: Power}``, ``kind: rss``.

The columns of a CSV are never guessed: flight.yaml names them. Times are texts (``YYYY-mm-dd HH:MM:SS[.f][offset]``, or
forms of other programs such as ``15.07.2024 11:49:27,231``) or numbers. Numbers count from ``time_origin`` if it is
given, else from 1970 in UTC; ``clock: local_as_utc`` is for wall time stored as UTC. Numbers are seconds, unless the
name of the column, or the steps between the rows, require another unit.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray
from aerpaw_cmp.logs.readers import unknown_name
from aerpaw_cmp.logs.text import add_flag, split
from aerpaw_cmp.readers import COLUMNS, Kind, Reader, ReadOptions, ReadResult, Rows, Stream, counted, dictionary

from . import _identity, _pose, _sheet

_EXTRA = ("rsrp_dbm", "sinr_db", "cqi", "mcs", "latitude_deg", "longitude_deg", "altitude_m")
# Further columns of ranks and levels. Positions in a manually merged table become the track.
_COMPANIONS: dict[str, tuple[str, ...]] = {"rank": _EXTRA, "rss": (*COLUMNS["telemetry"][:-2], "sinr_db")}
# Columns that each kind requires.
_VALUE = {"telemetry": _pose.PLACE, "rss": ("rss_db",), "rank": ("ri_raw",)}

# Units of record columns, by the ends of their names.
_UNITS = {"_deg": "deg", "_m": "m", "_mps": "m/s", "_dbm": "dBm", "_db": "dB"}
# Quantities of record columns whose values can show a wrong unit or shifted rows.
_QUANTITIES = {row.name: row for row in dictionary.QUANTITIES if row.role in ("position", "height")}
# Quantities whose names do not contradict a mapping to a column of the telemetry.
_NO_POSE = ("time", "fix", "satellites")
# Identities to which a column with an unknown name can be mapped.
_NAMED = ("cell", "device")
# Keys that divide a mapped table, besides devices: each part is a series.
_KEYS = ("network", "PCI", "ARFCN")


def _checked(options: ReadOptions, header: list[str]) -> tuple[Kind, dict[str, int]]:
    """Return the kind, and the position of the file column for each record column."""
    if options.kind is None:
        raise UsageError("the kind of the table is missing", expected="'kind:' telemetry, rss or rank")
    allowed = ["time", *_NAMED, *COLUMNS[options.kind], *_COMPANIONS.get(options.kind, ())]
    if unknown := sorted(set(options.columns) - set(allowed)):
        found = f"'columns:' names {unknown[0]!r}, which a {options.kind} record does not have"
        raise unknown_name(found, unknown[0], allowed)
    lacking = [name for name in ("time", *_VALUE[options.kind]) if name not in options.columns]
    if lacking:
        example = f"e.g. columns: {{{lacking[0]}: {header[0]!r}}}"
        raise UsageError(f"'columns:' lacks {', '.join(lacking)}", expected=example)
    if absent := sorted({name for name in options.columns.values() if name not in header}):
        raise unknown_name(f"the file has no column {absent[0]!r}", absent[0], header[:40])
    if options.kind == "rank" and options.ri_base is None:
        raise UsageError("the table does not show whether rank 1 is 0 or 1", expected="'ri_base:' zero or one")
    return options.kind, {column: header.index(name) for column, name in options.columns.items()}


def _values(sheet: _sheet.Sheet, column: int, name: str, options: ReadOptions) -> FloatArray:
    """Return a mapped column in the unit of its record column.

    Raises
    ------
    UsageError
        If the unit in the file does not fit the mapped quantity.
    """
    values, unit = sheet.numbers(column), sheet.unit_read(column)
    meaning, written = sheet.meanings[column], sheet.names[column]
    if meaning is not None and not _is_of(meaning.quantity, name, options.unit):
        raise UsageError(
            f"the name of column {written!r} means {meaning.quantity.name}, but it is mapped to {name}",
            expected="one quantity and unit: correct the mapping, --unit or the header",
        )
    wanted = next(unit for end, unit in (*_UNITS.items(), ("", "")) if name.endswith(end))
    right = unit in ("dBm", "dB", "dB re full scale") if name == "rss_db" else unit == wanted
    bracketed = "[" in written or unit in {known for known, _ in dictionary.UNITS.values()}
    if unit and wanted and not right and bracketed:
        raise UsageError(f"column {written!r} is in {unit} and mapped to {name}", expected=f"a column in {wanted}")
    same = {"dBm": (None, "dBm"), "dB re full scale": (None, "dB", "dB re full scale")}.get(unit, (options.unit,))
    if name == "rss_db" and options.unit not in same:
        raise UsageError(f"column {written!r} is in {unit}, but --unit is {options.unit}", expected="one unit")
    if name == "rss_db" and unit == "dB" and options.unit == "dBm":
        sheet.notes[column] = f"column {written!r} is marked dB, but --unit is dBm: read as dBm"
    return values


def _is_of(quantity: dictionary.Quantity, name: str, unit: str | None) -> bool:
    """Check whether a column of a quantity can be mapped to a column of the record model."""
    if name == "rss_db":
        return quantity.role == "rss" or (quantity.unit == "dB" and unit != "dBm")
    if name == "ri_raw":
        return quantity.role == "rank"
    # 'vx' is the velocity to the east if x is east
    of_axes = quantity.role == "velocity" and name.startswith("velocity")
    return name not in COLUMNS["telemetry"] or quantity.name in (name, *_NO_POSE) or of_axes


_UNIT = re.compile(r" \[[^\[\]]*\]$")


def _odd(sheet: _sheet.Sheet, column: int) -> BoolArray:
    """Return the mask of cells that are words or infinities, except -inf dB, which means no signal."""
    values = sheet.numbers(column)
    texts = [text.strip('"').lower() for text in sheet.texts(column)]
    none = np.array([text in _sheet.NO_VALUE and text != "inf" for text in texts], dtype=bool)
    return np.asarray(np.isnan(values) & ~none)


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the streams of the kind in the options, one for each device, network and cell of the table.

    Raises
    ------
    UsageError
        If ``kind``, ``columns``, ``ri_base`` or ``timezone`` is missing, or a named column does not exist.
    """
    lines = split(data)
    if lines.blank.all():
        return ReadResult("generic_csv", (), len(lines), 0, len(lines))
    first = int(np.argmin(lines.blank))
    head = [lines.raw(i) for i in range(first, min(first + _sheet.TITLES, len(lines)))]

    def are_named(names: list[str]) -> bool:
        return all({name, _UNIT.sub("", name)} & {*names} for name in options.columns.values())

    # the header is the line with the columns that the user named, else the first line
    header_of = _sheet.header_of(head, are_named) or _sheet.header_of(head, lambda _names: True)
    at, separator, header = header_of or (0, ",", [lines.text(first)])
    # options proposed by a draft may include the unit from the line below the header
    bare = {key: name if name in header else _UNIT.sub("", name) for key, name in options.columns.items()}
    options = replace(options, columns=bare) if {*bare.values()} <= {*header} else options
    kind, where = _checked(options, header)
    sheet = _sheet.cut(lines, first + at, separator, header)
    sheet.used |= {*where.values()}
    for name in {*_NAMED} & {*where}:
        sheet.names[where.pop(name)] = name
    sheet.mapped = {where[name]: quantity for name, quantity in _QUANTITIES.items() if name in where}
    rows = _sheet.rows(sheet, options, reader="generic_csv", column=where.pop("time"))
    for column in (where[name] for name in _VALUE[kind]):
        if len(sheet) and not any(sheet.texts(column)):
            found = f"column {sheet.names[column]!r} is empty in every row"
            raise InputError(found, expected="values", cause=_sheet.MISALIGNED)
    if kind == "rss":
        _refuse_other_numbers(sheet, where["rss_db"], options)
    what = sheet.meanings[where["rss_db"]] if kind == "rss" else None
    # the quantity determines the unit of an RSRP
    of_quantity = what.quantity.unit if what is not None and np.isfinite(what.quantity.can_be[0]) else ""
    unit = sheet.unit_read(where["rss_db"]) or of_quantity if kind == "rss" else ""
    if kind == "rss" and options.unit is None and not unit:
        rows.warnings.append("no 'unit:' is given: the levels are read as dB re full scale")
    angles = {name: sheet.numbers(where[name]) for name in _pose.ANGLES if name in where}
    if not any(sheet.unit(where[name]) for name in angles) and _pose.are_small(angles):
        rows.warnings.append(_pose.small_angles(angles))
    streams: list[Stream | None] = []
    for device, of_device, table in _identity.parts(rows, sheet, "device"):
        whole, level = [("", of_device, table)], where.get("rss_db")
        heights, about = _above_takeoff(of_device, table, where)
        divided = _identity.parts(of_device, table, *_KEYS, level=level) if kind != "telemetry" else whole
        for label, part, cells in divided:
            words = "_".join(word for word in (options.channel or kind, label, device) if word)
            # all cells of a device share the zero of heights
            of_part = None if heights is None else heights[np.searchsorted(of_device.row, part.row)], about
            streams.append(_stream(part, cells, kind, where, words, options.unit or unit, of_part))
        track = {name: column for name, column in where.items() if name in COLUMNS["telemetry"]}
        if kind == "rss" and {*_pose.PLACE[:2]} <= {*track}:
            name = "_".join(filter(None, ("vehicle", device)))
            streams.append(_stream(of_device, table, "telemetry", track, name, "", (heights, about)))
    sheet.used |= {i for i, name in enumerate(header) if name in options.read_elsewhere}
    rows.warnings += sheet.remarks()
    return rows.result(streams)


_OF_LONG_TABLES = ("rss", "kpi", "rank", "position", "height")


def _refuse_other_numbers(sheet: _sheet.Sheet, column: int, options: ReadOptions) -> None:
    """Refuse powers without a unit as levels, and tables in which another column names the quantity of each row."""
    for i in range(len(sheet.names)):
        texts = {*sheet.texts(i)}
        named = sorted(texts) if _identity.few(texts) else []
        known = [text for text in named if (m := dictionary.meaning(text)) and m.quantity.role in _OF_LONG_TABLES]
        if len(known) > 1:
            found = f"column {sheet.names[i]!r} names the quantity of each row: {', '.join(known[:4])}"
            raise InputError(found, expected="a column per quantity", cause="a table in long form: pivot it")
    values = sheet.numbers(column)[np.isfinite(sheet.numbers(column))]
    if len(values) and not sheet.unit_read(column) and options.unit != "dB" and 0 < values.min() <= values.max() < 1:
        found, name = f"all levels are between 0 and 1, such as {values[0]:.3g}", sheet.names[column]
        expected = f"decibels, or the unit in the header: '{name} [mW]', or '{name} [linear]' for a power of full scale"
        raise InputError(found, expected=expected, cause="linear powers")


# Heights above take-off (None if they are not changed), and the attributes about their source.
_Heights = tuple[FloatArray | None, _pose.Height]


def _stream(
    rows: Rows, sheet: _sheet.Sheet, kind: Kind, where: dict[str, int], name: str, unit: str, heights: _Heights
) -> Stream | None:
    """Return the stream of mapped columns according to its kind, and flag rows with words in place of numbers."""
    options, flag = rows.options, rows.flag.copy()
    values: dict[str, AnyArray] = {key: _values(sheet, column, key, options) for key, column in where.items()}
    if {*_pose.PLACE[:2]} <= set(values):
        values[_pose.PLACE[0]] = np.where(_pose.without_fix(sheet), np.nan, values[_pose.PLACE[0]])
        coarse = _pose.whole_degrees([sheet.names[where[key]] for key in _pose.PLACE[:2]], values)
        rows.warnings += [f"{coarse}: is it the right column?"] if coarse else []
    above, about = heights
    values |= {} if above is None else {"altitude_m": above}
    odd = np.any([_odd(sheet, where[key]) for key in _VALUE[kind] if key in where], axis=0)
    add_flag(flag, odd, "no_number")
    if odd.any():
        lines = counted(int(odd.sum()), "row is", "rows are")
        first = int(rows.row[odd][0]) + 1
        rows.warnings.append(f"{lines} flagged no_number; the first: line {first}, a word or an infinity; not scored")
    if kind == "rss":
        level, meaning = values["rss_db"], sheet.meanings[where["rss_db"]]
        silent = ~(level > options.floor_db) | ((unit == "dBm") & (level == 0))
        add_flag(flag, silent & ~odd, "out_of_coverage")
        values["rss_db"] = np.where(silent, np.nan, level)
        quantity = meaning.quantity.name if meaning is not None and meaning.quantity.can_be[0] < 0 else None
        about = {"unit": unit or "dB re full scale", "quantity": quantity, **about}
    elif kind == "rank":
        base, ri = int(options.ri_base == "one"), values["ri_raw"]
        good = (ri >= base) & (ri <= 7 + base) & (ri == np.round(ri))
        none = np.isnan(ri) | ((ri == 0) & (base == 1))
        add_flag(flag, none & ~odd, "no_csi")
        add_flag(flag, ~good & ~none, "ri_out_of_range")
        values["rank"] = np.where(good, ri + 1 - base, np.nan)
        about = {"ri_base": options.ri_base, **about}
    else:
        place = {key: values[key] for key in _pose.PLACE if key in values}
        latitude, longitude, *altitude = place.values()
        # loggers write -999 if there is no fix; allow for rounding
        lost = ~((np.abs(latitude) <= 90) & (np.abs(longitude) <= 180) & np.all([m > -998.5 for m in altitude], axis=0))
        add_flag(flag, lost, "no_fix")
        values |= {key: np.where(lost, np.nan, column) for key, column in place.items()}
        for key in {"fix", "satellites"} & set(values):
            values[key] = np.where(np.isnan(values[key]), -1, values[key]).clip(-1, 255).astype(np.int64)
    return rows.stream(kind, name, values, flag=flag, about=about)


def _above_takeoff(rows: Rows, sheet: _sheet.Sheet, where: dict[str, int]) -> _Heights:
    """Return heights above take-off unless the header has another name or datum."""
    height = sheet.meanings[where["altitude_m"]] if {*_pose.PLACE} <= {*where} else None
    known = height is not None and dictionary.meaning(sheet.names[where["altitude_m"]]) is not None
    if height is None or not known or height.quantity.datum in ("take-off", "ground"):
        return None, {}
    rows.height_from = "assumed" if height.quantity.datum == "unknown" else "written"
    values: dict[str, AnyArray] = {name: sheet.numbers(where[name]) for name in _pose.PLACE}
    lost = _pose.without_fix(sheet) | np.isnan(values[_pose.PLACE[0]])
    return _pose.above_takeoff(rows, values, height.quantity.datum, lost)


READER = Reader(
    name="generic_csv", title="any CSV with a header, columns mapped in flight.yaml",
    kinds=("telemetry", "rss", "rank"), sample="Time,Power,...", sniff=lambda _head: False, read=read,
)  # fmt: skip

"""The identity of a reading: the combination of all columns that name a device, a network, a cell or a beam.

A column joins the key of a series if it distinguishes rows that the other columns of the key do not distinguish. If
there is a PCI, the number of a cell joins only if one PCI occurs with two numbers. A column with an unknown name joins
if its values distinguish rows with the same time, or if its values and the level change together in a fixed order.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from aerpaw_cmp.readers import AnyArray, Attribute, BoolArray, FloatArray, Rows, counted, dictionary

from . import _sheet

# A column with more values than this does not name devices or networks. Such a column is probably a counter.
_MOST_PARTS = 64
# At a handover a program updates its columns one after the other. A value in at most this number of rows, and in at
# most this share of the rows of the other columns' key, is such a delay.
_LAG_ROWS, _LAG_SHARE = 2, 0.1
# A column of identities that is empty in more than this share of the rows may have merged cells.
_MOSTLY = 0.8


def parts(
    rows: Rows, sheet: _sheet.Sheet, *keys: str, found: bool = True, level: int | None = None
) -> Iterator[tuple[str, Rows, _sheet.Sheet]]:
    """Divide a table by identity: yield the name of each part, its rows and its cells.

    Parameters
    ----------
    rows : Rows
    sheet : Sheet
    keys : str
        Quantities of the dictionary, such as ``device`` or ``network``. The identity is the combination of all columns
        of these quantities.
    found : bool
        True if columns with unknown names that distinguish rows are also used.
    level : int, optional
        The column of levels, if its name does not show it.

    Yields
    ------
    tuple of str, Rows and Sheet
        The name is empty if the table has one part.
    """
    known = ((i, m) for i, m in enumerate(sheet.meanings) if m and m.quantity.name in keys)
    columns = [i for i, meaning in known if not meaning.place.startswith("n")]
    marks = _marks(rows, sheet, keys, columns, level) if found else []
    texts = {i: _named(sheet, i) for i in (*columns, *marks)}
    filled = _with_level(sheet)
    picked = np.flatnonzero(filled).tolist()
    several = [i for i in columns if 1 < len({texts[i][row] for row in picked}) <= _MOST_PARTS]
    base = ["\t".join(row) for row in zip(*(texts[i] for i in several), strict=True)]
    several += dividing_columns({i: texts[i] for i in marks}, filled, base)
    rows.warnings += filter(None, (mostly_empty(sheet, i, filled) for i in several))
    if unknown := [sheet.names[i] for i in several if i in marks and sheet.meanings[i] is None]:
        shown = ", ".join(map(repr, unknown))
        rows.warnings.append(f"column {shown} distinguishes the rows: each of its values is a series")
    single = {i: next(iter(values)) for i, values in _values(texts).items() if len(values) == 1}
    divided = {sheet.plain[i] for i in several}
    alone = {sheet.plain[i]: text for i, text in single.items() if sheet.plain[i] not in divided}
    sheet.used |= {*several, *single}
    if not several:
        yield "", replace(rows, about=rows.about | attributes_of(alone)), sheet
        return
    rows_of: dict[tuple[str, ...], list[int]] = {}
    for row, values in enumerate(zip(*(texts[i] for i in several), strict=True)):
        rows_of.setdefault(values, []).append(row)
    for values, mine in rows_of.items():
        where = np.zeros(len(sheet), dtype=bool)
        where[mine] = True
        written = {sheet.plain[i]: text for i, text in zip(several, values, strict=True) if text}
        label = "_".join(_label(name, text) for name, text in written.items())
        yield label, replace(rows.part(where), about=rows.about | attributes_of(alone | written)), sheet.part(where)


def mostly_empty(sheet: _sheet.Sheet, column: int, where: BoolArray) -> str:
    """Return a sentence about a column of identities that is empty in most rows of a mask, but not in all."""
    texts = [text for text, picked in zip(_named(sheet, column), where.tolist(), strict=True) if picked]
    empty = texts.count("")
    if not _MOSTLY * len(texts) < empty < len(texts):
        return ""
    text = f"is empty in {counted(empty, 'row')}, which become a separate series"
    return f"column {sheet.names[column]!r} {text}: are its cells merged, or written on changes only? If so, fill them"


def _values(texts: Mapping[int, list[str]]) -> dict[int, set[str]]:
    return {i: {*cells} - {""} for i, cells in texts.items()}


def _levels(sheet: _sheet.Sheet) -> AnyArray:
    """Return for each row, as bytes, which levels, ratios and ranks it has. The bytes are empty if the row has none."""
    columns = [
        np.isfinite(sheet.numbers(i))
        for i, meaning in enumerate(sheet.meanings)
        if meaning is not None and (meaning.quantity.role in ("rss", "rank") or meaning.quantity.name == "SINR")
    ]
    bits = np.packbits(np.stack(columns or [np.zeros(len(sheet), dtype=bool)], axis=1), axis=1)
    return np.asarray(bits.view(f"S{bits.shape[1]}").ravel())


def _with_level(sheet: _sheet.Sheet) -> BoolArray:
    """Return the mask of the rows with a level, a ratio or a rank, or of all rows if there is no such row."""
    filled: BoolArray = _levels(sheet) != b""
    return filled if filled.any() else np.ones(len(sheet), dtype=bool)


def dividing_columns(texts: Mapping[int, list[str]], counts: BoolArray, base: Sequence[str] = ()) -> list[int]:
    """Return, in order, the columns that divide the rows further than the columns before them.

    Parameters
    ----------
    texts : mapping of int to list of str, length n
        Texts of each column, which are empty where the column names nothing.
    counts : bool array, shape (n,)
        Rows that are considered.
    base : sequence of str, length n, optional
        Part of the identity of each row that is already known.
    """
    picked = np.flatnonzero(counts).tolist()
    key = [base[row] for row in picked] if len(base) else [""] * len(picked)
    chosen = []
    for i, cells in texts.items():
        values = {*cells} - {""}
        # a column with one text does not divide the rows
        if len({*cells}) < 2 or len(values) > _MOST_PARTS:
            continue
        both = Counter((before, cells[row]) for before, row in zip(key, picked, strict=True))
        if _is_divided(both, alone=len(values) == 1):
            chosen.append(i)
            key = [f"{before}\t{cells[row]}" for before, row in zip(key, picked, strict=True)]
    return chosen


def _is_divided(counts: Counter[tuple[str, str]], *, alone: bool) -> bool:
    """Check whether a key has two values of a column, except in the few rows in which a program lags."""
    totals, values = Counter[str](), Counter[str]()
    for (before, _), count in counts.items():
        totals[before] += count
    several = len(totals) > 1
    for (before, _), count in counts.items():
        # if the key has other columns, a value in few rows is a delay; if it has none, each value counts
        lag = count <= _LAG_ROWS and count <= _LAG_SHARE * totals[before]
        values[before] += not (lag and (several or alone))
    return max(values.values(), default=0) > 1


def cell_columns(sheet: _sheet.Sheet, *, nr: bool | None = None) -> list[int]:
    """Return columns named like a cell that the dictionary does not know, if possible only of NR (``nr``) or of LTE."""
    columns = [
        i for i, words in enumerate(sheet.plain) if not sheet.meanings[i] and dictionary.names_a_cell(words, alone=True)
    ]
    return [i for i in columns if dictionary.has("nr", sheet.plain[i]) == nr] or columns


def _marks(rows: Rows, sheet: _sheet.Sheet, keys: Sequence[str], known: list[int], level: int | None) -> list[int]:
    """Return the columns without a known quantity whose values are separate networks or devices.

    Such columns contain names of cells if there is no PCI, or change together with the level in a fixed order. A column
    of nodes, beams or directions is found because many rows have the same time and key without it. Devices also differ
    in their positions.
    """
    key = keys[0]
    marks = cell_columns(sheet) if key == "network" and ("PCI" in keys or sheet.find("PCI") is None) else []
    of_cells = (i for i, m in enumerate(sheet.meanings) if m is not None and m.quantity.name in _CELL)
    columns = dict.fromkeys([*known, *marks, *of_cells])
    table = pd.DataFrame({"time": rows.time, "levels": _levels(sheet), **{str(i): sheet.texts(i) for i in columns}})
    place = sheet.find("latitude_deg")
    if key == "device":
        at = pd.DataFrame({"time": rows.time, "at": "" if place is None else sheet.texts(place)})
        if at["time"].duplicated().mean() - at.duplicated().mean() < _REPEATED:
            return []
        table = table[["time", "levels", *(str(i) for i in known)]]
    unknown = [
        i
        for i, m in enumerate(sheet.meanings)
        if m is None and i not in marks and not dictionary.has("no_identity", sheet.plain[i])
    ]
    found: list[int] = []
    while (repeated := table.duplicated().mean()) >= _REPEATED:
        # add the column that leaves the fewest rows with the same time and key, then look for another column
        left = {i: table.assign(mark=sheet.texts(i)).duplicated().mean() for i in unknown if few(sheet.texts(i))}
        best = min(left, key=lambda i: left[i], default=-1)
        if best < 0 or left[best] > repeated - _REPEATED / 2:
            break
        found.append(best)
        unknown.remove(best)
        table[str(best)] = sheet.texts(best)
    names = ("RSRP", "RSSI", "SNR", "SINR", "power") if level is None else ()
    level = next((i for name in names if (i := sheet.find(name)) is not None), level)
    if found and not _name_sources(table, [str(i) for i in found], None if level is None else sheet.numbers(level)):
        shown = ", ".join(repr(sheet.names[i]) for i in found)
        rows.warnings.append(f"column {shown}: rows with the same time differ in its values, but {_ASKED}")
        found = []
    marks += found
    if key == "network" and unknown and level is not None:
        # compare rows of one known key, because a cell number adds no information if it has only one PCI
        same = _of_one_key(table.drop(columns=["time", "levels"]))
        part, time = sheet.part(same), rows.time[same]
        for i in unknown:
            alternates, in_turns = _alternates(time, part, i, level)
            marks += [i] if in_turns else []
            if alternates and not in_turns:
                text = f"column {sheet.names[i]!r}: the level changes with its values"
                rows.warnings.append(f"{text}, but {_ASKED}")
    return marks


_ASKED = "not in a fixed order: does it name the device or cell of a row? If so, call it 'device'"


def _name_sources(table: pd.DataFrame, found: list[str], level: FloatArray | None) -> bool:
    """Check whether columns that distinguish rows of one time name sources, unlike a temperature or a counter.

    Either most sources have one row at each time, or the level changes less within a source than between sources.
    """
    key = [name for name in table if name not in ("time", "levels", *found)]
    groups = [group for _, group in table.groupby(key)] if key else [table]
    places = sum(group["time"].nunique() * len(group[found].drop_duplicates()) for group in groups)
    filled = (~table.duplicated()).sum() / places
    if table.duplicated().mean() <= _MOST_DOUBLE and filled >= _REPEATED:
        return True
    if level is None:
        return False
    known = table.assign(level=level).sort_values("time", kind="stable")
    within, between = (known.groupby(names)["level"].diff().abs().median() for names in ([*key, *found], ["time"]))
    return bool(within < _SMALLER * between)


def _of_one_key(table: pd.DataFrame) -> BoolArray:
    """Return the mask of the rows with the most frequent key, or of all rows if there is no key."""
    if not table.shape[1]:
        return np.ones(len(table), dtype=bool)
    key = table.groupby(list(table.columns), sort=False).ngroup().to_numpy()
    return np.asarray(key == np.bincount(key).argmax()) if len(key) else np.zeros(0, dtype=bool)


_CELL = ("PCI", "ARFCN", "technology", "device", "network")
_REPEATED, _MOST_MARKS, _MOST_DOUBLE = 0.3, 16, 0.1


def few(texts: Iterable[str]) -> bool:
    """Check whether a column has several values, but not more than the plausible number of devices or cells."""
    return 1 < len({*texts}) <= _MOST_MARKS


# A column (such as the device) alternates together with the level if the level changes little between successive rows
# with the same entry: the median change is below a share of the median change between neighbouring rows with different
# entries. The share is _SMALLER, or _SMALLER_IF_RARE if the entry changes less than _FEWEST times. Entries alternate in
# a fixed order if at least the share _IN_TURN of rows have the same entry as the row k before, where k is the number
# of different entries, and at least the same share differ from the row directly before. Tables with fewer rows than
# _FEWEST are not tested.
_SMALLER, _SMALLER_IF_RARE, _IN_TURN, _FEWEST = 0.5, 0.2, 0.8, 8


def _alternates(time: AnyArray, sheet: _sheet.Sheet, column: int, level: int) -> tuple[bool, bool]:
    """Return whether a column and the level alternate together, and whether they do so in a fixed order."""
    texts = np.array(sheet.texts(column), dtype=object)
    if column == level or not few(texts.tolist()) or len(texts) < _FEWEST:
        return False, False
    order = np.argsort(time, kind="stable")
    texts, values = texts[order], sheet.numbers(level)[order]
    changed, count = texts[1:] != texts[:-1], len({*texts.tolist()})
    if not changed.any() or len(texts) < 2 * count:
        return False, False
    within = np.concatenate([np.abs(np.diff(values[texts == text])) for text in {*texts.tolist()}])
    smaller = _SMALLER if changed.sum() >= _FEWEST else _SMALLER_IF_RARE
    alternates = _typical(within) < smaller * _typical(np.abs(np.diff(values))[changed])
    in_turns = min(changed.mean(), (texts[count:] == texts[:-count]).mean()) >= _IN_TURN
    return alternates, alternates and bool(in_turns)


def _typical(steps: FloatArray) -> float:
    known = steps[np.isfinite(steps)]
    return float(np.median(known)) if len(known) else np.nan


# Codes of operators, in which 0 is not a network. Other sources may count from 0.
_CODES = ("operator", "carrier", "provider", "plmn", "network", "mcc", "mnc", "query")


def _named(sheet: _sheet.Sheet, column: int) -> list[str]:
    """Return the texts of a column, empty where a text is not a name. 0 can name a device, but not a network."""
    meaning = sheet.meanings[column]
    code = meaning is not None and meaning.quantity.name == "network" and sheet.plain[column].startswith(_CODES)
    none = {*_sheet.NO_VALUE, *dictionary.TEXTS["no_identity"], *("0" if code else "")}
    written = sheet.texts(column)
    whole = {text: _FLOAT.sub(r"\1", text) for text in {*written}}
    texts = [whole[text] for text in written]
    # 'lw1', 'LW1' and 'LW-1' are the same tower; '3510 MHz' and '3.51 GHz' are the same carrier
    plain = {text: re.sub(r"(?<=[^\W\d])[-_ ](?=\d)", "", text.casefold()) for text in {*texts}}
    carriers = {text: attributes_of({sheet.plain[column]: text}).get("frequency_hz") for text in plain}
    plain |= {text: f"{hz:.9g}" for text, hz in carriers.items() if isinstance(hz, float)}
    plain |= (damaged := _damaged(Counter(texts), plain))
    for text in damaged:
        sheet.notes[column] = f"column {sheet.names[column]!r}: {text!r} is read as a damaged {plain[text]!r}"
    spelling = {plain[text]: text for text in reversed(texts) if text not in damaged}
    named = {text: "" if text.lower() in none else spelling[plain[text]] for text in {*texts}}
    return [named[text] for text in texts]


def _damaged(counts: Counter[str], plain: Mapping[str, str]) -> dict[str, str]:
    """Return the names in one row that differ from one frequent name only in characters that names do not have."""
    often = [text for text, count in counts.items() if count > _DAMAGE_ROWS]
    rare = [text for text, count in counts.items() if count == 1 and _DAMAGE.search(text)]
    like = {text: [*filter(re.compile(_DAMAGE.sub(".", text)).fullmatch, often)] for text in rare}
    return {text: plain[others[0]] for text, others in like.items() if len(others) == 1}


# A damaged character, and the number of rows of a frequent name.
_DAMAGE, _DAMAGE_ROWS = re.compile(r"[^\w\- .:/]|[\x80-\xff]"), 9
# Pandas writes integers of a column with missing values as floats.
_FLOAT = re.compile(r"^(\d+)\.0+$")


def cell_names(
    sheet: _sheet.Sheet, base: Sequence[str], about: dict[str, dict[str, Attribute]], *, nr: bool
) -> list[str]:
    """Return a name per row that distinguishes cells of one PCI and carrier.

    Parameters
    ----------
    sheet : Sheet
    base : sequence of str, length n
        PCI and carrier of each row.
    about : dict
        The attributes of each name are added to it.
    nr : bool
        True for NR cells, False for LTE cells.
    """
    texts = {i: _named(sheet, i) for i in cell_columns(sheet, nr=nr)}
    chosen = dividing_columns(texts, _with_level(sheet), base)
    sheet.used |= {i for i, values in _values(texts).items() if len(values) <= _MOST_PARTS}
    return labels(sheet, chosen, about)


def labels(sheet: _sheet.Sheet, columns: Sequence[int], about: dict[str, dict[str, Attribute]]) -> list[str]:
    """Return a name for each row from its identity columns, and add the attributes of each name to ``about``."""
    of_row, texts = [""] * len(sheet), {i: _named(sheet, i) for i in columns}
    # the same cell has the same name in 'CID 1' and 'CID 2'
    kinds = {i: m.quantity.name if (m := sheet.meanings[i]) else sheet.plain[i] for i in columns}
    for row in range(len(sheet)) if columns else ():
        written = {kinds[i]: texts[i][row] for i in columns if texts[i][row]}
        of_row[row] = "_".join(_label(name, text) for name, text in written.items())
        about.setdefault(of_row[row], attributes_of(written))
    return of_row


def attributes_of(written: Mapping[str, str]) -> dict[str, Attribute]:
    """Return the attributes of a part: its identities as written, and a frequency in Hz."""
    about: dict[str, Attribute] = {}
    for name, text in written.items():
        if _THOUSANDS.fullmatch(text) and "freq" in name and "ghz" not in name:  # 3,510 MHz: no UAV uses 3.51 MHz
            text = text.replace(",", "")
        value, unit = _SI.fullmatch(text.replace(",", ".")), re.search(r"\b[kmg](?=hz$)", name)
        if value is not None and ("freq" in name or name[:2] == "f ") and (value[2] or unit or float(value[1]) > 1e6):
            si = value[2] or (unit[0] if unit else "")
            about["frequency_hz"] = float(value[1]) * {"k": 1e3, "m": 1e6, "g": 1e9, "": 1.0}[si.lower()]
        else:
            about["node" if name in ("tower", "site") else name.replace(" ", "_")] = text
    return about


_THOUSANDS = re.compile(r"\d{1,2}(?:,\d{3})+(?:\.\d+)?")
_SI = re.compile(r"(\d{1,12}(?:\.\d{1,9})?) ?([kMG])?(?:Hz)?")


def _label(name: str, value: str) -> str:
    # the name must begin with a letter, such as 'sim1' instead of '1'
    word = re.sub(r"\W+", "_", value).strip("_")
    return word if word[:1].isalpha() else name.partition(" ")[0] + word

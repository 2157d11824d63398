"""The dictionary of columns: the meaning of a name in any log of any program, and its possible values.

:func:`meaning` returns the quantity of a column by its name: unit, numbers for missing values, possible range, role
(serving cell, n-th neighbour, uplink) and the datum of a height. ``PROGRAMS`` adds facts that do not follow from names:
units and datums that a program is known to write. The rows are in ``dictionary.yaml``. Add new names there.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..common.units import BoolArray, FloatArray
from .records import Kind

# Numbers that Android, modems, autopilots and scripts write for "not available". These numbers are the ends of integer
# types, including 28 bits (LTE cell identity) and 16 bits (MAVLink), and numbers like -999, which scripts write.
UNAVAILABLE = (2147483647.0, -2147483648.0, 9223372036854775807.0, 268435455.0, 65535.0, -32768.0, -999.0, -9999.0)
_ANY = (-np.inf, np.inf)


@dataclass(frozen=True, slots=True)
class Quantity:
    """A row of the dictionary.

    Parameters
    ----------
    name : str
        The usual term, or the column of the record model.
    role : str
        ``time``, ``position``, ``height``, ``angle``, ``velocity``, ``count``, ``doubt``, ``identity``, ``cell`` or a
        kind of stream: ``rss``, ``rank``, ``kpi``.
    names : tuple of str
        Patterns that are searched for in a simplified name (:func:`plain`), the preferred pattern first.
    unit : str
        Unit in which values are stored. It is also assumed for numbers without a unit.
    none : tuple of float
        Numbers that mean a missing value, in addition to those of :data:`UNAVAILABLE`.
    can_be : (low, high)
        Possible values in the unit of the quantity. A value outside this range belongs to another column.
    datum : str
        Zero of a height: ``take-off``, ``ground``, ``sea level``, ``ellipsoid`` or ``unknown``.
    open_unit : bool
        True if programs write the quantity in several units, so that the unit of plain numbers is unknown.
    """

    name: str
    role: str
    names: tuple[str, ...]
    unit: str = ""
    none: tuple[float, ...] = ()
    can_be: tuple[float, float] = _ANY
    datum: str = ""
    open_unit: bool = False

    @property
    def kind(self) -> Kind:
        """The kind of stream that a level, rank or KPI becomes."""
        return "rss" if self.role == "rss" else "rank" if self.role == "rank" else "kpi"


_FULL_SCALE = "dB re full scale"
# Words for a height, written as HEIGHT in the patterns of the file.
_HEIGHT = r"(alt|altitude|height|hgt|elevation|ele)"


def table(path: Path) -> Mapping[str, Any]:
    """Return a table that is part of this package, with every value as text."""
    # the C loader, which all wheels of PyYAML contain, reads the dictionary in 10 ms
    return dict(yaml.load(path.read_text(encoding="utf-8"), getattr(yaml, "CBaseLoader", yaml.BaseLoader)))


_FILE = table(Path(__file__).with_name("dictionary.yaml"))


def _quantity(row: Mapping[str, Any]) -> Quantity:
    low, high = map(float, row.get("range", _ANY))
    return Quantity(
        name=row["name"], role=row["role"], unit=row.get("unit", ""), datum=row.get("datum", ""),
        names=tuple(pattern.replace("HEIGHT", _HEIGHT) for pattern in row["names"]),
        none=tuple(map(float, row.get("missing", ()))), can_be=(low, high), open_unit="open_unit" in row,
    )  # fmt: skip


QUANTITIES = tuple(_quantity(row) for row in _FILE["quantities"])
# Expressions that are searched for in simplified names (:func:`plain`).
PATTERNS = {name: re.compile("".join(pieces)) for name, pieces in _FILE["patterns"].items()}
ZONES: Mapping[str, Mapping[str, Any]] = _FILE["zones"]
HINTS: Mapping[str, Sequence[str]] = _FILE["hints"]
FIXES: Mapping[str, str] = _FILE["fixes"]
TEXTS: Mapping[str, Sequence[str]] = _FILE["texts"]
IDLE: Mapping[str, Sequence[str]] = _FILE["idle"]
DATES: Sequence[str] = _FILE["dates"]
DAY_NUMBERS: Mapping[str, Sequence[str]] = _FILE["day_numbers"]
LIMITS: Mapping[str, Mapping[str, Sequence[str]]] = _FILE["limits"]
# Hours east of UTC, and a zone with summer time, of each meaning of an ambiguous abbreviation.
WINTER = {
    word: [(float(hours), zone) for zone, hours in meanings.items()] for word, meanings in ZONES["winter"].items()
}


@cache
def _forms() -> tuple[tuple[re.Pattern[str], Quantity], ...]:
    """Return one expression per row: for most names, a single search then excludes all patterns of the row."""
    return tuple((re.compile("|".join(f"(?:{pattern})" for pattern in row.names)), row) for row in QUANTITIES)


@dataclass(frozen=True, slots=True)
class Meaning:
    """The meaning of a column.

    Parameters
    ----------
    quantity : Quantity
    unit : str
        The unit in the name of the column, in lower case. Empty if there is none.
    rat : str
        ``lte``, ``nr`` or empty.
    place : str
        ``serving``, ``scell1``, ``n2`` (the second neighbour; ``n0`` if the name has no number), ``cell2``, ``sim2``.
    indirect : bool
        True for the uplink, a statistic or a model: such a level was not measured by the receiver.
    part : str
        ``mean`` for a level averaged over time, ``port`` for the level at a single receive port, empty for the level of
        the cell.
    """

    quantity: Quantity
    unit: str = ""
    rat: str = ""
    place: str = "serving"
    indirect: bool = False
    part: str = ""


_WORDS = {word: english for english, words in _FILE["translations"].items() for word in words}
# Latin and Cyrillic words are complete, Chinese, Japanese and Korean words have no spaces between them.
_COMPLETE, _WITHIN = (
    "|".join(word for word in sorted(_WORDS, key=len, reverse=True) if (word < "\u2e80") is complete)
    for complete in (True, False)
)
_TRANSLATED = re.compile(rf"(?<![^\W\d_])(?:{_COMPLETE})(?![^\W\d_])|{_WITHIN}|[\u3040-\u9fff\uac00-\ud7af]+")
# Headers copied from web pages contain zero-width spaces. Translated words may have underscores between them.
_LETTERS = str.maketrans({"\u200b": "", "_": " ", "\u00b5": "u", "\u03bc": "u"})


@cache
def plain(name: str) -> str:
    """Return a name in lower case and in English, with punctuation replaced by single spaces.

    Examples
    --------
    >>> plain("RSRP (LTE detected) - 1")
    'rsrp lte detected 1'
    >>> plain("H\u00f6he [m]"), plain("\u7ecf\u5ea6")
    ('height m', 'longitude')
    """
    if _WORD.search(name):
        name = _TRANSLATED.sub(lambda word: f" {_WORDS.get(word[0], 'other')} ", name.lower().translate(_LETTERS))
    return re.sub(r"[^a-z0-9]+", " ", name).strip()


# A letter, or a character that may be one in another script.
_WORD = re.compile(r"[A-Za-z]|[^\x00-\x7f]")


_BRACKETS = re.compile(r"[\[(\uff08]([^\[\]()\uff09]{1,24})[\])\uff09]")
_BRACKET = re.compile(_BRACKETS.pattern + r"\s*$")
# Boundaries between words in 'RsrpDbm' and 'RSRPDbm', but not in 'dBm' and 'eNB'.
_CAMEL = re.compile(r"(?<=[a-z])(?<!\b[a-z])(?<!_[a-z])(?<!d[bB]u)(?=[A-Z])(?!Bm?$)|(?<=[A-Z0-9])(?=[dD][bB][mM]?$)")
_A_UNIT = re.compile(r"(?!lte$|nr$|5g$|4g$|utc$|gps$|local$|dl$|ul$)[a-z\u00b5\u03bc%\u00b0]{1,7}(/[a-z]{1,3})?")


@cache
def meaning(name: str, words: str | None = None) -> Meaning | None:
    """Return the meaning of a name, or None if it is unknown.

    Parameters
    ----------
    name : str
        Name as written in the file, with its unit.
    words : str, optional
        Plain form of the name in common words, if the program uses words of its own.

    Examples
    --------
    >>> level = meaning("NB1_RSRP [dBm]")
    >>> level.quantity.name, level.unit, level.place
    ('RSRP', 'dbm', 'n1')
    """
    # return early for numbers and times, because sniffers test every cell of the first lines
    if words is None and not _WORD.search(name):
        return None
    bare, unit = without_unit(name)
    texts = [plain(name) if words is None else words]
    if not re.search("[a-z]", texts[0]):
        return None
    if texts[0] == plain(name):
        # 'Time (+02:00)'; 'heightAboveGround'
        texts += [bare, plain(in_brackets(name)[2]), plain(_CAMEL.sub(" ", name))]
    texts = [
        PATTERNS["joined_neighbour"].sub(r"neighbour \1 ", text).replace("  ", " ") for text in dict.fromkeys(texts)
    ]
    hits = ((row, text) for text in texts for form, row in _forms() if form.search(text))
    row, text = next(hits, (None, ""))
    if row is not None and row.role == "other":  # a name of a tower or antenna may precede that of a level
        row, text = next((hit for hit in hits if hit[0].role in ("rss", "rank", "kpi", "cell")), (None, ""))
    # 'rx [dBm]' is a level, not the name of a receiver
    if row is None or (row.role == "identity" and is_unit(unit)):
        return None
    if row.unit and unit in UNITS and (UNITS[unit][0] != row.unit) and row.role in ("position", "angle", "velocity"):
        unit = ""  # the W of 'Longitude (W)' is not watts, and the m of 'vel_n_m_s' is not metres
    rat = "nr" if has("nr", text) else "lte" if has("lte", text) else ""
    digits = PATTERNS["number"].search(re.sub(r"\b[45] ?g\b", "", text))
    number = next((group for group in digits.groups() if group), "0") if digits else "0"
    second = PATTERNS["secondary"].search(text)
    place = f"n{number}" if has("neighbour", text) else f"scell{second[1]}" if second else "serving"
    if place == "serving" and (other := PATTERNS["other"].search(text)):
        place = (other[1] or other[2] or f"cell{other[3]}").replace(" ", "")
    part = "mean" if has("mean", text) else "port" if has("port", text) else ""
    return Meaning(row, unit, rat, place, indirect=has("indirect", text), part=part)


# Words that are ignored when the names of an identity and a level are paired: statistics, radio access, serving cell.
_UNPAIRED = re.compile(
    rf"{PATTERNS['mean'].pattern}|\b(nr|ss|lte|4g|5g|cell|serving|primary|pcell|pscell|spcell|dbm?)\b"
)

_PAIRED = ("RSRP", "RSSI", "RSCP")
_OF_WHO = re.compile(r"\b(id|identity|name|no|num|number|index|address|addr)\b")


def _split(name: str, what: Meaning | None) -> tuple[str, str]:
    """Return the words that name a cell, without its PCI, and the words that an identity and a level have in common."""
    bare = re.sub(r"(?<=[a-z])(?=\d)", " ", without_unit(name)[0])
    who, is_quantity = PATTERNS["who"], what is not None and what.quantity.role != "identity"
    kind = "" if is_quantity else " ".join(part[0] for part in who.finditer(bare))
    form = next((form for form, row in _forms() if what and row.name == what.quantity.name), _OF_WHO)
    rest = _OF_WHO.sub(" ", who.sub(" ", form.sub(" ", bare)))
    return kind, " ".join(_UNPAIRED.sub(" ", rest).split())


def with_places(columns: Iterable[tuple[str, Meaning | None]]) -> list[Meaning | None]:
    """Return the meanings of columns.

    A level and an identity get the same ``place`` if all other words of their names are the same.

    If a place has several identities, such as "PCI A" and "PCI B", it has several cells: "RSRP A" is the level of the
    first cell.

    Examples
    --------
    >>> names = ["PCI A", "RSRP A", "PCI B", "RSRP B"]
    >>> [what.place for what in with_places([(name, meaning(name)) for name in names])]
    ['cell a', 'cell a', 'cell b', 'cell b']

    Other identities, such as "CID_1" or "AP1", have the role ``mark`` if at least two share the words of a level:

    >>> names = ["AP1", "RSSI1", "AP2", "RSSI2"]
    >>> [(what.quantity.role, what.place) for what in with_places([(name, meaning(name)) for name in names])]
    [('mark', 'cell1'), ('rss', 'cell1'), ('mark', 'cell2'), ('rss', 'cell2')]
    """
    named = [(*_split(name, what), what) for name, what in columns]
    levels = {rest: what for _, rest, what in named if what and what.quantity.name in _PAIRED}
    marked = {rest for kind, rest, _ in named if kind and rest in levels}
    marked = marked if len(marked) > 1 else set()
    words = [rest for _, rest, _ in named]
    known = [
        replace(levels[rest], quantity=Quantity(kind, "mark", ())) if kind and rest in marked else what
        for kind, rest, what in named
    ]
    cells: dict[tuple[str, str], dict[str, set[str]]] = {}
    for rest, what in zip(words, known, strict=True):
        if what is not None and (what.quantity.name in (*_PAIRED, "PCI") or what.quantity.role == "mark"):
            role = "level" if what.quantity.name in _PAIRED else "identity"
            cells.setdefault((role, what.place), {}).setdefault(rest, set()).add(what.rat)
    placed = []
    for rest, what in zip(words, known, strict=True):
        shared = {} if what is None else cells.get(("identity", what.place), {})
        if what is not None and rest in shared and rest in cells.get(("level", what.place), {}):
            several = any(shared[rest] & rats for other, rats in shared.items() if other != rest)
            # a "target" with an identity is the target cell of a handover; without an identity, it is the target of a
            # model
            indirect = what.indirect and has("indirect", rest.replace("target", ""))
            what = replace(what, place=f"cell {rest}" if several and rest else what.place, indirect=indirect)
        placed.append(what)
    return placed


@cache
def without_unit(name: str) -> tuple[str, str]:
    """Return the plain name without its unit, and the unit in lower case or an empty text.

    Examples
    --------
    >>> without_unit("Height [ft]"), without_unit("rsrp_dbm"), without_unit("latE7"), without_unit("Time (EDT)")
    (('height', 'ft'), ('rsrp', 'dbm'), ('lat', 'e7'), ('time edt', 'edt'))
    >>> without_unit("Altitude (ft) MSL"), without_unit("alt_ft_agl"), without_unit("altFt")
    (('altitude msl', 'ft'), ('alt agl', 'ft'), ('alt', 'ft'))
    """
    unit, _zone, rest = in_brackets(name)
    if unit:
        return plain(rest) if is_unit(unit) else plain(name), unit
    words = plain(_CAMEL.sub(" ", name))
    end = re.fullmatch(r"(.+?)(?: ?1?)(e ?[67])", words)
    if end is not None:
        return end[1], end[2].replace(" ", "")
    inside = re.fullmatch(rf"(.+?)(?: in)? ({'|'.join(_SUFFIXES)})( (?!s\b).+)?", words)
    return (inside[1] + (inside[3] or ""), inside[2]) if inside is not None else (plain(name), "")


def in_brackets(name: str) -> tuple[str, str, str]:
    """Return the unit in brackets, other text in brackets at the end, and the name without brackets."""
    unit = next((inner for inner in _BRACKETS.finditer(name) if is_unit(inner[1])), None)
    if unit is not None:
        return unit[1].lower(), "", f"{name[: unit.start()]} {name[unit.end() :]}"
    written = _BRACKET.search(name)
    if written is None:
        return "", "", name
    inside, rest = written[1].strip(), name[: written.start()]
    words = inside.split()
    if len(words) == 2 and is_unit(words[0]):  # 'Altitude (ft MSL)'
        return words[0].lower(), words[1], rest
    if is_unit(inside) or _A_UNIT.fullmatch(inside.lower()):
        return inside.lower(), "", rest
    return "", inside, rest


def rank_of(quantity: Quantity, words: str) -> tuple[int, int]:
    """Return the position of a plain name in the order of preference: first by row, then by pattern."""
    fits = [i for i, pattern in enumerate(quantity.names) if re.search(pattern, words)]
    # use ellipsoid heights only if there is no other height: at Lake Wheeler, they differ from heights above sea level
    # by 33 m
    last = len(QUANTITIES) * (quantity.datum == "ellipsoid")
    return QUANTITIES.index(quantity) + last, fits[0] if fits else len(quantity.names)


def is_none(quantity: Quantity, values: FloatArray) -> BoolArray:
    """Return the mask of numbers that mean a missing value."""
    return np.isin(values, (*UNAVAILABLE, *quantity.none))


def impossible(quantity: Quantity, values: FloatArray) -> BoolArray:
    """Return the mask of values that a quantity cannot have, such as fractions of identities."""
    beyond = (values < quantity.can_be[0]) | (values > quantity.can_be[1])
    if quantity.role == "cell":
        beyond |= np.isfinite(values) & (values != np.round(values))
    return beyond & ~is_none(quantity, values)


def angle_form(values: FloatArray, quantity: Quantity) -> str:
    """Return the unit of positions that are too large for degrees: ``1e-7 deg``, ``ddmm.mmmm`` or an empty text."""
    # ignore zeros, which rows before the first fix contain
    known = np.abs(values[np.isfinite(values) & ~is_none(quantity, values) & (values != 0)])
    most = quantity.can_be[1]
    # use the median, because a few damaged rows do not prove another unit
    if not len(known) or np.median(known) <= most:
        return ""
    if (known == np.round(known)).all() and np.median(known) > 1e5 and known.max() <= most * 1e7:
        return "1e-7 deg"
    # minutes are below 60, and at most three digits of degrees precede them
    if known.max() <= 100 * most and (known % 100 < 60).all():
        return "ddmm.mmmm"
    return ""


# --- units ------------------------------------------------------------------------------------------------------------


def _times(factor: float) -> Callable[[FloatArray], FloatArray]:
    return lambda values: values * factor


def _milliwatts(per_unit: float) -> Callable[[FloatArray], FloatArray]:
    def convert(values: FloatArray) -> FloatArray:
        # allow zeros, which have no level in dB, and negative values, which are not powers
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(values >= 0, 10 * np.log10(np.where(values > 0, values, np.nan) * per_unit), np.nan)

    return convert


# Voltages that are levels in a receiver of 50 ohm: 0 dBm are 0.224 V, 106.99 dBuV.
ACROSS_50_OHM = ("dbuv", "db\u00b5v", "db\u03bcv")
_DBUV_OF_0_DBM = 90 + 10 * float(np.log10(50.0))

# Units that a name or a cell may have, by the unit after conversion, with their factors.
_FACTORS = {unit: {word: float(factor) for word, factor in words.items()} for unit, words in _FILE["units"].items()}
# Units of power, by their number of milliwatts. Powers are converted to dBm.
_POWERS = {"mw": 1.0, "w": 1e3, "uw": 1e-3, "\u00b5w": 1e-3, "nw": 1e-6, "pw": 1e-9}
# For each unit, the unit after conversion, and the function that converts values to it.
UNITS: dict[str, tuple[str, Callable[[FloatArray], FloatArray]]] = {
    **{word: (unit, _times(factor)) for unit, words in _FACTORS.items() for word, factor in words.items()},
    **{word: ("dBm", _milliwatts(factor)) for word, factor in _POWERS.items()},
    **{word: ("dBm", lambda values: values - _DBUV_OF_0_DBM) for word in ACROSS_50_OHM},
    "dbw": ("dBm", lambda values: values + 30.0),
    "linear": ("dB", _milliwatts(1.0)),
}
# Units of MAVLink's integers. A converter that writes decimals has already scaled the values.
OF_INTEGERS = ("mm", "cm/s", "cdeg", "e7", "semicircles")
_DDMM = ("ddmm.mmmm", "dddmm.mmmm", "ddmm.mmmmm", "dddmm.mmmmm", "ddmm.mm", "dddmm.mm", "nmea")
_SUFFIXES = _FILE["suffixes"]


# A factor before a unit: '0.1 dBm', '1e-7 deg'.
_SCALED = re.compile(r"(0\.0{0,8}1|1?e-\d{1,2}) ?\*? ?([a-z\u00b0\u00b5\u03bc].{0,20})")


def is_unit(text: str) -> bool:
    """Check whether a text is a unit from which values can be converted."""
    unit = _scale(text.lower())[1]
    return unit in UNITS or unit in _DDMM


def _scale(written: str) -> tuple[float, str]:
    """Return the factor before a unit (1 if there is none) and the unit."""
    scaled = _SCALED.fullmatch(written)
    if scaled is None:
        return 1.0, written
    return float(f"1{scaled[1]}" if scaled[1].startswith("e") else scaled[1]), scaled[2]


def unit_of(written: str) -> str:
    """Return the unit to which a written unit is converted, an unknown unit as written, else an empty text."""
    written = _scale(written)[1]
    known = UNITS.get(written)
    if known or written in _DDMM:
        return known[0] if known else "deg"
    return written if written in _FACTORS or _A_UNIT.fullmatch(written) else ""


def converted(values: FloatArray, written: str) -> FloatArray:
    """Return values of a written unit in the unit of the dictionary."""
    if written in _DDMM:
        degrees = np.trunc(values / 100)  # NMEA format: ddmm.mmmm
        return np.asarray(degrees + (values - 100 * degrees) / 60)
    factor, unit = _scale(written)
    return UNITS[unit][1](values * factor if factor != 1 else values) if unit in UNITS else values


# --- programs ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Program:
    """A program that is recognised by its columns, with its known words, units and datums.

    Parameters
    ----------
    name : str
    signs : collection of str
        Sets of plain names. A table that has all names of one set was written by this program.
    words : mapping of str to str
        Patterns of the names that the program writes, matched against complete plain names, and the words of the
        dictionary for these names.
    units : mapping of str to str
        Units of plain names without a unit in brackets. The name ``time`` means the clock.
    datum : str
        Datum of heights whose name does not contain a datum.
    angles : str
        Unit of angles.
    """

    name: str
    signs: tuple[frozenset[str], ...]
    words: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    datum: str = ""
    angles: str = ""


PROGRAMS = tuple(
    Program(**{**row, "signs": tuple(frozenset(names) for names in row["signs"])}) for row in _FILE["programs"]
)
_SIGNS = frozenset[str]().union(*(sign for known in PROGRAMS for sign in known.signs))
AERPAW_MAT = next(known for known in PROGRAMS if known.name == "AERPAW .mat")


def names_a_cell(words: str, *, alone: bool = False) -> bool:
    """Check whether a plain name names a cell, an antenna or a beam, without other words if ``alone``."""
    return PATTERNS["of_a_cell"].fullmatch(words) is not None or (not alone and has("cell_id", words))


def like_levels(names: Iterable[str]) -> list[str]:
    """Return the unknown names that may be levels, except electric power next to a voltage."""
    words = {name: plain(_CAMEL.sub(" ", name)) for name in names}
    electric = any(re.search(r"volt|batt|\bcurrent", text) for text in words.values())
    return [
        name for name, text in words.items()
        if has("like_a_level", text) and not has("unlike_a_level", text)
        and not (electric and re.fullmatch(r"(.* )?(power|pwr)( m?w)?", text))
    ]  # fmt: skip


def has(kind: str, words: str) -> bool:
    """Check whether plain words contain the pattern of a kind, such as ``gain``."""
    return PATTERNS[kind].search(words) is not None


def is_statistic(name: str) -> bool:
    """Check whether a name contains a word for a mean, a maximum, a prediction or a raw level."""
    return any(has(kind, plain(name)) for kind in ("mean", "indirect", "raw"))


def can_be_level(name: str) -> bool:
    """Check whether the unit in a name, if it is known, is a unit of levels, and not of field strengths or heights."""
    return UNITS.get(without_unit(name)[1], ("dBm",))[0] in ("dBm", "dB", _FULL_SCALE)


def program(names: Collection[str]) -> Program | None:
    """Return the program that wrote a table with such plain names, or None if no program is recognised."""
    present = set(names)
    if present.isdisjoint(_SIGNS):  # fast exit, because sniffers test lines of any kind
        return None
    return next((item for item in PROGRAMS if any(sign <= present for sign in item.signs)), None)


# The name of a MAVLink or DataFlash message in front of its fields: 'GLOBAL_POSITION_INT.lat'.
_MESSAGE = re.compile(r"[A-Z][A-Z\d_]{2,}\.(?=\w)")


def described(
    names: Iterable[str], *, known: Program | None = None, of: Collection[str] = ()
) -> tuple[Program | None, list[tuple[Meaning | None, str, str]]]:
    """Return the program of a table and, per name, its meaning, its unit and its plain form in common words.

    Parameters
    ----------
    names : iterable of str
        Names as written in the file.
    known : Program, optional
        The program, if the caller knows it.
    of : collection of str
        Further names that identify the program.
    """
    names = [*names]
    if len({found[0] for found in map(_MESSAGE.match, names) if found}) == 1:  # all fields are of one message
        bare_names = [_MESSAGE.sub("", name) for name in names]
        names = bare_names if len({*bare_names}) == len({*names}) else names
    own = [(name, plain(name)) for name in names]  # use a list, because a table may have a name twice
    present = [bare for _, bare in own]
    known = known or program([*present, *map(plain, of)])
    words, columns = dict(known.words) if known else {}, []
    angles = any(re.match(r"az|alt", bare) for bare in present)
    if "rank" in present and not words and any((m := meaning(name)) and m.quantity.kind != "kpi" for name in present):
        words = {"rank": "rank indicator"}  # without levels, 'rank' may be the position in a list
    for name, bare in own:
        forms = (re.sub(form, word, bare) for form, word in words.items() if re.fullmatch(form, bare))
        common = next(forms, bare)
        if common == bare and not meaning(bare) and meaning(name):
            bare = common = plain(_CAMEL.sub(" ", name))  # 'RecordedAt' is 'recorded at'
        what = meaning(name, None if common == bare else common)
        if what is not None and what.quantity.name == "quality" and common == bare:
            what = None  # only AERPAW's sounder has a quality in dB, other link qualities are percentages
        if bare.startswith("elev") and (angles or "deg" in bare):
            what = None  # an angle next to an azimuth, or the ground next to an altitude
        unit = what.unit if what else without_unit(name)[1]
        if known and (not unit or bare in known.units):
            unit = known.units.get(bare, known.angles if what and what.quantity.role == "angle" else "")
        columns.append((what, unit, common))
    return known, columns


def record_columns(
    fields: Mapping[str, FloatArray], *, integers: Collection[str] = (), of: Collection[str] = ()
) -> dict[str, FloatArray]:
    """Return the columns of the record model, in its units, from the fields of a message or of a file.

    Parameters
    ----------
    fields : mapping of str to float array, shape (n,)
    integers : collection of str
        Names of integer fields: only these have the units of integers (mm, 1e-7 deg).
    of : collection of str
        Further names that identify the program.

    Returns
    -------
    dict of str to float array, shape (n,)
        If several fields have the same quantity, only the preferred field. Heights above take-off are ``above_home_m``.
    """
    columns: dict[str, tuple[tuple[int, int], FloatArray]] = {}
    for name, (what, unit, words) in zip(fields, described(fields, of=of)[1], strict=True):
        if what is None or what.quantity.role not in ("position", "height", "angle", "velocity", "count"):
            continue
        row = what.quantity
        # decimals were written by a converter, which has already scaled the values
        unit = "" if unit in OF_INTEGERS and name not in integers else unit
        # 65535 mm may be a height: only the ends of the integer type mean a missing value
        none = np.abs(fields[name]) >= UNAVAILABLE[0] if unit in ("mm", "e7") else is_none(row, fields[name])
        values = np.where(none, np.nan, fields[name])
        if row.role == "position" and not unit:
            unit = angle_form(values, row)
        column = "above_home_m" if row.datum == "take-off" else row.name
        place = rank_of(row, words)
        if column not in columns or place < columns[column][0]:
            columns[column] = place, converted(values, unit)
    return {column: values for column, (_, values) in columns.items()}

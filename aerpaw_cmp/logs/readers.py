"""The interface of readers, and the search for the reader of a file.

A reader is a pure function of bytes, and opens no file or port. Each format module builds one :class:`Reader` and
lists it in the catalogue that the entry-point group ``aerpaw_cmp.readers`` names.

The clock, the height datum and the identity of each stream are either written in the file, known from its program, or
assumed.

Attributes ``clock_from``, ``height_from`` (streams with altitudes) and ``identity_from`` (levels and ranks) are one of
``written``, ``program``, ``assumed``; ``clock_source`` and ``height_source`` describe the program or the assumption.
Values in flight.yaml count as written. ``ingest --draft`` asks about assumed values.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal

from ..common.errors import AerpawCmpError, InputError, UsageError, one_line
from ..common.text import decoded
from .records import Attribute, Kind, ReadResult, Stream

ENTRY_POINT_GROUP = "aerpaw_cmp.readers"
# Number of bytes of a file that sniffers see first.
HEAD_BYTES = 65_536
# Number of bytes that sniffers see if no log reader recognises the first ``HEAD_BYTES``.
DEEP_BYTES = 4 << 20

# A function that reads a log from pieces of complete lines, with a result that does not depend on their size.
_ReadPieces = Callable[[Iterable[bytes], "ReadOptions"], ReadResult]


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Facts that are not in a file. All are optional, and a reader uses those that it needs.

    Parameters
    ----------
    timezone : str, optional
        IANA zone of clocks without a zone. A reader raises ``UsageError`` if it needs the zone.
    clock : {"local", "utc", "local_as_utc"}, optional
        Overrides the reader's own rule; ``local_as_utc`` is local wall time that was stored as if it were UTC.
    time_origin : str, optional
        ISO time (with zone, or local in ``timezone``) of a log whose times are relative.
    gps_rollovers : int
        How often the week number of the log's GPS receiver has rolled over. Each rollover adds 1 024 weeks to the
        times.
    ri_base : {"zero", "one"}, optional
        Number that the program prints for rank 1. Readers of formats with a fixed base ignore it.
    columns : mapping, optional
        Name of the file column for each record column, only for generic CSV.
    read_elsewhere : collection of str
        Columns of the same file that the user reads with other options. These columns do not need a warning.
    kind : str, optional
        Kind of stream, only for generic CSV.
    node, channel : str, optional
        Tower and channel to which the log belongs.
    frequency_hz : float, optional
        Carrier frequency [Hz].
    unit : {"dBm", "dBFS", "dB"}, optional
        Unit of RSS, if the file does not specify it. ``dBFS`` is stored as ``dB re full scale``; ``dB`` is a ratio.
    floor_db : float
        RSS at or below this is out of coverage.
    file_name : str
        Name of the log without folders, set by ``ingest``, for formats whose content is ambiguous.
    neighbour : callable, optional
        Function that returns the content of another file in the log's folder by its name, or None if it is missing. Set
        by ``ingest``, for formats with samples in a second file.

    Raises
    ------
    UsageError
        If ``unit`` has another value.
    """

    timezone: str | None = None
    clock: Literal["local", "utc", "local_as_utc"] | None = None
    time_origin: str | None = None
    gps_rollovers: int = 0
    ri_base: Literal["zero", "one"] | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    read_elsewhere: Collection[str] = ()
    kind: Kind | None = None
    node: str | None = None
    channel: str | None = None
    frequency_hz: float | None = None
    unit: str | None = None
    floor_db: float = -200.0
    file_name: str = ""
    neighbour: Callable[[str], bytes | None] | None = None

    def __post_init__(self) -> None:
        """Convert the unit to the form in which logs are stored, or refuse it."""
        known = None if self.unit is None else _LEVEL_UNITS.get(self.unit.lower())
        if self.unit is not None and known is None:
            raise UsageError(
                f"the unit {self.unit!r} of levels",
                expected="dBm, dBFS or dB (a ratio to the noise)",
                cause="a linear unit belongs in the name of the column, such as power_mw, and is converted",
            )
        object.__setattr__(self, "unit", known)


_LEVEL_UNITS = {"dbm": "dBm", "dbfs": "dB re full scale", "db re full scale": "dB re full scale", "db": "dB"}


ASSUMED_CLOCK, ASSUMED_HEIGHT = "assumed: local wall time", "assumed: above take-off"


@dataclass(frozen=True, slots=True)
class Reader:
    """One log format.

    Parameters
    ----------
    name : str
        Short, lower case, used in flight.yaml.
    title : str
        One line for ``aerpaw-cmp formats``.
    kinds : tuple of str
        Kinds of stream that the reader can return. Empty for known files that are not logs; ``title`` describes them.
    sample : str
        One typical line.
    sniff : callable
        ``sniff(head: bytes) -> bool``. The function tests only the content, never the file name, and must not raise an
        exception.
    read : callable
        ``read(data: bytes, options: ReadOptions) -> ReadResult``.
    pieces : bool
        True if a file of a few records is a piece of the log in its folder.
    read_pieces : callable, optional
        ``read_pieces(pieces, options) -> ReadResult``: the same as ``read``, but from pieces of complete lines, for
        logs larger than memory; see :mod:`aerpaw_cmp.logs.files`.
    clock_from, height_from : str
        ``written``, ``program: which``, or ``assumed: what``; see :mod:`aerpaw_cmp.logs.readers`. An attribute
        of this name in a stream has precedence.
    plugin : str
        Entry point of a third-party reader, set by :func:`catalogue`.
    """

    name: str
    title: str
    kinds: tuple[Kind, ...]
    sample: str
    sniff: Callable[[bytes], bool]
    read: Callable[[bytes, ReadOptions], ReadResult]
    pieces: bool = False
    read_pieces: _ReadPieces | None = None
    clock_from: str = ASSUMED_CLOCK
    height_from: str = ASSUMED_HEIGHT
    plugin: str = ""


@contextmanager
def blaming(plugin: str, doing: str, kind: type[AerpawCmpError] = UsageError) -> Iterator[None]:
    """Name the plug-in in errors that its code raises. An empty name, as for our readers, is not added."""
    try:
        yield
    except Exception as error:
        if not plugin or isinstance(error, AerpawCmpError):
            raise
        raise kind(
            f"the plug-in {plugin!r} failed when {doing} ({type(error).__name__}: {one_line(str(error)[:200])})",
            expected="readers as in docs/adding_a_reader.md",
            cause="an error in the plug-in: update or uninstall it",
        ) from error


@cache
def catalogue() -> tuple[Reader, ...]:
    """Return all readers of the entry-point group, read once.

    Raises
    ------
    UsageError
        If the group is empty, two readers share a name, or a plug-in cannot be loaded.
    """
    from importlib.metadata import entry_points

    readers: list[Reader] = []
    for point in entry_points(group=ENTRY_POINT_GROUP):
        plugin = "" if point.value.startswith("aerpaw_parsers:") else point.name
        with blaming(plugin, "it was loaded"):
            readers += [replace(reader, plugin=plugin) for reader in point.load()]
    if not readers:
        raise UsageError(
            f"no readers are installed under the entry-point group {ENTRY_POINT_GROUP!r}",
            cause="the package was not installed: run 'pip install -e .' in the checkout",
        )
    names = [reader.name for reader in readers]
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise UsageError(f"two installed readers share the name {double[0]!r}", expected="unique reader names")
    return tuple(readers)


def _accepts(reader: Reader, head: bytes) -> bool:
    with blaming(reader.plugin, f"reader {reader.name!r} tested a file"):
        return reader.sniff(head)


def by_name(name: str) -> Reader:
    """Return the reader with a name, or raise ``UsageError`` with the known names."""
    known = {reader.name: reader for reader in catalogue()}
    if name not in known:
        raise unknown_name(f"unknown reader {name!r}", name, sorted(known))
    return known[name]


def unknown_name(found: str, name: str, known: Sequence[str]) -> UsageError:
    """Return the error for an unknown name, with the known names and the most similar one."""
    from difflib import get_close_matches

    near = get_close_matches(name, known, 1)
    cause = f"did you mean {near[0]!r}?" if near else None
    return UsageError(found, expected=f"one of {', '.join(known)}", cause=cause)


_BLANK_LINES = re.compile(rb"\A(?:[ \t]*\r?\n)+")


def claims(data: bytes) -> list[Reader]:
    """Return the readers whose sniffers accept the beginning of a file, without blank lines before it.

    If no reader of logs accepts the first ``HEAD_BYTES``, the sniffers get ``DEEP_BYTES``, because the first typical
    line of a console or a KML may come late. Readers of files that are not logs are tried last.
    """
    data = _BLANK_LINES.sub(b"", data[:DEEP_BYTES])
    heads = (data[:HEAD_BYTES], data) if len(data) > HEAD_BYTES else (data,)
    # try log readers first, with few bytes and then with more, because a page of text may quote a log
    tried = [(head, True) for head in heads] + [(head, False) for head in reversed(heads)]
    accepting = ([r for r in catalogue() if bool(r.kinds) is of_logs and _accepts(r, head)] for head, of_logs in tried)
    return next((readers for readers in accepting if readers), [])


def identify(data: bytes, *, path: str | None = None) -> Reader:
    """Return the single reader whose sniffer accepts the content.

    Raises
    ------
    InputError
        If no reader or several readers accept the content, or if it is empty or a Git-LFS pointer.
    """
    if not data.strip():
        raise InputError("the file is empty", expected="log lines", cause="an aborted run", path=path)
    head = data[:HEAD_BYTES]
    # test this before any sniffer, because no reader would recognise the text of a pointer
    if head.startswith(b"version https://git-lfs"):
        raise InputError(
            "a Git-LFS pointer instead of the data",
            expected="the log itself",
            cause="the repository was cloned without 'git lfs pull'",
            path=path,
        )
    known = claims(data)
    if known and not known[0].kinds:
        found = f"not a log: {known[0].title}"
        raise InputError(found, expected="one of the formats of 'aerpaw-cmp formats'", path=path)
    if len(known) == 1:
        return known[0]
    if known:
        names = ", ".join(reader.name for reader in known)
        raise InputError(
            f"several readers accept this content: {names}",
            expected="exactly one",
            cause="name one with 'reader:' in flight.yaml or --reader",
            path=path,
        )
    binary, shown = b"\0" in head, ascii(head.lstrip().split(b"\n", 1)[0][:80].decode(errors="replace"))
    raise InputError(
        "binary content that no reader recognises" if binary else f"no reader recognises this content: {shown}",
        expected="one of the formats of 'aerpaw-cmp formats'",
        cause="another kind of file, or a damaged one" if binary else _advice(head),
        path=path,
    )


def _advice(head: bytes) -> str:
    lines = [decoded(line).strip() for line in head.lstrip(b"\xef\xbb\xbf \r\n").split(b"\n")[:30]]
    # take the most frequent sign as the separator, because decimal commas are rarer
    sign = max(",;\t|", key="".join(lines).count)
    rows = [line.strip("# ").split(sign if any(sign in line for line in lines) else None) for line in lines]
    # a header has as many fields as the row below it, and only the row contains numbers; settings are above the header
    valued = [any(map(_NUMBER.match, row)) for row in rows]
    heads = [i for i in range(len(rows) - 1) if valued[i : i + 2] == [False, True] and len(rows[i]) == len(rows[i + 1])]
    at = max(heads[::-1] or range(len(rows)), key=lambda i: (len(rows[i]), lines[i][:1] != "#"))
    first, names = lines[at], [name.strip().strip('"') for name in rows[at]]
    table = (heads or sign in first) and not any(name[:1].isdigit() for name in names)
    if table and len(names) > 1 and not first.startswith(("{", "[", "<", "$")):
        if len(head) == HEAD_BYTES and b"\n" not in head:
            return f"no line ends in the first {HEAD_BYTES >> 10} KiB: an aborted copy, or not a table"
        if "\ufffd" in first:
            return "text in another encoding than UTF-8: save the table as UTF-8"
        return _mapping_advice(names, rows[at + 1 :])
    words = re.split(r"[,;\s|]+", first)
    if len(words) > 1 and (re.fullmatch(r"[-+.\d]+", words[0] + words[-1]) or "time" in words):
        return "a table without names or commas: write a line such as 'time,rss_db' above it, commas between its cells"
    return "a log of a kind that is not supported: docs/adding_a_reader.md"


_NUMBER = re.compile(r'[ "]*[-+]?\d')
_NEGATIVE = re.compile(r'[ "]*-\d{1,3}(\.\d*)?[ "]*')


def _mapping_advice(names: list[str], rows: Sequence[Sequence[str]]) -> str:
    """Return the options that read an unknown table, if its names or cells may contain a track or a level."""
    from . import dictionary

    elsewhere = next(row.names[0] for row in dictionary.QUANTITIES if row.name == "elsewhere")
    known = [*map(dictionary.meaning, names)]
    rows = [row for row in rows if len(row) == len(names)]
    levels = [
        name for i, name in enumerate(names)
        if not known[i] and rows and all(_NEGATIVE.fullmatch(row[i]) for row in rows)
        and not dictionary.has("unlike_a_level", dictionary.plain(name))
    ]  # fmt: skip
    in_dbm = {name: dictionary.without_unit(name)[1] == "dbm" for name in names}
    means = [name for name in names if in_dbm[name] and dictionary.has("statistic_of_a_level", dictionary.plain(name))]
    times = [name for i, name in enumerate(names) if rows and all(dictionary.has("dated", row[i]) for row in rows)]
    names = [name for name in names if not re.search(elsewhere, dictionary.plain(name))]
    fits = {
        what: [name for words in forms for name in names if re.search(words, dictionary.plain(name))]
        for what, forms in dictionary.HINTS.items()
    } | {"rss_db": [name for name in dictionary.like_levels(names) if dictionary.can_be_level(name)] or levels or means}
    fits["time"] = fits["time"] or times
    ranks = [name for name in names if dictionary.has("like_a_rank", dictionary.plain(name))]
    fits["rss_db"].sort(key=lambda name: (dictionary.is_statistic(name), not in_dbm[name], "rx" not in name.lower()))
    if fits["time"] and {"roll_deg", "pitch_deg"} <= {what.quantity.name for what in known if what}:
        return "angles without positions: write them into the table of the positions, at the same times"
    if ranks and fits["time"] and not fits["rss_db"]:
        return f"a table of another kind: name its columns: --map {fits['time'][0]!r}=time --map {ranks[0]!r}=rank"
    if not fits["time"] or not (fits["rss_db"] or all(fits[what] for what in dictionary.HINTS)):
        lacking = " or ".join(what for what in ("time", "rss_db") if not fits[what])
        return f"a table of another kind; no column looks like {lacking}"
    if not (fits["latitude_deg"] and fits["longitude_deg"]):
        fits = {what: fits[what] for what in ("time", "rss_db")}
    pairs = [f"--map {named[0]!r}={what}" for what, named in fits.items() if named]
    others = f"; other columns: {', '.join(map(repr, fits['rss_db'][1:4]))}" if fits["rss_db"][1:] else ""
    return f"a table of another kind: name its columns: {' '.join(pairs)}{others}"


def stated(result: ReadResult, reader: Reader, options: ReadOptions) -> ReadResult:
    """Return a result whose streams have the sources of their clock, height and identity."""
    streams = tuple(
        replace(stream, attributes={**stream.attributes, **_origins(stream, reader, options)})
        for stream in result.streams
    )
    return replace(result, streams=streams)


def _origins(stream: Stream, reader: Reader, options: ReadOptions) -> dict[str, Attribute]:
    about = stream.attributes
    attributes: dict[str, Attribute] = {}
    if "clock_from" not in about:
        attributes |= _split("clock", _clock(stream, reader, options))
    if "height_from" not in about and "altitude_m" in stream.frame and stream.frame["altitude_m"].notna().any():
        attributes |= _split("height", reader.height_from)
    if stream.kind in ("rss", "rank") and "identity_from" not in about:
        # a cell or a connection identifies a stream as well as the name of a node does
        named = any(key in about for key in ("node", "pci", "rnti")) or options.node is not None
        attributes["identity_from"] = "written" if named else "assumed"
    return attributes


def _clock(stream: Stream, reader: Reader, options: ReadOptions) -> str:
    if options.clock is not None:
        return "written"
    if stream.attributes.get("clock") == "relative":
        return "assumed: the times are relative, from an unknown origin"
    return reader.clock_from


def _split(what: str, text: str) -> dict[str, Attribute]:
    """Split a text such as ``program: datetime.now()`` into two attributes."""
    word, _, source = text.partition(": ")
    return {f"{what}_from": word, **({f"{what}_source": source} if source else {})}


def named_tower(path: str, towers: Sequence[str]) -> str | None:
    """Return the tower of the site whose name is in a path (``lw-1`` is LW1), the last tower if there are several."""
    places = {}
    for tower in towers:
        letters = "[-_ ]?".join(map(re.escape, re.findall(r"\d+|[^\W\d_]+", tower)))
        # match complete names: LW12 is not LW1, and ACCESS does not contain the tower CC
        ends = r"(?!\d)" if tower[-1:].isdigit() else r"(?![^\W_])"
        for match in re.finditer(rf"(?<![^\W_]){letters}{ends}" if letters else r"(?!)", path, re.IGNORECASE):
            places[match.start()] = tower
    # use the last tower, because file names come after folders
    return places[max(places)] if places else None

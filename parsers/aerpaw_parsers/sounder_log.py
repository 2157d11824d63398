"""GNU Radio channel sounder logs (``power_log``, ``quality_log``, ``snr_log``): ``od -f -w4`` through ``ts``.

``[2025-01-01 12:00:00.000000] 0000014      -35.401386``: arrival time, **octal** byte offset of the sample (four bytes
each), value in dB re full scale. ``*`` replaces samples that are equal to the sample before them. The last line may
contain only an offset. Without a signal, the power is 20 log10(FLT_MIN) minus the gain, about -790 dB. Writer: AERPAW
``startGNURadio-ChannelSounder-RX.sh``. Files of nightly soundings between towers name the link in the file name:
``LW1:LW2:3235751:3.32G:0:2026-06-01_02_00_05:power_log.txt`` (transmitter or ``null``, receiver, radio, channel).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray, IntArray
from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.files import Column
from aerpaw_cmp.readers import KEPT_REJECTED, Reader, ReadOptions, ReadResult, Stream, counted

from . import _identity

_STAMP = 28  # "[" + 26 characters of time + "]"
_VALUE = 16  # od -f: right-aligned in sixteen columns
_WIDTHS = range(7, 13)  # octal digits of the offset; seven until 2 MiB of samples, ten from 128 MiB on
_MOST_REPEATS = 5_000_000  # two days at 30 samples per second; only a damaged offset implies more
_HEAD = rb"^\[(" + _text.TIME + rb")\] "
# A sample, a '*' (no offset) or a last line (no value).
_LINE = re.compile(_HEAD + rb"+(?:\*|([0-7]{7,12})(?: +(" + _text.NUMBER + rb"|-?nan|-?inf))?)[ \t]*$")


def sniff(head: bytes) -> bool:
    """Check whether most of the first lines are od lines, with at least one sample."""
    lines = _text.first_lines(head)
    known = [found for found in map(_LINE.match, lines) if found and (found[3] or not found[2])]
    return any(found[3] for found in known) and 2 * len(known) > len(lines)


@dataclass
class _Samples:
    """Samples in the order of the file: 0-based line, wall clock, byte offset, value."""

    line: IntArray
    wall: IntArray
    offset: IntArray
    value: FloatArray

    @classmethod
    def none(cls) -> _Samples:
        """Return an empty series of samples."""
        empty = np.zeros(0, dtype=np.int64)
        return cls(empty, empty, empty, np.zeros(0))

    def take(self, order: AnyArray) -> _Samples:
        return _Samples(self.line[order], self.wall[order], self.offset[order], self.value[order])

    def join(self, *others: _Samples) -> _Samples:
        """Return all samples in the order of their lines, and samples of one line in the order of the parts."""
        parts = (self, *others)
        joined = _Samples(*(np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS))
        if np.all(joined.line[1:] > joined.line[:-1]):
            return joined
        return joined.take(np.argsort(joined.line, kind="stable"))


_COLUMNS = {"line": np.int64, "wall": np.int64, "offset": np.int64, "value": np.float64}
_NONE = np.zeros(0, dtype=np.int64)


_DECIMAL = re.compile(rb" *-?\d+(?:\.\d+)?")
_OF_DECIMALS = np.isin(np.arange(256), [*b" -.0123456789"])


def _decimals(cells: AnyArray) -> tuple[FloatArray, BoolArray]:
    """Convert right-aligned decimals, ``(n, 16)`` uint8, to numbers, and return which of them are plain decimals."""
    texts = np.ascontiguousarray(cells).view(f"S{_VALUE}").ravel()
    plain = np.ones(len(texts), dtype=bool)
    digit, point = cells >= 48, cells == 46
    # exclude numbers that begin or end with a point, and trailing spaces, because NumPy accepts them
    complete = digit[:, -1].all() and not point[:, 0].any() and digit[:, :-1][point[:, 1:]].all()
    try:
        if complete and _OF_DECIMALS[cells].all():
            return texts.astype(np.float64), plain
    except ValueError:
        pass
    # there is a damaged line, which is rare, so test each text
    plain[:] = [_DECIMAL.fullmatch(text) is not None for text in texts.tolist()]
    return np.where(plain, texts, b"0").astype(np.float64), plain


def _fixed_layout(lines: _text.Lines) -> tuple[_Samples, IntArray]:
    """Return the samples of all lines in the layout of ``ts`` and ``od``, without a Python loop over lines.

    Also return the lines of this layout whose offset is not an octal number.
    """
    length = lines.ends - lines.starts
    parts, wrong = [], [np.zeros(0, dtype=np.int64)]
    for width in _WIDTHS:
        rows = np.flatnonzero(length == _STAMP + 1 + width + _VALUE)
        if not len(rows):
            continue
        cells = lines.fixed(rows, _STAMP + 1 + width + _VALUE)
        wall, valid = _text.parse_digits(cells[:, 1 : _STAMP - 1], 6)
        offset, worst = _text.integers(cells[:, _STAMP + 1 : _STAMP + 1 + width], 8)
        value, plain = _decimals(cells[:, _STAMP + 1 + width :])
        valid &= plain & (cells[:, 0] == 91) & (cells[:, _STAMP - 1] == 93) & (cells[:, _STAMP] == 32)
        valid &= cells[:, _STAMP + 1 + width] == 32
        wrong.append(rows[valid & (worst > 7) & (worst <= 9)])
        parts.append(_Samples(rows, wall, offset, value).take(valid & (worst <= 7)))
    return _Samples.none().join(*parts), np.concatenate(wrong)


@dataclass
class _Piece:
    """The content of a log or a piece of it: samples, ``*`` and foot lines (value NaN), and the account.

    ``torn`` is the 0-based line without an end.
    """

    samples: _Samples
    marks: _Samples
    texts: dict[int, str]
    lines: int
    blank: int
    torn: int = -1


def _piece(lines: _text.Lines, rejects: _text.Rejects) -> _Piece:
    """Read all samples in the layout of od at once, and the few other lines one by one."""
    fixed, wrong = _fixed_layout(lines)
    rejects.add(lines, wrong, "the offset is not an octal number: not written by od")
    unread = ~lines.blank
    unread[fixed.line] = unread[wrong] = False
    odd: list[tuple[int, bytes, int, float, bool]] = []
    for i in np.flatnonzero(unread).tolist():
        line = lines.raw(i)
        found = _LINE.match(line)
        last = lines.unterminated and i == len(lines) - 1
        if found is None:
            rejects.add(lines, [i], _reason(line))
        elif last and found[3] and len(line) < _STAMP + 1 + len(found[2]) + _VALUE:
            rejects.add(lines, [i], "truncated last line: the value is cut short")
        else:
            odd.append((i, found[1], int(found[2] or b"-1", 8), float(found[3] or "nan"), found[3] is not None))
    line_of, times, offset, value, sampled = zip(*odd, strict=True) if odd else ((),) * 5
    wall, valid, _, _ = _text.parse_texts(_text.cells(times))
    rows = _Samples(np.array(line_of, np.int64), wall, np.array(offset, np.int64), np.array(value, np.float64))
    rejects.add(lines, rows.line[~valid], "the time stamp is not a date of the calendar")
    samples, marks = (rows.take(valid & (np.array(sampled, dtype=bool) == kind)) for kind in (True, False))
    texts = {i: lines.text(i) for i in marks.line[:KEPT_REJECTED].tolist()}
    return _Piece(fixed.join(samples) if len(samples.line) else fixed, marks, texts, len(lines), int(lines.blank.sum()))


def _reason(line: bytes) -> str:
    if b"\0" in line:
        return _text.NUL
    if not line.startswith(b"["):
        return "the line does not begin with '[time]', which the program 'ts' writes"
    if not re.match(_HEAD, line):
        return "the time stamp is incomplete or of another form (truncated line?)"
    return "neither 'offset value', nor '*': not an od line"


def _expand(samples: _Samples, marks: _Samples) -> tuple[_Samples, IntArray, list[tuple[int, str]]]:
    """Return the samples that ``*`` lines replace.

    Returns
    -------
    repeats : _Samples
        The suppressed samples, with the line of the ``*`` and times between the times of the neighbours.
    used : int array
        0-based ``*`` lines that were expanded.
    bad : list of (line, reason)
    """
    stars = marks.take(marks.offset < 0)
    feet = marks.take(marks.offset >= 0)
    if not len(stars.line):
        return _Samples.none(), stars.line, []
    # if the last line contains only an offset, it ends the last run like a sample without a value
    near = np.unique(np.searchsorted(samples.line, stars.line).clip(max=len(samples.line) - 1))
    ends = (samples.take(near) if len(samples.line) else samples).join(feet)
    after = np.searchsorted(ends.line, stars.line)
    before = np.searchsorted(samples.line, stars.line) - 1
    bounded = (before >= 0) & (after < len(ends.line))
    second = np.concatenate(([False], np.diff(before) == 0))
    first, count = bounded & ~second, np.zeros(len(stars.line), dtype=np.int64)
    count[first] = (ends.offset[after[first]] - samples.offset[before[first]]) // 4 - 1
    fits = (count >= 0) & (np.cumsum(np.maximum(count, 0)) <= _MOST_REPEATS)
    reasons = {
        "'*' without a sample before it or an offset after it: the length of the run is unknown": ~bounded,
        "a second '*' in one run": bounded & second,
        "'*' between offsets that do not bound a run of plausible length": first & ~fits,
    }
    bad = [(i, reason) for reason, where in reasons.items() for i in stars.line[where].tolist()]
    chosen = np.flatnonzero(first & fits)
    start, end, count = before[chosen], after[chosen], count[chosen]
    step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + 1
    part = step / np.repeat(count + 1, count)
    span = (ends.wall[end] - samples.wall[start]).astype(np.float64)
    repeats = _Samples(
        np.repeat(stars.line[chosen], count),
        np.repeat(samples.wall[start], count) + np.round(part * np.repeat(span, count)).astype(np.int64),
        np.repeat(samples.offset[start], count) + 4 * step,
        np.repeat(samples.value[start], count),
    )
    return repeats, stars.line[chosen], bad


# Names of the three logs from AERPAW's start scripts and emulator: ``2025-01-01_power_log.txt``, ``lw1_snr.txt``.
_NAMED = re.compile(r"(?<![a-z])(power|quality|snr)(?![a-z])|(?:power|quality|snr)(?=_?log)")


def read_pieces(pieces: Iterable[bytes], options: ReadOptions) -> ReadResult:
    """Return one stream of levels. ``options.channel`` or the file name decides its kind; all layouts are equal.

    Runs, times and flags are computed from the samples of all pieces together.

    Raises
    ------
    UsageError
        If no time zone is given.
    """
    rejects, warnings = _text.Rejects(), list[str]()
    log = _joined(pieces, rejects)
    repeats, used, bad = _expand(log.samples, log.marks)
    feet = log.marks.line[log.marks.offset >= 0].tolist()
    foot = "no value after the offset (truncated last line, or the end of od's input)"
    for i, reason in (*bad, *((i, foot) for i in feet)):
        rejects.add_line(i + 1, reason, log.texts.get(i, ""))
    rejected, reasons = rejects.result()
    accepted = len(log.samples.line) + len(used)
    streams = (_stream(log, repeats, options, warnings),) if accepted else ()
    return ReadResult(
        reader="sounder_log", streams=streams, lines=log.lines, accepted=accepted, blank=log.blank, rejected=rejected,
        warnings=tuple(warnings), reasons=reasons,
    )  # fmt: skip


def _joined(pieces: Iterable[bytes], rejects: _text.Rejects) -> _Piece:
    """Return the content of all pieces of a log."""
    marks, texts = _Samples.none(), dict[int, str]()
    before, blank, unterminated = 0, 0, False
    columns = [Column(kind) for kind in _COLUMNS.values()]
    for data in pieces:
        lines = _text.split(data)
        rejects.before = before
        piece = _piece(lines, rejects)
        for part in (piece.samples, piece.marks):
            part.line += before
        for column, name in zip(columns, _COLUMNS, strict=True):
            column.extend(getattr(piece.samples, name))
        marks = marks.join(piece.marks) if len(piece.marks.line) else marks
        texts |= {before + i: text for i, text in piece.texts.items()} if len(texts) < KEPT_REJECTED else {}
        before, blank, unterminated = before + len(lines), blank + piece.blank, lines.unterminated
    samples = _Samples(*(column.array() for column in columns))
    return _Piece(samples, marks, texts, before, blank, torn=before - 1 if unterminated else -1)


def _stream(log: _Piece, repeats: _Samples, options: ReadOptions, warnings: list[str]) -> Stream:
    """Return the stream with its flags, and add warnings about repeated, lost and missing samples and about times."""
    samples, repeated = log.samples, np.zeros(0, dtype=bool)
    if len(repeats.line):
        samples = samples.join(repeats)
        repeated = np.isin(samples.line, repeats.line)  # lines of '*' contain no other samples
        restored = counted(len(repeats.line), "sample was", "samples were")
        warnings.append(f"{restored} restored, flagged 'repeated': the program od writes '*' for values that repeat")
    # free each column when it is not needed any more, because a log may have 1 GB
    jump = samples.offset
    jump[1:] -= jump[:-1]
    jump[0] = 0
    lost = jump > 4
    if lost.any():
        missing = counted(int((jump[lost] // 4 - 1).sum()), "sample")
        warnings.append(f"offsets jump at {counted(int(lost.sum()), 'place')}: {missing} missing")
    if back := int((jump < 0).sum()):
        warnings.append(f"offsets step back at {counted(back, 'place')}: several runs in one file?")
    samples.offset = jump = _NONE
    instants = _text.wall_to_utc(samples.wall, options, needed_by="sounder_log")
    samples.wall = _NONE
    flag = _text.no_flags(len(samples.line))
    instants.flag(flag)
    _text.add_flag(flag, repeated, "repeated")
    silent = ~(samples.value > options.floor_db)
    samples.value[silent] = np.nan
    _text.add_flag(flag, silent, "out_of_coverage")
    _text.add_flag(flag, lost, "samples_lost_before")
    if log.torn >= 0:
        _text.add_flag(flag, samples.line == log.torn, _text.UNTERMINATED)
    samples.line += 1
    frame = _text.frame("rss", instants.time, samples.line, flag, {"rss_db": samples.value}, own=True)
    warnings += [*instants.warnings, *_text.back_in_time(frame)]
    named = _NAMED.search(options.file_name.lower())
    if named is None and options.channel is None:
        warnings.append(
            "power, quality and SNR logs have one layout: read as power, because the file name does not show the kind; "
            "use the channel option for another kind"
        )
    name = options.channel or (named.group() if named else "power")
    unit = "dB" if name.lower() in ("quality", "snr") else "dB re full scale"
    attributes = _text.attributes(
        options, channel=name, unit=options.unit or unit, quantity="SNR" if name.lower() == "snr" else None,
        repeated_samples=len(repeats.line),
    )  # fmt: skip
    if link := _SOUNDING.match(options.file_name):
        attributes |= _identity.attributes_of({key: text for key, text in link.groupdict().items() if text != "null"})
    return Stream("rss", name, frame, attributes)


# Name of a file of the nightly soundings between towers.
_SOUNDING = re.compile(
    r"(?P<transmitter>\w+):(?P<receiver>\w+):(?P<receiver_serial_number>\w+):(?P<receiver_frequency>[\w.]+)"
    r":(?P<receiver_channel>\d):\d{4}-"
)

READER = Reader(
    name="sounder_log", title="GNU Radio channel sounder power, quality or SNR log (od text)", kinds=("rss",),
    sample="[2025-01-01 12:00:00.032760] 0000004       -35.12345", sniff=sniff,
    read=lambda data, options: read_pieces((data,), options), read_pieces=read_pieces,
)  # fmt: skip

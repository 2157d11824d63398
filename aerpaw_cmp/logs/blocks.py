"""Logs of any size, read in blocks of lines: memory holds one block and the records.

A block is read as a small log of its own. In front of it stand the lines that it needs from before: the head of the
file (a header), the last line of each kind that later lines hang on (the title of a table, the time above it), and
the last line before the cut, so that what a reader says about neighbours (a gap, a lost sample) is said once. What
these lines give is taken off again: their records, their place in the account, their share of counts in warnings.
What only the whole log can tell is left to ``settle``.
"""

from __future__ import annotations

import hashlib
import operator
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.errors import InputError
from ..common.units import AnyArray, IntArray
from .readers import InBlocks, Reader, ReadOptions
from .records import Attribute, ReadResult, RejectedLine, Stream

if TYPE_CHECKING:
    import pandas as pd

BLOCK_BYTES = 2 << 20
"""What a step over such a block needs is taken and given back without a question to the system."""
FROM_BYTES = 24 << 20
"""Smaller files are read in one piece."""
_CHUNK = 2 << 20
_KEPT_BYTES = 31 << 20
"""Taken and given back once, unwritten: from then on the C library keeps (up to twice) as much for the next step,
instead of giving each block's arrays back to the system and asking for them again, page by page."""
_AT_ONCE = 1 << 20
"""Rows that a step over a whole column takes at a time: what it needs beside the column stays small."""
_ROOM = 1 << 22
"""Rows up to which a column takes room for eight times as many (which costs nothing before it is written to); above, it
grows by a sixteenth, in place."""
_MOST_RATIO = 1100
"""Deflate makes a file at most 1032 times smaller."""
_SUMMED = re.compile(
    r"(\d+ (samples|rows|times|further points)|(time|offsets) (steps?|jump)|the row index jumps|offsets step)\b"
)
"""Warnings whose numbers are counts: over blocks they add up."""
_STEPS_BACK = "time steps back at "
_TOGETHER: dict[str, Callable[[Any, Any], Any]] = {"repeated_samples": operator.add, "ports": max}
"""How attributes of two parts that are counts, or bounds, become one."""
_LOOK_BACK = 1000
"""Lines among which a place to cut is looked for."""


class Whole(Exception):  # noqa: N818 - no error: the caller reads the file in one piece
    """A log that cannot be read in blocks after all."""


def read(place: Path, reader: Reader, options: ReadOptions) -> tuple[ReadResult, str]:
    """What ``reader.read`` gives for the whole file, and the SHA-256 of its content after unpacking.

    Raises
    ------
    Whole
        If what a line means depends on more than its block (an hour of wall time that came twice).
    InputError
        If a gzip file is damaged or cut.
    """
    assert reader.in_blocks is not None
    digest = hashlib.sha256()
    try:
        result = reader.in_blocks(counted(_contents(place), digest), options)
    except zlib.error as error:
        raise InputError(f"a damaged gzip file ({error})", cause="a cut download", path=place) from error
    return result, digest.hexdigest()


def by_lines(
    read: Callable[[bytes, ReadOptions], ReadResult],
    *,
    apart: re.Pattern[bytes] | None = None,
    head: Callable[[bytes, ReadOptions], int] | None = None,
    keep: Sequence[re.Pattern[bytes]] = (),
    settle: Callable[[ReadResult], ReadResult] | None = None,
) -> InBlocks:
    """Reading in blocks for a format whose lines are read one by one.

    Parameters
    ----------
    read : callable
        The reader's own, for one block.
    apart : re.Pattern, optional
        Lines that stand alone, one record each: a cut is made only between two of them, and the one before it is seen
        by the next block. Any line end where there is none.
    head : callable, optional
        ``head(data, options) -> int``: how many bytes of the file's beginning every block needs in front; whole lines.
    keep : sequence of re.Pattern, optional
        MULTILINE patterns of lines on which later ones hang: the last of each is put in front of a block; of a pattern
        with the group ``kind`` the last of each kind that this group tells.
    settle : callable, optional
        What only the whole log can tell, from the joined result.

    Returns
    -------
    callable
        ``in_blocks(chunks, options)``: the same result as ``read`` of all bytes at once.
    """

    def in_blocks(chunks: Iterator[bytes], options: ReadOptions) -> ReadResult:
        np.empty(_KEPT_BYTES, dtype=np.uint8)
        gathered = Gathered()
        top_of = None if head is None else lambda data: head(data, options)
        before: tuple[bytes, ReadResult | None] = b"", None
        for front, data in _blocks(_unmarked(chunks), apart, top_of, keep):
            if front != before[0]:
                before = front, read(front, options)
            gathered.add(read(data, options), before[1])
        result = gathered.result()
        return result if settle is None else settle(result)

    return in_blocks


def _unmarked(chunks: Iterator[bytes]) -> Iterator[bytes]:
    """The chunks of a file without its byte order mark."""
    for i, chunk in enumerate(chunks):
        yield chunk.removeprefix(b"\xef\xbb\xbf") if i == 0 else chunk


def whole_lines(chunks: Iterator[bytes]) -> Iterator[bytes]:
    """Blocks of whole lines, for a reader that keeps by itself what later lines hang on."""
    for _, data in _blocks(_unmarked(chunks), None, None, ()):
        yield data


def beginning(chunks: Iterator[bytes], size: int) -> tuple[bytes, Iterator[bytes]]:
    """At least so many bytes of a log's beginning where it has them, without a mark, and the chunks of all of it."""
    taken: list[bytes] = []
    for piece in chunks:
        taken.append(piece)
        if sum(map(len, taken)) > size:
            break
    return b"".join(taken).removeprefix(b"\xef\xbb\xbf"), chain(taken, chunks)


def first_line(data: bytes, options: ReadOptions) -> int:  # noqa: ARG001 - the contract of heads
    """Bytes of the first line: the ``head`` of a table whose header stands there."""
    return data.find(b"\n") + 1


def counted(chunks: Iterator[bytes], digest: Any) -> Iterator[bytes]:
    """The chunks, each added to a digest as it passes."""
    for chunk in chunks:
        digest.update(chunk)
        yield chunk


def _contents(place: Path) -> Iterator[bytes]:
    """Chunks of a file, gunzipped where needed."""
    machine: Any = None
    first, inside, packed, unpacked = True, False, 0, 0
    with place.open("rb") as file:
        while chunk := file.read(_CHUNK):
            if first and chunk.startswith(b"\x1f\x8b"):
                machine = zlib.decompressobj(zlib.MAX_WBITS | 16)
            first = False
            if machine is None:
                yield chunk
                continue
            packed += len(chunk)
            while chunk:
                inside = True
                piece = machine.decompress(chunk, _CHUNK)
                unpacked += len(piece)
                if unpacked > _MOST_RATIO * packed + _CHUNK:
                    raise InputError("the gzip file unpacks to more than it can hold", cause="no log", path=place)
                yield piece
                chunk = machine.unconsumed_tail
                if machine.eof:
                    chunk, inside = machine.unused_data, False
                    machine = zlib.decompressobj(zlib.MAX_WBITS | 16)
    if inside:
        raise InputError("the gzip file ends too early", cause="a cut download", path=place)


def _blocks(
    chunks: Iterator[bytes],
    apart: re.Pattern[bytes] | None,
    head: Callable[[bytes], int] | None,
    keep: Sequence[re.Pattern[bytes]],
) -> Iterator[tuple[bytes, bytes]]:
    """Blocks of whole lines behind the lines from before that they need: these, and both as one piece."""
    parts: list[bytes] = []
    size, enough = 0, BLOCK_BYTES
    top, front = b"", b""
    kept: list[dict[bytes, bytes]] = [{} for _ in keep]
    begun = False
    for chunk in chunks:
        parts.append(chunk)
        size += len(chunk)
        if size < enough:
            continue
        data, rest = _joined_to_cut(parts, apart if begun or head is None else _NEVER)
        cut: int | None = len(data)
        if rest is None:
            cut = _cut(data, apart)
        if cut is not None and (cut <= len(front) or (not begun and head is not None and head(data) > cut)):
            cut = None
        if cut is None:  # one run of suppressed samples, or one line: more is needed
            parts, enough = [data, rest or b""], 2 * size
            continue
        if rest is None:
            data, rest = data[:cut], data[cut:]
        yield front, data
        if not begun and head is not None:
            top = data[: head(data + rest)]
        for pattern, lines in zip(keep, kept, strict=True):
            lines |= _last_lines(pattern, data, len(front), cut)
        last = data[data.rfind(b"\n", 0, cut - 1) + 1 : cut] if apart is not None else b""
        front = b"".join([top, *dict.fromkeys(line for lines in kept for line in lines.values()), last])
        begun, parts, size, enough = True, [front, rest], len(rest), BLOCK_BYTES
    data = b"".join(parts)
    if len(data) > len(front) or not begun:
        yield front, data


_NEVER = re.compile(b"(?!)")
_TAIL = 1 << 16


def _joined_to_cut(parts: Sequence[bytes], apart: re.Pattern[bytes] | None) -> tuple[bytes, bytes | None]:
    """The pieces as one up to the cut, and the rest: one copy, where the last piece shows a cut near its end."""
    last = parts[-1]
    begin = max(len(last) - _TAIL, 0)
    cut = _cut(last[begin:], apart)
    if cut is None:
        return b"".join(parts), None
    return b"".join([*parts[:-1], memoryview(last)[: begin + cut]]), last[begin + cut :]


def _last_lines(pattern: re.Pattern[bytes], data: bytes, start: int, end: int) -> dict[bytes, bytes]:
    """The last line of each kind between two places that the pattern finds, by kind."""
    if "kind" in pattern.groupindex:
        return {found["kind"]: _line_at(data, found.start()) for found in pattern.finditer(data, start, end)}
    line = _last_line(pattern, data, start, end)
    return {b"": line} if line else {}


def _line_at(data: bytes, place: int) -> bytes:
    first = data.rfind(b"\n", 0, place) + 1
    return data[first : data.find(b"\n", first) + 1]


def _last_line(pattern: re.Pattern[bytes], data: bytes, start: int, end: int) -> bytes:
    """The last line between two places that the pattern finds, none as empty bytes; looked for from the end."""
    window = 1 << 16
    while True:
        begin = data.rfind(b"\n", start, max(end - window, start)) + 1 if end - start > window else start
        begin = max(begin, start)
        places = [found.start() for found in pattern.finditer(data, begin, end)]
        if places:
            return _line_at(data, places[-1])
        if begin == start:
            return b""
        window *= 8


def _cut(data: bytes, apart: re.Pattern[bytes] | None) -> int | None:
    """The last line end, or the last place between two lines that stand alone; None where there is none near."""
    after = data.rfind(b"\n")
    if apart is None:
        return after + 1 or None
    for _ in range(_LOOK_BACK):
        before = data.rfind(b"\n", 0, max(after, 0))
        earlier = data.rfind(b"\n", 0, max(before, 0))
        if earlier < 0:
            return None
        if apart.match(data[before + 1 : after]) and apart.match(data[earlier + 1 : before]):
            return before + 1
        after = before
    return None


class Gathered:
    """Results of blocks, put together."""

    def __init__(self) -> None:
        self.reader = ""
        self.lines = self.accepted = self.blank = 0
        self.rejected: list[RejectedLine] = []
        self.warnings = _Warnings()
        self.order: list[tuple[str, str]] = []
        self.records: dict[tuple[str, str], Records] = {}
        self.attributes: dict[tuple[str, str], dict[str, Attribute]] = {}

    def add(self, result: ReadResult, before: ReadResult | None) -> None:
        """The next block.

        Parameters
        ----------
        result : ReadResult
            Of the block and the lines in front of it.
        before : ReadResult, optional
            Of the lines in front alone.
        """
        if any("had twice" in text for text in result.warnings):
            raise Whole
        front = 0 if before is None else before.lines
        shift = self.lines - front
        self.reader = result.reader
        self.rejected += [
            RejectedLine(line.number + shift, line.reason, line.text) for line in result.rejected if line.number > front
        ]
        self.lines += result.lines - front
        self.accepted += result.accepted - (0 if before is None else before.accepted)
        self.blank += result.blank - (0 if before is None else before.blank)
        self.warnings.add(result.warnings, () if before is None else before.warnings)
        added = []
        for stream in result.streams:
            key = (stream.kind, stream.name)
            columns = _behind(stream.frame, front)
            if len(columns["line"]):
                added.append(key)
                columns["line"] = columns["line"] + shift
                self.records.setdefault(key, Records()).extend(columns)
                self.attributes[key] = _joined(self.attributes.get(key), stream.attributes)
        self.order = in_order(self.order, added)

    def result(self) -> ReadResult:
        """All blocks as one result."""
        streams = []
        for key in self.order:
            frame = self.records.pop(key).frame()
            about = {name: value for name, value in self.attributes[key].items() if value != _DIFFERS}
            streams.append(Stream(key[0], key[1], frame, about))  # type: ignore[arg-type]
        back = steps_back(streams[0].frame["time"].to_numpy()) if streams else 0
        return ReadResult(
            reader=self.reader,
            streams=tuple(streams),
            lines=self.lines,
            accepted=self.accepted,
            blank=self.blank,
            rejected=tuple(self.rejected),
            warnings=self.warnings.result(back),
        )


def in_order(known: Sequence[Any], more: Sequence[Any]) -> list[Any]:
    """Two selections of one ordered list, merged: a new name follows the one that it follows in its selection.

    Examples
    --------
    >>> in_order(["a", "c", "z"], ["a", "b", "c"])
    ['a', 'b', 'c', 'z']
    """
    made, place = list(known), 0
    for name in more:
        if name in made:
            place = made.index(name) + 1
        else:
            made.insert(place, name)
            place += 1
    return made


def _joined(known: dict[str, Attribute] | None, more: Any) -> dict[str, Attribute]:
    """Attributes of two parts of a stream: counts added, what differs left out."""
    if known is None:
        return dict(more)
    made = dict(known)
    for name, value in more.items():
        if name in _TOGETHER and name in made:
            made[name] = _TOGETHER[name](made[name], value)
        elif name == "clock" and made.get(name) != value:
            raise Whole  # what the times count from was read in two ways
        elif made.setdefault(name, value) != value:
            made[name] = _DIFFERS
    return made


_DIFFERS = "differs"
"""In place of an attribute that two parts of a stream have otherwise: a third part does not bring it back."""


class _Column:
    """A column that grows: its values are held once, as the system moves the pages of a large array, not its bytes."""

    def __init__(self, dtype: Any) -> None:
        self.values: AnyArray = np.empty(0, dtype=dtype)
        self.count = 0

    def extend(self, piece: AnyArray) -> None:
        """Values behind those that are there; the type becomes one that holds both."""
        dtype = np.result_type(self.values.dtype, piece.dtype)
        if dtype != self.values.dtype:
            self.values = self.values.astype(dtype)
        end = self.count + len(piece)
        if end > len(self.values):
            self._grow(end)
        self.values[self.count : end] = piece
        self.count = end

    def _grow(self, need: int) -> None:
        if need > _ROOM:
            self.values.resize(need + need // 16, refcheck=False)
            return
        wider = np.empty(min(8 * need, _ROOM), dtype=self.values.dtype)
        wider[: self.count] = self.values[: self.count]
        self.values = wider

    def array(self) -> AnyArray:
        """The column; it takes no more values."""
        self.values.resize(self.count, refcheck=False)
        return self.values


class _Flags(_Column):
    """Flags as small numbers of their few texts; the same text is one object in the end."""

    def __init__(self, dtype: Any = np.uint8) -> None:
        super().__init__(dtype)
        self.texts = {"": 0}

    def extend(self, piece: AnyArray) -> None:
        """Numbers of the texts behind those that are there."""
        import pandas as pd

        codes = np.zeros(len(piece), dtype=np.uint8)
        if piece.tolist().count("") < len(piece):  # the quickest look at objects
            marked = np.flatnonzero(piece != "")
            place, found = pd.factorize(piece[marked])
            number = np.array([self.texts.setdefault(text, len(self.texts)) for text in found])
            codes = codes.astype(np.min_scalar_type(len(self.texts)))
            codes[marked] = number[place]
        super().extend(codes)

    def array(self) -> AnyArray:
        """The column of texts."""
        texts = np.array(list(self.texts), dtype=object)
        made = np.empty(self.count, dtype=object)
        for first in range(0, self.count, _AT_ONCE):
            made[first : first + _AT_ONCE] = texts[self.values[first : min(first + _AT_ONCE, self.count)]]
        return made


class Records:
    """The records of a stream, block behind block; a column that a block lacks is NaN there."""

    def __init__(self) -> None:
        self.columns: dict[str, _Column] = {}
        self.count = 0

    def extend(self, more: dict[str, AnyArray]) -> None:
        """Those of the next block."""
        if list(self.columns) != list(more):
            names = in_order(list(self.columns), list(more))
            self.columns = {name: self.columns.get(name) or self._new(name, more[name].dtype) for name in names}
        length = len(more["line"])
        for name, column in self.columns.items():
            column.extend(more[name] if name in more else np.full(length, np.nan))
        self.count += length

    def _new(self, name: str, dtype: Any) -> _Column:
        column = _Flags() if name == "flag" else _Column(dtype)
        if self.count:
            column.extend(np.full(self.count, np.nan))
        return column

    def frame(self) -> pd.DataFrame:
        """All of them, each column an array of its own."""
        import pandas as pd

        content: dict[str, Any] = {}
        for name in list(self.columns):
            values = self.columns.pop(name).array()
            content[name] = pd.Series(values, dtype=object, copy=False) if values.dtype == object else values
        made: pd.DataFrame = pd.DataFrame(content, copy=False)
        return made


def _behind(frame: pd.DataFrame, front: int) -> dict[str, AnyArray]:
    """Columns of the records whose lines lie behind the first ``front``."""
    columns = {str(name): frame[name].to_numpy() for name in frame.columns}
    if not front:
        return columns
    mine = columns["line"] > front
    first = len(mine) - int(np.count_nonzero(mine))
    keep: Any = slice(first, None) if mine[first:].all() else mine
    return {name: column[keep] for name, column in columns.items()}


def steps_back(time: AnyArray) -> int:
    """How often the instants (n,) of a log step back."""
    stamp: IntArray = np.asarray(time, dtype="datetime64[ns]").view(np.int64)
    steps = 0
    for first in range(0, len(stamp) - 1, _AT_ONCE):
        piece = stamp[first : first + _AT_ONCE + 1]
        steps += int(np.count_nonzero(piece[1:] < piece[:-1]))
    return steps


class _Warnings:
    """Warnings of all blocks: counts of one kind added up, others said once."""

    def __init__(self) -> None:
        self.counts: dict[str, list[int]] = {}
        self.plain: dict[str, str] = {}

    def add(self, texts: Sequence[str], before: Sequence[str]) -> None:
        """Those of a block, and those of the lines in front of it alone, which were counted before."""
        keys = {text: re.sub(r"\d+", "#", text) if _SUMMED.match(text) else text for text in (*texts, *before)}
        order = in_order(list(self.plain), [keys[text] for text in texts])
        self.plain |= {keys[text]: text for text in reversed(texts)} | self.plain
        self.plain = {key: self.plain[key] for key in order}
        for sign, group in ((1, texts), (-1, before)):
            for text in group:
                if (key := keys[text]) in self.plain and _SUMMED.match(text):
                    old = self.counts.setdefault(key, [0] * key.count("#"))
                    new = [sign * int(number) for number in re.findall(r"\d+", text)]
                    self.counts[key] = [a + b for a, b in zip(old, new, strict=True)]

    def result(self, back: int) -> tuple[str, ...]:
        """The texts, with the number of steps back of the whole log."""
        out = []
        stepped = f"{_STEPS_BACK}{back} places"
        for key, text in self.plain.items():
            if key.startswith(_STEPS_BACK):
                out += [stepped] if back else []
            elif key not in self.counts:
                out.append(text)
            elif self.counts[key] and self.counts[key][0] > 0:
                numbers = iter(self.counts[key])
                out.append(re.sub("#", lambda _: str(next(numbers)), key))  # noqa: B023 - used at once
        if back and stepped not in out:
            out.append(stepped)
        return tuple(out)


def with_warnings(result: ReadResult, *, without: str, more: Sequence[str]) -> ReadResult:
    """A result without the warnings that a pattern finds, and with others: what ``settle`` needs."""
    kept = tuple(text for text in result.warnings if not re.search(without, text))
    return replace(result, warnings=(*kept, *more))

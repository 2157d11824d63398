"""Logs of any size, read in blocks of lines: memory holds one block and the records.

A block is read as a small log of its own. In front of it stand the lines that it needs from before: the head of the
file (a header), the last line of each kind that later lines hang on (the title of a table, the time above it), and
the last line before the cut, so that what a reader says about neighbours (a gap, a lost sample) is said once. What
these lines give is taken off again: their records, their place in the account, their share of counts in warnings.
What only the whole log can tell is left to ``settle``.
"""

from __future__ import annotations

import hashlib
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..common.errors import InputError
from ..common.units import AnyArray
from .readers import InBlocks, Reader, ReadOptions
from .records import Attribute, ReadResult, RejectedLine, Stream

if TYPE_CHECKING:
    import pandas as pd

BLOCK_BYTES = 12 << 20
FROM_BYTES = 24 << 20
"""Smaller files are read in one piece."""
_CHUNK = 4 << 20
_MOST_RATIO = 1100
"""Deflate makes a file at most 1032 times smaller."""
_SUMMED = re.compile(
    r"(\d+ (samples|rows|times|further points)|(time|offsets) (steps?|jump)|the row index jumps|offsets step)\b"
)
"""Warnings whose numbers are counts: over blocks they add up."""
_STEPS_BACK = "time steps back at "
_COUNTED = ("repeated_samples",)
"""Attributes that are counts."""
_LOOK_BACK = 1000
"""Lines among which a place to cut is looked for."""


class Whole(Exception):  # noqa: N818 - no error: the caller reads the file in one piece
    """A log that cannot be read in blocks after all."""


def read(place: Path, reader: Reader, options: ReadOptions) -> tuple[ReadResult, str]:
    """What ``reader.read`` gives for the whole file, and its SHA-256.

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
        result = reader.in_blocks(_contents(place, digest), options)
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
        MULTILINE patterns of lines on which later ones hang: the last of each is put in front of a block.
    settle : callable, optional
        What only the whole log can tell, from the joined result.

    Returns
    -------
    callable
        ``in_blocks(chunks, options)``: the same result as ``read`` of all bytes at once.
    """

    def in_blocks(chunks: Iterator[bytes], options: ReadOptions) -> ReadResult:
        gathered = Gathered()
        top_of = None if head is None else lambda data: head(data, options)
        for front, data in _blocks(_unmarked(chunks), apart, top_of, keep):
            before = read(front, options) if front else None
            gathered.add(read(front + data, options), before)
        result = gathered.result()
        return result if settle is None else settle(result)

    return in_blocks


def _unmarked(chunks: Iterator[bytes]) -> Iterator[bytes]:
    """The chunks of a file without its byte order mark."""
    for i, chunk in enumerate(chunks):
        yield chunk.removeprefix(b"\xef\xbb\xbf") if i == 0 else chunk


def first_line(data: bytes, options: ReadOptions) -> int:  # noqa: ARG001 - the contract of heads
    """Bytes of the first line: the ``head`` of a table whose header stands there."""
    return data.find(b"\n") + 1


def _contents(place: Path, digest: Any) -> Iterator[bytes]:
    """Chunks of a file, gunzipped where needed; the digest is that of the bytes on disk."""
    machine: Any = None
    first, inside, packed, unpacked = True, False, 0, 0
    with place.open("rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
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
    """Blocks of whole lines, each behind the lines from before that it needs."""
    parts: list[bytes] = []
    size, enough = 0, BLOCK_BYTES
    top, kept, last = b"", [b""] * len(keep), b""
    begun = False
    for chunk in chunks:
        parts.append(chunk)
        size += len(chunk)
        if size < enough:
            continue
        data = b"".join(parts)
        cut = _cut(data, apart)
        if not begun and head is not None and cut is not None and head(data) > cut:
            cut = None
        if cut is None:  # one run of suppressed samples, or one line: more is needed
            parts, size, enough = [data], len(data), 2 * size
            continue
        yield _front(top, kept, last), data[:cut]
        if not begun and head is not None:
            top = data[: head(data)]
        kept = [_last_line(pattern, data, cut) or line for pattern, line in zip(keep, kept, strict=True)]
        last = data[data.rfind(b"\n", 0, cut - 1) + 1 : cut] if apart is not None else b""
        begun, parts, size, enough = True, [data[cut:]], len(data) - cut, BLOCK_BYTES
    data = b"".join(parts)
    if data or not begun:
        yield _front(top, kept, last), data


def _front(top: bytes, kept: Sequence[bytes], last: bytes) -> bytes:
    return b"".join([top, *dict.fromkeys(kept), last])


def _last_line(pattern: re.Pattern[bytes], data: bytes, end: int) -> bytes:
    """The last line that the pattern finds, none as empty bytes; looked for from the end."""
    window = 1 << 16
    while True:
        begin = data.rfind(b"\n", 0, max(end - window, 0)) + 1 if end > window else 0
        places = [found.start() for found in pattern.finditer(data, begin, end)]
        if places:
            first = data.rfind(b"\n", 0, places[-1]) + 1
            return data[first : data.find(b"\n", first) + 1]
        if begin == 0:
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
        self.parts: dict[tuple[str, str], list[dict[str, AnyArray]]] = {}
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
            frame = stream.frame
            if front:
                frame = frame[frame["line"].to_numpy() > front]
            if len(frame):
                added.append(key)
                columns = {name: frame[name].to_numpy(copy=True) for name in frame.columns}  # each alone can be freed
                columns["line"] += shift
                self.parts.setdefault(key, []).append(columns)
                self.attributes[key] = _joined(self.attributes.get(key), stream.attributes)
        self.order = in_order(self.order, added)

    def result(self) -> ReadResult:
        """All blocks as one result; parts are freed column by column."""
        streams = []
        for key in self.order:
            frame = _concatenated(self.parts.pop(key))
            streams.append(Stream(key[0], key[1], frame, self.attributes[key]))  # type: ignore[arg-type]
        back = _steps_back(streams[0].frame) if streams else 0
        return ReadResult(
            self.reader,
            tuple(streams),
            self.lines,
            self.accepted,
            self.blank,
            tuple(self.rejected),
            self.warnings.result(back),
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
        if name in _COUNTED:
            made[name] = made.get(name, 0) + value
        elif name == "clock" and made.get(name) != value:
            raise Whole  # what the times count from was read in two ways
        elif made.setdefault(name, value) != value:
            del made[name]
    return made


def _concatenated(parts: list[dict[str, AnyArray]]) -> pd.DataFrame:
    """Columns one behind the other, at most one of them held twice; a column that one part lacks is NaN there."""
    import numpy as np
    import pandas as pd

    names: list[str] = []
    for part in parts:
        names = in_order(names, list(part)) if list(part) != names else names
    lengths = [len(part["line"]) for part in parts]
    content: dict[str, Any] = {}
    for name in names:
        pieces = [part.pop(name, None) for part in parts]
        joined = np.concatenate(
            [np.full(n, np.nan) if piece is None else piece for n, piece in zip(lengths, pieces, strict=True)]
        )
        content[name] = pd.Series(joined, dtype=object, copy=False) if joined.dtype == object else joined
    made: pd.DataFrame = pd.DataFrame(content, copy=False)
    return made


def _steps_back(frame: pd.DataFrame) -> int:
    import numpy as np

    return int((np.diff(frame["time"].to_numpy().astype(np.int64)) < 0).sum())


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

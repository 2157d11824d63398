"""Logs of any size, read in blocks of lines: memory holds one block and the records.

A block ends between two lines that stand alone (``Reader.apart``), and the next one begins with the last line of
the one before: what a reader says about neighbours (a gap, a clock that steps back) is said once. The record of
that line is dropped again.
"""

from __future__ import annotations

import hashlib
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..common.errors import InputError
from .readers import Reader, ReadOptions
from .records import Attribute, ReadResult, RejectedLine, Stream

if TYPE_CHECKING:
    import pandas as pd

BLOCK_BYTES = 24 << 20
FROM_BYTES = 48 << 20
"""Smaller files are read in one piece."""
_CHUNK = 4 << 20
_MOST_RATIO = 1100
"""Deflate makes a file at most 1032 times smaller."""
_SUMMED = re.compile(r"(\d+ (samples|rows|times)|(time|offsets) (steps?|jump))\b")
"""Warnings whose numbers are counts: over blocks they add up."""


class Whole(Exception):  # noqa: N818 - no error: the caller reads the file in one piece
    """A log that cannot be read in blocks after all."""


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


def _blocks(chunks: Iterator[bytes], apart: re.Pattern[bytes]) -> Iterator[tuple[bytes, bool]]:
    """Blocks of whole lines, and whether the first line is the last of the block before."""
    parts: list[bytes] = []
    size, overlaps, enough = 0, False, BLOCK_BYTES
    for chunk in chunks:
        parts.append(chunk)
        size += len(chunk)
        if size < enough:
            continue
        data = b"".join(parts)
        cut = _cut(data, apart)
        if cut is None:  # one run of suppressed samples, or one line: more is needed
            parts, enough = [data], 2 * size
            continue
        last = data.rfind(b"\n", 0, cut - 1) + 1
        yield data[:cut], overlaps
        parts, overlaps, enough = [data[last:]], True, BLOCK_BYTES
        size = len(parts[0])
    data = b"".join(parts)
    if data:
        yield data, overlaps


def _cut(data: bytes, apart: re.Pattern[bytes]) -> int | None:
    """The last place between two lines that stand alone, among the last thousand."""
    after = data.rfind(b"\n")
    for _ in range(1000):
        before = data.rfind(b"\n", 0, max(after, 0))
        earlier = data.rfind(b"\n", 0, max(before, 0))
        if earlier < 0:
            return None
        if apart.match(data[before + 1 : after]) and apart.match(data[earlier + 1 : before]):
            return before + 1
        after = before
    return None


def read(place: Path, reader: Reader, options: ReadOptions) -> tuple[ReadResult, str]:
    """What ``reader.read`` gives for the whole file, and its SHA-256.

    Raises
    ------
    Whole
        If the log holds wall times that came twice: which pass a time belongs to depends on all lines before.
    InputError
        If a gzip file is damaged or cut.
    """
    assert reader.apart is not None
    digest = hashlib.sha256()
    gathered = _Gathered(reader.name)
    try:
        for data, overlaps in _blocks(_contents(place, digest), reader.apart):
            gathered.add(reader.read(data, options), overlaps=overlaps)
    except zlib.error as error:
        raise InputError(f"a damaged gzip file ({error})", cause="a cut download", path=place) from error
    return gathered.result(), digest.hexdigest()


class _Gathered:
    """Results of blocks, put together."""

    def __init__(self, reader: str) -> None:
        self.reader = reader
        self.lines = self.accepted = self.blank = 0
        self.rejected: list[RejectedLine] = []
        self.warnings: list[str] = []
        self.parts: dict[tuple[str, str], list[pd.DataFrame]] = {}
        self.attributes: dict[tuple[str, str], dict[str, Attribute]] = {}

    def add(self, result: ReadResult, *, overlaps: bool) -> None:
        """The next block."""
        if any("had twice" in text for text in result.warnings):
            raise Whole
        shift = self.lines - int(overlaps)
        doubled = [line for line in result.rejected if overlaps and line.number == 1]
        self.rejected += [
            RejectedLine(line.number + shift, line.reason, line.text) for line in result.rejected if line not in doubled
        ]
        self.lines += result.lines - int(overlaps)
        self.accepted += result.accepted - int(overlaps and not doubled)
        self.blank += result.blank
        self.warnings += result.warnings
        for stream in result.streams:
            key = (stream.kind, stream.name)
            frame = stream.frame
            if overlaps:
                frame = frame[frame["line"].to_numpy() > 1]
            if shift:
                frame = frame.assign(line=frame["line"] + shift)
            self.parts.setdefault(key, []).append(frame)
            known = self.attributes.setdefault(key, dict.fromkeys(stream.attributes, 0))
            for name, value in stream.attributes.items():
                counted = isinstance(value, int) and not isinstance(value, bool)
                known[name] = known.get(name, 0) + value if counted else value  # type: ignore[operator]

    def result(self) -> ReadResult:
        """All blocks as one result; parts are freed column by column."""
        streams = []
        for (kind, name), parts in self.parts.items():
            streams.append(Stream(kind, name, _concatenated(parts), self.attributes[kind, name]))  # type: ignore[arg-type]
            parts.clear()
        return ReadResult(
            self.reader,
            tuple(streams),
            self.lines,
            self.accepted,
            self.blank,
            tuple(self.rejected),
            _merged(self.warnings),
        )


def _concatenated(parts: list[pd.DataFrame]) -> pd.DataFrame:
    """Frames one behind the other, with at most one column held twice."""
    import numpy as np
    import pandas as pd

    names = list(parts[0].columns)
    columns = [{name: part[name].to_numpy() for name in names} for part in parts]
    parts.clear()
    content: dict[str, Any] = {}
    for name in names:
        joined = np.concatenate([one.pop(name) for one in columns])
        content[name] = pd.Series(joined, dtype=object, copy=False) if joined.dtype == object else joined
    made: pd.DataFrame = pd.DataFrame(content, copy=False)
    return made


def _merged(warnings: list[str]) -> tuple[str, ...]:
    """Warnings of all blocks: counts of one kind added up, others said once."""
    found: dict[str, list[list[int]]] = {}
    plain: dict[str, str] = {}
    for text in warnings:
        key = re.sub(r"\d+", "#", text) if _SUMMED.match(text) else text
        plain.setdefault(key, text)
        found.setdefault(key, []).append([int(number) for number in re.findall(r"\d+", text)])
    out = []
    for key, numbers in found.items():
        if "#" in key and len(numbers) > 1:
            totals = iter([sum(column) for column in zip(*numbers, strict=True)])
            out.append(re.sub("#", lambda _: str(next(totals)), key))  # noqa: B023 - used at once
        else:
            out.append(plain[key])
    return tuple(out)

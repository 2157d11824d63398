"""Logs larger than memory: a file as pieces of whole lines.

The one law of readers that take pieces (``Reader.read_pieces``): pieces of any size give what one piece gives. A reader
keeps of each piece the few numbers that it needs and settles what only the whole log can tell at the end.

Records of 2 GB fill memory all the same. Where only their number and span are asked for, ``Reader.read_sections`` gives
them section by section (:func:`spans`), and last a result with the sums over all.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from ...common.units import AnyArray
from ..records import ReadResult, Stream
from . import packed

PIECE_BYTES = 4 << 20


def file_pieces(place: Path, digest: Any) -> Iterator[bytes]:
    """Content of a log, unpacked, some MiB of whole lines at a time; ``digest`` takes that content."""
    chunks = packed.chunks(place, PIECE_BYTES)
    first = next(chunks, b"")
    content = chain((first,), chunks)
    yield from whole_lines(_counted(content if packed.form(first) is None else packed.pieces(content, place), digest))


def whole_lines(chunks: Iterable[bytes]) -> Iterator[bytes]:
    r"""The same bytes, each piece but the last with a line end at its end, without a byte order mark in front.

    Examples
    --------
    >>> list(whole_lines([b"a\nb", b"c", b"d\n", b"e"]))
    [b'a\n', b'bcd\n', b'e']
    """
    pending: list[bytes] = []
    started = False
    for chunk in chunks:
        cut = chunk.rfind(b"\n") + 1
        if not cut:
            pending.append(chunk)
            continue
        piece = b"".join([*pending, chunk[:cut]])
        yield piece if started else piece.removeprefix(b"\xef\xbb\xbf")
        started, pending = True, [chunk[cut:]] if cut < len(chunk) else []
    if pending:
        piece = b"".join(pending)
        yield piece if started else piece.removeprefix(b"\xef\xbb\xbf")


def _counted(chunks: Iterable[bytes], digest: Any) -> Iterator[bytes]:
    for chunk in chunks:
        digest.update(chunk)
        yield chunk


class Column:
    """A column that grows in place: pieces that are kept one by one and joined take twice the memory."""

    def __init__(self, dtype: Any, first: Any = ()) -> None:
        self._values: AnyArray = np.array(first, dtype=dtype)
        self._count = len(self._values)

    def __len__(self) -> int:
        """Count the values."""
        return self._count

    def extend(self, piece: AnyArray) -> None:
        """Values behind those that are there."""
        end = self._count + len(piece)
        if end > len(self._values):
            # a sixteenth more: few moves, little to spare
            self._values.resize(end + end // 16, refcheck=False)  # the system moves pages, not bytes
        self._values[self._count : end] = piece
        self._count = end

    def array(self) -> AnyArray:
        """The column; it takes no more values."""
        self._values.resize(self._count, refcheck=False)
        return self._values


class WholeLogError(Exception):
    """Something that only all records of a log together can settle."""


# Streams by section, and last the result without them.
Sections = Iterator[Stream | ReadResult]

# Records of a section, some 100 MB.
SECTION = 1 << 20


def spans(sections: Sections) -> ReadResult:
    """Result of a log whose streams hold the first and the last record in time, and how many there are.

    Raises
    ------
    WholeLogError
        If values are impossible, or days lie between records: the limits of quantities judge all of them together.
    """
    import pandas as pd

    from .. import limits

    ends: dict[str, Stream] = {}
    for stream in sections:
        if isinstance(stream, ReadResult):
            return replace(stream, streams=tuple(ends.values()))
        time, before = stream.frame["time"].to_numpy("datetime64[ns]"), ends.get(stream.name)
        latest = time[:1] if before is None else before.frame["time"].to_numpy("datetime64[ns]")[-1:]
        checked = limits.check(ReadResult("", (stream,), 0, 0, 0))
        if checked.warnings or not limits.one_run(np.concatenate([latest, time]).view(np.int64)):
            break
        frame, rows = stream.frame.iloc[[int(time.argmin()), int(time.argmax())]], len(time)
        if before is not None:
            frame = pd.concat([before.frame, frame]).sort_values("time", kind="stable").iloc[[0, -1]]
            rows += before.rows
        ends[stream.name] = replace(stream, frame=frame, stand_for=rows)
    raise WholeLogError

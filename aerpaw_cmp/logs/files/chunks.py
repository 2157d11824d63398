"""Logs larger than memory: a file as pieces of whole lines.

The one law of readers that take pieces (``Reader.read_pieces``): pieces of any size give what one piece gives. A reader
keeps of each piece the few numbers that it needs and settles what only the whole log can tell at the end.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from ...common.units import AnyArray
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

    def __init__(self, dtype: Any) -> None:
        self._values: AnyArray = np.empty(0, dtype=dtype)
        self._count = 0

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

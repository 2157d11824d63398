"""What whole columns of a log decide, gathered over its blocks: a log in one piece is one block.

A block decides for itself where all blocks must decide alike (the form of times); what differs sends the table to be
read in one piece. The rest is settled when all blocks are there.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import pandas as pd

from aerpaw_cmp.common.units import BoolArray
from aerpaw_cmp.logs import blocks
from aerpaw_cmp.logs.readers import InBlocks, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, Stream

from . import _frames, _json


@dataclass
class Decided:
    """Answers so far.

    Parameters
    ----------
    answers : dict
        One per question.
    marks : set
        What was seen at least once.
    kept : dict
        What the next block has to know.
    tables : int
        Blocks that had rows.
    """

    answers: dict[str, Hashable] = field(default_factory=dict)
    marks: set[Hashable] = field(default_factory=set)
    kept: dict[Hashable, Any] = field(default_factory=dict)
    tables: int = 0
    _ended: bool = False
    _one_piece: bool = False

    def begin(self, rows: int, *, foot: bool) -> None:
        """A block of so many rows; with words below the table no rows may follow. Raises ``blocks.Whole``."""
        if rows:
            self.tables += 1
            if self._ended or (self._one_piece and self.tables > 1):
                raise blocks.Whole
        self._ended |= foot

    def agree(self, question: str, answer: Hashable) -> None:
        """Raise ``blocks.Whole`` where an earlier block decided otherwise."""
        if self.answers.setdefault(question, answer) != answer:
            raise blocks.Whole

    def one_piece(self) -> None:
        """Let no second block come; raises ``blocks.Whole`` where this is one."""
        self._one_piece = True
        if self.tables > 1:
            raise blocks.Whole


ReadBlock = Callable[[bytes, ReadOptions, Decided], ReadResult]
Settle = Callable[[ReadResult, Decided], ReadResult]


def in_one_piece(read: ReadBlock, settle: Settle, data: bytes, options: ReadOptions) -> ReadResult:
    """A table as one block, settled."""
    decided = Decided()
    return settle(read(data, options, decided), decided)


def in_blocks(read: ReadBlock, settle: Settle, head: Callable[[bytes], int]) -> InBlocks:
    """Reading a table in blocks, each behind its first ``head(data)`` bytes."""

    def read_log(chunks: Iterator[bytes], options: ReadOptions) -> ReadResult:
        decided = Decided()
        pieces = _joined(chunks, _CHUNKS * blocks.BLOCK_BYTES)
        return blocks.by_lines(
            lambda data, given: read(data, given, decided),
            head=lambda data, _options: head(data),
            settle=lambda result: settle(result, decided),
        )(pieces, options)

    return read_log


def json_in_blocks(read: ReadBlock) -> InBlocks:
    """Reading JSON lines in blocks; each sees the last object of the one before, too, which must change nothing."""

    def read_log(chunks: Iterator[bytes], options: ReadOptions) -> ReadResult:
        decided = Decided()
        return blocks.by_lines(lambda data, given: read(data, given, decided), apart=_json.WHOLE)(chunks, options)

    return read_log


_CHUNKS = 4
"""Tables of cells have some hundred streams, each with a frame per block: fewer blocks, larger ones."""


def _joined(chunks: Iterator[bytes], size: int) -> Iterator[bytes]:
    """The same bytes in larger pieces."""
    parts: list[bytes] = []
    for chunk in chunks:
        parts.append(chunk)
        if sum(map(len, parts)) >= size:
            yield b"".join(parts)
            parts = []
    yield b"".join(parts)


def finished(result: ReadResult, streams: Iterable[Stream], *warnings: str) -> ReadResult:
    """A result with its settled streams; how often the clock steps back is counted anew in the first of them."""
    kept = tuple(stream for stream in streams if len(stream.frame))
    back = _frames.steps_back(kept[0].frame) if kept else []
    more = dict.fromkeys([*warnings, *back])
    return blocks.with_warnings(replace(result, streams=kept), without="^time steps back at ", more=tuple(more))


def ordered(place: Callable[[Stream], Any]) -> Callable[[ReadResult], ReadResult]:
    """Settles a log whose blocks may have met its streams in another order than that of the whole.

    Parameters
    ----------
    place : callable
        Where a stream stands among the others.
    """
    return lambda result: finished(result, sorted(result.streams, key=place))


def without(frame: pd.DataFrame, where: BoolArray) -> pd.DataFrame:
    """A frame without some rows; the old one is emptied column by column: one more of a large log is too much."""
    if not where.any():
        return frame
    keep, content = ~where, {}
    for name in map(str, frame.columns.tolist()):
        values = frame.pop(name).to_numpy()[keep]
        content[name] = pd.Series(values, dtype=object, copy=False) if values.dtype == object else values
    made: pd.DataFrame = pd.DataFrame(content, copy=False)
    return made

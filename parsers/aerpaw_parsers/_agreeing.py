"""Reading in blocks of JSON lines where something is decided by the whole log: all blocks must decide alike."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator

from aerpaw_cmp.logs import blocks
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.records import ReadResult

from . import _json


def in_blocks(
    read: Callable[[bytes, ReadOptions, set[Hashable]], ReadResult],
) -> Callable[[Iterator[bytes], ReadOptions], ReadResult]:
    """``in_blocks`` of a reader that adds to a set how it understood a block: two ways, and the log is read whole."""

    def read_log(chunks: Iterator[bytes], options: ReadOptions) -> ReadResult:
        decided: set[Hashable] = set()

        def read_block(data: bytes, given: ReadOptions) -> ReadResult:
            result = read(data, given, decided)
            if len(decided) > 1:
                raise blocks.Whole
            return result

        return blocks.by_lines(read_block, apart=_json.WHOLE)(chunks, options)

    return read_log

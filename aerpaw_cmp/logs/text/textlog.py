"""A text format from its parts: the regular expression of its rows, what marks it, and the streams of its columns.

:func:`reader` does the rest: sniffing, the account of all lines, times, torn last lines.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

from ...common.counting import counted
from ...common.units import BoolArray, IntArray
from ..readers import Reader, ReadOptions
from ..records import Kind, ReadResult, Stream
from . import lines as _lines
from . import rows as _rows

Pattern = re.Pattern[bytes]
BOM = rb"(?:\xef\xbb\xbf)?"


def reader(
    name: str,
    title: str,
    *,
    kinds: tuple[Kind, ...],
    sample: str,
    row: Pattern | Callable[[bytes], Pattern],
    streams: Callable[[_rows.Rows], Iterable[Stream | None]],
    header: Pattern | None = None,
    mark: Pattern | None = None,
    torn: Pattern | None = None,
    otherwise: str = "of another form than the format's rows (torn line?)",
    fields: int = 0,
    clock: str = "wall",
    skip: Callable[[bytes, IntArray], BoolArray] | None = None,
) -> Reader:
    r"""A reader of lines that a pattern describes.

    Parameters
    ----------
    name, title, kinds, sample
        As of :class:`aerpaw_cmp.logs.readers.Reader`.
    row : re.Pattern or callable
        See :func:`aerpaw_cmp.logs.text.rows.matched`; a callable makes it of the beginning of the file (of its
        header, say).
    streams : callable
        ``streams(rows)``: the streams of the rows; its docstring is the reader's.
    header : re.Pattern, optional
        The whole line above a table: a comment wherever it stands. A file is known by its first line where there is
        one, by ``mark`` where there is one, else by most of its first lines being rows.
    mark : re.Pattern, optional
        MULTILINE; a line by which a console is known.
    torn : re.Pattern, optional
        How a row of a console begins: such a line that is no row is rejected, all other lines are talk. Without it
        every line that is neither row nor header is rejected.
    otherwise : str
        Reason of rejected lines.
    fields : int
        Number of fields of a table: lines with others are rejected with their number.
    clock : str
        See :func:`aerpaw_cmp.logs.text.rows.times`.
    skip : callable, optional
        ``skip(data, lines)``: which of the matching lines (0-based) are comments after all.

    Returns
    -------
    Reader
    """

    def reason(line: bytes) -> str | None:
        if header is not None and header.fullmatch(line):
            return None
        if torn is not None:
            return "an incomplete row (torn line?)" if torn.match(line) else None
        count = line.count(b",") + 1
        return f"{counted(count, 'field')}, expected {fields} (torn line?)" if fields not in (0, count) else otherwise

    def read(data: bytes, options: ReadOptions) -> ReadResult:
        pattern = row if isinstance(row, re.Pattern) else row(data)
        left_out = None if skip is None else lambda lines: skip(data, lines)
        rows = _rows.matched(data, pattern, options, reader=name, reason=reason, clock=clock, skip=left_out)
        return rows.result(streams(rows))

    def known(head: bytes) -> bool:
        if header is not None:
            return header.fullmatch(head[:4000].split(b"\n", 1)[0]) is not None
        return _lines.mostly(head, row) if isinstance(row, re.Pattern) else False

    def marked(head: bytes) -> bool:
        # an expression that begins with a line's start takes 5 ms of each MiB, and a KML gives it four of them
        return mark is not None and not head.startswith(_lines.MARKUP) and mark.search(head) is not None

    return Reader(
        name=name, title=title, kinds=kinds, sample=sample, sniff=known if mark is None else marked,
        read=read,
    )  # fmt: skip

"""A small HTML table: what a notebook shows of a record."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence


def html_table(titles: Sequence[str], rows: Iterable[Sequence[object]], caption: str = "") -> str:
    """A table with a head; every text is escaped.

    Examples
    --------
    >>> html_table(["tower"], [["LW1"]])
    '<table><thead><tr><th>tower</th></tr></thead><tbody><tr><td>LW1</td></tr></tbody></table>'
    """
    head = "".join(f"<th>{html.escape(title)}</th>" for title in titles)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    # a caption comes first in a table: HTML allows it nowhere else
    name = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    return f"<table>{name}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"

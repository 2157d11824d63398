"""Files of a folder of results: text in pieces, numbers as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any


def merge(into: dict[str, Any], numbers: Mapping[str, Any]) -> None:
    """Put ``other`` into ``into``, key by key; what is only in ``into`` stays."""
    for key, value in numbers.items():
        if isinstance(value, Mapping) and isinstance(into.get(key), dict):
            merge(into[key], value)
        else:
            into[key] = value


def json_text(numbers: Mapping[str, Any], indent: int | None = 2) -> str:
    """Numbers as the text of a file."""
    return json.dumps(numbers, indent=indent, ensure_ascii=False, allow_nan=False) + "\n"


def write_file(path: Path, content: str | bytes | Iterator[str]) -> Path:
    """Write one file of a folder of results; its own folder is made when missing, but not that one's parent.

    Text may come in pieces.

    The set becomes whole, and errors become messages, in :class:`~aerpaw_cmp.common.outputs.OutputFolder`.
    """
    path.parent.mkdir(exist_ok=True)
    pieces = iter([content]) if isinstance(content, (str, bytes)) else content
    with path.open("wb") as file:
        for piece in pieces:
            file.write(piece.encode("utf-8") if isinstance(piece, str) else piece)
    return path

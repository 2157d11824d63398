"""Files that a settings file names: inputs, which no output may replace.

No list of keys: whatever text of the settings names a file is one, so that a new key cannot be forgotten.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel


def input_files(settings: BaseModel, path: Path, logs_root: Path | None = None) -> list[Path]:
    """A settings file and every file that one of its values names, against its folder or ``logs_root``."""
    roots = [path.parent] if logs_root is None else [logs_root, path.parent]
    return [path, *(place for _, _, place in named_files(settings.model_dump(), roots))]


def named_files(content: Any, roots: Sequence[Path]) -> Iterator[tuple[str, str, Path]]:
    """Dotted key, text and place of every value that names a file."""
    for key, text in _texts(content, ""):
        for root in roots:
            # most texts name nothing: a Path is made of those that do
            if os.path.isfile(os.path.join(root, text)):  # noqa: PTH113, PTH118  never raises
                yield key, text, root / text
                break


def _texts(value: Any, key: str) -> Iterator[tuple[str, str]]:
    """Every text in nested settings with its dotted key."""
    if isinstance(value, (str, Path)):
        yield key, str(value)
    elif isinstance(value, dict):
        for name, item in value.items():
            yield from _texts(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, (list, tuple)):
        for index, item in enumerate(value):
            yield from _texts(item, f"{key}.{index}" if key else str(index))

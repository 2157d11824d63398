"""Texts of one form, digits aside, at once: what a pattern finds in one of them is at the same place in all."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from aerpaw_cmp.common.units import AnyArray, FloatArray, IntArray

_AS_ZERO = bytes.maketrans(b"123456789", b"000000000")
_ZERO_FOR_DIGITS = np.frombuffer(bytes(range(256)).translate(_AS_ZERO), dtype=np.uint8)
_FEW = 8
"""Fewer texts are sooner read one by one."""
_MOST_FORMS = 16


@dataclass(frozen=True)
class Alike:
    """Texts of one form.

    Parameters
    ----------
    first : str
        One of them.
    at : int array, shape (n,)
        Which of all texts these are.
    cells : uint8 array, shape (n, m)
        Their characters; empty where they are few or beyond ASCII, to be read one by one.
    """

    first: str
    at: IntArray
    cells: AnyArray

    def __len__(self) -> int:
        """Count the texts."""
        return len(self.at)

    @property
    def at_once(self) -> bool:
        """Whether the characters are there."""
        return self.cells.size > 0

    def whole(self, span: tuple[int, int]) -> IntArray:
        """Digits between two places as numbers; 0 where there are none."""
        total = np.zeros(len(self), dtype=np.int64)
        for column in self.cells[:, span[0] : span[1]].T:
            total = total * 10 + (column - np.uint8(48))
        return total

    def numbers(self, span: tuple[int, int]) -> FloatArray:
        """Decimals between two places, with a point or a comma."""
        part = self.cells[:, span[0] : span[1]].copy()
        part[part == 44] = 46
        return np.asarray(part.view(f"S{part.shape[1]}").ravel().astype(np.float64))


def grouped(texts: Sequence[str]) -> list[Alike]:
    """Texts by their form, in the order of its first text."""
    groups: dict[bytes, list[int]] = {}
    coded = [text.encode("utf-8", "surrogatepass") for text in texts]
    for i, code in enumerate(coded):
        groups.setdefault(code.translate(_AS_ZERO), []).append(i)
    made = []
    for form, at in groups.items():
        few = len(at) < _FEW or not form or not form.isascii() or b"\0" in form
        cells = b"" if few else b"".join([coded[i] for i in at])
        room = np.frombuffer(cells, dtype=np.uint8).reshape(len(at), -1) if cells else np.zeros((0, 0), dtype=np.uint8)
        made.append(Alike(texts[at[0]], np.array(at, dtype=np.int64), room))
    return made


class Cells(Sequence[str]):
    """Texts of a column that never were objects of Python.

    Parameters
    ----------
    cells : bytes array, shape (n,)
        ASCII without NUL.
    """

    def __init__(self, cells: AnyArray) -> None:
        self.cells = cells

    def __len__(self) -> int:
        """Count the texts."""
        return len(self.cells)

    def __getitem__(self, i: Any) -> Any:
        """One of them as a text."""
        return self.cells[i].decode("ascii")

    def grouped(self) -> list[Alike] | None:
        """As :func:`grouped`; None where there are many forms, or where marks or spaces stand around a text."""
        width = self.cells.dtype.itemsize
        table = np.ascontiguousarray(self.cells).view(np.uint8).reshape(len(self), width)
        forms = np.zeros((len(self), -(-width // 8) * 8), dtype=np.uint8)
        forms[:, :width] = _ZERO_FOR_DIGITS[table]
        left, words = np.arange(len(self)), forms.view(np.uint64)
        made: list[Alike] = []
        while len(left):
            alike = np.logical_and.reduce([word == word[0] for word in words.T])
            at = left[alike]
            first = self[int(at[0])]
            if len(made) == _MOST_FORMS or first != bare(first):
                return None
            few = len(at) < _FEW or not first
            cells = table if len(at) == len(table) else table[at]
            made.append(Alike(first, at, np.zeros((0, 0), dtype=np.uint8) if few else cells[:, : len(first)]))
            left, words = left[~alike], words[~alike]
        return made


def bare(text: str) -> str:
    """A text without the spaces and quotes around it."""
    return text.strip().strip('"').strip()


def spans(found: re.Match[str]) -> list[tuple[int, int]]:
    """Places of a match and of its groups; an empty one where a group found nothing."""
    return [(max(begin, 0), max(end, 0)) for begin, end in (found.span(i) for i in range(found.re.groups + 1))]

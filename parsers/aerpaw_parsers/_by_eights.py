"""Decimals of a table eight characters at a time: a word of 64 bits holds eight, and NumPy takes many words at once.

What is no plain decimal (a word, an exponent, more digits than a float64 holds exactly) is left to the caller's
slower, stricter way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray, IntArray

from . import _lines, _table

_MOST = 24
"""Bytes of three words."""
_DIGITS = 18
"""Digits of a whole number that an int64 holds, whatever they are."""
_TENS = 10.0 ** np.arange(_MOST)
_POINT = 0x2E ^ 0x30


class _Form:
    """Constants for words of four or of eight bytes."""

    def __init__(self, dtype: type[np.unsignedinteger[Any]], signed: type[np.signedinteger[Any]], size: int) -> None:
        def each(byte: int) -> Any:
            return dtype(sum(byte << 8 * i for i in range(size)))

        self.dtype, self.signed, self.size = dtype, signed, size
        self.zeros, self.points, self.seven, self.top = each(0x30), each(_POINT), each(0x7F), each(0x80)
        self.above_nine = each(0x76)
        self.last = np.array([(2 ** (8 * n) - 1) << 8 * (size - n) for n in range(size + 1)], dtype=dtype)
        self.pairs = []
        for bits, ten in [(8, 10), (16, 100), (32, 10_000)][: size.bit_length() - 1]:
            mask = sum((2 ** (bits // 2) - 1) << at for at in range(0, 8 * size, bits))  # what the step before left
            self.pairs.append((dtype(mask), dtype(ten * 2**bits + 1), dtype(bits)))


_FOUR, _EIGHT = _Form(np.uint32, np.int32, 4), _Form(np.uint64, np.int64, 8)


def table(data: bytes, count: int, separator: int = 44) -> tuple[_lines.Lines, _table.Fields]:
    """Lines of a text, and the fields of those that have ``count``: both by one look at the bytes."""
    buffer = np.frombuffer(data, dtype=np.uint8)
    places = _lines.places(buffer, separator, 10)
    rows = len(places) // count
    if (
        not rows
        or data[-1] != 10
        or len(places) != rows * count
        or int(np.count_nonzero(buffer == 10)) != rows
        or not (buffer[places[count - 1 :: count]] == 10).all()
    ):
        lines = _lines.split(data)
        return lines, _table.fields(lines, count, separator)
    ends = places.reshape(rows, count)
    starts, stops = np.zeros(rows, dtype=np.int64), ends[:, -1].copy()
    np.add(stops[:-1], 1, out=starts[1:])
    if b"\r" in data:
        stops -= (stops > starts) & (buffer[np.maximum(stops - 1, 0)] == 13)
        ends[:, -1] = stops
    return _lines.Lines(data, starts, stops), _table.Fields(np.arange(rows), starts, ends)


@dataclass(frozen=True)
class Decimals:
    """Columns of numbers.

    Parameters
    ----------
    value : list of float arrays, each of shape (n,)
        As ``float`` reads each cell; NaN where it is empty, anything where it is odd.
    odd : list of bool arrays, each of shape (n,)
        Cells that are neither empty nor a plain decimal.
    """

    value: list[FloatArray]
    odd: list[BoolArray]


def decimals(lines: _lines.Lines, found: _table.Fields, wanted: Sequence[int], *, comma: bool = False) -> Decimals:
    """Columns of the fields of n lines as numbers.

    Parameters
    ----------
    lines : Lines
    found : Fields
    wanted : sequence of int
        Columns to read.
    comma : bool
        Whether a comma is a decimal sign, as a point is.
    """
    room, before = lines.buffer, 0
    if comma or (len(found.rows) and found.begin[0] < _MOST) or lines.unterminated:
        room, before = np.zeros(len(lines.data) + 2 * _MOST, dtype=np.uint8), _MOST
        room[_MOST : _MOST + len(lines.data)] = lines.buffer
    if comma:
        room[room == 44] = 46
    made = Decimals([], [])
    for column in wanted:
        value, odd = _column(room, found.start(column) + before, found.ends[:, column] + before)
        made.value.append(value)
        made.odd.append(odd)
    return made


def _column(room: AnyArray, begin: IntArray, end: IntArray) -> tuple[FloatArray, BoolArray]:
    """Numbers of cells, and which are none; ``_MOST`` bytes stand in front of the first."""
    size = end - begin
    lead = room[begin]
    minus = empty = None
    if lead.min() < 46 or not size.all():  # a sign, or an empty cell: any separator stands behind it
        minus, empty = lead == 45, size == 0
        signed = minus | (lead == 43)
        size -= signed
        empty &= ~signed
    longest = int(size.max())
    width = next((width for width in (4, 8, 16) if longest <= width), _MOST)
    cells = np.ndarray((len(room) - width + 1,), dtype=f"S{width}", buffer=room, strides=(1,))[end - width]
    value, odd = (_short if longest <= 16 else _long)(cells, width, size, longest)
    if minus is not None:
        odd |= (size == 0) & signed
        sign = minus.astype(np.uint64)
        sign <<= np.uint64(63)
        value.view(np.uint64)[:] ^= sign
        value[empty] = np.nan
    return value, odd


def _short(cells: AnyArray, width: int, size: IntArray, longest: int) -> tuple[FloatArray, BoolArray]:
    """Cells of one or two words: fifteen digits over a power of ten round once."""
    if width == 4:
        value, places, odd = _word(_FOUR, cells.view(np.uint32), size)
    else:
        value, places, odd = _word(_EIGHT, cells.view(np.uint64)[width // 8 - 1 :: width // 8], size)
    if width == 16:
        few = longest <= 12
        words = cells.view(np.uint32)[1::4] if few else cells.view(np.uint64)[::2]
        high, above, worse = _word(_FOUR if few else _EIGHT, words, size - 8)
        pointed, higher = np.asarray(places) >= 0, np.asarray(above) >= 0
        high *= np.where(pointed, 1e7, 1e8)  # a point takes the place of a digit: seven are left
        value += high
        odd |= worse
        odd |= pointed & higher
        places = np.where(pointed, places, np.where(higher, above + 8, 0))
    value /= _TENS[np.maximum(places, 0)]
    return value, odd


def _long(cells: AnyArray, width: int, size: IntArray, longest: int) -> tuple[FloatArray, BoolArray]:  # noqa: ARG001
    """Cells of three words, up to eighteen digits."""
    words = cells.view(np.uint64).reshape(len(cells), 3)
    (low, a, odd), (middle, b, worse), (high, c, worst) = (
        _word(_EIGHT, words[:, 2 - i], size - 8 * i) for i in range(3)
    )
    first, second, third = (np.asarray(places) >= 0 for places in (a, b, c))
    odd |= worse
    odd |= worst
    odd |= (first & second) | ((first | second) & third)
    odd |= size > np.where(first | second | third, _DIGITS + 1, _DIGITS)
    digits = low.astype(np.int64)
    digits += middle.astype(np.int64) * np.where(first, 10**7, 10**8)
    digits += high.astype(np.int64) * np.where(first | second, 10**15, 10**16)
    places = np.where(first, a, np.where(second, np.asarray(b) + 8, np.where(third, np.asarray(c) + 16, 0)))
    odd |= (places > 15) & (digits > 2**53)
    digits[odd] = 0
    return _quotient(digits, places), odd


def _quotient(digits: IntArray, places: AnyArray) -> FloatArray:
    """Whole numbers over powers of ten, rounded once; at most fifteen places where they are above 2**53.

    Notes
    -----
    The remainder of a rounded quotient is a float64; Dekker's product gives it (T. J. Dekker, Numerische Mathematik
    18, 1971, doi:10.1007/BF01397083). With what the whole number loses as a float64 it is a multiple of the quotient's
    last place, and less than 2**53 of them as the power is at most 1e15: it is exact. Over the power of ten it
    corrects the quotient; the error of that, 2e-16 of a last place, is less than the distance of any such decimal from
    a midpoint of two float64 that it does not hit, 2.5e-16.
    """
    ten = np.broadcast_to(_TENS[places], digits.shape)
    whole = digits.astype(np.float64)
    lost = (digits - whole.astype(np.int64)).astype(np.float64)
    value = whole / ten
    product = value * ten
    a, b = _halves(value)
    c, d = _halves(ten)
    error = ((a * c - product) + a * d + b * c) + b * d
    value += (((whole - product) - error) + lost) / ten
    return np.asarray(value)


def _halves(value: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Two float64 of half the digits each, whose sum is the value."""
    scaled = value * 134_217_729.0
    upper = scaled - (scaled - value)
    return upper, value - upper


def _word(form: _Form, word: AnyArray, size: IntArray) -> tuple[FloatArray, AnyArray | int, BoolArray]:
    """Numbers in the last ``size`` bytes, digits behind their point (-1: there is none), and which are odd."""
    word = word ^ form.zeros
    word &= form.last.take(size, mode="clip")
    spot = word[int(size.argmax())].tobytes().find(_POINT)
    if spot >= 0:
        shift, beyond = form.dtype(8 * spot), form.dtype(8 * spot + 8)
        point = word >> shift
        point &= form.dtype(0xFF)
        fits, places = point == _POINT, form.size - 1 - spot
        everywhere = bool(fits.all())
        if everywhere or (fits | (size <= 0)).all():
            below = word & form.dtype((1 << 8 * spot) - 1)
            below <<= form.dtype(8)
            word >>= beyond
            word <<= beyond
            word |= below
            odd = _no_digits(form, word)
            odd |= size == places + 1  # the point comes first
            return _number(form, word), places if everywhere else np.where(fits, places, -1), odd
    odd = _no_digits(form, word)
    if not odd.any():
        return _number(form, word), -1, odd
    word, behind = _without_point(form, word, size)
    return _number(form, word.copy()), behind, _no_digits(form, word)


def _without_point(form: _Form, word: AnyArray, size: IntArray) -> tuple[AnyArray, IntArray]:
    """Words without the first of their points, wherever it is, and how many bytes stood behind it (-1: no point)."""
    here = word ^ form.points
    rest = here & form.seven
    rest += form.seven
    rest |= here
    rest |= form.seven
    np.invert(rest, out=rest)  # 0x80 where a point is
    rest &= form.dtype(0) - rest  # the first
    rest >>= form.dtype(7)  # a power of 256, or none
    none = rest == 0
    place = np.zeros(len(rest), dtype=np.int64)
    for byte in range(1, form.size):
        place[rest == form.dtype(1 << 8 * byte)] = byte
    places = form.size - 1 - place
    places[none] = -1
    below = rest - form.dtype(1)
    above = np.invert(below << form.dtype(8) | form.dtype(0xFF))
    made = np.where(none, word, (word & above) | ((word & below) << form.dtype(8)))
    made[~none & (place == form.size - size)] = form.seven  # the point comes first: no digits
    return made, places


def _no_digits(form: _Form, word: AnyArray) -> BoolArray:
    """Words with a byte above nine."""
    sums = word + form.above_nine
    sums |= word
    sums &= form.top
    return np.asarray(sums != 0)


def _number(form: _Form, word: AnyArray) -> FloatArray:
    """Digits, the first in the lowest byte, as a number; the word is used up."""
    for mask, factor, shift in form.pairs:
        word &= mask  # of the first step: digits need four bits
        word *= factor
        word >>= shift
    return np.asarray(word.view(form.signed).astype(np.float64))

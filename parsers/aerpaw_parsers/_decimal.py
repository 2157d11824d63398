"""Plain decimals straight from bytes, one NumPy step per character column.

Nothing here loops over lines. What is not plain (exponents, ``nan``, signs of plus) is reported as invalid and left
to the caller's slower, stricter way.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray

_ROOM = (2**53 - 9) // 10  # one digit more is still exact in float64


def decimal(columns: Iterable[AnyArray], count: int) -> tuple[FloatArray, BoolArray]:
    """Right-aligned decimals, spaces in front.

    Parameters
    ----------
    columns : iterable of uint8 arrays, each of shape (n,)
        Characters from left to right.
    count : int
        n.

    Returns
    -------
    value : float array, shape (n,)
        As ``float`` reads the text: a mantissa up to 2**53 over an exact power of ten rounds once.
    valid : bool array, shape (n,)
        Whether the text is a plain decimal that can be read so.
    """
    mantissa, places = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    begun, dotted, negative, last = (np.zeros(count, dtype=bool) for _ in range(4))
    valid = np.ones(count, dtype=bool)
    for column in columns:
        digit = column - np.uint8(48)
        is_digit = digit <= 9
        minus, dot, space = column == 45, column == 46, column == 32
        # spaces then a minus may come first, one point only behind a digit
        valid &= is_digit | ((space | minus) & ~begun) | (dot & ~dotted & last)
        valid &= ~is_digit | (mantissa < _ROOM)
        negative |= minus
        begun |= ~space
        mantissa = np.where(is_digit, mantissa * 10 + digit, mantissa)
        places += is_digit & dotted
        dotted |= dot
        last = is_digit
    valid &= last & (places <= 22)
    value = mantissa / 10.0 ** np.where(valid, places, 0)
    return np.where(negative, -value, value), valid

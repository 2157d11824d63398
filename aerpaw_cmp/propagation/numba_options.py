"""Compiler options of every kernel; imported only where numba is there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
from numba.core import config
from numba.extending import register_jitable

from .compiled import cache_folder

FOLDER = cache_folder()
_MATHS: dict[str, Any] = {"error_model": "numpy", "fastmath": False}
_PART: dict[str, Any] = {"forceinline": True, "_nrt": False}


def kernel(function: Callable[..., Any], **options: Any) -> Any:
    """Decorator of a kernel: compiled at its first call, kept in :data:`FOLDER` where something can be written."""
    options = options or {"_nrt": True}  # said, or it would be that of the first caller
    before = config.CACHE_DIR
    config.CACHE_DIR = "" if FOLDER is None else str(FOLDER)  # numba asks for it when a function is decorated
    try:
        return numba.njit(cache=FOLDER is not None, nogil=True, **_MATHS, **options)(function)
    finally:
        config.CACHE_DIR = before


def part(function: Callable[..., Any]) -> Any:
    """Decorator of a part of kernels that makes no array.

    A call would hand over each array of its records, hundreds of words, and count its users up and down: four fifths of
    the time of a search went there. The caller holds the arrays, so nothing is counted in a part (numba's ``_nrt``).
    """
    return kernel(function, **_PART)


def law(function: Callable[..., Any], *, inline: bool = True) -> None:
    """Let kernels call a law of plain Python, which NumPy evaluates as it is; in place of the call, or by a call."""
    register_jitable(**_MATHS, forceinline=inline)(function)

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


def kernel(function: Callable[..., Any], *, inlined: bool = False) -> Any:
    """Decorator of a kernel: compiled at its first call, kept in :data:`FOLDER` where something can be written."""
    before = config.CACHE_DIR
    config.CACHE_DIR = "" if FOLDER is None else str(FOLDER)  # numba asks for it when a function is decorated
    try:
        return numba.njit(cache=FOLDER is not None, nogil=True, forceinline=inlined, **_MATHS)(function)
    finally:
        config.CACHE_DIR = before


def part(function: Callable[..., Any]) -> Any:
    """Decorator of a part of kernels: a call would hand over each array of its records, hundreds of words."""
    return kernel(function, inlined=True)


def law(function: Callable[..., Any]) -> None:
    """Let kernels call a law of plain Python, which NumPy evaluates as it is."""
    register_jitable(**_MATHS, forceinline=True)(function)

"""Compiler options of every kernel. This module is imported only if numba is available."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
from numba.core import config
from numba.core.serialize import dumps
from numba.extending import register_jitable

from ..common.files import read_sealed, write_sealed
from .compiled import code_folder

FOLDER = code_folder()
_MARK = b"aerpaw-cmp kernel 1\n"
# As NumPy: 1 / 0 is infinite, not an exception; and no sum is reordered, or bits would differ.
_MATHS: dict[str, Any] = {"error_model": "numpy", "fastmath": False}
_PART: dict[str, Any] = {"forceinline": True, "_nrt": False}


def kernel(function: Callable[..., Any], **options: Any) -> Any:
    """Compile a kernel at its first call, and cache it in :data:`FOLDER` if that can be written."""
    options = options or {"_nrt": True}  # set explicitly, or the option of the first caller would be used
    compiled = numba.njit(nogil=True, **_MATHS, **options)(function)
    if FOLDER is not None:
        before = config.CACHE_DIR
        config.CACHE_DIR = str(FOLDER)  # numba requires a private folder here, but does not store anything in it
        try:
            compiled.enable_caching()
        finally:
            config.CACHE_DIR = before
        # after numba has created its cache, which would unpickle any file in the folder
        compiled._cache._cache_file = _Sealed(function)
    return compiled


class _Sealed:
    """The compiled code of one kernel on disk, instead of numba's files, whose damage raises any exception or crashes.

    An entry is followed by its SHA-256. A damaged entry is ignored, and the kernel is compiled again. Only this user
    can write to the folder (:func:`aerpaw_cmp.propagation.compiled.code_folder`), since an entry contains machine code.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._name = f"{function.__module__}.{function.__qualname__}"

    def _place(self, key: Any) -> Path:
        assert FOLDER is not None
        # hashed: a signature of records is longer than a file name may be
        return FOLDER / f"{self._name}-{sha256(repr(key).encode()).hexdigest()[:32]}.kernel"

    def load(self, key: Any) -> Any:
        """Return the compiled code of a signature. None if it is not stored."""
        try:
            content = read_sealed(self._place(key), _MARK)
        except ValueError:
            return None
        return None if content is None else pickle.loads(content)

    def save(self, key: Any, data: Any) -> None:
        """Keep the compiled code of a signature."""
        write_sealed(self._place(key), dumps(data), _MARK)


def part(function: Callable[..., Any]) -> Any:
    """Decorator of a part of kernels that makes no array.

    A call would hand over each array of its records, hundreds of words, and count its users up and down: four fifths of
    the time of a search went there. The caller holds the arrays, so nothing is counted in a part (numba's ``_nrt``).
    """
    return kernel(function, **_PART)


def law(function: Callable[..., Any], *, inline: bool = True) -> None:
    """Let kernels use a formula in plain Python, which NumPy also evaluates. ``inline`` inserts its body."""
    register_jitable(**_MATHS, forceinline=inline)(function)

"""How every function is compiled; imported only where numba is there."""

from __future__ import annotations

from typing import Any

from numba import njit


def can_keep() -> bool:
    """Whether compiled code can be kept: beside this file, in the user's cache folder, or in ``NUMBA_CACHE_DIR``."""
    try:
        njit(cache=True)(can_keep)
    except RuntimeError:  # no folder that can be written
        return False
    return True


OPTIONS: dict[str, Any] = {"cache": can_keep(), "nogil": True, "error_model": "numpy", "fastmath": False}
"""Not kept where nothing can be written: it is compiled anew by each process, and runs."""

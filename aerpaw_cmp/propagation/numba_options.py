"""How every kernel is compiled, and the folder that keeps the code; imported only where numba is there.

numba's cache on disk notices a change in the file of a kernel alone: laws and constants that a kernel takes from
another file would stay as they were compiled. So the folder is named by a hash of every source of compiled code.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
from numba.core import config
from numba.extending import register_jitable

ROOM = Path(__file__).parent
SOURCES = (
    "field/dyads.py", "field/fresnel.py", "field/kernels.py",
    "growth.py", "merging.py", "boxtree.py", "image.py", "numba_options.py",
)  # fmt: skip
"""Files of kernels, and those whose functions and constants they take in."""


def source_hash() -> str:
    """Hash of the sources, of numba's version and of Python's."""
    made = sha256(f"{numba.__version__} {sys.version_info[:3]}".encode())
    for name in SOURCES:
        made.update((ROOM / name).read_bytes())
    return made.hexdigest()[:16]


def cache_folder() -> Path | None:
    """Folder of compiled code: ``NUMBA_CACHE_DIR``, beside this file or the user's cache; None if none is kept."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    for base in (Path(given),) if given else (ROOM / "__pycache__", home / "aerpaw-cmp" / "compiled"):
        folder = base / f"kernels-{source_hash()}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    return None


FOLDER = cache_folder()
_MATHS: dict[str, Any] = {"error_model": "numpy", "fastmath": False}


def kernel(function: Callable[..., Any]) -> Any:
    """Decorator of a kernel: compiled at its first call, kept in :data:`FOLDER` where something can be written."""
    before = config.CACHE_DIR
    config.CACHE_DIR = "" if FOLDER is None else str(FOLDER)  # numba asks for it when a function is decorated
    try:
        return numba.njit(cache=FOLDER is not None, nogil=True, **_MATHS)(function)
    finally:
        config.CACHE_DIR = before


def law(function: Callable[..., Any]) -> None:
    """Let kernels call a law of plain Python, which NumPy evaluates as it is."""
    register_jitable(**_MATHS)(function)

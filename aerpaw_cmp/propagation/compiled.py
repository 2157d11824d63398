"""Compiled code of the path search among thousands of faces: options of kernels, folder of the code, and threads.

numba is optional (extra ``fast``). Importing numba and reading compiled code takes about a second, and compiling takes
ten to thirty seconds, once per machine. NumPy finds the same paths among few faces in about the same time, so compiled
code is used only for more faces (:func:`aerpaw_cmp.propagation.engines.by_beams`).
``AERPAW_CMP_COMPILED=never`` switches compiled code off.

numba's cache on disk notices only changes in the file of a kernel. If a formula or constant changes in another file
that a kernel imports, the old compiled code would still be used. The name of the folder therefore contains a hash of
every source of compiled code.
"""

from __future__ import annotations

import os
import pickle
import sys
import tempfile
import warnings
from collections.abc import Callable
from functools import lru_cache
from hashlib import sha256
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ..common.errors import UsageError
from ..common.files import cache_folder, read_sealed, write_sealed

ROOM = Path(__file__).parents[1]
SWITCH = "AERPAW_CMP_COMPILED"
# Modules of compiled code, and modules whose functions and constants it includes.
SOURCES = (
    "propagation/search/beams.py", "propagation/search/merging.py", "propagation/search/mirror.py",
    "propagation/geometry.py", "propagation/compiled.py",
)  # fmt: skip

_MARK = b"aerpaw-cmp kernel 1\n"
# As in NumPy, 1 / 0 is infinite and not an exception. Sums are not reordered, because the last bits would differ.
_MATHS: dict[str, Any] = {"error_model": "numpy", "fastmath": False}


def is_allowed() -> bool:
    """Return False if ``AERPAW_CMP_COMPILED`` is ``never``.

    Raises
    ------
    UsageError
        If the variable has an unknown value.
    """
    value = os.environ.get(SWITCH, "auto").strip().lower() or "auto"
    if value not in ("auto", "never"):
        raise UsageError(f"{SWITCH}={value}", expected="auto or never")
    return value == "auto"


def _source_hash() -> str:
    """Return the hash of the sources and of the versions of numba and Python."""
    # machine code depends on the versions of numba and Python
    digest = sha256(f"{version('numba')} {sys.version_info[:3]}".encode())
    for name in SOURCES:
        digest.update((ROOM / name).read_bytes())
    return digest.hexdigest()[:16]


@lru_cache(maxsize=1)
def code_folder() -> Path | None:
    """Return the private folder of compiled code, or None if no folder can be used.

    The folder is in ``NUMBA_CACHE_DIR``, the package or the user's cache.
    """
    named = os.environ.get("NUMBA_CACHE_DIR")
    for base in (Path(named),) if named else (ROOM / "__pycache__", cache_folder("compiled")):
        folder = base / f"kernels-{_source_hash()}"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            status = folder.stat()
            # refuse a folder that other users can write to: they could leave code there that this process would run
            if hasattr(os, "geteuid") and (status.st_uid != os.geteuid() or status.st_mode & 0o022):
                continue
            # try to write, because no other test covers permissions, quotas and read-only mounts
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    return None


def why_missing() -> str:
    """Return the reason why compiled code cannot run, or an empty text if it can."""
    return _failure() if is_allowed() else f"{SWITCH}=never"


@lru_cache(maxsize=1)
def _failure() -> str:
    """Import the kernels and try them. Any exception is a reason to use NumPy, not an error.

    A broken installation has many symptoms (no LLVM for this processor, a NumPy that is too new, a truncated cache),
    and NumPy returns the same result.
    """
    if find_spec("numba") is None:
        return "numba is not installed (pip install 'aerpaw-cmp[fast]')"
    if os.path.lexists(".numba_config.yaml"):  # such a file can make numba write files
        return "the working folder contains a .numba_config.yaml, which numba would apply"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numba warns about its cache
            # a broken LLVM fails only when something is compiled, not on import
            import_module("aerpaw_cmp.propagation.search.beams").try_out()
    except Exception as error:
        line = (str(error).splitlines() or [""])[0]
        return f"compiled code cannot run ({type(error).__name__}: {line})"
    return ""


@lru_cache(maxsize=1)
def warn_once(reason: str) -> None:
    """Warn that compiled code cannot run, with the reason."""
    warnings.warn(f"{reason}: the job runs in NumPy, up to ten times slower", RuntimeWarning, stacklevel=4)


def thread_count() -> int:
    """Return the number of cores that this process may use. A container or taskset may limit it."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # this function does not exist on macOS and Windows
        return os.cpu_count() or 1


def kernel(function: Callable[..., Any], **options: Any) -> Any:
    """Compile a kernel at its first call, and cache it in :func:`code_folder` if that can be written."""
    import numba
    from numba.core import config

    options = options or {"_nrt": True}  # explicit, else the first caller's option would apply
    compiled = numba.njit(nogil=True, **_MATHS, **options)(function)
    if (folder := code_folder()) is not None:
        before = config.CACHE_DIR
        config.CACHE_DIR = str(folder)  # numba requires a private folder here, but does not store anything in it
        try:
            compiled.enable_caching()
        finally:
            config.CACHE_DIR = before
        # replace the cache that numba created, because it would unpickle any file in the folder
        compiled._cache._cache_file = _CheckedCache(function, folder)
    return compiled


class _CheckedCache:
    """The compiled code of one kernel on disk.

    Each entry ends with its SHA-256, because damaged machine code can crash the process. A damaged entry is ignored,
    and the kernel is compiled again. Only this user can write to the folder (:func:`code_folder`), since an entry
    contains machine code.
    """

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        self._folder = folder
        self._name = f"{function.__module__}.{function.__qualname__}"

    def _place(self, key: Any) -> Path:
        # use a hash, because the signature of a record is too long for a file name
        return self._folder / f"{self._name}-{sha256(repr(key).encode()).hexdigest()[:32]}.kernel"

    def load(self, key: Any) -> Any:
        """Return the compiled code for a signature. None if it is not stored."""
        try:
            content = read_sealed(self._place(key), _MARK)
        except ValueError:
            return None
        return None if content is None else pickle.loads(content)

    def save(self, key: Any, data: Any) -> None:
        """Store the compiled code for a signature."""
        from numba.core.serialize import dumps

        write_sealed(self._place(key), dumps(data), _MARK)


def part(function: Callable[..., Any]) -> Any:
    """Compile a function that kernels call and that does not create an array.

    Reference counting is switched off for the function (numba's ``_nrt``), because the caller keeps the arrays alive.
    Updating the counts of the arrays at each call took four fifths of the time of a search.
    """
    return kernel(function, forceinline=True, _nrt=False)

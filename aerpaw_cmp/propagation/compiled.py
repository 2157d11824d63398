"""Use of the compiled path search: whether it runs, the folder for its code, and threads.

numba is optional (extra ``fast``). Importing numba and reading compiled code takes about a second. Compiling takes ten
to thirty seconds, once per machine. A job is therefore compiled only if NumPy would take longer: the sum of the
estimated seconds of all jobs of a process decides, and a first report never waits for a compiler.
``AERPAW_CMP_COMPILED`` overrides the choice: ``auto``, ``never`` or ``always``.

numba's cache on disk notices only changes in the file of a kernel. Formulas and constants that a kernel imports from
another file would stay as they were compiled. The folder name therefore contains a hash of every source of compiled
code.
"""

from __future__ import annotations

import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ..common.errors import UsageError
from ..common.files import cache_folder
from ..common.units import AnyArray

ROOM = Path(__file__).parents[1]
SWITCH = "AERPAW_CMP_COMPILED"
BEAMS = "propagation.search.beams"
# Modules of compiled code, and modules whose functions and constants it includes.
SOURCES = (
    "propagation/search/beams.py", "propagation/search/merging.py", "propagation/search/mirror.py",
    "propagation/geometry.py", "propagation/compiled.py", "propagation/numba_options.py",
)  # fmt: skip

# CPU seconds of the first compilation on a machine.
COMPILE_S = 25.0
# CPU seconds of NumPy above which importing numba and reading compiled code pays off.
READ_S = 0.4
# A job that NumPy finds in less time always uses NumPy, even if numba is loaded.
LEAST_S = 0.25

# CPU seconds of NumPy per link and face, sequences of two reflections: 2.2 s in a map of 12 780 links, 245 faces and
# ten heights, which with numba took 1.6 s and 110 MiB more.
MIRRORS_S = 7e-8


@dataclass(frozen=True, slots=True)
class State:
    """The compiled code, or the reason why it is not available."""

    kernels: ModuleType | None
    reason: str


def switch() -> str:
    """The value of ``AERPAW_CMP_COMPILED``.

    Raises
    ------
    UsageError
        If the value is not known.
    """
    value = os.environ.get(SWITCH, "auto").strip().lower() or "auto"
    if value not in ("auto", "never", "always"):
        raise UsageError(f"{SWITCH}={value}", expected="auto, never or always")
    return value


def _source_hash() -> str:
    """Return the hash of the sources, of numba's version and of Python's."""
    # machine code depends on the versions of numba and Python
    digest = sha256(f"{version('numba')} {sys.version_info[:3]}".encode())
    for name in SOURCES:
        digest.update((ROOM / name).read_bytes())
    return digest.hexdigest()[:16]


@lru_cache(maxsize=1)
def code_folder() -> Path | None:
    """Return the private folder of compiled code, or None if no folder can be used.

    It is in ``NUMBA_CACHE_DIR``, the package or the user's cache.
    """
    named = os.environ.get("NUMBA_CACHE_DIR")
    for base in (Path(named),) if named else (ROOM / "__pycache__", cache_folder("compiled")):
        folder = base / f"kernels-{_source_hash()}"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            # other users could leave code for us to run in a folder that they can write to
            if not _is_private(folder.stat()):
                continue
            # only a trial is reliable: rights, quotas and read-only mounts cannot be distinguished otherwise
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    return None


def _is_private(status: os.stat_result) -> bool:
    """Check whether only this user can write to a folder, because its contents will be executed."""
    return not hasattr(os, "geteuid") or (status.st_uid == os.geteuid() and not status.st_mode & 0o022)


class _Spent:
    """The estimated CPU seconds of NumPy that this process spent on searches: many small jobs count as a large one."""

    seconds = 0.0


def beams_for(links: int, faces: int) -> bool:
    """Check whether compiled beams are worth their start where mirror images in NumPy would find the same paths."""
    chosen, numpy_s = switch(), links * faces * MIRRORS_S
    _Spent.seconds += numpy_s
    if chosen == "never" or (chosen == "auto" and (numpy_s < LEAST_S or _Spent.seconds < _cost_s())):
        return False
    state = load()
    if state.kernels is None and (chosen == "always" or find_spec("numba") is not None):
        warn_once(state.reason)
    return state.kernels is not None


def beams() -> State:
    """The search among thousands of faces (:mod:`aerpaw_cmp.propagation.search.beams`), or why it cannot run."""
    if switch() == "never":
        return State(None, f"{SWITCH}=never")
    return load()


def _cost_s() -> float:
    """Return the CPU seconds until compiled code runs: it is loaded, kept on disk, or has to be compiled."""
    # loaded already: nothing left to pay
    if f"aerpaw_cmp.{BEAMS}" in sys.modules:
        return LEAST_S
    folder = code_folder() if find_spec("numba") else None
    return READ_S if folder is not None and (folder / f"{BEAMS}.compiled").exists() else COMPILE_S


@lru_cache(maxsize=1)
def load() -> State:
    """Import the kernels and try them. Any failure is a reason to use NumPy, not an error.

    A broken installation has many symptoms (no LLVM for this processor, a NumPy that is too new, a truncated cache),
    and NumPy returns the same result.
    """
    if find_spec("numba") is None:
        return State(None, "numba is not installed (pip install 'aerpaw-cmp[fast]')")
    if os.path.lexists(".numba_config.yaml"):  # it names files that numba then writes, and may come from a third party
        return State(None, "the working folder holds a .numba_config.yaml, which numba would obey")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numba's own, about its cache
            kernels = import_module(f"aerpaw_cmp.{BEAMS}")
            # a broken LLVM fails only when something is compiled, not on import
            kernels.try_out()
            if (folder := code_folder()) is not None:
                (folder / f"{BEAMS}.compiled").touch()
    except Exception as error:
        line = (str(error).splitlines() or [""])[0]
        return State(None, f"compiled code cannot run ({type(error).__name__}: {line})")
    return State(kernels, "")


@lru_cache(maxsize=1)
def warn_once(reason: str) -> None:
    """Say why compiled code is not there."""
    warnings.warn(f"{reason}: the job runs in NumPy, up to ten times slower", RuntimeWarning, stacklevel=4)


def thread_count() -> int:
    """Threads to use: the cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS and Windows
        return os.cpu_count() or 1


def in_threads(call: Callable[[Any], Any], parts: Iterable[Any], threads: int) -> list[Any]:
    """Return ``call(part)`` for each part, in order. Kernels release the interpreter's lock.

    No thread remains afterwards, so a process that is forked later has no threads.
    """
    parts = list(parts)
    count = min(threads, len(parts))
    if count < 2:
        return [call(part) for part in parts]
    # threads suffice: kernels let go of the interpreter's lock
    with ThreadPoolExecutor(count) as pool:
        waiting = [pool.submit(call, part) for part in parts]
        try:
            return [each.result() for each in waiting]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def column(values: AnyArray, kind: Any = np.float64) -> AnyArray:
    """Return an array with the layout that kernels require: one type, contiguous and writable."""
    # numba compiles separately for every layout and for read-only arrays
    return np.require(values, kind, ["C", "W"])

"""Whether and how the compiled kernels run: settings, fall-back to NumPy, threads.

numba is optional (extra ``fast``). Importing it and reading the compiled code takes about a second, the first
compilation on a machine some ten; so replays too small to gain from it stay with NumPy. The choice depends on the size
of the work alone: the same replay is evaluated the same way each time. ``AERPAW_CMP_COMPILED`` decides otherwise:
``auto``, ``never`` or ``always``.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from threading import Lock, Thread
from types import ModuleType
from typing import Any

import numpy as np

from ..common.errors import UsageError
from ..common.units import AnyArray

SWITCH = "AERPAW_CMP_COMPILED"
ENOUGH_WORK = 400_000
"""Element pairs of all links of a replay from which compiled code is faster, numba's import included
(``benchmarks/kernel.py --break-even``)."""


@dataclass(frozen=True, slots=True)
class State:
    """Compiled code, or why there is none."""

    kernels: ModuleType | None
    reason: str


def switch() -> str:
    """The value of ``AERPAW_CMP_COMPILED``.

    Raises
    ------
    UsageError
        If it is none of those known.
    """
    value = os.environ.get(SWITCH, "auto").strip().lower() or "auto"
    if value not in ("auto", "never", "always"):
        raise UsageError(f"{SWITCH}={value}", expected="auto, never or always")
    return value


def kernels_for(work: int) -> ModuleType | None:
    """Compiled kernels of the field, or None: the work (element pairs of links) is too small, or they cannot run."""
    return _chosen("field.kernels", work)


def beams() -> State:
    """The search among thousands of faces (:mod:`aerpaw_cmp.propagation.growth`), or why it cannot run."""
    if switch() == "never":
        return State(None, f"{SWITCH}=never")
    return load("growth")


def _chosen(name: str, work: int) -> ModuleType | None:
    chosen = switch()
    if chosen == "never" or (chosen == "auto" and work < ENOUGH_WORK):
        return None
    state = load(name)
    if state.kernels is None and (chosen == "always" or find_spec("numba") is not None):
        warn_once(state.reason)
    return state.kernels


@lru_cache(maxsize=4)
def load(name: str) -> State:
    """Import kernels and try them; whatever goes wrong there is a reason to do without, not an error.

    A broken installation shows itself in many ways (no LLVM for this processor, a NumPy too new, a cache cut short),
    and NumPy gives the same answer.
    """
    if find_spec("numba") is None:
        return State(None, "numba is not installed (pip install 'aerpaw-cmp[fast]')")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numba's own, about its cache
            kernels = import_module(f".{name}", __package__)
            kernels.try_out()
    except Exception as error:
        line = (str(error).splitlines() or [""])[0]
        return State(None, f"compiled code cannot run ({type(error).__name__}: {line})")
    return State(kernels, "")


@lru_cache(maxsize=1)
def warn_once(reason: str) -> None:
    """Say why compiled code is not there."""
    warnings.warn(f"{reason}: the replay runs in NumPy, some ten times slower", RuntimeWarning, stacklevel=4)


def thread_count(threads: int | None) -> int:
    """Threads to use: as asked, else the cores that this process may use."""
    if threads is not None:
        if threads < 1:
            raise UsageError(f"{threads} threads", expected="at least 1")
        return threads
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS and Windows
        return os.cpu_count() or 1


def in_threads(call: Callable[[Any], Any], parts: Iterable[Any], threads: int | None) -> list[Any]:
    """``call`` of each part, results in order; kernels release the interpreter's lock.

    The thread that asks works as well and takes the next part as the others do: a search of a thousand poses lasts some
    milliseconds, and a pool is one to start and to wait for. No thread stays: what is forked later has none.
    """
    parts = list(parts)
    count = min(thread_count(threads), len(parts))
    if count < 2:
        return [call(part) for part in parts]
    results: list[Any] = [None] * len(parts)
    faults: list[BaseException] = []
    numbers, one_at_a_time = iter(range(len(parts))), Lock()

    def work() -> None:
        while not faults:
            with one_at_a_time:
                number = next(numbers, None)
            if number is None:
                return
            try:
                results[number] = call(parts[number])
            except BaseException as error:  # of whatever thread: raised below
                faults.append(error)

    helpers = [Thread(target=work, daemon=True) for _ in range(count - 1)]
    for helper in helpers:
        helper.start()
    work()
    for helper in helpers:
        helper.join()
    if faults:
        raise faults[0]
    return results


def column(values: AnyArray, kind: Any = np.float64) -> AnyArray:
    """An array as kernels take it: of one type, contiguous, writable (a read-only one would be compiled for anew)."""
    return np.require(values, kind, ["C", "W"])

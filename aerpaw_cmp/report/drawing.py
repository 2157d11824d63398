"""Many figures drawn by several processes where that is safe and pays, else one after the other.

Matplotlib holds the interpreter lock, so threads gain nothing. A forked process has everything loaded and at hand; one
is made only on Linux, from a process that runs no further threads of Python and has not loaded Dr.Jit (whose own
threads do not survive a fork).
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

_Item = TypeVar("_Item")

FEWEST = 8
"""Figures below which a further process does not pay."""

_PR_SET_PDEATHSIG = 1
"""Of prctl(2) on Linux: the signal that the kernel sends when the parent ends."""

_work: list[Callable[[], object]] = []
"""What forked processes find when they start: closures cannot be sent to them."""


def in_order(draws: Sequence[Callable[[], _Item]], processes: int | None = None) -> Iterator[_Item]:
    """The results of functions without arguments, in their order, computed by several processes where it is safe.

    Parameters
    ----------
    draws : sequence of callable
        Each gives something that can be pickled.
    processes : int, optional
        How many; by default as :func:`usable_processes` says.

    Notes
    -----
    A process that dies (memory) costs time and nothing else: what is missing is computed here.
    """
    count = usable_processes(len(draws)) if processes is None else processes
    done = 0
    if count > 1:
        try:
            for result in _forked(draws, count):
                yield result
                done += 1
        except BrokenProcessPool:
            pass
    for draw in draws[done:]:
        yield draw()


def usable_processes(figures: int) -> int:
    """Processes that may share so many figures: cores of this process, one where forking is unsafe or pays nothing."""
    if figures < FEWEST or not sys.platform.startswith("linux"):
        return 1
    if threading.active_count() > 1 or any(name in sys.modules for name in ("drjit", "mitsuba")):
        return 1
    return min(len(os.sched_getaffinity(0)), 4)


def _forked(draws: Sequence[Callable[[], _Item]], processes: int) -> Iterator[_Item]:
    import multiprocessing

    _work[:] = draws
    context = multiprocessing.get_context("fork")
    pool = ProcessPoolExecutor(processes, context, initializer=_follow_parent, initargs=(os.getpid(),))
    try:
        with warnings.catch_warnings():
            # Python 3.12 warns of any thread, also the sleeping ones of BLAS, which know about forks
            warnings.simplefilter("ignore", DeprecationWarning)
            futures = [pool.submit(_draw, number) for number in range(len(draws))]
        for future in futures:
            yield future.result()  # type: ignore[misc]
    finally:
        pool.shutdown(cancel_futures=True)
        _work.clear()


def _follow_parent(parent: int) -> None:
    """Leave Ctrl-C to the parent, and end with it: a process left behind would hold the lock of its output."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before this was asked for
        os._exit(1)


def _draw(number: int) -> object:
    return _work[number]()

"""Many small computations shared by forked processes where that is safe and pays, else one after the other.

Matplotlib and NumPy on small arrays hold the interpreter lock, so threads gain nothing. A forked process has everything
loaded and at hand; one is made only on Linux, from a process that runs no further threads of Python, is not itself a
worker among others, and has loaded neither Dr.Jit nor CUDA (whose own threads do not survive a fork).
"""

from __future__ import annotations

import ctypes
import gc
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from .interrupts import held

_Item = TypeVar("_Item")

MOST = 4
"""Processes at most: what is shared here is a few seconds long."""

_PR_SET_PDEATHSIG = 1
"""Of prctl(2) on Linux: the signal that the kernel sends when the parent ends."""

_UNSAFE = ("drjit", "mitsuba", "numba.cuda")
_TICKET = 4
_TICKETS = 4096
"""Bytes of the number of a computation, and how many computations a pipe holds on any system (a fourth of 64 KiB)."""


def in_order(calls: Sequence[Callable[[], _Item]], processes: int | None = None, *, fewest: int = 2) -> Iterator[_Item]:
    """The results of functions without arguments, in their order, computed by several processes where it is safe.

    Parameters
    ----------
    calls : sequence of callable
        Each gives something that can be pickled.
    processes : int, optional
        How many; by default as :func:`usable_processes` says.
    fewest : int
        Functions below which a further process does not pay.

    Notes
    -----
    A process that dies (memory) costs time and nothing else: what is missing is computed here.
    """
    with ahead(calls, processes, fewest=fewest) as results:
        yield from results


@contextmanager
def ahead(
    calls: Sequence[Callable[[], _Item]], processes: int | None = None, *, fewest: int = 2
) -> Iterator[Iterator[_Item]]:
    """:func:`in_order`, begun at once: inside the block this process is free until it asks for the next result."""
    count = usable_processes() if processes is None else processes
    if count < 2 or not fewest <= len(calls) <= _TICKETS:
        yield (call() for call in calls)
        return
    with _shared(calls, min(count, len(calls))) as results:
        yield results


@contextmanager
def beside(call: Callable[[], _Item]) -> Iterator[Callable[[], _Item]]:
    """One computation in a further process while this one goes on; the block gets a function that waits for it.

    Where a fork is unsafe or there is one core, it is computed when it is asked for.
    """
    if usable_processes() < 2:
        yield call
        return
    with _shared([call], 1) as results:
        yield lambda: next(results)


@contextmanager
def _shared(calls: Sequence[Callable[[], _Item]], processes: int) -> Iterator[Iterator[_Item]]:
    shared = _Shared(calls, processes)
    try:
        yield iter(shared)
    finally:
        shared.end()


def usable_processes() -> int:
    """Processes that may share a computation: cores of this process, one where forking is unsafe."""
    import multiprocessing

    if not sys.platform.startswith("linux") or threading.active_count() > 1:
        return 1
    if multiprocessing.parent_process() is not None or any(name in sys.modules for name in _UNSAFE):
        return 1
    return min(len(os.sched_getaffinity(0)), MOST)


class _Shared(Generic[_Item]):
    """Computations that forked processes take from a pipe of their numbers, each its own way back."""

    def __init__(self, calls: Sequence[Callable[[], _Item]], processes: int) -> None:
        import multiprocessing

        self._calls = calls
        context = multiprocessing.get_context("fork")
        tickets, fill = os.pipe()
        os.write(fill, b"".join(number.to_bytes(_TICKET, "little") for number in range(len(calls))))
        os.close(fill)
        self._found: dict[int, _Item] = {}
        self._ways: list[Connection] = []
        self._children: list[Any] = []
        froze = not gc.get_freeze_count()  # what somebody else has frozen is to stay so
        if froze:
            gc.freeze()  # a collection in a child would touch, and so copy, all that it shares with this process
        with warnings.catch_warnings():
            # Python 3.12 warns of any thread, also the sleeping ones of BLAS, which know about forks
            warnings.simplefilter("ignore", DeprecationWarning)
            for _ in range(processes):
                here, there = context.Pipe(duplex=False)
                child = context.Process(target=_work, args=(calls, tickets, there, os.getpid()), daemon=True)
                try:
                    with held():  # what runs around a fork swallows an interrupt
                        child.start()
                except OSError:  # no process or memory left: those that run, or this one, do it all
                    here.close()
                    break
                finally:
                    there.close()
                _widen(here)
                self._ways.append(here)
                self._children.append(child)
        if froze:
            gc.unfreeze()
        os.close(tickets)

    def __iter__(self) -> Iterator[_Item]:
        for number, call in enumerate(self._calls):
            while number not in self._found and self._ways:
                self._receive()
            yield self._found.pop(number) if number in self._found else call()

    def _receive(self) -> None:
        """Take what has come; a way that was closed is one whose process is done, or dead."""
        for way in wait(self._ways):
            assert isinstance(way, Connection)
            try:
                answer = way.recv_bytes()
            except (EOFError, OSError):
                self._ways.remove(way)
                way.close()
                continue
            number, body = int.from_bytes(answer[:_TICKET], "little"), answer[_TICKET:]
            with suppress(Exception):  # what cannot be carried is computed here
                self._found[number] = pickle.loads(body)

    def end(self) -> None:
        """Leave nothing running."""
        for way in self._ways:
            way.close()
        for child in self._children:
            child.kill()
            child.join()
            child.close()


def _widen(way: Connection) -> None:
    """Room for a whole picture, so that a process goes on before the last one was taken."""
    import fcntl

    with suppress(OSError, AttributeError):
        fcntl.fcntl(way.fileno(), fcntl.F_SETPIPE_SZ, 1 << 20)


def _work(calls: Sequence[Callable[[], object]], tickets: int, way: Connection, parent: int) -> None:
    """What a forked process does: compute what is left, until nothing is.

    A computation that fails sends nothing but its number, and fails again where its message belongs.
    """
    _follow_parent(parent)
    while ticket := os.read(tickets, _TICKET):
        try:
            body = pickle.dumps(calls[int.from_bytes(ticket, "little")](), protocol=pickle.HIGHEST_PROTOCOL)
        except Exception:
            body = b""
        way.send_bytes(ticket + body)
    way.close()
    os._exit(0)  # nothing of the parent's is to be flushed or ended twice


def _follow_parent(parent: int) -> None:
    """Leave Ctrl-C to the parent, and end with it: a process left behind would hold the lock of its output."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before this was asked for
        os._exit(1)

"""Ctrl-C is never lost: what Python swallows of it is raised again where a job can be left.

An interrupt is an exception that may come anywhere, also where Python cannot raise one: in what runs around a fork, in
a finaliser, in the callback of a weak reference ("Exception ignored in ..."); before Python 3.12 one inside a class
body becomes a RuntimeError. A command notes that it came, looks again before each stage and before an output takes its
name, and holds it back for the moments in which a half-done step would be told wrongly.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_came = False


def came() -> bool:
    """Whether an interrupt came since :func:`noted` began; False outside of it."""
    return _came


def look() -> None:
    """Raise the interrupt that was swallowed.

    Raises
    ------
    KeyboardInterrupt
        If one came.
    """
    if _came:
        raise KeyboardInterrupt


@contextmanager
def noted() -> Iterator[None]:
    """Note the interrupts of a command; one in the background, which ignores them, goes on doing so.

    Raises
    ------
    KeyboardInterrupt
        For whatever became of one on its way, which is its cause then.
    """
    global _came
    if not _is_ours_to_set() or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    previous = sys.unraisablehook
    signal.signal(signal.SIGINT, _note)
    # Python shows a traceback of what it swallows: this one is not lost
    sys.unraisablehook = lambda what: None if what.exc_type is KeyboardInterrupt else previous(what)
    try:
        yield
    except Exception as error:
        if not _came:
            raise
        raise KeyboardInterrupt from error
    finally:
        _came = False
        sys.unraisablehook = previous
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _note(number: int, frame: FrameType | None) -> None:
    global _came
    _came = True
    signal.default_int_handler(number, frame)


@contextmanager
def held() -> Iterator[None]:
    """Hold interrupts back until the block has ended; they are raised then."""
    before = signal.getsignal(signal.SIGINT)
    if not _is_ours_to_set() or not callable(before):
        yield
        return
    seen: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _frame: seen.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if seen:
        before(seen[0], None)


def _is_ours_to_set() -> bool:
    return threading.current_thread() is threading.main_thread()

"""Ctrl-C, SIGTERM and SIGHUP are never lost: what Python swallows of one is raised again where a job can be left.

An interrupt is an exception that may come anywhere, also where Python cannot raise one: in what runs around a fork, in
a finaliser, in the callback of a weak reference ("Exception ignored in ..."); before Python 3.12 one inside a class
body becomes a RuntimeError. A command notes that it came, looks again before each stage and before an output takes its
name, and holds it back for the moments in which a half-done step would be told wrongly.

SIGTERM is what scancel, systemd and docker send, SIGHUP what a closed terminal does: both end a command as Ctrl-C does.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    _Handler = Callable[[int, FrameType | None], Any] | int | signal.Handlers | None

# What ends a command in order.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# Undone when :func:`noted` ends: hidden places whose owner an interrupt did not let finish its first step.
AT_END: list[Callable[[], None]] = []

_signalled = False
_last: int = signal.SIGINT


def interrupted() -> bool:
    """Check whether an interrupt came since :func:`noted` began; False outside of it."""
    return _signalled


def last() -> signal.Signals:
    """The signal of the latest interrupt, also after :func:`noted` has ended."""
    return signal.Signals(_last)


def raise_interrupt() -> None:
    """Raise the interrupt that was swallowed.

    Raises
    ------
    KeyboardInterrupt
        If one came.
    """
    if _signalled:
        raise KeyboardInterrupt


@contextmanager
def noted() -> Iterator[None]:
    """Note the interrupts of a command; a signal that the process ignores (nohup, background) stays ignored.

    Raises
    ------
    KeyboardInterrupt
        For whatever became of one on its way, which is its cause then.
    """
    global _signalled, _last
    ours = _set(SIGNALS, _note)
    if not ours:
        yield
        return
    _last = signal.SIGINT
    previous = sys.unraisablehook
    # Python shows a traceback of what it swallows: this one is not lost
    sys.unraisablehook = lambda what: None if what.exc_type is KeyboardInterrupt else previous(what)
    try:
        yield
    except Exception as error:
        if not _signalled:
            raise
        raise KeyboardInterrupt from error
    finally:
        _set(SIGNALS, signal.SIG_IGN, _note)
        while AT_END:
            AT_END.pop()()
        _signalled = False
        sys.unraisablehook = previous
        for number, before in ours:
            signal.signal(number, before)


def _set(numbers: tuple[int, ...], handler: _Handler, *untouched: _Handler) -> list[tuple[int, _Handler]]:
    """Take the signals that nobody else handles or ignores; gives their handlers of before."""
    if threading.current_thread() is not threading.main_thread():
        return []
    untouched = untouched or (signal.SIG_DFL, signal.default_int_handler)
    ours = [(number, signal.getsignal(number)) for number in numbers if signal.getsignal(number) in untouched]
    for number, _ in ours:
        signal.signal(number, handler)
    return ours


def _note(number: int, _frame: FrameType | None) -> None:
    global _signalled, _last
    _signalled, _last = True, number
    raise KeyboardInterrupt


@contextmanager
def held() -> Iterator[None]:
    """Hold interrupts back until the block has ended; they are raised then."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    signals: list[int] = []
    before = {number: signal.getsignal(number) for number in SIGNALS}
    ours = {number: handler for number, handler in before.items() if callable(handler)}
    for number in ours:
        signal.signal(number, lambda number, _frame: signals.append(number))
    try:
        yield
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)
    if signals and callable(handler := ours[signals[0]]):
        handler(signals[0], None)

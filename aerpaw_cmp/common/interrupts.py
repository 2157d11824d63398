"""Handling of Ctrl-C, SIGTERM and SIGHUP: an interrupt that Python swallows is raised later, at a safe point.

An interrupt is an exception that may occur anywhere, even where Python cannot pass it on: in code around a fork, in a
finaliser, in the callback of a weak reference. Python then only prints "Exception ignored in ...". Before Python 3.12
an interrupt inside a class body becomes a RuntimeError. A command records each interrupt, checks for it before each
stage and before an output is renamed, and delays it during steps that must not be interrupted.

A call of compiled code (LLVM, linear algebra, Sionna) may last for minutes, during which Python handles no signals. If
a signal arrives during such a call, a second thread ends the process.

scancel, systemd and docker send SIGTERM, and a closed terminal sends SIGHUP. Both signals end a command as Ctrl-C does.

A standard stream may be closed, its disk may be full, or its reader may have ended. Such errors are not reported as
bugs of the program.

The streams of a command store the first error of their descriptor and then discard output. :func:`output_fault` returns
this error.
"""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    _Handler = Callable[[int, FrameType | None], Any] | int | signal.Handlers | None

# Signals that end a command after it has cleaned up.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# The exit code after a signal is this number plus the number of the signal.
SIGNALLED = 128

# Functions that :func:`noted` calls when it ends. They remove hidden files whose creation was interrupted.
AT_END: list[Callable[[], None]] = []

# Time that compiled code may continue after a signal: half of the second within which a command should end.
PATIENCE_S = 0.5

_signalled = False
_last: int = signal.SIGINT


def interrupted() -> bool:
    """Check whether an interrupt occurred since :func:`noted` began. False outside that context."""
    return _signalled


def last() -> signal.Signals:
    """Return the signal of the latest interrupt, even after :func:`noted` has ended."""
    return signal.Signals(_last)


def raise_interrupt() -> None:
    """Raise the interrupt that Python swallowed, if there was one.

    Raises
    ------
    KeyboardInterrupt
        If an interrupt was swallowed.
    """
    if _signalled:
        raise KeyboardInterrupt


@contextmanager
def noted() -> Iterator[None]:
    """Record interrupts while a command runs. A signal that the process ignores (nohup, background) stays ignored.

    Raises
    ------
    KeyboardInterrupt
        If an interrupt became another exception, which is then the ``__cause__``.
    """
    global _signalled, _last
    ours = _set(SIGNALS, _note)
    if not ours:
        yield
        return
    _last = signal.SIGINT
    previous = sys.unraisablehook
    # do not let Python print that it ignored the interrupt, because the interrupt is raised later
    sys.unraisablehook = lambda what: None if what.exc_type is KeyboardInterrupt else previous(what)
    try:
        with _watched():
            yield
    except Exception as error:
        if not _signalled:
            raise
        raise KeyboardInterrupt from error
    finally:
        # ignore further signals, because they would stop the clean-up
        _set(SIGNALS, signal.SIG_IGN, _note)
        _clear()
        _signalled = False
        sys.unraisablehook = previous
        for number, before in ours:
            signal.signal(number, before)


def _set(numbers: tuple[int, ...], handler: _Handler, *untouched: _Handler) -> list[tuple[int, _Handler]]:
    """Set a handler for signals whose handler is in ``untouched`` (default: Python's), and return the old handlers."""
    if threading.current_thread() is not threading.main_thread():
        return []
    # keep the handlers of a program that embeds this package
    untouched = untouched or (signal.SIG_DFL, signal.default_int_handler)
    ours = [(number, signal.getsignal(number)) for number in numbers if signal.getsignal(number) in untouched]
    for number, _ in ours:
        signal.signal(number, handler)
    return ours


def _note(number: int, _frame: FrameType | None) -> None:
    global _signalled, _last
    _signalled, _last = True, number
    raise KeyboardInterrupt


def _clear() -> None:
    while AT_END:
        AT_END.pop()()


@contextmanager
def _watched() -> Iterator[None]:
    """Start a thread that handles signals while the main thread runs compiled code, which cannot handle them."""
    read, write = os.pipe()
    # set_wakeup_fd refuses a descriptor that could block the handler
    os.set_blocking(write, False)
    before = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    ended = threading.Event()
    threading.Thread(target=_watch, args=(read, ended), daemon=True).start()
    try:
        yield
    finally:
        ended.set()
        signal.set_wakeup_fd(before)
        # the second thread ends when it reads the end of the pipe
        os.close(write)


def _watch(signals: int, ended: threading.Event) -> None:
    """End the process if a signal is not delayed and Python could not run its handler for ``PATIENCE_S``."""
    while number := os.read(signals, 1):
        if not ended.wait(PATIENCE_S) and not _signalled and signal.getsignal(number[0]) is _note:
            _clear()
            # do not use print, because the blocked thread may hold the lock of the stream
            os.write(2, f"aerpaw-cmp: {cause(number[0])} in a long calculation; its output was not written\n".encode())
            # sys.exit would end only this thread
            os._exit(SIGNALLED + number[0])
    os.close(signals)


def cause(number: int) -> str:
    """Return the message for a process that a signal ended."""
    return "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"


@contextmanager
def held() -> Iterator[None]:
    """Delay interrupts until the block has ended, then raise them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    signals: list[int] = []
    before = {number: signal.getsignal(number) for number in SIGNALS}
    ours = {number: handler for number, handler in before.items() if callable(handler)}
    for number in ours:
        # do not block signals by a mask, because a thread of a library would receive them instead
        signal.signal(number, lambda number, _frame: signals.append(number))
    try:
        yield
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)
    if signals and callable(handler := ours[signals[0]]):
        handler(signals[0], None)


class _Descriptor(io.FileIO):
    """A standard descriptor that stores its first error until the end of the command."""

    fault: OSError | None = None

    def write(self, data: Any) -> int:
        if self.fault is None:
            try:
                return super().write(data)
            except OSError as error:
                self.fault = error
        # report all bytes as written, because the caller would otherwise try again forever
        return memoryview(data).nbytes


def guard() -> None:
    """Replace the standard streams of this process by :class:`_Descriptor`, except streams of tests or other programs.

    Closed descriptors are opened first: otherwise the next files that are opened would get the numbers of these
    descriptors and receive the printed output. Writing to the opened descriptors fails, as it did when they were
    closed.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        closed = _is_closed(number)
        if closed:
            os.open(os.devnull, os.O_RDONLY)  # the lowest free descriptor is the one that was closed
        stream = getattr(sys, name)
        buffer = getattr(stream, "buffer", None)
        raw = getattr(buffer, "raw", buffer)  # keep the buffering that PYTHONUNBUFFERED selects
        if number and (closed or stream is None or (type(raw) is io.FileIO and raw.fileno() == number)):
            encoding = getattr(stream, "encoding", None) or "utf-8"
            setattr(sys, name, _stream(number, encoding, buffered=buffer is None or buffer is not raw))


def _is_closed(number: int) -> bool:
    try:
        os.fstat(number)
    except OSError:
        return True
    return False


def _stream(number: int, encoding: str, *, buffered: bool) -> io.TextIOWrapper:
    raw = _Descriptor(number, "w", closefd=False)
    # escape a character that the terminal cannot show, instead of failing
    return io.TextIOWrapper(
        io.BufferedWriter(raw) if buffered else raw,  # type: ignore[arg-type]
        encoding=encoding,
        errors="backslashreplace",
        line_buffering=number == 2 or os.isatty(number),
        write_through=not buffered,
    )


def output_fault() -> OSError | None:
    """Flush standard output. Return the error if the flush or an earlier write failed, else None."""
    try:
        sys.stdout.flush()
    except OSError as error:
        return error
    # tests and notebooks replace sys.stdout by streams without our _Descriptor
    buffer = getattr(sys.stdout, "buffer", None)
    raw = getattr(buffer, "raw", buffer)
    return raw.fault if isinstance(raw, _Descriptor) else None

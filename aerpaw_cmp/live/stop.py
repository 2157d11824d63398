"""A request to end that wakes whoever waits."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import threading

from ..common.interrupts import SIGNALS


class Stop:
    """A request to end, from a signal or another thread; wakes the waiting tap.

    As a context it is asked by SIGINT, SIGTERM and SIGHUP, and is closed at the end. Signals reach the main thread
    alone, and an ignored one (nohup) stays so.
    """

    def __init__(self) -> None:
        # a full pipe must not block a signal handler
        self._read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self.reason = ""
        self.count = 0

    def __enter__(self) -> Stop:
        alone = threading.current_thread() is threading.main_thread()
        signals = [number for number in SIGNALS if alone and signal.getsignal(number) is not signal.SIG_IGN]
        self._before = [(n, signal.signal(n, lambda by, _: self(signal.Signals(by).name))) for n in signals]
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before:
            signal.signal(number, handler)
        self.close()

    def __call__(self, reason: str = "stop") -> None:
        """Ask for the end; a second time: at once."""
        self.reason = self.reason or reason
        self.count += 1
        with contextlib.suppress(OSError):
            os.write(self._write, b"x")

    def wait(self, timeout_s: float) -> bool:
        """Wait until asked, at most so long; whether asked."""
        poller = select.poll()
        poller.register(self._read, select.POLLIN)
        poller.poll(timeout_s * 1e3)
        return self.count > 0

    def fileno(self) -> int:
        """Readable once asked."""
        return self._read

    def close(self) -> None:
        """Close the pipe."""
        os.close(self._read)
        os.close(self._write)

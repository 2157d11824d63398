"""The terminal beside the polling: one that hangs (Ctrl-S, a lost ssh connection) holds no poll."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

from .session import TapStatus


class StatusNotifier:
    """Calls ``on_status`` in a thread of its own, in order; what a hanging terminal cannot take is let go.

    Parameters
    ----------
    on_status : callable
        If it raises, it is not called again: a broken terminal must not end the log.
    """

    def __init__(self, on_status: Callable[[TapStatus], None]) -> None:
        self._on_status = on_status
        self._queue: queue.Queue[TapStatus | None] = queue.Queue(maxsize=1000)
        self._thread = threading.Thread(target=self._run, name="tap-status", daemon=True)
        self._thread.start()

    def notify(self, status: TapStatus) -> None:
        """Pass a status on; a mere line is let go while others wait, a message only when memory is full."""
        if status.message or self._queue.qsize() < 10:
            try:
                self._queue.put_nowait(status)
            except queue.Full:
                return

    def close(self, timeout_s: float = 2.0) -> None:
        """Pass on what waits, but do not wait for a terminal that hangs."""
        try:
            self._queue.put_nowait(None)
        except queue.Full:
            return
        self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            while (status := self._queue.get()) is not None:
                self._on_status(status)
        except Exception:
            while self._queue.get() is not None:  # broken: only empty the queue
                pass

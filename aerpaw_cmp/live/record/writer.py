"""The log beside the polling: a disk that stalls for seconds, as memory cards do, delays no poll.

Each record is handed to a thread that writes it, and the polling waits for it, so that in the ordinary case a record
is in the kernel's hands before the next command goes out. It waits at most ``patience_s``: if the disk takes longer,
records queue up in memory (bounded) and the polling goes on.
"""

from __future__ import annotations

import threading
from collections import deque

from ...common.counting import counted
from ...logs.files.checksums import Record
from .log import SegmentLog


class LogWriter:
    """Writes to a :class:`~aerpaw_cmp.live.record.log.SegmentLog` in a thread of its own.

    Parameters
    ----------
    log : SegmentLog
        Not yet open; its settings bound the queue.
    """

    def __init__(self, log: SegmentLog) -> None:
        self.log = log
        log.on_fault = self._tell
        self._messages: deque[str] = deque(maxlen=100)
        self._queue: deque[tuple[Record, int]] = deque()
        self._bytes = 0
        self._dropped = 0
        self._changed = threading.Condition()
        self._busy = self._closing = self._sync_wanted = False
        self.free_bytes: int | None = None
        """Space left on the disk, as last seen."""
        self._thread = threading.Thread(target=self._run, name="tap-log", daemon=True)

    @property
    def lost(self) -> int:
        """Records that memory could not hold while the disk took none."""
        return self.log.lost + self._dropped

    @property
    def fault(self) -> str:
        """Reason why the disk takes no records now; empty while it does."""
        fault = self.log.fault
        return "" if fault is None else fault.reason

    def messages(self) -> list[str]:
        """Messages about the disk since the last call."""
        # by number: the writing thread may add to them meanwhile
        return [self._messages.popleft() for _ in range(len(self._messages))]

    def open(self) -> None:
        """Open the log; raises ``InputError`` as :meth:`SegmentLog.open` does."""
        self.log.open()
        self.free_bytes = self.log.free_bytes()
        self._thread.start()

    def append(self, record: Record) -> bool:
        """Hand over one record; True once the kernel has it, False if it waits in memory."""
        # about what the other fields of a record take as text
        size = 500 + sum(len(line) for line in record.get("lines", ()) if isinstance(line, str))
        settings = self.log.settings
        with self._changed:
            stalled = self._busy or bool(self._queue)
            self._queue.append((record, size))
            self._bytes += size
            while len(self._queue) > settings.backlog_records or self._bytes > settings.backlog_bytes:
                self._bytes -= self._queue.popleft()[1]
                self._dropped += 1
            self._changed.notify_all()
            # during a stall that was waited for once, do not wait again
            done = not stalled and self._changed.wait_for(self._idle, settings.patience_s)
        return done and self.log.fault is None

    def sync(self) -> None:
        """``fdatasync`` soon; waits for it at most ``patience_s``."""
        with self._changed:
            self._sync_wanted = True
            self._changed.notify_all()
            self._changed.wait_for(self._idle, self.log.settings.patience_s)

    def close(self, timeout_s: float = 30.0) -> None:
        """Write what waits and close; a disk that still hangs after the time is left alone."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self._dropped += len(self._queue)
            self._tell(f"the disk hangs: {counted(len(self._queue), 'record')} lost")
        else:
            self.log.close()

    # inside -----------------------------------------------------------------------------------------------

    def _tell(self, text: str) -> None:
        self._messages.append(text)

    def _idle(self) -> bool:
        return not (self._queue or self._busy or self._sync_wanted)

    def _run(self) -> None:
        pause_s = min(1.0, max(0.02, self.log.settings.sync_interval_s / 2))
        while True:
            with self._changed:
                self._changed.wait_for(lambda: not self._idle() or self._closing, pause_s)
                item = self._queue.popleft() if self._queue else None
                if item is not None:
                    self._bytes -= item[1]
                sync = item is None and self._sync_wanted
                closing = item is None and not sync and self._closing
                self._busy = item is not None or sync
            if closing:
                return
            self._work(item[0] if item is not None else None, sync)
            with self._changed:
                self._busy = False
                if sync:
                    self._sync_wanted = False
                self._changed.notify_all()

    def _work(self, record: Record | None, sync: bool) -> None:
        try:
            if record is not None:
                self.log.append(record)
            elif sync:
                self.log.sync()
            else:
                self.log.tick()
                self.free_bytes = self.log.free_bytes()
        except Exception as error:  # one bad record must not end the log
            self._dropped += record is not None
            self._tell(f"a record could not be written: {type(error).__name__}: {error}")

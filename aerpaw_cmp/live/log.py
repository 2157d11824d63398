"""The tap's durable log: append-only JSONL segments.

One record is one line, written by one ``write`` to an ``O_APPEND`` file, so a record that was written before a SIGKILL
is in the file. ``fdatasync`` is called at an interval, so a power loss destroys at most the records of one interval.
Each line ends with the CRC-32 of the preceding text, which distinguishes records from truncated or damaged lines.

A thread writes the records (:class:`TapLog`). The polling waits at most ``patience_s`` for each record, so a record is
normally in the kernel before the next command is sent.

The polling continues if the disk stalls for seconds, as memory cards do, or is full or read-only. Records wait in
bounded memory, in order, and are written when the disk accepts them again. Records that had to be dropped are counted
in a ``disk`` record.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..common.errors import InputError
from ..common.files import sync
from ..common.text import counted
from ..logs.files import Record, encode_record


@dataclass(frozen=True, slots=True)
class Clock:
    """The wall clock and the monotonic clock [ns]. Tests use simulated clocks."""

    utc_ns: Callable[[], int] = time.time_ns
    mono_ns: Callable[[], int] = time.monotonic_ns


def boot_id() -> str:
    """Return the identity of this boot. Monotonic times are only comparable within one boot."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def clock_synchronised() -> bool | None:
    """Check whether the kernel considers the wall clock synchronised (adjtimex(2)). None if that is unknown."""
    try:
        # modes = 0 only reads; the structure has 208 bytes, all unused here; 5 is TIME_ERROR
        state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.create_string_buffer(512))
    except (OSError, AttributeError):
        return None
    return None if state < 0 else bool(state != 5)


@dataclass(slots=True)
class LogSettings:
    """Settings for writing the log.

    Parameters
    ----------
    sync_interval_s : float
        Longest time between a record and its ``fdatasync``. 0: after every record.
    segment_bytes : int
        Size at which a segment is closed.
    segment_s : float
        Age at which a segment is closed [s].
    backlog_records, backlog_bytes : int
        Limits of the records that wait in memory while the disk does not accept them.
    retry_s : float
        Pause between attempts to write to a faulty disk [s].
    patience_s : float
        Longest time that the polling waits for a record to be written [s]. After that, the polling continues, and
        records wait in memory.
    """

    sync_interval_s: float = 1.0
    segment_bytes: int = 16 * 2**20
    segment_s: float = 3600.0
    backlog_records: int = 200_000
    backlog_bytes: int = 64 * 2**20
    retry_s: float = 1.0
    patience_s: float = 0.25


class TapLog:
    """The log of one session: numbered segments in a folder, and the thread that writes and syncs them.

    Parameters
    ----------
    folder : Path
        Folder of the segments, which is created if it does not exist.
    header : callable
        Returns the header record of each segment.
    settings : LogSettings
    clock : Clock

    Attributes
    ----------
    paths : list of Path
        The segments.
    records, bytes_written : int
        Lines and bytes in the segments.
    fault : str
        Reason why the disk cannot be written now. Empty if the disk can be written.
    free_bytes : int or None
        Free space on the disk for an ordinary user.
    """

    def __init__(
        self,
        folder: Path,
        header: Callable[[], Record],
        settings: LogSettings | None = None,
        clock: Clock | None = None,
    ) -> None:
        self._folder, self._header = folder, header
        self._settings, self._clock = settings or LogSettings(), clock or Clock()
        self.paths: list[Path] = []
        self.records = self.bytes_written = 0
        self.fault = ""
        self.free_bytes: int | None = None
        self._messages: deque[str] = deque(maxlen=100)
        self._changed = threading.Condition()
        self._queue: deque[tuple[Record, int]] = deque()
        self._queued_bytes = 0
        self._busy = self._closing = self._sync_wanted = False
        # use a counter for each of the two threads: with a common counter, counts could be lost
        self._dropped = self._refused = 0
        self._fault_since_ns = self._fault_lost = self._retry_ns = 0
        self._stem, self._fd, self._size, self._truncated, self._dirty = "", -1, 0, False, False
        self._opened_ns = self._synced_ns = 0
        self._thread = threading.Thread(target=self._run, name="tap-log", daemon=True)

    # for the polling thread -------------------------------------------------------------------------------

    @property
    def lost(self) -> int:
        """Number of records that were lost, because the disk did not accept them and memory was full."""
        return self._dropped + self._refused

    def open(self) -> None:
        """Make the folder and the first segment, and start the thread.

        Raises
        ------
        InputError
            If the folder cannot be written.
        """
        self._stem = time.strftime("tap_%Y%m%dT%H%M%SZ", time.gmtime(self._clock.utc_ns() / 1e9)) + f"_{os.getpid()}"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._new_segment()
        except OSError as error:
            raise InputError(
                f"cannot write a log here ({error.strerror})",
                expected="a folder after -o that can be written to",
                cause=_disk_cause(error),
                path=self._folder,
            ) from None
        self._measure_disk()
        self._thread.start()

    def append(self, record: Record) -> bool:
        """Pass one record to the thread. Return True if the kernel has it, False if the record waits in memory."""
        # approximate size of the other fields of a record as text
        size = 500 + sum(len(line) for line in record.get("lines", ()) if isinstance(line, str))
        with self._changed:
            stalled = self._busy or bool(self._queue)
            self._queue.append((record, size))
            self._queued_bytes += size
            limits = self._settings
            while len(self._queue) > limits.backlog_records or self._queued_bytes > limits.backlog_bytes:
                self._queued_bytes -= self._queue.popleft()[1]
                self._dropped += 1
            self._changed.notify_all()
            # during a stall of the disk, only the first record waits
            if not stalled:
                self._changed.wait_for(lambda: self._is_idle() or bool(self.fault), limits.patience_s)
            return self._is_idle() and not self.fault

    def sync(self) -> None:
        """Request ``fdatasync``, and wait at most ``patience_s`` for it."""
        with self._changed:
            self._sync_wanted = True
            self._changed.notify_all()
            self._changed.wait_for(self._is_idle, self._settings.patience_s)

    def messages(self) -> list[str]:
        """Return the messages about the disk since the last call."""
        # read the number once, because the writing thread may add messages meanwhile
        return [self._messages.popleft() for _ in range(len(self._messages))]

    def close(self, timeout_s: float = 30.0) -> None:
        """Write the waiting records and close. Do not wait longer than ``timeout_s`` for a disk that hangs."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        self._dropped += len(self._queue)
        if self._thread.is_alive():
            self._messages.append(f"the disk hangs: {counted(len(self._queue), 'record')} lost")

    def _is_idle(self) -> bool:
        return not (self._queue or self._busy or self._sync_wanted)

    # the writing thread -----------------------------------------------------------------------------------

    def _run(self) -> None:
        pause_s = min(1.0, max(0.02, self._settings.sync_interval_s / 2))
        closing, accepted = False, True
        while not closing or (self._queue and accepted):
            with self._changed:
                self._changed.wait_for(self._has_work, pause_s)
                closing = self._closing
                item = self._queue.popleft() if self._queue and (closing or self._can_retry()) else None
                self._queued_bytes -= 0 if item is None else item[1]
                sync, self._sync_wanted = item is None and self._sync_wanted, self._sync_wanted and item is not None
                self._busy = sync or item is not None
            if item is not None:
                accepted = self._take(*item)
            elif sync:
                self._sync()
            with self._changed:
                self._busy = False
                self._changed.notify_all()
            # after the kernel has the record, the polling continues; sync meanwhile
            if self._dirty and self._clock.mono_ns() - self._synced_ns >= self._settings.sync_interval_s * 1e9:
                self._sync()
            self._measure_disk()
        self._sync()
        self._close_fd()

    def _has_work(self) -> bool:
        return self._closing or self._sync_wanted or (bool(self._queue) and self._can_retry())

    def _can_retry(self) -> bool:
        return not self.fault or self._clock.mono_ns() >= self._retry_ns

    def _take(self, record: Record, size: int) -> bool:
        """Write a record of the queue. If the disk does not accept it, put it back and return False."""
        try:
            if self._fd < 0:
                self._new_segment()
            self._put(record)
        except OSError as error:
            self._fail(error)
            with self._changed:
                self._queue.appendleft((record, size))
                self._queued_bytes += size
            return False
        except Exception as error:  # an error in one record must not end the log
            self._refused += 1
            self._messages.append(f"a record could not be written: {type(error).__name__}: {error}")
        try:
            if self.fault and not self._queue:
                self._recover()
            full = self._size >= self._settings.segment_bytes
            if full or self._clock.mono_ns() - self._opened_ns > self._settings.segment_s * 1e9:
                self._rotate()
        except OSError as error:
            self._fail(error)
        return True

    def _put(self, record: Record) -> None:
        """Write a record as one line.

        The number of the record also counts lost records, so that readers notice the loss.
        """
        record["n"] = self.records + self.lost
        line = encode_record(record)
        # if a truncated line could not be removed, end it here, so that the checksum refuses only that line
        data = b"\n" + line if self._truncated else line
        written = os.write(self._fd, data)
        # if the disk became full within the line, remove the truncated line from the file
        if written < len(data):
            try:
                os.ftruncate(self._fd, self._size)
            except OSError:
                self._truncated = True
                self._size += written
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._truncated = False
        self._size += written
        self.bytes_written += written
        self.records += 1
        self._dirty = True

    def _fail(self, error: OSError) -> None:
        """Record that the disk failed, and set the time of the next attempt."""
        if error.errno in (errno.EIO, errno.EROFS, errno.EBADF, errno.ESTALE):
            self._close_fd()  # a failed sync may have dropped pages: use a new segment
        self._retry_ns = self._clock.mono_ns() + int(self._settings.retry_s * 1e9)
        if not self.fault:
            self.fault = error.strerror or str(error)
            self._fault_since_ns, self._fault_lost = self._clock.utc_ns(), self.lost
            self._messages.append(
                f"the log cannot be written: {self.fault}. {_disk_cause(error)}; records wait in memory"
            )

    def _recover(self) -> None:
        """Record that a fault is over, because the disk has accepted all waiting records."""
        os.fdatasync(self._fd)
        reason, lost, self.fault = self.fault, self.lost - self._fault_lost, ""
        period = {"from_utc_ns": self._fault_since_ns, "to_utc_ns": self._clock.utc_ns()}
        self._put({"kind": "disk", "reason": reason, **period, "lost": lost})
        self._messages.append(f"the disk accepts records again; {lost} were lost")

    def _rotate(self) -> None:
        self._put({"kind": "rotate", "next_segment": len(self.paths) + 1})
        self._sync()
        if not self.fault:
            self._close_fd()
            self._new_segment()

    def _new_segment(self) -> None:
        path = self._folder / f"{self._stem}_{len(self.paths) + 1:04d}.jsonl"
        # O_EXCL: never write into the segment of another session
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o644)
        self._size, self._truncated = 0, False
        try:
            self._put({**self._header(), "segment": len(self.paths) + 1})
            os.fdatasync(self._fd)
            # sync the folder: otherwise the name of the new file may be lost in a power loss
            sync(self._folder)
        except OSError:
            self._close_fd()
            with contextlib.suppress(OSError):
                path.unlink()  # it contains only a truncated header
            raise
        self.paths.append(path)
        self._opened_ns = self._synced_ns = self._clock.mono_ns()

    def _sync(self) -> None:
        if self._fd < 0 or self.fault:
            return
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            self._fail(error)
            return
        self._dirty, self._synced_ns = False, self._clock.mono_ns()

    def _close_fd(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _measure_disk(self) -> None:
        try:
            state = os.statvfs(self._folder)
            self.free_bytes = state.f_bavail * state.f_frsize
        except OSError:
            self.free_bytes = None


def _disk_cause(error: OSError) -> str:
    return {
        errno.ENOSPC: "the disk is full: free space or give another folder with -o",
        errno.EDQUOT: "the quota is used up: free space or give another folder with -o",
        errno.EFBIG: "a limit on file size: see 'ulimit -f'",
        errno.EROFS: "the disk is mounted read-only",
        errno.EACCES: "the folder belongs to another user: choose your own folder with -o",
        errno.EPERM: "the folder belongs to another user: choose your own folder with -o",
        errno.ENOTDIR: "part of the path is a file",
        errno.EEXIST: "part of the path is a file",
    }.get(error.errno or 0, "a failing disk or card")

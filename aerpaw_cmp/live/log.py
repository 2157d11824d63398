"""The tap's durable log: append-only JSONL segments.

One record is one line, written by one ``write`` to an ``O_APPEND`` file, so a record that was written before a SIGKILL
is in the file. ``fdatasync`` follows at an interval, so a power loss costs at most that interval. Each line ends with
the CRC-32 of the preceding text, which distinguishes records from truncated or damaged lines.

A disk that is full or read-only does not stop the caller. Records wait in bounded memory, in order, and are written
when the disk accepts them again. Records that had to be dropped are counted in a ``disk`` record.

A disk that stalls for seconds, as memory cards do, does not delay polls. Each record is passed to a thread that writes
it (:class:`LogWriter`). The polling waits at most ``patience_s`` for it, so a record is normally in the kernel before
the next command is sent. If the disk takes longer, records wait in bounded memory and the polling continues.
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
from dataclasses import dataclass, field
from pathlib import Path

from ..common.errors import InputError
from ..common.text import counted
from ..logs.files import Record, encode_record


@dataclass(frozen=True, slots=True)
class Clock:
    """The wall and monotonic clock [ns]. A test supplies others."""

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


def _sync_directory(folder: Path) -> None:
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


@dataclass(slots=True)
class LogSettings:
    """Settings for writing the log.

    Parameters
    ----------
    sync_interval_s : float
        Longest time between a record and its ``fdatasync``. 0: after every record.
    segment_bytes : int
        A segment is closed at this size.
    segment_s : float
        ... or at this age [s].
    backlog_records, backlog_bytes : int
        Limits of the records that wait in memory while the disk cannot be written.
    retry_s : float
        Pause between attempts on a faulty disk.
    patience_s : float
        Longest wait of the polling for a record to be written. Then the polling continues and records wait in memory.
    """

    sync_interval_s: float = 1.0
    segment_bytes: int = 16 * 2**20
    segment_s: float = 3600.0
    backlog_records: int = 200_000
    backlog_bytes: int = 64 * 2**20
    retry_s: float = 1.0
    patience_s: float = 0.25


@dataclass(slots=True)
class DiskFault:
    """An open fault of the log's disk."""

    reason: str
    since_utc_ns: int
    lost: int = 0


@dataclass(slots=True)
class SegmentLog:
    """Numbered segments of one session in a folder.

    Parameters
    ----------
    folder : Path
        Folder of the segments. Created if missing.
    header : callable
        Returns the header record of each segment.
    settings : LogSettings
    clock : Clock
    on_fault : callable
        Called with a sentence when the disk fails and when it works again.

    Raises
    ------
    InputError
        From :meth:`open`, if the folder cannot be written.
    """

    folder: Path
    header: Callable[[], Record]
    settings: LogSettings = field(default_factory=LogSettings)
    clock: Clock = field(default_factory=Clock)
    on_fault: Callable[[str], None] = lambda _text: None
    path: Path | None = None
    paths: list[Path] = field(default_factory=list)
    bytes_written: int = 0
    records: int = 0
    fault: DiskFault | None = None
    lost: int = 0
    _fd: int = -1
    _size: int = 0
    _segment: int = 0
    _stem: str = ""
    _number: int = 0
    _opened_ns: int = 0
    _synced_ns: int = 0
    _dirty: bool = False
    _torn: bool = False
    _retry_ns: int = 0
    _backlog: deque[bytes] = field(default_factory=deque)
    _backlog_bytes: int = 0

    def open(self) -> None:
        """Make the folder and the first segment."""
        self._stem = time.strftime("tap_%Y%m%dT%H%M%SZ", time.gmtime(self.clock.utc_ns() / 1e9)) + f"_{os.getpid()}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._new_segment()
        except OSError as error:
            raise InputError(
                f"cannot write a log here ({error.strerror})",
                expected="a folder that can be written to",
                cause=_disk_cause(error),
                path=self.folder,
            ) from None

    def append(self, record: Record) -> bool:
        """Write one record. Return True once the kernel has it, False if it waits in memory.

        The number ``n`` of the record in the session is set here. Call :meth:`tick` afterwards.
        """
        record["n"] = self._number
        self._number += 1
        self._put(encode_record(record))
        if self._backlog and not self._drain():
            return False
        now = self.clock.mono_ns()
        if self._size >= self.settings.segment_bytes or now - self._opened_ns > self.settings.segment_s * 1e9:
            self._rotate()
        return self.fault is None

    def tick(self) -> None:
        """Sync if it is due, and try a faulty disk again. Call it after each record and while there are none."""
        if self.fault is not None:
            self._drain()
        elif self._dirty and self.clock.mono_ns() - self._synced_ns >= self.settings.sync_interval_s * 1e9:
            self.sync()

    def sync(self) -> None:
        """``fdatasync`` now (gap, rotation, stop)."""
        if self._fd < 0 or self.fault is not None:
            return
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            self._fail(error)
            return
        self._dirty = False
        self._synced_ns = self.clock.mono_ns()

    def close(self) -> None:
        """Last attempt at what waits, sync, close."""
        # reset the pause between attempts
        self._retry_ns = 0
        if self.fault is not None:
            self._drain()
        self.sync()
        self._close_fd()
        self.lost += len(self._backlog)

    def free_bytes(self) -> int | None:
        """Space left for an ordinary user on the log's disk."""
        try:
            state = os.statvfs(self.folder)
        except OSError:
            return None
        return state.f_bavail * state.f_frsize

    # inside -----------------------------------------------------------------------------------------------

    def _put(self, line: bytes) -> None:
        self._backlog.append(line)
        self._backlog_bytes += len(line)
        while len(self._backlog) > self.settings.backlog_records or self._backlog_bytes > self.settings.backlog_bytes:
            self._backlog_bytes -= len(self._backlog.popleft())
            self.lost += 1
            if self.fault is not None:
                self.fault.lost += 1

    def _drain(self) -> bool:
        """Write the waiting records. Return False while the disk cannot be written."""
        if self.fault is not None:
            now = self.clock.mono_ns()
            if now < self._retry_ns:
                return False
            self._retry_ns = now + int(self.settings.retry_s * 1e9)
        try:
            if self._fd < 0:
                self._new_segment()
            while self._backlog:
                self._write(self._backlog[0])
                self._backlog_bytes -= len(self._backlog.popleft())
                self.records += 1
            if self.fault is not None:
                self._recover(self.fault)
        except OSError as error:
            self._fail(error)
            return False
        return True

    def _recover(self, fault: DiskFault) -> None:
        """The disk took everything: record the fault as past."""
        os.fdatasync(self._fd)
        self.fault = None
        record = {
            "kind": "disk",
            "reason": fault.reason,
            "from_utc_ns": fault.since_utc_ns,
            "to_utc_ns": self.clock.utc_ns(),
            "lost": fault.lost,
            "n": self._number,
        }
        self._number += 1
        self._write(encode_record(record))
        self.records += 1
        self.on_fault(f"the disk accepts records again; {fault.lost} were lost")

    def _write(self, line: bytes) -> None:
        """Write a line at once. A partial write is cut off, so that no truncated line stays inside the file."""
        # a part that could not be cut off becomes a separate line, which its checksum refuses
        data = b"\n" + line if self._torn else line
        written = os.write(self._fd, data)
        # the disk became full within the line
        if written < len(data):
            try:
                os.ftruncate(self._fd, self._size)
            except OSError:
                self._torn = True
                self._size += written
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._torn = False
        self._size += written
        self.bytes_written += written
        self._dirty = True

    def _fail(self, error: OSError) -> None:
        if error.errno in (errno.EIO, errno.EROFS, errno.EBADF, errno.ESTALE):
            self._close_fd()  # after a failed sync the kernel may have dropped pages: go on in a new segment
        if self.fault is None:
            self.fault = DiskFault(error.strerror or str(error), self.clock.utc_ns())
            self._retry_ns = self.clock.mono_ns() + int(self.settings.retry_s * 1e9)
            self.on_fault(
                f"the log cannot be written: {self.fault.reason}. {_disk_cause(error)}; records wait in memory"
            )

    def _rotate(self) -> None:
        try:
            self._write(encode_record({"kind": "rotate", "next_segment": self._segment + 1, "n": self._number}))
            self._number += 1
            self.records += 1
            self.sync()
            if self.fault is None:
                self._close_fd()
                self._new_segment()
        except OSError as error:
            self._fail(error)

    def _new_segment(self) -> None:
        self._segment += 1
        path = self.folder / f"{self._stem}_{self._segment:04d}.jsonl"
        # O_EXCL: never into the segment of another session
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o644)
        self._fd, self._size, self._torn = fd, 0, False
        record = self.header()
        record["segment"] = self._segment
        record["n"] = self._number
        try:
            self._write(encode_record(record))
            os.fdatasync(fd)
            # the name of a new file survives a power loss only once its folder is synced
            _sync_directory(self.folder)
        except OSError:
            self._close_fd()
            self._segment -= 1
            with contextlib.suppress(OSError):
                path.unlink()  # it contains only a truncated header
            raise
        self._number += 1
        self.path = path
        self.paths.append(path)
        self._opened_ns = self._synced_ns = self.clock.mono_ns()

    def _close_fd(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


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


class LogWriter:
    """A thread that writes to a :class:`SegmentLog` and syncs it.

    Parameters
    ----------
    log : SegmentLog
        A log that is not open yet. Its settings limit the queue.
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
        """The reason why the disk cannot be written now. Empty if it can."""
        fault = self.log.fault
        return "" if fault is None else fault.reason

    def messages(self) -> list[str]:
        """Return the messages about the disk since the last call."""
        # read the number once, because the writing thread may add messages meanwhile
        return [self._messages.popleft() for _ in range(len(self._messages))]

    def open(self) -> None:
        """Open the log. Raises ``InputError`` as :meth:`SegmentLog.open` does."""
        self.log.open()
        self.free_bytes = self.log.free_bytes()
        self._thread.start()

    def append(self, record: Record) -> bool:
        """Pass one record to the writer. Return True once the kernel has it, False if it waits in memory."""
        # approximate size of the other fields of a record as text
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
            # wait only once during a stall of the disk
            done = not stalled and self._changed.wait_for(self._idle, settings.patience_s)
        return done and self.log.fault is None

    def sync(self) -> None:
        """Request ``fdatasync``, and wait at most ``patience_s`` for it."""
        with self._changed:
            self._sync_wanted = True
            self._changed.notify_all()
            self._changed.wait_for(self._idle, self.log.settings.patience_s)

    def close(self, timeout_s: float = 30.0) -> None:
        """Write the waiting records and close. A disk that still hangs after the time is abandoned."""
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
            if item is not None:
                self._append(item[0])
            if sync:
                self.log.sync()
            with self._changed:
                self._busy = False
                if sync:
                    self._sync_wanted = False
                self._changed.notify_all()
            # the polling continues: the kernel has the record
            self.log.tick()
            self.free_bytes = self.log.free_bytes()

    def _append(self, record: Record) -> None:
        try:
            self.log.append(record)
        except Exception as error:  # one bad record must not end the log
            self._dropped += 1
            self._tell(f"a record could not be written: {type(error).__name__}: {error}")

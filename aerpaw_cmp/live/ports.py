"""Serial ports of the tap: find the modem's AT port, open it exclusively, and report other processes that use it.

The port is opened with ``termios`` directly. pyserial is not used, because it empties the input queue when it opens a
port, so that waiting answers are lost. pyserial also requires a DTR ioctl that some USB paths refuse, and reports an
unplugged cable by three unrelated exceptions (its issues 401 and 417). Here an unplugged cable always raises
:class:`PortGoneError`.

The module also contains settings, status and summary of a session of the tap.

A separate thread writes the status to the terminal, so that a hanging terminal (Ctrl-S, a lost ssh connection) does not
delay a poll.

A schedule determines when each query is due.

A request to end wakes the waiting threads.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import fnmatch
import grp
import os
import pwd
import queue
import re
import select
import signal
import stat
import termios
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..common.errors import AerpawCmpError, InputError, UsageError
from ..common.interrupts import SIGNALS
from ..common.text import counted
from .log import LogSettings

_QUECTEL_VENDOR = "2c7c"
# Interfaces of 2c7c:0800: 00 is DIAG, 01 NMEA, 02 and 03 take AT commands (ModemManager's
# 77-mm-quectel-port-types.rules).
_AT_INTERFACES = ("02", "03")

_GONE = {errno.ENOENT, errno.ENXIO, errno.EIO, errno.ENODEV, errno.ENOTCONN, errno.ESHUTDOWN}


class PortGoneError(Exception):
    """The error for a port that does not exist at present. The port may come back."""


@dataclass(frozen=True, slots=True)
class PortInfo:
    """A serial port, and how it was found.

    Parameters
    ----------
    path : Path
        Path of the port: a stable name if there is one.
    device : Path
        The device node to which the path leads now.
    how : str
        ``given``, ``by-id`` or ``usb``.
    interface : str or None
        USB interface number, two hex digits.
    product : str or None
        ``vendor:product`` of the USB device.
    """

    path: Path
    device: Path
    how: str
    interface: str | None = None
    product: str | None = None


@dataclass(frozen=True, slots=True)
class Holder:
    """A process that has the port open."""

    pid: int
    name: str


def _list_ports() -> list[Any]:
    """Return the serial ports of this system as pyserial lists them."""
    from serial.tools import list_ports

    return list(list_ports.comports())


@dataclass(frozen=True, slots=True)
class Roots:
    """The folder of devices and the list of serial ports. Tests use a simulated folder and list."""

    dev: Path = Path("/dev")
    ports: Callable[[], list[Any]] = _list_ports

    def usb(self) -> dict[str, tuple[str, str]]:
        """Return ``(vendor:product, interface)`` of each USB serial port, by the name of its device."""
        devices = {}
        for port in self.ports():
            # the kernel's name of the interface, such as 1-1:1.2; a device with one interface does not have such a name
            interface = re.search(r":\d+\.(\d+)$", port.location or "")
            if port.vid is not None:
                number = int(interface[1]) if interface else 0
                devices[Path(port.device).name] = f"{port.vid:04x}:{port.pid:04x}", f"{number:02x}"
        return devices


def _entries(folder: Path, pattern: str) -> list[Path]:
    """Return sorted entries of a folder. Empty if it vanishes, as /dev/serial/by-id does with its last device."""
    try:
        names = os.listdir(folder)  # noqa: PTH208 (Path.iterdir and glob are lazy: they may raise in the middle)
    except OSError:
        return []
    return [folder / name for name in sorted(names) if fnmatch.fnmatchcase(name, pattern)]


def find_candidates(roots: Roots) -> list[PortInfo]:
    """Return AT ports of Quectel modems, the likeliest first: by-id names, then USB interface numbers."""
    ports: list[PortInfo] = []
    by_name = roots.usb()
    for interface in _AT_INTERFACES:
        for link in _entries(roots.dev / "serial/by-id", f"*[Qq]uectel*-if{interface}*"):
            if link.exists():
                usb = by_name.get(link.resolve().name)
                ports.append(PortInfo(link, link.resolve(), "by-id", interface, usb[0] if usb else None))
    known = {port.device for port in ports}
    for interface in _AT_INTERFACES:
        for name, usb in sorted(by_name.items(), key=lambda item: (len(item[0]), item[0])):
            node = roots.dev / name
            if usb[0].startswith(_QUECTEL_VENDOR) and usb[1] == interface and node.resolve() not in known:
                ports.append(PortInfo(node, node.resolve(), "usb", interface, usb[0]))
    return ports


def find_port(path: Path, roots: Roots) -> PortInfo:
    """Return the properties of a port.

    If a by-id name leads to the given ``/dev/ttyUSB*``, that name is used. The port is then found again if the modem
    comes back under another number.

    Raises
    ------
    PortGoneError
        If the port does not exist.
    """
    if not path.exists():
        raise PortGoneError(f"{path} is not there")
    by_name = roots.usb()
    product, interface = by_name.get(path.resolve().name) or by_name.get(path.name) or (None, None)
    links = _entries(roots.dev / "serial/by-id", "*") if path.parent == roots.dev else []
    link = next((link for link in links if link.resolve() == path.resolve()), None)
    return PortInfo(link or path, path.resolve(), "by-id" if link else "given", interface, product)


def holders(path: Path, *, others_only: bool = True) -> list[Holder]:
    """Return processes that have the port open, as far as ``/proc`` is readable, by default without this process."""
    try:
        wanted = path.stat().st_rdev
    except OSError:
        return []
    holding = []
    for folder, holder in _processes():
        with contextlib.suppress(OSError):
            # the master of a pseudo-terminal has another device number, so only openers of the port count
            if any(stat.S_ISCHR(file.st_mode) and file.st_rdev == wanted for file in _open_files(folder)):
                holding.append(holder)
    return sorted((h for h in holding if not others_only or h.pid != os.getpid()), key=lambda h: h.pid)


def _processes() -> Iterator[tuple[Path, Holder]]:
    """Yield the folder in ``/proc`` and the name of each process."""
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # the process has ended
            yield folder, Holder(int(folder.name), (folder / "comm").read_text().strip())


def _open_files(process: Path) -> Iterator[os.stat_result]:
    for fd in (process / "fd").iterdir():
        with contextlib.suppress(OSError):
            yield fd.stat()


def modem_manager() -> Holder | None:
    """Return ModemManager if it runs. The name of that process is visible even if its open files are not."""
    return next((holder for _, holder in _processes() if holder.name == "ModemManager"), None)


def _busy(path: Path, others: list[Holder]) -> InputError:
    who = ", ".join(f"{h.name} (process {h.pid})" for h in others[:4]) or "a process of another user"
    if len(others) > 4:
        who += f" and {len(others) - 4} more"
    if any(h.name == "ModemManager" for h in others) or (not others and modem_manager()):
        cause = (
            "ModemManager uses it. Free it now with 'sudo systemctl stop ModemManager', permanently with the udev rule "
            'ATTRS{idVendor}=="2c7c", ENV{ID_MM_DEVICE_IGNORE}="1"'
        )
    elif others:
        cause = f"another program or another tap reads it; to end it: 'kill {others[0].pid}'"
    else:
        cause = f"see 'sudo fuser -v {path}'"
    return InputError(f"the port is in use by {who}", expected="a port that only the tap uses", cause=cause, path=path)


def _denied(path: Path) -> InputError:
    state = path.stat()
    try:
        owner, group = pwd.getpwuid(state.st_uid).pw_name, grp.getgrgid(state.st_gid).gr_name
    except KeyError:
        owner, group = str(state.st_uid), str(state.st_gid)
    if state.st_mode & 0o060 == 0o060:
        expected, step = f"a user of group {group!r}", f"'sudo usermod -aG {group} $USER' and log in again"
    else:
        expected, step = f"the user {owner!r}, because its group may not open it", f"'sudo chown $USER {path}'"
    return InputError(
        f"no permission to open the port (owner {owner}, group {group}, mode {stat.S_IMODE(state.st_mode):o})",
        expected=expected,
        cause=f"run {step}",
        path=path,
    )


class SerialPort:
    """An open port: raw, non-blocking, locked for this process.

    Use :meth:`open`. Every method raises :class:`PortGoneError` when the device is gone.
    """

    def __init__(self, fd: int, path: Path) -> None:
        self._fd = fd
        self.path = path

    @classmethod
    def open(cls, path: Path) -> SerialPort:
        """Open a port exclusively.

        Raises
        ------
        PortGoneError
            If the port does not exist, or vanishes while it is opened.
        InputError
            If this user may not open the port, another process uses it, or it is not a serial port.
        """
        try:
            fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise cls._open_error(path, error) from None
        try:
            if not os.isatty(fd):
                raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))
            users = holders(path)  # before any change: another process may use the port
            if users:
                raise _busy(path, users)
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # the lock only excludes other taps. TIOCEXCL makes any further attempt to open the port fail, except for
            # root.
            fcntl.ioctl(fd, termios.TIOCEXCL)
            make_raw(fd, termios.B115200)
            users = holders(path)  # check again: another process may have opened the port meanwhile
            if users:
                raise _busy(path, users)
        except (OSError, termios.error, AerpawCmpError) as error:
            os.close(fd)
            if isinstance(error, AerpawCmpError):
                raise
            raise cls._open_error(path, error) from None
        return cls(fd, path)

    @staticmethod
    def _open_error(path: Path, error: OSError | termios.error) -> Exception:
        number = error.args[0]
        if number in _GONE:
            return PortGoneError(f"{path} is gone ({os.strerror(number)})")
        if number in (errno.EBUSY, errno.EWOULDBLOCK):
            return _busy(path, holders(path))
        if number in (errno.EACCES, errno.EPERM):
            return _denied(path)
        return InputError(
            f"cannot be opened as a serial port ({os.strerror(number)})",
            expected="a serial port, e.g. /dev/serial/by-id/usb-Quectel*-if02-port0",
            cause="the name of another device or file",
            path=path,
        )

    def fileno(self) -> int:
        """File descriptor, for ``select``."""
        return self._fd

    def read(self, limit: int = 65_536) -> bytes:
        """Return the bytes that are available now, ``b""`` if there are none."""
        try:
            data = os.read(self._fd, limit)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise PortGoneError(f"{self.path} is gone ({error.strerror})") from None
        if not data:  # with VMIN=1, an empty read means a hang-up
            raise PortGoneError(f"{self.path} is gone (hung up)")
        return data

    def write(self, data: bytes, timeout_s: float = 1.0) -> None:
        """Write all bytes within the time. A port that does not accept bytes for this time counts as gone."""
        deadline = time.monotonic() + timeout_s
        while data:
            try:
                data = data[os.write(self._fd, data) :]
            except BlockingIOError:
                poller = select.poll()
                poller.register(self._fd, select.POLLOUT)
                if not poller.poll(max(0.0, deadline - time.monotonic()) * 1e3):
                    raise PortGoneError(f"{self.path} does not accept bytes") from None
            except OSError as error:
                raise PortGoneError(f"{self.path} is gone ({error.strerror})") from None

    def close(self) -> None:
        """Close the port. This method can be called even if the port is gone."""
        if self._fd >= 0:
            with contextlib.suppress(OSError, termios.error):
                fcntl.ioctl(self._fd, termios.TIOCNXCL)
            os.close(self._fd)
            self._fd = -1


def make_raw(fd: int, baud: int) -> None:
    """Set a port to no echo, no line editing, 8N1 and no flow control, and keep its input queue."""
    _, _, cflag, _, _, _, cc = termios.tcgetattr(fd)
    # keep HUPCL: the system decides whether a modem is notified when its port closes
    cflag = (cflag & termios.HUPCL) | termios.CS8 | termios.CREAD | termios.CLOCAL
    cc[termios.VMIN], cc[termios.VTIME] = 1, 0
    # clear all flags of input, output and local mode, because each of them changes or delays bytes
    termios.tcsetattr(fd, termios.TCSANOW, [0, 0, cflag, 0, baud, baud, cc])


@dataclass(frozen=True, slots=True)
class TapSettings:
    """The settings of the tap. The defaults suit a flight.

    Parameters
    ----------
    folder : Path
        Folder of the log segments (``-o``). Created if missing.
    port : str, optional
        The serial port. None means the first AT port of a Quectel modem.
    ri_hz : float
        Rate of ``nr5g_csi`` [Hz].
    other_hz : float
        Rate of each of :data:`~aerpaw_cmp.live.modem.OTHER_QUERIES` [Hz].
    pause_s : float
        Pause between an answer and the next command [s].
    answer_timeout_s : float
        Time after which an answer becomes a ``late`` record [s].
    probe_timeout_s : float
        Time limit for each of the two probes of a newly opened port [s].
    silent_s : float
        Time without a final result after which the port is reopened [s].
    enable_csi : bool
        Switch CSI reporting on, and restore it on exit (the only command that writes).
    no_csi_alarm_s : float, optional
        Raise an alarm after this time without a rank [s].
    status_s : float
        Interval of the status calls [s].
    duration_s : float, optional
        End the session after this time [s].
    reconnect_min_s, reconnect_max_s : float
        Shortest and longest pause between attempts to reconnect [s].
    log : LogSettings
        Durability and rotation.
    roots : Roots
        Folders in which devices are searched for.
    """

    folder: Path
    port: str | None = None
    ri_hz: float = 2.0
    other_hz: float = 1.0
    pause_s: float = 0.02
    answer_timeout_s: float = 2.0
    probe_timeout_s: float = 1.0
    silent_s: float = 10.0
    enable_csi: bool = False
    no_csi_alarm_s: float | None = None
    status_s: float = 1.0
    duration_s: float | None = None
    reconnect_min_s: float = 0.1
    reconnect_max_s: float = 2.0
    log: LogSettings = field(default_factory=LogSettings)
    roots: Roots = field(default_factory=Roots)

    def __post_init__(self) -> None:
        for name in ("ri_hz", "no_csi_alarm_s", "duration_s"):
            value = getattr(self, name)
            # written in this way, the test also refuses NaN
            if value is not None and not 0 < value < 1e6:
                raise UsageError(f"{name} is {value:g}", expected="a positive number below 1e6")


@dataclass(frozen=True, slots=True)
class TapStatus:
    """The status that the terminal shows.

    Parameters
    ----------
    connected : bool
    rank : int or None
        Rank of the last answer. None: no CSI.
    rsrp_dbm, sinr_db : int or None
        Last known values of the NR cell.
    ri_rate_hz : float
        Rate of answers with status ok over the last 10 s.
    gaps, records, bytes_written : int
    disk_free_bytes : int or None
    disk_fault : str
        Reason why the disk cannot be written now. Empty if the disk can be written.
    missed : int
        Number of polls that were due while connected, but not made.
    predicted_rank : int or None
        Rank that the replay predicts at the present pose.
    predicts : bool
        True if the tap makes predictions.
    alarm : bool
        True if there was no CSI for longer than the limit, so that the bell rings.
    message : str
        Text to be shown once (a loss, a fault, a hint). Empty on regular calls.
    """

    connected: bool = False
    rank: int | None = None
    rsrp_dbm: int | None = None
    sinr_db: int | None = None
    ri_rate_hz: float = 0.0
    gaps: int = 0
    records: int = 0
    bytes_written: int = 0
    disk_free_bytes: int | None = None
    disk_fault: str = ""
    missed: int = 0
    predicted_rank: int | None = None
    predicts: bool = False
    alarm: bool = False
    message: str = ""


class StatusNotifier:
    """A thread that calls ``on_status`` in order. A status is dropped if a hanging terminal cannot show it.

    Parameters
    ----------
    on_status : callable
        If it raises an exception, it is not called again, because a broken terminal must not end the log.
    """

    def __init__(self, on_status: Callable[[TapStatus], None]) -> None:
        self._on_status = on_status
        self._queue: queue.Queue[TapStatus | None] = queue.Queue(maxsize=1000)
        self._thread = threading.Thread(target=self._run, name="tap-status", daemon=True)
        self._thread.start()

    def notify(self, status: TapStatus) -> None:
        """Queue a status. The status is dropped if the queue is full, or if ten statuses wait and it has no message."""
        # lines without a message may be dropped, because the next line overwrites them. A message is shown only once.
        if status.message or self._queue.qsize() < 10:
            try:
                self._queue.put_nowait(status)
            except queue.Full:
                return

    def close(self, timeout_s: float = 2.0) -> None:
        """Write the waiting statuses, but do not wait for a terminal that hangs."""
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
            while self._queue.get() is not None:  # the stream is broken: discard the queue
                pass


@dataclass(frozen=True, slots=True)
class TapSummary:
    """The summary of a session that has ended.

    Parameters
    ----------
    reason : str
        ``SIGINT``, ``SIGTERM``, ``SIGHUP``, ``duration`` or the reason of the caller's stop.
    exit_code : int
        0, or 1 if records were lost because of the disk.
    segments : tuple of Path
    answers : mapping
        Counts by status, for each query.
    rates_hz, missed : mapping
        For each query, the achieved rate, and the number of polls that were due while connected, but not made.
    gaps : int
    gap_s, duration_s : float
    records, lost_records, redacted : int
    """

    reason: str
    exit_code: int
    segments: tuple[Path, ...]
    answers: dict[str, dict[str, int]]
    rates_hz: dict[str, float]
    missed: dict[str, int]
    gaps: int
    gap_s: float
    duration_s: float
    records: int
    lost_records: int
    redacted: int
    alarms: int = 0


def format_status(status: TapStatus) -> str:
    """Return one line for the terminal. The line contains no text from the modem."""
    if not status.connected:
        head = "NO PORT"
    elif status.rank is None:
        head = "rank -"
    else:
        head = f"rank {status.rank}"
    if status.predicts:
        predicted = "-" if status.predicted_rank is None else str(status.predicted_rank)
        head += f" (predicted {predicted})"
    parts = [
        head,
        "RSRP " + ("-" if status.rsrp_dbm is None else f"{status.rsrp_dbm} dBm"),
        "SINR " + ("-" if status.sinr_db is None else f"{status.sinr_db} dB"),
        f"{status.ri_rate_hz:.1f} Hz",
        counted(status.gaps, "gap"),
        f"{status.bytes_written / 2**20:.1f} MiB",
        "disk ?" if status.disk_free_bytes is None else f"disk {status.disk_free_bytes / 2**30:.1f} GiB",
    ]
    if status.alarm:
        parts.append("NO CSI")
    return "  ".join(parts)


# A poll that is late by at most this number of periods is made immediately. Older polls are skipped and counted as
# missed.
_CATCH_UP = 2
# The first query is polled at most this many times in a row while another query is due.
_IN_A_ROW = 3


def stale_after_s(period_s: float) -> float:
    """Return the age from which a measured value is out of date [s], for a period of the rank query [s]."""
    return max(3.0, 3 * period_s)


class Schedule:
    """The order and times of the queries. If several are due, the first query has priority, then the longest wait.

    If a modem answers so slowly that the first query is always due, another query is sent after every three polls of
    the first query.

    After a short stall, late polls follow each other immediately, with their true times in the records, so no answer is
    lost. After a long stall, the schedule restarts at the present time.

    Parameters
    ----------
    periods_ns : dict of str to int
        Period of each query [ns].
    """

    def __init__(self, periods_ns: dict[str, int]) -> None:
        self._periods = periods_ns
        self._first = next(iter(periods_ns))
        self._due: dict[str, int] = {}
        self._in_a_row = 0
        self.missed: Counter[str] = Counter()

    def reset(self, now_ns: int) -> None:
        """Restart the schedule, with all queries due now."""
        self._due = dict.fromkeys(self._periods, now_ns)

    def next(self, now_ns: int) -> tuple[str, int]:
        """Return the name and due time of the next poll."""
        name = min(self._due, key=lambda n: self._due[n])
        if self._due[self._first] <= now_ns:
            others = {n: due for n, due in self._due.items() if n != self._first and due <= now_ns}
            name = min(others, key=others.__getitem__) if others and self._in_a_row >= _IN_A_ROW else self._first
        return name, self._due[name]

    def started(self, name: str, now_ns: int) -> None:
        """Record that a poll begins. Count polls that are too late to be made as missed."""
        period = self._periods[name]
        late = max(0, (now_ns - self._due[name]) // period)
        skipped = late if late > _CATCH_UP else 0
        self.missed[name] += skipped
        self._in_a_row = self._in_a_row + 1 if name == self._first else 0
        self._due[name] += (skipped + 1) * period

    def slots(self, duration_ns: int) -> dict[str, int]:
        """Return the number of polls that are due within a gap of this length."""
        return {name: duration_ns // period for name, period in self._periods.items()}


class Stop:
    """A request to end, from a signal or another thread. The request wakes the waiting tap.

    Inside a ``with`` block, SIGINT, SIGTERM and SIGHUP request the end. The end of the block closes the pipe. Only
    the main thread receives signals, and an ignored signal (nohup) stays ignored.
    """

    def __init__(self) -> None:
        # non-blocking: a full pipe must not block a signal handler
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
        """Request the end. A second request means that the tap ends immediately."""
        self.reason = self.reason or reason
        self.count += 1
        with contextlib.suppress(OSError):
            os.write(self._write, b"x")

    def fileno(self) -> int:
        """Return a descriptor that is readable after the end was requested."""
        return self._read

    def close(self) -> None:
        """Close the pipe."""
        os.close(self._read)
        os.close(self._write)

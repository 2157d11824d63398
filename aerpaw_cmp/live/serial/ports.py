"""Serial ports: find the modem's AT port, open it for us alone, say who else holds it.

The port is opened with ``termios`` directly. pyserial empties the input queue when it opens (answers that wait
there would be lost), insists on a DTR ioctl that some USB paths refuse, and reports an unplugged cable by three
unrelated exceptions (its issues 401 and 417); here it is always :class:`PortGoneError`.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import fnmatch
import grp
import os
import pwd
import re
import select
import stat
import termios
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ...common.errors import AerpawCmpError, InputError, UsageError

_QUECTEL_VENDOR = "2c7c"
# Of 2c7c:0800: 00 is DIAG, 01 NMEA, 02 and 03 take AT commands (ModemManager's 77-mm-quectel-port-types.rules).
_AT_INTERFACES = ("02", "03")

_GONE = {errno.ENOENT, errno.ENXIO, errno.EIO, errno.ENODEV, errno.ENOTCONN, errno.ESHUTDOWN}


class PortGoneError(Exception):
    """The port is not there (any more); it may come back."""


@dataclass(frozen=True, slots=True)
class PortInfo:
    """A serial port and how it was found.

    Parameters
    ----------
    path : Path
        What to open; a stable name if there is one.
    device : Path
        The node it leads to now.
    how : str
        ``given``, ``by-id``, ``usb``, ``node``.
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


@dataclass(frozen=True, slots=True)
class Roots:
    """Folders where the system keeps devices; tests give their own tree."""

    dev: Path = Path("/dev")
    sys: Path = Path("/sys")


def _usb_of(tty: str, roots: Roots) -> tuple[str, str] | None:
    """``(vendor:product, interface)`` of a tty by sysfs."""
    device = roots.sys / "class/tty" / tty / "device"
    if not device.exists():
        return None
    for folder in (device.resolve(), *device.resolve().parents):
        number = folder / "bInterfaceNumber"
        if number.exists():
            usb = folder.parent
            try:
                product = (usb / "idVendor").read_text().strip() + ":" + (usb / "idProduct").read_text().strip()
                return product, number.read_text().strip()
            except OSError:
                return None
    return None


def _entries(folder: Path, pattern: str) -> list[Path]:
    """Entries of a folder by name; none if it vanishes meanwhile, as /dev/serial/by-id does with its last device."""
    try:
        names = os.listdir(folder)  # noqa: PTH208 (Path.iterdir and glob are lazy: they may raise in the middle)
    except OSError:
        return []
    return [folder / name for name in sorted(names) if fnmatch.fnmatchcase(name, pattern)]


def find_candidates(roots: Roots | None = None) -> list[PortInfo]:
    """AT ports of Quectel modems, the likeliest first: by-id names, then USB interface numbers, then PCIe nodes."""
    roots = roots or Roots()
    ports: list[PortInfo] = []
    for interface in _AT_INTERFACES:
        for link in _entries(roots.dev / "serial/by-id", f"*[Qq]uectel*-if{interface}*"):
            if link.exists():
                usb = _usb_of(link.resolve().name, roots)
                ports.append(PortInfo(link, link.resolve(), "by-id", interface, usb[0] if usb else None))
    known = {port.device for port in ports}
    ttys = sorted(_entries(roots.sys / "class/tty", "ttyUSB*"), key=lambda p: (len(p.name), p.name))
    for interface in _AT_INTERFACES:
        for tty in ttys:
            usb = _usb_of(tty.name, roots)
            node = roots.dev / tty.name
            if usb and usb[0].startswith(_QUECTEL_VENDOR) and usb[1] == interface and node.resolve() not in known:
                ports.append(PortInfo(node, node.resolve(), "usb", interface, usb[0]))
    for name in ("mhi_DUN", "smd11"):
        if (roots.dev / name).exists():
            ports.append(PortInfo(roots.dev / name, roots.dev / name, "node"))
    return ports


def find_port(port: str | Path | None, roots: Roots | None = None) -> PortInfo:
    """The port to open now.

    A given ``/dev/ttyUSB*`` that a by-id name leads to is followed by that name, so that it is found again when the
    modem comes back under another number.

    Raises
    ------
    PortGoneError
        If it is not there.
    UsageError
        If it is a URL of pyserial.
    """
    roots = roots or Roots()
    _refuse_url(port)
    if port is None:
        candidates = find_candidates(roots)
        if not candidates:
            raise PortGoneError("no AT port of a Quectel modem (USB 2c7c, interface 02 or 03) is there")
        return candidates[0]
    path = Path(port)
    if not path.exists():
        raise PortGoneError(f"{path} is not there")
    usb = _usb_of(path.resolve().name, roots) or _usb_of(path.name, roots)
    interface, product = (usb[1], usb[0]) if usb else (None, None)
    by_id = roots.dev / "serial/by-id"
    if path.parent == roots.dev:
        for link in _entries(by_id, "*"):
            if link.resolve() == path.resolve():
                return PortInfo(link, path.resolve(), "by-id", interface, product)
    return PortInfo(path, path.resolve(), "given", interface, product)


_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.]{1,12})://(.*)", re.DOTALL)


def _refuse_url(port: str | Path | None) -> None:
    """The tap opens devices itself (see the head of this file); what pyserial calls a URL is refused by name."""
    match = _URL.fullmatch(port) if isinstance(port, str) else None
    if match is None:
        return
    kind, rest = match[1].lower(), match[2]
    bridge = {
        "socket": f"socat pty,link=/tmp/modem,rawer tcp:{rest or 'HOST:PORT'}",
        "loop": "aerpaw-cmp modem-sim --link /tmp/modem",
    }
    command = bridge.get(kind, "socat pty,link=/tmp/modem,rawer ...")
    raise UsageError(
        f"the port is a URL of pyserial ({kind}://)",
        expected="a serial device, e.g. /dev/serial/by-id/usb-Quectel*-if02-port0",
        cause=f"the tap opens devices only; '{command}' makes one, for 'aerpaw-cmp tap /tmp/modem'",
    )


def holders(path: Path, *, others_only: bool = True) -> list[Holder]:
    """Processes that have the port open, by ``/proc`` (as far as we may look); without our own by default."""
    try:
        wanted = path.stat().st_rdev
    except OSError:
        return []
    holding = []
    for process in _processes():
        with contextlib.suppress(OSError):
            # the master of a pseudo-terminal has another device number, so only openers of the port count
            if any(stat.S_ISCHR(file.st_mode) and file.st_rdev == wanted for file in _open_files(process)):
                holding.append(_holder(process))
    return sorted((h for h in holding if not others_only or h.pid != os.getpid()), key=lambda h: h.pid)


def _processes() -> Iterator[Path]:
    return (folder for folder in Path("/proc").iterdir() if folder.name.isdigit())


def _holder(process: Path) -> Holder:
    return Holder(int(process.name), (process / "comm").read_text().strip())


def _open_files(process: Path) -> Iterator[os.stat_result]:
    for fd in (process / "fd").iterdir():
        with contextlib.suppress(OSError):
            yield fd.stat()


def modem_manager() -> Holder | None:
    """ModemManager if it runs; its name can be seen even where its open files cannot."""
    for process in _processes():
        with contextlib.suppress(OSError):
            if (holder := _holder(process)).name == "ModemManager":
                return holder
    return None


def _busy(path: Path, others: list[Holder]) -> InputError:
    who = ", ".join(f"{h.name} (process {h.pid})" for h in others[:4]) or "a process that we may not look at"
    if len(others) > 4:
        who += f" and {len(others) - 4} more"
    if any(h.name == "ModemManager" for h in others) or (not others and modem_manager()):
        cause = (
            "ModemManager took it. Free it now with 'sudo systemctl stop ModemManager', for good with the udev rule "
            'ATTRS{idVendor}=="2c7c", ENV{ID_MM_DEVICE_IGNORE}="1"'
        )
    elif others:
        cause = f"another program or another tap reads it; to end it: 'kill {others[0].pid}'"
    else:
        cause = f"see 'sudo fuser -v {path}'"
    return InputError(f"the port is held by {who}", expected="a port for the tap alone", cause=cause, path=path)


def _denied(path: Path) -> InputError:
    state = path.stat()
    try:
        owner, group = pwd.getpwuid(state.st_uid).pw_name, grp.getgrgid(state.st_gid).gr_name
    except KeyError:
        owner, group = str(state.st_uid), str(state.st_gid)
    return InputError(
        f"no permission to open the port (owner {owner}, group {group}, mode {stat.S_IMODE(state.st_mode):o})",
        expected=f"a user of group {group!r}",
        cause=f"run 'sudo usermod -aG {group} $USER' and log in again",
        path=path,
    )


class SerialPort:
    """An open port: raw, non-blocking, locked for us.

    Use :meth:`open`. Every method raises :class:`PortGoneError` when the device is gone.
    """

    def __init__(self, fd: int, path: Path) -> None:
        self._fd = fd
        self.path = path

    @classmethod
    def open(cls, path: Path) -> SerialPort:
        """Open a port for us alone.

        Raises
        ------
        PortGoneError
            If it is not there or vanishes meanwhile.
        InputError
            If we may not open it, another process holds it, or it is no serial port.
        """
        try:
            fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise cls._open_error(path, error) from None
        try:
            if not os.isatty(fd):
                raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))
            users = holders(path)  # before anything is changed on a port that another one uses
            if users:
                raise _busy(path, users)
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # the lock keeps out other taps alone; this refuses every further open, but for root
            fcntl.ioctl(fd, termios.TIOCEXCL)
            make_raw(fd, termios.B115200)
            users = holders(path)  # again: someone may have come between
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
            cause="the name of something else",
            path=path,
        )

    def fileno(self) -> int:
        """File descriptor, for ``select``."""
        return self._fd

    def read(self, limit: int = 65_536) -> bytes:
        """Read what is there now; ``b""`` if nothing."""
        try:
            data = os.read(self._fd, limit)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise PortGoneError(f"{self.path} is gone ({error.strerror})") from None
        if not data:  # with VMIN=1 an empty read is a hang-up
            raise PortGoneError(f"{self.path} is gone (hung up)")
        return data

    def write(self, data: bytes, timeout_s: float = 1.0) -> None:
        """Write all of it within the time; a port that takes nothing for so long counts as gone."""
        deadline = time.monotonic() + timeout_s
        while data:
            try:
                data = data[os.write(self._fd, data) :]
            except BlockingIOError:
                poller = select.poll()
                poller.register(self._fd, select.POLLOUT)
                if not poller.poll(max(0.0, deadline - time.monotonic()) * 1e3):
                    raise PortGoneError(f"{self.path} takes no bytes") from None
            except OSError as error:
                raise PortGoneError(f"{self.path} is gone ({error.strerror})") from None

    def close(self) -> None:
        """Give the port back; harmless if it is gone."""
        if self._fd >= 0:
            with contextlib.suppress(OSError, termios.error):
                fcntl.ioctl(self._fd, termios.TIOCNXCL)
            os.close(self._fd)
            self._fd = -1


def make_raw(fd: int, baud: int) -> None:
    """No echo, no line editing, 8N1, no flow control; what waits in the queue stays."""
    _, _, cflag, _, _, _, cc = termios.tcgetattr(fd)
    # HUPCL stays as it was: whether a modem is told that its port closes is the system's choice, not ours
    cflag = (cflag & termios.HUPCL) | termios.CS8 | termios.CREAD | termios.CLOCAL
    cc[termios.VMIN], cc[termios.VTIME] = 1, 0
    # every flag of input, output and local mode changes or holds back bytes: none is wanted
    termios.tcsetattr(fd, termios.TCSANOW, [0, 0, cflag, 0, baud, baud, cc])

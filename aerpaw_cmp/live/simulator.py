"""A simulated modem: a pseudo-terminal that answers like an RM502Q-AE during a simulated flight.

The simulator answers any program that opens the port, so it can be used with the tap, a terminal program and the tests.
"""

from __future__ import annotations

import contextlib
import math
import os
import pty
import re
import termios
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from ..common.errors import UsageError
from .modem import QUERIES
from .ports import make_raw

# Delay of each answer.
_LATENCY_S = 0.02


def flight_rank(seconds: float) -> int:
    """Return the rank of the built-in flight. The rank varies slowly between 1 and 4, and is sometimes 0 (no CSI)."""
    if seconds % 120.0 > 118.0:
        return 0
    return 1 + round(1.5 + 1.5 * math.sin(seconds / 20.0))


def _flight_rsrp(seconds: float) -> float:
    """Return the RSRP of the built-in flight [dBm]."""
    return -85.0 - 12.0 * (1.0 + math.sin(seconds / 31.0))


class FlightModem:
    """An RM502Q-AE in SA mode over a simulated flight.

    Parameters
    ----------
    rank : callable, optional
        ``rank(seconds) -> int``, where 0 means no CSI. Default: the rank of a built-in flight.
    rsrp : callable, optional
        ``rsrp(seconds) -> dBm``. Default: the RSRP of a built-in flight.
    """

    def __init__(
        self, rank: Callable[[float], int] | None = None, rsrp: Callable[[float], float] | None = None
    ) -> None:
        self._rank, self._rsrp = rank or flight_rank, rsrp or _flight_rsrp
        self.csi = [1, 1]
        self._start = time.monotonic()
        self._asked = 0

    def reply(self, command: str) -> tuple[str, ...]:
        """Return lines for a command, the final result last."""
        now = time.monotonic() - self._start
        rank = self._rank(now) if self.csi[1] else 0
        rsrp = round(self._rsrp(now))
        sinr = max(-20, min(38, 110 + rsrp + round(3 * math.sin(now / 3.0))))
        self._asked += 1
        write = re.fullmatch(r'AT\+QNWCFG="csi_ctrl",([01]),([01])', command)
        if write:
            self.csi = [int(write.group(1)), int(write.group(2))]
            return ("OK",)
        # use the number of the query as PMI, so that each answer can be distinguished
        csi = f"{min(27, 4 + 6 * rank)},{rank},{min(15, 4 + 2 * rank)},{self._asked % 60_000}" if rank else "0,0,0,0"
        answers: dict[str, tuple[str, ...]] = {
            "sync": (),
            "identity": ("Quectel", "RM502Q-AE", "Revision: RM502QAEAAR00A00M4G"),
            "firmware": ("RM502QAEAAR00A00M4G",),
            "csi_ctrl": (f'+QNWCFG: "csi_ctrl",{self.csi[0]},{self.csi[1]}',),
            "nr5g_csi": (f'+QNWCFG: "nr5g_csi",{csi}',),
            "lte_csi": ('+QNWCFG: "lte_csi",0,0,0,0',),
            "servingcell": (
                '+QENG: "servingcell","NOCONN","NR5G-SA","TDD",999,99,0002A4001,77,1F,633984,78,12,'
                f"{rsrp},-11,{sinr},1,-",
            ),
            "qrsrp": (f"+QRSRP: {rsrp},{rsrp - 3},{rsrp - 2},{rsrp - 5},NR5G",),
            "qrsrq": ("+QRSRQ: -11,-11,-11,-12,NR5G",),
            "qsinr": (f"+QSINR: {sinr},{sinr - 2},{sinr - 1},{sinr - 4},NR5G",),
            "qnwinfo": ('+QNWINFO: "TDD NR5G","99999","NR5G BAND 78",633984',),
            "qcainfo": ('+QCAINFO: "PCC",633984,12,"NR5G BAND 78",77',),
        }
        for name, lines in answers.items():
            if QUERIES[name].text == command:
                return (*lines, "OK")
        return ("ERROR",)


class ModemSimulator:
    """A context manager for a simulated modem on a pseudo-terminal, served by a thread.

    Parameters
    ----------
    modem : FlightModem, optional
        Answers of the modem. Default: a built-in flight.
    link : Path, optional
        Symbolic link to the port. None means no link.

    Examples
    --------
    >>> with ModemSimulator() as modem:
    ...     modem.port.exists()
    True
    """

    def __init__(self, modem: FlightModem | None = None, *, link: Path | None = None) -> None:
        self.link = link
        self._modem = modem or FlightModem()
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._received = b""
        self._master = -1
        self._node = self._plug()
        self._thread = threading.Thread(target=self._run, name="modem-sim", daemon=True)

    def __enter__(self) -> ModemSimulator:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join(timeout=5.0)
        with self._lock:
            if self._master >= 0:
                os.close(self._master)
                self._master = -1
        self._unlink()

    @property
    def port(self) -> Path:
        """The path to open: the link if there is one, else the device node."""
        return self.link or self._node

    def _plug(self) -> Path:
        master, slave = pty.openpty()
        try:
            make_raw(slave, termios.B115200)
            node = Path(os.ttyname(slave))
        finally:
            os.close(slave)  # only the tap may have the port open
        # a program that stops reading must not block the thread forever
        os.set_blocking(master, False)
        self._master = master
        link = self.link
        if link is not None:
            link.parent.mkdir(parents=True, exist_ok=True)
            try:
                link.symlink_to(node)
            except FileExistsError:
                os.close(master)
                raise UsageError(
                    "the name is taken",
                    expected="a new name after --link",
                    cause="a simulator that was killed: remove its link" if link.is_symlink() else "a file of yours",
                    path=link,
                ) from None
        return node

    def _unlink(self) -> None:
        """Remove the link if it still leads to our device node."""
        link = self.link
        with contextlib.suppress(OSError):
            if link is not None and link.readlink() == self._node:
                link.unlink()

    def _read(self) -> bytes:
        """Return received bytes. If there are none, or no process has the port open, wait a moment."""
        try:
            return os.read(self._master, 4096)
        except OSError:
            self._stop.wait(0.002)
            return b""

    def _write(self, data: bytes) -> bool:
        """Write all bytes. Return False if that fails."""
        while data and not self._stop.is_set():
            try:
                with self._lock:
                    count = os.write(self._master, data[:4096])
            except BlockingIOError:
                self._stop.wait(0.002)
                continue
            except OSError:
                return False
            data = data[count:]
        return not data

    def _run(self) -> None:
        while not self._stop.is_set():
            self._received += self._read()
            while b"\r" in self._received:
                line, self._received = self._received.split(b"\r", 1)
                if command := line.strip(b"\n\0 ").decode("latin-1"):
                    self._serve(command)

    def _serve(self, command: str) -> None:
        """Answer a command."""
        self._stop.wait(_LATENCY_S)
        self._write(framed(self._modem.reply(command)))


def framed(lines: Iterable[str]) -> bytes:
    """Return lines of an answer as a modem writes them."""
    return b"".join(b"\r\n" + line.encode("latin-1") + b"\r\n" for line in lines)

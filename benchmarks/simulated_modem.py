"""A simulated modem with faults and a journal of its answers, and the log of the tap, for its tests and benchmarks."""

from __future__ import annotations

import os
import pty
import random
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from aerpaw_cmp.live.simulator import FlightModem, ModemSimulator, framed
from aerpaw_cmp.logs.files import Record, decode_record


@dataclass(frozen=True, slots=True)
class Faults:
    """The faults to inject, where numbers count answers, 0 means never, and times are in seconds.

    ``binary_echo`` echoes a command with its high bits set, ``glue`` leaves out the line end between two information
    lines, ``silent_after`` says nothing more after so many answers.
    """

    echo: bool = False
    latency_s: float = 0.02
    jitter_s: float = 0.0
    bytewise_s: float = 0.0
    urc_every: int = 0
    no_final_every: int = 0
    late_every: int = 0
    late_s: float = 3.0
    rubbish_every: int = 0
    binary_echo: bool = False
    glue: bool = False
    huge_line_every: int = 0
    error_every: int = 0
    silent_after: int = 0
    seed: int = 1


@dataclass(slots=True)
class Served:
    """An answer, whose ``read`` becomes True once the other side sent its next command.

    Then the answer was read completely.
    """

    command: str
    lines: tuple[str, ...]
    read: bool = False


class FaultyModem(ModemSimulator):
    """The simulated modem with faults, or another device according to ``kind``."""

    def __init__(
        self,
        *,
        link: Path | None = None,
        kind: Literal["modem", "gps", "diag", "silent", "rubbish"] = "modem",
        faults: Faults = Faults(),
        csi_on: bool = True,
        rank: Callable[[float], int] | None = None,
    ) -> None:
        self.kind, self.faults = kind, faults
        self.journal: list[Served] = []
        self.sent_bytes = self._answered = 0
        self._pending: Served | None = None
        self._random = random.Random(faults.seed)
        self._speaking = threading.Lock()
        super().__init__(FlightModem(rank), link=link)
        self._modem.csi = [int(csi_on)] * 2

    def __enter__(self) -> FaultyModem:
        super().__enter__()
        return self

    @property
    def node(self) -> Path:
        """The present node."""
        return self._node

    @property
    def csi(self) -> list[int]:
        """State of ``csi_ctrl``."""
        return list(self._modem.csi)

    def unplug(self) -> None:
        """Pull the cable: the port hangs up and its node goes away."""
        with self._lock:
            self._pending = None  # it is unknown whether it was read
            old, self._master, self._received = self._master, -1, b""
            self._unlink()
            os.close(old)

    def replug(self) -> None:
        """Plug the cable in again: the device gets a new number, and the link follows. The modem then reports RDY."""
        spare = pty.openpty()  # takes the number that became free, so that the modem gets another one
        with self._lock:
            self._node = self._plug()
        for fd in spare:
            os.close(fd)
        if self.kind == "modem":
            self._write(b"\r\nRDY\r\n")

    def _read(self) -> bytes:
        if self._master < 0:
            self._stop.wait(0.01)
        else:
            self._babble()
        return super()._read()

    def _write(self, data: bytes) -> bool:
        """Write bytes without mixing them with those of another thread."""
        with self._speaking:
            sent = super()._write(data)
        self.sent_bytes += len(data) if sent else 0
        return sent

    def _babble(self) -> None:
        """Write the unsolicited output of other devices."""
        if self.kind == "gps":
            self._write(b"$GPGSV,1,1,00*79\r\n$GPRMC,,V,,,,,,,,,,N*53\r\n")
        elif self.kind == "diag":
            self._write(b"\x7e" + self._random.randbytes(60) + b"\x7e")
        elif self.kind == "rubbish":
            self._write(self._random.randbytes(80))
        if self.kind != "modem":
            self._stop.wait(0.05)

    def _serve(self, command: str) -> None:
        with self._lock:
            if self._pending is not None:
                self._pending.read, self._pending = True, None
        faults, self._answered = self.faults, self._answered + 1
        if self.kind != "modem" or 0 < faults.silent_after < self._answered:
            return
        if faults.echo:
            self._write(command.encode("latin-1") + b"\r\r\n")
        elif faults.binary_echo:
            self._write(bytes(b | 0x80 for b in command.encode("latin-1")) + b"\r\r\n")
        reply = self._modem.reply(command)
        self._stop.wait(faults.latency_s + faults.jitter_s * self._random.random())
        data, lines = self._spoilt(list(reply))
        served = Served(command, lines)
        with self._lock:  # before the bytes go out: who reads them may look here at once
            self._pending = served
            self.journal.append(served)
        if faults.bytewise_s > 0:
            sent = all(
                self._write(data[i : i + 1]) and not self._stop.wait(faults.bytewise_s) for i in range(len(data))
            )
        else:
            sent = self._write(data)
        if not sent:
            self.journal.pop()

    def _spoilt(self, lines: list[str]) -> tuple[bytes, tuple[str, ...]]:
        """Bytes of an answer with the faults of its number, and its lines without final result."""
        faults, number = self.faults, self._answered

        def hit(every: int) -> bool:
            return every > 0 and number % every == 0

        if hit(faults.error_every):
            lines = ["+CME ERROR: 14"]
        if hit(faults.no_final_every):
            lines = lines[:-1]
        if hit(faults.late_every):
            self._stop.wait(faults.late_s)
        texts = ["".join(lines[:-1]), lines[-1]] if faults.glue and len(lines) > 2 else lines
        chunks = [framed([text]) for text in texts if text]
        if hit(faults.urc_every):
            chunks.insert(1, b'\r\n+QIND: "csq",22,99\r\n')
        if hit(faults.rubbish_every):
            chunks.insert(0, self._random.randbytes(50) + b"\r\n")
        if hit(faults.huge_line_every):
            chunks.insert(0, b"x" * 10_000_000 + b"\r\n")
        return b"".join(chunks), tuple(lines[:-1])


@dataclass(frozen=True, slots=True)
class BadLine:
    """A line of a log that is not a record."""

    path: Path
    number: int
    reason: str
    torn_tail: bool


def read_log(folder: Path, bad: list[BadLine] | None = None) -> Iterator[Record]:
    """Return the records of the tap's log in a folder, in order. Damaged lines are appended to ``bad``."""
    bad = [] if bad is None else bad
    for path in sorted(folder.glob("tap_*.jsonl")):
        lines = path.read_bytes().split(b"\n")
        for number, line in enumerate(lines, 1):
            try:
                record = decode_record(line) if line.strip() else None
            except ValueError as error:
                bad.append(BadLine(path, number, str(error), number == len(lines)))
                continue
            if record is not None:
                yield record

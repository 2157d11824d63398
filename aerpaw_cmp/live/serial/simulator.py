"""A modem that is not there: a pseudo-terminal that answers like an RM502Q-AE, with faults on request.

It speaks to whatever opens the port, so the tap, a terminal program and the tests all use the same thing. Answers
come from a built-in flight, a captured transcript or an earlier tap log.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import pty
import random
import re
import select
import termios
import threading
import time
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ...common.errors import AerpawCmpError, InputError, UsageError
from ...logs.readers import ReadOptions, identify
from ..record.log import BadLine, read_log
from ..stop import Stop
from .framing import Answer, frame_transcript
from .modem import QUERIES
from .ports import make_raw

# Lines up to and with the final result; None: say nothing.
_Reply = tuple[str, ...] | None


@dataclass(frozen=True, slots=True)
class Faults:
    """Faults that the simulator makes; every number counts answers, 0 is never.

    Parameters
    ----------
    echo : bool
        Echo commands, as most modems do after a reset.
    latency_s, jitter_s : float
        Time before an answer, and its random part [s].
    bytewise_s : float
        Pause between single bytes [s]; 0: whole answers.
    urc_every : int
        An unsolicited line in the middle of each n-th answer.
    no_final_every : int
        Each n-th answer lacks its ``OK``.
    late_every, late_s : int, float
        Each n-th answer comes so late [s].
    rubbish_every : int
        Random bytes before each n-th answer.
    binary_echo : bool
        Echo each command with its high bits set.
    glue : bool
        Leave out the line end between two information lines.
    huge_line_every, huge_line_bytes : int
        A line without meaning and so long before each n-th answer.
    error_every : int
        ``+CME ERROR: 14`` in place of each n-th answer.
    silent_after : int
        Say nothing more after so many answers.
    unplug_every_s, unplug_s : float
        Unplug at random moments, on average so often, for so long [s].
    seed : int
        Of all that is random.
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
    huge_line_bytes: int = 10_000_000
    error_every: int = 0
    silent_after: int = 0
    unplug_every_s: float = 0.0
    unplug_s: float = 0.5
    seed: int = 1


Kind = Literal["modem", "gps", "diag", "silent", "rubbish"]


@dataclass(frozen=True, slots=True)
class ModemSimSettings:
    """Settings of the simulated modem.

    Parameters
    ----------
    link : Path, optional
        A symbolic link to the port, kept right when the port changes its number; None: no link.
    source : Path, optional
        What to play: a transcript or a tap log; None: a built-in flight.
    kind : {"modem", "gps", "diag", "silent", "rubbish"}
        What hangs on the port.
    faults : Faults
    csi_on : bool
        Whether CSI reporting is on at the start.
    rank : callable, optional
        ``rank(seconds) -> int``, 0 for no CSI; replaces the built-in flight.
    rsrp : callable, optional
        ``rsrp(seconds) -> dBm``; replaces that of the built-in flight.
    """

    link: Path | None = None
    source: Path | None = None
    kind: Kind = "modem"
    faults: Faults = field(default_factory=Faults)
    csi_on: bool = True
    rank: Callable[[float], int] | None = None
    rsrp: Callable[[float], float] | None = None

    def __post_init__(self) -> None:
        if self.kind not in ("modem", "gps", "diag", "silent", "rubbish"):
            raise UsageError(f"unknown kind {self.kind!r}", expected="modem, gps, diag, silent or rubbish")


@dataclass(slots=True)
class Served:
    """One answer in the simulator's own journal.

    ``read`` is True once the other side sent its next command: then it has read this answer to the end.
    """

    number: int
    command: str
    lines: tuple[str, ...]
    mono_ns: int
    read: bool = False


# where answers come from --------------------------------------------------------------------------------------


def _flight_rank(seconds: float) -> int:
    """Rank of the built-in flight: 1 to 4 in slow turns, now and then no CSI."""
    if seconds % 120.0 > 118.0:
        return 0
    return 1 + round(1.5 + 1.5 * math.sin(seconds / 20.0))


def _flight_rsrp(seconds: float) -> float:
    """RSRP of the built-in flight [dBm]."""
    return -85.0 - 12.0 * (1.0 + math.sin(seconds / 31.0))


class FlightModem:
    """An RM502Q-AE in SA mode over a simulated flight.

    Parameters
    ----------
    rank : callable
        ``rank(seconds) -> int``.
    csi_on : bool
    rsrp : callable
        ``rsrp(seconds) -> dBm``.
    """

    def __init__(
        self,
        rank: Callable[[float], int] = _flight_rank,
        csi_on: bool = True,
        rsrp: Callable[[float], float] = _flight_rsrp,
    ) -> None:
        self._rank, self._rsrp = rank, rsrp
        self.csi = [int(csi_on), int(csi_on)]
        self._start = time.monotonic()
        self._asked = 0

    def reply(self, command: str) -> _Reply:
        """Lines for a command."""
        now = time.monotonic() - self._start
        rank = self._rank(now) if self.csi[1] else 0
        rsrp = round(self._rsrp(now))
        sinr = max(-20, min(38, 110 + rsrp + round(3 * math.sin(now / 3.0))))
        self._asked += 1
        write = re.fullmatch(r'AT\+QNWCFG="csi_ctrl",([01]),([01])', command)
        if write:
            self.csi = [int(write.group(1)), int(write.group(2))]
            return ("OK",)
        # PMI counts the questions, so that each answer can be told from the others
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


class RecordedModem:
    """Plays recorded answers, each command's in their order, again from the start when they are used up.

    Parameters
    ----------
    answers : list of (command or None, lines with final result)
        Where the command is None it is told by the prefix of the first line.
    """

    def __init__(self, answers: list[tuple[str | None, tuple[str, ...]]]) -> None:
        self._by_command: dict[str, list[tuple[str, ...]]] = {}
        self._next: dict[str, int] = {}
        self._fallback = FlightModem()
        for command, lines in answers:
            for key in _commands_of(command, lines):
                own = lines if command is not None and ";" not in command else _lines_for(key, lines)
                self._by_command.setdefault(key, []).append(own)

    @property
    def commands(self) -> tuple[str, ...]:
        """Commands that have recorded answers."""
        return tuple(self._by_command)

    def reply(self, command: str) -> _Reply:
        """The next recorded answer; identity and ``AT`` are always answered, the rest is ERROR."""
        recorded = self._by_command.get(command.upper())
        if recorded is None:
            if command in ("AT", "ATI", "AT+CGMR") or "csi_ctrl" in command:
                return self._fallback.reply(command)
            return ("ERROR",)
        index = self._next.get(command.upper(), 0)
        self._next[command.upper()] = index + 1
        return recorded[index % len(recorded)]


def _commands_of(command: str | None, lines: tuple[str, ...]) -> Iterator[str]:
    if command is not None and ";" not in command:
        yield command.upper()
        return
    for query in QUERIES.values():  # chained command, or none shown: whose prefix stands in the lines?
        if query.prefixes and any(line.replace(" ", "").startswith(query.prefixes) for line in lines):
            yield query.text.upper()


def _lines_for(key: str, lines: tuple[str, ...]) -> tuple[str, ...]:
    for query in QUERIES.values():
        if query.text.upper() == key and query.prefixes:
            matching = tuple(line for line in lines if line.replace(" ", "").startswith(query.prefixes))
            return (*matching, "OK")
    return lines


_FINAL = {"ok": "OK", "error": "ERROR", "cut": "OK", "timeout": "", "lost": ""}


def load_recorded(path: Path) -> RecordedModem:
    """A modem that plays a transcript or a tap log (file or folder).

    Raises
    ------
    InputError
        If there is no answer in it.
    """
    answers: list[tuple[str | None, tuple[str, ...]]] = []
    if path.is_dir() or path.suffix == ".jsonl":
        bad: list[BadLine] = []
        for record in read_log(path, bad):
            if record.get("kind") == "exchange" and record["status"] in ("ok", "error", "cme", "cms"):
                answers.append(
                    (record["command"], (*record["lines"], _final_text(record["status"], record.get("code"))))
                )
    else:
        try:
            data = path.read_bytes()
        except OSError as error:
            raise InputError(
                f"cannot be read ({error.strerror})", expected="a transcript or tap log", path=path
            ) from None
        for event in frame_transcript(data):
            if isinstance(event, Answer):
                answers.append((event.command, (*event.lines, _final_text(event.status, event.code))))
    modem = RecordedModem(answers)
    if not modem.commands:
        raise InputError("no answer to any known command", expected="an AT transcript or a tap log", path=path)
    return modem


def ranks_of(path: Path, options: ReadOptions) -> Callable[[float], int] | None:
    """Rank over time since the start of a log, None if no reader finds ranks in it."""
    data = path.read_bytes()
    try:
        result = identify(data).read(data, options)
    except AerpawCmpError:
        return None
    streams = [stream for stream in result.streams if stream.kind == "rank" and len(stream.frame)]
    if not streams:
        return None
    frame = streams[0].frame.sort_values("time")
    times = frame["time"].to_numpy().astype("datetime64[ns]").astype("int64")
    seconds = [float(t - times[0]) / 1e9 for t in times]
    ranks = [0 if math.isnan(rank) else round(rank) for rank in frame["rank"].to_numpy(dtype="float64").tolist()]

    def rank(elapsed_s: float) -> int:
        return ranks[max(0, bisect_right(seconds, elapsed_s % (seconds[-1] + 1.0)) - 1)]

    return rank


def _final_text(status: str, code: str | None) -> str:
    return f"+{status.upper()} ERROR: {code}" if status in ("cme", "cms") else _FINAL[status]


# the port -----------------------------------------------------------------------------------------------------


class ModemSimulator:
    """A simulated modem on a pseudo-terminal, served by a thread; a context manager.

    Parameters
    ----------
    settings : ModemSimSettings

    Examples
    --------
    >>> with ModemSimulator(ModemSimSettings()) as modem:
    ...     modem.port.exists()
    True
    """

    def __init__(self, settings: ModemSimSettings | None = None) -> None:
        self.settings = settings or ModemSimSettings()
        self._modem: FlightModem | RecordedModem
        if self.settings.source is not None:
            self._modem = load_recorded(self.settings.source)
        else:
            rank, rsrp = self.settings.rank or _flight_rank, self.settings.rsrp or _flight_rsrp
            self._modem = FlightModem(rank, self.settings.csi_on, rsrp)
        self._random = random.Random(self.settings.faults.seed)
        self._master = -1
        self._lock = threading.RLock()
        self._speaking = threading.Lock()
        self._stop = threading.Event()
        self._unplugged = threading.Event()
        self._answered = 0
        self._pending: Served | None = None
        self.journal: list[Served] = []
        self.unplugs: list[int] = []
        self.sent_bytes = 0
        self.keep_journal = True
        self._node = self._plug()
        self._thread = threading.Thread(target=self._run, name="modem-sim", daemon=True)

    def __enter__(self) -> ModemSimulator:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join(timeout=5.0)
        with self._lock:
            self._close_master()
        self._unlink()

    @property
    def port(self) -> Path:
        """Path to open: the link if there is one, else the node."""
        return self.settings.link or self._node

    @property
    def node(self) -> Path:
        """The present node."""
        return self._node

    @property
    def csi(self) -> list[int]:
        """State of ``csi_ctrl``."""
        return list(getattr(self._modem, "csi", ()))

    def unplug(self) -> None:
        """Pull the cable: the port hangs up and its node goes away."""
        with self._lock:
            self._unplugged.set()
            self._pending = None  # nobody can tell whether it was read
            self.unplugs.append(time.monotonic_ns())
            old, self._master = self._master, -1
            self._unlink()
            if old >= 0:
                os.close(old)

    def replug(self) -> None:
        """Put the cable back: a new node under another number, the link follows; the modem says RDY."""
        spare = pty.openpty()  # takes the number that became free, so that the modem gets another one
        with self._lock:
            self._node = self._plug()
            self._unplugged.clear()
        for fd in spare:
            os.close(fd)
        if self.settings.kind == "modem":
            self._write(b"\r\nRDY\r\n")

    # inside -----------------------------------------------------------------------------------------------

    def _plug(self) -> Path:
        master, slave = pty.openpty()
        try:
            make_raw(slave, termios.B115200)
            node = Path(os.ttyname(slave))
        finally:
            os.close(slave)  # only the tap shall hold the port
        os.set_blocking(master, False)
        self._master = master
        link = self.settings.link
        if link is not None:
            link.parent.mkdir(parents=True, exist_ok=True)
            try:
                link.symlink_to(node)
            except FileExistsError:
                os.close(master)
                raise UsageError(
                    "the name is taken",
                    expected="a new name",
                    cause="a simulator that was killed: remove it",
                    path=link,
                ) from None
        return node

    def _unlink(self) -> None:
        """Remove the link, if it is still the one to our node."""
        link = self.settings.link
        with contextlib.suppress(OSError):
            if link is not None and link.readlink() == self._node:
                link.unlink()

    def _close_master(self) -> None:
        if self._master >= 0:
            os.close(self._master)
            self._master = -1

    def _run(self) -> None:
        received = b""
        next_unplug = self._next_unplug()
        while not self._stop.is_set():
            if next_unplug is not None and time.monotonic() > next_unplug:
                self.unplug()
                self._stop.wait(self.settings.faults.unplug_s)
                self.replug()
                received, next_unplug = b"", self._next_unplug()
            if self._unplugged.is_set():
                received = b""
                self._stop.wait(0.01)
                continue
            self._babble()
            received += self._read()
            while b"\r" in received:
                line, received = received.split(b"\r", 1)
                self._serve(line.strip(b"\n\0 ").decode("latin-1"))

    def _next_unplug(self) -> float | None:
        mean = self.settings.faults.unplug_every_s
        return None if mean <= 0 else time.monotonic() + self._random.uniform(0.2, 1.8) * mean

    def _read(self) -> bytes:
        fd = self._master
        if fd < 0:
            return b""
        poller = select.poll()
        poller.register(fd, select.POLLIN)
        try:
            ready = poller.poll(20)
            if not ready:
                return b""
            if not ready[0][1] & select.POLLIN:
                self._stop.wait(0.02)  # nobody has the port open: poll reports a hang-up at once
                return b""
            return os.read(fd, 4096)
        except OSError:
            self._stop.wait(0.02)
            return b""

    def _write(self, data: bytes) -> bool:
        """Write all of it unless the cable is pulled meanwhile; another thread's bytes stand before or behind."""
        with self._speaking:
            return self._write_out(data)

    def _write_out(self, data: bytes) -> bool:
        while data and not self._stop.is_set():
            try:
                with self._lock:
                    count = os.write(self._master, data[:4096])  # EBADF while the cable is pulled: the number is -1
                    self.sent_bytes += count
            except OSError as error:
                if error.errno not in (errno.EAGAIN, errno.EINTR):
                    return False
                self._stop.wait(0.002)
                continue
            data = data[count:]
        return not data

    def _babble(self) -> None:
        """Write the unsolicited output of other devices."""
        kind = self.settings.kind
        if kind == "gps":
            self._write(b"$GPGSV,1,1,00*79\r\n$GPRMC,,V,,,,,,,,,,N*53\r\n")
        elif kind == "diag":
            self._write(b"\x7e" + bytes(self._random.randrange(256) for _ in range(60)) + b"\x7e")
        elif kind == "rubbish":
            self._write(bytes(self._random.randrange(256) for _ in range(80)))
        if kind != "modem":
            self._stop.wait(0.05)

    def _serve(self, command: str) -> None:
        with self._lock:
            if self._pending is not None:
                self._pending.read = True
                self._pending = None
        if self.settings.kind != "modem" or not command:
            return
        faults = self.settings.faults
        self._answered += 1
        number = self._answered
        if faults.silent_after and number > faults.silent_after:
            return
        if faults.echo:
            self._write(command.encode("latin-1") + b"\r\r\n")
        elif faults.binary_echo:
            self._write(bytes(b | 0x80 for b in command.encode("latin-1")) + b"\r\r\n")
        reply = self._modem.reply(command)
        self._stop.wait(faults.latency_s + faults.jitter_s * self._random.random())
        data, lines = self._spoil(number, reply)
        if not data:
            return
        served = Served(number, command, lines, time.monotonic_ns())
        with self._lock:  # before the bytes go out: who reads them may look here at once
            self._pending = served
            if self.keep_journal:
                self.journal.append(served)
        if faults.bytewise_s > 0:
            sent = all(
                self._write(data[i : i + 1]) and not self._stop.wait(faults.bytewise_s) for i in range(len(data))
            )
        else:
            sent = self._write(data)
        with self._lock:
            if not sent and self.keep_journal:
                self.journal.pop()

    def _spoil(self, number: int, reply: _Reply) -> tuple[bytes, tuple[str, ...]]:
        """Bytes of an answer with the faults of its number, and its lines without final result."""
        faults = self.settings.faults

        def hit(every: int) -> bool:
            return every > 0 and number % every == 0

        if reply is None:
            return b"", ()
        lines = list(reply)
        if hit(faults.error_every):
            lines = ["+CME ERROR: 14"]
        if hit(faults.no_final_every):
            lines = lines[:-1]
        if hit(faults.late_every):
            self._stop.wait(faults.late_s)
        texts = lines
        if faults.glue and len(lines) > 2:
            texts = ["".join(lines[:-1]), lines[-1]]
        chunks = [b"\r\n" + text.encode("latin-1") + b"\r\n" for text in texts if text]
        if hit(faults.urc_every):
            chunks.insert(1, b'\r\n+QIND: "csq",22,99\r\n')
        if hit(faults.rubbish_every):
            chunks.insert(0, bytes(self._random.randrange(256) for _ in range(50)) + b"\r\n")
        if hit(faults.huge_line_every):
            chunks.insert(0, b"x" * faults.huge_line_bytes + b"\r\n")
        return b"".join(chunks), tuple(lines[:-1]) if lines else ()


def run_modem_sim(
    settings: ModemSimSettings,
    *,
    on_ready: Callable[[Path], None] | None = None,
    meanwhile: Callable[[], None] | None = None,
) -> int:
    """Serve a simulated modem until a signal comes.

    Parameters
    ----------
    settings : ModemSimSettings
    on_ready : callable, optional
        Gets the port's name.
    meanwhile : callable, optional
        Called several times a second, e.g. to write the telemetry of the same flight.

    Returns
    -------
    int
        Exit code 0.
    """
    stop = Stop()
    try:
        with stop.on_signals(), ModemSimulator(settings) as modem:
            modem.keep_journal = False
            if on_ready is not None:
                on_ready(modem.port)
            beat = meanwhile or (lambda: None)
            while not stop.wait(0.1 if meanwhile else 1.0):
                beat()
    finally:
        stop.close()
    return 0

"""Settings, status and summary of a session of the tap.

The status goes to the terminal beside the polling: one that hangs (Ctrl-S, a lost ssh connection) holds no poll.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from ..common.counting import counted
from ..common.errors import UsageError
from .record.log import LogSettings
from .serial.ports import Roots


@dataclass(frozen=True, slots=True)
class TapSettings:
    """Settings of the tap; the defaults suit a flight.

    Parameters
    ----------
    folder : Path
        Where the log segments go (``-o``); made if missing.
    port : str, optional
        The serial port; None: the first AT port of a Quectel modem.
    ri_hz : float
        Rate of ``nr5g_csi`` [Hz].
    other_hz : float
        Rate of each of :data:`~aerpaw_cmp.live.serial.modem.OTHER_QUERIES` [Hz].
    pause_s : float
        Rest between an answer and the next command [s].
    answer_timeout_s : float
        An answer later than this is a ``late`` record [s].
    probe_timeout_s : float
        Each of the two probes of a newly opened port waits so long [s].
    silent_s : float
        Without any final result for so long, the port is opened anew [s].
    enable_csi : bool
        Switch CSI reporting on, and back on exit (the only command that writes).
    no_csi_alarm_s : float, optional
        Alarm when no rank came for so long [s].
    no_csi_exit : bool
        End with exit code 1 on that alarm instead of going on.
    status_s : float
        Interval of the status calls [s].
    duration_s : float, optional
        End by itself after so long [s].
    wait_for_port_s : float
        At the start, wait so long for the port to appear [s].
    reconnect_min_s, reconnect_max_s : float
        Back-off after a loss [s].
    log : LogSettings
        Durability and rotation.
    roots : Roots
        Where devices are looked for.
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
    wait_for_port_s: float = 0.0
    reconnect_min_s: float = 0.1
    reconnect_max_s: float = 2.0
    log: LogSettings = field(default_factory=LogSettings)
    roots: Roots = field(default_factory=Roots)

    def __post_init__(self) -> None:
        # asked this way round, NaN is refused as well
        for name in ("ri_hz", "answer_timeout_s", "probe_timeout_s", "silent_s", "status_s", "reconnect_min_s"):
            if not 0 < getattr(self, name) < 1e6:
                raise UsageError(f"{name} is {getattr(self, name)}", expected="a positive number")
        for name in ("other_hz", "pause_s", "wait_for_port_s"):
            if not 0 <= getattr(self, name) < 1e6:
                raise UsageError(f"{name} is {getattr(self, name)}", expected="zero or a positive number")
        if self.no_csi_alarm_s is not None and not self.no_csi_alarm_s > 0:
            raise UsageError(f"no_csi_alarm_s is {self.no_csi_alarm_s}", expected="a positive number of seconds")


@dataclass(frozen=True, slots=True)
class TapStatus:
    """Status that the terminal shows.

    Parameters
    ----------
    connected : bool
    rank : int or None
        Of the last answer; None: no CSI.
    rsrp_dbm, sinr_db : int or None
        NR, last known.
    ri_rate_hz : float
        Answers with status ok over the last 10 s.
    gaps, records, bytes_written : int
    disk_free_bytes : int or None
    disk_fault : str
        Why the disk takes no records now; empty while it does.
    missed : int
        Poll slots that passed unused while connected.
    predicted_rank : int or None
        By the replay at the present pose.
    predicts : bool
        Whether predictions are made at all.
    alarm : bool
        No CSI for longer than asked: ring the bell.
    message : str
        Something to be read once (a loss, a fault, an advice); empty on regular calls.
    """

    connected: bool
    rank: int | None
    rsrp_dbm: int | None
    sinr_db: int | None
    ri_rate_hz: float
    gaps: int
    records: int
    bytes_written: int
    disk_free_bytes: int | None
    disk_fault: str = ""
    missed: int = 0
    predicted_rank: int | None = None
    predicts: bool = False
    alarm: bool = False
    message: str = ""


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
        # a line is written over by the next one, a message is said once
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


@dataclass(frozen=True, slots=True)
class TapSummary:
    """Summary of a session that ended.

    Parameters
    ----------
    reason : str
        ``SIGINT``, ``SIGTERM``, ``SIGHUP``, ``duration``, ``no_csi`` or what the caller's stop said.
    exit_code : int
        0; 1 if the no-CSI alarm ended it or records were lost to the disk.
    segments : tuple of Path
    answers : mapping
        Query to ``{status: count}``.
    rates_hz, missed : mapping
        Query to achieved rate, and to poll slots passed unused while connected.
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
    """One line for the terminal; nothing in it comes from the modem as text."""
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

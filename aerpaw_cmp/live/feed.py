"""The state that the tap's page shows: rows of measurements and predictions, the state of each modem, alarms.

The tap passes records to :meth:`Feed.put`, which appends to a bounded queue. This method does not use a lock that a
browser could hold. A thread of the server processes the queue. Each browser requests the data that are newer than its
cursor. Rows are stored in rings of fixed size, so memory does not grow with the flight or with browsers that do not
read.
"""

from __future__ import annotations

import base64
import contextlib
import itertools
import math
import re
import secrets
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from ..logs.files import Record
from .modem import RI_QUERY
from .ports import TapStatus, stale_after_s

# Number of rows that are stored: two hours at 10 Hz, ten hours at 2 Hz.
ROWS = 72_000
_PENDING = 20_000
# Largest number of rows in one message, so that a slow connection gets a long history in parts.
CHUNK = 4_000
_ALARMS = 300
_LONGEST_TEXT = 300
_GPS_LOST_S = 5.0
_CLOCK_OFF_S = 2.0
_DISK_LOW_BYTES = 200 * 2**20
_STEP_SHOWN_S = 30.0
# Smallest step of the clock that the page shows [s]. A smaller step moves a sample by less than the error of its
# position.
_STEP_S = 0.2

MEASURED = ("t", "rank", "rsrp", "sinr")
# Errors that a record with unexpected content can raise. The record is then not shown on the page, and the polling
# continues.
_MALFORMED = (KeyError, TypeError, ValueError, AttributeError, ArithmeticError)
# A cursor: a version, then two row numbers for each of at most sixteen modems.
_CURSOR = re.compile(r"([0-9a-f]{8})((?:-[0-9]{1,9}){1,33})")


class Rows:
    """The last rows of a table of 32-bit floats. Rows are numbered from zero over the whole session."""

    def __init__(self, size: int = ROWS) -> None:
        self._rows: deque[bytes] = deque(maxlen=size)
        self.count = 0

    def add(self, row: Sequence[float | None]) -> None:
        """Append a row. None becomes NaN."""
        self._rows.append(struct.pack(f"<{len(row)}f", *(math.nan if value is None else value for value in row)))
        self.count += 1

    def after(self, first: int, most: int = CHUNK) -> tuple[int, str]:
        """Return the number of the first returned row, and the rows from it on as little-endian floats in base64."""
        # older rows are lost; a cursor beyond the end is invalid and gets no rows
        oldest = self.count - len(self._rows)
        first = min(max(first, oldest), self.count)
        part = itertools.islice(self._rows, first - oldest, first - oldest + most)
        return first, base64.b64encode(b"".join(part)).decode("ascii")


@dataclass(slots=True)
class Alarm:
    """An alarm and its time. ``end_s`` is None while the alarm is active."""

    number: int
    modem: int
    kind: str
    text: str
    start_s: float
    end_s: float | None = None
    version: int = 0


@dataclass(slots=True)
class _Modem:
    """The state of one modem for the page. Times are monotonic seconds since the feed began."""

    name: str
    port: str = ""
    status: TapStatus = field(default_factory=TapStatus)
    connected: bool = False
    rank: int | None = None
    rsrp_dbm: float | None = None
    sinr_db: float | None = None
    offset_db: float | None = None
    inside: list[int] | None = None
    age_s: float | None = None
    delay_s: float | None = None
    fix: float | None = None
    predicts: bool = False
    ended: bool = False
    measured: Rows = field(default_factory=Rows)
    predicted: Rows = field(default_factory=Rows)
    period_s: float = 0.5
    rank_s: float = 0.0
    level_s: float = 0.0
    gps_s: float = 0.0
    step_s: float | None = None
    step_text: str = ""
    gap_text: str = ""
    unsynchronised: bool = False
    sent: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=64))
    open: dict[str, Alarm] = field(default_factory=dict)

    # a status also contains the first four values, but the values of a record may be newer
    _SHOWN = ("connected", "rank", "rsrp_dbm", "sinr_db", "name", "port", "predicts", "offset_db", "inside", "ended")

    @property
    def stale_s(self) -> float:
        """Age from which a measured value is out of date [s]."""
        return stale_after_s(self.period_s)

    def shown(self, now: float) -> dict[str, Any]:
        """Return the present values that the page shows, and the age of the rank. Old levels are None."""
        ages = {"rank_age_s": round(now - self.rank_s, 3), "stale_s": self.stale_s}
        levels = {} if now - self.level_s <= self.stale_s else {"rsrp_dbm": None, "sinr_db": None}
        return asdict(self.status) | {name: getattr(self, name) for name in self._SHOWN} | levels | ages


class Feed:
    """The state of the page, which one thread writes and the threads of browsers read.

    Parameters
    ----------
    names : sequence of str
        Names of the modems.
    mono_ns, utc_ns : callable
        The clocks of the time stamps in records [ns].
    """

    def __init__(
        self,
        names: Sequence[str],
        mono_ns: Callable[[], int] = time.monotonic_ns,
        utc_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._mono_ns, self._utc_ns = mono_ns, utc_ns
        self.epoch = secrets.token_hex(4)
        self.start_ns, self._start_mono_ns = utc_ns(), mono_ns()
        self._modems = [_Modem(name) for name in names]
        self._pending: deque[tuple[int, Record | TapStatus]] = deque(maxlen=_PENDING)
        self._changed = threading.Condition()
        self._version = 0
        self._alarms: deque[Alarm] = deque(maxlen=_ALARMS)
        self._alarm_count = 0
        self._ended: Mapping[str, Any] | None = None

    def put(self, modem: int, item: Record | TapStatus) -> None:
        """Add a record or a status, without blocking. If too many items wait, the oldest is dropped."""
        self._pending.append((modem, item))

    def end(self, ended: Mapping[str, Any]) -> None:
        """End the session. The page shows ``ended``."""
        self.digest()
        with self._changed:
            self._ended = ended
            self._bump()

    def now(self) -> float:
        """Return the monotonic seconds since the feed began."""
        return self._seconds(self._mono_ns())

    # the server's thread ----------------------------------------------------------------------------------

    def digest(self) -> None:
        """Process the waiting records, update the alarms, and wake the browsers' threads if anything is new."""
        items = [self._pending.popleft() for _ in range(len(self._pending))]
        with self._changed:
            for number, item in items:
                with contextlib.suppress(*_MALFORMED):
                    self._take(self._modems[number], item)
            if self._update_alarms() or items or not self._version:
                self._bump()

    def after(self, cursor: str, wait_s: float = 0.0) -> tuple[dict[str, Any] | None, str]:
        """Return everything newer than the cursor, and the next cursor. None if nothing new arrives within ``wait_s``.

        A cursor of another session, or an invalid cursor, starts from the beginning.
        """
        epoch, version, rows = self._parsed(cursor)
        with self._changed:
            if not self._changed.wait_for(lambda: version < self._version, wait_s):
                return None, cursor
            now, modems, complete, following = self.now(), [], True, []
            for index, modem in enumerate(self._modems):
                content = modem.shown(now)
                for place, (key, table) in enumerate((("rows", modem.measured), ("predictions", modem.predicted))):
                    first, data = table.after(rows[2 * index + place])
                    content[key] = [first, data]
                    reached = min(table.count, first + CHUNK)
                    complete = complete and reached == table.count
                    following.append(reached)
                modems.append(content)
            message = {
                "epoch": self.epoch,
                "continues": epoch == self.epoch,
                "start_ms": self.start_ns // 1_000_000,
                "now_s": round(now, 3),
                "clock_ms": self._utc_ns() // 1_000_000,
                "modems": modems,
                "alarms": [asdict(alarm) for alarm in self._alarms if alarm.version > version],
                "ended": self._ended,
            }
            # if rows remain to be sent, keep the old version, so that the next request does not wait
            reached_version = self._version if complete else version
            return message, "-".join(map(str, [self.epoch, reached_version, *following]))

    # inside -----------------------------------------------------------------------------------------------

    def _bump(self) -> None:
        self._version += 1
        self._changed.notify_all()

    def _parsed(self, cursor: str) -> tuple[str, int, list[int]]:
        zeros = [0] * (2 * len(self._modems))
        match = _CURSOR.fullmatch(cursor)
        numbers = [int(text) for text in match[2][1:].split("-")] if match else []
        if match is None or match[1] != self.epoch or len(numbers) != 1 + len(zeros):
            return "", 0, zeros
        return self.epoch, numbers[0], numbers[1:]

    def _seconds(self, mono_ns: int) -> float:
        return (mono_ns - self._start_mono_ns) / 1e9

    def _status(self, modem: _Modem, status: TapStatus) -> None:
        modem.status, modem.connected, modem.predicts = status, status.connected, status.predicts
        if status.message and status.message not in _alarms_of(modem, self.now()).values():
            self._raise(modem, "message", status.message).end_s = self.now()  # a message has no duration

    def _take(self, modem: _Modem, item: Record | TapStatus) -> None:
        if isinstance(item, TapStatus):
            self._status(modem, item)
            return
        takers = {
            "header": self._take_header,
            "exchange": self._take_exchange,
            "prediction": self._take_prediction,
            "gap": self._take_gap,
            "clock": self._take_clock,
            "end": self._take_end,
        }
        if (take := takers.get(item["kind"])) is not None:
            take(modem, item)

    def _take_header(self, modem: _Modem, record: Record) -> None:
        modem.port = str(record.get("port", {}).get("device", ""))
        modem.period_s = 1.0 / record.get("settings", {}).get("ri_hz", 2.0)
        modem.connected, modem.ended = True, False
        modem.unsynchronised = record.get("clock_synchronised") is False
        modem.rank_s = self._seconds(record["mono_ns"])

    def _take_exchange(self, modem: _Modem, record: Record) -> None:
        decoded = record.get("decoded") or {}
        if record["query"] == "servingcell":
            cell = decoded.get("nr") or {}
            modem.rsrp_dbm, modem.sinr_db = _finite(cell.get("rsrp_dbm")), _finite(cell.get("sinr_db"))
            modem.level_s = self._seconds(record["last_mono_ns"])
        elif record["query"] == RI_QUERY:
            # the modem read its rank between the query and the end of the answer
            t = self._seconds((record["sent_mono_ns"] + record["last_mono_ns"]) // 2)
            rank = _finite(decoded.get("rank"))
            modem.rank = None if rank is None else int(rank)
            if modem.rank is not None:
                modem.rank_s = t
            # levels come from another query at a slower rate: store the last levels with each rank unless they are old
            if t - modem.level_s > modem.stale_s:
                modem.rsrp_dbm = modem.sinr_db = None
            modem.measured.add((t, modem.rank, modem.rsrp_dbm, modem.sinr_db))
            modem.sent.append((record["sent_utc_ns"], t))

    def _take_prediction(self, modem: _Modem, record: Record) -> None:
        modem.predicts = True
        t = next((t for sent, t in modem.sent if sent == record["for_sent_utc_ns"]), None)
        if t is None:
            return
        modem.age_s, modem.delay_s = _finite(record.get("telemetry_age_s")), _finite(record.get("telemetry_delay_s"))
        modem.fix, modem.offset_db = _finite(record.get("fix")), _finite(record.get("offset_db"))
        modem.inside = [int(count) for count in record.get("inside") or ()] or None
        if record.get("east_m") is not None and not (modem.fix is not None and 0 <= modem.fix < 3):
            modem.gps_s = t
        low, high = record.get("rank_interval") or (None, None)
        level_low, level_high = record.get("level_interval_dbm") or (None, None)
        level, offset = record.get("level_dbm"), modem.offset_db
        # without an offset, the replayed level does not have the reference of the RSRP axis
        level = None if level is None or offset is None else level + offset
        modem.predicted.add(
            (
                *(t, record.get("measured"), record.get("predicted"), low, high),
                *(record.get("rsrp_dbm"), level, level_low, level_high),
                *(record.get("east_m"), record.get("north_m"), record.get("up_m")),
            )
        )

    def _take_gap(self, modem: _Modem, record: Record) -> None:
        modem.connected = record["state"] == "closed"
        modem.gap_text = "" if modem.connected else f"no modem: {record['reason']}"
        if modem.connected:
            modem.rank_s = self._seconds(record["mono_ns"])
        else:
            _clear(modem)

    def _take_clock(self, modem: _Modem, record: Record) -> None:
        step_s = record["step_ns"] / 1e9
        if abs(step_s) >= max(_STEP_S, modem.period_s / 2):  # for a slow tap, only larger steps matter
            modem.step_s = self._seconds(record["mono_ns"])
            modem.step_text = f"the wall clock stepped by {step_s:+.3f} s"

    def _take_end(self, modem: _Modem, _record: Record) -> None:
        modem.connected, modem.ended, modem.gap_text = False, True, ""
        _clear(modem)

    # alarms -----------------------------------------------------------------------------------------------

    def _raise(self, modem: _Modem, kind: str, text: str) -> Alarm:
        alarm = Alarm(
            number=self._alarm_count,
            modem=self._modems.index(modem),
            kind=kind,
            text=text[:_LONGEST_TEXT],
            start_s=self.now(),
            version=self._version + 1,  # the present version may already have been sent
        )
        self._alarm_count += 1
        self._alarms.append(alarm)
        return alarm

    def _update_alarms(self) -> bool:
        """Open and close alarms according to the present state. Return whether an alarm changed."""
        changed = False
        for modem in self._modems:
            conditions = {} if modem.ended or self._ended else _alarms_of(modem, self.now())
            for kind in [kind for kind in modem.open if kind not in conditions]:
                alarm = modem.open.pop(kind)
                alarm.end_s, alarm.version, changed = self.now(), self._version + 1, True
            for kind, text in conditions.items():
                if kind not in modem.open:
                    modem.open[kind], changed = self._raise(modem, kind, text), True
        return changed


def _clear(modem: _Modem) -> None:
    """Remove the last measured values, because they are not valid in a gap or after the end."""
    modem.rank = modem.rsrp_dbm = modem.sinr_db = None


def _finite(value: Any) -> float | None:
    """Return a finite number of a record, else None. A crafted log may contain anything."""
    return value if isinstance(value, (int, float)) and math.isfinite(value) else None


def _alarms_of(modem: _Modem, now: float) -> dict[str, str]:
    """Return the alarms that are active at this moment, by kind."""
    alarms: dict[str, str] = {}
    stale_s, lost_s = modem.stale_s, max(_GPS_LOST_S, 3 * modem.period_s)
    if modem.gap_text:
        alarms["gap"] = modem.gap_text
    elif modem.connected and now - modem.rank_s > stale_s:
        alarms["stale"] = f"no rank for more than {stale_s:g} s: is data flowing, and CSI reporting on?"
    if modem.predicts and now - modem.gps_s > lost_s:
        if modem.fix is not None and 0 <= modem.fix < 3:
            alarms["gps"] = "GPS lost: the telemetry reports no 3-D fix"
        elif modem.age_s is None:
            alarms["gps"] = "no position: the telemetry log has no lines yet"
        else:
            alarms["gps"] = f"no position for more than {lost_s:g} s: the telemetry log is not up to date"
    if modem.status.disk_fault:
        alarms["disk"] = f"the log cannot be written: {modem.status.disk_fault}; records wait in memory"
    elif modem.status.disk_free_bytes is not None and modem.status.disk_free_bytes < _DISK_LOW_BYTES:
        alarms["disk"] = f"less than {_DISK_LOW_BYTES // 2**20} MiB left on the log's disk"
    if modem.step_s is not None and now - modem.step_s < _STEP_SHOWN_S:
        alarms["step"] = modem.step_text
    # a line may be written late but never before its time, so the limit for early lines is smaller
    if modem.delay_s is not None and (modem.delay_s < -_CLOCK_OFF_S / 4 or modem.delay_s > _CLOCK_OFF_S):
        ahead = "ahead of" if modem.delay_s < 0 else "behind"
        alarms["clock"] = f"the telemetry's clock is {abs(modem.delay_s):.1f} s {ahead} this computer's"
    elif modem.unsynchronised:
        alarms["clock"] = "the clock is not synchronised (NTP or GPS): times may not fit the telemetry"
    return alarms

"""A tap log played to the page at its own pace or faster, as if the flight took place now."""

from __future__ import annotations

import heapq
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..common.errors import InputError, UsageError
from ..logs.files.checksums import Record
from .feed import Feed
from .record.log import BadLine, read_log
from .stop import Stop

# Time between two records beyond this (the tap was off) is passed at once, in seconds of the log.
_LONGEST_PAUSE_S = 10.0


class Player:
    """Hands the records of one or more logs to a feed, in the order of their times.

    Parameters
    ----------
    folders : sequence of Path
        Log folders or segments, one per modem.
    speed : float
        Seconds of the log per second.

    Raises
    ------
    InputError
        If a log holds no record with a time.
    """

    def __init__(self, folders: Sequence[Path], speed: float = 1.0) -> None:
        if not 0 < speed <= 1e6:
            raise UsageError(f"--speed {speed:g}", expected="a positive number")
        self._wanted_speed, self._speed, self._bad = speed, 0.0, list[BadLine]()
        logs = [_timed(folder, modem, self._bad) for modem, folder in enumerate(folders)]
        self._records = heapq.merge(*logs, key=lambda item: item[0])
        self._next = next(self._records, None)
        if self._next is None:
            raise InputError("the log holds no record with a time", expected="a tap log", path=folders[0])
        self._at_ns, self._since = self._next[0], time.monotonic()

    def steady_ns(self) -> int:
        """Time of the log that is played now [ns]; it stands still before the play and after it."""
        return self._at_ns + int((time.monotonic() - self._since) * self._speed * 1e9)

    def play(self, feed: Feed, stop: Stop) -> int:
        """Play to the end of the log or until asked to stop; the number of unreadable lines."""
        self._since, self._speed = time.monotonic(), self._wanted_speed
        while self._next is not None and not stop.count:
            due, modem, record = self._next
            ahead_s = (due - self.steady_ns()) / 1e9
            if ahead_s > _LONGEST_PAUSE_S:
                self._at_ns, self._since = due, time.monotonic()
            elif ahead_s > 0:
                stop.wait(min(ahead_s / self._speed, 0.2))
                continue
            feed.put(modem, record)
            self._next = next(self._records, None)
        self._at_ns, self._since, self._speed = self.steady_ns(), time.monotonic(), 0.0
        return len(self._bad)


def _timed(folder: Path, modem: int, bad: list[BadLine]) -> Iterator[tuple[int, int, Record]]:
    """Records with their steady times: monotonic ones of each session, put to UTC by its header."""
    shift, last = 0, 0
    for record in read_log(folder, bad):
        mono = record.get("mono_ns", record.get("last_mono_ns"))
        if record.get("kind") == "header" and isinstance(record.get("utc_ns"), int) and isinstance(mono, int):
            shift = record["utc_ns"] - mono
        last = max(last, mono + shift) if isinstance(mono, int) else last
        if last:
            yield last, modem, record

"""Schedule of the queries: which one is due when."""

from __future__ import annotations

from collections import Counter

# A slot that is late by at most so many periods is still polled, at once; older ones are missed and counted.
_CATCH_UP = 2


class Schedule:
    """Order and times of the queries. The first name goes first whenever it is due; the others by age.

    After a short stall the polls that fell due meanwhile follow each other without a rest (each record has its true
    times), so that a hiccup of the machine costs no answer; after a long one the schedule starts from now.

    Parameters
    ----------
    periods_ns : mapping
        Name to period.
    """

    def __init__(self, periods_ns: dict[str, int]) -> None:
        self._periods = periods_ns
        self._first = next(iter(periods_ns))
        self._due: dict[str, int] = {}
        self.missed: Counter[str] = Counter()

    def reset(self, now_ns: int) -> None:
        """Start anew: all due now."""
        self._due = dict.fromkeys(self._periods, now_ns)

    def next(self, now_ns: int) -> tuple[str, int]:
        """Name and due time of the next poll."""
        if self._due[self._first] <= now_ns:
            return self._first, self._due[self._first]
        name = min(self._due, key=lambda n: self._due[n])
        return name, self._due[name]

    def started(self, name: str, now_ns: int) -> None:
        """A poll begins; slots that cannot be caught up any more are missed."""
        period = self._periods[name]
        late = max(0, (now_ns - self._due[name]) // period)
        skipped = late if late > _CATCH_UP else 0
        self.missed[name] += skipped
        self._due[name] += (skipped + 1) * period

    def slots(self, duration_ns: int) -> dict[str, int]:
        """Polls that a gap of this length cost."""
        return {name: duration_ns // period for name, period in self._periods.items()}

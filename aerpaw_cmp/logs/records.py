"""The record model: the result of every reader for every format.

A log file becomes a :class:`ReadResult`: streams of records, the account of its lines, and the rejected lines with
their reasons (the first thousand verbatim, all counted). The account is checked when the result is built::

    lines == accepted + rejected_count + blank

Columns (UTC ``time`` as naive ``datetime64[ns]``; units in names). Every frame has ``time``, ``line``
(1-based line, or row of a binary file) and ``flag`` (empty, or reasons joined by ``;``).

telemetry
    ``latitude_deg longitude_deg altitude_m`` (above take-off) ``roll_deg pitch_deg yaw_deg`` (nose up +,
    right wing down +, yaw clockwise from north) ``velocity_north_mps velocity_east_mps velocity_down_mps
    fix satellites``, and ``battery_v`` if the log has it. Missing values are NaN (``fix`` and ``satellites``: -1).
rss
    ``rss_db`` (NaN: out of coverage). Attributes: ``node``, ``channel``, ``unit``
    (``"dBm"`` or ``"dB re full scale"``), ``frequency_hz``.
rank
    ``rank`` (float; NaN = no CSI, never 0), ``ri_raw``, and ``rsrp_dbm sinr_db cqi mcs
    latitude_deg longitude_deg altitude_m`` if the log has them. Attributes: ``ri_base`` (``"one"`` or ``"zero"``).
kpi
    ``value``: any other quantity of a modem or base station (RSRQ, SINR, CQI, throughput, ...); a report does not
    compare it. Attributes: ``quantity``, ``unit``.

An rss stream of one cell has the attribute ``pci`` and, if known, ``arfcn``, ``band`` and ``rat``.

The column ``serving`` is 1 while the cell serves the phone, 0 while another cell serves it, and NaN if unknown.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd

Kind = Literal["telemetry", "rss", "rank", "kpi"]
Attribute = str | float | int | bool

# Columns that a frame of each kind must have in addition to ``time``, ``line`` and ``flag``.
COLUMNS: dict[str, tuple[str, ...]] = {
    "telemetry": (
        "latitude_deg", "longitude_deg", "altitude_m", "roll_deg", "pitch_deg", "yaw_deg",
        "velocity_north_mps", "velocity_east_mps", "velocity_down_mps", "fix", "satellites",
    ),
    "rss": ("rss_db",),
    "rank": ("rank", "ri_raw"),
    "kpi": ("value",),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Stream:
    """One sequence of records of one kind.

    Parameters
    ----------
    kind : {"telemetry", "rss", "rank", "kpi"}
        Kind of the stream, which determines its columns (see the module text).
    name : str
        Name that is unique within the file, such as ``"vehicle"``, ``"power"`` or ``"USRP1"``.
    frame : pandas.DataFrame
        The records in file order, with the default integer index.
    attributes : mapping
        Attributes of the complete stream: node, channel, unit, frequency_hz, ri_base, clock.

    Raises
    ------
    ValueError
        If a column of the kind is missing (a bug of the reader, not of the user).
    """

    kind: Kind
    name: str
    frame: pd.DataFrame
    attributes: Mapping[str, Attribute] = field(default_factory=dict)

    def __post_init__(self) -> None:
        present = set(self.frame.columns)
        missing = [c for c in ("time", "line", "flag", *COLUMNS[self.kind]) if c not in present]
        if missing:
            raise ValueError(f"stream {self.name!r} of kind {self.kind!r} lacks columns {missing}")

    @property
    def rows(self) -> int:
        """The number of records."""
        return len(self.frame)

    @property
    def channel(self) -> str:
        """The channel of the receiver if the log specifies it, else the name."""
        return str(self.attributes.get("channel") or self.name)


@dataclass(frozen=True, slots=True)
class RejectedLine:
    """A line that is not a record: its 1-based number, the reason, and its text (at most 500 characters)."""

    number: int
    reason: str
    text: str


@dataclass(frozen=True, slots=True)
class RejectedReason:
    """A reason why lines were rejected, with the number of these lines, and the first and last of them (1-based)."""

    reason: str
    count: int
    first: int
    last: int


# The first rejected lines of a file are stored verbatim, and all are counted.
KEPT_REJECTED = 1000


def by_reason(counted: Iterable[RejectedReason]) -> tuple[RejectedReason, ...]:
    """Join the counts of each reason, in the order of their first lines."""
    known: dict[str, RejectedReason] = {}
    for item in counted:
        old = known.get(item.reason, RejectedReason(item.reason, 0, item.first, item.last))
        first, last = min(old.first, item.first), max(old.last, item.last)
        known[item.reason] = RejectedReason(item.reason, old.count + item.count, first, last)
    return tuple(sorted(known.values(), key=lambda entry: entry.first))


@dataclass(frozen=True, slots=True)
class ReadResult:
    """The result of reading one file.

    Parameters
    ----------
    reader : str
        Name of the reader.
    streams : tuple of Stream
        Streams of the file. May be empty.
    lines, accepted, blank : int
        ``blank`` counts blank lines, headers and comments.
    rejected : tuple of RejectedLine
        All rejected lines, at most the first ``KEPT_REJECTED``.
    reasons : tuple of RejectedReason
        Number of rejected lines per reason; by default counted from ``rejected``.
    warnings : tuple of str
        Sentences for the user.

    Raises
    ------
    ValueError
        If lines are not the sum of accepted, rejected and blank lines.
    """

    reader: str
    streams: tuple[Stream, ...]
    lines: int
    accepted: int
    blank: int
    rejected: tuple[RejectedLine, ...] = ()
    warnings: tuple[str, ...] = ()
    reasons: tuple[RejectedReason, ...] = ()

    def __post_init__(self) -> None:
        # count the lines, because readers of small files do not return reasons
        if not self.reasons:
            reasons = by_reason(RejectedReason(line.reason, 1, line.number, line.number) for line in self.rejected)
            object.__setattr__(self, "reasons", reasons)
        if len(self.rejected) > KEPT_REJECTED:
            # store only the first lines, because the text of a damaged log of 1 GB would fill the memory. All lines are
            # counted in the reasons.
            object.__setattr__(self, "rejected", self.rejected[:KEPT_REJECTED])
        if self.lines != self.accepted + self.rejected_count + self.blank:
            raise ValueError(
                f"reader {self.reader!r} did not account for every line: {self.lines} lines, but {self.accepted} "
                f"accepted + {self.rejected_count} rejected + {self.blank} blank"
            )

    @property
    def rejected_count(self) -> int:
        """The number of rejected lines, including those that are not stored."""
        return sum(item.count for item in self.reasons)


def has_wall_clock(start: np.datetime64) -> bool:
    """Check whether a log has wall-clock times. Relative times without an origin begin in 1970."""
    import numpy as np

    return bool(start >= np.datetime64("1980-01-01"))

"""Measure the power of the clock test: inject lags into every real flight of a folder.

Each flight is drafted as usual, and its radio times are shifted. A lag of one second or more is found (verdict
"shifted", with the lag in the interval), wrong (the interval does not contain it) or undecided. A smaller lag counts
as found if the verdict is "ok", or "shifted" with an interval that contains it. The clocks of these logs agree within
about one second. Therefore an interval that misses a small lag is not counted as wrong. Flights that are called
"shifted" as logged are counted.

    python benchmarks/clock_power.py FOLDER [--timezone America/New_York] [--only TEXT] [--quiet]
"""

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from aerpaw_cmp.common.errors import AerpawCmpError
from aerpaw_cmp.compare.result import CANNOT_TELL, SHIFTED
from aerpaw_cmp.flight.clock import ClockEstimate, judge_clock
from aerpaw_cmp.flight.data import FlightData, gather, read_logs
from aerpaw_cmp.flight.drafting.draft import DraftOptions, drafts
from aerpaw_cmp.flight.gains import load_with_learned
from aerpaw_cmp.flight.replay import clock_channels, same_computer
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions

PLANTED_S = (0.0, 0.3, -0.7, 1.0, -1.5, 3.0, -6.0, 10.0)
UNSHIFTED_WITHIN_S = 1.0


def drafted(path: Path, timezone: str) -> FlightData | None:
    """Return the drafted flight of one file, or None if it has no levels along a track."""
    try:
        files = ingest([path], options=ReadOptions(timezone=timezone))
        with tempfile.TemporaryDirectory() as folder:
            (made,) = drafts(files, Path(folder), DraftOptions(timezone=timezone))
            flight = Path(folder) / "flight.yaml"
            flight.write_text(made.text)
            settings = load_with_learned(flight)
            data = gather(settings, Path(folder), read_logs(settings, Path(folder)))
    except (AerpawCmpError, ValueError):
        return None
    return data if data.rss and data.track is not None else None


def judged(data: FlightData) -> Iterator[tuple[float, ClockEstimate]]:
    """The estimate of each planted lag, computer by computer."""
    for members in same_computer(data):
        channels = clock_channels(data, [data.rss[i] for i in members])
        for planted in PLANTED_S:
            yield planted, judge_clock([replace(c, time_s=c.time_s + planted) for c in channels])


def outcome(planted: float, clock: ClockEstimate) -> str:
    """``found``, ``wrong`` or ``undecided``."""
    if clock.verdict == CANNOT_TELL:
        return "undecided"
    low, high = clock.ci95_s
    if not low - UNSHIFTED_WITHIN_S <= planted <= high + UNSHIFTED_WITHIN_S:
        return "wrong"
    return "found" if clock.verdict == SHIFTED or abs(planted) < 1.0 else "undecided"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--timezone", default="America/New_York")
    parser.add_argument("--only", default="", help="files whose path holds this")
    parser.add_argument("--quiet", action="store_true", help="the table alone")
    asked = parser.parse_args()
    counts: dict[tuple[str, float], Counter[str]] = {}
    for path in sorted(p for p in asked.folder.rglob("*") if p.is_file() and asked.only in str(p)):
        data = drafted(path, asked.timezone)
        for planted, clock in judged(data) if data is not None else ():
            said, (low, high) = outcome(planted, clock), clock.ci95_s
            count = counts.setdefault((path.parent.name, abs(planted)), Counter())
            count[said] += 1
            count["shifted"] += clock.verdict == SHIFTED
            if not asked.quiet:
                print(
                    f"{path.stem:40} {planted:+5.1f} {said:9} {clock.verdict:11} {clock.radio_minus_telemetry_s:+6.2f}"
                    f" [{low:+.2f}, {high:+.2f}]  {clock.reason}",
                    flush=True,
                )
    print("folder        planted  found  wrong  undecided  called shifted")
    for (kind, planted), count in sorted(counts.items()):
        numbers = (count[name] for name in ("found", "wrong", "undecided", "shifted"))
        print(f"{kind:12} {planted:6.1f} s  {{:5}}  {{:5}}  {{:9}}  {{:14}}".format(*numbers))
    return int(any(count["wrong"] for count in counts.values()))


if __name__ == "__main__":
    sys.exit(main())

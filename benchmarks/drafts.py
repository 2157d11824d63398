"""Draft the logs of a folder: each file alone, each folder, and with --pairs each track with each radio log.

The script prints, for each draft, the samples that a report would score, or the reason why there are none. The exit
code is 1 if a draft gives neither. All pairs are drafted that share time or contain a relative clock. No user would
draft the other pairs together, so only a sample of them (--others) is drafted.

    python benchmarks/drafts.py FOLDER [--timezone America/New_York] [--pairs] [--others 100]
"""

import argparse
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from aerpaw_cmp.common.errors import AerpawCmpError
from aerpaw_cmp.flight.drafting.draft import DraftOptions, drafts
from aerpaw_cmp.logs.flight_file import IngestedFile
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.records import has_wall_clock


def outcome(read: Callable[[], Sequence[IngestedFile]], timezone: str) -> tuple[str, str]:
    """Return ``drafted``, ``refused`` or ``silent``, and the message."""
    try:
        files = read()
        if not files:
            return "refused", "no log"
        with tempfile.TemporaryDirectory() as folder:
            made = drafts(files, Path(folder), DraftOptions(timezone=timezone))
    except AerpawCmpError as error:
        return "refused", str(error)
    words = [remark for draft in made for remark in draft.remarks if "can be compared" in remark]
    kind = "drafted" if any(not word.startswith("no sample") for word in words) else "silent"
    return kind, "; ".join(words)


def pairs(files: Mapping[Path, Sequence[IngestedFile]], others: int) -> list[tuple[Path, Path]]:
    """Pairs of a track and a radio log: all that may be of one flight, and a sample of the others."""
    tracks = [path for path, made in files.items() if "telemetry" in _kinds(made)]
    radios = [path for path, made in files.items() if _kinds(made) & {"rss", "rank"}]
    likely, unlikely = [], []
    for track, radio in product(tracks, radios):
        if track != radio:
            (likely if _may_meet(files[track], files[radio]) else unlikely).append((track, radio))
    return likely + random.Random(32).sample(unlikely, min(others, len(unlikely)))


def _kinds(made: Sequence[IngestedFile]) -> set[str]:
    return {stream.kind for file in made for stream in file.result.streams if len(stream.frame)}


def _may_meet(track: Sequence[IngestedFile], radio: Sequence[IngestedFile]) -> bool:
    """Check whether the logs overlap in time, or one of the clocks is relative."""
    (first, last), (other_first, other_last) = _span(track), _span(radio)
    relative = not (has_wall_clock(first) and has_wall_clock(other_first))
    return relative or bool(first <= other_last and other_first <= last)


def _span(made: Sequence[IngestedFile]) -> tuple[np.datetime64, np.datetime64]:
    times = [s.frame["time"].to_numpy("datetime64[us]") for file in made for s in file.result.streams if len(s.frame)]
    return min(time.min() for time in times), max(time.max() for time in times)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--timezone", default="America/New_York")
    parser.add_argument("--pairs", action="store_true", help="the pairs alone")
    parser.add_argument("--others", type=int, default=100)
    asked = parser.parse_args()
    every = [path for path in sorted(asked.folder.rglob("*")) if path.is_file() and path.suffix != ".md"]
    options = ReadOptions(timezone=asked.timezone)
    groups = [[path] for path in every] + [[path] for path in sorted(asked.folder.iterdir()) if path.is_dir()]
    readings: list[Callable[[], Sequence[IngestedFile]]]
    readings = [partial(ingest, group, options=options) for group in groups]
    if asked.pairs:
        known: dict[Path, Sequence[IngestedFile]] = {}
        for path in every:
            with suppress(AerpawCmpError):
                known[path] = ingest([path], options=options)
        groups = [[*pair] for pair in pairs(known, asked.others)]
        readings = [partial(lambda pair: [file for path in pair for file in known[path]], group) for group in groups]
    unsaid, counts = 0, Counter[str]()
    for group, read in zip(groups, readings, strict=True):
        kind, words = outcome(read, asked.timezone)
        unsaid += not words
        counts[kind] += 1
        print(f"{kind:8} {' + '.join(str(path.relative_to(asked.folder)) for path in group)}: {words}", flush=True)
    print(f"{len(groups)} drafts: {dict(counts)}; {unsaid} without a word")
    return int(unsaid > 0)


if __name__ == "__main__":
    sys.exit(main())

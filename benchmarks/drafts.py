"""Drafts of a folder of logs: each file alone, each folder, each two files of a folder that share time.

Prints, per draft, the samples that a report would score, or the reason why none. Exit code 1 if a draft gives neither.

    python benchmarks/drafts.py FOLDER [--timezone America/New_York] [--pairs]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from itertools import combinations
from pathlib import Path

from aerpaw_cmp.common.errors import AerpawCmpError
from aerpaw_cmp.flight.draft import drafts
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions


def outcome(paths: list[Path], timezone: str) -> tuple[str, str]:
    """``drafted``, ``refused`` or ``silent``, and what is said."""
    try:
        files = ingest(paths, options=ReadOptions(timezone=timezone))
        if not files:
            return "refused", "no log"
        with tempfile.TemporaryDirectory() as folder:
            made = drafts(files, Path(folder), timezone=timezone)
    except AerpawCmpError as error:
        return "refused", str(error)
    words = [remark for one in made for remark in one.remarks if "can be compared" in remark]
    kind = "drafted" if any(not word.startswith("no sample") for word in words) else "silent"
    return kind, "; ".join(words)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--timezone", default="America/New_York")
    parser.add_argument("--pairs", action="store_true")
    asked = parser.parse_args()
    every = [path for path in sorted(asked.folder.rglob("*")) if path.is_file() and path.suffix != ".md"]
    groups = [[path] for path in every] + [[path] for path in sorted(asked.folder.iterdir()) if path.is_dir()]
    if asked.pairs:
        groups += [[*pair] for pair in combinations(every, 2)]
    unsaid = 0
    for group in groups:
        kind, words = outcome(group, asked.timezone)
        unsaid += not words
        print(f"{kind:8} {' + '.join(str(path.relative_to(asked.folder)) for path in group)}: {words}", flush=True)
    return int(unsaid > 0)


if __name__ == "__main__":
    sys.exit(main())

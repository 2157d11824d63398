"""First sentences of reports of flights that are drafted and reported as they come, not a line edited.

Prints, per file whose draft has samples to score, the first sentence of the page, and by channel the RMSE, that of free
space and that of all samples with the receiver's floor [dB].

    python benchmarks/drafted_reports.py FOLDER [--timezone America/New_York] [--only TEXT]
"""

from __future__ import annotations

import argparse
import html
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path


def reported(log: Path, timezone: str) -> tuple[str, list[str]] | None:
    """First sentence, and numbers by channel; None where nothing is drafted or scored."""
    with tempfile.TemporaryDirectory() as name:
        flight, out = Path(name) / "flight.yaml", Path(name) / "report"
        draft = _run("ingest", str(log), "--timezone", timezone, "--draft", str(flight))
        if draft.returncode or not flight.is_file():
            return None
        done = _run("report", str(flight), "-o", str(out), "--figures", "none", "--audit", "none")
        if done.returncode:
            return f"exit {done.returncode}: {done.stderr.strip()[-200:]}", []
        page = (out / "report.html").read_text(encoding="utf-8")
        metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    first = re.search(r'class="verdict">(.*?)</p>', page, re.DOTALL)
    numbers = []
    for tower, channels in metrics.get("rss", {}).items():
        for channel, one in channels.items():
            free = one.get("baselines", {}).get("free_space", {}).get("rmse_db")
            floor = (one.get("detection") or {}).get("rmse_db")
            numbers.append(f"{tower} {channel} {_db(one.get('rmse_db'))}, free space {_db(free)}, floor {_db(floor)}")
    for tower, one in metrics.get("rank", {}).items():
        kappa = (one.get("receiver") or {}).get("kappa")
        numbers.append(f"rank {tower} kappa {_db(kappa)}")
    clocks = [f"clock {name} {one['verdict']}" for name, one in metrics.get("clock", {}).items()]
    return html.unescape(first[1]).strip() if first else "no sentence", [*numbers, *clocks]


def _run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "aerpaw_cmp", *arguments], check=False, capture_output=True, text=True
    )  # fmt: skip


def _db(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--timezone", default="America/New_York")
    parser.add_argument("--only", default="", help="files whose path holds this")
    asked = parser.parse_args()
    for path in sorted(p for p in asked.folder.rglob("*") if p.is_file() and asked.only in str(p)):
        found = reported(path, asked.timezone)
        if found is not None:
            print(
                f"{path.relative_to(asked.folder)}: {found[0]}",
                *(f"    {one}" for one in found[1]),
                sep="\n",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())

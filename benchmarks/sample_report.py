"""The sample flight's report without its audit: seconds with empty caches, and again, against importing its libraries.

    python benchmarks/sample_report.py [--figures page] [--runs 1]

Cold: no font list, no compiled kernel and no path is kept from an earlier run. Asked: at most 12 s cold and at most
five times the imports warm. CPU seconds are of all processes; wall seconds mean something on an idle machine only.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

from report import IMPORTS, ROOT, report, run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--figures", default="page")
    parser.add_argument("--runs", type=int, default=1, help="warm runs; the fastest counts")
    options = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start, figures {options.figures}, no audit")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        kept = {key: str(folder / key) for key in ("XDG_CACHE_HOME", "MPLCONFIGDIR", "AERPAW_CMP_CACHE")}
        line = report(
            ROOT / "sample_logs" / "flight.yaml", folder / "out", "--audit", "none", "--figures", options.figures
        )
        found = {"cold": run(line, **kept)}
        found["warm"] = min((run(line, **kept) for _ in range(options.runs)), key=lambda one: one["wall_s"])
        found["imports"] = min(
            (run([sys.executable, "-c", IMPORTS], **kept) for _ in range(3)), key=lambda one: one["wall_s"]
        )
        stages = json.loads((folder / "out" / "metrics.json").read_text())["stages"]
    for title, one in found.items():
        print(f"{title:8} {one['wall_s']:6.1f} s, {one['cpu_s']:6.1f} CPU s, {one['peak_mib']:.0f} MiB")
    warm, imports = found["warm"], found["imports"]
    print(
        f"warm over imports: {warm['wall_s'] / imports['wall_s']:.1f} wall, {warm['cpu_s'] / imports['cpu_s']:.1f} CPU"
    )
    print("stages of the last run, wall s: " + ", ".join(f"{k.removesuffix('_s')} {v:.1f}" for k, v in stages.items()))


if __name__ == "__main__":
    main()

"""Processor time of the tap at its default rates, as a share of one core."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from tap_common import conditions, cpu_s, show, start_tap

from aerpaw_cmp.live.simulator import Faults, ModemSimSettings, ModemSimulator


def measure(seconds: float, folder: Path) -> dict[str, object]:
    """Share of one core over a session, after the start."""
    link = folder / "modem"
    with ModemSimulator(ModemSimSettings(link=link, faults=Faults(latency_s=0.03, jitter_s=0.03))) as modem:
        process = start_tap(link, folder / "log", duration_s=seconds + 60, show_status=True)
        while len(modem.journal) < 6:
            time.sleep(0.05)
        start, before = time.monotonic(), cpu_s(process.pid)
        time.sleep(seconds)
        used, elapsed = cpu_s(process.pid) - before, time.monotonic() - start
        process.terminate()  # SIGINT is ignored where a shell started this in the background
        summary = json.loads(process.communicate(timeout=30)[0])
    return {
        "seconds": round(elapsed, 1),
        "cpu_percent_of_one_core": round(100 * used / elapsed, 3),
        "exchanges_per_s": round(sum(summary["rates_hz"].values()), 2),
        "ri_rate_hz": summary["rates_hz"]["nr5g_csi"],
        "missed_polls": sum(summary["missed"].values()),
    }


def main() -> None:
    """Measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--quick", action="store_true", help="10 s")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = measure(10.0 if arguments.quick else arguments.seconds, Path(folder))
    show({**result, **conditions()}, arguments.json)
    if float(result["cpu_percent_of_one_core"]) >= 2.0:  # type: ignore[arg-type]
        sys.exit(1)


if __name__ == "__main__":
    main()

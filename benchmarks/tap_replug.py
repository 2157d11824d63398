"""Unplug and replug at random moments: is every answer that the modem saw read in the log, and every gap recorded?"""

from __future__ import annotations

import argparse
import json
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from tap_common import conditions, read_lines, show, start_tap

from aerpaw_cmp.live.log import BadLine, read_log
from aerpaw_cmp.live.simulator import Faults, ModemSimSettings, ModemSimulator


def cycles(count: int, seed: int, folder: Path) -> dict[str, object]:
    """One tap through all cycles."""
    chance = random.Random(seed)
    link, log = folder / "modem", folder / "log"
    unplugged: list[tuple[int, int]] = []
    nodes = set()
    with ModemSimulator(ModemSimSettings(link=link, faults=Faults(latency_s=0.001, jitter_s=0.01, seed=seed))) as modem:
        process = start_tap(
            link, log, ri_hz=40.0, other_hz=10.0, pause_s=0.0, reconnect_min_s=0.02, reconnect_max_s=0.1
        )
        for _ in range(count):
            seen, until = len(modem.journal), time.monotonic() + 60
            while len(modem.journal) < seen + 6:  # the tap is back: probe, set-up, first polls
                if process.poll() is not None or time.monotonic() > until:
                    raise RuntimeError(f"the tap did not come back: {process.poll()}")
                time.sleep(0.002)
            time.sleep(chance.uniform(0.0, 0.2))
            nodes.add(str(modem.node))
            gone = time.monotonic_ns()
            modem.unplug()
            time.sleep(chance.uniform(0.05, 0.3))
            unplugged.append((gone, time.monotonic_ns()))
            modem.replug()
        seen = len(modem.journal)
        while len(modem.journal) < seen + 6:
            time.sleep(0.01)
        process.send_signal(signal.SIGTERM)
        summary = json.loads(process.communicate(timeout=30)[0])
        read = read_lines(modem.journal)
    bad: list[BadLine] = []
    records = list(read_log(log, bad))
    logged = [(r["command"], tuple(r["lines"])) for r in records if r["kind"] == "exchange" and r["status"] == "ok"]
    closed = [r for r in records if r["kind"] == "gap" and r["state"] == "closed"]
    # both sides read the same monotonic clock: a gap record must cover each time without a port
    covered = 0
    for gone, back in unplugged:
        covered += any(
            r["mono_ns"] - r["duration_ns"] <= back and r["mono_ns"] >= back and r["mono_ns"] >= gone for r in closed
        )
    return {
        "cycles": count,
        "answers_read": len(read),
        "lost": len(read) - sum(answer in set(logged) for answer in read),
        "gap_records": len(closed),
        "cycles_in_a_gap_record": covered,
        "gaps_in_summary": summary["gaps"],
        "nodes_used": len(nodes),
        "bad_lines": len(bad),
    }


def main() -> None:
    """Unplug, count, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="10 cycles")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        result = cycles(10 if arguments.quick else arguments.cycles, arguments.seed, Path(folder))
    show({**result, "seconds": round(time.monotonic() - start, 1), **conditions()}, arguments.json)
    if result["lost"] or result["bad_lines"] or result["cycles_in_a_gap_record"] != result["cycles"]:
        sys.exit(1)


if __name__ == "__main__":
    main()

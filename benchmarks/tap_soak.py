"""A long session at many times the speed: does memory grow, is a poll missed?

All rates, the sync and the rotation are multiplied; the simulated modem answers at once. The modem runs in this
process, the tap in its own.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from tap_common import conditions, resident_kib, show, start_tap

from aerpaw_cmp.live.log import BadLine, read_log
from aerpaw_cmp.live.simulator import Faults, ModemSimSettings, ModemSimulator


def soak(simulated_s: float, speed: float, folder: Path) -> dict[str, object]:
    """One session; resident memory sampled over its second half."""
    link, log = folder / "modem", folder / "log"
    duration_s = simulated_s / speed
    memory: list[int] = []
    with ModemSimulator(ModemSimSettings(link=link, faults=Faults(latency_s=0.0))) as modem:
        modem.keep_journal = False
        process = start_tap(
            link,
            log,
            ri_hz=2.0 * speed,
            other_hz=speed,
            pause_s=0.0,
            duration_s=duration_s,
            show_status=True,
            status_s=1.0 / speed,
            log={"sync_interval_s": 1.0 / speed, "segment_s": 3600.0 / speed / 6, "patience_s": 0.25 / speed},
        )
        until = time.monotonic() + duration_s - 0.5
        while time.monotonic() < until and process.poll() is None:
            memory.append(resident_kib(process.pid))
            time.sleep(min(1.0, duration_s / 20))
        out, err = process.communicate(timeout=60)
    if process.returncode:
        raise RuntimeError(f"the tap ended with {process.returncode}: {err or out}")
    summary = json.loads(out)
    bad: list[BadLine] = []
    count = sum(1 for _ in read_log(log, bad))
    settled = memory[len(memory) // 5 :]  # after start-up
    third = max(1, len(settled) // 3)
    return {
        "simulated_s": simulated_s,
        "speed": speed,
        "exchanges": sum(sum(counts.values()) for counts in summary["answers"].values()),
        "not_ok": sum(n for counts in summary["answers"].values() for status, n in counts.items() if status != "ok"),
        "missed_polls": sum(summary["missed"].values()),
        "ri_rate_over_asked": round(summary["rates_hz"]["nr5g_csi"] / (2.0 * speed), 4),
        "memory_first_third_kib": round(sum(settled[:third]) / third),
        "memory_last_third_kib": round(sum(settled[-third:]) / third),
        "segments": len(list(log.iterdir())),
        "records": count,
        "bad_lines": len(bad),
    }


def main() -> None:
    """Soak, count, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--simulated-s", type=float, default=3600.0)
    parser.add_argument("--speed", type=float, default=20.0)
    parser.add_argument("--quick", action="store_true", help="200 s at the same speed")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = soak(200.0 if arguments.quick else arguments.simulated_s, arguments.speed, Path(folder))
    show({**result, **conditions()}, arguments.json)
    grown = int(result["memory_last_third_kib"]) - int(result["memory_first_third_kib"])  # type: ignore[call-overload]
    if result["missed_polls"] or result["bad_lines"] or result["not_ok"] or grown > 256:
        sys.exit(1)


if __name__ == "__main__":
    main()

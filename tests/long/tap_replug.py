"""Unplug and replug at random moments: is every byte from the kernel in a record, and is every gap recorded?

There are two checks. The first compares bytes: a copy of the bytes that the tap's port received (one file per opening) is
split into lines here, without code of the package. These are compared with the lines, unfinished lines and final results
of the records. The second compares answers: each answer that the tap read completely (it had sent its next command) must
be in the log, as often as the modem sent it. The modem sends byte by byte, so that cables are unplugged in the middle of
lines. Bytes that it sent into a cable and that were not read before the cable was unplugged are not compared. They are
counted as ``bytes_never_read``.
"""

import argparse
import json
import random
import re
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.simulated_modem import BadLine, Faults, FaultyModem, read_log
from tests.long.tap_common import conditions, read_lines, show, start_tap

FINAL = {"ok": "OK", "error": "ERROR", "cme": "+CME ERROR: ", "cms": "+CMS ERROR: "}


def lines_given(pieces: Iterable[bytes]) -> Counter[str]:
    """Return the lines of the kernel's bytes, cut at CR and LF without blank lines, for each opening of the port."""
    given: Counter[str] = Counter()
    for data in pieces:
        given.update(line for text in re.split(rb"[\r\n]+", data) if (line := text.decode("latin-1").strip(" \t")))
    return given


def lines_recorded(records: Iterable[dict[str, Any]]) -> Counter[str]:
    """Lines that the records hold: information, final results, and what was cut off."""
    lines: Counter[str] = Counter()
    for record in records:
        if record["kind"] not in ("exchange", "late", "unsolicited", "gap"):
            continue
        lines.update(record.get("lines") or ())
        if (status := record.get("status")) in FINAL:
            lines[FINAL[status] + (record.get("code") or "")] += 1
        # after a time-out the line goes on growing, and is recorded when it ends
        if record.get("status") != "timeout" and (partial := (record.get("partial") or "").strip(" \t\r\n")):
            lines[partial] += 1
    return lines


def size(lines: Counter[str]) -> int:
    """Bytes of lines."""
    return sum(len(text) * count for text, count in lines.items())


def cycles(count: int, seed: int, folder: Path, bytewise_s: float = 3e-4) -> dict[str, Any]:
    """One tap through all cycles."""
    chance = random.Random(seed)
    link, log = folder / "modem", folder / "log"
    unplugged: list[tuple[int, int]] = []
    nodes = set()
    faults = Faults(latency_s=0.001, jitter_s=0.01, bytewise_s=bytewise_s, seed=seed)
    with FaultyModem(link=link, faults=faults) as modem:
        process = start_tap(
            link, log, ri_hz=40.0, other_hz=10.0, pause_s=0.0, reconnect_min_s=0.02, reconnect_max_s=0.1,
            capture=str(folder / "given"),
        )  # fmt: skip
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
        sent_bytes = modem.sent_bytes
    bad: list[BadLine] = []
    records = list(read_log(log, bad))
    logged = Counter(
        (r["command"], tuple(r["lines"])) for r in records if r["kind"] == "exchange" and r["status"] == "ok"
    )
    pieces = [path.read_bytes() for path in sorted(folder.glob("given-*.bin"))]
    given, recorded = lines_given(pieces), lines_recorded(records)
    received = sum(len(piece) for piece in pieces)
    ends = [r["received_bytes"] for r in records if r["kind"] == "end"]
    closed = [r for r in records if r["kind"] == "gap" and r["state"] == "closed"]
    # both sides read the same monotonic clock: a gap record must cover each time without a port
    covered = 0
    for gone, back in unplugged:
        covered += any(
            r["mono_ns"] - r["duration_ns"] <= back and r["mono_ns"] >= back and r["mono_ns"] >= gone for r in closed
        )
    return {
        "cycles": count, "answers_read": len(read), "lost": (Counter(read) - logged).total(),
        "received_bytes": received, "received_bytes_by_the_tap": ends[-1] if ends else None,
        "line_bytes_given": size(given), "line_bytes_recorded": size(recorded),
        "line_bytes_in_gap_records": size(lines_recorded(r for r in records if r["kind"] == "gap")),
        "line_bytes_missing": size(given - recorded), "line_bytes_invented": size(recorded - given),
        "bytes_sent": sent_bytes, "bytes_never_read": sent_bytes - received, "gap_records": len(closed),
        "cycles_in_a_gap_record": covered,
        "gaps_in_summary": summary["gaps"], "nodes_used": len(nodes), "bad_lines": len(bad),
    }  # fmt: skip


def failed(result: dict[str, Any]) -> bool:
    """Check whether a byte, an answer or a gap is missing."""
    return bool(
        result["lost"]
        or result["bad_lines"]
        or result["cycles_in_a_gap_record"] != result["cycles"]
        or result["line_bytes_missing"]
        or result["line_bytes_invented"]
        or result["received_bytes"] != result["received_bytes_by_the_tap"]
    )


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
    if failed(result):
        sys.exit(1)


if __name__ == "__main__":
    main()

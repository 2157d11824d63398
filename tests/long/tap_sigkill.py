"""Send SIGKILL at random moments: does the log contain every answer that the tap read, and no corrupt record?

An answer counts as read once the tap sent its next command. This is stricter than to allow one second for writing. On a
very busy machine, where a write takes more than a quarter of a second, records that wait in memory at the kill are lost
(docs/tap.md). ``--patience-s 10`` distinguishes this from any other loss.
"""

import argparse
import json
import random
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from benchmarks.simulated_modem import BadLine, Faults, FaultyModem, read_log
from tests.long.tap_common import conditions, free_port, read_lines, show, start_browser, start_tap


def one_kill(number: int, seed: int, folder: Path, *, web: bool = False, patience_s: float = 0.25) -> dict[str, int]:
    """Kill one tap, and compare the records that it acknowledged with those on disk."""
    chance = random.Random(f"{seed}/{number}")
    link, log = folder / f"modem{number}", folder / f"log{number}"
    with FaultyModem(link=link, faults=Faults(latency_s=0.001, jitter_s=0.01, seed=number)) as modem:
        port = free_port() if web else None
        browser = start_browser(port) if port else None
        settings = {"segment_bytes": 20_000, "patience_s": patience_s}
        process = start_tap(link, log, ri_hz=40.0, other_hz=10.0, pause_s=0.0, log=settings, web=port)
        until = time.monotonic() + 60
        while not modem.journal:  # the moment counts from the first answer, so that each kill hits a running tap
            if process.poll() is not None or time.monotonic() > until:
                raise RuntimeError(f"the tap did not start: {process.communicate()[1]}")
            time.sleep(0.005)
        time.sleep(chance.uniform(0.0, 2.0))
        process.kill()
        process.communicate()
        shown = 0
        if browser is not None:
            browser.terminate()
            shown = json.loads(browser.communicate()[0])["rows"]
        read = read_lines(modem.journal)
    bad: list[BadLine] = []
    logged = []
    if log.exists() and any(log.iterdir()):
        for record in read_log(log, bad):
            if record["kind"] == "exchange" and record["status"] in ("ok", "error"):
                logged.append((record["command"], tuple(record["lines"])))
    elif read:
        raise RuntimeError("no log although the tap ran")
    return {
        "answers": len(read), "lost": len([answer for answer in read if answer not in set(logged)]),
        "out_of_order": int(logged[: len(read)] != read), "torn_tails": sum(line.torn_tail for line in bad),
        "corrupt": sum(not line.torn_tail for line in bad), "worst_torn": len(bad), "answers_shown": shown,
    }  # fmt: skip


def main() -> None:
    """Kill, count, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--parallel", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--web", action="store_true", help="with the page open in a browser's stead")
    parser.add_argument("--patience-s", type=float, default=0.25, help="longer: the polling waits for a slow disk")
    parser.add_argument("--quick", action="store_true", help="20 kills")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    kill = partial(one_kill, web=arguments.web, patience_s=arguments.patience_s)
    kills = 20 if arguments.quick else arguments.kills
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(arguments.parallel) as pool:
        results = list(pool.map(lambda i: kill(i, arguments.seed, Path(folder)), range(kills)))
    total = {key: sum(result[key] for result in results) for key in results[0]}
    total["worst_torn"] = max(result["worst_torn"] for result in results)
    show({"kills": kills, **total, "seconds": round(time.monotonic() - start, 1), **conditions()}, arguments.json)
    if total["lost"] or total["corrupt"] or total["out_of_order"] or total["worst_torn"] > 1:
        sys.exit(1)


if __name__ == "__main__":
    main()

"""Run the tap with its page: is the log complete, is the page up to date, and what does the server cost?

The script has three parts. *Soak* multiplies all rates of a session, with three readers of the page. One of them is
stopped (SIGSTOP) for a twelfth of the time. Before that, the tap runs without the page for a sixth of the time. *Pace*
polls the rank at 10 Hz, with and without the page and its readers. *Fuzz* sends damaged requests while the tap runs. The
modem runs in this process, and the tap and the readers in separate processes.
"""

import argparse
import json
import random
import signal
import socket
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from aerpaw_cmp.report.live import live_page
from benchmarks.simulated_modem import BadLine, Faults, FaultyModem, read_log
from tests.long.tap_common import (
    CSI,
    conditions,
    cpu_s,
    damaged,
    free_port,
    resident_kib,
    show,
    start_browser,
    start_tap,
)


def log_against_modem(log: Path, modem: FaultyModem) -> dict[str, int]:
    """Compare the answers that the modem saw read with the log: lost, out of order, and lines that are not records."""
    bad: list[BadLine] = []
    logged = [tuple(r["lines"]) for r in read_log(log, bad) if r["kind"] == "exchange" and r["query"] == "nr5g_csi"]
    read = [served.lines for served in modem.journal if served.read and served.command == CSI]
    return {
        "answers": len(read),
        "lost": len(set(read) - set(logged)),
        "out_of_order": int(logged[: len(read)] != read),
        "bad_lines": len(bad),
    }


def soak(simulated_s: float, speed: float, folder: Path, *, web: bool) -> dict[str, Any]:
    """One session at many times the speed."""
    name = "web" if web else "alone"
    link, log, port, duration_s = folder / f"modem-{name}", folder / name, free_port(), simulated_s / speed
    browsers = [start_browser(port) for _ in range(3)] if web else []
    memory: list[int] = []
    with FaultyModem(link=link, faults=Faults(latency_s=0.0)) as modem:
        process = start_tap(
            link, log, ri_hz=2.0 * speed, other_hz=speed, pause_s=0.0, duration_s=duration_s, status_s=1.0 / speed,
            log={"sync_interval_s": 1.0 / speed, "segment_s": 3600.0 / speed / 6}, web=port if web else None,
        )  # fmt: skip
        start = time.monotonic()
        while process.poll() is None and time.monotonic() < start + duration_s - 0.5:
            elapsed = (time.monotonic() - start) / duration_s
            if browsers:
                browsers[2].send_signal(signal.SIGSTOP if 0.4 < elapsed < 0.4 + 1 / 12 else signal.SIGCONT)
            if elapsed > 0.2:
                memory.append(resident_kib(process.pid))
            time.sleep(min(1.0, duration_s / 40))
        out, err = process.communicate(timeout=120)
        if process.returncode:
            raise RuntimeError(f"the tap ended with {process.returncode}: {err or out}")
        summary, third = json.loads(out), max(1, len(memory) // 3)
        for browser in browsers:
            browser.send_signal(signal.SIGCONT)
            browser.terminate()
        seen = [json.loads(browser.communicate()[0]) for browser in browsers]
        result = log_against_modem(log, modem)
    return result | {
        "missed_polls": sum(summary["missed"].values()),
        "memory_grown_kib": round((sum(memory[-third:]) - sum(memory[:third])) / third),
        "memory_kib": max(memory, default=0),
        **({"rows_shown": [s["rows"] for s in seen], "holes": sum(s["holes"] for s in seen)} if web else {}),
    }


def pace(seconds: float, folder: Path, *, web: bool) -> dict[str, Any]:
    """Processor time at 10 Hz, and the time from an answer to its reader."""
    name = "paced-web" if web else "paced"
    link, port = folder / f"modem-{name}", free_port()
    browsers = [start_browser(port) for _ in range(3)] if web else []
    with FaultyModem(link=link, faults=Faults(latency_s=0.02)) as modem:
        process = start_tap(link, folder / name, ri_hz=10.0, duration_s=seconds + 60, web=port if web else None)
        while len(modem.journal) < 20:
            time.sleep(0.05)
        time.sleep(1.0)
        start, before = time.monotonic(), cpu_s(process.pid)
        time.sleep(seconds)
        share = (cpu_s(process.pid) - before) / (time.monotonic() - start)
        process.terminate()  # SIGINT is ignored where a shell started this in the background
        process.communicate(timeout=120)
    for browser in browsers:
        browser.terminate()
    seen = [json.loads(browser.communicate()[0]) for browser in browsers]
    delays = {key: round(max(s[f"{key}_s"] for s in seen), 3) for key in ("median", "p99")} if seen else {}
    return {"cpu_percent": round(100 * share, 2), **delays}


def fuzz(requests: int, folder: Path) -> dict[str, Any]:
    """Damaged requests while the tap runs: what is answered, and does the process grow."""
    link, log, port, chance = folder / "modem-fuzz", folder / "fuzz", free_port(), random.Random(1)
    page, answers = live_page(None, "benchmark")[0], Counter[str]()
    others, memory = 0, 0
    with FaultyModem(link=link, faults=Faults(latency_s=0.01)) as modem:
        process = start_tap(link, log, ri_hz=10.0, web=port)
        while len(modem.journal) < 20:
            time.sleep(0.05)
        for number in range(requests):
            if number == requests // 5:
                memory = resident_kib(process.pid)
            data = b""
            try:
                with socket.create_connection(("127.0.0.1", port), 10) as connection:
                    connection.settimeout(0.5)
                    connection.sendall(damaged(chance))
                    connection.shutdown(socket.SHUT_WR)
                    while b"retry: 1000" not in data and (got := connection.recv(65_536)):
                        data += got
            except OSError:
                answers["cut"] += 1
            head, _, body = data.partition(b"\r\n\r\n")
            answers[head[9:12].decode() if head.startswith(b"HTTP/") else "no head"] += 1
            others += not (body in (b"", page) or body.startswith(b"retry: 1000") or len(body) < 100)
        grown = resident_kib(process.pid) - memory
        alive = process.poll() is None
        process.terminate()  # SIGINT is ignored where a shell started this in the background
        process.communicate(timeout=120)
        result = log_against_modem(log, modem)
    return {"requests": requests, "answers_by_status": dict(answers), "other_content": others, "alive": alive,
            "fuzz_memory_grown_kib": grown, "fuzz_lost": result["lost"]}  # fmt: skip


def main() -> None:
    """Soak, pace, fuzz, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--simulated-s", type=float, default=7200.0)
    parser.add_argument("--speed", type=float, default=20.0)
    parser.add_argument("--pace-s", type=float, default=60.0)
    parser.add_argument("--requests", type=int, default=10_000)
    parser.add_argument("--quick", action="store_true", help="200 s at the same speed, 5 s, 200 requests")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    simulated_s, pace_s, requests = arguments.simulated_s, arguments.pace_s, arguments.requests
    if arguments.quick:
        simulated_s, pace_s, requests = 200.0, 5.0, 200
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        result: dict[str, Any] = {"simulated_s": simulated_s, "speed": arguments.speed}
        for arm, part in (("alone", max(60.0, simulated_s / 6)), ("web", simulated_s)):
            outcome = soak(part, arguments.speed, folder, web=arm == "web")
            result |= {f"{arm}_{key}": value for key, value in outcome.items()}
        for arm in ("alone", "web"):
            result |= {f"10hz_{arm}_{key}": value for key, value in pace(pace_s, folder, web=arm == "web").items()}
        result |= fuzz(requests, folder)
    show({**result, **conditions()}, arguments.json)
    faults = ("web_lost", "web_out_of_order", "web_bad_lines", "web_holes", "other_content", "fuzz_lost")
    server_percent = result["10hz_web_cpu_percent"] - result["10hz_alone_cpu_percent"]
    slow = result["10hz_web_p99"] >= 1.0 or server_percent >= 5.0
    grown = result["web_memory_grown_kib"] > 512 or result["fuzz_memory_grown_kib"] > 1024
    if any(result[key] for key in faults) or not result["alive"] or slow or grown:
        sys.exit(1)


if __name__ == "__main__":
    main()

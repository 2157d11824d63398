"""Press Ctrl-C in every command: measure the time until it ends, how it ends, and what it leaves.

    python -m tests.long.interrupts [--only TEXT] [--moments 7] [--json]

Each command first runs to its end on a large input, to measure its processor time. Then it runs once for each moment,
which is a share of that time. At this moment its process group gets SIGINT, as from a terminal. (The tap and its modem
are interrupted by the clock.)

A command must end with exit code 130, a message without a traceback, and at most one second of processor time after the
signal. It must leave no hidden file, no incomplete output and no process. The clock time is shown, too, but on a busy
machine it depends mostly on other processes.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from aerpaw_cmp.common.outputs import changed_files, read_sums

SAMPLE = Path(__file__).resolve().parents[2] / "sample_logs"
MOST_S = 1.0
# These wait for the modem or for whoever opens it, and end in order: seconds of the clock in which they are stopped.
LIVE, LIVE_S = ("tap", "modem-sim"), 8.0
TICKS = os.sysconf("SC_CLK_TCK")

# Words of each command; {0} is the folder of the inputs, "out" the output in the working folder.
CASES = {
    "formats": "formats --json",
    "sample": "sample -o out",
    "doctor": "doctor",
    "bench": "bench --quick",
    "ingest": "ingest {0}/large --timezone America/New_York -o out.h5",
    "ingest --draft": "ingest {0}/sample --timezone America/New_York --draft out.yaml",
    "report": "report {0}/sample/flight.yaml -o out",
    "report, audit full": "report {0}/sample/flight.yaml -o out --audit full",
    "report, all figures": "report {0}/sample/flight.yaml -o out --audit none --figures all --kmz",
    "campaign": "campaign {0}/sample/campaign.yaml -o out --fresh --workers 2",
    "explain": "explain {0}/sample/flight.yaml --time 20 --tower LW1",
    "diff": "diff {0}/a {0}/b",
    "calibrate": "calibrate {0}/sample/calibration.yaml -o out.yaml",
    "predict": "predict lake_wheeler --height 40 --spacing 10 -o out",
    "plan": "plan sphere --site lake_wheeler --tower LW1 --geofence {0}/fence.kml --minutes 12 -o out",
    "plan, hostile fence": "plan sphere --site lake_wheeler --tower LW1 --geofence {0}/hostile.kml --minutes 12 -o out",
    "map": "map lake_wheeler --spacing 20 -o out",
    "map, engine": "map lake_wheeler --quick -o out",
    "simulate": "simulate {0}/sample/flight.yaml -o out",
    "site import": "site import {0}/large.osm -o out.yaml",
    "site show": "site show lake_wheeler -o out --export",
    "site export": "site export lake_wheeler -o out",
    "modem-sim": "modem-sim --link modem --flight {0}/sample/flight.yaml --telemetry track.txt",
    "tap": "tap {0}/modem -o taplog --web 127.0.0.1:0",
}


def fence(corners: int, spread: float) -> str:
    """Return a geofence at LW1. With a spread, it crosses itself at almost every corner."""
    chance = random.Random(1)
    at = ((35.7275 + spread * chance.random(), -78.696 + spread * chance.random()) for _ in range(corners))
    places = " ".join(f"{east:.7f},{north:.7f},0" for north, east in at)
    ring = f"<LinearRing><coordinates>{places}</coordinates></LinearRing>"
    return f"<kml><Placemark><Polygon><outerBoundaryIs>{ring}</outerBoundaryIs></Polygon></Placemark></kml>"


def houses(count: int) -> str:
    """A map of many houses."""
    nodes, ways = [], []
    for k in range(count):
        north, east = 35.72 + 2e-4 * (k // 200), -78.70 + 2e-4 * (k % 200)
        corners = ((0, 0), (0, 1e-4), (1e-4, 1e-4), (1e-4, 0))
        nodes += [
            f'<node id="{4 * k + i}" lat="{north + a:.7f}" lon="{east + b:.7f}"/>' for i, (a, b) in enumerate(corners)
        ]
        refs = "".join(f'<nd ref="{4 * k + i}"/>' for i in (0, 1, 2, 3, 0))
        ways.append(f'<way id="{k}">{refs}<tag k="building" v="yes"/></way>')
    return f'<osm version="0.6">{"".join(nodes)}{"".join(ways)}</osm>'


def furnish(root: Path) -> None:
    """Inputs of all commands."""
    shutil.copytree(SAMPLE, root / "sample")
    (root / "sample/campaign.yaml").write_text(
        "campaign: c\nflights: [flight.yaml]\nsettings: {a: {}, b: {rt.max_depth: 1}}\n"
    )
    (root / "sample/calibration.yaml").write_text("calibration: c\nflights: [flight.yaml]\n")
    (root / "large").mkdir()
    for log in (*SAMPLE.glob("*/*_vehicleOut.txt"), *SAMPLE.glob("LW1/*power_log.txt")):
        (root / "large" / log.name).write_bytes(log.read_bytes() * 60)
    (root / "fence.kml").write_text(fence(5, 0.002))
    (root / "hostile.kml").write_text(fence(30_000, 0.01))
    (root / "large.osm").write_text(houses(6000))


def line(words: str, root: Path) -> list[str]:
    return [sys.executable, "-m", "aerpaw_cmp", *words.format(root).split()]


@contextmanager
def modem(root: Path) -> Iterator[None]:
    """The modem that the tap reads."""
    process = subprocess.Popen(
        line("modem-sim --link {0}/modem", root), stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    )
    while not (root / "modem").exists() and process.poll() is None:
        time.sleep(0.05)
    try:
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.wait()


def used_s(pid: int, *, children: bool = True) -> float:
    """Processor time of a process, and of its children that ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return sum(map(int, fields[11 : 15 if children else 13])) / TICKS


def group(number: int) -> list[int]:
    """Processes of a group."""
    members = []
    for place in Path("/proc").iterdir():
        with suppress(OSError, ValueError):
            zombie = (place / "stat").read_text().rpartition(") ")[2].startswith("Z")  # waits for its parent to look
            if os.getpgid(int(place.name)) == number and not zombie:
                members.append(int(place.name))
    return members


def left_behind(folder: Path) -> list[str]:
    """Return the files that an interrupted command must not leave."""
    names = [str(place.relative_to(folder)) for place in folder.rglob("*")]
    hidden = [name for name in names if "/." in f"/{name}"]
    torn = changed_files(folder / "out") if (folder / "out").is_dir() else []
    loose = ["out without SHA256SUMS"] if (folder / "out").is_dir() and read_sums(folder / "out") is None else []
    return hidden + torn + loose


def one_run(words: str, root: Path, after_s: float | None) -> dict[str, Any]:
    """Interrupt a command once it has used a given processor time."""
    live = words.startswith(LIVE)
    with tempfile.TemporaryDirectory() as home:
        folder = Path(home)
        process = subprocess.Popen(
            line(words, root), cwd=folder, start_new_session=True, text=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a job in the background ignores it
        )  # fmt: skip
        used, own, begun, sent_at, at_signal, own_then = 0.0, 0.0, time.monotonic(), None, 0.0, 0.0
        while process.poll() is None:
            used, own = used_s(process.pid) or used, used_s(process.pid, children=False) or own
            spent = time.monotonic() - begun if live else used
            if sent_at is None and after_s is not None and spent >= after_s:
                at_signal, own_then, sent_at = used, own, time.monotonic()
                os.killpg(process.pid, signal.SIGINT)
            time.sleep(0.004)
        ended = time.monotonic()
        assert process.stderr is not None
        said = process.stderr.read()
        row: dict[str, Any] = {"code": process.returncode, "cpu_s": used}
        if sent_at is None:
            return row | ({"said": said[-500:]} if process.returncode else {})
        faults = (
            []
            if process.returncode in ((0, 130) if live else (130,))
            else [f"exit code {process.returncode}: {said[-300:]}"]
        )
        faults += [said[-1500:]] if "Traceback" in said or "Exception ignored" in said else []
        faults += [f"{len(others)} processes stay" for others in [group(process.pid)] if others]
        faults += [f"left {name}" for name in left_behind(folder)]
        after = own - own_then  # a worker's whole time is added where it is reaped
        faults += [f"{after:.2f} s of the processor after the signal"] if after > MOST_S else []
        return row | {
            "at_s": round(at_signal, 2),
            "after_cpu_s": round(after, 2),
            "after_s": round(ended - sent_at, 2),
            "faults": faults,
        }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="commands whose name contains this")
    parser.add_argument("--moments", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as home:
        root = Path(home)
        furnish(root)
        os.environ["AERPAW_CMP_CACHE"] = str(root / "cache")
        for name, words in ((name, words) for name, words in CASES.items() if given.only in name):
            if name == "diff":
                for out in "ab":
                    subprocess.run(
                        line(f"report {{0}}/sample/flight.yaml -q --audit none -o {{0}}/{out}", root),
                        check=True,
                        stdout=subprocess.DEVNULL,
                    )
            with modem(root) if name == "tap" else nullcontext():
                plain = {"code": 0, "cpu_s": LIVE_S} if words.startswith(LIVE) else one_run(words, root, None)
                if plain["code"]:
                    print(f"{name}: exit code {plain['code']}: {plain.get('said')}", file=sys.stderr)
                moments = [(k + 0.5) / given.moments * plain["cpu_s"] for k in range(given.moments)]
                runs = [one_run(words, root, max(0.15, moment)) for moment in moments]
            runs = [run for run in runs if "faults" in run]
            rows.append({"command": name, "cpu_s": plain["cpu_s"], "runs": runs, "code": plain["code"]})
            worst = [max((run[key] for run in runs), default=0.0) for key in ("after_cpu_s", "after_s")]
            if not given.json:
                print(
                    f"{name:20} {plain['cpu_s']:6.1f} s, {len(runs)} interrupts; to the end at most {worst[0]:.2f} s "
                    f"of the processor, {worst[1]:.2f} s by the clock",
                    *(f"    at {run['at_s']} s: {fault}" for run in runs for fault in run["faults"]),
                    sep="\n",
                    flush=True,
                )
    faults = sum(len(run["faults"]) for row in rows for run in row["runs"])
    print(json.dumps(rows) if given.json else f"{sum(len(row['runs']) for row in rows)} interrupts, {faults} faults")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())

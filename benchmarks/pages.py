"""Measure size and loading time of pages: report (sample, 50 000 samples), map (paper's grid), large campaign.

Each page is opened in headless Chromium from the disk, cold. "usable" is the time from the start of the navigation to
the second frame after the page's script is done; "main thread" is the processor time of the page's main thread, which
does not grow with what else the machine does. Limits: report 4 MB (sample) and 8 MB (50 000 samples), map 8 MB,
campaign 5 MB, all below 2 s.

    python benchmarks/pages.py [--only report,long,map,campaign] [--map PAGE] [--flights 200] [--settings 20]
                               [--repeats 3] [--json]

``map`` makes the paper's map without its study (minutes), or opens the page given by ``--map``.
"""

import argparse
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml

ROOT = Path(__file__).parents[1]
MB = 1e6
LIMIT_MB = {"report": 4.0, "long": 8.0, "map": 8.0, "campaign": 5.0}
LIMIT_S = 2.0
READY = {
    "report.html": "window.explorer",
    "map.html": "window.mapExplorer && mapExplorer.ready",
    "campaign.html": "document.readyState === 'complete'",
}


def command(*arguments: str) -> None:
    """One command of the tool, as a user gives it."""
    path = f"{ROOT}{os.pathsep}{ROOT / 'parsers'}"
    done = subprocess.run(
        [sys.executable, "-m", "aerpaw_cmp", *arguments], capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments)}\n{done.stderr}")


# --- the pages ------------------------------------------------------------------------------------------------------


def report_page(folder: Path) -> Path:
    """Return the page of the sample flight, without audit and speed table."""
    content = yaml.safe_load((ROOT / "sample_logs" / "flight.yaml").read_text())
    content["rt"] = {**content.get("rt", {}), "audit_links": 0}
    shutil.copytree(ROOT / "sample_logs", folder / "sample")
    (folder / "sample" / "flight.yaml").write_text(yaml.safe_dump(content))
    command("report", str(folder / "sample" / "flight.yaml"), "-o", str(folder / "report"))
    return folder / "report" / "report.html"


def long_page(folder: Path, samples: int = 50_000) -> Path:
    """Return the page of a simulated flight with ten channels and this total number of samples."""
    from aerpaw_cmp.report import flight as write
    from benchmarks.fabricated import long_flight

    return write.write_report(long_flight(samples), folder / "long")[0][0]


def map_page(folder: Path) -> Path:
    """The paper's grid, five towers, ten heights, three K, three foliage modes."""
    command("map", "lake_wheeler", "--no-study", "-o", str(folder / "map"))
    return folder / "map" / "map.html"


def campaign_page(folder: Path, flights: int, settings: int) -> tuple[Path, dict[str, Any]]:
    """Return the page of a simulated campaign."""
    from aerpaw_cmp.report.campaign import write_campaign
    from benchmarks.fabricated import season

    data = season(flights, settings)
    (folder / "campaign").mkdir()
    begin = time.process_time()
    page = write_campaign(data, folder / "campaign")[0]
    return page, {"rows": len(data.rss), "write_cpu_s": time.process_time() - begin}


# --- the browser ------------------------------------------------------------------------------------------------------


def opened(page: Path, repeats: int) -> dict[str, float]:
    """Medians of the seconds until the page is usable, and of the main thread's processor time."""
    sys.path.insert(0, str(ROOT))
    from tests.report.browsing import BROWSER, DRIVER, complaints, start

    if not (BROWSER and DRIVER):
        raise SystemExit("no chromium with chromedriver on this machine: pages cannot be opened")
    ready, wall, thread = READY[page.name], [], []
    for _ in range(repeats):
        driver = start("--window-size=1440,1200")
        try:
            driver.get("about:blank")
            driver.execute_cdp_cmd("Performance.enable", {"timeDomain": "threadTicks"})
            driver.get(page.resolve().as_uri())
            usable = driver.execute_async_script(
                f"const done = arguments[0]; const wait = () => ({ready}) ? requestAnimationFrame(() => "
                "requestAnimationFrame(() => done(performance.now()))) : setTimeout(wait, 5); wait()"
            )
            measures = {m["name"]: m["value"] for m in driver.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]}
            said = complaints(driver)
        finally:
            driver.quit()
        if said:
            raise SystemExit(f"{page}: {said}")
        wall.append(usable / 1000)
        thread.append(measures["TaskDuration"])
    return {"usable_s": statistics.median(wall), "main_thread_s": statistics.median(thread)}


def main() -> None:
    """Make the pages, open them, and print the table. The exit code is 1 if a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="report,long,map,campaign")
    parser.add_argument("--map", type=Path, help="a map.html that was made before")
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--settings", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    sys.path[:0] = [str(ROOT), str(ROOT / "parsers")]
    rows: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind in arguments.only.split(","):
            more: dict[str, Any] = {}
            place = folder / f"{kind}_of"
            place.mkdir()
            if kind == "campaign":
                page, more = campaign_page(place, arguments.flights, arguments.settings)
            elif kind == "map" and arguments.map:
                page = arguments.map
            else:
                make = {"report": report_page, "long": long_page, "map": map_page}[kind]
                page = make(place)
            rows[kind] = {"mb": page.stat().st_size / MB, **opened(page, arguments.repeats), **more}
            rows[kind]["ok"] = rows[kind]["mb"] <= LIMIT_MB[kind] and rows[kind]["usable_s"] < LIMIT_S
    result = {
        "machine": {"cpus": os.cpu_count(), "load": os.getloadavg()[0], "python": platform.python_version()},
        "numpy": np.__version__, "campaign": [arguments.flights, arguments.settings], "pages": rows,
    }  # fmt: skip
    if arguments.json:
        print(json.dumps(result, indent=1))
    else:
        print(f"{result['machine']}; campaign of {arguments.flights} flights and {arguments.settings} settings")
        print(f"{'page':10} {'MB':>7} {'limit':>6} {'usable s':>9} {'main thread s':>14}  ok")
        for kind, row in rows.items():
            seconds = f"{row['usable_s']:9.2f} {row['main_thread_s']:14.2f}"
            print(f"{kind:10} {row['mb']:7.2f} {LIMIT_MB[kind]:6.1f} {seconds}  {row['ok']}")
            print("".join(f"           {k}: {v:.6g}\n" for k, v in row.items() if k in ("rows", "write_cpu_s")), end="")
    if not all(row["ok"] for row in rows.values()):
        raise SystemExit(1)


if __name__ == "__main__":
    main()

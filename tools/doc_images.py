"""Remake the pictures of ``docs/images``: the sample's figures, the tutorial's page, the tap.

python tools/doc_images.py [sample] [tutorial] [tap]     (some 20 minutes for all)

Figures of the gallery are drawn when the documentation is built; that of docs/performance.md by ``make bench-all``.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
FIGURES = ("trajectory", "rss_LW4_USRP1", "rank_histogram_LW1")


def run(*words: object) -> None:
    """Run a command line of this Python in the project's folder; a failure ends the script."""
    subprocess.run([sys.executable, *map(str, words)], cwd=ROOT, check=True)


def of_the_report() -> None:
    """Figures of the sample's report."""
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "report"
        run("-m", "aerpaw_cmp", "report", "sample_logs/flight.yaml", "-o", out, "--audit", "none", "--figures", "png")
        for name in FIGURES:
            shutil.copy(out / "figures" / f"{name}.png", IMAGES / f"sample_{name}.png")


def of_the_tutorial() -> None:
    """The first screen of the report that docs/tutorial.md makes in its fourth step."""
    with tempfile.TemporaryDirectory() as place:
        logs, draft = Path(place) / "try_it", Path(place) / "try_it" / "draft.yaml"
        run("-m", "aerpaw_cmp", "sample", "-o", logs)
        run("-m", "aerpaw_cmp", "ingest", logs, "--timezone", "America/New_York", "--draft", draft, "--quiet")
        draft.write_text(draft.read_text().replace("field: power", "field: coherent"))
        run("-m", "aerpaw_cmp", "report", draft, "-o", logs / "report", "--audit", "none")
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1440,900"]
        words = ["chromium", *flags, f"--user-data-dir={place}/profile"]
        page = (logs / "report" / "report.html").as_uri()
        subprocess.run([*words, f"--screenshot={IMAGES}/tutorial_report.png", page], check=True, capture_output=True)


def main(names: list[str]) -> None:
    """Remake the named parts, or all."""
    parts = {
        "sample": of_the_report,
        "tutorial": of_the_tutorial,
        "tap": lambda: run("tools/tap_picture.py", IMAGES / "tap_live.png", IMAGES / "tap_live_phone.png"),
    }
    if unknown := set(names) - set(parts):
        raise SystemExit(f"unknown: {', '.join(sorted(unknown))}; expected {', '.join(parts)}")
    for name in names or parts:
        parts[name]()


if __name__ == "__main__":
    main(sys.argv[1:])

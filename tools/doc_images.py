"""Make the pictures in ``docs/images`` of the tutorial's report and of the tap's page.

python tools/doc_images.py [tutorial] [tap]

Figures of the gallery are drawn when the documentation is built, and ``make bench-all`` draws docs/performance.md's.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"


def run(*words: object) -> None:
    """Run a command line with this Python in the project's folder. A failure ends the script."""
    subprocess.run([sys.executable, *map(str, words)], cwd=ROOT, check=True)


def of_the_tutorial() -> None:
    """Take a picture of the first screen of the report of docs/tutorial.md, step 4."""
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
    """Make the named pictures, or all pictures."""
    parts = {
        "tutorial": of_the_tutorial,
        "tap": lambda: run("tools/tap_picture.py", IMAGES / "tap_live.png", IMAGES / "tap_live_phone.png"),
    }
    if unknown := set(names) - set(parts):
        raise SystemExit(f"unknown: {', '.join(sorted(unknown))}; expected {', '.join(parts)}")
    for name in names or parts:
        parts[name]()


if __name__ == "__main__":
    main(sys.argv[1:])

"""Chromium with its driver for the tests of the pages: install them, else print the line that does.

Run by ``make test`` where they are missing. Never a failure: without them those tests skip, and the run says so.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.setup_llvm import apt, say

PACKAGES = ("chromium", "chromium-driver")  # Debian's; Ubuntu has them as snaps alone
LINE = "sudo apt-get update && sudo apt-get install -y " + " ".join(PACKAGES)


def main() -> None:
    """Install, or explain."""
    apt_get = apt(say)
    if apt_get is not None:
        apt_get("update", "-qq")
        if apt_get("install", "-y", "-qq", "--no-install-recommends", *PACKAGES):
            return
    say(f"No Chromium with chromedriver: the tests of the pages skip. On Debian: {LINE}")
    say("    Elsewhere: Chromium or Chrome, and the chromedriver of the same version, on the PATH")


if __name__ == "__main__":
    main()

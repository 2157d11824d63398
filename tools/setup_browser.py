"""Install Chromium and its driver for the tests of the pages, or print the command that installs them.

``make test`` runs it if they are missing. It never fails: without a browser these tests are skipped and reported.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.setup_llvm import apt, say

PACKAGES = ("chromium", "chromium-driver")  # names in Debian; Ubuntu has them as snaps only
LINE = "sudo apt-get update && sudo apt-get install -y " + " ".join(PACKAGES)


def main() -> None:
    """Install the packages, or print how to install them."""
    apt_get = apt(say)
    if apt_get is not None:
        apt_get("update", "-qq")
        if apt_get("install", "-y", "-qq", "--no-install-recommends", *PACKAGES):
            return
    say(f"No Chromium with chromedriver: the tests of the pages are skipped. On Debian: {LINE}")
    say("    On other systems: Chromium or Chrome and the chromedriver of the same version, in folders of PATH")


if __name__ == "__main__":
    main()

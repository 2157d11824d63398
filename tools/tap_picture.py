"""Take pictures of the tap's page in headless Chromium while tap and modem-sim run for some minutes.

python tools/tap_picture.py docs/images/tap_live.png docs/images/tap_live_phone.png --seconds 200
"""

from __future__ import annotations

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

FLIGHT = Path(__file__).resolve().parents[1] / "sample_logs" / "flight.yaml"


def command(*arguments: object) -> subprocess.Popen[str]:
    """Start a command of this program."""
    words = [sys.executable, "-m", "aerpaw_cmp", *map(str, arguments)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def pictures(url: str, wide: Path, phone: Path, seconds: float) -> None:
    """Take pictures of the page: dark theme on a laptop, theme for sunlight on a phone."""
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    options = ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"):
        options.add_argument(argument)
    driver = Chrome(options=options, service=Service(shutil.which("chromedriver")))
    try:
        driver.get(url)
        driver.execute_script(
            "const w = document.getElementById('window'); w.value = '0'; w.dispatchEvent(new Event('change'))"
        )
        time.sleep(seconds)
        for theme, path, width, height in (("dark", wide, 1440, 900), ("sun", phone, 390, 844)):
            if driver.execute_script("return document.documentElement.dataset.theme") != theme:
                driver.execute_script("document.getElementById('theme').click()")
            size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
            driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            time.sleep(1.5)
            driver.save_screenshot(str(path))
    finally:
        driver.quit()


def main() -> None:
    """Start simulator and tap, and take the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("wide", type=Path)
    parser.add_argument("phone", type=Path)
    parser.add_argument("--seconds", type=float, default=200.0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        port, telemetry = folder / "modem", folder / "vehicleOut.txt"
        sim = command("modem-sim", "--link", port, "--flight", FLIGHT, "--telemetry", telemetry)
        tap = None
        try:
            assert sim.stdout is not None
            sim.stdout.readline()
            flown = ("--flight", FLIGHT, "--telemetry", telemetry)
            tap = command("tap", port, "-o", folder / "taplog", *flown, "--web", "127.0.0.1:0", "--no-status")
            assert tap.stderr is not None
            line = tap.stderr.readline()
            while "the page: " not in line:
                if not line:
                    raise SystemExit(f"the tap did not start: {tap.communicate()[0]}")
                line = tap.stderr.readline()
            pictures(line.split()[2], arguments.wide, arguments.phone, arguments.seconds)
        finally:
            for process in (tap, sim):
                if process is not None:
                    process.send_signal(signal.SIGINT)
                    process.communicate(timeout=20)


if __name__ == "__main__":
    main()

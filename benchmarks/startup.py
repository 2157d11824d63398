"""How light is ``aerpaw-cmp --help``? Ratio of its time to that of ``python -c pass``, and what it loads.

Runs both in turn and compares their medians, so that a busy machine slows both alike.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = {
    "python -c pass": ["-c", "pass"],
    "import aerpaw_cmp": ["-c", "import aerpaw_cmp"],
    "aerpaw-cmp --help": ["-m", "aerpaw_cmp", "--help"],
}


def median_seconds(rounds: int) -> dict[str, float]:
    """Median wall time of each command [s], the commands run in turn."""
    seconds: dict[str, list[float]] = {name: [] for name in COMMANDS}
    for _ in range(rounds + 1):  # the first round fills the file cache
        for name, arguments in COMMANDS.items():
            start = time.perf_counter()
            subprocess.run([sys.executable, *arguments], cwd=ROOT, stdout=subprocess.DEVNULL, check=True)
            seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(times[1:]) for name, times in seconds.items()}


def own_modules(arguments: list[str]) -> list[str]:
    """Modules that a command imports beyond those of ``python -c pass``."""

    def imported(command: list[str]) -> set[str]:
        environ = {**os.environ, "PYTHONPROFILEIMPORTTIME": "1"}
        done = subprocess.run(
            [sys.executable, *command], cwd=ROOT, env=environ, capture_output=True, text=True, check=True
        )
        return {line.rpartition("|")[2].strip() for line in done.stderr.splitlines() if line.startswith("import time")}

    return sorted(imported(arguments) - imported(["-c", "pass"]))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="5 rounds instead of 40")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rounds = 5 if options.quick else 40
    seconds = median_seconds(rounds)
    base = seconds["python -c pass"]
    result = {
        "conditions": f"Python {platform.python_version()}, {platform.machine()}, median of {rounds} runs in turn",
        "seconds": seconds,
        "ratios": {name: value / base for name, value in seconds.items()},
        "modules_of_help": own_modules(COMMANDS["aerpaw-cmp --help"]),
    }
    if options.json:
        print(json.dumps(result))
        return 0
    print(result["conditions"])
    for name, value in seconds.items():
        print(f"{name:<20} {1e3 * value:7.1f} ms   {value / base:5.2f} x python -c pass")
    print(f"--help imports {len(result['modules_of_help'])} modules: {', '.join(result['modules_of_help'])}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Commands that a user waits for, as processes: processor seconds and peak memory of a repeated run.

Each command runs once before, so that every cache is filled. Then it runs in turns with ``import sionna.rt,
matplotlib.pyplot, pandas``. Machines differ in speed, and the speed of one machine changes by a fifth within minutes,
so the ratio of the two medians decides. Commands on real logs need AERPAW_CMP_FIELD_DATA.

    python benchmarks/waits.py [--only NAME] [--json]
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.report import IMPORTS, ROOT, run

FIELD = os.environ.get("AERPAW_CMP_FIELD_DATA", "")
REAL = ["--logs-root", FIELD]
# The imports where the seconds below were asked for: the report of dataset 12 took 5.1 s there, 3.2 times the imports.
ASKED_IMPORTS_S = 5.1 / 3.2
# Of each: seconds before the work began, seconds asked for, the command, and whether it needs the field's logs.
COMMANDS: dict[str, tuple[float, float, list[str], bool]] = {
    "report of dataset 12": (5.1, 3.2, ["report", str(ROOT / "tests/field/dataset12_40m.yaml"), *REAL], True),
    "report of the sample": (10.3, 6.0, ["report", f"{ROOT}/sample_logs/flight.yaml"], False),
    "map lake_wheeler": (60.0, 28.0, ["map", "lake_wheeler"], False),
    "calibrate three flights": (
        15.0,
        8.0,
        ["calibrate", f"{ROOT}/tests/field/calibrations/dataset12.yaml", *REAL],
        True,
    ),
    "predict a route of 30 minutes": (6.6, 3.5, ["predict", "{folder}/route.csv", "--site", "lake_wheeler"], False),
}


def main() -> None:
    """Measure them all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=sorted(COMMANDS))
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        turn = np.linspace(0.0, 20.0 * np.pi, 1800)
        places = np.column_stack([35.7275 + 0.003 * np.cos(turn / 7), -78.6961 + 0.003 * np.sin(turn), 0.0 * turn + 40])
        np.savetxt(f"{folder}/route.csv", places, "%.7f", ",", header="lat,lon,alt", comments="")
        for name, (before_s, asked_s, command, real) in COMMANDS.items():
            if (arguments.only and name != arguments.only) or (real and not FIELD):
                continue
            text = [sys.executable, "-m", "aerpaw_cmp", *(part.format(folder=folder) for part in command)]
            text += ["-o", f"{folder}/out.yaml" if command[0] == "calibrate" else f"{folder}/{command[0]}", "--force"]
            runs = []
            # The map has 51 figures, nothing that a first run keeps, and is long enough to be measured by one.
            for _ in range(1 if command[0] == "map" else 4):
                imports = run([sys.executable, "-c", IMPORTS])
                runs.append({"imports_s": imports["cpu_s"], **run(text)})
            medians = {key: statistics.median(row[key] for row in runs[-3:]) for key in runs[0]}
            rows.append({"command": name, "before_s": before_s, "asked_s": asked_s, **medians})
    if arguments.json:
        print(json.dumps({"rows": rows}))
        return
    for row in rows:
        print(f"{row['command']}: {row['cpu_s']:.1f} s of processor (asked for {row['asked_s']:g}), "
              f"{row['cpu_s'] / row['imports_s']:.2f} x the imports of {row['imports_s']:.2f} s (asked for "
              f"{row['asked_s'] / ASKED_IMPORTS_S:.2f}), {row['peak_mib']:.0f} MiB")  # fmt: skip


if __name__ == "__main__":
    main()

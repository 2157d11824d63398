"""What the benchmarks of the tap share: a tap in its own process on a simulated modem."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "parsers")]

CSI = 'AT+QNWCFG="nr5g_csi"'

CHILD = """
import json, sys
from pathlib import Path
from aerpaw_cmp.common.errors import AerpawCmpError
from aerpaw_cmp.live.log import LogSettings
from aerpaw_cmp.live.tap import TapSettings, run_tap
values = json.loads(sys.argv[1])
log = LogSettings(**values.pop("log", {}))
show = values.pop("show_status", False)
if capture := values.pop("capture", None):  # a copy of what the kernel gives, a file per opening of the port
    import itertools
    from aerpaw_cmp.live.ports import SerialPort
    numbers, opened, read = itertools.count(), SerialPort.__init__, SerialPort.read

    def begin(self, *arguments):
        opened(self, *arguments)
        self.copy = open(f"{capture}-{next(numbers):06}.bin", "ab", buffering=0)

    def copied(self, *arguments):
        data = read(self, *arguments)
        self.copy.write(data)
        return data

    SerialPort.__init__, SerialPort.read = begin, copied
try:
    summary = run_tap(TapSettings(folder=Path(values.pop("folder")), log=log, **values),
                      on_status=(lambda status: None) if show else None)
except AerpawCmpError as error:
    print(error, file=sys.stderr)
    sys.exit(error.exit_code)
print(json.dumps({"answers": summary.answers, "rates_hz": summary.rates_hz, "missed": summary.missed,
                  "gaps": summary.gaps, "gap_s": summary.gap_s, "duration_s": summary.duration_s,
                  "records": summary.records, "lost_records": summary.lost_records}))
sys.exit(summary.exit_code)
"""


def start_tap(port: Path, folder: Path, **settings: Any) -> subprocess.Popen[str]:
    """A tap in its own process; its summary comes as JSON on standard output."""
    values = {"port": str(port), "folder": str(folder), **settings}
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'parsers'}"}
    return subprocess.Popen(
        [sys.executable, "-c", CHILD, json.dumps(values)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


def read_lines(journal: Iterable[Any]) -> list[tuple[str, tuple[str, ...]]]:
    """Command and lines of the answers that the simulator saw read to the end."""
    return [(served.command, served.lines) for served in list(journal) if served.read]


def resident_kib(pid: int) -> int:
    """Resident memory of a process [KiB]; 0 if it ended."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    return 0


def conditions() -> dict[str, object]:
    """What the numbers depend on."""
    return {
        "python": platform.python_version(),
        "kernel": platform.release(),
        "cores": os.cpu_count(),
        "load": [round(x, 2) for x in os.getloadavg()],
    }


def show(result: dict[str, object], as_json: bool) -> None:
    """Print a result."""
    if as_json:
        print(json.dumps(result))
        return
    for key, value in result.items():
        print(f"{key:28} {value}")

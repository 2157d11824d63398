"""Logs of planned flights, as if they had been flown."""

import shutil
from pathlib import Path

from aerpaw_cmp.cli import main

NO_LOGS = shutil.ignore_patterns("flight.yaml", "SHA256SUMS")


def simulate(flight: Path, folder: Path | None = None) -> None:
    """Write the logs of a flight file and what was planted, beside it or to a folder with others."""
    out = flight.parent / f"{flight.stem}_simulated"
    assert main(["simulate", str(flight), "-o", str(out), "--quiet"]) == 0
    shutil.copytree(out, folder or flight.parent, dirs_exist_ok=True, ignore=NO_LOGS)
    shutil.rmtree(out)

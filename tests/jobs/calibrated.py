"""A calibration as the command makes it, without its files."""

from __future__ import annotations

from pathlib import Path

from aerpaw_cmp.jobs.learning.calibrate import Calibration, calibrate, load_calibration, read_flights


def calibrated(path: Path) -> tuple[Calibration, list[str]]:
    """What was learned, and what is said of copied logs."""
    settings = load_calibration(path)
    flights, said = read_flights(settings, path.parent, None)
    return calibrate(settings, flights, path.parent), said

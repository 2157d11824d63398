"""The ``antenna export`` job."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..common.errors import UsageError
from ..common.outputs import OutputFile, is_sealed, sealed
from ..flight.settings import AntennaSettings, load_pattern
from ..site.antenna.antennas import MeasuredPattern
from ..site.antenna.export import exported
from .tasks.options import JobOutcome


def run_antenna_export(
    file: Path,
    out: Path,
    *,
    elevation: Path | None = None,
    variable: str | None = None,
    carrier_hz: float | None = None,
    force: bool = False,
) -> JobOutcome:
    """Write a pattern file in the format that the ending of ``out`` says.

    Parameters
    ----------
    file : Path
        Any pattern that a flight file may name.
    out : Path
    elevation : Path, optional
        Second cut, where ``file`` is an azimuth cut.
    variable : str, optional
        Grid inside a .mat file.
    carrier_hz : float, optional
    force : bool
        Replace a file that this tool did not write.

    Returns
    -------
    JobOutcome
    """
    inputs = [file, *([] if elevation is None else [elevation])]
    bare = out.suffix == ".msi"  # the format begins with NAME: no line in front
    with OutputFile(out, own=is_sealed, inputs=inputs, force=force) as output:
        cut = None if elevation is None else str(elevation.absolute())
        grid = variable is not None or file.suffix == ".mat"
        if grid and cut is not None:
            raise UsageError("an elevation cut beside a gain grid", expected="an azimuth cut as FILE", path=file)
        kind: Any = {"model": "gain_grid", "variable": variable or ""} if grid else {"model": "file"}
        settings = AntennaSettings(**kind, file=str(file.absolute()), elevation=cut)
        pattern = load_pattern(settings, Path(), carrier_hz)
        assert isinstance(pattern, MeasuredPattern)
        text = exported(pattern, file.stem, out, carrier_hz)
        output.write(text.encode("utf-8") if bare else sealed(text))
    return JobOutcome(folder=out.parent, files=(out,))

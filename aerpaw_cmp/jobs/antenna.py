"""The ``antenna export`` job."""

from __future__ import annotations

from pathlib import Path

from ..common.errors import UsageError
from ..common.outputs import OutputFile, is_sealed, sealed
from ..site.antenna.antennas import read_gain_grid
from ..site.antenna.pattern_files import exported, read_cut_files, read_pattern_file
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
    with OutputFile(out, own=is_sealed, inputs=inputs, force=force) as output:
        if variable is not None or file.suffix == ".mat":
            if elevation is not None:
                raise UsageError("an elevation cut beside a gain grid", expected="an azimuth cut as FILE", path=file)
            pattern = read_gain_grid(file, variable or "")
        elif elevation is not None:
            pattern = read_cut_files(file, elevation)
        else:
            pattern = read_pattern_file(file, carrier_hz=carrier_hz)
        text = exported(pattern, file.stem, out, carrier_hz)
        # MSI begins with NAME: no line may stand in front
        output.write(text.encode("utf-8") if out.suffix == ".msi" else sealed(text))
    return JobOutcome(folder=out.parent, files=(out,))

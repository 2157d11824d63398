"""All chosen formats into a folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from ...common.stages import Progress, silent
from .formats import FOLDER, FORMATS, missing_module
from .geojson import write_geojson
from .kmz import write_kmz
from .netcdf import write_netcdf
from .points import Export

__all__ = ["FORMATS", "write_exports"]

_WRITERS: dict[str, Callable[[Export, Path], list[Path]]] = {
    "geojson": write_geojson,
    "kmz": write_kmz,
    "netcdf": write_netcdf,
}


def write_exports(export: Export, folder: Path, formats: Iterable[str], progress: Progress = silent) -> list[Path]:
    """Write the files of some formats into ``folder / "exports"``.

    Parameters
    ----------
    export : Export
    folder : Path
        Of the results; the folder of the exports is made when missing.
    formats : iterable of str
        Of :data:`~aerpaw_cmp.report.exports.formats.FORMATS`.
    progress : Progress
        Told of a format whose library is missing (asked for as ``all``).

    Returns
    -------
    list of Path

    Raises
    ------
    OSError
        If the disk does not take a file.
    """
    place = folder / FOLDER
    written: list[Path] = []
    for name in formats:
        if missing := missing_module(name):
            progress(f"export {name} left out: {missing} is not installed (pip install 'aerpaw-cmp[geo]')")
            continue
        place.mkdir(exist_ok=True)
        written += _WRITERS[name](export, place)
    return written

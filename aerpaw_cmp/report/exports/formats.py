"""Export formats: those that are asked for, and their files; loads a writer where one is wanted."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from ...common.errors import UsageError
from ...common.stages import Progress, logged

if TYPE_CHECKING:
    from .points import Export

FORMATS = ("kmz", "netcdf")
# By format: the modules that it needs besides the default installation.
_NEEDS = {"netcdf": ("netCDF4", "xarray")}

ALL = "all"
FOLDER = "exports"


def chosen_formats(names: Iterable[str], known: Iterable[str] = FORMATS) -> tuple[str, ...]:
    """The formats that a user writes: names of known ones, also joined by commas; ``all`` for every one.

    Raises
    ------
    UsageError
        An unknown name; a format that is named and whose library is not installed.

    Examples
    --------
    >>> chosen_formats(["netcdf,kmz", "kmz"])
    ('kmz', 'netcdf')
    """
    chosen = [part.strip().lower() for name in names for part in name.split(",") if part.strip()]
    if unknown := [name for name in chosen if name not in (*known, ALL)]:
        raise UsageError(f"format {unknown[0]!r}", expected=", ".join((*known, ALL)))
    for name in chosen:
        if name != ALL and (missing := _missing_module(name)):
            raise UsageError(
                f"format {name} needs {missing}, which is not installed",
                expected="pip install 'aerpaw-cmp[geo]', or another format",
            )
    return tuple(name for name in known if name in chosen or ALL in chosen)


def _missing_module(name: str) -> str:
    """The module that a format needs and that is not there."""
    return next((module for module in _NEEDS.get(name, ()) if importlib.util.find_spec(module) is None), "")


def write_exports(export: Export, folder: Path, formats: Iterable[str], progress: Progress = logged) -> list[Path]:
    """Write the files of some formats into ``folder / "exports"``.

    Parameters
    ----------
    export : Export
    folder : Path
        Of the results; the folder of the exports is made when missing.
    formats : iterable of str
        Of :data:`FORMATS`.
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
    from .kmz import write_kmz
    from .netcdf import write_netcdf

    writers = {"kmz": write_kmz, "netcdf": write_netcdf}
    place = folder / FOLDER
    written: list[Path] = []
    for name in formats:
        if missing := _missing_module(name):
            progress(f"export {name} left out: {missing} is not installed (pip install 'aerpaw-cmp[geo]')")
            continue
        place.mkdir(exist_ok=True)
        written += writers[name](export, place)
    return written

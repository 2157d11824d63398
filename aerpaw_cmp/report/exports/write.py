"""Which formats there are, what each needs, and all chosen ones into a folder."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable
from pathlib import Path

from ...common.errors import UsageError
from ...common.stages import Progress, silent
from .geojson import write_geojson
from .geopackage import write_geopackage
from .gpx import write_gpx
from .kmz import write_kmz
from .matlab import write_mat
from .netcdf import write_netcdf
from .parquet import write_parquet
from .samples import Export

_WRITERS: dict[str, tuple[Callable[[Export, Path], list[Path]], str]] = {
    "geojson": (write_geojson, ""),
    "geopackage": (write_geopackage, ""),
    "kmz": (write_kmz, ""),
    "gpx": (write_gpx, ""),
    "mat": (write_mat, ""),
    "netcdf": (write_netcdf, "netCDF4"),
    "parquet": (write_parquet, "pyarrow"),
}
"""By format: what writes it, and the module that it needs besides the default installation."""

FORMATS = tuple(_WRITERS)
ALL = "all"
FOLDER = "exports"


def chosen_formats(*lists: str | Iterable[str]) -> tuple[str, ...]:
    """The formats of lists as a user writes them: names, also joined by commas; ``all`` for every one.

    Raises
    ------
    UsageError
        An unknown name; a format that is named and whose library is not installed.

    Examples
    --------
    >>> chosen_formats(["gpx,kmz", "gpx"], "geojson")
    ('geojson', 'kmz', 'gpx')
    """
    names = [name for some in lists for name in ([some] if isinstance(some, str) else some)]
    wanted = [part.strip().lower() for name in names for part in name.split(",") if part.strip()]
    unknown = [name for name in wanted if name not in (*FORMATS, ALL)]
    if unknown:
        raise UsageError(f"export {unknown[0]!r}", expected=", ".join((*FORMATS, ALL)))
    for name in wanted:
        if name != ALL and (missing := _missing(name)):
            raise UsageError(
                f"export {name} needs {missing}, which is not installed",
                expected="pip install 'aerpaw-cmp[geo]', or another format",
            )
    return tuple(name for name in FORMATS if name in wanted or ALL in wanted)


def _missing(name: str) -> str:
    """The module that a format needs and that is not there."""
    module = _WRITERS[name][1]
    try:
        found = not module or importlib.util.find_spec(module) is not None
    except ValueError:  # a module that is set to None, as an import of it would fail
        found = False
    return "" if found else module


def write_exports(export: Export, folder: Path, formats: Iterable[str], progress: Progress = silent) -> list[Path]:
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
    UsageError
        If a format cannot hold the samples.
    OSError
        If the disk does not take a file.
    """
    place = folder / FOLDER
    written: list[Path] = []
    for name in formats:
        if missing := _missing(name):
            progress(f"export {name} left out: {missing} is not installed (pip install 'aerpaw-cmp[geo]')")
            continue
        place.mkdir(exist_ok=True)
        written += _WRITERS[name][0](export, place)
    return written

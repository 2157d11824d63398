"""Export formats that there are, and those that are asked for; loads none of their writers."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable

from ...common.errors import UsageError

FORMATS = ("geojson", "kmz", "netcdf")
_NEEDS = {"netcdf": ("netCDF4", "xarray")}
"""By format: the modules that it needs besides the default installation."""

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
    >>> chosen_formats(["netcdf,kmz", "kmz"], "geojson")
    ('geojson', 'kmz', 'netcdf')
    """
    names = [name for some in lists for name in ([some] if isinstance(some, str) else some)]
    wanted = [part.strip().lower() for name in names for part in name.split(",") if part.strip()]
    unknown = [name for name in wanted if name not in (*FORMATS, ALL)]
    if unknown:
        raise UsageError(f"export {unknown[0]!r}", expected=", ".join((*FORMATS, ALL)))
    for name in wanted:
        if name != ALL and (missing := missing_module(name)):
            raise UsageError(
                f"export {name} needs {missing}, which is not installed",
                expected="pip install 'aerpaw-cmp[geo]', or another format",
            )
    return tuple(name for name in FORMATS if name in wanted or ALL in wanted)


def missing_module(name: str) -> str:
    """The module that a format needs and that is not there."""
    return next((module for module in _NEEDS.get(name, ()) if not _installed(module)), "")


def _installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ValueError:  # a module that is set to None, as an import of it would fail
        return False

"""Versions of everything that shapes a number."""

from __future__ import annotations

import platform
from datetime import datetime, timezone
from functools import cache
from importlib import metadata

from .. import __version__

_PACKAGES = ("numpy", "scipy", "pandas", "pyproj", "shapely", "sionna-rt", "mitsuba", "drjit")


NOT_INSTALLED = "not installed"


@cache
def version(package: str) -> str:
    """Version of an installed package, "not installed" where it is not; its metadata is read once."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return NOT_INSTALLED


def utc_now() -> str:
    """The present instant in UTC, ISO 8601 to the second."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def versions() -> dict[str, str]:
    """Versions by name; "not installed" where a package is not."""
    return {"aerpaw-cmp": __version__, "python": platform.python_version()} | {
        name: version(name) for name in _PACKAGES
    }

"""Versions of everything that shapes a number."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

from .. import __version__

PACKAGES = ("numpy", "scipy", "pandas", "pyproj", "shapely", "sionna-rt", "mitsuba", "drjit")


def versions() -> dict[str, str]:
    """Versions by name; "not installed" where a package is not."""
    numbers = {"aerpaw-cmp": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            numbers[name] = version(name)
        except PackageNotFoundError:
            numbers[name] = "not installed"
    return numbers

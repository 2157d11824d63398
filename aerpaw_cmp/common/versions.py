"""Versions of everything that shapes a number."""

from __future__ import annotations

import platform
import subprocess
from datetime import datetime, timezone
from functools import cache
from importlib import metadata
from pathlib import Path

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


@cache
def commit() -> str:
    """Commit of this tree, ``abc1234`` or ``abc1234.dirty``, where it is no release; "" where it is one.

    A checkout asks Git; a wheel holds the answer of the tree that it was built from (``tools/commit_file.py``).
    """
    package = Path(__file__).parents[1]
    written = package / COMMIT_FILE
    if written.is_file():
        return written.read_text(encoding="ascii").strip()
    if not (package.parent / ".git").exists():
        return ""
    release = f"v{__version__}"
    # --long counts the commits behind a tag also where there are none, so that the answer has one form
    ask = ["git", "-C", str(package.parent), "describe", "--tags", "--always", "--long", "--abbrev=7"]
    try:
        # no shell: the path of a checkout may hold blanks and quotes
        told = subprocess.run(
            [*ask, "--dirty=.dirty", "--match", release], capture_output=True, text=True, check=True, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return UNKNOWN
    answer = told.stdout.strip()
    # a release is its tag, clean: nothing behind it and no ".dirty"
    return "" if answer.startswith(f"{release}-0-g") and "." not in answer[len(release) :] else answer.split("-g")[-1]


# Of a wheel, beside the package's own files.
COMMIT_FILE = "commit.txt"

# A checkout without Git, or one that Git distrusts, is no release either.
UNKNOWN = "unknown"


def tool_version() -> str:
    """Version of this program, with the commit of a tree that is no release: ``0.4.0+gabc1234``."""
    mark = commit() and ("+" if commit() == UNKNOWN else "+g") + commit()
    return __version__ + mark


def utc_now() -> str:
    """The present instant in UTC, ISO 8601 to the second."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def versions() -> dict[str, str]:
    """Versions by name; "not installed" where a package is not."""
    return {"aerpaw-cmp": tool_version(), **library_versions()}


def library_versions() -> dict[str, str]:
    """The same without this program."""
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}

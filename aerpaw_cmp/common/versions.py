"""Versions of this program and of the libraries that affect its results."""

from __future__ import annotations

import contextlib
import hashlib
import platform
import subprocess
from datetime import datetime, timezone
from functools import cache
from importlib import import_module, metadata
from pathlib import Path

from .. import __version__

_PACKAGES = ("numpy", "scipy", "pandas", "pyproj", "shapely", "sionna-rt", "mitsuba", "drjit")


NOT_INSTALLED = "not installed"


@cache
def version(package: str) -> str:
    """Return the version of an installed package, else "not installed". Cached, so that metadata are read only once."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return NOT_INSTALLED


@cache
def commit() -> str:
    """Return the commit of the source tree, ``abc1234`` or ``abc1234.dirty``. Empty for a release.

    In a checkout, Git is queried. A wheel contains the commit of the tree from which it was built
    (``tools/commit_file.py``).
    """
    package = Path(__file__).parents[1]
    written = package / COMMIT_FILE
    if written.is_file():
        return written.read_text(encoding="ascii").strip()
    if not (package.parent / ".git").exists():
        return ""
    release = f"v{__version__}"
    # --long always adds the number of commits after the tag, so that the output always has the same form
    ask = ["git", "-C", str(package.parent), "describe", "--tags", "--always", "--long", "--abbrev=7"]
    try:
        # do not use a shell, because the path of a checkout may contain spaces and quotes
        described = subprocess.run(
            [*ask, "--dirty=.dirty", "--match", release], capture_output=True, text=True, check=True, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return UNKNOWN
    answer = described.stdout.strip()
    # a release is a clean checkout of its tag: no later commits and no ".dirty"
    return "" if answer.startswith(f"{release}-0-g") and "." not in answer[len(release) :] else answer.split("-g")[-1]


# File in a wheel that contains the commit, next to the other files of the package.
COMMIT_FILE = "commit.txt"

# Commit of a checkout if Git is not installed or does not trust its folder. Such a checkout is not treated as a
# release.
UNKNOWN = "unknown"


def tool_version() -> str:
    """Return the version of this program, with the commit unless it is a release: ``0.4.0+gabc1234``."""
    mark = commit() and ("+" if commit() == UNKNOWN else "+g") + commit()
    return __version__ + mark


def utc_now() -> str:
    """Return the present time in UTC, ISO 8601 to the second."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def versions() -> dict[str, str]:
    """Return the versions of this program, Python and the libraries by name, "not installed" for a missing library."""
    return {"aerpaw-cmp": tool_version(), **library_versions()}


def library_versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries by name."""
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}


# Entry points of readers. The digest contains the versions of readers from other packages.
READERS = "aerpaw_cmp.readers"

# Code, and the tables that it reads: tables of the parsers, the dictionary of columns, and weights of the statistics.
_SOURCES = ("**/*.py", "*.yaml", "logs/*.yaml", "compare/*.json")


@cache
def code_digest() -> str:
    """Return the digest of this program's source and tables, and of the versions of its numerical packages."""
    digest = hashlib.sha256()
    for name in ("aerpaw_cmp", "aerpaw_parsers"):
        with contextlib.suppress(ImportError):
            root = Path(str(import_module(name).__file__)).parent
            for path in sorted(path for pattern in _SOURCES for path in root.glob(pattern)):
                digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    for name in ("numpy", "scipy", "sionna-rt"):
        digest.update(f"{name} {version(name)}".encode())
    for plugin in sorted({str(p.dist and (p.dist.name, p.dist.version)) for p in metadata.entry_points(group=READERS)}):
        digest.update(plugin.encode())
    return digest.hexdigest()

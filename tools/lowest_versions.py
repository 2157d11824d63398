"""The lowest versions that pyproject.toml allows, as constraints for pip, to test an environment with old packages.

``python tools/lowest_versions.py > lowest.txt``, then ``pip install -c lowest.txt -e .`` in a separate environment.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def lowest(dependencies: list[str]) -> list[str]:
    """Return each requirement at its lowest version.

    Examples
    --------
    >>> lowest(["numpy>=2.0", "sionna-rt>=2.0,<2.3"])
    ['numpy==2.0', 'sionna-rt==2.0']
    """
    return [re.sub(r"^([\w.-]+)>=([\w.]+)(,<[\w.]+)?$", r"\1==\2", line) for line in dependencies]


if __name__ == "__main__":
    project = tomllib.loads((Path(__file__).resolve().parents[1] / "pyproject.toml").read_text())["project"]
    print("\n".join(lowest(project["dependencies"])))

"""Build hook that stores the commit of the tree in a wheel or an sdist, so that ``--version`` can print it.

Hatchling runs it during a build. A wheel built from an sdist already contains the file.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

_ASK = "from aerpaw_cmp.common.versions import commit; print(commit())"


class CommitFile(BuildHookInterface):  # type: ignore[type-arg]
    """A build hook that adds ``aerpaw_cmp/commit.txt``."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the commit of the tree to the file. An editable installation reads it from Git at each run instead."""
        if version == "editable" or Path(self.root, "aerpaw_cmp", "commit.txt").is_file():
            return
        commit = subprocess.run([sys.executable, "-c", _ASK], cwd=self.root, capture_output=True, text=True, check=True)
        self._file = Path(tempfile.mkdtemp()) / "commit.txt"
        self._file.write_text(commit.stdout, encoding="ascii")
        build_data["force_include"][str(self._file)] = "aerpaw_cmp/commit.txt"

"""The commit that a wheel or an sdist was built from, so that an installed package can name it (``--version``).

Hatchling runs this while it builds; a wheel made from an sdist has the file already.
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
    """Puts ``aerpaw_cmp/commit.txt`` into what is built."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Ask the tree for its commit; an editable install asks it anew each time."""
        if version == "editable" or Path(self.root, "aerpaw_cmp", "commit.txt").is_file():
            return
        told = subprocess.run([sys.executable, "-c", _ASK], cwd=self.root, capture_output=True, text=True, check=True)
        self._file = Path(tempfile.mkdtemp()) / "commit.txt"
        self._file.write_text(told.stdout, encoding="ascii")
        build_data["force_include"][str(self._file)] = "aerpaw_cmp/commit.txt"

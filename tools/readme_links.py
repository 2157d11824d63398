"""The README as a package index shows it: a link into this project must name its whole address there.

Hatchling runs this where metadata are made. The address is that of ``Source`` under ``[project.urls]``, the links are
those of the version's tag, ``/raw/`` for images and ``/blob/`` for pages, GitHub's way. While it names
no owner the README stays as it is.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(?P<image>!?)(?P<text>\[[^\]\[]*\])\((?P<target>(?![a-z]+:|#|/)[^)\s]+)\)")


def with_addresses(text: str, source: str, version: str) -> str:
    """A text in Markdown whose links into the project begin with the address of a version of it."""

    def address(link: re.Match[str]) -> str:
        kind = "raw" if link["image"] else "blob"
        return f"{link['image']}{link['text']}({source.rstrip('/')}/{kind}/v{version}/{link['target']})"

    return _LINK.sub(address, text)


class ReadmeLinks(MetadataHookInterface):
    """Sets ``readme``."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the README, with whole addresses where the project has one."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        source = metadata["urls"]["Source"]
        text = text if "<owner>" in source else with_addresses(text, source, metadata["version"])
        metadata["readme"] = {"content-type": "text/markdown", "text": text}

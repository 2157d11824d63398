"""Metadata hook that gives the README complete links, because a package index does not resolve relative links.

Hatchling runs it when it creates the metadata. Links begin with the address ``Source`` of ``[project.urls]`` and the
tag of the version, with ``/raw/`` for images and ``/blob/`` for pages, as on GitHub. As long as the address does not
name an owner, the README is not changed.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(?P<image>!?)(?P<text>\[[^\]\[]*\])\((?P<target>(?![a-z]+:|#|/)[^)\s]+)\)")


def with_addresses(text: str, source: str, version: str) -> str:
    """Return a Markdown text in which links into the project begin with the address of one of its versions."""

    def address(link: re.Match[str]) -> str:
        kind = "raw" if link["image"] else "blob"
        return f"{link['image']}{link['text']}({source.rstrip('/')}/{kind}/v{version}/{link['target']})"

    return _LINK.sub(address, text)


class ReadmeLinks(MetadataHookInterface):
    """A metadata hook that sets ``readme``."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the README, with complete links if the project has an address."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        source = metadata["urls"]["Source"]
        text = text if "<owner>" in source else with_addresses(text, source, metadata["version"])
        metadata["readme"] = {"content-type": "text/markdown", "text": text}

"""Keys that docs/reference/json.md lists for a command."""

import re
from collections.abc import Iterable
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "json.md"


def listed(command: str) -> list[str]:
    (row,) = re.findall(rf"^\| `{command}` \| (.*?) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return re.findall(r"`(\w+)`", row)


def unlisted(command: str, keys: Iterable[str]) -> list[str]:
    """Keys of an object that the page does not name."""
    return sorted(set(keys) - {"schema", *listed(command)})

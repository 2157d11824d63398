"""Every claim of docs/security.md names tests that are there."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_each_claim_names_a_test_that_exists() -> None:
    table = (ROOT / "docs" / "security.md").read_text(encoding="utf-8").split("| claim | test |")[1].split("\n\n")[0]
    rows = [line for line in table.splitlines() if line.startswith("| ") and "---" not in line]
    assert len(rows) > 15
    for row in rows:
        path = None
        named = re.findall(r"`((?:tests|benchmarks)/[\w/]+\.py)?(?:::|\.\.\.)?(\w+)?`", row.split("|")[2])
        assert named, row
        for file, name in named:
            path = file or path
            assert path is not None, row
            text = (ROOT / path).read_text(encoding="utf-8")
            assert not name or name in text, (path, name)

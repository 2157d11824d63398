"""Write the line of each function into docs/equations.md (``--check``: only say which are out of date)."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "equations.md"
ROW = re.compile(r"^\| (?P<equation>.*?) \| (?P<formula>.*) \| `(?P<function>[\w.]+)` \| .*\|$")


def place(function: str) -> str:
    """``aerpaw_cmp/room/module.py:line`` of ``room.module.name[.method]``; LookupError when there is none."""
    path, names = ROOT / "aerpaw_cmp", function.split(".")
    while path.is_dir():
        path = path / names.pop(0)
    path = path.with_suffix(".py")
    node: ast.AST = ast.parse(path.read_text(encoding="utf-8"))
    for name in names:
        inside = [n for n in getattr(node, "body", []) if getattr(n, "name", None) == name]
        if not inside:
            raise LookupError(f"{path.relative_to(ROOT)} has no {'.'.join(names)}")
        node = inside[0]
    return f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}"


def main() -> int:
    """Bring the page up to date; with ``--check`` exit 1 where it is not."""
    old = PAGE.read_text(encoding="utf-8")
    lines = []
    for line in old.splitlines():
        row = ROW.match(line)
        if row:
            line = f"| {row['equation']} | {row['formula']} | `{row['function']}` | {place(row['function'])} |"
        lines.append(line)
    new = "\n".join(lines) + "\n"
    if "--check" in sys.argv:
        return int(new != old)
    PAGE.write_text(new, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

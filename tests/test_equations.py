"""docs/equations.md against the code: each function exists and names its equation."""

import importlib.util
import inspect
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROW = re.compile(r"^\| (?P<equation>.*?) \| (?P<formula>.*) \| `(?P<function>[\w.]+)` \|$")
ROWS = [m for m in map(ROW.match, (ROOT / "docs" / "equations.md").read_text().splitlines()) if m]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row['equation']}-{row['function']}")
def test_the_function_exists_and_names_the_equation(row: re.Match[str]) -> None:
    thing = importlib.import_module("aerpaw_cmp")
    for name in row["function"].split("."):
        if hasattr(thing, "__path__") and importlib.util.find_spec(f"{thing.__name__}.{name}"):
            thing = importlib.import_module(f"{thing.__name__}.{name}")
        else:
            thing = getattr(thing, name)
    text = " ".join((inspect.getdoc(thing) or "").split())
    assert re.search(re.escape(row["equation"]) + r"(?!\d)", text), f"the docstring does not name {row['equation']}"


def test_all_displayed_equations_of_the_paper_are_there() -> None:
    numbers = {int(n) for row in ROWS for n in re.findall(r"arXiv 2502\.10324 eq\. (\d+)", row["equation"])}
    assert numbers == set(range(1, 20))

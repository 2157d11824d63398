"""Words of user-visible text: terms of the field and no private metaphors (docs/vocabulary.md)."""

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from aerpaw_cmp.cli.app import app

ROOT = Path(__file__).parents[1]
# Pattern: what to write in its place.
BANNED = {
    r"\bWORSE\b": "worse, and only where an interval says so",
    r"shown to be": "significant, not significant",
    r"\bstretch(?:es)? of\b|\bof (?:a|the) stretch\b|\bstretches left out\b": "segment, held-out segment",
    r"\bnot told apart\b|\bcannot be told\b|\bis told\b|\bwas told\b": "stated, not separable",
    r"[Ll]east and most|\bto the first \[dB\]": "minimum / maximum, difference from the best setting",
    r"ends hold|covers none of": "outer bins include, a noun and a number",
    r"\b[Pp]aths? invented|\binvented paths?": "paths only in our engine",
    r"[Ww]ith reserve": "Caution:",
    r"What the scene needs|\(weakened\)|\(power sum\)": "model comparison; attenuated, incoherent",
    r"\bevery \d+\. ": "every 2nd",
    r"[Oo]ffset of the (?:span|others)\b": "offset of the selection, of the training flights",
    r"\bno (?:remarks|progress and)\b": "results, warnings and failures only",
}


@functools.cache
def parsed(path: Path) -> ast.Module:
    """Return the syntax tree of a file, which several tests of test_project.py use."""
    return ast.parse(path.read_text(encoding="utf-8"))


def texts_of(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of strings with a blank that are not docstrings, and of templates."""
    if path.suffix != ".py":
        yield from enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        return
    tree = parsed(path)
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    bodies = [statement for node in ast.walk(tree) if isinstance(node, documented) for statement in node.body]
    docstrings = {id(statement_.value) for statement_ in bodies if isinstance(statement_, ast.Expr)}
    for node in ast.walk(tree):
        text = node.value if isinstance(node, ast.Constant) and id(node) not in docstrings else None
        if isinstance(text, str) and " " in text.strip():
            yield node.lineno, text


def faults(text: str) -> list[str]:
    return [f"{match[0]!r}: {instead}" for banned, instead in BANNED.items() if (match := re.search(banned, text))]


FILES = [
    *sorted((ROOT / "aerpaw_cmp").rglob("*.py")),
    *sorted((ROOT / "parsers").rglob("*.py")),
    *sorted((ROOT / "aerpaw_cmp/report/templates").glob("*.jinja")),
    *(path for path in sorted((ROOT / "aerpaw_cmp/report/templates").glob("*.js")) if "uPlot" not in path.name),
    *sorted(path for path in (ROOT / "docs").rglob("*.md") if "research" not in path.parts),
    ROOT / "README.md",
]


@pytest.mark.parametrize(
    "text",
    ["Ray tracing is WORSE than free space", "the largest error of a stretch", "Paths invented 20", "every 2. pose"],
)
def test_a_banned_word_would_be_seen(text: str) -> None:
    assert faults(text)


def options(group: Any, name: str = "") -> Iterator[tuple[str, str]]:
    for verb, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from options(command, f"{name}{verb} ")
        else:
            yield from (
                (f"{name}{verb} {parameter.opts[0]}", parameter.help)
                for parameter in command.params
                if getattr(parameter, "help", "")
            )


def test_help_of_an_option_is_a_noun_phrase_with_its_default_in_brackets() -> None:
    texts = list(options(typer.main.get_command(app)))
    assert len(texts) > 100
    for name, text in texts:
        assert not re.match(r"What|Whose|Which|Whether|Of |Only say|In place", text), (name, text)
        assert "may be repeated" not in text, name
        assert not re.search(r"(?<!\[)\b[Dd]efault:", text), (name, text)
        assert len(text.split()) <= 25, (name, text)

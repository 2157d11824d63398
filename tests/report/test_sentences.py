"""Every sentence of the five pages with its condition: tests/report/sentences.md.

    python -m tests.report.test_sentences        writes that table again; read it before you commit it

The table is made from the modules of words, the captions of figures and the templates. A page that shows words which
the table does not have, or a table that is not that of the code, fails.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import pytest

from tests.report.shown import DATA, PAGES

ROOT = Path(__file__).parents[2] / "aerpaw_cmp" / "report"
TABLE = Path(__file__).with_name("sentences.md")
GAP = "…"
SHELL = ("cards.py", "templates/page.html.jinja")
SOURCES = {
    "report": (*SHELL, "flight.py", "flight_words.py", "flight_figures.py", "charts.py", "columns.py",
               "templates/explorer.html.jinja", "templates/method.html.jinja", "templates/site_view.html.jinja"),
    "map": (*SHELL, "maps.py", "charts.py", "templates/map_explorer.html.jinja"),
    "campaign": (*SHELL, "campaign.py"),
    "calibration": (*SHELL, "calibration.py"),
    "prediction": (*SHELL, "prediction.py", "templates/places.html.jinja"),
}  # fmt: skip
WORD = re.compile(r"[A-Za-z][A-Za-z'-]*")
INLINE = {"b", "i", "em", "strong", "code", "a", "br", "sup", "sub", "abbr"}


def of_module(path: Path) -> Iterator[tuple[str, str]]:
    """Yield condition and text of each string of a module that is not a docstring. Values of an f-string are gaps."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    yield from _strings(tree, [])


def _strings(node: ast.AST, above: list[str]) -> Iterator[tuple[str, str]]:
    if isinstance(node, (ast.Constant, ast.JoinedStr)):
        text = _text(node)
        if WORD.search(text):
            yield " and ".join(above), text
        return
    for child, condition in _children(node):
        yield from _strings(child, [*above, condition] if condition else above)


def _text(node: ast.Constant | ast.JoinedStr) -> str:
    if isinstance(node, ast.Constant):
        text = node.value if isinstance(node.value, str) else ""
    else:
        text = "".join(str(part.value) if isinstance(part, ast.Constant) else GAP for part in node.values)
    return " ".join(re.sub(r"(?<!\{)\{[^{}]*\}", GAP, text).split())


def _children(node: ast.AST) -> Iterator[tuple[ast.AST, str]]:
    """Parts of a node, each with the condition that the node adds."""
    if isinstance(node, (ast.If, ast.IfExp)):
        test = ast.unparse(node.test)
        body, other = ([node.body], [node.orelse]) if isinstance(node, ast.IfExp) else (node.body, node.orelse)
        yield from ((part, test) for part in body)
        yield from ((part, f"not ({test})") for part in other)
    elif isinstance(node, ast.Dict):
        for key, value in zip(node.keys, node.values, strict=True):
            yield value, ast.unparse(key) if key is not None else ""
            yield from ((part, "") for part in [key] if part is not None)
    elif isinstance(node, ast.Tuple) and node.elts and isinstance(node.elts[0], ast.Lambda):
        yield from ((part, ast.unparse(node.elts[0].body)) for part in node.elts[1:])
    elif isinstance(node, (ast.FunctionDef, ast.ClassDef, ast.Module)):
        docstrings = [part for part in node.body if isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant)]
        name = "" if isinstance(node, ast.Module) else node.name
        yield from ((part, name) for part in node.body if part not in docstrings)
    elif isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        yield node.value, ast.unparse(target) if ast.unparse(target).isupper() else ""
    elif not isinstance(node, ast.Raise):
        yield from ((part, "") for part in ast.iter_child_nodes(node))


def of_template(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the condition and the text of each block of a template. Values that the template prints become gaps."""
    source = re.sub(r"<style>.*?</style>|{#.*?#}", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    above: list[str] = []
    held, at_start = "", ""
    for token in re.findall(r"{%.*?%}|{{.*?}}|<[^>]*>|[^{<]+|[{<]", source, flags=re.DOTALL):
        tag = re.match(r"</?([a-z0-9]+)", token)
        if tag and tag[1] not in INLINE:
            yield from _block(held, at_start)
            held, at_start = "", " and ".join(above)
        elif token.startswith("{%"):
            verb, *rest = token.strip("{}% ").split(None, 1)
            if verb in ("if", "for", "macro"):
                above.append(rest[0] if rest else verb)
            elif verb in ("elif", "else") and above:
                above[-1] = rest[0] if rest else f"not ({above[-1]})"
            elif verb in ("endif", "endfor", "endmacro") and above:
                above.pop()
            held += f" {GAP} " if verb in ("if", "else", "elif", "endif", "for", "endfor") and held.strip() else ""
            at_start = at_start if held.strip() else " and ".join(above)
        elif token.startswith("{{"):
            held += GAP
            for quoted in re.findall(r'"([^"]*)"', token):
                yield from _block(quoted, " and ".join(above))
        else:
            held += "" if tag else token
    yield from _block(held, at_start)


def _block(text: str, condition: str) -> Iterator[tuple[str, str]]:
    plain = " ".join(text.split())
    if WORD.search(plain):
        yield condition, plain


@cache
def pieces() -> list[tuple[str, str, str, str]]:
    """Page, source, condition and text, each once."""
    entries = []
    for page, names in SOURCES.items():
        for name in names:
            parts = of_template if name.endswith(".jinja") else of_module
            entries += [(page, name, condition, text) for condition, text in parts(ROOT / name)]
    return list(dict.fromkeys(entries))


def rows() -> list[tuple[str, str, str, str]]:
    """Pieces of three words and more."""
    return [row for row in pieces() if sum(bool(WORD.search(word)) for word in row[3].split()) >= 3]


def written() -> str:
    """The table as it is kept."""
    lines = [
        "# Sentences of the pages",
        "",
        "Made by `python -m tests.report.test_sentences`: source, the condition under which a sentence may stand, and the",
        "sentence, in which … is a number or a name. A change of words is a change of this table, to be read against",
        "docs/vocabulary.md.",
    ]
    for page in SOURCES:
        lines += ["", f"## {page}", "", "| source | condition | sentence |", "| --- | --- | --- |"]
        lines += [
            "| " + " | ".join(cell.replace("|", "\\|") for cell in row[1:]) + " |" for row in rows() if row[0] == page
        ]
    return "\n".join(lines) + "\n"


def test_the_table_is_that_of_the_code() -> None:
    assert TABLE.read_text(encoding="utf-8") == written(), "python -m tests.report.test_sentences; read what changed"
    assert len(rows()) > 300


class Text(HTMLParser):
    """Text of the blocks of a page, without scripts, styles, code and cells of data."""

    def __init__(self) -> None:
        super().__init__()
        self.blocks: list[str] = [""]
        self.skipped = 0

    def handle_starttag(self, tag: str, attrs: object) -> None:  # noqa: ARG002
        self.skipped += tag in SKIPPED
        if tag not in INLINE:
            self.blocks.append("")

    def handle_endtag(self, tag: str) -> None:
        self.skipped -= tag in SKIPPED
        if tag not in INLINE:
            self.blocks.append("")

    def handle_data(self, data: str) -> None:
        if not self.skipped:
            self.blocks[-1] += data


# Names without a capital.
ENGINES = {"image", "sionna"}
SKIPPED = ("script", "style", "td", "pre", "code", "svg")


def unknown(html: str) -> list[str]:
    """Return sequences of three words of a page that are neither in the table nor in the data."""
    parser = Text()
    parser.feed(html)
    texts = [part for *_, text in pieces() for part in re.split(GAP, text)] + list(DATA)
    known = {run for text in texts for run in runs(text)}
    starts = {tuple(words[:k]) for text in texts if (words := WORD.findall(text)) for k in (1, 2)}
    ends = {tuple(words[-k:]) for text in texts if (words := WORD.findall(text)) for k in (1, 2)}
    out = []
    for block in parser.blocks:
        for run in runs(block):
            joined = any(run[:k] in ends and run[k:] in starts for k in (1, 2))
            joined |= run[:1] in ends and run[2:] in starts  # a name between
            if run not in known and not joined and not ENGINES & set(run):
                out.append(" ".join(run))
    return out


def runs(text: str) -> Iterator[tuple[str, ...]]:
    """Three words in a row, all small, with nothing but blanks between them."""
    for part in re.findall(r"(?<![\w'.-])(?:[a-z][a-z'-]*[ \n]+)+[a-z][a-z'-]*", text):
        words = part.split()
        yield from (tuple(words[i : i + 3]) for i in range(len(words) - 2))


@pytest.mark.parametrize("page", SOURCES)
def test_a_page_shows_no_sentence_that_the_table_lacks(page: str, request: pytest.FixtureRequest) -> None:
    html = PAGES[page](request.getfixturevalue)
    assert len(html) > 2000
    assert unknown(html) == []


def test_a_new_sentence_would_be_seen() -> None:
    assert unknown("<p>this clause was never written into it</p>")


if __name__ == "__main__":
    TABLE.write_text(written(), encoding="utf-8")

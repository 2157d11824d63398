"""The documentation: every command in it is parsed by the real parser, the tutorial's are run, the pages build strictly."""

import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.cli.app import app
from benchmarks import performance

ROOT = Path(__file__).parents[1]
PAGES = [
    *sorted((ROOT / "docs").rglob("*.md")),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md")),
    *sorted((ROOT / "reports").glob("README.md")),
]
PROGRAM: Any = typer.main.get_command(app)
_NUMBERS = {"N", "DB", "S", "HZ", "M", "K"}
STARTS = ("aerpaw-cmp ", "python benchmarks/", "python tools/", "python -m ", "pytest ", "make ")


def commands(text: str) -> list[tuple[str, bool]]:
    """Yield the command lines of a page, and whether each is in a block (True) or in a sentence (False)."""
    text = text.replace("\\\n", " ")
    lines = [line.strip().removeprefix("$ ") for line in text.splitlines()]
    inside = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    in_block = [(line, True) for line in lines if line.startswith(STARTS)]
    return in_block + [(span, False) for span in inside if span.startswith(STARTS)]


def words_of(line: str) -> list[str]:
    """Return the words of a line without comment, pipe, brackets and dots. N, DB and the like are numbers."""
    line = re.split(r"\s#|\s\||\s>|\s&", line)[0].replace("[", " ").replace("]", " ").replace("...", " ")
    return ["1" if word in _NUMBERS else word for word in shlex.split(line)]


def check(line: str, in_block: bool) -> None:
    """Raise an exception if the line could not run: unknown command, option, file, target, or a wrong value."""
    program, *words = words_of(line)
    if program == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert words[0] in targets, words[0]
    elif program == "pytest":
        assert all((ROOT / word.split("::")[0]).exists() for word in words if word.startswith("tests/")), line
    elif program == "python":
        script = f"{words[1].replace('.', '/')}.py" if words[0] == "-m" else words[0]
        code = (ROOT / script).read_text()
        assert all(f'"{word}"' in code for word in words if word.startswith("--")), line
    elif not words[0].isupper() and words not in (["-h"], ["--help"]):
        parse([word for word in words if word not in ("-h", "--help")], in_block)


def parse(words: list[str], complete: bool) -> None:
    """Let the program parse a line. A line within a sentence may omit required arguments."""
    if words[0].startswith("-"):
        assert words[0] in {option for parameter in PROGRAM.params for option in parameter.opts} | {
            "--version",
            "--debug",
            "--help",
        }
        return
    command, context = PROGRAM, PROGRAM.make_context("aerpaw-cmp", [], resilient_parsing=True)
    while hasattr(command, "commands") and words:
        name = words.pop(0)
        command = command.commands[name]
        group = hasattr(command, "commands")
        try:
            context = command.make_context(name, [] if group else words, parent=context, resilient_parsing=group)
        except Exception as error:
            if complete or type(error).__name__ != "MissingParameter":
                raise


LINES = {
    f"{page.relative_to(ROOT)}: {line}": (line, block) for page in PAGES for line, block in commands(page.read_text())
}


def test_there_are_commands_in_the_documentation() -> None:
    assert len(LINES) > 60


@pytest.mark.parametrize("where", LINES)
def test_a_command_of_the_documentation_would_run(where: str) -> None:
    check(*LINES[where])


@pytest.mark.parametrize(
    "line",
    ["aerpaw-cmp report flight.yaml --audits none", "aerpaw-cmp reprot x", "aerpaw-cmp site import map.osm",
     "aerpaw-cmp map --figures magic", "python benchmarks/ingest.py --no-such-thing", "python benchmarks/nothing.py",
     "pytest tests/nothing.py", "make nothing"],
)  # fmt: skip
def test_a_wrong_command_would_be_seen(line: str) -> None:
    with pytest.raises(Exception, match=r"(?s).*"):
        check(line, True)


def blocks(page: str) -> list[tuple[str, str]]:
    return re.findall(r"^```(\w*)\n(.*?)^```", page, re.MULTILINE | re.DOTALL)


def test_the_tutorial_shows_what_its_commands_print(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Run the quick commands of the tutorial. Its report is that of ``make report`` except for the audit."""
    monkeypatch.chdir(tmp_path)
    shown, ran = "", []
    for kind, text in blocks((ROOT / "docs" / "tutorial.md").read_text()):
        if kind == "sh":
            shown = ""
            for line in text.splitlines():
                words = words_of(line)
                if words[0] == "aerpaw-cmp" and words[1] not in ("report", "campaign"):
                    capsys.readouterr()
                    assert main(words[1:]) == 0
                    shown += "".join(capsys.readouterr())
                    ran.append(words[1])
        elif shown and kind == "text":
            squeezed = " ".join(shown.split())
            for line in text.splitlines():
                for part in filter(None, (part.strip() for part in line.split("..."))):
                    assert " ".join(part.split()) in squeezed, part
        elif kind == "yaml" and ran[-1:] == ["ingest"]:
            draft = (tmp_path / "try_it" / "draft.yaml").read_text()
            assert all(line in draft for line in text.splitlines() if line != "  ...")
    assert ran[:2] == ["sample", "ingest"]


needs_mkdocs = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("mkdocs", "material", "mkdocstrings_handlers")),
    reason="mkdocs-material is not here: pip install --group docs",
)


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built documentation, figures as blanks: the gallery's scripts take 10 s and run in ``make docs``."""
    folder = tmp_path_factory.mktemp("docs")
    environ = {**os.environ, "AERPAW_CMP_DOCS_FIGURES": "0", "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(folder)],
        cwd=ROOT, env=environ, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr + done.stdout
    return folder


@needs_mkdocs
def test_the_pages_build_strictly_and_ask_no_network(pages: Path) -> None:
    loads = re.compile(
        r'<(?:script|img|iframe|source)[^>]+src="?(https?:|//)|<link[^>]+rel="?(?:stylesheet|preconnect|icon|preload)[^>]+href="?(https?:|//)'
    )
    written = list(pages.rglob("*.html"))
    assert len(written) > 20
    for page in written:
        assert not loads.search(page.read_text()), page
    for style in pages.rglob("*.css"):
        assert not re.search(r"url\(\s*[\"']?(https?:|//)", style.read_text()), style


@needs_mkdocs
def test_the_reference_has_every_public_name_and_every_command(pages: Path) -> None:
    import aerpaw_cmp
    from aerpaw_cmp.common.text import COMMANDS

    python = (pages / "reference" / "python.html").read_text()
    for name, home in aerpaw_cmp._HOME.items():
        assert f'id="aerpaw_cmp.{home}.{name}"' in python
    assert ":class:" not in python
    listed = (pages / "reference" / "commands.html").read_text()
    assert all(f"aerpaw-cmp {name}" in listed for name in COMMANDS)


def test_every_page_has_a_place_in_the_menu() -> None:
    menu = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")[2]
    pages = [page.relative_to(ROOT / "docs").as_posix() for page in sorted((ROOT / "docs").rglob("*.md"))]
    assert len(pages) > 30
    assert [name for name in pages if name not in menu] == []


def test_the_menu_has_four_kinds_of_page_and_at_most_45() -> None:
    menu = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")[2]
    assert re.findall(r"^  - ([^:]+):", menu, re.MULTILINE) == [
        "Home",
        "Tutorial",
        "How to",
        "Reference",
        "Explanation",
    ]
    assert 30 < menu.count(".md") <= 45


@pytest.mark.parametrize("page", sorted((ROOT / "docs").rglob("*.md")), ids=lambda page: page.stem)
def test_a_page_opens_with_its_question_and_an_example(page: Path) -> None:
    """The first paragraph asks, and a block of commands, output or settings comes before the second section."""
    text = re.sub(r"\A---\n.*?\n---\n|<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    first, *sections = re.split(r"^## ", text, flags=re.MULTILINE)
    paragraph = first.partition("\n\n")[2].strip().partition("\n\n")[0]
    assert "?" in paragraph, paragraph
    opening = first + "".join(sections[:1])
    assert re.search(r"^(```|    \S)", opening, re.MULTILINE) or page.stem == "vocabulary", "no example"


def test_each_claim_of_security_names_a_test_that_exists() -> None:
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


@pytest.mark.skipif(
    not (ROOT / "benchmarks" / "history.jsonl").is_file(), reason="no history yet: make bench-all makes it"
)
def test_the_page_of_performance_is_made_from_the_history() -> None:
    history = performance.runs(performance.HISTORY)
    assert (ROOT / "docs" / "performance.md").read_text(encoding="utf-8") == performance.page(history)


# Private words of earlier pages (what to write instead: docs/vocabulary.md), and inversions that have to be decoded.
PRIVATE = re.compile(
    r"\b(?:anew|whatever|whoever|beside|seldom|planted|rungs?|mends?|whole or|in the mean|stands? (?:in|under|twice)"
    r"|(?<!there )(?:is|are) no (?!longer)|so (?:many|much) (?:positions|samples|flights)|speaks? for|as it stands|remembers?)\b",
    re.IGNORECASE,
)


def prose(page: Path) -> list[str]:
    """Return the sentences of a page, without code, tables, headings and comments."""
    text = re.sub(r"(?s)\A---\n.*?\n---\n|```.*?```|<!--.*?-->", "", page.read_text(encoding="utf-8"))
    text = re.sub(r"^(?:[|#]| {4}).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"`[^`]+`", "X", re.sub(r"\]\([^)]*\)", "]", text))
    paragraphs = (" ".join(part.split()) for part in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.) ", text))
    return [one for part in paragraphs for one in re.split(r"(?<=[.?!:])\s+(?=[A-Z\[*(])", part) if one]


def test_pages_use_short_sentences_and_no_private_words() -> None:
    sentences = {
        (page.stem, sentence): len(re.findall(r"[\w'-]+", sentence)) for page in PAGES for sentence in prose(page)
    }
    assert len(sentences) > 1500
    assert [key for key in sentences if PRIVATE.search(key[1])] == []
    long = [key for key, words in sentences.items() if words > 30]
    assert len(long) <= 0.05 * len(sentences), sorted(long)[:20]
    assert sum(sentences.values()) <= 17 * len(sentences)

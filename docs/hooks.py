"""Hooks of ``make docs``, which turns pages into HTML.

- Runs every script of ``docs/gallery``: its figure goes into the gallery, with the script, and in place of the comment
  ``<!-- gallery: NAME -->`` of any page. A script that fails ends the build.
- Replaces links out of the documentation (benchmarks, tests) and roles in docstrings by text.
"""

from __future__ import annotations

import ast
import io
import os
import re
import runpy
from pathlib import Path
from typing import Any

import matplotlib
from mkdocs.structure.files import File, Files

matplotlib.use("Agg")

FOLDER = Path(__file__).parent
SCRIPTS = sorted((FOLDER / "gallery").glob("*.py"))


def words_of(script: Path) -> tuple[str, str, str]:
    """Return title, text and code of a script: first line and rest of its docstring, and the code below."""
    source = script.read_text(encoding="utf-8")
    tree = ast.parse(source)
    title, _, text = (ast.get_docstring(tree) or "").partition("\n")
    return title, text.strip(), "\n".join(source.splitlines()[tree.body[0].end_lineno :]).strip()


def picture(script: Path) -> bytes:
    """Return the SVG of a script's ``figure``, or a blank if AERPAW_CMP_DOCS_FIGURES is 0 (a fast build)."""
    if os.environ.get("AERPAW_CMP_DOCS_FIGURES") == "0":
        return b'<svg xmlns="http://www.w3.org/2000/svg" width="1" height="1"/>'
    import matplotlib.pyplot as plt

    with matplotlib.rc_context({"svg.hashsalt": "docs", "savefig.facecolor": "white", "savefig.bbox": "tight"}):
        stream = io.BytesIO()
        runpy.run_path(str(script))["figure"].savefig(stream, format="svg", metadata={"Date": None})
    plt.close("all")
    return stream.getvalue()


def gallery() -> str:
    """Return the page of all figures with their code."""
    parts = [
        "# Gallery",
        "What do two-ray fading, Fresnel coefficients or an antenna pattern look like with this package? `make docs` "
        "draws each figure with the code below it. Copy a script and change it: its "
        "variable `figure` is a Matplotlib figure.",
    ]
    for script in SCRIPTS:
        title, text, code = words_of(script)
        parts += [f"## {title} {{ #{script.stem} }}", text, f"![{title}](gallery/{script.stem}.svg)"]
        parts += [f'```python title="docs/gallery/{script.name}"\n{code}\n```']
    return "\n\n".join(parts) + "\n"


def on_files(files: Files, config: Any) -> Files:
    """Add the gallery and its figures."""
    for script in SCRIPTS:
        files.append(File.generated(config, f"gallery/{script.stem}.svg", content=picture(script)))
    files.append(File.generated(config, "gallery.md", content=gallery()))
    return files


def _figure(name: str, up: str) -> str:
    title, text, _ = words_of(FOLDER / "gallery" / f"{name}.py")
    return f"![{title}]({up}gallery/{name}.svg)\n\n*{title}.* {' '.join(text.split())} [Code]({up}gallery.md#{name})\n"


def commands() -> str:
    """Return a section per command with its help."""
    from typer.main import get_command

    from aerpaw_cmp.cli.app import app

    parts: list[str] = []

    def add(group: Any, context: Any, words: str) -> None:
        for name in sorted(group.commands):
            one = group.commands[name]
            inner = one.make_context(name, [], parent=context, resilient_parsing=True)
            if hasattr(one, "commands"):
                add(one, inner, f"{words} {name}")
            else:
                inner.terminal_width = inner.max_content_width = 110
                parts.append(f"## {words} {name}".strip() + f"\n\n```text\n{one.get_help(inner)}\n```\n")

    program: Any = get_command(app)
    add(program, program.make_context("aerpaw-cmp", [], resilient_parsing=True), "")
    return "\n".join(parts)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Insert figures and commands, and replace links out of the documentation by file names."""
    up = "../" * page.file.src_uri.count("/")
    markdown = re.sub(r"<!-- gallery: (\w+) -->", lambda match: _figure(match[1], up), markdown)
    if "<!-- commands -->" in markdown:
        markdown = markdown.replace("<!-- commands -->", commands())
    return re.sub(rf"\[([^\]]+)\]\((?:\.\./){{{up.count('/') + 1}}}([^)]+)\)", r"\1 (`\2`)", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Replace roles of docstrings, such as ``:class:`~a.b.C` ``, by their last name."""
    return re.sub(r":(?:class|func|meth|data|mod|attr|exc):<code>~?(?:[\w.]+\.)?(\w+)</code>", r"<code>\1</code>", html)

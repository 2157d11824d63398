"""Common parts of all pages: template engine, figures, and the writing of files to a results folder.

A page is a single file that needs no network. The template engine escapes every text from a log or a
configuration.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from markupsafe import Markup

from ..common.stages import Progress, logged
from ..common.text import counted
from ..common.versions import commit, utc_now, versions
from .canvas import FORMATS, FigureSpec, render
from .texts import coded

# Choices for figures as files: no figures, one format, or all formats.
FIGURES = ("none", *FORMATS, "all")


def links_of(by_tower: Mapping[str, Mapping[str, Any]]) -> dict[tuple[str, str], Any]:
    """Return numbers by tower and channel from ``rss`` of metrics.json."""
    return {(tower, name): numbers for tower, channels in by_tower.items() for name, numbers in channels.items()}


def merge(into: dict[str, Any], numbers: Mapping[str, Any]) -> None:
    """Merge ``numbers`` into ``into``, key by key. Keys that ``numbers`` does not have are not changed."""
    for key, value in numbers.items():
        if isinstance(value, Mapping) and isinstance(into.get(key), dict):
            merge(into[key], value)
        else:
            into[key] = value


def json_text(numbers: Mapping[str, Any] | Sequence[Any], indent: int | None = 2) -> str:
    """Return numbers as the JSON text of a file."""
    return json.dumps(numbers, indent=indent, ensure_ascii=False, allow_nan=False) + "\n"


def write_file(path: Path, content: str | bytes | Iterator[str]) -> Path:
    """Write one file of a folder of results and return its path.

    Text may be passed in pieces. The folder of the file is created if its parent exists.
    :class:`~aerpaw_cmp.common.outputs.OutputFolder` writes the folder atomically and turns errors into messages.
    """
    path.parent.mkdir(exist_ok=True)
    pieces = iter([content]) if isinstance(content, (str, bytes)) else content
    with path.open("wb") as file:
        for piece in pieces:
            file.write(piece.encode("utf-8") if isinstance(piece, str) else piece)
    return path


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """The content that every page and its metrics.json share: time (UTC, ISO 8601), versions, and seconds per stage."""

    generated: str = field(default_factory=utc_now)
    versions: Mapping[str, str] = field(default_factory=versions)
    stages_s: Mapping[str, float] = field(default_factory=dict)


def about(page: Any) -> dict[str, Any]:
    """Return time, versions and stages for metrics.json. ``page`` has the fields of :class:`Made`."""
    return {
        "generated": page.generated,
        "commit": commit(),
        "versions": dict(sorted(page.versions.items())),
        "stages": {f"{name}_s": seconds for name, seconds in page.stages_s.items()},
    }


# ``script`` is 'none' or the digest of the script of the page. If a hostile text passed the escaping, the browser would
# still refuse any other script or file.
_CONTENT_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {script}"


def digest(text: str) -> str:
    """Return the SHA-256 of a script or style in the form of a content security policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"


@cache
def environment() -> Any:
    """Return the template engine. The engine escapes all text and fails on undefined names."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("aerpaw_cmp.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(coded=coded, counted=counted, embedded=embedded, zip=zip)
    return environment


def script(*names: str) -> str:
    """Return the joined text of the named scripts."""
    folder = resources.files("aerpaw_cmp.report") / "templates"
    return "\n".join((folder / name).read_text(encoding="utf-8") for name in names)


def rendered(template: str, scripts: Sequence[str] = (), **content: Any) -> str:
    """Render a template with its scripts and a content policy that allows only these scripts."""
    code = script(*scripts) if scripts else ""
    policy = _CONTENT_POLICY.format(script=digest(code) if code else "'none'")
    page = environment().get_template(f"{template}.html.jinja")
    return str(page.render(script=Markup(code), content_policy=policy, **content))


def as_json(content: Mapping[str, Any]) -> str:
    """Return JSON text for a script element. Each ``<`` is escaped, so that no text inside can end the element."""
    return json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def embedded(content: Mapping[str, Any] | None) -> Markup:
    """Return the data of a page's script as JSON text, or an empty text if there are no data."""
    return Markup(as_json(content)) if content else Markup("")


def write_figures(
    specs_of: Callable[[], Sequence[FigureSpec]], folder: Path, drawn: str, progress: Progress = logged
) -> list[Path]:
    """Draw figures, write each in one or all formats, and return the paths.

    Parameters
    ----------
    specs_of : callable
        Function that returns the figures.
    folder : Path
        Folder, which is created if it does not exist.
    drawn : str
        A value of :data:`FIGURES`.
    progress : Progress
        Called with the share of figures that have been drawn.

    Returns
    -------
    list of Path
    """
    specs = () if drawn == "none" else specs_of()
    written: list[Path] = []
    for number, spec in enumerate(specs, 1):
        pictures = render(spec, FORMATS if drawn == "all" else (drawn,))
        written += [write_file(folder / f"{spec.name}.{form}", content) for form, content in pictures.items()]
        progress("figures", number / len(specs))
    return written

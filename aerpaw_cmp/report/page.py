"""The base of every page: shell, files of a folder of results, names, numbers and instants as text.

A page is one file that needs nothing else and no network; without a script its figures still stand. Every text that
comes from a log or a configuration is escaped by the template engine.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from markupsafe import Markup

from ..common.stages import Progress, logged
from ..common.text import counted
from ..common.versions import commit, utc_now, versions
from .canvas import FigureSpec, Picture, render
from .texts import coded


def links_of(by_tower: Mapping[str, Mapping[str, Any]]) -> dict[tuple[str, str], Any]:
    """Numbers by tower and channel, of ``rss`` in metrics.json."""
    return {(tower, name): numbers for tower, channels in by_tower.items() for name, numbers in channels.items()}


def merge(into: dict[str, Any], numbers: Mapping[str, Any]) -> None:
    """Put ``other`` into ``into``, key by key; what is only in ``into`` stays."""
    for key, value in numbers.items():
        if isinstance(value, Mapping) and isinstance(into.get(key), dict):
            merge(into[key], value)
        else:
            into[key] = value


def json_text(numbers: Mapping[str, Any], indent: int | None = 2) -> str:
    """Numbers as the text of a file."""
    return json.dumps(numbers, indent=indent, ensure_ascii=False, allow_nan=False) + "\n"


def write_file(path: Path, content: str | bytes | Iterator[str]) -> Path:
    """Write one file of a folder of results; its own folder is made when missing, but not that one's parent.

    Text may come in pieces.

    The set becomes whole, and errors become messages, in :class:`~aerpaw_cmp.common.outputs.OutputFolder`.
    """
    path.parent.mkdir(exist_ok=True)
    pieces = iter([content]) if isinstance(content, (str, bytes)) else content
    with path.open("wb") as file:
        for piece in pieces:
            file.write(piece.encode("utf-8") if isinstance(piece, str) else piece)
    return path


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """Instant (UTC, ISO 8601), versions and seconds of the stages: what every page and its metrics.json end with."""

    generated: str = field(default_factory=utc_now)
    versions: Mapping[str, str] = field(default_factory=versions)
    stages_s: Mapping[str, float] = field(default_factory=dict)


def about(page: Any) -> dict[str, Any]:
    """The entries of metrics.json on when and how a page was made; ``page`` has the fields of :class:`Made`."""
    return {
        "generated": page.generated,
        "commit": commit(),
        "versions": dict(sorted(page.versions.items())),
        "stages": {f"{name}_s": seconds for name, seconds in page.stages_s.items()},
    }


# ``script``: 'none', or the digest of the page's one script. Lets a browser refuse whatever would be loaded or run
# besides, should a hostile log ever get past the escaping.
_CONTENT_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {script}"


def digest(text: str) -> str:
    """A script or style as a content policy names it."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"


def picture_uri(picture: Picture) -> str:
    """A picture as a data URI: its small PNG where it has one, else the SVG."""
    kind, content = ("png", picture.inline) if picture.inline else ("svg+xml", picture.formats["svg"])
    return f"data:image/{kind};base64," + base64.b64encode(content).decode("ascii")


@cache
def environment() -> Any:
    """The template engine: everything escaped, an undefined name is an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("aerpaw_cmp.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(coded=coded, counted=counted, embedded=embedded, picture_uri=picture_uri, zip=zip)
    return environment


def script(*names: str) -> str:
    """Scripts of the page, one after the other."""
    folder = resources.files("aerpaw_cmp.report") / "templates"
    return "\n".join((folder / name).read_text(encoding="utf-8") for name in names)


def rendered(template: str, scripts: Sequence[str] = (), **content: Any) -> str:
    """Render a template with its scripts and the content policy that lets a browser run them alone."""
    code = script(*scripts) if scripts else ""
    policy = _CONTENT_POLICY.format(script=digest(code) if code else "'none'")
    text: str = (
        environment()
        .get_template(f"{template}.html.jinja")
        .render(script=Markup(code), content_policy=policy, **content)
    )
    return text


def as_json(content: Mapping[str, Any]) -> str:
    """Text for a script element: no name can close it."""
    return json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def embedded(content: Mapping[str, Any] | None) -> Markup:
    """The data of a page's script, inside the page; empty without any."""
    return Markup(as_json(content)) if content else Markup("")


def write_figures(
    specs: Sequence[FigureSpec],
    folder: Path,
    formats: Sequence[str] = ("png",),
    kind: str = "screen",
    progress: Progress = logged,
) -> tuple[list[Picture], list[Path]]:
    """Draw figures and write each in its formats; gives the pictures and the files.

    Parameters
    ----------
    specs : sequence of FigureSpec
    folder : Path
        Made when missing.
    formats : sequence of str
        Of matplotlib, as ``"svg"``, ``"png"``, ``"pdf"``.
    kind : str
        Style, as in :func:`render`.
    progress : Progress
        Share of the figures that are drawn.

    Returns
    -------
    pictures : list of Picture
    files : list of Path
    """
    drawn: list[Picture] = []
    written: list[Path] = []
    for spec in specs:
        progress("figures", len(drawn) / len(specs))
        picture = render(spec, formats, kind)
        drawn.append(picture)
        written += [write_file(folder / f"{spec.name}.{form}", content) for form, content in picture.formats.items()]
    if specs:
        progress("figures", 1.0)
    return drawn, written

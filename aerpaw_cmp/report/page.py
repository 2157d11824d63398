"""The base of every page: shell, files of a folder of results, names, numbers and instants as text.

A page is one file that needs nothing else and no network; without a script its figures still stand. Every text that
comes from a log or a configuration is escaped by the template engine.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from ..common.counting import counted
from ..common.jsonable import number_key
from ..common.stages import Progress, logged
from ..common.versions import commit, utc_now, versions
from ..logs.records import has_wall_clock
from .canvas import FigureSpec, Picture, render

# Columns of rss.csv, followed by one ``<baseline>_dbm`` per baseline.
RSS_COLUMNS: dict[str, str] = {
    "time_utc": "instant of the sample, ISO 8601, UTC; empty: the log has relative times and no origin was given",
    "time_s": "seconds after the first sample of this tower and channel",
    "tower": "name of the tower",
    "channel": "name of the channel",
    "unit": "unit of measured_db",
    "east_m": "UAV position, metres east of the site origin",
    "north_m": "metres north",
    "up_m": "metres above the ground at the origin",
    "measured_db": "as logged; empty: no signal",
    "calibrated_db": "measured_db plus the offset of this tower and channel",
    "simulated_dbm": "ray tracing; empty: no path",
    "residual_db": "calibrated_db minus simulated_dbm",
    "measured_out_of_coverage": "1: the log has no signal here",
    "simulated_out_of_coverage": "1: the ray tracing has no path here",
}

# Columns of rank.csv, followed by one ``simulated_rank_k<K>`` per K (0: no path), then what a receiver decides by:
# ``level_dbm`` and ``sigma<i>_over_sigma1_db``, 20 log10 of the ratio of singular values (empty: no path, or zero);
# with ``rank.receiver`` also ``probability_rank<r>``.
RANK_COLUMNS: dict[str, str] = {
    "time_utc": "instant of the report, ISO 8601, UTC; empty: the log has relative times and no origin was given",
    "time_s": "seconds after the first report of this tower",
    "tower": "name of the tower",
    "east_m": "UAV position, metres east of the site origin",
    "north_m": "metres north",
    "up_m": "metres above the ground at the origin",
    "measured_rank": "reported rank 1 to 4; empty: no CSI",
}


# K as a key of metrics.json and of rank.csv.
k_key = number_key


def iso_time(time: Any) -> Any:
    """Instants as ISO 8601 text with milliseconds and ``Z``; empty where not a time."""
    instants = np.asarray(time, dtype="datetime64[ns]")
    # half a unit added: numpy truncates, and a stored 0.9999999 s must not lose a millisecond
    text = np.datetime_as_string((instants + np.timedelta64(500_000, "ns")).astype("datetime64[ms]"), timezone="UTC")
    return np.where(np.isnat(instants), "", text)


def safe_name(text: str) -> str:
    """A part of a file name from any text.

    Examples
    --------
    >>> safe_name("LW1 USRP1"), safe_name("../a b"), safe_name("")
    ('LW1_USRP1', 'a_b', '_')
    """
    return re.sub(r"[^A-Za-z0-9.-]+", "_", text).strip("._")[:80] or "_"


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


def number(value: float | None, decimals: int = 1, unit: str = "") -> str:
    """A number for a table; an en dash where there is none.

    Examples
    --------
    >>> number(-3.14159, 2), number(float("nan")), number(-0.004, 2)
    ('−3.14', '–', '0.00')
    """
    if value is None or not math.isfinite(value):
        return "–"
    rounded = round(value, decimals) + 0.0  # what rounds to zero has no sign
    text = f"{rounded:,.{decimals}f}".replace(",", "\u202f").replace("-", "\u2212")
    return f"{text}\u202f{unit}" if unit else text


def interval(value: tuple[float | None, float | None] | None, decimals: int = 1) -> str:
    """An interval as ``[low, high]``, a bound as ``≥ low``, or nothing; "cannot tell" where there is neither."""
    if value is None:
        return ""
    low, high = (math.nan if end is None else end for end in value)
    if not math.isfinite(low):
        return "cannot tell"
    return (
        f"[{number(low, decimals)}, {number(high, decimals)}]" if math.isfinite(high) else f"≥ {number(low, decimals)}"
    )


def percent(share: float | None, decimals: int = 0) -> str:
    """A share as a percentage; an en dash where there is none."""
    return number(None if share is None else 100 * share, decimals, "%")


def minute(instant: str) -> str:
    """An ISO 8601 instant of UTC to the minute; any other text as it is.

    Examples
    --------
    >>> minute("2026-11-23T06:11:20+00:00"), minute("later")
    ('2026-11-23 06:11 UTC', 'later')
    """
    parts = re.fullmatch(r"(\d{4}-\d\d-\d\d)T(\d\d:\d\d):\d\d(?:\.\d+)?(?:Z|\+00:00)", instant)
    return instant if parts is None else f"{parts[1]} {parts[2]} UTC"


def duration(seconds: float | None) -> str:
    """Seconds with three digits that count, in ms below one second.

    Examples
    --------
    >>> duration(0.000412), duration(0.1731), duration(5.1913), duration(None)
    ('0.412\u202fms', '173\u202fms', '5.19\u202fs', '–')
    """
    if seconds is None or not math.isfinite(seconds):
        return "–"
    value, unit = (1000.0 * seconds, "ms") if seconds < 1.0 else (seconds, "s")
    return number(value, 0 if value >= 100 else 1 if value >= 10 else 2 if value >= 1 else 3, unit)


def flat(settings: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Nested settings as dotted names and plain text, without those that are not set; a bound as ``≥ low``.

    What is listed, as the logs of a flight, has a numbered row each.

    Examples
    --------
    >>> list(flat({"a": {"b_ci95_db": (5.5, None), "c": None}, "d": [1, 2], "e_ci95": (None, None)}))
    [('a.b_ci95_db', '≥ 5.5'), ('d', '1, 2')]
    >>> list(flat({"logs": [{"path": "a.txt", "node": "LW1", "kind": None, "skip": []}, {"path": "b.txt"}]}))
    [('logs.1', 'path: a.txt, node: LW1'), ('logs.2', 'path: b.txt')]
    """
    for key, value in settings.items():
        name = f"{above}.{key}" if above else str(key)
        if isinstance(value, Mapping):
            yield from flat(value, name)
        elif isinstance(value, (list, tuple)) and any(isinstance(part, Mapping) for part in value):
            for number, part in enumerate(value, 1):
                yield f"{name}.{number}", ", ".join(": ".join(row) for row in flat(part))
        elif (text := _plain(name, value)) is not None:
            yield name, text


def _plain(name: str, value: Any) -> str | None:
    """Text of one setting or number; None where it is not set or empty."""
    if "ci95" in name and isinstance(value, (list, tuple)) and None in value:
        return None if value[0] is None else f"≥ {short(value[0])}"
    if isinstance(value, (list, tuple)):
        return ", ".join(map(short, value)) or None
    return None if value is None else short(value)


def clock(instant: Any, start: Any) -> str:
    """Time of day (UTC), or seconds after ``start`` where the log has relative times only.

    Examples
    --------
    >>> clock(np.datetime64("2025-06-01T14:00:03.2"), np.datetime64("2025-06-01T14:00:00"))
    '14:00:03'
    >>> clock(np.datetime64("1970-01-01T00:00:03.2"), np.datetime64("1970-01-01"))
    '3.2'
    """
    if has_wall_clock(start):
        return str(iso_time([instant])[0])[11:19]
    return number(float((instant - start) / np.timedelta64(1, "s")))


def more(rows: Sequence[Any], limit: int) -> str:
    """Words for a caption where a table does not show all rows.

    Examples
    --------
    >>> more([1, 2, 3], 2), more([1, 2], 2)
    (' (the first 2 of 3; the files beside this page hold all)', '')
    """
    return f" (the first {limit} of {len(rows)}; the files beside this page hold all)" if len(rows) > limit else ""


def short(value: Any) -> str:
    """A value as text; numbers to 6 digits, which metrics.json holds in full; an en dash where there is none."""
    if value is None:
        return "–"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def coded(text: str) -> Markup:
    """Text whose parts between backquotes are commands or keys; all of it escaped.

    Examples
    --------
    >>> str(coded("Next: `a < b`."))
    'Next: <code>a &lt; b</code>.'
    """
    parts = str(text).replace("(95 %)", "(95\N{NO-BREAK SPACE}%)").split("`")
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if i % 2 else escape(part) for i, part in enumerate(parts)
    )


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
    environment.filters.update(
        num=number, coded=coded, counted=counted,
        interval=interval, percent=percent, duration=duration, minute=minute, k=k_key,
        flat=lambda s: list(flat(s)), clock=clock, picture_uri=picture_uri, more=more,
    )  # fmt: skip
    return environment


def script(*names: str) -> str:
    """Scripts of the page, one after the other."""
    folder = resources.files("aerpaw_cmp.report") / "templates"
    return "\n".join((folder / name).read_text(encoding="utf-8") for name in names)


def rendered(template: str, scripts: Sequence[str] = (), **content: Any) -> str:
    """A page from its template, with its scripts and the content policy that lets a browser run them alone."""
    code = script(*scripts) if scripts else ""
    page = environment().get_template(f"{template}.html.jinja")
    policy = _CONTENT_POLICY.format(script=digest(code) if code else "'none'")
    text: str = page.render(script=Markup(code), content_policy=policy, **content)
    return text


def as_json(content: Mapping[str, Any]) -> str:
    """Text for a script element: no name can close it."""
    return json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def embedded(content: Mapping[str, Any] | None) -> Markup:
    """The data of a page's script, inside the page; empty without any."""
    return Markup(as_json(content)) if content else Markup("")


def write_page(
    folder: Path, name: str, numbers: Mapping[str, Any], shown: Mapping[str, Any], **content: Any
) -> list[Path]:
    """Write ``metrics.json`` and the page NAME.html of a job.

    Parameters
    ----------
    folder : Path
    name : str
        Of the page and its template.
    numbers : mapping
        For metrics.json.
    shown : mapping
        Data of the live canvas, as :func:`aerpaw_cmp.report.places.payload` makes it.
    content
        For the template.

    Returns
    -------
    list of Path
        The page first.
    """
    page = rendered(name, ("common.js", "places.js"), explorer=embedded(shown), **content)
    return [write_file(folder / f"{name}.html", page), write_file(folder / "metrics.json", json_text(numbers))]


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

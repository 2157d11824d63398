"""Pages as lists of cards. One function returns each card.

A :class:`Card` has a heading, paragraphs, tables, charts and positions, and ``page.html.jinja`` shows the cards of all
pages in the same way. A card or table without content is not shown, so the functions do not have to check for content.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from ..compare.statistics import Interval
from .page import json_text, rendered, write_file
from .texts import cut, flat, interval, number, percent, short

# Forms of a column: text, heading of a row, right-aligned text, percentage. The form of a column of numbers is its
# number of decimals.
TEXT, HEAD, RIGHT, SHARE = "text", "head", "right", "share"

# Scripts of a page, by the view that shows its positions.
_SCRIPTS = {
    "explorer": ("uplot.min.js", "common.js", "explorer.js"),
    "map_explorer": ("common.js", "map_explorer.js"),
    "places": ("common.js", "places.js"),
}


def cell(value: Any, form: str | int) -> Any:
    """Return the text of a cell from an interval, a number or a text, in the form of its column.

    Examples
    --------
    >>> cell(1.25, 1), cell((0.5, 1.5), 1), cell(0.5, SHARE), cell(None, TEXT)
    ('1.2', '[0.5, 1.5]', '50\u202f%', '–')
    """
    if isinstance(value, str):
        return value
    if isinstance(form, int):
        return interval(value, form) if isinstance(value, tuple) else number(value, form)
    return percent(value) if form == SHARE else short(value)


def _numeric(form: str | int) -> bool:
    """Check whether a column is aligned to the right."""
    return isinstance(form, int) or form in (RIGHT, SHARE)


def estimate(value: float | None, ends: Interval | None, form: str | int = 2, mark: str = "{}") -> Markup:
    """Return a number as HTML, with its interval in small type.

    Parameters
    ----------
    value : float, optional
    ends : Interval, optional
    form : str or int
        Decimals, or :data:`SHARE` for a percentage.
    mark : str
        HTML in which the number is inserted, such as ``<b>{}</b>``.

    Returns
    -------
    Markup

    Examples
    --------
    >>> print(estimate(0.916, (0.9, 0.93), SHARE))
    92 % <span class="small">[90, 93]</span>
    """
    if form == SHARE and ends is not None:
        ends = 100 * ends[0], 100 * ends[1]
    shown = interval(None if cell(value, form) == "\u2013" else ends, form if isinstance(form, int) else 0)
    return Markup('{} <span class="small">{}</span>').format(Markup(mark).format(cell(value, form)), shown)


def bold(text: Any) -> Markup:
    """Return a text in bold type."""
    return Markup("<b>{}</b>").format(text)


def paragraph(*parts: Any) -> Markup:
    """Return a paragraph of texts and Markup."""
    return Markup("<p>{}</p>").format(Markup(" ").join(part for part in parts if part))


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table of a card. A table without rows is not shown.

    Parameters
    ----------
    caption : str
    columns : mapping of str to str or int
        Column headings, each with the form of its cells: :data:`TEXT`, :data:`HEAD`, :data:`RIGHT`, :data:`SHARE` or
        decimals.
    rows : sequence of sequences
        Values of the cells, in the form that :func:`cell` accepts.
    look : str
        ``dense`` for many columns, ``tall`` for many rows.
    notes : sequence of str
        Paragraphs below the table.
    """

    caption: str
    columns: Mapping[str, str | int]
    rows: Sequence[Sequence[Any]]
    look: str = ""
    notes: Sequence[str] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Positions:
    """The data of a map or sphere. ``view`` names the script that shows it: explorer, map_explorer or places."""

    view: str
    data: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Card:
    """A part of a page: heading, paragraphs, tables, charts and positions in this order, and then inner cards.

    Parameters
    ----------
    title : str
    text : sequence
        Paragraphs: strings (with commands between backquotes), lists, or Markup, which is not escaped.
    tables : sequence of Table
    chart : str
        Section whose charts (:class:`~aerpaw_cmp.report.charts.Chart`) this card shows.
    positions : Positions, optional
    id, link : str
        Anchor of a section, and its label in the navigation.
    fold : bool
        True if the card is closed until a reader opens it.
    group : str
        Name of a group of cards of which only one is open at a time.
    grid : bool
        True if charts are side by side.
    parts : sequence of Card
    """

    title: str = ""
    text: Sequence[Any] = ()
    tables: Sequence[Table] = ()
    chart: str = ""
    positions: Positions | None = None
    id: str = ""
    link: str = ""
    fold: bool = False
    group: str = ""
    grid: bool = False
    parts: Sequence[Card] = ()

    @property
    def empty(self) -> bool:
        """True if there is no content below the heading."""
        filled = any(self.text) or any(table.rows for table in self.tables) or self.chart or self.positions
        return not (filled or any(not part.empty for part in self.parts))


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """A page with its head and its cards.

    Parameters
    ----------
    kind, title, tag : str
        Name of the command, heading, and a word next to the name of the command.
    verdict : str
        The result in a paragraph.
    cautions : sequence of str
        Limits of the numbers. Three are shown; all others can be unfolded.
    about : sequence of str
        Lines in small type.
    numbers : sequence
        Records with ``label``, ``value``, ``interval`` and ``reference`` for the boxes of main numbers.
    first, cards : sequence of Card
        Cards above the navigation and below it.
    charts : sequence of Chart
        Charts in the order of the data of the script.
    """

    kind: str
    title: str
    tag: str = ""
    verdict: str = ""
    cautions: Sequence[str] = ()
    about: Sequence[str] = ()
    numbers: Sequence[Any] = ()
    first: Sequence[Card] = ()
    cards: Sequence[Card] = ()
    charts: Sequence[Any] = ()

    @property
    def view(self) -> str:
        """The view of the positions of the page, empty if no card has positions."""
        return next((card.positions.view for card in (*self.first, *self.cards) if card.positions), "")

    def html(self) -> str:
        """Return the page as one file."""
        cards = [card for card in self.cards if not card.empty]
        scripts = _SCRIPTS.get(self.view, ())
        return rendered("page", scripts, page=self, cards=cards, cell=cell, numeric=_numeric)


# Characters of a setting that the page shows. Fingerprints of logs have thousands.
_SETTING_SHOWN = 300


def settings_card(made: Any, *settings: Mapping[str, Any], fold: bool = False) -> Card:
    """Return the card of settings, versions and times. ``made`` has the fields of :class:`~.page.Made`."""
    rows = [(key, cut(text, _SETTING_SHOWN)) for part in settings for key, text in flat(part)]
    checked = Table(caption="All settings, with their defaults.", columns={"Key": HEAD, "Value": TEXT}, rows=rows)
    software = Table(caption="Software.", columns={"Name": HEAD, "Version": TEXT}, rows=list(made.versions.items()))
    stages = list(made.stages_s.items())
    seconds = Table(caption="Seconds per stage.", columns={"Stage": HEAD, "Seconds": 2}, rows=stages)
    parts = (
        Card(title="Settings", tables=[checked], fold=True),
        Card(title="Versions and seconds per stage", tables=[software, seconds], fold=True),
    )
    return Card(title="Settings, versions, time", id="settings", link="Settings", fold=fold, parts=parts)


def write_page(folder: Path, name: str, page: Page, numbers: Mapping[str, Any]) -> list[Path]:
    """Write the page and the ``metrics.json`` of a job.

    Parameters
    ----------
    folder : Path
    name : str
        Name of the file without ``.html``.
    page : Page
    numbers : mapping
        Content of metrics.json.

    Returns
    -------
    list of Path
        The page is the first.
    """
    return [write_file(folder / f"{name}.html", page.html()), write_file(folder / "metrics.json", json_text(numbers))]

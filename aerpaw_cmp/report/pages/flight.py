"""report.html of a flight: what its template shows, in one record."""

from __future__ import annotations

from collections.abc import Sequence

from ...compare.judge.ladder import LadderRow
from ...compare.level.rss import PART_DB
from ...logs.records import has_wall_clock
from ..content.flight import RANKS, ReportData, start_of
from ..exports.tables import further_numbers
from ..figures.charts import charts_of, shown_confusion
from ..kit.page import embedded, environment, rendered
from ..names import RANK_COLUMNS, RSS_COLUMNS
from ..words import flight as words
from ..words.flight_verdict import headlines, paragraph
from .explorer import payload

# Rejected lines shown per file; the flight file holds all.
_REJECTED_SHOWN = 20

# what the templates of a flight's page alone use
_FILTERS = {"audit_summary": words.audit_summary, "further": further_numbers, "instants": words.instants}


def _ladder_table(ladder: Sequence[LadderRow]) -> list[tuple[str, bool, float, dict[str, LadderRow]]]:
    """Model, whether recommended, seconds, and its rows by tower and channel."""
    table: dict[str, dict[str, LadderRow]] = {}
    for row in ladder:
        table.setdefault(row.model, {})[f"{row.tower} {row.channel}".strip()] = row
    return [
        (model, any(r.recommended for r in rows.values()), max(r.seconds for r in rows.values()), rows)
        for model, rows in table.items()
    ]


def page(data: ReportData, files: Sequence[str]) -> str:
    """The whole page.

    Parameters
    ----------
    data : ReportData
    files : sequence of str
        Names of the files beside the page.
    """
    charts = charts_of(data)
    linked = payload(data, charts) if data.rss or data.rank else None
    environment().filters.update(_FILTERS)
    return rendered(
        "report",
        ("uplot.min.js", "common.js", "explorer.js") if linked else (),
        data=data,
        charts=charts,
        explorer=embedded(linked),
        first_words=paragraph(data),
        numbers=headlines(data),
        serving=shown_confusion(data.serving) if data.serving is not None and data.serving.n else None,
        start=start_of(data),
        clock_unit="UTC" if has_wall_clock(start_of(data)) else "s",
        files=files,
        notes=list(dict.fromkeys([*data.site.notes, *data.notes])),  # a flight repeats what its site says
        ranks=RANKS,
        parted_db=PART_DB,
        headline=words.headline(data),
        verdicts=words.verdicts(data.rss, data.rank),
        ladder_verdict=words.ladder_verdict(data.ladder),
        ladder=_ladder_table(data.ladder),
        cautions=words.cautions(data),
        offsets=words.offset_sentences(data.rss),
        baselines=list(dict.fromkeys(name for item in data.rss for name in item.baselines)),
        rss_columns=RSS_COLUMNS,
        rank_columns=RANK_COLUMNS,
        rejected_shown=_REJECTED_SHOWN,
        pretty=words.pretty,
    )

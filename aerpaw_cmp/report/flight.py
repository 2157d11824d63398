"""report.html of a flight: what its template shows, in one record; and the folder of the results around it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..common.stages import Stages
from ..compare.judge.ladder import LadderRow
from ..compare.level.rss import PART_DB
from ..logs.records import has_wall_clock
from . import flight_figures as figures
from . import flight_words as words
from .canvas import FORMATS
from .charts import charts_of, shown_confusion
from .columns import further_numbers, metrics, rank_csv, rss_csv
from .explorer import payload
from .exports import FOLDER
from .flight_data import RANKS, ReportData, start_of
from .flight_words import headlines, paragraph
from .page import RANK_COLUMNS, RSS_COLUMNS, embedded, environment, json_text, rendered, write_figures, write_file

# Rejected lines shown per file; the flight file holds all.
_REJECTED_SHOWN = 20

# Figures that are drawn as files: none, or every one in a format or in all.
FIGURES = ("none", "svg", "png", "pdf", "all")

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


# --- the folder -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenReport:
    """The files, ``report.html`` first, and the record with the seconds that its writing took."""

    files: tuple[Path, ...]
    data: ReportData


def write_report(
    data: ReportData,
    folder: str | Path,
    *,
    drawn: str = "none",
    style: str = "screen",
    exports: Sequence[str] = (),
    stages: Stages | None = None,
) -> WrittenReport:
    """Write the files of a report.

    Parameters
    ----------
    data : ReportData
    folder : path
        Empty; that of :meth:`aerpaw_cmp.common.outputs.OutputFolder.filling`, say.
    drawn : str
        One of :data:`FIGURES`.
    style : {"screen", "paper"}
    exports : sequence of str
        Formats of :data:`aerpaw_cmp.report.exports.FORMATS` for the samples, besides the CSVs.
    stages : Stages, optional
        Times the stage "report"; all its seconds are then those of the record.

    Returns
    -------
    WrittenReport
        Files: ``report.html`` first, the CSVs (header only when they have no rows), the figures, ``metrics.json``.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    folder, stages = Path(folder), stages or Stages(seconds=dict(data.stages_s))
    written: list[Path] = []
    with stages("report"):
        specs = [] if drawn == "none" else figures.figure_specs(data)
        formats = FORMATS if drawn == "all" else (drawn,)
        for name, text in (("rss.csv", rss_csv(data.rss)), ("rank.csv", rank_csv(data.rank))):
            # written even without rows: a reader finds the same files in every report
            written.append(write_file(folder / name, text))
        _, pictures = write_figures(specs, folder / "figures", formats, style, stages.progress)
    written += pictures
    if exports:
        from .exports import of_report, write_exports

        with stages("exports"):
            written += write_exports(of_report(data), folder, exports, stages.progress)
    data = dataclasses.replace(data, stages_s=dict(stages.seconds))
    offered = (folder, folder / FOLDER)
    files = ["metrics.json", *(path.relative_to(folder).as_posix() for path in written if path.parent in offered)]
    # a page names the folder of pictures only if it was written
    files += ["figures/"] * bool(pictures)
    with stages("report"):
        html = write_file(folder / "report.html", page(data, files))
    data = dataclasses.replace(data, stages_s=dict(stages.seconds))
    numbers = write_file(folder / "metrics.json", json_text(metrics(data)))
    return WrittenReport(files=(html, *written, numbers), data=data)

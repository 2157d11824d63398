"""The results folder of a report: page, figures, tables and metrics."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...common.stages import Stages
from ..content.flight import ReportData
from ..exports.formats import FOLDER
from ..exports.tables import metrics, rank_csv, rss_csv
from ..figures import flight as figures
from ..kit.canvas import FORMATS, STYLES, write_figures
from ..kit.files import json_text, write_file
from . import flight as html

# Figures that are drawn as files: none, or every one in a format or in all.
FIGURES = ("none", "svg", "png", "pdf", "all")

__all__ = ["FIGURES", "STYLES", "WrittenReport", "write_report"]


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
        Formats of :data:`aerpaw_cmp.report.exports.formats.FORMATS` for the samples, besides the CSVs.
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
        _, paths = write_figures(specs, folder / "figures", formats, style, stages.progress)
    written += paths
    if exports:
        from ..exports.formats import write_exports
        from ..exports.points import of_report

        with stages("exports"):
            written += write_exports(of_report(data), folder, exports, stages.progress)
    data = dataclasses.replace(data, stages_s=dict(stages.seconds))
    offered = (folder, folder / FOLDER)
    files = ["metrics.json", *(path.relative_to(folder).as_posix() for path in written if path.parent in offered)]
    with stages("report"):
        page = write_file(folder / "report.html", html.page(data, files))
    data = dataclasses.replace(data, stages_s=dict(stages.seconds))
    numbers = write_file(folder / "metrics.json", json_text(metrics(data)))
    return WrittenReport(files=(page, *written, numbers), data=data)

"""The results folder of a report: page, figures, tables and metrics."""

from __future__ import annotations

import json
from pathlib import Path

from . import figures, html
from .data import ReportData
from .export import metrics, rank_frame, rss_frame, write_file


def write_report(data: ReportData, folder: str | Path) -> list[Path]:
    """Write the files of a report.

    Parameters
    ----------
    data : ReportData
    folder : path
        Empty; that of :meth:`aerpaw_cmp.common.outputs.OutputFolder.filling`, say.

    Returns
    -------
    list of Path
        ``report.html`` first, then ``metrics.json``, the CSVs (header only when they have no rows), the figures.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    from . import canvas

    folder = Path(folder)
    numbers = json.dumps(metrics(data), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    written = [write_file(folder / "metrics.json", numbers)]
    for name, frame in (("rss.csv", rss_frame(data.rss)), ("rank.csv", rank_frame(data.rank))):
        # written even without rows: a reader finds the same files in every report
        written.append(write_file(folder / name, frame.to_csv(index=False, lineterminator="\n")))
    drawn, pictures = canvas.write_plates(figures.plates(data), folder / "figures")
    written += pictures
    files = [str(path.relative_to(folder)) for path in written if path.parent == folder]
    page = write_file(folder / "report.html", html.page(data, drawn, files))
    return [page, *written]

"""The results folder of a report: page, figures, tables and metrics."""

from __future__ import annotations

import json
import re
from pathlib import Path

from . import figures, html
from .data import ReportData
from .export import make_folder, metrics, rank_frame, rss_frame, write_atomic

_OWN_FIGURES = re.compile(
    r"(trajectory|altitude|speed_against_error"
    r"|(rss|rss_check|rss_residual|rss_angles|pair|rank_(map|histogram|time|confusion|k))_[A-Za-z0-9._-]+)\.(svg|png)"
)


def remove_stale(folder: Path, kept: set[str], own: re.Pattern[str] = _OWN_FIGURES) -> None:
    """Remove figures of an earlier report that this one no longer has; other files are left alone."""
    for path in folder.glob("*"):
        if path.name not in kept and own.fullmatch(path.name):
            path.unlink()


def write_report(data: ReportData, folder: str | Path) -> list[Path]:
    """Write the whole report.

    Parameters
    ----------
    data : ReportData
    folder : path
        Made when missing. Files of an earlier report with the same names are replaced.

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
    make_folder(folder)
    numbers = json.dumps(metrics(data), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    written = [write_atomic(folder / "metrics.json", numbers)]
    for name, frame in (("rss.csv", rss_frame(data.rss)), ("rank.csv", rank_frame(data.rank))):
        # written even without rows, so that the table of an earlier report never stands beside this one
        written.append(write_atomic(folder / name, frame.to_csv(index=False, lineterminator="\n")))
    drawn, pictures = canvas.write_plates(figures.plates(data), folder / "figures")
    written += pictures
    remove_stale(folder / "figures", {path.name for path in written})
    files = [str(path.relative_to(folder)) for path in written if path.parent == folder]
    page = write_atomic(folder / "report.html", html.page(data, drawn, files))
    return [page, *written]

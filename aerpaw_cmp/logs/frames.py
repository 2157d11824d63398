"""Logs as data frames, for notebooks: ``read(path)`` gives one frame per stream."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from .ingest import Ingested, account_notes, ingest, summary
from .readers import ReadOptions


class Logs(dict[str, pd.DataFrame]):
    """Frames by the name of their stream, with the account of every file.

    ``frame.attrs`` holds what is true of a whole stream (node, channel, unit, frequency) and its ``reader``, ``file``
    and ``kind``. A name that several files use becomes ``<file>:<stream>`` for all of them.

    Parameters
    ----------
    files : Ingested
        As :func:`aerpaw_cmp.logs.ingest.ingest` gives them.

    Attributes
    ----------
    files : Ingested
        The records themselves, with rejected lines and warnings.
    """

    def __init__(self, files: Ingested) -> None:
        self.files = files
        streams = [(Path(file.path).name, file, stream) for file in files for stream in file.result.streams]
        names = [stream.name for _, _, stream in streams]
        frames: dict[str, pd.DataFrame] = {}
        for file_name, file, stream in streams:
            key = stream.name if names.count(stream.name) == 1 else f"{file_name}:{stream.name}"
            if key in frames:  # two files of one name in two folders
                key = f"{file.path}:{stream.name}"
            frame = stream.frame.copy(deep=False)
            frame.attrs = {
                **stream.attributes,
                "kind": stream.kind,
                "reader": file.result.reader,
                "file": file.path,
            }
            frames[key] = frame
        super().__init__(frames)

    @property
    def account(self) -> dict[str, Any]:
        """Lines accepted, rejected and blank of each file, and its streams: what ``ingest --json`` prints."""
        return summary(self.files)

    @property
    def notes(self) -> list[str]:
        """Rejected lines, warnings and files left out, one sentence each."""
        return account_notes(self.account)

    def __repr__(self) -> str:
        """One line per stream."""
        return "\n".join([f"Logs of {_count(len(self.files), 'file')}", *("  " + _line(k, v) for k, v in self.items())])

    def _repr_html_(self) -> str:
        """A table of streams for notebooks."""
        rows = "".join(
            f"<tr><td>{html.escape(name)}</td><td>{html.escape(str(frame.attrs['kind']))}</td>"
            f"<td>{html.escape(str(frame.attrs['reader']))}</td><td>{len(frame)}</td>"
            f"<td>{html.escape(Path(str(frame.attrs['file'])).name)}</td></tr>"
            for name, frame in self.items()
        )
        head = "".join(f"<th>{title}</th>" for title in ("stream", "kind", "reader", "records", "file"))
        return f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _line(name: str, frame: pd.DataFrame) -> str:
    return f"{name}: {frame.attrs['kind']}, {_count(len(frame), 'record')} ({frame.attrs['reader']})"


def read(
    path: str | Path | Sequence[str | Path],
    timezone: str | None = None,
    *,
    reader: str | None = None,
    time_origin: str | None = None,
    **options: Any,
) -> Logs:
    """Read logs of any known format into pandas frames.

    Parameters
    ----------
    path : path or sequence of paths
        Files and folders; a folder is searched to the bottom.
    timezone : str, optional
        IANA zone of clocks that show local time, such as ``"America/New_York"``.
    reader : str, optional
        Name of the reader (``aerpaw-cmp formats`` lists them) instead of finding it by content.
    time_origin : str, optional
        Instant of zero for logs with relative times.
    options
        Further fields of :class:`aerpaw_cmp.logs.readers.ReadOptions`.

    Returns
    -------
    Logs
        A dict ``{stream: DataFrame}``; columns as in :mod:`aerpaw_cmp.logs.records`, ``time`` in UTC.

    Raises
    ------
    InputError
        A file is missing, damaged or of no known format.
    UsageError
        An option is missing, such as ``timezone``.

    Examples
    --------
    >>> logs = read("sample_logs/UAV", timezone="America/New_York")  # doctest: +SKIP
    >>> logs["vehicle"].altitude_m.max()  # doctest: +SKIP
    """
    chosen = ReadOptions(timezone=timezone, time_origin=time_origin, **options)
    return Logs(ingest(path, options=chosen, reader=reader))

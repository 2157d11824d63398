"""Logs as data frames, for notebooks: ``read(path)`` returns one frame per stream."""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeAlias
from zoneinfo import ZoneInfo

import pandas as pd

from ..common.errors import InputError, from_python
from ..common.text import counted, html_table
from .flight_file import write_flight
from .ingest import Ingested, account_notes, ingest, summary
from .readers import ReadOptions, named_tower

# A file, a folder, or a pattern such as ``"logs/*.txt"``. ``~`` means the home folder.
Source: TypeAlias = str | os.PathLike[str]


_TOWERS = ("LW1", "LW2", "LW3", "LW4", "LW5")


@from_python
class Logs(dict[str, pd.DataFrame]):
    """The frames of logs by the name of their stream, with the account of every file.

    ``frame.attrs`` contains the attributes of the stream (node, channel, unit, frequency) and its ``reader``, ``file``
    and ``kind``. If a log does not name its node, the node is the tower that the path contains (``LW1/power.txt``). If
    several files have a stream of the same name, the keys are ``<file>:<stream>``, with the folder if necessary.

    Parameters
    ----------
    files : Ingested
        Result of :func:`aerpaw_cmp.logs.ingest.ingest`.

    Attributes
    ----------
    files : Ingested
        The records, with rejected lines and warnings.
    """

    def __init__(self, files: Ingested) -> None:
        self.files = files
        streams = [(Path(file.path).name, file, stream) for file in files for stream in file.result.streams]
        names = Counter(stream.name for _, _, stream in streams)
        alike = Counter((file_name, stream.name) for file_name, _, stream in streams)
        frames: dict[str, pd.DataFrame] = {}
        for file_name, file, stream in streams:
            place = file_name if alike[file_name, stream.name] == 1 else file.path
            key = stream.name if names[stream.name] == 1 else f"{place}:{stream.name}"
            frame = stream.frame.copy(deep=False)
            # add the zone, because records have naive times in UTC
            frame["time"] = pd.to_datetime(frame["time"]).dt.tz_localize("UTC")
            if stream.kind in ("rss", "rank") and (node := named_tower("/".join(Path(file.path).parts[-2:]), _TOWERS)):
                frame.attrs["node"] = node
            frame.attrs.update(stream.attributes)
            frame.attrs |= {"kind": stream.kind, "reader": file.result.reader, "file": file.path}
            frames[key] = frame
        super().__init__(frames)

    @property
    def account(self) -> dict[str, Any]:
        """The account of the lines of each file, and its streams, as printed by ``ingest --json``."""
        return summary(self.files)

    @property
    def notes(self) -> list[str]:
        """The rejected lines, warnings and skipped files, one sentence each."""
        return account_notes(self.account)

    def select(self, **wanted: Any) -> dict[str, pd.DataFrame]:
        """Return the frames whose attributes have the given values.

        Parameters
        ----------
        wanted
            Attributes of a stream, such as ``kind="rss"``, ``node="LW1"``, ``channel``, ``unit``, ``reader``, ``file``.

        Examples
        --------
        >>> logs.select(kind="rss", node="LW1")  # doctest: +SKIP
        """
        return {k: v for k, v in self.items() if all(v.attrs.get(name) == value for name, value in wanted.items())}

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write every stream with its account into a flight file (HDF5), which :func:`read` can read.

        Parameters
        ----------
        path : path
            Path such as ``flight.h5``; an existing file is replaced.
        """
        write_flight(Path(path).expanduser(), self.files)

    def __repr__(self) -> str:
        """Return a line per stream."""
        lines = (
            f"  {name}: {frame.attrs['kind']}, {counted(len(frame), 'record')} ({frame.attrs['reader']})"
            for name, frame in self.items()
        )
        return "\n".join([f"Logs of {counted(len(self.files), 'file')}", *lines])

    def _repr_html_(self) -> str:
        """Return a table of streams for notebooks."""
        rows = [
            (name, frame.attrs["kind"], frame.attrs["reader"], len(frame), Path(str(frame.attrs["file"])).name)
            for name, frame in self.items()
        ]
        return html_table(("stream", "kind", "reader", "records", "file"), rows)


@from_python
def read(
    path: Source | Iterable[Source], timezone: str | ZoneInfo | None = None, *, reader: str | None = None,
    time_origin: str | None = None, **options: Any,
) -> Logs:  # fmt: skip
    """Read logs of any known format into pandas frames.

    Parameters
    ----------
    path : path, pattern, or several of these
        Files and folders (searched recursively); ``~`` and ``"logs/*.txt"`` are expanded.
    timezone : str or ZoneInfo, optional
        IANA zone of clocks that show local time, such as ``"America/New_York"``.
    reader : str, optional
        Name of the reader (``aerpaw-cmp formats`` lists all readers). Default: detected by content.
    time_origin : str, optional
        Date and time at which the times of logs with relative times are zero.
    options
        Further fields of :class:`aerpaw_cmp.logs.readers.ReadOptions`.

    Returns
    -------
    Logs
        A dict ``{stream: DataFrame}`` with the columns of :mod:`aerpaw_cmp.logs.records`, ``time`` in UTC with its
        zone.

    Raises
    ------
    InputError
        If a file is missing, damaged or of an unknown format, or no file matches a pattern.
    UsageError
        If an option is missing, such as ``timezone``.

    Examples
    --------
    >>> logs = read("sample_logs/UAV", timezone="America/New_York")  # doctest: +SKIP
    >>> logs["vehicle"].altitude_m.max()  # doctest: +SKIP
    """
    zone = None if timezone is None else str(timezone)
    chosen = ReadOptions(timezone=zone, time_origin=time_origin, **options)
    if chosen.columns:
        reader = reader or "generic_csv"  # the same default as for --map
    files = Ingested()
    # a str is also a sequence, so test it first
    for source in [path] if isinstance(path, (str, os.PathLike)) else path:
        here = ingest(list(_matching(source)), options=chosen, reader=reader)
        files += here
        files.skipped += here.skipped
    return Logs(files)


def _matching(source: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield the path itself, or the paths that its pattern matches."""
    place = Path(source).expanduser()
    if place.exists() or not glob.has_magic(str(place)):
        yield place
        return
    matching = sorted(glob.glob(str(place), recursive=True))  # noqa: PTH207 - absolute patterns, which Path refuses
    if not matching:
        raise InputError("no file matches the pattern", expected="at least one log", path=str(source))
    yield from map(Path, matching)

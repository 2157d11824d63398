"""Every file that a report was made from, besides the logs: settings, site, antennas, elevation, reference powers.

Whatever text of the flight file or of the site file names a file is one (:mod:`aerpaw_cmp.common.inputs`).
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from ...common.errors import AerpawCmpError
from ...common.files import LARGEST_TABLE
from ...common.inputs import input_files, named_files
from ...common.outputs import file_digest
from ...common.provenance import trained_on
from ...flight.gains.memory import load_with_learned
from ...flight.settings import FlightFile
from ...report.flight_data import InputFile
from ...site.antenna.learned import read_table
from ...site.inputs import inputs_of_site, site_files


def other_inputs(
    settings: FlightFile, flight: Path, logs_root: Path | None = None, learned: Path | None = None
) -> tuple[InputFile, ...]:
    """The flight file, the site file and every file that either names, but for the logs.

    Parameters
    ----------
    settings : FlightFile
        As checked.
    flight : Path
        The flight file.
    logs_root : Path, optional
        Where logs and antenna files resolve besides the folder of the flight file.
    learned : Path, optional
        calibrated.yaml of ``report --with``.

    Returns
    -------
    tuple of InputFile
        Path as it is named (the packaged site: as the package names it), SHA-256, and as role the key that names it.
        They have no lines to account for.
    """
    content = settings.model_dump(exclude={"logs"})
    roots = [flight.parent] if logs_root is None else [logs_root, flight.parent]
    entries = {os.path.realpath(flight): _entry(flight.name, flight, "flight file")}
    if learned is not None:
        entries[os.path.realpath(learned)] = _entry(learned.name, learned, "learned settings")
    for key, text, place in named_files(content, roots):
        if key != "site.file":
            entries.setdefault(os.path.realpath(place), _entry(text, place, key))
    for text, role, place in site_files(settings.site.file, flight.parent):
        entries.setdefault(os.path.realpath(place), _entry(text, place, role))
    return tuple(entries.values())


def inputs_of_flight(settings: FlightFile, flight: Path, logs_root: Path | None = None) -> list[Path]:
    """Every file that a flight is read from, its site's too: no output may replace one."""
    return [*input_files(settings, flight, logs_root), *inputs_of_site(settings.site.file, flight.parent)]


def inputs_of_flights(flights: Iterable[Path], logs_root: Path | None = None) -> list[Path]:
    """Inputs of several flight files; of one that is wrong the file alone."""
    files: list[Path] = []
    for flight in flights:
        files.append(flight)
        with suppress(AerpawCmpError, OSError):
            files += inputs_of_flight(load_with_learned(flight), flight, logs_root)
    return files


def stamp(path: Path) -> tuple[int, int]:
    """Size and time of a file: a worker that lives for days must see that it was changed; zeros where there is none."""
    try:
        status = os.stat(path)  # noqa: PTH116
    except OSError:
        return 0, 0
    return status.st_size, status.st_mtime_ns


def digest_of(place: Path) -> str:
    """SHA-256 of a file, computed once for its size and time: a campaign asks with every task."""
    return _digest(place, *stamp(place))


@lru_cache(maxsize=1024)
def _digest(place: Path, _size: int, _mtime_ns: int) -> str:
    return file_digest(place)


@lru_cache(maxsize=1024)
def _learned_on(place: Path, size: int, _mtime_ns: int) -> tuple[str, ...]:
    """SHA-256 of the logs that a file says it was learned from."""
    if size > LARGEST_TABLE:
        return ()
    return trained_on(read_table(place, "an input").decode("utf-8", errors="replace"))


def _entry(name: str, place: Path, role: str) -> InputFile:
    return InputFile(path=name, sha256=digest_of(place), role=role, learned_on=_learned_on(place, *stamp(place)))

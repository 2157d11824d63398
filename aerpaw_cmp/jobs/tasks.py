"""Inputs of a task of a campaign or a map, and its stored outcomes.

The inputs are all files from which a report was made: logs, settings, site, antennas, elevation, reference powers.
Every value of a flight file or a site file that names a file is an input (:mod:`aerpaw_cmp.common.yamlfile`). An
outcome is stored under a digest of its inputs, so no finished task is computed twice.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict, TypeAdapter
from pydantic_core import to_json

from ..common.content import trained_on
from ..common.errors import AerpawCmpError, InputError, UsageError, parsing
from ..common.files import LARGEST_TABLE, read_sealed, write_sealed
from ..common.outputs import file_digest
from ..common.units import AnyArray
from ..common.versions import code_digest
from ..common.yamlfile import input_files, named_files
from ..flight.gains import load_with_learned
from ..flight.settings import FlightFile
from ..report.flight_data import InputFile
from ..site.learned import read_table
from ..site.siteyaml import inputs_of_site, site_files


def other_inputs(
    settings: FlightFile, flight: Path, logs_root: Path | None = None, learned: Path | None = None
) -> tuple[InputFile, ...]:
    """Return the flight file, the site file and every file that either names, except the logs.

    Parameters
    ----------
    settings : FlightFile
        The checked settings.
    flight : Path
        The flight file.
    logs_root : Path, optional
        Folder to which relative paths of logs and antenna files may also refer, besides the folder of the flight file.
    learned : Path, optional
        calibrated.yaml of ``report --with``.

    Returns
    -------
    tuple of InputFile
        Path as written, SHA-256, and as role the key that names the file. The lines of these files are not counted.
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
    """Return every file from which a flight and its site are read. No output may replace such a file."""
    return [*input_files(settings, flight, logs_root), *inputs_of_site(settings.site.file, flight.parent)]


def inputs_of_flights(flights: Iterable[Path], logs_root: Path | None = None) -> list[Path]:
    """Return the inputs of several flight files. If a flight file is wrong, return only its own path."""
    files: list[Path] = []
    for flight in flights:
        files.append(flight)
        with suppress(AerpawCmpError, OSError):
            files += inputs_of_flight(load_with_learned(flight), flight, logs_root)
    return files


def stamp(path: Path) -> tuple[int, int]:
    """Return size and time of a file, by which a long-lived worker detects changes. Both are 0 if there is no file."""
    try:
        status = os.stat(path)  # noqa: PTH116
    except OSError:
        return 0, 0
    return status.st_size, status.st_mtime_ns


def digest_of(place: Path) -> str:
    """Return the SHA-256 of a file, cached by size and time, because every task of a campaign needs it."""
    return _digest(place, *stamp(place))


@lru_cache(maxsize=1024)
def _digest(place: Path, _size: int, _mtime_ns: int) -> str:
    return file_digest(place)


@lru_cache(maxsize=1024)
def _learned_on(place: Path, size: int, _mtime_ns: int) -> tuple[str, ...]:
    """Return the SHA-256 of the logs that a file lists as its training data."""
    if size > LARGEST_TABLE:
        return ()
    return trained_on(read_table(place, "an input").decode("utf-8", errors="replace"))


def _entry(name: str, place: Path, role: str) -> InputFile:
    return InputFile(path=name, sha256=digest_of(place), role=role, learned_on=_learned_on(place, *stamp(place)))


# Version of the format of entries. Increase it if the format changes.
LAYOUT = 8

_SEAL = b"aerpaw-cmp outcome"


class OutcomeStore:
    """A store of records by key: files ``<key>.npz``, each sealed with the digest of its content.

    Parameters
    ----------
    folder : Path
        It is created when the first entry is written.
    kind : type
        Dataclass of an outcome. Entries are checked against its fields, and no other class is built from a file.

    Attributes
    ----------
    warnings : list of str
        Damaged entries that were not used.
    """

    def __init__(self, folder: Path, kind: type) -> None:
        self.folder = folder
        # wrap the class in a list, because pydantic does not accept a configuration for a dataclass
        self._kind = TypeAdapter(list[kind], config=ConfigDict(arbitrary_types_allowed=True, extra="forbid"))  # type: ignore[valid-type]
        self.warnings: list[str] = []

    def check(self) -> None:
        """Raise UsageError before the first task if the folder cannot be written."""
        probe = self.folder / f".probe-{os.getpid()}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise UsageError(
                f"task results cannot be stored in {self.folder}: {error.strerror or error}",
                expected="a writable folder",
                cause="a disk that is full or read-only, or a file in the way",
            ) from None

    def load(self, key: str) -> Any | None:
        """Return the outcome of a key, or None if there is no intact entry."""
        file = self.folder / f"{key}.npz"
        try:
            content = read_sealed(file, _SEAL)
        except ValueError:
            self.warnings.append(f"a damaged outcome was not used; its task is computed again: {file}")
            return None
        if content is None:
            return None
        try:
            # do not allow pickles: in a shared folder, they could run code of another user
            with parsing(file, any_shape=True), np.load(io.BytesIO(content), allow_pickle=False) as parts:
                arrays = {name: parts[name] for name in parts.files}
                outcome = json.loads(
                    arrays["content"].tobytes(),
                    object_hook=lambda part: arrays[part[_ARRAY]] if _ARRAY in part else part,
                )
                return self._kind.validate_python([outcome])[0]
        except InputError:
            self.warnings.append(f"an outcome that this tool did not write was not used: {file}")
            return None

    def save(self, key: str, outcome: Any) -> None:
        """Write an entry atomically. If the disk cannot be written, store nothing and do not fail."""
        arrays = _Arrays()
        text = to_json(outcome, fallback=arrays.plain, inf_nan_mode="constants")
        content = np.frombuffer(text, dtype=np.uint8)
        entry = io.BytesIO()
        np.savez(entry, content=content, **arrays.by_name)  # type: ignore[arg-type]
        write_sealed(self.folder / f"{key}.npz", entry.getvalue(), _SEAL)


# Key that marks the name of an array in the JSON.
_ARRAY = "array of the entry"


class _Arrays:
    """Arrays by name.

    Equal arrays are stored once, which halves the size: channels of a tower share times and positions.
    """

    def __init__(self) -> None:
        self.by_name: dict[str, AnyArray] = {}
        self._names: dict[tuple[str, tuple[int, ...], bytes], str] = {}

    def plain(self, value: Any) -> Any:
        """Return the name of an array instead of the array, and a number of NumPy as a number of Python."""
        if not isinstance(value, np.ndarray):
            return value.item()
        if value.dtype.hasobject:  # NumPy would pickle objects
            raise TypeError("an outcome cannot contain arrays of objects")
        name = self._names.setdefault((value.dtype.str, value.shape, value.tobytes()), f"a{len(self._names)}")
        self.by_name[name] = value
        return {_ARRAY: name}


# Settings that do not affect the outcome of a task: names, the plan of a simulation, pages, the audit.
_WITHOUT_EFFECT: dict[str, Any] = {"flight": True, "report": True, "rt": {"audit_links"}}


def task_inputs(settings: FlightFile, flight: Path, logs_root: Path | None) -> list[dict[str, str]]:
    """Return role, path and SHA-256 of every file that an outcome depends on, logs last.

    Raises
    ------
    OSError
        If a log cannot be read.
    UsageError
        If the site cannot be read.
    """
    entries = [
        {"role": other_input.role, "path": other_input.path, "sha256": other_input.sha256}
        for other_input in other_inputs(settings, flight, logs_root)
        if other_input.role != "flight file"  # the content of the flight file is in the settings, with overrides
    ]
    for log in settings.logs:
        path = (logs_root or flight.parent) / log.path
        entries.append({"role": "log", "path": log.path, "sha256": digest_of(path)})
    return entries


def task_key(settings: FlightFile, inputs: Iterable[Mapping[str, str]], *more: object) -> str:
    """Return the digest of everything that affects an outcome: settings, content of inputs, code, and ``more``.

    Labels are not part of the digest, so a flight or setting with a new name keeps its stored outcomes.
    """
    digest = hashlib.sha256()
    digest.update("\n".join([str(LAYOUT), code_digest(), *map(str, more)]).encode())
    digest.update(settings.model_dump_json(exclude=_WITHOUT_EFFECT).encode())
    for entry in inputs:
        digest.update(f"{entry['role']} {entry['sha256']}\n".encode())
    return digest.hexdigest()

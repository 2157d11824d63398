"""Outcomes of a campaign's tasks, kept on disk by what they depend on: nothing finished is computed twice."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import os
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ..common.files import read_sealed, write_sealed
from ..common.outputs import file_digest
from ..flight.settings import FlightFile
from .manifest import other_inputs

LAYOUT = 1
"""Raised whenever the form of an entry changes."""

_SEAL = b"aerpaw-cmp outcome"


class OutcomeStore:
    """Results of tasks as ``<sha256>.npz`` in one folder, each sealed by the digest of its content.

    Parameters
    ----------
    folder : Path
        Made when the first entry is saved.
    types : iterable of type
        Frozen dataclasses that an entry may hold (:func:`records_of`); nothing else is ever built from a file.

    Attributes
    ----------
    told : list of str
        Damaged entries that were not used.
    """

    def __init__(self, folder: Path, types: Iterable[type]) -> None:
        self.folder = folder
        self._types = {kind.__name__: kind for kind in types}
        self.told: list[str] = []

    def load(self, key: str) -> Any | None:
        """The outcome of a key, or None where there is no sound entry."""
        place = self.folder / f"{key}.npz"
        try:
            entry = read_sealed(place, _SEAL)
        except ValueError:
            self.told.append(f"a damaged outcome was not used, its task is computed anew: {place}")
            return None
        if entry is None:
            return None
        with np.load(io.BytesIO(entry), allow_pickle=False) as arrays:
            return self._decode(json.loads(str(arrays["content"])), arrays)

    def _knows(self, value: Any) -> bool:
        """Whether :meth:`load` could give a record back."""
        return self._types.get(type(value).__name__) is type(value)

    def save(self, key: str, outcome: Any) -> None:
        """Write an entry whole or not at all; a folder that cannot be written costs the entry, not the run."""
        arrays: dict[str, Any] = {}
        content = json.dumps(self._encode(outcome, arrays))
        entry = io.BytesIO()
        np.savez_compressed(entry, content=np.array(content), **arrays)
        write_sealed(self.folder / f"{key}.npz", entry.getvalue(), _SEAL)

    def __contains__(self, key: str) -> bool:
        return (self.folder / f"{key}.npz").is_file()

    def _encode(self, value: Any, arrays: dict[str, Any]) -> Any:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            if not self._knows(value):
                raise TypeError(f"{type(value).__name__} is no record that an outcome may hold")
            fields = {f.name: self._encode(getattr(value, f.name), arrays) for f in dataclasses.fields(value) if f.init}
            return {"is": type(value).__name__, "of": fields}
        if isinstance(value, np.ndarray):
            name = f"a{len(arrays)}"
            arrays[name] = value
            return {"is": "array", "of": name}
        if isinstance(value, (tuple, list)):
            return {"is": type(value).__name__, "of": [self._encode(item, arrays) for item in value]}
        if isinstance(value, Mapping):
            pairs = [[self._encode(k, arrays), self._encode(v, arrays)] for k, v in value.items()]
            return {"is": "dict", "of": pairs}
        return value.item() if isinstance(value, np.generic) else value

    def _decode(self, value: Any, arrays: Any) -> Any:
        if not isinstance(value, dict):
            return value
        kind, content = value["is"], value["of"]
        if kind == "array":
            return arrays[content]
        if kind in ("tuple", "list"):
            items = [self._decode(item, arrays) for item in content]
            return tuple(items) if kind == "tuple" else items
        if kind == "dict":
            return {self._decode(k, arrays): self._decode(v, arrays) for k, v in content}
        return self._types[kind](**{name: self._decode(item, arrays) for name, item in content.items()})


def records_of(*modules: ModuleType) -> set[type]:
    """The dataclasses that some modules define."""
    return {
        kind
        for module in modules
        for kind in vars(module).values()
        if isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind.__module__ == module.__name__
    }


def task_key(settings: FlightFile, flight: Path, logs_root: Path | None, *more: object) -> str:
    """Digest of what an outcome depends on: checked settings, content of every file, code, and ``more``.

    Raises
    ------
    OSError
        If a log cannot be read.
    UsageError
        If the site cannot.
    """
    digest = hashlib.sha256()
    digest.update("\n".join([str(LAYOUT), code_digest(), *map(str, more)]).encode())
    digest.update(settings.model_dump_json().encode())
    for one in other_inputs(settings, flight, logs_root):
        if one.role != "flight file":  # what it says stands in the settings, overrides included
            digest.update(f"{one.role} {one.sha256}\n".encode())
    for log in settings.logs:
        digest.update(_content((logs_root or flight.parent) / log.path).encode())
    return digest.hexdigest()


def _content(path: Path) -> str:
    found = os.stat(path)  # noqa: PTH116  the times make the key of the cache
    return _digest_of(path, found.st_size, found.st_mtime_ns)


@cache
def _digest_of(path: Path, _size: int, _mtime_ns: int) -> str:
    return file_digest(path)


@cache
def code_digest() -> str:
    """Digest of this package's source and of the versions of what it computes with."""
    digest = hashlib.sha256()
    for name in ("aerpaw_cmp", "aerpaw_parsers"):
        with contextlib.suppress(ImportError):
            root = Path(str(import_module(name).__file__)).parent
            for path in sorted(root.rglob("*.py")):
                digest.update(path.read_bytes())
    for name in ("numpy", "scipy", "sionna-rt"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            digest.update(f"{name} {metadata.version(name)}".encode())
    return digest.hexdigest()

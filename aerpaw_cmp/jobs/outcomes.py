"""Outcomes of a campaign's tasks, kept by what they depend on: nothing finished is computed twice."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import math
import os
import re
import zipfile
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ..common.files import seal, unseal
from ..common.units import AnyArray
from ..flight.settings import FlightFile
from .manifest import digest_of, other_inputs
from .place import Place, open_place

LAYOUT = 4
"""Raised whenever the form of an entry changes."""

_SEAL = b"aerpaw-cmp outcome"

_TORN = (OSError, EOFError, RecursionError, zipfile.BadZipFile)

READERS = "aerpaw_cmp.readers"
"""Entry points of readers: those of other packages count with their version."""


class OutcomeStore:
    """Results of tasks by key: ``<key>.npz``, sealed by the digest of its content, and ``<key>.json``, its manifest.

    Parameters
    ----------
    place : Place or Path
        A folder or an object store.
    types : iterable of type
        Frozen dataclasses that an entry may hold (:func:`records_of`); nothing else is ever built from a file.

    Attributes
    ----------
    warnings : list of str
        Damaged entries that were not used.
    """

    def __init__(self, place: Place | Path, types: Iterable[type]) -> None:
        self.place = open_place(place) if isinstance(place, Path) else place
        self._types = {kind.__name__: kind for kind in types}
        self.warnings: list[str] = []

    def load(self, key: str) -> Any | None:
        """The outcome of a key, or None where there is no sound entry."""
        entry = self.place.read(f"{key}.npz")
        if entry is None:
            return None
        try:
            content = unseal(entry, _SEAL)
        except ValueError:
            self.warnings.append(
                f"a damaged outcome was not used, its task is computed anew: {self.place.url}/{key}.npz"
            )
            return None
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as parts:
                return self._decode(json.loads(parts["content"].tobytes()), _Packed(parts["arrays"]))
        except (ValueError, LookupError, TypeError, ArithmeticError, AttributeError, *_TORN):
            self.warnings.append(f"an outcome that this tool did not write was not used: {self.place.url}/{key}.npz")
            return None

    def _knows(self, value: Any) -> bool:
        """Whether :meth:`load` could give a record back."""
        return self._types.get(type(value).__name__) is type(value)

    def save(self, key: str, outcome: Any, manifest: Mapping[str, Any] | None = None) -> bool:
        """Write an entry whole or not at all, then its manifest; False where the place does not take it."""
        packed = _Packed()
        content = np.frombuffer(json.dumps(self._encode(outcome, packed)).encode(), dtype=np.uint8)
        entry = io.BytesIO()
        np.savez(entry, content=content, arrays=packed.bytes())
        sealed = seal(entry.getvalue(), _SEAL)
        try:
            self.place.write(f"{key}.npz", sealed)
            if manifest is not None:
                whole = {**manifest, "sha256": hashlib.sha256(sealed).hexdigest(), "bytes": len(sealed)}
                self.place.write(f"{key}.json", _text(whole))
        except OSError:
            return False
        self.place.remove(f"{key}.failed.json")
        return True

    def save_failure(self, key: str, manifest: Mapping[str, Any]) -> None:
        """Remember that a task failed, and how; it is never taken for an outcome."""
        with contextlib.suppress(OSError):
            self.place.write(f"{key}.failed.json", _text(manifest))

    def manifests(self, keys: Iterable[str], *, failed: bool = False) -> dict[str, dict[str, Any]]:
        """What stands beside the outcomes (or failures) of some keys, where it can be read."""
        end = ".failed.json" if failed else ".json"
        contents = {}
        for name, content in self.place.read_many(f"{key}{end}" for key in keys).items():
            with contextlib.suppress(ValueError):
                contents[name.removesuffix(end)] = json.loads(content)
        return contents

    def keys(self) -> tuple[set[str], set[str]]:
        """Keys that have an outcome, and keys that failed the last time."""
        names = self.place.names()
        kept = {name.removesuffix(".npz") for name in names if name.endswith(".npz")}
        return kept, {name.removesuffix(".failed.json") for name in names if name.endswith(".failed.json")}

    def sound(self, key: str) -> bool:
        """Whether there is an outcome that :meth:`load` could take."""
        entry = self.place.read(f"{key}.npz")
        if entry is None:
            return False
        with contextlib.suppress(ValueError):
            unseal(entry, _SEAL)
            return True
        return False

    def _encode(self, value: Any, arrays: _Packed) -> Any:
        if value is None or type(value) in _AS_THEY_ARE:
            return value
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            if not self._knows(value):
                raise TypeError(f"{type(value).__name__} is no record that an outcome may hold")
            fields = {name: self._encode(getattr(value, name), arrays) for name in _field_names(type(value))}
            return {"is": type(value).__name__, "of": fields}
        if isinstance(value, np.ndarray):
            if value.dtype.hasobject:
                raise TypeError("an outcome holds no arrays of objects")
            return {"is": "array", "of": arrays.put(value)}
        if isinstance(value, (tuple, list)):
            return {"is": type(value).__name__, "of": [self._encode(item, arrays) for item in value]}
        if isinstance(value, Mapping):
            pairs = [[self._encode(k, arrays), self._encode(v, arrays)] for k, v in value.items()]
            return {"is": "dict", "of": pairs}
        return value.item() if isinstance(value, np.generic) else value

    def _decode(self, value: Any, arrays: _Packed) -> Any:
        if not isinstance(value, dict):
            return value
        kind, content = value["is"], value["of"]
        if kind == "array":
            return arrays.get(content["from"], content["kind"], tuple(content["shape"]))
        if kind in ("tuple", "list"):
            items = [self._decode(item, arrays) for item in content]
            return tuple(items) if kind == "tuple" else items
        if kind == "dict":
            return {self._decode(k, arrays): self._decode(v, arrays) for k, v in content}
        fields = {name: self._decode(item, arrays) for name, item in content.items()}
        for field in dataclasses.fields(self._types[kind]):
            if field.name in fields and not _may_be(fields[field.name], str(field.type)):
                raise TypeError(f"{kind}.{field.name} is no {field.type}")
        return self._types[kind](**fields)


_KINDS: dict[str, type | tuple[type, ...]] = {
    "float": (int, float), "int": int, "str": str, "bool": bool, "tuple": tuple, "dict": dict, "Mapping": dict,
    "AnyArray": np.ndarray, "FloatArray": np.ndarray, "IntArray": np.ndarray, "BoolArray": np.ndarray,
}  # fmt: skip


def _may_be(value: Any, annotation: str) -> bool:
    """Whether a value can stand in a field: a forged entry must not fail where its numbers are used."""
    kinds = [_KINDS.get(part.strip().split("[")[0]) for part in re.split(r"\|(?![^\[]*\])", annotation)]
    if value is None:
        return "None" in annotation or None in kinds
    return None in kinds or any(isinstance(value, kind) for kind in kinds if kind is not None)


class _Packed:
    """Arrays one after the other, each once: channels of a tower share times and places, half of all that is kept.

    Parameters
    ----------
    content : (bytes,) uint8, optional
        As :meth:`bytes` gave it.
    """

    def __init__(self, content: AnyArray | None = None) -> None:
        self._content = content
        self._parts: list[bytes] = []
        self._size = 0
        self._known: dict[Any, Any] = {}

    def put(self, array: AnyArray) -> dict[str, Any]:
        """Where an array lies."""
        raw = np.ascontiguousarray(array).tobytes()
        start = self._known.setdefault(raw, self._size)
        if start == self._size and raw:
            self._parts.append(raw)
            self._size += len(raw)
        return {"from": start, "kind": array.dtype.str, "shape": array.shape}

    def bytes(self) -> AnyArray:
        """All of them."""
        return np.frombuffer(b"".join(self._parts), dtype=np.uint8)

    def get(self, start: int, kind: str, shape: tuple[int, ...]) -> AnyArray:
        """The array that was put; the same one for those that were equal."""
        count = math.prod(shape)
        if self._content is None or not count:
            return np.zeros(shape, dtype=kind)
        key = (start, kind, shape)
        if key not in self._known:
            size = count * np.dtype(kind).itemsize
            self._known[key] = self._content[start : start + size].copy().view(kind).reshape(shape)
        array: AnyArray = self._known[key]
        return array


_AS_THEY_ARE = frozenset({str, int, float, bool})


@cache
def _field_names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind) if field.init)


def _text(manifest: Mapping[str, Any]) -> bytes:
    """A manifest as JSON, a line per entry: indented, it would cost as much as all else that keeps an outcome."""
    lines = [f"{json.dumps(str(key))}: {json.dumps(value, default=str)}" for key, value in manifest.items()]
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def records_of(*modules: ModuleType) -> set[type]:
    """The dataclasses that some modules define."""
    return {
        kind
        for module in modules
        for kind in vars(module).values()
        if isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind.__module__ == module.__name__
    }


_WITHOUT_EFFECT: dict[str, Any] = {"flight": True, "report": True, "rt": {"audit_links": True, "advanced": {"cache"}}}
"""Settings that a campaign's outcome does not depend on: names, the plan of a simulation, pages, the audit, caches."""


def task_inputs(settings: FlightFile, flight: Path, logs_root: Path | None) -> list[dict[str, str]]:
    """Role, path and SHA-256 of every file that an outcome depends on, logs last.

    Raises
    ------
    OSError
        If a log cannot be read.
    UsageError
        If the site cannot.
    """
    entries = [
        {"role": one.role, "path": one.path, "sha256": one.sha256}
        for one in other_inputs(settings, flight, logs_root)
        if one.role != "flight file"  # what it says stands in the settings, overrides included
    ]
    for log in settings.logs:
        path = (logs_root or flight.parent) / log.path
        entries.append({"role": "log", "path": log.path, "sha256": _content(path)})
    return entries


def task_key(settings: FlightFile, inputs: Iterable[Mapping[str, str]], *more: object) -> str:
    """Digest of what an outcome depends on: settings that matter, content of every input, code, and ``more``.

    Labels do not: a flight or a setting that gets another name keeps its outcomes.
    """
    digest = hashlib.sha256()
    digest.update("\n".join([str(LAYOUT), code_digest(), *map(str, more)]).encode())
    digest.update(settings.model_dump_json(exclude=_WITHOUT_EFFECT).encode())
    for one in inputs:
        digest.update(f"{one['role']} {one['sha256']}\n".encode())
    return digest.hexdigest()


def _content(path: Path) -> str:
    status = os.stat(path)  # noqa: PTH116  the times make the key of the cache
    return digest_of(path, status.st_size, status.st_mtime_ns)


_ROOMS_ASIDE = ("cli/", "live/", "maps/", "report/", "__main__.py")
_BUT = ("report/__init__.py", "report/against.py", "report/campaign_data.py", "report/data.py")


def shapes_numbers(module: str) -> bool:
    """Whether a file of the package (path below it, with /) can change a campaign's outcome.

    Pages, the tap, maps and the command line cannot; ``tests/jobs/test_outcomes.py`` holds that no task loads them.
    """
    return module in _BUT or not module.startswith(_ROOMS_ASIDE)


@cache
def code_digest() -> str:
    """Digest of the source that a task runs and of the versions of what it computes with."""
    digest = hashlib.sha256()
    for name in ("aerpaw_cmp", "aerpaw_parsers"):
        with contextlib.suppress(ImportError):
            root = Path(str(import_module(name).__file__)).parent
            modules = sorted(path.relative_to(root).as_posix() for path in root.rglob("*.py"))
            for module in filter(shapes_numbers if name == "aerpaw_cmp" else None, modules):
                digest.update(module.encode() + b"\0" + (root / module).read_bytes())
    for name in ("numpy", "scipy", "sionna-rt"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            digest.update(f"{name} {metadata.version(name)}".encode())
    for plugin in sorted({str(p.dist and (p.dist.name, p.dist.version)) for p in metadata.entry_points(group=READERS)}):
        digest.update(plugin.encode())
    return digest.hexdigest()

"""Zip and tar archives as folders of logs: members are read as streams, bounded, and never written to disk.

A member is named like a file in a folder: ``dataset.zip/LW1/power_log.txt``.
"""

from __future__ import annotations

import io
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

from ..common.errors import InputError

MOST_MEMBERS = 100_000
MOST_BYTES = 2**31
"""Of one member after decompression."""
MOST_IN_ALL = 2**35
"""Of all members together."""
_ZIP = (b"PK\x03\x04", b"PK\x05\x06")
_TAR = b"ustar"
_MARGIN = 2**20
_RATIO = 1200
"""Deflate makes a file at most 1032 times smaller: what claims more lies."""


def is_archive(head: bytes) -> bool:
    """Whether the first bytes of a file (gunzipped or not) are those of an archive."""
    return head.startswith(_ZIP) or head[257:262] == _TAR


def inside(path: Path) -> tuple[Path, str] | None:
    """The archive and the member that a path names; None where no part of it is a file."""
    for parent in path.parents:
        try:
            if parent.is_file():
                return parent, path.relative_to(parent).as_posix()
        except (OSError, ValueError):
            return None
    return None


def members(data: bytes, path: str | Path) -> Iterator[tuple[str, Callable[[], bytes]]]:
    """Names of the files in an archive, in order, and what reads each.

    Raises
    ------
    InputError
        If the archive is damaged, or holds or unpacks to more than a data set can; also from the callables.
    """
    try:
        yield from _zip(data, path) if data.startswith(_ZIP) else _tar(data, path)
    except (zipfile.BadZipFile, tarfile.TarError, zlib.error, EOFError, OSError, NotImplementedError) as error:
        raise InputError(f"a damaged archive ({error})", cause="a cut download", path=path) from error


def _hidden(name: str) -> bool:
    return any(part.startswith(".") or part == "__MACOSX" for part in name.split("/"))


def _zip(data: bytes, path: str | Path) -> Iterator[tuple[str, Callable[[], bytes]]]:
    book = zipfile.ZipFile(io.BytesIO(data))
    members = [one for one in book.infolist() if not one.is_dir() and not _hidden(one.filename)]
    _check(len(members), sum(one.file_size for one in members), path)
    for one in sorted(members, key=lambda one: one.filename):
        yield one.filename, lambda one=one: _unzipped(book, one, path)  # type: ignore[misc]


def _unzipped(book: zipfile.ZipFile, one: zipfile.ZipInfo, path: str | Path) -> bytes:
    place = f"{path}/{one.filename}"
    if one.file_size > MOST_BYTES or one.file_size > _RATIO * one.compress_size + _MARGIN:
        raise InputError(
            f"the member unpacks to {one.file_size} bytes", expected=f"at most {MOST_BYTES}", cause="no log", path=place
        )
    try:
        with book.open(one) as stream:
            content = stream.read(one.file_size + 1)
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError) as error:
        raise InputError(f"a damaged or locked member ({error})", cause="a cut download", path=place) from error
    if len(content) > one.file_size:
        raise InputError("the member is larger than the archive says", cause="no log", path=place)
    return content


def _tar(data: bytes, path: str | Path) -> Iterator[tuple[str, Callable[[], bytes]]]:
    book = tarfile.open(fileobj=io.BytesIO(data), mode="r:")  # noqa: SIM115 - members are read later
    members = [one for one in book.getmembers() if one.isreg() and not _hidden(one.name)]
    _check(len(members), sum(one.size for one in members), path)
    for one in sorted(members, key=lambda one: one.name):
        yield one.name, lambda one=one: _untarred(book, one)  # type: ignore[misc]


def _untarred(book: tarfile.TarFile, one: tarfile.TarInfo) -> bytes:
    stream = book.extractfile(one)
    return stream.read() if stream is not None else b""


def _check(count: int, total: int, path: str | Path) -> None:
    if count > MOST_MEMBERS:
        raise InputError(f"the archive holds {count} files", expected=f"at most {MOST_MEMBERS}", path=path)
    if total > MOST_IN_ALL:
        raise InputError(f"the archive unpacks to {total} bytes", expected=f"at most {MOST_IN_ALL}", path=path)

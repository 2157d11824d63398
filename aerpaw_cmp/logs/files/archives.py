"""Zip and tar archives as folders of logs: members are read as streams, bounded, and never written to disk.

A member is named like a file in a folder: ``dataset.zip/LW1/power_log.txt``.
"""

from __future__ import annotations

import io
import lzma
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from os.path import isfile
from pathlib import Path

from ...common.errors import InputError

# A flight of half an hour with a burst every 0.1 s has 18 000.
MOST_MEMBERS = 20_000
# Of one member after decompression.
MOST_BYTES = 2**31
# Of all members together.
_MOST_IN_ALL = 2**35
# Of all members together to the archive, beyond ``_FREE_BYTES``: logs shrink to a fifth, the most even to a 50th.
MOST_RATIO = 100
_ZIP = (b"PK\x03\x04", b"PK\x05\x06")
_TAR = b"ustar"
_MARGIN = 2**20
_FREE_BYTES = 2**28
# Deflate makes a file at most 1032 times smaller: what claims more lies.
_RATIO = 1200
# What Python's libraries raise for damaged archives; a ValueError for a directory that begins before the file does.
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, OSError, ValueError, IndexError,
    OverflowError, NotImplementedError,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Member:
    """A file of an archive.

    Parameters
    ----------
    name : str
        Relative, whatever the archive says.
    size : int
        After decompression, as the archive says [bytes].
    read : callable
        Content, all of it or at most so many bytes.
    """

    name: str
    size: int
    read: Callable[[int | None], bytes]


def is_archive(head: bytes) -> bool:
    """Check whether the first bytes of a file (gunzipped or not) are those of an archive."""
    # the mark of POSIX tar stands behind 257 bytes of the first header
    return head.startswith(_ZIP) or head[257:262] == _TAR


def inside(path: Path) -> tuple[Path, str] | None:
    """The archive and the member that a path names; None where no part of it is a file."""
    # Path's own test raises for a name that is too long
    file = next((parent for parent in path.parents if isfile(parent)), None)  # noqa: PTH113
    return None if file is None else (file, path.relative_to(file).as_posix())


def members(data: bytes, path: str | Path) -> dict[str, Member]:
    """Files of an archive by their names, in order.

    Raises
    ------
    InputError
        If the archive is damaged, or holds or unpacks to more than a data set can; also from a member's ``read``.
    """
    try:
        entries = list(_zip(data, path) if data.startswith(_ZIP) else _tar(data, path))
    except (*_DAMAGE, tarfile.TarError) as error:
        raise InputError(f"a damaged archive ({error})", cause="a cut download", path=path) from error
    _check(entries, len(data), path)
    return {member.name: member for member in sorted(entries, key=lambda member: member.name)}


def _hidden(name: str) -> bool:
    return any((part.startswith(".") and part != "..") or part == "__MACOSX" for part in name.split("/"))


def _zip(data: bytes, path: str | Path) -> Iterator[Member]:
    book = zipfile.ZipFile(io.BytesIO(data))
    for entry in book.infolist():
        if not entry.is_dir() and not _hidden(entry.filename):
            size = entry.file_size
            # deflate cannot do it: the directory lies
            lies = size > MOST_BYTES or size > _RATIO * entry.compress_size + _MARGIN
            read = (
                partial(_refused, f"the member unpacks to {size} bytes", f"at most {MOST_BYTES}", path)
                if lies
                else partial(_unzipped, book, entry, path)
            )
            yield _member(entry.filename, 0 if lies else size, path, read)


def _unzipped(book: zipfile.ZipFile, entry: zipfile.ZipInfo, path: str | Path, most: int | None) -> bytes:
    place = f"{path}/{entry.filename}"
    try:
        with book.open(entry) as stream:
            # one byte more than is said shows a lie
            content = stream.read(entry.file_size + 1 if most is None else most)
    except (*_DAMAGE, RuntimeError) as error:
        raise InputError(f"a damaged or locked member ({error})", cause="a cut download", path=place) from error
    if len(content) > entry.file_size:
        raise InputError("the member is larger than the archive says", cause="no log", path=place)
    return content


def _tar(data: bytes, path: str | Path) -> Iterator[Member]:
    # "r:": no compression, which would be unpacked without a limit
    book = tarfile.open(fileobj=io.BytesIO(data), mode="r:")  # noqa: SIM115 - members are read later
    for entry in book.getmembers():
        # no links, devices or pipes
        if entry.isreg() and not _hidden(entry.name):
            yield _member(entry.name, entry.size, path, partial(_untarred, book, entry))


def _untarred(book: tarfile.TarFile, entry: tarfile.TarInfo, most: int | None) -> bytes:
    stream = book.extractfile(entry)
    return stream.read(-1 if most is None else most) if stream is not None else b""


def _member(name: str, size: int, path: str | Path, read: Callable[[int | None], bytes]) -> Member:
    """A member under a relative name: what a flight.yaml names by it lies in the archive and nowhere else."""
    if ".." in name.split("/"):
        return Member(name, 0, partial(_refused, "the member's name leads out of the archive", "a name below it", path))
    return Member(name.lstrip("/"), size, read)


def _refused(found: str, expected: str, path: str | Path, _most: int | None) -> bytes:
    raise InputError(found, expected=expected, path=path)


def most_bytes(size: int) -> int:
    """Bytes that an archive or packed file of ``size`` bytes may unpack to."""
    return min(_MOST_IN_ALL, MOST_RATIO * size + _FREE_BYTES)


def _check(entries: list[Member], size: int, path: str | Path) -> None:
    total = sum(member.size for member in entries)
    if len(entries) > MOST_MEMBERS:
        raise InputError(f"the archive holds {len(entries)} files", expected=f"at most {MOST_MEMBERS}", path=path)
    if total > most_bytes(size):
        raise InputError(
            f"the archive of {size} bytes unpacks to {total} bytes",
            expected=f"at most {MOST_RATIO} times its size and {_FREE_BYTES >> 20} MiB, and {_MOST_IN_ALL >> 30} GiB",
            cause="no data set: an archive made to fill a disk or the memory",
            path=path,
        )

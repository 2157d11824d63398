"""Files of logs: archives, packed files, checksums, and reading of files larger than memory in pieces.

Logs packed by gzip, bzip2 or xz are unpacked piece by piece, up to a limit. A file may contain several streams, as
parallel packers write them.

Zip and tar archives are read as folders of logs: members are streams with a limit and are never written to disk. The
name of a member has the form of a file in a folder: ``dataset.zip/LW1/power_log.txt``.

Each line of the log of ``aerpaw-cmp tap`` is a JSON object. The last key is the CRC-32 of the text before it.

A log larger than memory is read in pieces of complete lines. The result of ``Reader.read_pieces`` does not depend on
the size of the pieces: a reader stores a few numbers per piece and completes the result at the end.
"""

from __future__ import annotations

import io
import json
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from os.path import isfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..common.errors import InputError
from ..common.units import AnyArray

# zipfile imports lzma, which some Python builds do not have
_LZMA_ERROR: type[Exception] = getattr(getattr(zipfile, "lzma", None), "LZMAError", OSError)
_MAGIC = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ\x00": "xz"}
_MODULES = {"gzip": "gzip", "bzip2": "bz2", "xz": "lzma"}
_BLOCKS = {b"%d1AY&SY" % level for level in range(1, 10)}
_PIECE = 2 << 20
# A file that unpacks to more than this multiple of its size is not a log: the most regular logs shrink to a hundredth.
_MOST_RATIO = 1100


def packed_form(head: bytes) -> str | None:
    """Return ``gzip``, ``bzip2`` or ``xz``, or None for other content."""
    for magic, name in _MAGIC.items():
        if head.startswith(magic) and (name != "bzip2" or head[3:10] in _BLOCKS):
            return name
    return None


def unpacked_pieces(file: BinaryIO, path: str | Path) -> Iterator[bytes]:
    """Yield the content of a packed file, some MiB at a time.

    Parameters
    ----------
    file : file object
        The packed file, at its beginning.
    path : str or Path
        Path in messages.

    Raises
    ------
    InputError
        If the file is damaged or truncated, or unpacks to more bytes than a log can have.
    """
    name = packed_form(file.read(10)) or "bzip2"
    file.seek(0)
    try:
        # import it here, because some Python builds do not have the module
        module = import_module(_MODULES[name])
    except ImportError as error:
        found = f"a {name} file, and this Python was built without {name}"
        raise InputError(found, expected="an unpacked log", path=path) from error
    count = 0
    try:
        for piece in iter(partial(module.open(file).read, _PIECE), b""):
            count += len(piece)
            # check while unpacking, so that a zip bomb is stopped at its first piece
            if count > _MOST_RATIO * file.tell() + _PIECE:
                found = f"the {name} file unpacks to more than {_MOST_RATIO} times its size"
                raise InputError(found, cause="not a log", path=path)
            yield piece
    except EOFError as error:
        raise InputError(f"the {name} file ends too early", cause="a truncated download", path=path) from error
    # a MemoryError is possible, because the header of an xz file may request more memory than is available
    except (OSError, ValueError, zlib.error, _LZMA_ERROR, MemoryError) as error:
        raise InputError(f"a damaged {name} file ({error})", cause="a truncated download", path=path) from error


def unpacked(raw: bytes, path: str | Path, most: int) -> bytes:
    """Return the content of a packed file, and refuse content of more than ``most`` bytes."""
    parts, size = [], 0
    for piece in unpacked_pieces(io.BytesIO(raw), path):
        parts.append(piece)
        size += len(piece)
        if size > most:
            found = f"the {packed_form(raw)} file unpacks to more than {most} bytes"
            raise InputError(found, cause="not a log", path=path)
    return b"".join(parts)


def head_of(place: Path, count: int) -> bytes:
    """Return the first bytes of the content of a packed file, up to the first damage."""
    head = b""
    # do not report damage here, because reading the file reports it later
    with suppress(InputError), place.open("rb") as file:
        for piece in unpacked_pieces(file, place):
            head += piece
            if len(head) >= count:
                break
    return head[:count]


# Largest number of files in an archive. A flight of half an hour with a burst every 0.1 s has 18 000 files.
MOST_MEMBERS = 20_000
# Largest size of a member, and of all members together, after decompression.
MOST_BYTES = 2**31
_MOST_IN_ALL = 2**35
# Largest ratio of the size of all members to that of the archive, in addition to ``_FREE_BYTES``. Packing reduces most
# logs to a fifth, and some to a fiftieth.
MOST_RATIO = 100
_ZIP = (b"PK\x03\x04", b"PK\x05\x06")
_TAR = b"ustar"
_MARGIN = 2**20
_FREE_BYTES = 2**28
# Deflate makes a file at most 1032 times smaller, so a header with a larger ratio is false.
_RATIO = 1200
# Errors of Python's libraries for damaged archives. ValueError: the directory would begin before the start of the file.
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, _LZMA_ERROR, struct.error, EOFError, OSError, ValueError, IndexError,
    OverflowError, NotImplementedError,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Member:
    """A file of an archive.

    Parameters
    ----------
    name : str
        Relative path, even if the path in the archive is absolute.
    size : int
        Size after decompression according to the archive [bytes].
    read : callable
        Function that returns the content, or at most the given number of bytes.
    """

    name: str
    size: int
    read: Callable[[int | None], bytes]


def is_archive(head: bytes) -> bool:
    """Check whether a file (gunzipped or not) begins like an archive."""
    # the signature of POSIX tar is at byte 257 of the first header
    return head.startswith(_ZIP) or head[257:262] == _TAR


def path_in_archive(path: Path) -> tuple[Path, str] | None:
    """Return the archive and the member that a path names, or None if no part of the path is a file."""
    # Path.is_file raises for a name that is too long
    file = next((parent for parent in path.parents if isfile(parent)), None)  # noqa: PTH113
    return None if file is None else (file, path.relative_to(file).as_posix())


def archive_members(data: bytes, path: str | Path) -> dict[str, Member]:
    """Return the files of an archive by their names, in order.

    Raises
    ------
    InputError
        If the archive is damaged, or has more files or bytes than a data set can have. ``read`` of a member raises the
        same error.
    """
    try:
        entries = list(_zip(data, path) if data.startswith(_ZIP) else _tar(data, path))
    except (*_DAMAGE, tarfile.TarError) as error:
        raise InputError(f"a damaged archive ({error})", cause="a truncated download", path=path) from error
    _check(entries, len(data), path)
    return {member.name: member for member in sorted(entries, key=lambda member: member.name)}


def _hidden(name: str) -> bool:
    return any((part.startswith(".") and part != "..") or part == "__MACOSX" for part in name.split("/"))


def _zip(data: bytes, path: str | Path) -> Iterator[Member]:
    book = zipfile.ZipFile(io.BytesIO(data))
    for entry in book.infolist():
        if not entry.is_dir() and not _hidden(entry.filename):
            size = entry.file_size
            # deflate cannot reach this ratio, so the size in the directory is false
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
            # read one byte more than declared, to detect a false size
            content = stream.read(entry.file_size + 1 if most is None else most)
    except (*_DAMAGE, RuntimeError) as error:
        raise InputError(f"a damaged or locked member ({error})", cause="a truncated download", path=place) from error
    if len(content) > entry.file_size:
        raise InputError("the member is larger than the archive declares", cause="not a log", path=place)
    return content


def _tar(data: bytes, path: str | Path) -> Iterator[Member]:
    # "r:" refuses compressed tar files, which would be unpacked without a limit
    book = tarfile.open(fileobj=io.BytesIO(data), mode="r:")  # noqa: SIM115 - members are read later
    for entry in book.getmembers():
        # skip links, devices and pipes
        if entry.isreg() and not _hidden(entry.name):
            yield _member(entry.name, entry.size, path, partial(_untarred, book, entry))


def _untarred(book: tarfile.TarFile, entry: tarfile.TarInfo, most: int | None) -> bytes:
    stream = book.extractfile(entry)
    return stream.read(-1 if most is None else most) if stream is not None else b""


def _member(name: str, size: int, path: str | Path, read: Callable[[int | None], bytes]) -> Member:
    """Return a member under a relative name, so that a flight.yaml can only name files inside the archive."""
    if ".." in name.split("/"):
        return Member(name, 0, partial(_refused, "the member's name leaves the archive", "a relative name", path))
    return Member(name.lstrip("/"), size, read)


def _refused(found: str, expected: str, path: str | Path, _most: int | None) -> bytes:
    raise InputError(found, expected=expected, path=path)


def most_bytes(size: int) -> int:
    """Return the largest allowed size of the unpacked content of an archive or packed file of ``size`` bytes."""
    return min(_MOST_IN_ALL, MOST_RATIO * size + _FREE_BYTES)


def _check(entries: list[Member], size: int, path: str | Path) -> None:
    total = sum(member.size for member in entries)
    if len(entries) > MOST_MEMBERS:
        raise InputError(f"the archive contains {len(entries)} files", expected=f"at most {MOST_MEMBERS}", path=path)
    if total > most_bytes(size):
        raise InputError(
            f"the archive of {size} bytes unpacks to {total} bytes",
            expected=f"at most {MOST_RATIO} times its size plus {_FREE_BYTES >> 20} MiB, and {_MOST_IN_ALL >> 30} GiB",
            cause="not a data set: an archive crafted to fill the disk or memory",
            path=path,
        )


SCHEMA = "aerpaw-cmp-tap/1"
_CRC = b',"crc":"'

Record = dict[str, Any]


def encode_record(record: Record) -> bytes:
    r"""Return the line of a record, with its checksum and line end.

    Examples
    --------
    >>> encode_record({"kind": "end", "n": 3})
    b'{"kind":"end","n":3,"crc":"a5ccacec"}\n'
    """
    body = json.dumps(record, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode("ascii")[:-1]
    return body + _CRC + b'%08x"}\n' % zlib.crc32(body)


def decode_record(line: bytes) -> Record:
    """Return the record of a line.

    Raises
    ------
    ValueError
        If the line is truncated or its checksum is wrong.
    """
    body, mark, tail = line.strip().rpartition(_CRC)
    if not mark or len(tail) != 10 or not tail.endswith(b'"}'):
        raise ValueError("truncated line: it does not end with a checksum")
    if b"%08x" % zlib.crc32(body) != tail[:8]:
        raise ValueError("damaged line: its checksum does not match")
    try:
        record = json.loads(body + b"}")
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(record, dict):
        raise ValueError("not a record")
    return record


PIECE_BYTES = 4 << 20


def file_pieces(place: Path, digest: Any) -> Iterator[bytes]:
    """Yield the unpacked content of a log, some MiB of complete lines at a time, and update ``digest`` with it."""
    with place.open("rb") as file:
        packed = packed_form(file.read(10)) is not None
        file.seek(0)
        chunks = unpacked_pieces(file, place) if packed else iter(partial(file.read, PIECE_BYTES), b"")
        yield from whole_lines(_counted(chunks, digest))


def whole_lines(chunks: Iterable[bytes]) -> Iterator[bytes]:
    r"""Yield the same bytes in pieces that end with a line end, except the last, and without a byte order mark.

    Examples
    --------
    >>> list(whole_lines([b"a\nb", b"c", b"d\n", b"e"]))
    [b'a\n', b'bcd\n', b'e']
    """
    pending: list[bytes] = []
    started = False
    for chunk in chunks:
        cut = chunk.rfind(b"\n") + 1
        if not cut:
            pending.append(chunk)
            continue
        piece = b"".join([*pending, chunk[:cut]])
        yield piece if started else piece.removeprefix(b"\xef\xbb\xbf")
        started, pending = True, [chunk[cut:]] if cut < len(chunk) else []
    if pending:
        piece = b"".join(pending)
        yield piece if started else piece.removeprefix(b"\xef\xbb\xbf")


def _counted(chunks: Iterable[bytes], digest: Any) -> Iterator[bytes]:
    for chunk in chunks:
        digest.update(chunk)
        yield chunk


class Column:
    """A column that grows in place, because joining stored pieces would need twice the memory."""

    def __init__(self, dtype: Any) -> None:
        self._content, self._dtype = bytearray(), dtype  # a bytearray grows in place, with an eighth in reserve

    def extend(self, piece: AnyArray) -> None:
        """Append values."""
        self._content += piece.astype(self._dtype, copy=False).tobytes()

    def array(self) -> AnyArray:
        """Return the column as an array. The column cannot grow after that."""
        return np.frombuffer(self._content, dtype=self._dtype)

"""Logs packed by gzip, bzip2 or xz, unpacked piece by piece and bounded.

A file may hold several streams, as parallel packers write them. Python may have been built without bzip2 or
xz: then the message says so.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from ...common.errors import InputError

_MAGIC = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ\x00": "xz"}
_PIECE = 2 << 20
# What unpacks to more than so many times its size is no log: text of the most regular of them takes a hundredth.
_MOST_RATIO = 1100
# Of the xz library; its strongest setting takes 65 MiB.
_MOST_MEMORY = 1 << 28


def form(head: bytes) -> str | None:
    """``gzip``, ``bzip2`` or ``xz``, None for any other content."""
    for magic, name in _MAGIC.items():
        if head.startswith(magic) and (name != "bzip2" or head[3:10] in _BLOCKS):
            return name
    return None


_BLOCKS = {b"%d1AY&SY" % level for level in range(1, 10)}


class _Gunzip:
    """One member of a gzip file, with the interface of the other two libraries."""

    def __init__(self) -> None:
        # 16: with the header of gzip, which is checked
        self._machine = zlib.decompressobj(zlib.MAX_WBITS | 16)

    def decompress(self, data: bytes, most: int) -> bytes:
        return self._machine.decompress(self._machine.unconsumed_tail + data, most)

    @property
    def eof(self) -> bool:
        return self._machine.eof

    @property
    def unused_data(self) -> bytes:
        return self._machine.unused_data

    @property
    def needs_input(self) -> bool:
        return not self._machine.unconsumed_tail


def _machine(name: str, path: str | Path) -> Callable[[], Any]:
    if name == "gzip":
        return _Gunzip
    try:
        # here: Python may lack these modules
        if name == "bzip2":
            import bz2

            return bz2.BZ2Decompressor
        import lzma

        # a header may ask for GiB of dictionary
        return lambda: lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=_MOST_MEMORY)
    except ImportError as error:
        raise InputError(
            f"a {name} file, and this Python was built without {name}", expected="the log unpacked", path=path
        ) from error


def pieces(content: Iterable[bytes], path: str | Path) -> Iterator[bytes]:
    """Content of a packed file, some MiB at a time.

    Parameters
    ----------
    content : iterable of bytes
        Of the file; the first one shows its form.
    path : str or Path
        What messages name.

    Raises
    ------
    InputError
        If it is damaged or cut, or unpacks to more than a log can.
    """
    content = iter(content)
    unread = next(content, b"")
    name = form(unread) or "bzip2"
    make, machine = _machine(name, path), None
    bytes_in, bytes_out = len(unread), 0
    while True:
        unread = unread if machine is not None else unread.lstrip(b"\0")  # padding between streams
        if not unread and (machine is None or machine.needs_input):
            unread = next(content, b"")
            bytes_in += len(unread)
            if not unread:
                break
            continue
        machine = make() if machine is None else machine
        try:
            piece = machine.decompress(unread, _PIECE)
        except MemoryError:
            raise
        except Exception as error:  # bz2 raises OSError and ValueError, lzma an exception of its own
            raise InputError(f"a damaged {name} file ({error})", cause="a cut download", path=path) from error
        bytes_out += len(piece)
        # as it goes, so that a bomb is stopped at its first piece
        if bytes_out > _MOST_RATIO * bytes_in + _PIECE:
            raise InputError(f"the {name} file unpacks to more than {_MOST_RATIO} times its size", cause="no log",
                             path=path)  # fmt: skip
        if piece:
            yield piece
        unread = machine.unused_data if machine.eof else b""
        machine = None if machine.eof else machine
    if machine is not None:
        raise InputError(f"the {name} file ends too early", cause="a cut download", path=path)


def unpacked(raw: bytes, path: str | Path, most: int) -> bytes:
    """All of a packed file, never more than ``most`` bytes; see :func:`pieces`."""
    parts, size = [], 0
    for piece in pieces([raw], path):
        parts.append(piece)
        size += len(piece)
        if size > most:
            raise InputError(f"the {form(raw)} file unpacks to more than {most} bytes", cause="no log", path=path)
    return b"".join(parts)


def head_of(place: Path, count: int) -> bytes:
    """The first bytes of what a packed file holds, none where it is damaged: reading it says so."""
    head = b""
    try:
        for piece in pieces(chunks(place, _PIECE), place):
            head += piece
            if len(head) >= count:
                break
    except InputError:
        return b""  # damaged further on than the beginning: refused alike when it is read
    return head[:count]


def chunks(place: Path, size: int) -> Iterator[bytes]:
    """Content of a file, so many bytes at a time."""
    with place.open("rb") as file:
        while chunk := file.read(size):
            yield chunk

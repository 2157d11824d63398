"""Atomic writing of files, bounded reading, and the cache folder."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path, PureWindowsPath
from typing import BinaryIO

from .errors import AerpawCmpError, InputError, OutputError, one_line

# Size limit of small files that are read at once: antenna patterns, receivers, the numbers of a report [bytes].
LARGEST_TABLE = 64 << 20


def inside(
    folder: Path, name: str, source: Path, *, plain: bool = False, error: type[AerpawCmpError] = InputError
) -> Path:
    """Return the path, below a folder, of a file that another file names. Use it for every name from a file.

    Parameters
    ----------
    folder : Path
    name : str
        Name of the file as written in ``source``, which may come from a third party.
    source : Path
        The file that contains the name, for the message.
    plain : bool
        Also refuse names of files in subfolders.
    error : type
        Class of the exception.

    Returns
    -------
    Path

    Raises
    ------
    AerpawCmpError
        If the name is absolute, contains ``..`` or NUL, or a link on its path leaves the folder.
    """
    parts = PureWindowsPath(name)  # Windows rules recognise both separators, drives and absolute POSIX paths
    depth, place = len(parts.parts), folder.joinpath(*parts.parts)
    wrong = not depth or parts.anchor or ".." in parts.parts or "\0" in name or (plain and depth > 1)
    if wrong or not Path(os.path.realpath(place)).is_relative_to(os.path.realpath(folder)):
        raise error(
            f"it names '{one_line(name)}', {'no file of its folder' if wrong else 'a link that leaves its folder'}",
            expected=f"the name of a file {'in' if plain else 'in or below'} {one_line(str(folder))}",
            cause="the file was edited by hand, or crafted to access your other files",
            path=source,
        )
    return place


def cache_folder(*parts: str) -> Path:
    """Return a path in the cache folder, which contains only data that this program can compute again.

    The folder is ``AERPAW_CMP_CACHE`` if that is set, otherwise a folder in ``XDG_CACHE_HOME`` or ``~/.cache``.
    """
    chosen = os.environ.get("AERPAW_CMP_CACHE")
    folder = Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "aerpaw-cmp")
    return folder.expanduser().joinpath(*parts)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder for one process at a time. The lock has no effect on systems and disks without locks."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        # Windows has no fcntl, and some network disks have no locks
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """Yield a temporary path that is renamed to ``target`` when the block ends without an error.

    Parameters
    ----------
    target : Path
        The output file. The folder of the file must exist. Other programs see the old file or the new one, never a
        part.

    Yields
    ------
    Path
        An empty file in the same folder. The file is removed if the block fails.

    Raises
    ------
    OSError
        If the folder is missing, full or not writable.
    """
    # the limit of a name is 255 bytes, and mkstemp adds a random suffix
    prefix = f".{target.name[:40]}."
    _clear_old_parts(target.parent, prefix)
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=prefix, suffix=".part")
    os.close(handle)
    part = Path(name)
    try:
        yield part
        part.chmod(plain_mode())  # mkstemp makes private files: set the usual permissions
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def _clear_old_parts(folder: Path, prefix: str) -> None:
    """Remove temporary files of the same target that are more than an hour old: killed runs left them."""
    for part in folder.glob(f"{glob.escape(prefix)}*.part"):
        with contextlib.suppress(OSError):
            if time.time() - part.stat().st_mtime > 3600:
                part.unlink()


def opened(path: Path, expected: str = "a file") -> BinaryIO:
    """Open a file of the user for reading.

    Raises
    ------
    InputError
        If the path is a pipe, a device or a socket, because opening or reading it may wait forever.
    OSError
        If the file cannot be opened.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError("not a regular file", expected=expected, cause="a pipe, a device or a socket", path=path)
    return path.open("rb")


def read_bounded(path: Path, most: int, expected: str = "a file") -> bytes:
    """Return the content of a file of at most ``most`` bytes.

    Parameters
    ----------
    path : Path
    most : int
    expected : str
        What the file should be, for the message.

    Returns
    -------
    bytes

    Raises
    ------
    InputError
        If the file has more bytes, or is a pipe, a device or a socket.
    OSError
        If the file cannot be read.
    """
    with opened(path, expected) as file:
        size = os.fstat(file.fileno()).st_size
        chunks: list[bytes] = []
        total = 0
        # count the bytes, because files of /proc report a size of 0 bytes
        while size <= most and total <= most and (chunk := file.read(_CHUNK)):
            chunks.append(chunk)
            total += len(chunk)
    if max(size, total) > most:
        excess = f"the file has {size} bytes" if size > most else f"it has more than {most} bytes"
        raise InputError(excess, expected=f"{expected} of at most {most} bytes", path=path)
    return b"".join(chunks)


def read_input(path: Path, most: int, expected: str = "a file") -> bytes:
    """Return the content of a file of at most ``most`` bytes. Raise InputError if it is larger or unreadable."""
    try:
        return read_bounded(path, most, expected)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", expected=expected, path=path) from None


_CHUNK = 1 << 20


def seal(content: bytes, mark: bytes) -> bytes:
    """Return the content followed by a mark and its SHA-256."""
    return content + mark + hashlib.sha256(content).digest()


def unseal(entry: bytes, mark: bytes) -> bytes:
    """Return the content of an entry that :func:`seal` created.

    Raises
    ------
    ValueError
        If the entry is damaged or another kind of file. The SHA-256 is checked before parsing, because readers of
        damaged archives raise many kinds of exceptions.
    """
    content, end = entry[: -len(mark) - 32], entry[-len(mark) - 32 :]
    if end != mark + hashlib.sha256(content).digest():
        raise ValueError("the checksum does not match the content")
    return content


def write_sealed(path: Path, content: bytes, mark: bytes) -> None:
    """Write a cache entry atomically, followed by a mark and the SHA-256 of its content.

    If the cache cannot be written, nothing is stored and no exception is raised.
    """
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as part:
            part.write_bytes(seal(content, mark))


def read_sealed(path: Path, mark: bytes) -> bytes | None:
    """Return the content of an entry that :func:`write_sealed` wrote. None if there is no entry.

    Raises
    ------
    ValueError
        If the entry is damaged, as in :func:`unseal`.
    """
    try:
        entry = path.read_bytes()
    except OSError:
        return None
    return unseal(entry, mark)


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file atomically. Raise OutputError if it cannot be written."""
    try:
        with atomic_path(path) as part:
            part.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)
    except OSError as error:
        raise OutputError(f"cannot be written ({error.strerror or error})", path=path) from None


def plain_mode() -> int:
    """Return the permissions of an ordinary new file."""
    # set the mask and restore it, because the mask cannot be read otherwise
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask


def sync(path: Path) -> None:
    """Sync a file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

"""Output files and folders. They replace only outputs of this tool, and are written atomically.

Files and folders follow the same rules:

=====================  =======================================================  ==================================
kind                   proof that this tool wrote it                            how the new output gets the name
=====================  =======================================================  ==================================
:class:`OutputFile`    a seal inside: the SHA-256 of the rest of the file       written nearby, synced, renamed
:class:`OutputFolder`  ``SHA256SUMS`` in it: the SHA-256 of every file in it filled nearby, synced, swapped
=====================  =======================================================  ==================================

An input is never replaced, with or without ``--force``. Inputs are compared by device and inode, so links are
recognised. Files that this tool did not write, or that were changed afterwards, are replaced only with ``--force``.

The hidden path next to the target (``.NAME.aerpaw-part``) is created before any computation, so that a bad ``-o`` is
reported first. This hidden output is locked (flock) until the run ends, so that a second run into the same target is
refused. A killed run leaves at most that hidden path, and the next run into the target removes it. See docs/security.md
for the exact guarantees.

The module also contains a stream that HDF5 can write to.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import hashlib
import os
import re
import stat
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from .errors import InputError, OutputError, UsageError, add_note, one_line
from .files import inside, plain_mode, sync
from .interrupts import AT_END, held, interrupted, raise_interrupt

# File in a result folder that lists its files; ``sha256sum -c SHA256SUMS`` checks them.
SUMS = "SHA256SUMS"
_SUMS_HEAD = "# aerpaw-cmp:"
_SEAL = "# aerpaw-cmp wrote this file; SHA-256 of the lines below: "
_UNFINISHED = ".unfinished"


# --- outputs of this tool --------------------------------------------------------------------------


def sealed(text: str) -> bytes:
    r"""Return a text in UTF-8, preceded by a comment line that contains the SHA-256 of the text.

    Examples
    --------
    >>> sealed("a: 1\n").decode().splitlines()[1]
    'a: 1'
    """
    content = text.encode("utf-8")
    return f"{_SEAL}{hashlib.sha256(content).hexdigest()}\n".encode("ascii") + content


def unsealed(text: str) -> str:
    """Return a text without the first line that :func:`sealed` added."""
    return text.partition("\n")[2] if text.startswith(_SEAL) else text


def is_sealed(path: Path) -> bool:
    """Check whether a file is unchanged since :func:`sealed` created it."""
    with path.open("rb") as stream:
        head = stream.readline(len(_SEAL) + 80)
        seal = f"{_SEAL}{_digest(stream)}\n" if head.startswith(_SEAL.encode("ascii")) else ""
    return head == seal.encode("ascii")


def check_seal(path: Path) -> None:
    """Refuse a file whose lines were changed after :func:`sealed` created it. Accept a file without a seal.

    Raises
    ------
    UsageError
    """
    with explained_os_errors(path), path.open("rb") as stream:
        begins = stream.read(len(_SEAL)) == _SEAL.encode("ascii")
    if begins and not is_sealed(path):
        raise UsageError(
            "a line of this file was changed after it was written (SHA-256 in its first line)",
            expected="the file as 'aerpaw-cmp calibrate' wrote it; run it again",
            cause="an edited value",
            path=path,
        )


def read_sums(folder: Path) -> dict[str, str] | None:
    """Return the SHA-256 of each file of a result folder by relative name. None if there is no valid list.

    A list that names a file outside the folder is not valid, because this tool may remove the listed files.
    """
    try:
        text = (folder / SUMS).read_text(encoding="utf-8")
        rows = [line.split("  ", 1) for line in text.splitlines() if not line.startswith("#")]
        sums = {row[1]: row[0] for row in rows if len(row) == 2}
        for name in sums:
            inside(folder, name, folder / SUMS)
    except (OSError, ValueError, InputError):
        return None
    return sums if text.startswith(_SUMS_HEAD) else None


def changed_files(folder: Path) -> list[str]:
    """Return names in ``SHA256SUMS`` whose file exists with different content."""
    return [
        name
        for name, digest in (read_sums(folder) or {}).items()
        if (folder / name).is_file() and file_digest(folder / name) != digest
    ]


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as stream:
        return _digest(stream)


def _digest(stream: BinaryIO) -> str:
    digest = hashlib.sha256()
    while block := stream.read(1 << 20):
        digest.update(block)
    return digest.hexdigest()


# --- inputs ---------------------------------------------------------------------------------------


def _identity(path: Path) -> tuple[int, int] | None:
    """Return device and inode of a file, or None if there is no such file."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


def files_below(folder: Path) -> Iterator[Path]:
    """Yield every file below a folder. Links to folders are not followed."""
    for parent, _, names in os.walk(folder):
        yield from (Path(parent, name) for name in names)


def _real(path: Path) -> Path:
    """Return a path with links resolved. Raise UsageError if the name is not possible."""
    try:
        return Path(os.path.realpath(path))
    except (OSError, ValueError) as error:
        raise UsageError(f"this output name is not possible ({error})", path=path) from None


# --- one file -------------------------------------------------------------------------------------


class OutputFile:
    """A context around a complete command that writes one file.

    Parameters
    ----------
    target : Path
        Value of ``-o``. A link is followed: its target is replaced, and the link remains.
    own : callable
        Returns whether an existing file is an earlier, unchanged output of the same kind.
    inputs : iterable of Path
        Files and folders that the command reads.
    force : bool
        Also replace a file that this tool did not write. An input is never replaced.

    Raises
    ------
    UsageError
        On entry: if the target is an input, was not written by this tool, has no parent folder, or is in use by another
        run.
    OutputError
        If the output cannot be written to the disk.
    """

    def __init__(
        self, target: Path, *, own: Callable[[Path], bool], inputs: Iterable[Path] = (), force: bool = False
    ) -> None:
        self.named, self.target = Path(target), _real(Path(target))
        self._own, self._inputs, self._force = own, tuple(inputs), force
        self._place: _Place | None = None

    def __enter__(self) -> OutputFile:
        with explained_os_errors(self.named):
            if not self.target.parent.is_dir():
                raise UsageError(
                    "there is no such folder", expected="a file name in a folder that exists", path=self.named.parent
                )
            self._refuse()
        self._place = _Place(self.target, self.named, folder=False)
        return self

    def _refuse(self) -> None:
        """Raise UsageError if the target must not be written."""
        if not _taken(self.target):
            return
        if not self.target.is_file():
            raise UsageError(
                "the output exists and is not a regular file", expected="a new name after -o", path=self.named
            )
        target = _identity(self.target)
        for path in self._inputs:
            if _identity(path) == target:
                raise _replaces_input(self.named, path)
        own = False
        with contextlib.suppress(OSError, ValueError):
            own = self._own(self.target)
        for path in () if own else self._inputs:  # an earlier output of this tool may be among the logs
            if path.is_dir() and any(_identity(file) == target for file in files_below(path)):
                raise _replaces_input(self.named, path)
        if not own and not self._force:
            raise UsageError(
                "the file exists, and it is not an unchanged output of this command",
                expected="a new name, or --force to replace it",
                path=self.named,
            )

    def write(self, content: bytes | Callable[[BinaryIO], None]) -> None:
        """Write and sync the file, then rename it, so that after a power cut the target is the old or the new file.

        ``content`` may be a function that writes to a stream. The function can also read from the stream.
        """
        place = self._place
        assert place is not None, "used as a context"
        with explained_os_errors(self.named):
            # use a copy of the descriptor, because closing the descriptor itself would release the lock
            with os.fdopen(os.dup(place.descriptor), "r+b") as stream:
                if callable(content):
                    content(stream)
                else:
                    stream.write(content)
                stream.flush()
                os.fchmod(stream.fileno(), plain_mode())
                os.fsync(stream.fileno())
            self._refuse()  # do not replace a file that was created meanwhile
            place.refuse_gone()
            raise_interrupt()
            with held():
                place.part.rename(self.target)
                place.leave()  # unlock, because HDF5 does not open a locked file
                self._place = None
                _sync_folder(self.target.parent)

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if self._place is not None:
            with held():
                self._place.leave()
                self._place = None
                _note_output_state(error, self.named)


def _note_output_state(error: BaseException | None, named: Path) -> None:
    """Add a note about the state of the output file to an interrupt."""
    if isinstance(error, KeyboardInterrupt) or (error is not None and interrupted()):
        exists = os.path.lexists(named)
        add_note(error, f"{one_line(str(named))} {'is as it was before' if exists else 'was not written'}")


def _replaces_input(named: Path, path: Path) -> UsageError:
    return UsageError(
        "the output would replace an input" + ("" if path == named else f", {one_line(str(path))}"),
        expected="another name after -o",
        path=named,
    )


# --- a folder -------------------------------------------------------------------------------------


class OutputFolder:
    """A context around a complete command that writes a folder of results. The folder is replaced completely.

    Parameters
    ----------
    target : Path
        Value of ``-o``. Created if it is missing, with its parents.
    job : str
        Name of the command, for ``SHA256SUMS``.
    inputs : iterable of Path
        Files that the command reads. None of them may be in the folder.
    force : bool
        Also replace files that were changed after this tool wrote them. Files of other programs are never replaced.

    Raises
    ------
    UsageError
        On entry: if the folder contains an input or files that this tool did not write, cannot be replaced, or is in
        use by another run.
    OutputError
        If the output cannot be written to the disk.

    Examples
    --------
    ::

        with OutputFolder(out, job="report", inputs=[flight]) as output:
            result = compute()
            with output.filling() as folder:
                write(result, folder)
    """

    def __init__(self, target: Path, *, job: str, inputs: Iterable[Path] = (), force: bool = False) -> None:
        self.named, self.target = Path(target), _real(Path(target))
        self._job, self._inputs, self._force = job, tuple(inputs), force
        self._place: _Place | None = None
        self._made: list[Path] = []  # parent folders that this run created; they are removed if it fails
        self._written = False

    def __enter__(self) -> OutputFolder:
        with explained_os_errors(self.named):
            self._refuse_shape()
            try:
                missing = [place for place in self.target.parents if not place.exists()]
                for place in reversed(missing):
                    place.mkdir(exist_ok=True)
                    self._made.append(place)
                self._place = _Place(self.target, self.named, folder=True)
                _restore(self.target)
                self._refuse_content()
                (self._place.part / _UNFINISHED).touch()
            except BaseException:
                # Python calls __exit__ only if __enter__ succeeded
                self.__exit__(None, None, None)
                raise
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with held():
            if self._place is not None:
                self._place.leave()
                self._place = None
            # remove the deepest folder first, because its parent is empty only afterwards
            for place in reversed(self._made):
                with contextlib.suppress(OSError):
                    place.rmdir()
            if not self._written:
                _note_output_state(error, self.named)

    def _refuse_shape(self) -> None:
        """Raise UsageError if the target cannot be a result folder."""
        if _taken(self.target) and not self.target.is_dir():
            raise UsageError("a file is in the way", expected="the name of a folder", path=self.named)
        if self.target.is_dir():
            working_folder = Path.cwd().resolve()
            if self.target == working_folder or self.target in working_folder.parents or os.path.ismount(self.target):
                raise UsageError(
                    "a result folder is replaced as a whole, which is not possible for the working folder, a folder "
                    "above it or a mount point",
                    expected=f"a folder inside it, such as {one_line(str(self.named / self._job))}",
                    path=self.named,
                )
        for path in self._inputs:
            if self.target in _real(path).parents or self.target == _real(path):
                raise UsageError(
                    f"the output folder contains an input, {one_line(str(path))}",
                    expected="a separate folder after -o, because all of its content is replaced",
                    path=self.named,
                )

    def _refuse_content(self) -> None:
        """Raise UsageError if the folder contains files that this tool did not write or that were changed later."""
        if not self.target.is_dir():
            return
        # refuse a read-only folder now, because its files could not be replaced after the computation
        if not os.access(self.target, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self.target))
        own = read_sums(self.target)
        list_of_others = SUMS if own is None and _taken(self.target / SUMS) else None
        own = own or {}
        if foreign := next(foreign_entries(self.target, own), list_of_others):
            raise UsageError(
                f"the folder contains files that this tool did not write: {one_line(foreign)}",
                expected="a new or empty folder after -o, because all content of a result folder is replaced",
                path=self.named,
            )
        inputs = {_identity(path) for path in self._inputs} - {None}
        for name in own:
            if _identity(self.target / name) in inputs:
                raise _replaces_input(self.named, self.target / name)
        if not self._force and (changed := changed_files(self.target)):
            raise UsageError(
                f"{one_line(changed[0])} was changed after this tool wrote it",
                expected="a new folder, or --force to replace it",
                path=self.named,
            )

    @contextlib.contextmanager
    def filling(self) -> Iterator[Path]:
        """Yield an empty folder for results. The folder takes the target's name if the block ends without an error."""
        place = self._place
        assert place is not None, "used as a context"
        with explained_os_errors(self.named):
            yield place.part
            place.refuse_gone()
            raise_interrupt()
            with held():
                self._commit(place)
                self._written = True
        self._made = []

    def placed(self, written: Iterable[Path]) -> tuple[Path, ...]:
        """Return the final paths of files that were written into the folder of :meth:`filling`."""
        assert self._place is not None, "used as a context"
        return tuple(self.named / path.relative_to(self._place.part) for path in written)

    def _commit(self, place: _Place) -> None:
        files = [file for file in files_below(place.part) if file.name != _UNFINISHED]
        results = sorted(file.relative_to(place.part).as_posix() for file in files)
        sums = "".join(f"{file_digest(place.part / name)}  {name}\n" for name in results)
        head = f"{_SUMS_HEAD} the files of one run of '{self._job}'; 'sha256sum -c {SUMS}' checks them\n"
        (place.part / SUMS).write_text(head + sums, encoding="utf-8")
        _sync_tree(place.part)
        self._refuse_content()  # refuse a file that was created meanwhile
        replaced = self.target.is_dir()
        for folder in (place.part, *(entry for entry in place.part.rglob("*") if entry.is_dir())):
            before = self.target / folder.relative_to(place.part)
            if before.is_dir():  # keep the permissions of the replaced folder, which may be private
                folder.chmod(stat.S_IMODE(before.stat().st_mode))
        (place.part / _UNFINISHED).unlink(missing_ok=True)
        _sync_folder(place.part)
        if replaced:
            place.lock_too(self.target)
            _exchange(place.part, self.target)
        else:
            place.part.rename(self.target)
        _sync_folder(self.target.parent)
        if replaced:
            with contextlib.suppress(OSError):  # the results are complete, and the next run clears the remains
                _clear(place.part)


def foreign_entries(folder: Path, own: Iterable[str]) -> Iterator[str]:
    """Yield the entries of a folder that this tool did not write: files, links, folders, other file systems.

    Parameters
    ----------
    folder : Path
    own : iterable of str
        Relative names of the files that this tool wrote.

    Yields
    ------
    str
    """
    known = {SUMS, *own}
    parents = {parent.as_posix() for name in known for parent in Path(name).parents}
    device = folder.stat().st_dev
    yield from (f"{place.relative_to(folder)}, a mounted file system" for place in _mounted_below(folder))
    for parent, folders, names in os.walk(folder):
        for place in (Path(parent, name) for name in (*folders, *names)):
            status, name = place.lstat(), place.relative_to(folder).as_posix()
            expected = parents if stat.S_ISDIR(status.st_mode) else known if stat.S_ISREG(status.st_mode) else ()
            if status.st_dev != device or name not in expected:
                yield name


def _mounted_below(folder: Path) -> list[Path]:
    """Return mount points below a folder, including bind mounts. Empty if the system does not list them."""
    try:
        lines = Path("/proc/self/mountinfo").read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except OSError:
        return []
    # this list contains spaces and similar characters as octal numbers
    points = (re.sub(r"\\(\d{3})", lambda code: chr(int(code[1], 8)), line.split(" ")[4]) for line in lines)
    return [Path(point) for point in points if folder in Path(point).parents]


# --- the hidden path ------------------------------------------------------------------------------


def hidden_name(target: Path, suffix: str) -> Path:
    """Return the hidden name of a path next to the target, shortened if it is long (255 bytes are the limit)."""
    name = target.name
    if len(os.fsencode(name)) > 200:
        name = hashlib.sha256(os.fsencode(name)).hexdigest()[:32]
    return target.with_name(f".{name}.aerpaw-{suffix}")


class _Place:
    """The locked path ``.NAME.aerpaw-part``. Remains of a killed run at this path are removed."""

    def __init__(self, target: Path, named: Path, *, folder: bool) -> None:
        self.named = named
        self.part = hidden_name(target, "part")
        self._further: list[int] = []
        self._left = False
        with explained_os_errors(named):
            with held():  # delay interrupts, so that a created file is always registered in AT_END
                self.descriptor = self._claim(folder)
                AT_END.append(self.leave)
            try:
                if folder:
                    self._empty()
                else:
                    os.ftruncate(self.descriptor, 0)
            except BaseException:
                self.leave()
                raise

    def _empty(self) -> None:
        """Remove the remains of a killed run. Raise UsageError if the path contains other files."""
        with contextlib.suppress(OSError):
            _clear(self.part, keep=True)
        if foreign := next(self.part.iterdir(), None):
            raise UsageError(
                f"the path {one_line(str(self.part))} contains files of other programs: {one_line(foreign.name)}",
                expected="no other files there: move them away",
                path=self.named,
            )

    def _claim(self, folder: bool) -> int:
        for _ in range(1000):  # another run may remove the hidden path between two of these steps
            try:
                if folder:
                    with contextlib.suppress(FileExistsError):
                        self.part.mkdir()
                    descriptor = os.open(self.part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
                else:
                    # do not follow a link, because another user could have put it into a shared folder. The file is
                    # private until it is finished.
                    descriptor = os.open(self.part, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            except FileNotFoundError:
                if not self.part.parent.is_dir():
                    raise
                continue
            if not _is_own(os.fstat(descriptor)):
                os.close(descriptor)
                raise UsageError(
                    f"the temporary path {one_line(str(self.part))} belongs to another user",
                    expected="your own temporary path: remove this one, or name another output",
                    cause="a shared folder, whose other user could replace the results before they are complete",
                    path=self.named,
                )
            mine = _lock(descriptor)
            if mine and self._is_there(descriptor):
                return descriptor
            os.close(descriptor)
            if not mine:
                break
        raise UsageError(
            "another run is writing here", expected="one run at a time, or another name after -o", path=self.named
        )

    def lock_too(self, folder: Path) -> None:
        """Also lock a folder that will be moved to this path."""
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        self._further.append(descriptor)
        _lock(descriptor)

    def _is_there(self, descriptor: int) -> bool:
        status = os.fstat(descriptor)
        return _identity(self.part) == (status.st_dev, status.st_ino)

    def refuse_gone(self) -> None:
        """Raise FileNotFoundError if the path was removed or replaced."""
        if not self._is_there(self.descriptor):
            raise FileNotFoundError(errno.ENOENT, "removed during the run", str(self.part))

    def leave(self) -> None:
        """Remove what is still at the hidden path, and unlock it."""
        if self._left:
            return
        self._left = True
        if self.leave in AT_END:
            AT_END.remove(self.leave)
        descriptors = (self.descriptor, *self._further)
        # remove the path only if it is one of the locked files: otherwise it belongs to another run or does not exist
        if any(self._is_there(descriptor) for descriptor in descriptors):
            with contextlib.suppress(OSError):
                _clear(self.part) if self.part.is_dir() else self.part.unlink()
        for descriptor in descriptors:
            os.close(descriptor)


def _is_own(status: os.stat_result) -> bool:
    """Check whether a file or folder belongs to this user. Always true if the system has no user numbers (Windows)."""
    return not hasattr(os, "geteuid") or status.st_uid == os.geteuid()


def _lock(descriptor: int) -> bool:
    """Lock a file. Return whether the lock was obtained, which is also true on systems and disks without locks."""
    try:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError:
        return True
    except OSError as error:
        # all other errors mean that the disk has no locks, which is not a reason to refuse
        return error.errno not in (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)
    return True


def _clear(part: Path, *, keep: bool = False) -> None:
    """Empty a temporary folder and, unless ``keep``, remove it. OSError if foreign files remain.

    A folder with ``.unfinished`` was being filled, so this tool wrote all its files. Otherwise it contains the replaced
    results, and this tool wrote only the listed files. Both markers are removed last, so that a killed run can be
    continued.
    """
    # refuse mounts, because os.walk enters them and unlink would delete the files of the mounted disk
    if _mounted_below(part):
        raise OSError(errno.EXDEV, "a file system is mounted there", str(part))
    # add permissions, because the permissions of replaced results may not allow removing their files
    for folder in (part, *(Path(parent, name) for parent, names, _ in os.walk(part) for name in names)):
        # change permissions only if necessary: only the owner may change them, but a group may be able to write
        if not folder.is_symlink() and not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
            folder.chmod(stat.S_IMODE(folder.stat().st_mode) | stat.S_IRWXU)
    signs = [part / _UNFINISHED, part / SUMS]
    names = files_below(part) if signs[0].exists() else [part / name for name in read_sums(part) or ()]
    for file in names:
        if file not in signs:
            file.unlink(missing_ok=True)
    for parent, folders, _ in os.walk(part, topdown=False):
        for folder in (Path(parent, name) for name in folders):
            folder.unlink() if folder.is_symlink() and signs[0].exists() else folder.rmdir()
    if not set(part.iterdir()) <= set(signs):
        raise OSError(errno.ENOTEMPTY, "files of other programs are there", str(part))
    for sign in signs:
        sign.unlink(missing_ok=True)
    if not keep:
        part.rmdir()


# --- names and disks ------------------------------------------------------------------------------


def _exchange(part: Path, target: Path) -> None:
    """Swap the names of two folders in one step, or in two steps that :func:`_restore` can undo."""
    if _names_swapped(part, target):
        return
    old = hidden_name(target, "old")
    target.rename(old)
    part.rename(target)
    old.rename(part)


def _restore(target: Path) -> None:
    """Undo the first step of a swap that was killed between its steps: the old folder gets its name again."""
    old = hidden_name(target, "old")
    if not old.is_dir() or not _is_own(old.lstat()):
        return
    if os.path.lexists(target):
        _clear(old)
    else:
        old.rename(target)


def _names_swapped(first: Path, second: Path) -> bool:
    """Swap names with RENAME_EXCHANGE (Linux) or RENAME_SWAP (macOS). Return False if that is not supported."""
    library = ctypes.CDLL(None, use_errno=True)
    names = os.fsencode(first), os.fsencode(second)
    if sys.platform == "darwin":
        # 2: RENAME_SWAP
        function, arguments = getattr(library, "renamex_np", None), (*names, 2)
    else:
        # -100: AT_FDCWD, names from the working folder; 2: RENAME_EXCHANGE
        function, arguments = getattr(library, "renameat2", None), (-100, names[0], -100, names[1], 2)
    if function is None:
        return False
    if function(*arguments) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP):
        return False
    raise OSError(code, os.strerror(code), str(second))


def _sync_tree(folder: Path) -> None:
    # go through the deepest folders first, so that the content of a folder is synced before the folder
    for parent, _, names in os.walk(folder, topdown=False):
        for name in names:
            if not Path(parent, name).is_symlink():
                sync(Path(parent, name))
        _sync_folder(Path(parent))


def _sync_folder(folder: Path) -> None:
    """Sync the names in a folder to the disk. Ignore the error of a system that cannot sync folders."""
    try:
        sync(folder)
    except OSError as error:
        if error.errno in (errno.EIO, errno.ENOSPC, errno.EDQUOT):
            raise


_REMEDIES = {
    errno.ENOSPC: "the disk is full: free some space, or choose another place for the output",
    errno.EDQUOT: "your quota is used up: free some space, or choose another place for the output",
    errno.EFBIG: "a limit on file sizes (ulimit -f or the file system)",
    errno.EIO: "the disk has errors: choose a place on another disk",
    errno.EROFS: "the disk is mounted read-only: choose another place for the output",
    errno.EACCES: "no right to write here: choose another place for the output",
    errno.EPERM: "no right to write here: choose another place for the output",
    errno.ENOENT: "a folder that does not accept files, or was removed during the run",
}
_WRONG_NAMES = (errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL)


def _taken(path: Path) -> bool:
    """Check whether a name is in use. Raise OSError for an impossible name, which ``lexists`` would treat as unused."""
    try:
        path.lstat()
    except FileNotFoundError:
        return False
    return True


@contextlib.contextmanager
def explained_os_errors(path: str | Path) -> Iterator[None]:
    """Convert an OSError inside the block into an error that names the output and the next step."""
    try:
        yield
    except OSError as error:
        if error.errno in _WRONG_NAMES:
            raise UsageError(
                f"cannot be written ({error.strerror})", cause="a file is in the way, or a name too long", path=path
            ) from error
        raise OutputError(
            f"cannot be written ({error.strerror or error})", cause=_REMEDIES.get(error.errno or 0), path=path
        ) from error


class Sink:
    """A stream that never raises inside HDF5, because HDF5 ends the process if the disk is full.

    The first exception or interrupt is stored, and :meth:`raise_spared` raises it. Later writes are ignored.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._failure: BaseException | None = None

    def raise_spared(self) -> None:
        """Raise the stored exception."""
        if self._failure is not None:
            raise self._failure

    def _spared(self, action: Callable[..., Any], *given: Any, instead: Any = 0) -> Any:
        if self._failure is None:
            try:
                return action(*given)
            # also catch interrupts, because they could stop HDF5 in the middle of a write
            except BaseException as failure:
                self._failure = failure
        return instead

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a position."""
        return int(self._spared(self._stream.seek, offset, whence))

    def tell(self) -> int:
        """Return the position in the stream."""
        return int(self._spared(self._stream.tell))

    def write(self, block: Any) -> int:
        """Write a block."""
        return int(self._spared(self._stream.write, block, instead=len(block)))

    def read(self, size: int = -1) -> bytes:
        """Read bytes. After a failure, and beyond the end, the bytes are zeros."""
        block = self._spared(self._stream.read, size, instead=b"")
        return bytes(block.ljust(max(size, 0), b"\0"))

    def truncate(self, size: int | None = None) -> int:
        """Change the length of the stream."""
        return int(self._spared(self._stream.truncate, size))

    def flush(self) -> None:
        """Flush the stream."""
        self._spared(self._stream.flush)

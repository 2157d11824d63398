"""Find logs, sniff them, read them and account for every line.

A path that the user names must be readable. Inside a folder or an archive, files of unknown kinds are skipped and
reported. ``dataset.zip/LW1/power_log.txt`` names a member of an archive.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..common.errors import AerpawCmpError, InputError, UsageError, one_line, parsing
from ..common.files import opened
from ..common.text import counted
from . import files as packed
from .flight_file import IngestedFile, read_flight
from .readers import DEEP_BYTES, HEAD_BYTES, Reader, ReadOptions, blaming, by_name, catalogue, claims, identify
from .records import ReadResult, RejectedLine, RejectedReason, Stream, by_reason

if TYPE_CHECKING:
    import pandas as pd

# Largest packed file that is unpacked in memory [bytes].
MAX_BYTES = 2**32

# A file with more records per stream than this is a separate log, not a piece of a log.
_PIECE_RECORDS = 50

# Number of rejected lines that a summary quotes per file.
_FIRST_REJECTED = 3

_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_HDF5 = b"\x89HDF\r\n\x1a\n"

__all__ = ["Ingested", "IngestedFile", "Skipped", "ingest", "read_bytes", "read_file", "summary"]

_OptionsFor = ReadOptions | Callable[[Path], ReadOptions]


@dataclass(frozen=True, slots=True)
class Skipped:
    """A file in a folder that was not read, with the reason.

    Parameters
    ----------
    error : AerpawCmpError, optional
        A usage error names an option that this file needs. The other files of the folder may not need it.
    """

    path: str
    reason: str
    error: AerpawCmpError | None = None

    @classmethod
    def of(cls, path: Path, names: Collection[str], error: AerpawCmpError) -> Skipped:
        """Return the record of a skipped file: the reason, and for a table the options with which it can be read."""
        way_out = f"; {error.cause}" if "--map" in (error.cause or "") else ""
        return cls(str(path), _samples_of(path.name, names) or error.found + way_out, error)


class Ingested(list[IngestedFile]):
    """The files that were read, in order. ``skipped`` contains the files in folders that were not read."""

    def __init__(self, files: Sequence[IngestedFile] = (), skipped: Sequence[Skipped] = ()) -> None:
        super().__init__(files)
        self.skipped: tuple[Skipped, ...] = tuple(skipped)


def read_bytes(path: str | Path) -> tuple[bytes, str]:
    """Return the content of a log, unpacked if it is a gzip, bzip2 or xz file, and the SHA-256 of that content.

    Raises
    ------
    InputError
        If the file is missing, not readable, not a regular file, too large, or a damaged packed file.
    """
    data = _unpacked(_raw(Path(path)), path)
    return data, hashlib.sha256(data).hexdigest()


def _unpacked(raw: bytes, path: str | Path) -> bytes:
    """Return the content of a file: unpacked if it is a packed file, otherwise unchanged."""
    most = min(MAX_BYTES, packed.most_bytes(len(raw)))
    return raw if packed.packed_form(raw) is None else packed.unpacked(raw, path, most)


def _raw(place: Path, limit: int = -1) -> bytes:
    """Return all bytes of a file on disk, or the first ``limit`` bytes."""
    try:
        if place.is_dir():
            raise InputError("a folder where a log is expected", path=place)
        with opened(place, "a log") as file:
            return file.read(limit)
    except FileNotFoundError as error:
        raise InputError("the file does not exist", cause="a misspelt path", path=place) from error
    except PermissionError as error:
        raise InputError("no permission to read", cause="the file belongs to another user", path=place) from error
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read ({error})", path=place) from error


def ingest(
    paths: Sequence[str | Path] | str | Path, *, options: _OptionsFor | None = None, reader: str | None = None
) -> Ingested:
    """Read files and folders.

    Parameters
    ----------
    paths : sequence of path
        Files, folders and archives (zip, tar). Folders are searched recursively, in sorted order; hidden files are
        ignored. For a flight file of ``ingest -o``, its logs are returned.
    options : ReadOptions or callable, optional
        Facts that are not in the files. A callable returns the facts for a path.
    reader : str, optional
        Name of the reader. Default: detected by content.

    Returns
    -------
    Ingested
        List of :class:`IngestedFile`; its ``skipped`` lists files of folders that were not read.

    Raises
    ------
    InputError
        If a named file cannot be read or has an unknown format, or a folder does not contain a log.
    UsageError
        If an option is missing (``timezone:``) or the reader is unknown.
    """
    chosen = by_name(reader) if reader is not None else None
    files: list[IngestedFile] = []
    skipped: list[Skipped] = []
    places = [Path(path) for path in ([paths] if isinstance(paths, (str, Path)) else paths)]
    _check_readable(places)
    for place in places:
        inside, skipped_below = _below(place, options, chosen)
        files += inside
        skipped += skipped_below
    if any(file.result.reader == "generic_csv" for file in files):
        # the mapped columns belong to one table: read only tables with them, and other files with their own readers
        refused = [item for item in skipped if isinstance(item.error, UsageError)]
        skipped = [item for item in skipped if item not in refused]
        for item in refused:
            try:
                files.append(read_file(item.path, options=options))
            except AerpawCmpError as error:
                skipped.append(Skipped.of(Path(item.path), (), error))
    if lacking := [item.error for item in skipped if isinstance(item.error, UsageError)]:
        lacking[0].others = Ingested(files, [item for item in skipped if item.error not in lacking])
        raise lacking[0]
    return Ingested(files, skipped)


def _check_readable(places: Sequence[Path]) -> None:
    """Raise InputError for all files that cannot be opened, because reading a folder may take minutes."""
    errors = []
    # a path may name a member of an archive, which does not exist on disk
    for place in (place for place in places if not _is_folder(place) and _part_of(place) is None):
        try:
            _raw(place, 1)
        except InputError as error:
            errors.append(error)
    if len(errors) > 1:
        listed = "; ".join(f"{one_line(str(error.path))}: {error.found}" for error in errors[:5])
        more = f"; and {len(errors) - 5} more" if len(errors) > 5 else ""
        raise InputError(
            f"{len(errors)} of {len(places)} paths cannot be read: {listed}{more}",
            expected="files and folders that exist",
            cause=errors[0].cause,
        )
    if errors:
        raise errors[0]


# Logs that were read, and files that were skipped.
_Found = tuple[list[IngestedFile], list[Skipped]]


def _below(place: Path, options: _OptionsFor | None, chosen: Reader | None) -> _Found:
    """Read a file, a folder, an archive or a flight file: return its logs and the skipped files."""
    if (is_folder := _is_folder(place)) or _is_archive(place):
        inside, skipped = (_folder if is_folder else _archive)(place, options, chosen)
    elif _is_flight_file(place):
        return _flight_file(place, chosen), []
    else:
        return [read_file(place, options=options, reader=chosen)], []
    if not inside and not any(isinstance(item.error, UsageError) for item in skipped):
        known = "a reader recognises" if chosen is None else f"reader {chosen.name!r} can read"
        looked = counted(len(skipped), "file")
        first = f"; {one_line(Path(skipped[0].path).name)}: {skipped[0].reason}" if skipped else ""
        raise InputError(
            f"the {'folder' if is_folder else 'archive'} contains no log that {known} ({looked} tested){first}",
            expected="one of the formats of 'aerpaw-cmp formats'",
            path=place,
        )
    return _join(inside), skipped


def _is_flight_file(place: Path) -> bool:
    return _head(place, len(_HDF5)) == _HDF5


def _flight_file(place: Path, chosen: Reader | None) -> list[IngestedFile]:
    return [replace(_of_kind(item, chosen, place), holder=str(place)) for item in read_flight(place)]


def as_utf8(data: bytes) -> bytes:
    """Return text without its byte order mark, and UTF-16 (written by PowerShell's ``>``) as UTF-8.

    Examples
    --------
    >>> as_utf8("a".encode("utf-16"))
    b'a'
    """
    if data[:2] in _UTF_16:
        text = data.decode("utf-16", errors="replace")
        # a binary file may begin with the same two bytes
        return data if "\0" in text or text.count("\ufffd") > 8 else text.encode()
    if b"\n" not in data and b"\r" in data and b"\0" not in data:  # CR: line ends of old versions of Mac OS
        data = data.replace(b"\r", b"\n")
    return data.removeprefix(b"\xef\xbb\xbf")


# Unlike the methods of Path, these functions do not raise an error for a name that is too long. read_bytes reports it.
_present, _is_folder = os.path.exists, os.path.isdir


def exists(path: Path) -> bool:
    """Check whether a path names a file, a folder, or a member of an archive."""
    return _present(path) or packed.path_in_archive(path) is not None


def _part_of(path: Path) -> tuple[Path, str] | None:
    return None if _present(path) else packed.path_in_archive(path)


def sniffers_of(path: Path) -> list[str]:
    """Return the names of the readers whose sniffers accept a log. Empty for a folder or a log in a flight file."""
    if path.is_dir():
        return []
    if (part := _part_of(path)) is None:
        return [reader.name for reader in claims(_beginning(path)) if reader.kinds]
    if _in_flight_file(path) is not None:
        return []  # a flight file contains the reader of each log
    content = packed.archive_members(read_bytes(part[0])[0], part[0])
    data = as_utf8(content[part[1]].read(DEEP_BYTES)) if part[1] in content else b""
    return [reader.name for reader in claims(data) if reader.kinds]


def _beginning(place: Path, count: int = DEEP_BYTES) -> bytes:
    """Return the first bytes of a log, unpacked and as UTF-8, or no bytes if a packed file is damaged."""
    head = _raw(place, count)
    return as_utf8(head if packed.packed_form(head) is None else packed.head_of(place, count))


# Logs of flight files that were already read, by flight file.
Held = dict[Path, list[IngestedFile]]


def named_log(root: Path, name: str) -> Path:
    """Return the path of an existing file, folder or archive member that a flight file names."""
    path = root / name
    if not exists(path):
        cause = "a wrong path or a wrong --logs-root"
        raise InputError("there is no such log", expected=f"a log below '{root}'", cause=cause, path=path)
    return path


def read_log(
    root: Path, name: str, options: ReadOptions, *, reader: str | None = None, held: Held | None = None
) -> IngestedFile:
    """Read one log that a flight file names.

    Parameters
    ----------
    root : Path
        Folder to which the path is relative.
    name : str
        Path of the log: a file, a folder of pieces, or a member of an archive.
    options : ReadOptions
        Facts that are not in the file.
    reader : str, optional
        Name of the reader. Default: detected by content.
    held : dict, optional
        Flight files that the caller has read before; this call adds those that it reads.

    Returns
    -------
    IngestedFile
        Content of the file, with at least one stream.

    Raises
    ------
    InputError
        If the file is missing, is not a log of this reader, or contains no record.
    UsageError
        If there is no such reader, or an option that it needs is missing.
    """
    path = named_log(root, name)
    if reader is not None:
        _refuse_other_kind(path, by_name(reader))
    if (part := _in_flight_file(path)) is not None:
        files = [_of_kind(_source(*part, held), None if reader is None else by_name(reader), part[0])]
    else:
        files = ingest([path], options=options, reader=reader)
    # a folder of pieces is a single log; several logs would get the same node and channel
    if len(files) != 1:
        names = ", ".join(one_line(Path(item.path).name) for item in files[:4])
        raise UsageError(
            f"{len(files)} logs under one path: {names}",
            expected=f"one of them, such as {name}/{one_line(Path(files[0].path).name)}",
            cause="a folder, an archive or a flight file of several logs",
            path=path,
        )
    (file,) = files
    if not file.result.streams:
        raise InputError(
            "no record could be read",
            expected=f"records of reader {file.result.reader!r}",
            cause=file.result.rejected[0].reason if file.result.rejected else "an aborted run",
            path=path,
        )
    return file


def _refuse_other_kind(path: Path, reader: Reader) -> None:
    """Refuse a log that another reader than the named reader recognises, because it is the wrong file."""
    if reader.name == "generic_csv":
        return  # the user named the columns of this file
    claimed_by = sniffers_of(path)
    if not claimed_by or reader.name in claimed_by:
        return
    raise InputError(
        f"the content is that of {' or '.join(claimed_by)}",
        expected=f"a log of reader {reader.name!r}, as flight.yaml specifies",
        cause="the wrong file, or the wrong 'reader:'",
        path=path,
    )


def _head(place: Path, count: int = HEAD_BYTES) -> bytes:
    """Return the first bytes of a file, or no bytes if it cannot be read, which is reported later."""
    try:
        return _raw(place, count)
    except InputError:
        return b""


def _is_archive(place: Path) -> bool:
    try:
        return packed.is_archive(_beginning(place, 1024))
    except InputError:
        return False  # the error is reported when the file is read


def _archive(place: Path, options: _OptionsFor | None, chosen: Reader | None) -> _Found:
    """Read all logs of an archive, and report files that cannot be read."""
    files: list[IngestedFile] = []
    skipped: list[Skipped] = []
    content = packed.archive_members(read_bytes(place)[0], place)
    if "xl/workbook.xml" in content:
        raise InputError("a spreadsheet (.xlsx)", expected="its table saved as CSV", path=place)
    for name, member in content.items():
        path = place / name
        try:
            files.append(_member(path, member, content, options, chosen))
        except AerpawCmpError as error:
            skipped.append(Skipped.of(path, content, error))
    return files, skipped


def _member(
    path: Path, member: packed.Member, content: Mapping[str, packed.Member], options: _OptionsFor | None,
    chosen: Reader | None,
) -> IngestedFile:  # fmt: skip
    """Read one file of an archive, and unpack it only if it begins like a log."""
    # read only the beginning, because data sets contain recordings of GiB next to their logs
    head = member.read(DEEP_BYTES)
    if chosen is None and member.size > DEEP_BYTES and packed.packed_form(head) is None and not packed.is_archive(head):
        chosen = identify(as_utf8(head), path=str(path))
    unpacked = _unpacked(member.read(None), path)
    digest = hashlib.sha256(unpacked).hexdigest()
    data = as_utf8(unpacked)
    # do not nest archives: each level would multiply the limit of unpacked bytes
    if packed.is_archive(data[:HEAD_BYTES]):
        raise InputError("an archive inside an archive: unpack it", path=path)

    def neighbour(name: str) -> bytes | None:
        file = content.get(f"{member.name.rpartition('/')[0]}/{name}".lstrip("/"))
        return None if file is None else file.read(None)

    return _read(path, data, digest, chosen or identify(data, path=str(path)), options, neighbour)


def _samples_of(name: str, names: Collection[str]) -> str | None:
    """Return the description of a file of samples whose meta file is in the same folder, else None."""
    meta = name.removesuffix(".sigmf-data") + ".sigmf-meta"
    if name.endswith(".sigmf-data") and meta in names:
        return f"not a log: the samples of {Path(meta).name}, read with it"
    return None


def read_file(path: str | Path, *, options: _OptionsFor | None = None, reader: Reader | None = None) -> IngestedFile:
    """Read one file or one member of an archive, as :func:`ingest` does."""
    place = Path(path)
    if (part := _part_of(place)) is not None:
        archive, name = part
        if _in_flight_file(place) is not None:
            return _of_kind(_source(archive, name), reader, archive)
        content = packed.archive_members(read_bytes(archive)[0], archive)
        if name not in content:
            raise InputError(f"the archive has no member {name!r}", cause="a misspelt path", path=archive)
        return _member(place, content[name], content, options, reader)
    head = _beginning(place)
    if reader is None and head:
        # identify the file before reading the rest, because folders contain large files of other kinds
        reader = identify(head, path=str(path))
    pointer = head.startswith(b"version https://git-lfs")
    if reader is not None and head.strip() and not pointer and (file := _in_pieces(place, reader, options)) is not None:
        return file
    data, digest = read_bytes(place)
    data = as_utf8(data)
    if not data.strip() or pointer:
        identify(data, path=str(path))  # raise the error for an empty file or a pointer
    return _read(place, data, digest, reader or identify(data, path=str(path)), options)


def _of_kind(file: IngestedFile, chosen: Reader | None, flight_file: Path) -> IngestedFile:
    """Check that a log in a flight file was read by the named reader, if one is named."""
    if chosen is not None and file.result.reader != chosen.name:
        raise InputError(
            f"{one_line(file.path)} was read by {file.result.reader!r}",
            expected=f"a log of reader {chosen.name!r}",
            cause="another log, or the wrong reader",
            path=flight_file,
        )
    return file


def _in_flight_file(path: Path) -> tuple[Path, str] | None:
    """Return the flight file that contains the log of a path, and the name of the log in it."""
    part = _part_of(path)
    return part if part is not None and _is_flight_file(part[0]) else None


def name_inside(path: str) -> str:
    """Return the end of a log's path, by which the log is found in its flight file.

    Examples
    --------
    >>> name_inside("../logs/a.txt"), name_inside("/home/me/a.txt")
    ('logs/a.txt', 'home/me/a.txt')
    """
    return "/".join(part for part in Path(os.path.normpath(path)).parts if part not in ("..", "/"))


def _source(flight_file: Path, name: str, held: Held | None = None) -> IngestedFile:
    """Return one of the logs in a flight file by its path or by the end of its path."""
    held = {} if held is None else held
    # read the flight file once for all logs in flight.yaml that refer to it
    files = held[flight_file] = held.get(flight_file) or read_flight(flight_file)
    named = [item for item in files if item.path == name or Path(item.path).as_posix().endswith(f"/{name}")]
    if len(named) != 1:
        known = ", ".join(one_line(item.path) for item in files)
        raise InputError(f"{len(named)} of its logs are called {name!r}", expected=f"one of {known}", path=flight_file)
    return named[0]


def _in_pieces(place: Path, reader: Reader, options: _OptionsFor | None) -> IngestedFile | None:
    """Read a log in pieces if its reader can, else return None. UTF-16 is never read in pieces."""
    if reader.read_pieces is None or _raw(place, 2) in _UTF_16:
        return None
    chosen, digest = _options(place, options, _neighbour_reader(place)), hashlib.sha256()
    read_pieces = reader.read_pieces
    result = _checked(place, reader, chosen, lambda: read_pieces(packed.file_pieces(place, digest), chosen))
    return IngestedFile(str(place), digest.hexdigest(), result)


def _options(path: Path, options: _OptionsFor | None, neighbour: Callable[[str], bytes | None]) -> ReadOptions:
    chosen = options(path) if callable(options) else options or ReadOptions()
    return replace(chosen, file_name=path.name, neighbour=neighbour)


def _neighbour_reader(path: Path) -> Callable[[str], bytes | None]:
    """Return a function that reads another file of a log's folder."""

    def read(name: str) -> bytes | None:
        neighbour = path.parent / Path(name).name
        return read_bytes(neighbour)[0] if neighbour.is_file() else None

    return read


def _read(
    path: Path, data: bytes, digest: str, reader: Reader, options: _OptionsFor | None,
    neighbour: Callable[[str], bytes | None] | None = None,
) -> IngestedFile:  # fmt: skip
    chosen = _options(path, options, neighbour or _neighbour_reader(path))
    return IngestedFile(str(path), digest, _checked(path, reader, chosen, lambda: reader.read(data, chosen)))


def _checked(path: Path, reader: Reader, options: ReadOptions, read: Callable[[], ReadResult]) -> ReadResult:
    """Return the result of a reader with impossible values flagged, and name the file in errors."""
    from . import limits, readers  # import here, because these modules load pandas

    expected, cause = f"lines such as {reader.sample!r}", "a log of another kind, or a damaged one"
    with parsing(path, expected, cause), blaming(reader.plugin, f"reader {reader.name!r} read it", InputError):
        result = readers.stated(limits.check(_later(read(), options.gps_rollovers)), reader, options)
    if not any(len(stream.frame) for stream in result.streams):
        first = f": {result.rejected[0].reason}: {result.rejected[0].text[:80]!r}" if result.rejected else ""
        raise InputError(
            f"reader {reader.name!r} found no record in {counted(result.lines, 'line')}{first}",
            expected=f"lines such as {reader.sample!r}",
            cause="a log of another kind, or an aborted run",
            path=path,
        )
    return result


# GPS receivers count weeks modulo 1 024 (IS-GPS-200). After a rollover, their dates are too early by this number of
# days.
ROLLOVER_DAYS = 7 * 1024
# Start of the first LTE networks. A log with an earlier date has a wrong clock.
_PLAUSIBLE_FROM = datetime(2009, 12, 1)
# Dates after this are wrong. For example, counts of LabVIEW (from 1904) and NTP (from 1900) become dates after 2080 if
# they are read as Unix time.
_FUTURE = datetime(2050, 1, 1)


def _later(result: ReadResult, rollovers: int) -> ReadResult:
    """Return a result with 1 024 weeks added to its times for each rollover of the receiver's week number.

    Without rollovers, dates before the first LTE networks (2009) are reported if one rollover makes them plausible.
    """
    streams, days = result.streams, rollovers * ROLLOVER_DAYS
    first = min((s.frame["time"].min() for s in streams if len(s.frame)), default=_PLAUSIBLE_FROM)
    if rollovers:
        shift = timedelta(days=days)
        streams = tuple(replace(s, frame=s.frame.assign(time=s.frame["time"] + shift)) for s in streams)
        text = f"{counted(rollovers, 'rollover')} of the GPS week number: {days} days were added to the times"
    elif first >= _FUTURE:
        text = f"the dates begin on {first:%Y-%m-%d}, in the future: do the times count from 1904 or 1900, not 1970?"
    elif _PLAUSIBLE_FROM - timedelta(days=ROLLOVER_DAYS) < first < _PLAUSIBLE_FROM:
        way = "'gps_rollovers: 1' next to the log in flight.yaml adds 1 024 weeks"
        rolled = f"if the week number of the GPS receiver rolled over, {way}"
        relative = streams[0].attributes.get("clock") == "relative"
        text = f"the dates begin on {first:%Y-%m-%d}: {'do they count from 2001 or 1980?' if relative else rolled}"
    else:
        return result
    return replace(result, streams=streams, warnings=(*result.warnings, text))


def _inside(
    place: Path, options: _OptionsFor | None, chosen: Reader | None, before: Sequence[IngestedFile] | None
) -> _Found:  # fmt: skip
    """Read a file of a folder: a log, an archive, or, if ``before`` is given, the other logs of a flight file."""
    if before is None:
        if _is_archive(place):
            return _archive(place, options, chosen)
        return [read_file(place, options=options, reader=chosen)], []
    known = {file.sha256 for file in before}
    inside = [file for file in _flight_file(place, chosen) if file.sha256 not in known]
    return inside, [] if inside else [Skipped(str(place), "a flight file without further logs")]


def _folder(folder: Path, options: _OptionsFor | None, chosen: Reader | None) -> _Found:
    """Read all logs below a folder, and report files that cannot be read."""
    files: list[IngestedFile] = []
    skipped: list[Skipped] = []
    try:
        # sort by name, because disks list files in different orders, and joined pieces and logs with equal clocks keep
        # the order
        places = sorted(p for p in folder.rglob("*") if not p.name.startswith(".") and (p.is_file() or p.is_symlink()))
    except OSError as error:
        raise InputError(f"the folder cannot be searched ({error})", path=folder) from error
    is_flight_file = {place: _is_flight_file(place) for place in places}
    # read flight files last, because they may contain logs of the folder
    for place in sorted(places, key=is_flight_file.__getitem__):
        if not place.is_file():  # do not follow links to folders, which may form a circle
            what = "a link to a folder: name that folder as well" if place.is_dir() else "a broken link"
            skipped.append(Skipped(str(place), what))
            continue
        try:
            inside, below = _inside(place, options, chosen, files if is_flight_file[place] else None)
        except AerpawCmpError as error:
            meta = place.with_suffix(".sigmf-meta")
            inside, below = [], [Skipped.of(place, {meta.name} if meta.exists() else (), error)]
        files += inside
        skipped += below
    return files, skipped


def summary(files: Sequence[IngestedFile]) -> dict[str, Any]:
    """Return the output of ``ingest --json``: files, their account, streams and warnings, and skipped files."""
    entries = [
        {
            "path": file.path,
            "reader": file.result.reader,
            "lines": file.result.lines,
            "accepted": file.result.accepted,
            "rejected": file.result.rejected_count,
            "first_rejected": [asdict(line) for line in file.result.rejected[:_FIRST_REJECTED]],
            "blank": file.result.blank,
            "streams": [_entry(stream) for stream in file.result.streams],
            "warnings": list(file.result.warnings),
        }
        for file in files
    ]
    skipped = [{"path": s.path, "reason": s.reason} for s in getattr(files, "skipped", ())]
    warnings = [f"{file.path}: {text}" for file in files for text in file.result.warnings]
    return {"files": entries, "skipped": skipped, "warnings": warnings}


def _entry(stream: Stream) -> dict[str, Any]:
    """Return a stream with its first and last time (ISO, UTC) and mean rate, which are None if they are undefined."""
    entry: dict[str, Any] = {"kind": stream.kind, "name": stream.name, "rows": stream.rows}
    start, end, rate = None, None, None
    if stream.rows:
        first, last = stream.frame["time"].min(), stream.frame["time"].max()
        seconds = (last - first).total_seconds()
        start, end = first.isoformat() + "Z", last.isoformat() + "Z"
        rate = (stream.rows - 1) / seconds if seconds > 0 else None
    return {**entry, "start": start, "end": end, "rate_hz": rate, "attributes": dict(stream.attributes)}


def account_notes(account: Mapping[str, Any]) -> list[str]:
    """Return warnings, the first rejected lines and the skipped files, one line each."""
    notes = []
    for file in account["files"]:
        path = one_line(file["path"])
        notes += [f"{path}: {text}" for text in file["warnings"]]
        for line in file["first_rejected"]:
            notes.append(f"{path}:{line['number']}: rejected: {line['reason']}: {line['text'][:80]!r}")
        more = file["rejected"] - len(file["first_rejected"])
        if more:
            lines = "line" if more == 1 else "lines"
            notes.append(f"{path}: and {more} more rejected {lines}, all in the flight file (-o)")
    return notes + [f"{one_line(skip['path'])}: skipped: {skip['reason']}" for skip in account["skipped"]]


# --- pieces of one log: a folder of thousands of bursts is read as one file ------------------------------------------


def _join(files: Sequence[IngestedFile]) -> list[IngestedFile]:
    """Join the pieces of one folder and reader under the name of the folder, and keep the order of the files."""
    kinds = {reader.name for reader in catalogue() if reader.pieces}
    groups: dict[tuple[str, str], list[IngestedFile]] = {}
    for file in files:
        if file.result.reader in kinds and all(len(s.frame) <= _PIECE_RECORDS for s in file.result.streams):
            groups.setdefault((str(Path(file.path).parent), file.result.reader), []).append(file)
    joined: dict[str, IngestedFile | None] = {}
    for (folder, _), group in groups.items():
        if len(group) > 1:
            # put the joined log at the position of its first piece
            joined |= {file.path: None for file in group[1:]}
            joined[group[0].path] = _joined(folder, group)
    return [kept for file in files if (kept := joined.get(file.path, file)) is not None]


def _joined(folder: str, group: Sequence[IngestedFile]) -> IngestedFile:
    """Join pieces into one log that contains the lines of all pieces, one after the other."""
    # sorted, so that the digest does not depend on the names of the pieces
    pieces = sorted(file.sha256 for file in group)
    digest = hashlib.sha256("".join(pieces).encode()).hexdigest()
    before = 0
    parts: dict[tuple[str, str], list[tuple[Stream, pd.DataFrame]]] = {}
    rejected: list[RejectedLine] = []
    reasons: list[RejectedReason] = []
    for file in group:
        for stream in file.result.streams:
            frame = stream.frame.assign(line=stream.frame["line"] + before)
            parts.setdefault((stream.kind, stream.name), []).append((stream, frame))
        rejected += [RejectedLine(line.number + before, line.reason, line.text) for line in file.result.rejected]
        reasons += [replace(item, first=item.first + before, last=item.last + before) for item in file.result.reasons]
        before += file.result.lines
    streams = tuple(_joined_stream(part) for part in parts.values())
    warnings = dict.fromkeys(text for file in group for text in file.result.warnings)
    result = ReadResult(
        reader=group[0].result.reader, streams=streams, lines=before,
        accepted=sum(file.result.accepted for file in group), blank=sum(file.result.blank for file in group),
        rejected=tuple(rejected), reasons=by_reason(reasons),
        warnings=(f"{len(group)} files of this folder were joined", *warnings),
    )  # fmt: skip
    return IngestedFile(folder, digest, result)


def _joined_stream(part: Sequence[tuple[Stream, pd.DataFrame]]) -> Stream:
    import pandas as pd

    first = part[0][0]
    about = [stream.attributes for stream, _ in part]
    common = {key: value for key, value in about[0].items() if all(other.get(key) == value for other in about)}
    frame = pd.concat([frame for _, frame in part]).sort_values("time", kind="stable").reset_index(drop=True)
    return Stream(first.kind, first.name, frame, common)

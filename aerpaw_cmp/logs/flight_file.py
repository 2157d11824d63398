"""The flight file: all records of some logs in one HDF5 file, which is written atomically.

Layout (root attributes ``format`` = ``aerpaw-cmp flight``, ``version`` = 1)::

    /files/00000/meta                     JSON: path, sha256, reader, lines, accepted, blank, warnings
    /files/00000/rejected                 JSON: list of [number, reason, text], the first thousand
    /files/00000/reasons                  JSON: list of [reason, count, first line, last line]
    /files/00000/streams/00000/meta       JSON: kind, name, columns [{name, type}], attributes
    /files/00000/streams/00000/C00000     values of the first column, and so on
    /files/00000/streams/00000/C00000.words   JSON: the texts of the codes of a text column

JSON is stored as UTF-8 bytes, because HDF5 strings cannot contain the NUL characters of damaged logs. Times are
int64 nanoseconds of UTC. The file can be read without this package.

The HDF5 data are followed by the word ``AERPAWCS`` and the SHA-256 of all bytes before it, which HDF5 ignores. The
SHA-256 is checked before HDF5 reads the file, because HDF5 would read some damaged bytes as data, and would not return
after reading others. A file without the SHA-256 (truncated, or changed by another program) is checked only by HDF5.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from ..common.errors import InputError, parsed, parsing
from ..common.outputs import OutputFile, Sink
from .records import ReadResult, RejectedLine, RejectedReason, Stream

if TYPE_CHECKING:
    import pandas as pd

    from ..common.units import AnyArray

FORMAT = "aerpaw-cmp flight"
_VERSION = 1
_MAGIC = b"\x89HDF\r\n\x1a\n"
_SEAL = b"AERPAWCS"
_DIGEST_BYTES = 32


@dataclass(frozen=True, slots=True)
class IngestedFile:
    """One file that was read.

    Parameters
    ----------
    path : str
        Path from the user, or path below the user's folder.
    sha256 : str
        SHA-256 of the content after unpacking, which identifies a log under any name and in any archive.
    result : ReadResult
    holder : str
        The flight file from which the log was read. Empty if the log itself was read.
    """

    path: str
    sha256: str
    result: ReadResult
    holder: str = ""


def write_flight(path: str | Path, files: Sequence[IngestedFile]) -> None:
    """Write a flight file atomically: a reader sees the old file or the new file, never a part.

    Raises
    ------
    UsageError
        If the path is an input, a file of another program, or in a missing folder; see
        :class:`~aerpaw_cmp.common.outputs.OutputFile`.
    OutputError
        If the output cannot be written to the disk.
    """
    with OutputFile(Path(path), own=is_flight_file) as output:
        output.write(partial(fill, files=files))


def fill(stream: BinaryIO, files: Sequence[IngestedFile]) -> None:
    """Write the content of a flight file, block by block, to an empty stream that can also be read.

    Raises
    ------
    OSError
        If the stream cannot be written.
    """
    import h5py

    sink = Sink(stream)
    try:
        with h5py.File(sink, "w") as book:
            book.attrs["format"], book.attrs["version"] = FORMAT, _VERSION
            shelf = book.create_group("files")
            for i, file in enumerate(files):
                _write_file(shelf.create_group(f"{i:05d}"), file, sink)
    finally:
        sink.raise_spared()  # raise the first failure of the stream, which causes the later errors of HDF5
    # append the SHA-256, because HDF5 ignores bytes after the end of its data
    size = stream.seek(0, os.SEEK_END)
    digest = _digest(stream, size)
    stream.seek(size)
    stream.write(_SEAL + digest)


def is_flight_file(path: Path) -> bool:
    """Check whether a file is an unchanged flight file, by the SHA-256 at its end."""
    with path.open("rb") as book:
        return _unchanged(book) is True


def _unchanged(book: BinaryIO) -> bool | None:
    """Check whether the SHA-256 at the end fits the content. Return None if there is no SHA-256."""
    size = book.seek(0, os.SEEK_END) - len(_SEAL) - _DIGEST_BYTES
    book.seek(max(size, 0))
    end = book.read()
    return end == _SEAL + _digest(book, size) if size > 0 and end.startswith(_SEAL) else None


def _digest(book: BinaryIO, size: int) -> bytes:
    """Return the SHA-256 of the first ``size`` bytes."""
    digest = hashlib.sha256()
    book.seek(0)
    while size > 0 and (block := book.read(min(size, 1 << 20))):
        digest.update(block)
        size -= len(block)
    return digest.digest()


def _write_file(group: Any, file: IngestedFile, sink: Sink) -> None:
    result = file.result
    known = {
        "reader": result.reader, "lines": result.lines, "accepted": result.accepted, "blank": result.blank,
        "warnings": result.warnings,
    }  # fmt: skip
    _write_json(group, "meta", {"path": file.path, "sha256": file.sha256, **known})
    _write_json(group, "rejected", [[line.number, line.reason, line.text] for line in result.rejected])
    _write_json(group, "reasons", [[item.reason, item.count, item.first, item.last] for item in result.reasons])
    shelf = group.create_group("streams")
    for i, stream in enumerate(result.streams):
        _write_stream(shelf.create_group(f"{i:05d}"), stream, sink)


def _write_stream(group: Any, stream: Stream, sink: Sink) -> None:
    columns = [{"name": str(name), "type": _type(stream.frame[name])} for name in stream.frame.columns]
    known = {"kind": stream.kind, "name": stream.name, "columns": columns, "attributes": dict(stream.attributes)}
    _write_json(group, "meta", known)
    for i, column in enumerate(columns):
        _write_column(group, f"C{i:05d}", stream.frame[column["name"]], column["type"])
        sink.raise_spared()


def _type(column: pd.Series[Any]) -> str:
    kind = column.dtype.kind
    return {"M": "time", "f": "float", "i": "integer", "u": "integer", "b": "boolean"}.get(kind, "text")


# Number of rows that are converted and written at a time: copies of all rows would need more memory than the records.
_AT_ONCE = 1 << 18
_CHUNK = 1 << 16


def _write_column(group: Any, name: str, column: pd.Series[Any], kind: str) -> None:
    import numpy as np

    numbers = {"text": np.int32, "time": np.int64, "float": np.float64, "integer": np.int64, "boolean": np.bool_}
    count = len(column)
    # the shuffle filter and light deflate reduce smooth columns to a tenth in little time
    packing = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "chunks": (min(count, _CHUNK),)}
    packing = packing if count > 256 else {}
    number: dict[str | None, int] = {None: -1}  # the code of a missing text

    def converted(part: Any) -> AnyArray:
        if kind == "text":
            return _codes(part, number)
        stamps = part.astype("datetime64[ns]") if kind == "time" else part
        return np.asarray(stamps.astype(numbers[kind]))

    cells = column.to_numpy()
    place = group.create_dataset(name, (count,), numbers[kind], **packing)
    for first in range(0, count, _AT_ONCE):
        place[first : first + _AT_ONCE] = converted(cells[first : first + _AT_ONCE])
    if kind == "text":
        _write_json(group, f"{name}.words", list(number)[1:])


def _codes(part: AnyArray, number: dict[str | None, int]) -> AnyArray:
    """Return the numbers of texts, and number new texts.

    pandas.factorize is not used, because up to version 2.3 it cuts texts off at a NUL.
    """
    import numpy as np
    import pandas as pd

    cells = part.tolist()
    # convert each different cell once, because a text column has few different values
    texts = {cell: None if pd.isna(cell) else str(cell) for cell in dict.fromkeys(cells)}
    code = {cell: number.setdefault(text, len(number) - 1) for cell, text in texts.items()}
    return np.fromiter(map(code.__getitem__, cells), np.int32, len(cells))


def _write_json(group: Any, name: str, content: Any) -> None:
    import numpy as np

    # escape invalid bytes (lone surrogates), which UTF-8 cannot encode
    text = json.dumps(content, ensure_ascii=True).encode("ascii")
    group.create_dataset(name, data=np.frombuffer(text, dtype=np.uint8))


@parsed("a flight file of 'aerpaw-cmp ingest -o'")
def read_flight(path: str | Path) -> list[IngestedFile]:
    """Read a flight file.

    Raises
    ------
    InputError
        If the file is missing, damaged, not a flight file, or of a newer version.
    """
    from ..common import native

    content = Path(path).read_bytes()
    if not content.startswith(_MAGIC):
        raise InputError("not an HDF5 file", expected="a flight file of 'aerpaw-cmp ingest -o'", path=path)
    if _unchanged(io.BytesIO(content)) is False:
        raise InputError(
            "the flight file is damaged (its content does not have the SHA-256 written with it)",
            expected="the bytes that 'aerpaw-cmp ingest -o' wrote",
            cause="a failing disk or transfer: copy it again or ingest the logs again",
            path=path,
        )
    items, notes = native.read("hdf5", content)
    form, version = notes["attributes"].get("format"), notes["attributes"].get("version")
    if form != FORMAT:
        raise InputError("an HDF5 file of another kind", expected="a flight file", path=path)
    if version != _VERSION:
        found, expected = f"flight file of version {version}", f"version {_VERSION}"
        raise InputError(found, expected=expected, cause="another version of this tool wrote it", path=path)
    cause = "a truncated copy, or a file of another version of this tool: ingest the logs again"
    with parsing(path, "a flight file of 'aerpaw-cmp ingest -o'", cause, any_shape=True):
        return [_read_file(items, name) for name in _numbered(items, "files/")]


def _numbered(items: Mapping[str, AnyArray], shelf: str) -> list[str]:
    """Return the groups below a group as paths that end with a slash."""
    return sorted({shelf + name[len(shelf) :].split("/")[0] + "/" for name in items if name.startswith(shelf)})


def _read_file(items: Mapping[str, AnyArray], group: str) -> IngestedFile:
    meta = _read_json(items[f"{group}meta"])
    rejected = tuple(RejectedLine(*entry) for entry in _read_json(items[f"{group}rejected"]))
    reasons = tuple(RejectedReason(*entry) for entry in _read_json(items[f"{group}reasons"]))
    streams = tuple(_read_stream(items, name) for name in _numbered(items, f"{group}streams/"))
    result = ReadResult(
        reader=meta["reader"], streams=streams, lines=meta["lines"], accepted=meta["accepted"], blank=meta["blank"],
        rejected=rejected, reasons=reasons, warnings=tuple(meta["warnings"]),
    )  # fmt: skip
    return IngestedFile(meta["path"], meta["sha256"], result)


def _read_stream(items: Mapping[str, AnyArray], group: str) -> Stream:
    import pandas as pd

    meta = _read_json(items[f"{group}meta"])
    listed = enumerate(meta["columns"])
    columns = {column["name"]: _read_column(items, f"{group}C{i:05d}", column["type"]) for i, column in listed}
    return Stream(meta["kind"], meta["name"], pd.DataFrame(columns), meta["attributes"])


def _read_column(items: Mapping[str, AnyArray], name: str, kind: str) -> Any:
    import numpy as np
    import pandas as pd

    values = items[name]
    if kind == "time":
        return values.astype("datetime64[ns]")
    if kind != "text":
        return values
    # code -1 means a missing text: it selects the last entry, None
    words = np.array([*_read_json(items[f"{name}.words"]), None], dtype=object)
    return pd.Series(words[values], dtype=object)


def _read_json(content: AnyArray) -> Any:
    return json.loads(content.tobytes())

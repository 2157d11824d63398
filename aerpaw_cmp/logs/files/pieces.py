"""Files that are pieces of one log: a folder of thousands of bursts is read as one file."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..flight_file import IngestedFile
from ..readers import catalogue
from ..records import ReadResult, RejectedLine, RejectedReason, Stream, by_reason

if TYPE_CHECKING:
    import pandas as pd

# A file with more records than this in a stream is a log of its own.
_PIECE_RECORDS = 50


def join(files: Sequence[IngestedFile]) -> list[IngestedFile]:
    """Files in order, the pieces of one folder and reader joined under the name of the folder."""
    kinds = {reader.name for reader in catalogue() if reader.pieces}
    groups: dict[tuple[str, str], list[IngestedFile]] = {}
    for file in files:
        if file.result.reader in kinds and all(len(s.frame) <= _PIECE_RECORDS for s in file.result.streams):
            groups.setdefault((str(Path(file.path).parent), file.result.reader), []).append(file)
    joined: dict[str, IngestedFile | None] = {}
    for (folder, _), group in groups.items():
        if len(group) > 1:
            # the first of them stands for all, where it stood in the order
            joined |= {file.path: None for file in group[1:]}
            joined[group[0].path] = _joined(folder, group)
    replaced = [joined.get(file.path, file) for file in files]
    return [file for file in replaced if file is not None]


def _joined(folder: str, group: Sequence[IngestedFile]) -> IngestedFile:
    """One log of the pieces; its lines are theirs, one behind the other."""
    pieces = sorted(file.sha256 for file in group)  # whatever the pieces are called
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
    streams = tuple(_stream(part) for part in parts.values())
    warnings = dict.fromkeys(text for file in group for text in file.result.warnings)
    result = ReadResult(
        reader=group[0].result.reader, streams=streams, lines=before,
        accepted=sum(file.result.accepted for file in group), blank=sum(file.result.blank for file in group),
        rejected=tuple(rejected), reasons=by_reason(reasons),
        warnings=(f"{len(group)} files of this folder were joined", *warnings),
    )  # fmt: skip
    return IngestedFile(folder, digest, result)


def _stream(part: Sequence[tuple[Stream, pd.DataFrame]]) -> Stream:
    import pandas as pd

    first = part[0][0]
    about = [stream.attributes for stream, _ in part]
    common = {key: value for key, value in about[0].items() if all(other.get(key) == value for other in about)}
    frame = pd.concat([frame for _, frame in part]).sort_values("time", kind="stable").reset_index(drop=True)
    return Stream(first.kind, first.name, frame, common)

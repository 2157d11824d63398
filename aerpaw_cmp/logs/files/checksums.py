"""Lines of the log of ``aerpaw-cmp tap``: a JSON object each, its last key the CRC-32 of what stands before it."""

from __future__ import annotations

import json
import zlib
from typing import Any

SCHEMA = "aerpaw-cmp-tap/1"
_CRC = b',"crc":"'

Record = dict[str, Any]


def encode_record(record: Record) -> bytes:
    r"""One line, with its checksum and line end.

    Examples
    --------
    >>> encode_record({"kind": "end", "n": 3})
    b'{"kind":"end","n":3,"crc":"a5ccacec"}\n'
    """
    body = json.dumps(record, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode("ascii")[:-1]
    return body + _CRC + b'%08x"}\n' % zlib.crc32(body)


def decode_record(line: bytes) -> Record:
    """A line's record.

    Raises
    ------
    ValueError
        With the reason, if the line is torn or its checksum is wrong.
    """
    body, mark, tail = line.strip().rpartition(_CRC)
    if not mark or len(tail) != 10 or not tail.endswith(b'"}'):
        raise ValueError("torn line: it does not end with a checksum")
    if b"%08x" % zlib.crc32(body) != tail[:8]:
        raise ValueError("damaged line: its checksum does not fit")
    try:
        record = json.loads(body + b"}")
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(record, dict):
        raise ValueError("not a record")
    return record

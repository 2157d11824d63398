"""Known files that are not logs but are stored with logs, so that the list of files in a folder is complete.

Each entry of ``no_log.yaml`` is a reader without kinds: its sniffer recognises the file, and its title describes it.
These readers are tried if no reader of logs recognises the content.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from aerpaw_cmp.common import kml
from aerpaw_cmp.logs import matfile
from aerpaw_cmp.readers import InputError, Reader, ReadOptions, ReadResult, dictionary, mostly

_PATTERN_MAT = re.compile(r"(?i)(rad_?pat|gain|theta\d?|phi\d?|sa\d{4}|rmwb\d{4}\w*|g[rt]_\w+|pattern\w*|antenna\w*)")
_IS: Mapping[str, Callable[[bytes], bool]] = {
    "kml": kml.is_kml,
    "mat_variables": lambda head: bool(matfile.names_of(head)),
    "antenna_mat": lambda head: any(_PATTERN_MAT.fullmatch(name) for name in matfile.names_of(head)),
}


def _refuse(what: str) -> Callable[[bytes, ReadOptions], ReadResult]:
    def read(_data: bytes, _options: ReadOptions) -> ReadResult:
        raise InputError(f"not a log: {what}", expected="one of the formats of 'aerpaw-cmp formats'")

    return read


def _sniffer(entry: Mapping[str, Any]) -> Callable[[bytes], bool]:
    def sniff(head: bytes) -> bool:
        def has(pattern: str) -> bool:
            return re.search(pattern.encode("latin-1"), head) is not None

        return (
            bool(head.strip())
            and all(_IS[name](head) for name in entry.get("is", ()))
            and not any(_IS[name](head) for name in entry.get("is_not", ()))
            and ("mostly" not in entry or mostly(head, re.compile(entry["mostly"].encode("latin-1"))))
            and all(map(has, entry.get("has", ())))
            and not any(map(has, entry.get("lacks", ())))
        )

    return sniff


READERS: tuple[Reader, ...] = tuple(
    Reader(name=name, title=entry["what"], kinds=(), sample="", sniff=_sniffer(entry), read=_refuse(entry["what"]))
    for name, entry in dictionary.table(Path(__file__).with_suffix(".yaml")).items()
)

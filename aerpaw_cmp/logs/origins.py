"""Provenance of a stream's clock, height datum and identity: written in the file, stated by its program, or assumed.

Attributes ``clock_from``, ``height_from`` (streams with altitudes) and ``identity_from`` (levels and ranks) are one of
``written``, ``program``, ``assumed``; ``clock_source`` and ``height_source`` say what the program or the assumption is.
What a user states in flight.yaml counts as written. What is assumed is a question of the draft.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from .records import Attribute, ReadResult, Stream

if TYPE_CHECKING:
    from .readers import Reader, ReadOptions


def stated(result: ReadResult, reader: Reader, options: ReadOptions) -> ReadResult:
    """A result whose streams say where their clock, height and identity are known from."""
    streams = tuple(
        replace(stream, attributes={**stream.attributes, **_origins(stream, reader, options)})
        for stream in result.streams
    )
    return replace(result, streams=streams)


def _origins(stream: Stream, reader: Reader, options: ReadOptions) -> dict[str, Attribute]:
    about = stream.attributes
    attributes: dict[str, Attribute] = {}
    if "clock_from" not in about:
        attributes |= _split("clock", _clock(stream, reader, options))
    if "height_from" not in about and "altitude_m" in stream.frame and stream.frame["altitude_m"].notna().any():
        attributes |= _split("height", reader.height_from)
    if stream.kind in ("rss", "rank") and "identity_from" not in about:
        # a cell or a connection is an identity as good as a node's name
        named = any(key in about for key in ("node", "pci", "rnti")) or options.node is not None
        attributes["identity_from"] = "written" if named else "assumed"
    return attributes


def _clock(stream: Stream, reader: Reader, options: ReadOptions) -> str:
    if options.clock is not None:
        return "written"
    if stream.attributes.get("clock") == "relative":
        return "assumed: the times are relative, from an unknown origin"
    return reader.clock_from


def _split(what: str, text: str) -> dict[str, Attribute]:
    """``program: datetime.now()`` as two attributes."""
    word, _, source = text.partition(": ")
    return {f"{what}_from": word, **({f"{what}_source": source} if source else {})}


def named_tower(path: str, towers: Sequence[str]) -> str | None:
    """The tower of the site whose name stands in a path, the last where several do; ``lw-1`` is LW1."""
    places = {}
    for tower in towers:
        letters = "[-_ ]?".join(map(re.escape, re.findall(r"\d+|[^\W\d_]+", tower)))
        # LW1 is not in LW12, nor CC in ACCESS
        ends = r"(?!\d)" if tower[-1:].isdigit() else r"(?![^\W_])"
        for match in re.finditer(rf"(?<![^\W_]){letters}{ends}" if letters else r"(?!)", path, re.IGNORECASE):
            places[match.start()] = tower
    # the last: file names stand behind folders
    return places[max(places)] if places else None

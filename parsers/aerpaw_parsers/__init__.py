"""Readers of log formats, one module each, and their catalogue ``READERS``, which aerpaw-cmp finds by its entry point.

A module contains its reader in ``READER``, or several readers in ``READERS``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from aerpaw_cmp.readers import Reader, dictionary


def _readers() -> Iterator[Reader]:
    origins = dictionary.table(Path(__file__).with_name("origins.yaml"))
    clocks, heights = (
        {name: origin for origin, names in origins[what].items() for name in names} for what in ("clocks", "heights")
    )
    for name in origins["formats"]:
        module = import_module(f".{name}", __name__)
        for reader in getattr(module, "READERS", None) or (module.READER,):
            clock, height = clocks.get(reader.name, reader.clock_from), heights.get(reader.name, reader.height_from)
            yield replace(reader, clock_from=clock, height_from=height)


READERS: tuple[Reader, ...] = tuple(_readers())

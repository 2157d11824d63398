"""Readers of log formats, one module each, and their catalogue ``READERS``, which aerpaw-cmp finds by its entry point.

A module contains its reader in ``READER``, or several readers in ``READERS``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from aerpaw_cmp.readers import Reader, dictionary

# Modules in the order in which ``aerpaw-cmp formats`` lists them.
_FORMATS = (
    "vehicle_out", "sounder_log", "flight_mat", "quectel_csv", "quectel_ri", "nemo_csv", "nemo_kml", "drive_test",
    "gnettrack_kml", "controller_log", "srsenb_log", "tap_jsonl", "gpx", "pawprints",
    "srsue_log", "vehicle_log", "quectel_console", "cell_search", "srsran_gnb", "oai_log", "ardupilot_bin",
    "mavlink_tlog", "px4_ulog", "nmea", "rtklib_pos", "dji_srt", "sigmf", "iq_burst", "generic_csv", "no_log",
)  # fmt: skip


def _readers() -> Iterator[Reader]:
    clocks, heights = (
        {name: origin for origin, names in table.items() for name in names}
        for table in dictionary.table(Path(__file__).with_name("origins.yaml")).values()
    )
    for name in _FORMATS:
        module = import_module(f".{name}", __name__)
        for reader in getattr(module, "READERS", None) or (module.READER,):
            clock, height = clocks.get(reader.name, reader.clock_from), heights.get(reader.name, reader.height_from)
            yield replace(reader, clock_from=clock, height_from=height)


READERS: tuple[Reader, ...] = tuple(_readers())

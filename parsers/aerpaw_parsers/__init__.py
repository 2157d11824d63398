"""The log formats, one module each, and their catalogue ``READERS``, which aerpaw-cmp finds by its entry point.

A module contains its reader in ``READER``, or several readers in ``READERS``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module

from aerpaw_cmp.readers import Reader

from ._origins import CLOCKS, HEIGHTS

# Modules in the order in which ``aerpaw-cmp formats`` lists them.
_FORMATS = (
    "vehicle_out", "sounder_log", "flight_mat", "quectel_csv", "quectel_ri", "nemo_csv", "nemo_kml", "drive_test",
    "gnettrack_kml", "controller_log", "srsenb_log", "tap_jsonl", "gpx", "pawprints",
    "srsue_log", "vehicle_log", "quectel_console", "cell_search", "srsran_gnb", "oai_log", "ardupilot_bin",
    "mavlink_tlog", "px4_ulog", "nmea", "rtklib_pos", "dji_srt", "sigmf", "iq_burst", "generic_csv", "no_log",
)  # fmt: skip


def _readers() -> Iterator[Reader]:
    for name in _FORMATS:
        module = import_module(f".{name}", __name__)
        for reader in getattr(module, "READERS", None) or (module.READER,):
            clock, height = CLOCKS.get(reader.name, reader.clock_from), HEIGHTS.get(reader.name, reader.height_from)
            yield replace(reader, clock_from=clock, height_from=height)


READERS: tuple[Reader, ...] = tuple(_readers())

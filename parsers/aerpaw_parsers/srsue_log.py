"""srsUE console (through ``ts``): RSRP, path loss, CFO and SNR of each carrier, once a second.

``[time] cc pci rsrp pl cfo | mcs snr iter brate bler ta_us | mcs buff brate bler``, before 2020 without ``pci`` and
bars. RSRP is in dBm of an uncalibrated front end, so it depends on the gain. Path loss is in dB as the UE computes it,
CFO in Hz with an SI suffix. The console does not print ranks. There is a level stream per cell, and the carrier offset
as KPI.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from aerpaw_cmp.readers import TIME, ZONE, LineFormat, Rows, Stream, text_reader

from . import _cells

_N = rb" +(?P<%s>[-+]?\d{1,7}(?:\.\d{1,6})?[kMGmun]?|n/a|-?inf|nan)"
_ROW = re.compile(
    rb"^\[(?P<time>" + TIME + ZONE + rb")\] *(?P<cc>\d{1,2}|lte|nr)"
    # there is a PCI only if three more numbers come before the bar, because srsLTE before 2020 printed none
    + rb"(?:" + _N % b"pci" + rb"(?=(?: +\S+){3} \|))?" + _N % b"rsrp" + _N % b"pl" + _N % b"cfo"
    + rb"(?: \|)?" + _N % b"mcs" + _N % b"snr" + rb"[^\n|]{0,80}(?:\|[^\n]{0,80})?$", re.MULTILINE,
)  # fmt: skip


def _streams(rows: Rows) -> Iterator[Stream | None]:
    rsrp, loss, snr, cfo, pci = (rows.si(name) for name in ("rsrp", "pl", "snr", "cfo", "pci"))
    rats = ["nr" if cc == "nr" else "lte" for cc in rows.text("cc")]
    carrier = [int(cc) if cc.isdigit() else 0 for cc in rows.text("cc")]
    readings = [
        _cells.Reading(i, rats[i], pci[i], np.nan, rsrp[i], serving=True, sinr_db=snr[i], pathloss_db=loss[i])
        for i in range(len(rows))
    ]
    for cc in sorted(set(carrier)):  # two carriers may share a PCI, and the console prints no ARFCN
        of_carrier = [reading for reading in readings if carrier[reading.row] == cc]
        for stream in _cells.streams(rows, of_carrier, source="srsUE"):
            name = f"{stream.name}_cc{cc}" if cc else stream.name
            yield replace(stream, name=name, attributes={**stream.attributes, "channel": rows.options.channel or name})
    yield rows.stream("kpi", "cfo", {"value": cfo}, quantity="CFO", unit="Hz")


_TITLE = rb"^\[[^\]\n]{19,40}\] *(?:(?:cc|rat) +pci +rsrp +pl +cfo +\||cc +rsrp +pl +cfo +mcs +snr)"
READER = text_reader(
    "srsue_log", "srsUE console: RSRP, path loss, CFO", kinds=("rss", "kpi"),
    sample="[2025-01-01 12:00:07.000000]   0    1   -61   61 -4.3k |   0   25   1.0   4.5k    0%  1.6 |  23  83k  19M",
    streams=_streams, lines=LineFormat(
        row=_ROW, mark=re.compile(_TITLE, re.MULTILINE),
        torn=re.compile(rb"^\[[^\]\n]{19,40}\] *(?:\d{1,2}|lte|nr) +\d{1,4} +[^ a-zA-Z]"),
    ),
)  # fmt: skip

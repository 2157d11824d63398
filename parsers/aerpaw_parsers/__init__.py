"""One module per log format; ``READERS`` is the catalogue that aerpaw-cmp finds by its entry point."""

from __future__ import annotations

from aerpaw_cmp.readers import Reader

from . import flight_mat, nemo_csv, sounder_log, vehicle_out

READERS: tuple[Reader, ...] = (
    vehicle_out.READER,
    sounder_log.READER,
    flight_mat.READER,
    nemo_csv.READER,
)

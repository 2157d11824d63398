"""One module per log format; ``READERS`` is the catalogue that aerpaw-cmp finds by its entry point."""

from __future__ import annotations

from aerpaw_cmp.logs.readers import Reader

from . import (
    aadm_snr,
    controller_log,
    flight_mat,
    generic_csv,
    nemo_csv,
    nemo_kml,
    quectel_csv,
    quectel_ri,
    sounder_log,
    srsenb_log,
    tap_jsonl,
    vehicle_out,
)

READERS: tuple[Reader, ...] = (
    vehicle_out.READER,
    sounder_log.READER,
    flight_mat.READER,
    quectel_csv.READER,
    quectel_ri.READER,
    nemo_csv.READER,
    nemo_kml.READER,
    aadm_snr.READER,
    controller_log.READER,
    srsenb_log.READER,
    tap_jsonl.READER,
    generic_csv.READER,
)

"""One module per log format; ``READERS`` is the catalogue that aerpaw-cmp finds by its entry point."""

from __future__ import annotations

from aerpaw_cmp.logs.readers import Reader

from . import (
    aadm_snr,
    controller_log,
    drive_test,
    flight_mat,
    generic_csv,
    gpx,
    nemo_csv,
    nemo_kml,
    no_log,
    pawprints,
    pose_csv,
    quectel_console,
    quectel_csv,
    quectel_ri,
    sounder_log,
    srsenb_log,
    srsue_log,
    tap_jsonl,
    vehicle_log,
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
    drive_test.READER,
    pose_csv.READER,
    aadm_snr.READER,
    controller_log.READER,
    srsenb_log.READER,
    tap_jsonl.READER,
    gpx.READER,
    pawprints.READER,
    srsue_log.READER,
    vehicle_log.READER,
    quectel_console.READER,
    generic_csv.READER,
    *no_log.READERS,
)

"""One module per log format; ``READERS`` is the catalogue that aerpaw-cmp finds by its entry point."""

from __future__ import annotations

from dataclasses import replace

from aerpaw_cmp.logs.readers import Reader

from . import (
    _origins,
    aadm_snr,
    amarisoft,
    ardupilot_bin,
    controller_log,
    drive_test,
    flight_mat,
    generic_csv,
    gnettrack_kml,
    gpx,
    iq_burst,
    mavlink_tlog,
    nemo_csv,
    nemo_kml,
    no_log,
    oai_log,
    own_csv,
    pawprints,
    pose_csv,
    px4_ulog,
    quectel_console,
    quectel_csv,
    quectel_ri,
    sigmf,
    sounder_log,
    srsenb_log,
    srsran_gnb,
    srsue_log,
    tap_jsonl,
    vehicle_log,
    vehicle_out,
)

_READERS: tuple[Reader, ...] = (
    vehicle_out.READER,
    sounder_log.READER,
    flight_mat.READER,
    quectel_csv.READER,
    quectel_ri.READER,
    nemo_csv.READER,
    nemo_kml.READER,
    drive_test.READER,
    gnettrack_kml.READER,
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
    srsran_gnb.READER,
    srsran_gnb.JSON_READER,
    oai_log.READER,
    amarisoft.READER,
    amarisoft.JSON_READER,
    ardupilot_bin.READER,
    mavlink_tlog.READER,
    px4_ulog.READER,
    sigmf.READER,
    iq_burst.READER,
    own_csv.READER,
    generic_csv.READER,
    *no_log.READERS,
)
READERS: tuple[Reader, ...] = tuple(
    replace(
        reader,
        clock_from=_origins.CLOCKS.get(reader.name, reader.clock_from),
        height_from=_origins.HEIGHTS.get(reader.name, reader.height_from),
    )
    for reader in _READERS
)

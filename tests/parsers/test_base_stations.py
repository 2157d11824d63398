"""Base stations, UEs, SigMF, bursts and our own exports: base and averaging of RI, and what each value means."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.ingest import sniffers_of
from aerpaw_cmp.logs.readers import ReadOptions, by_name
from aerpaw_cmp.logs.records import ReadResult
from aerpaw_parsers import _json
from tests.parsers import samples

PLAIN = ReadOptions(timezone="America/New_York")


def read(reader: str, data: bytes, options: ReadOptions = PLAIN) -> ReadResult:
    return by_name(reader).read(data, options)


@pytest.mark.parametrize(
    ("reader", "data", "ranks", "means"),
    [
        ("srsran_gnb", samples.FILES["srsran_gnb/console"], [2.0, None, None], [2.0, 2.2, None]),
        ("srsran_gnb", samples.FILES["srsran_gnb/old_console"], [1.0], [1.0]),
        ("srsran_gnb", samples.FILES["srsran_gnb/log"], [2.0], [2.0]),
        ("srsran_json", samples.FILES["srsran_json/metrics"], [2.0, None], [2.0, 1.5]),
    ],
)
def test_a_mean_of_ranks_is_no_rank(
    reader: str, data: bytes, ranks: list[float | None], means: list[float | None]
) -> None:
    (stream,) = read(reader, data).streams
    assert stream.attributes["ri_base"] == "one"
    assert "mean" in str(stream.attributes["source"])
    assert [None if np.isnan(v) else v for v in stream.frame["rank"]] == ranks
    assert [None if np.isnan(v) else v for v in stream.frame["rank_mean"]] == means
    assert stream.frame["time"][0].floor("s") == pd.Timestamp("2025-03-02T15:00:00")


def test_a_message_before_the_first_report_does_not_hide_the_format(tmp_path: Path) -> None:
    log = tmp_path / "metrics.json"
    log.write_bytes(b"Metrics server is listening on 127.0.0.1:8001\n" + samples.FILES["srsran_json/metrics"])
    assert sniffers_of(log) == ["srsran_json"]
    # a match within one line keeps the search of a file of empty lines linear
    found = _json._ON_A_LINE.search(b"\n\n\n [{")
    assert found is not None
    assert found.start() == 3


def test_the_form_of_most_times_of_reports_is_that_of_all() -> None:
    line = samples.FILES["srsran_json/metrics"].splitlines(keepends=True)[0]
    (epoch,) = re.findall(rb'"timestamp": ?([0-9.]+)', line)
    data = line * 5 + line.replace(epoch, b'"no time"') * 4
    assert read("srsran_json", data).accepted == 5


@pytest.mark.parametrize("rnti", [b"70.5", b"-1", b"1e300", b'"x"'])
def test_a_number_that_is_no_rnti_is_no_identity(rnti: bytes) -> None:
    data = re.sub(rb'"rnti": ?\d+', b'"rnti": ' + rnti, samples.FILES["srsran_json/metrics"], count=1)
    result = read("srsran_json", data)
    assert sum(len(stream.frame) for stream in result.streams) == 2


def test_reports_with_times_of_the_day_alone_pass_midnight() -> None:
    line = samples.FILES["srsran_json/metrics"].splitlines(keepends=True)[0]
    (epoch,) = re.findall(rb'"timestamp": ?([0-9.]+)', line)
    data = b"".join(
        line.replace(epoch, b'"%s"' % time) for time in (b"23:59:58", b"23:59:59", b"00:00:00", b"00:00:01")
    )
    options = replace(PLAIN, file_name="gnb_2025-03-02.json")
    time = by_name("srsran_json").read(data, options).streams[0].frame["time"].to_numpy()
    assert (time[1:] - time[:-1] == np.timedelta64(1, "s")).all()


def test_sigmf_of_single_bursts_and_the_sounder() -> None:
    meta = {
        "global": {"core:datatype": "cf32_le", "gps:position": {"x": -78.7, "y": 35.73, "z": 30}},
        "captures": [
            {"core:sample_start": 0, "core:timestamp": 1740927600.25, "core:rx_location": {"latitude": 35.5, "longitude": -78.5},
             "core:rotation": {"pitch": 1, "roll": 2, "yaw": 3}},
        ],
    }  # fmt: skip
    (track,) = read("sigmf", json.dumps(meta).encode()).streams
    assert track.frame.iloc[0][["yaw_deg", "roll_deg"]].tolist() == [3.0, 2.0]


def test_power_of_sigmf_samples() -> None:
    """A carrier of amplitude a has the power 20 log10 a, for each data type."""
    rate = 10_000
    phase = np.exp(2j * np.pi * 0.01 * np.arange(600))
    amplitude = np.repeat([0.5, 0.05, 0.005], 200)
    wave = phase * amplitude
    meta = {
        "global": {"core:datatype": "", "core:sample_rate": rate},
        "captures": [{"core:sample_start": 0, "core:datetime": "2025-03-02T15:00:00Z"}],
    }
    for kind, data in (
        ("cf32_le", np.stack([wave.real, wave.imag], axis=1).astype("<f4").tobytes()),
        ("ci16_le", np.round(np.stack([wave.real, wave.imag], axis=1) * 2**15).astype("<i2").tobytes()),
    ):
        meta["global"]["core:datatype"] = kind  # type: ignore[index]
        options = replace(PLAIN, file_name="b.sigmf-meta", neighbour={"b.sigmf-data": data}.get)
        (stream,) = read("sigmf", json.dumps(meta).encode(), options).streams
        assert stream.frame["rss_db"].tolist() == pytest.approx([-6.0206, -26.0206, -46.0206], abs=0.01)
        assert (stream.frame["time"].diff().dropna().dt.total_seconds() == 0.02).all()
    with pytest.raises(InputError, match="samples cannot be read"):
        read("sigmf", json.dumps(meta).encode())
    meta["captures"] = [{"core:sample_start": 0}]
    with pytest.raises(InputError, match="have no time and are not read"):
        read("sigmf", json.dumps(meta).encode(), options)


def test_a_burst_says_its_frequency_and_needs_its_name() -> None:
    result = read("iq_burst", samples.iq_mat(), replace(PLAIN, file_name=samples.IQ_NAME))
    assert result.streams[0].attributes["frequency_hz"] == 3.32e9
    with pytest.raises(InputError, match="name of the burst"):
        read("iq_burst", samples.iq_mat(), replace(PLAIN, file_name="burst.mat"))


def test_an_export_of_the_tap_keeps_its_queries_apart() -> None:
    lte = b"2025-03-02T15:00:00.300Z,0.02,3,lte_csi,ok,4,4,11,9,,\n"
    streams = {stream.name: stream for stream in read("drive_test", samples.FILES["tap_export"] + lte).streams}
    ranks = {name: stream.frame["rank"].tolist() for name, stream in streams.items() if stream.kind == "rank"}
    assert sorted(ranks.values()) == [[2.0], [4.0]]
    (level,) = (stream for stream in streams.values() if stream.kind == "rss")
    assert level.frame["rss_db"].tolist() == [-80.0]
    assert str(level.frame["time"][0]) == "2025-03-02 15:00:00.350000"


def test_objects_over_several_lines_are_read_behind_any_number_of_damaged_ones():
    damaged = b'{"timestamp": 1740927600.25, "cells": ~}\n'
    good = json.dumps({"timestamp": 1740927601.25, "ue_list": []}, indent=2).encode() + b"\n"
    lines = _text.split(40 * damaged + good)
    parsed = _json.objects(lines)
    assert [entry["timestamp"] for entry in parsed.values] == [1740927601.25]
    assert len(parsed.rejected) == 40
    assert parsed.row.tolist() == [40]


def test_reports_without_ranks_are_refused() -> None:
    data = re.sub(rb'"(dl_)?ri":', b'"dl_mcs_x":', samples.FILES["srsran_json/metrics"])
    with pytest.raises(InputError, match="no UE has a rank"):
        read("srsran_json", data)

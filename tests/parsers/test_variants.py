"""Logs that were changed by editors, spreadsheets or shells give the same records."""

import re
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import by_name, identify
from tests.parsers.samples import BINARY, FILES, OPTIONS, SAMPLES

TEXTS = [
    (reader, name, data, accepted)
    for reader, cases in SAMPLES.items()
    for name, (data, accepted, _) in cases.items()
    if reader not in BINARY
]
VARIANTS = {
    "byte order mark": lambda data: b"\xef\xbb\xbf" + data,
    "utf-16": lambda data: data.decode().encode("utf-16"),
    "spaces at the end of lines": lambda data: re.sub(rb"\r?\n", b" \n", data),
    "tabs at the end of lines": lambda data: re.sub(rb"\r?\n", b"\t\n", data),
    "a blank line behind each": lambda data: data.replace(b"\n", b"\n\n"),
    "blank lines in front": lambda data: b"\r\n \n" + data,
    "blank lines at the end": lambda data: data + b"\n\n" if data.endswith(b"\n") else data,
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_line_ends_and_marks_change_nothing(variant: str, tmp_path: Path) -> None:
    for reader, name, data, accepted in TEXTS:
        place = tmp_path / OPTIONS.file_name
        place.write_bytes(VARIANTS[variant](data))
        options = replace(OPTIONS, columns=OPTIONS.columns if reader == "generic_csv" else {})
        (file,) = ingest(place, options=options, reader="generic_csv" if reader == "generic_csv" else None)
        assert (file.result.reader, file.result.accepted) == (reader, accepted), (reader, name)


LATE = ("controller_log", "srsenb_log", "srsue_log", "quectel_console", "srsran_gnb", "oai_log")


@pytest.mark.parametrize(("reader", "name"), [(r, name) for r in LATE for name in SAMPLES[r]])
def test_a_table_that_begins_behind_long_talk_is_found(reader: str, name: str, tmp_path: Path) -> None:
    talk = b"[2025-03-02 09:59:00.000000] --  Software Radio Systems LTE: Setting frequency, please wait\n" * 1500
    data, accepted, _ = SAMPLES[reader][name]
    (tmp_path / "log.txt").write_bytes(talk + data)
    (file,) = ingest(tmp_path / "log.txt", options=OPTIONS)
    assert (file.result.reader, file.result.accepted) == (reader, accepted)


def _cells(data: bytes) -> list[list[bytes]]:
    return [line.split(b",") for line in data.split(b"\r\n")[:-1]]


@pytest.mark.parametrize(
    "change",
    [
        lambda rows: b"\n".join(b",".join(row[::-1]) for row in rows) + b"\n",
        lambda rows: b"\n".join(b";".join(row).replace(b".", b",") for row in rows) + b"\n",
        lambda rows: b"\n".join(b"\t".join(row) for row in rows) + b"\n",
        lambda rows: b"Flight 3\n" + b"\n".join(b",".join([*row, b"x"]) for row in rows) + b"\n",
        lambda rows: b"\n".join(b",".join(b'"' + cell + b'"' for cell in row) for row in rows) + b"\n",
        lambda rows: b",".join(rows[0]).upper() + b"\n" + b"\n".join(b",".join(row) for row in rows[1:]) + b"\n",
    ],
    ids=["order", "decimal comma", "tabs", "title and more columns", "quoted", "capitals"],
)
def test_a_rank_table_in_another_dress_gives_the_same_ranks(change) -> None:  # type: ignore[no-untyped-def]
    usual = by_name("nemo_csv").read(FILES["nemo_csv/table"], OPTIONS).streams[0].frame
    data = change(_cells(FILES["nemo_csv/table"]))
    result = identify(data).read(data, OPTIONS)
    (rank,) = (stream.frame for stream in result.streams if stream.kind == "rank")
    shown = usual[usual["rank"].notna()]
    assert rank["rank"].tolist() == shown["rank"].tolist()
    assert rank["time"].tolist() == shown["time"].tolist()


def test_a_mapped_table_has_any_separator() -> None:
    options = replace(OPTIONS, kind="rss", columns={"time": "Time", "rss_db": "Level"})
    usual = by_name("generic_csv").read(b"Time,Level\n2025-03-02T10:00:00.5,-81.5\n", options).streams[0].frame
    for data in (b"Time;Level\n2025-03-02T10:00:00.5;-81,5\n", b"Time\tLevel\n2025-03-02T10:00:00.5\t-81.5\n"):
        frame = by_name("generic_csv").read(data, options).streams[0].frame
        assert frame["rss_db"].tolist() == usual["rss_db"].tolist()
        assert frame["time"].tolist() == usual["time"].tolist()


def test_what_fuzzing_found() -> None:
    """A dot is not a number. A number has the same value regardless of other lines."""
    log = b"2025-03-02T10:00:00.250000 [METRICS ] [I] Scheduler UE pci=1 rnti=0x4601 cqi=. dl_ri=. dl_mcs=27\n"
    assert by_name("srsran_gnb").read(log, OPTIONS).accepted == 0
    head = FILES["nemo_csv/table"].split(b"\r\n")[0] + b"\n"
    row = b"11,500.0,35.7300002,-78.7000003,3.916381539223372036854775808,2.0,,,\n"
    odd = b"12,600.0,35.73-1e30,-78.7000003,3.9,2.0,,,\n"
    assert by_name("nemo_csv").read(head + row, OPTIONS).accepted == 1
    assert by_name("nemo_csv").read(head + row + odd, OPTIONS).accepted == 1
    dotted = b"11,500.0,35.7300002,-78.7000003,.5,2.0,,,\n"
    assert by_name("nemo_csv").read(head + dotted, OPTIONS).accepted == 0


@pytest.mark.parametrize("name", ["ten_fields", "eleven_fields", "nine_fields", "eight_fields"])
def test_further_fields_behind_a_row_are_left_out(name: str) -> None:
    """A logger may write more fields in every row.

    In a log of the known layout, two rows joined in one line look similar and are rejected.
    """
    data = SAMPLES["vehicle_out"][name][0]
    usual = by_name("vehicle_out").read(data, OPTIONS)
    more = re.sub(rb"(\r?\n)", rb",7.5,AUTO\1", data)
    assert identify(more).name == "vehicle_out"
    longer = by_name("vehicle_out").read(more, OPTIONS)
    assert (longer.accepted, longer.rejected) == (usual.accepted, usual.rejected)
    pd.testing.assert_frame_equal(longer.streams[0].frame, usual.streams[0].frame)
    first, second = data.splitlines(keepends=True)[:2]
    glued = by_name("vehicle_out").read(data * 3 + first.rstrip() + second, OPTIONS)
    assert (glued.accepted, len(glued.rejected)) == (3 * usual.accepted, 3 * len(usual.rejected) + 1)


def test_an_offset_in_the_times_of_the_modem_logger_wins() -> None:
    data = FILES["quectel_csv/csi"]
    zoned = re.sub(rb"(?m)^(20\d\d-\d\d-\d\d) (\d\d:\d\d:\d\d\.\d+)", rb"\1T\2-05:00", data)
    assert zoned != data
    usual = by_name("quectel_csv").read(data, OPTIONS)
    result = by_name("quectel_csv").read(zoned, replace(OPTIONS, timezone=None))
    assert result.accepted == usual.accepted
    for zoned_stream, usual_stream in zip(result.streams, usual.streams, strict=True):
        pd.testing.assert_frame_equal(zoned_stream.frame, usual_stream.frame)

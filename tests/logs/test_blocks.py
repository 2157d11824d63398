"""A log read in blocks says what it says in one piece, wherever it is cut."""

from __future__ import annotations

import gzip
import hashlib
import zipfile
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.logs import blocks
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions, by_name
from aerpaw_cmp.logs.records import ReadResult
from aerpaw_cmp.logs.writers import format_power_log
from tests.frames import assert_same_frame
from tests.parsers import samples

OPTIONS = samples.OPTIONS
TIMES = np.datetime64("2025-03-02T15:00:00", "ns") + np.arange(400) * np.timedelta64(32_760_000, "ns")


def sounder(*, odd: bool) -> bytes:
    """A power log; with ``odd``: suppressed runs, lost samples, clock steps, torn and blank lines."""
    lines = format_power_log(TIMES, np.random.default_rng(3).normal(-40, 9, 400), "America/New_York").splitlines(
        keepends=True
    )
    if odd:
        for i in (40, 41, 42, 200, 333):
            lines[i] = lines[i][:29] + b"*\n"
        del lines[100:107], lines[250:251]
        lines[300], lines[310] = lines[310], lines[300]
        lines[120] = b"torn\n"
        lines[121] = b"\n"
    return b"".join(lines)


def same(one: ReadResult, other: ReadResult) -> None:
    assert (one.lines, one.accepted, one.blank, one.rejected) == (
        other.lines,
        other.accepted,
        other.blank,
        other.rejected,
    )
    assert sorted(one.warnings) == sorted(other.warnings)
    assert [(a.kind, a.name) for a in one.streams] == [(b.kind, b.name) for b in other.streams]
    for a, b in zip(one.streams, other.streams, strict=True):
        assert_same_frame(a.frame, b.frame, check_like=True)
        assert dict(a.attributes) == dict(b.attributes)


CASES = {
    "plain": ("sounder_log", sounder(odd=False)),
    "odd": ("sounder_log", sounder(odd=True)),
    "torn": ("sounder_log", sounder(odd=True)[:-9]),
    "csi": ("quectel_csv", samples.QUECTEL_CSI * 40),
}


@pytest.mark.parametrize("case", CASES)
@given(block=st.integers(600, 6000), chunk=st.integers(300, 3000))
@settings(max_examples=6, deadline=None)
def test_blocks_say_what_one_piece_says(
    tmp_path_factory: pytest.TempPathFactory, case: str, block: int, chunk: int
) -> None:
    reader, data = CASES[case]
    place = tmp_path_factory.mktemp("blocks") / "x_power_log.txt"
    place.write_bytes(data)
    options = replace(OPTIONS, file_name=place.name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blocks, "BLOCK_BYTES", block)
        patch.setattr(blocks, "_CHUNK", chunk)
        result, digest = blocks.read(place, by_name(reader), options)
    same(result, by_name(reader).read(data, options))
    assert digest == hashlib.sha256(data).hexdigest()


LARGE = [
    (reader, name, data)
    for reader, found in samples.SAMPLES.items()
    for name, (data, *_) in found.items()
    if by_name(reader).in_blocks is not None
]


BY_THE_WHOLE = {("oai_log", "frames"), ("oai_log", "ue")}
"""Their clock counts from the start of the log."""
SOMETIMES_WHOLE = {("drive_test", "nemo"), ("drive_test", "nemo_title")}
"""Where a quantity has rows of its own in a later block only."""


def in_two(reader: str, pieces: list[bytes], options: ReadOptions) -> ReadResult:
    """What a reader says of a file that comes in such pieces, each at once a block as far as it has whole lines."""
    read = by_name(reader).in_blocks
    assert read is not None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blocks, "BLOCK_BYTES", 1)
        return read(iter(pieces), options)


@pytest.mark.parametrize(("reader", "name", "data"), LARGE, ids=[f"{reader}-{name}" for reader, name, _ in LARGE])
def test_a_cut_at_any_line_changes_nothing(reader: str, name: str, data: bytes) -> None:
    whole = by_name(reader).read(data, OPTIONS)
    ends = [i + 1 for i in range(len(data)) if data[i : i + 1] == b"\n"]
    if (reader, name) in BY_THE_WHOLE:
        with pytest.raises(blocks.Whole):
            in_two(reader, [data], OPTIONS)
        return
    lines = [data[a:b] for a, b in zip([0, *ends], [*ends, len(data)], strict=True)]
    for pieces in (*([data[:place], data[place:]] for place in ends), lines):
        with nullcontext() if (reader, name) not in SOMETIMES_WHOLE else suppress(blocks.Whole):
            same(in_two(reader, pieces, OPTIONS), whole)


PAIRS = [
    (reader, f"{one}+{two}", head + tail)
    for reader, found in samples.SAMPLES.items()
    for one, (head, *_) in found.items()
    for two, (tail, *_) in found.items()
    if by_name(reader).in_blocks is not None and head.endswith(b"\n")
]


@pytest.mark.parametrize(("reader", "name", "data"), PAIRS, ids=[f"{reader}-{name}" for reader, name, _ in PAIRS])
def test_logs_joined_by_hand_say_in_blocks_what_they_say_in_one_piece(reader: str, name: str, data: bytes) -> None:
    """A block that has other kinds of lines than the one before it decides nothing for itself."""
    try:
        whole = by_name(reader).read(data, OPTIONS)
    except InputError:
        return
    lines = data.splitlines(keepends=True)
    for pieces in (lines, [b"".join(lines[i : i + 3]) for i in range(0, len(lines), 3)]):
        with suppress(blocks.Whole):
            same(in_two(reader, pieces, OPTIONS), whole)


def test_a_cell_on_several_carriers_has_no_carrier_in_blocks_either() -> None:
    line = (
        b'{"abs_time": %d, "connected_pci": 2, "cells": [{"technology": "4G_LTE", "rsrp": -90, "pci": 2, '
        b'"earfcn": %d}]}\n'
    )
    for carriers, expected in (([1, 1, 2, 2, 3, 3], None), ([1, 2, 1, 1, 1, 1], None), ([5] * 6, 5)):
        pieces = [line % (1740927600000 + 1000 * i, carrier) for i, carrier in enumerate(carriers)]
        for size in (1, 2, 3):
            grouped = [b"".join(pieces[i : i + size]) for i in range(0, 6, size)]
            cell = in_two("pawprints", grouped, OPTIONS).streams[0]
            assert cell.attributes.get("arfcn") == expected
        assert by_name("pawprints").read(b"".join(pieces), OPTIONS).streams[0].attributes.get("arfcn") == expected


def test_a_tower_that_has_two_columns_is_one_stream() -> None:
    rows = [b"2025-03-02 10:00:0%d.5,-80.5,-90.5,-70.5\n" % i for i in range(6)]
    log = [b"time,snr_lw1,snr_lw2,snr_LW1\n", *rows]
    whole = by_name("aadm_snr").read(b"".join(log), OPTIONS)
    assert [stream.name for stream in whole.streams] == ["LW1", "LW2"]
    assert whole.streams[0].frame["rss_db"].tolist() == [-80.5] * 6
    assert whole.warnings == ("a second column of LW1 is left out",)
    same(in_two("aadm_snr", log, OPTIONS), whole)


def test_a_loss_written_as_infinite_is_none() -> None:
    title, row = samples.SRSUE.splitlines(keepends=True)[1:3]
    log = [title, row, row.replace(b"   61 -4.2k", b"  inf -4.2k").replace(b":00.000003", b":01.000003")]
    whole = by_name("srsue_log").read(b"".join(log), OPTIONS)
    assert whole.streams[0].frame["pathloss_db"].tolist()[0] == 61.0
    assert np.isnan(whole.streams[0].frame["pathloss_db"].to_numpy()[1])
    same(in_two("srsue_log", log, OPTIONS), whole)


def test_the_most_channels_that_a_base_station_opened_bound_its_ranks() -> None:
    opened = b"[2025-03-02 10:00:00.000001] Opening %d channels in RF device=uhd\n"
    title, row = (line + b"\n" for line in samples.SRSENB.splitlines()[1:3])
    log = [opened % 2, row, row, opened % 1, row, row, title, opened % 4]
    whole = by_name("srsenb_log").read(b"".join(log), OPTIONS)
    assert whole.streams[0].attributes["ports"] == 2  # what was opened behind the last row bounds none
    for size in (1, 2, 3):
        pieces = [b"".join(log[i : i + size]) for i in range(0, len(log), size)]
        same(in_two("srsenb_log", pieces, OPTIONS), whole)


@pytest.mark.parametrize("reader", ["sounder_log", "vehicle_out"])
def test_a_gap_around_a_row_of_no_date_is_seen_at_a_cut_too(reader: str) -> None:
    """The line before a cut is seen by the next block; one that gives no record must not stand there."""
    if reader == "sounder_log":
        rows = [b"[2025-03-02 10:00:%02d.000000] %07o       -20.12345\n" % (i, 4 * i) for i in range(40)]
    else:
        rows = [b"%d,-78.69,35.72,79.9,44.2,80,2022-01-13 14:07:%02d.285580,3,14\n" % (i, i) for i in range(40)]
    for place in range(1, 39):
        damaged = rows[place].replace(b"2025-03-02", b"2025-02-30").replace(b"2022-01-13", b"2022-13-13")
        lines = [*rows[:place], damaged, *rows[place + 1 :]]
        whole = by_name(reader).read(b"".join(lines), OPTIONS)
        assert any("jump" in text for text in whole.warnings)
        same(in_two(reader, lines, OPTIONS), whole)


def test_what_a_row_says_does_not_hang_on_the_others() -> None:
    csi = b'2025-03-02 10:00:%02d.250,"+QNWCFG: ""lte_csi""",20,1,9,%b,"+QNWCFG: ""nr5g_csi""",24,2,12,5\n'
    pose = b"%d,-78.7000001,35.7300002,0.5,48.1,99,2025-03-02 10:00:%02d.250000,5,12%b\r\n"
    for odd in (b"5e8", b"+5", b"5.", b"12345678", b" 5"):
        rows = [csi % (i, odd if i == 3 else b"3") for i in range(6)]
        alone = by_name("quectel_csv").read(rows[3], OPTIONS)
        together = by_name("quectel_csv").read(b"".join(rows), OPTIONS)
        assert (alone.accepted, together.accepted) == (0, 5), odd
    for odd in (3, 5):
        rows = [pose % (i, i, b"\r" if i < odd else b"") for i in range(6)]
        assert by_name("vehicle_out").read(b"".join(rows), OPTIONS).accepted == 6


def test_a_cut_at_any_byte_changes_nothing() -> None:
    for reader, data in (("sounder_log", samples.SOUNDER), ("vehicle_out", samples.VEHICLE_10)):
        whole = by_name(reader).read(data, OPTIONS)
        for place in range(0, len(data) + 1, 3):
            same(in_two(reader, [data[:place], data[place:]], OPTIONS), whole)


def test_large_logs_go_through_blocks_packed_or_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = sounder(odd=True)
    (tmp_path / "a_power_log.txt").write_bytes(data)
    (tmp_path / "b_power_log.txt.gz").write_bytes(gzip.compress(data))
    whole = ingest(tmp_path, options=OPTIONS)
    monkeypatch.setattr(blocks, "FROM_BYTES", 1000)
    monkeypatch.setattr(blocks, "BLOCK_BYTES", 3000)
    monkeypatch.setattr(blocks, "_CHUNK", 1000)
    for one, other in zip(ingest(tmp_path, options=OPTIONS), whole, strict=True):
        same(one.result, other.result)
        assert one.sha256 == other.sha256
    (tmp_path / "b_power_log.txt.gz").write_bytes(gzip.compress(data)[:-3000])
    assert "too early" in ingest(tmp_path, options=OPTIONS).skipped[0].reason
    (tmp_path / "b_power_log.txt.gz").write_bytes(gzip.compress(b"\0" * 300_000))
    with pytest.raises(InputError):
        ingest(tmp_path / "b_power_log.txt.gz", options=OPTIONS, reader="sounder_log")


def test_an_hour_that_came_twice_is_read_in_one_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    times = np.datetime64("2025-11-02T05:30:00", "ns") + np.arange(400) * np.timedelta64(10, "s")
    data = format_power_log(times, np.linspace(-40.0, -50.0, 400), "America/New_York")
    place = tmp_path / "a_power_log.txt"
    place.write_bytes(data)
    monkeypatch.setattr(blocks, "FROM_BYTES", 1000)
    monkeypatch.setattr(blocks, "BLOCK_BYTES", 3000)
    monkeypatch.setattr(blocks, "_CHUNK", 1000)
    (file,) = ingest(place, options=OPTIONS)
    assert file.result.streams[0].frame["time"].tolist() == [pd.Timestamp(t) for t in times]


def test_a_large_member_of_an_archive_goes_through_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = sounder(odd=True)
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as book:
        book.writestr("a_power_log.txt", data)
    (whole,) = ingest(tmp_path / "a.zip", options=OPTIONS)
    seen: list[int] = []
    gathered = blocks.Gathered.add
    monkeypatch.setattr(blocks.Gathered, "add", lambda *a: seen.append(a[1].lines) or gathered(*a))
    monkeypatch.setattr(blocks, "FROM_BYTES", 1000)
    monkeypatch.setattr(blocks, "BLOCK_BYTES", 3000)
    (file,) = ingest(tmp_path / "a.zip", options=OPTIONS)
    same(file.result, whole.result)
    assert seen


@pytest.mark.parametrize(
    ("head", "damaged"), [(b"|    | LTE ", b"xy |    | LTE "), (b"SINR |\n", b"SINR ;\n")], ids=["inside", "endless"]
)
def test_a_damaged_head_of_a_drawn_table_counts_alike_in_blocks(head: bytes, damaged: bytes) -> None:
    """One not at the start of its line was a head in one piece alone; one without an end hid the head before it."""
    data = samples.QUECTEL_CONSOLE + samples.QUECTEL_CONSOLE.replace(head, damaged, 1)
    assert damaged in data
    whole = by_name("quectel_console").read(data, OPTIONS)
    same(in_two("quectel_console", data.splitlines(keepends=True), OPTIONS), whole)
    alone = samples.QUECTEL_CONSOLE.replace(head, damaged, 1)
    same(
        in_two("quectel_console", alone.splitlines(keepends=True), OPTIONS),
        by_name("quectel_console").read(alone, OPTIONS),
    )


def test_a_column_grows_by_pages_and_keeps_its_values(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the size where its room is moved and not copied, with a type that widens on the way."""
    monkeypatch.setattr(blocks, "_ROOM", 500)
    monkeypatch.setattr(blocks, "_AT_ONCE", 37)
    records = blocks.Records()
    expected = []
    for i, size in enumerate((30, 290, 1, 250, 7, 600)):
        more = {
            "line": np.arange(size),
            "flag": np.array([f"reason_{i}_{n % 400}" if n % 3 else "" for n in range(size)], dtype=object),
            "level": np.arange(size) + (0.5 if i > 2 else 0),
        }
        more["level"] = more["level"].astype(np.float64 if i > 2 else np.int64)
        if i > 3:
            more["beside"] = np.full(size, float(i))
        expected.append(pd.DataFrame(more))
        records.extend(more)
    frame = records.frame()
    pd.testing.assert_frame_equal(frame, pd.concat(expected, ignore_index=True).astype({"flag": object}))
    texts = frame["flag"].tolist()
    assert len({id(text) for text in texts}) == len(set(texts)) > 256, "one object per text"


def test_steps_back_are_counted_over_the_edges(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "_AT_ONCE", 3)
    time = np.random.default_rng(3).integers(0, 5, 100)
    assert blocks.steps_back(time.astype("datetime64[ns]")) == (np.diff(time) < 0).sum()


@pytest.mark.parametrize("index", [b"85e8", b"9223372036854775808", b"7.0", b"-3", b"7.5"])
def test_an_index_in_another_form_counts_alike_whatever_stands_beside_it(
    index: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside a row that is no number the pattern decided, and it wanted digits alone."""
    (data, *_) = samples.SAMPLES["nemo_csv"]["table"]
    head, row = data.splitlines(keepends=True)[:2]
    odd = index + row[row.index(b",") :]
    fields = row.split(b",")
    torn = b",".join((*fields[:2], b"35x.7", *fields[3:]))
    log = head + row * 40 + odd + row * 40 + torn + row
    reader = by_name("nemo_csv")
    assert reader.in_blocks is not None
    monkeypatch.setattr(blocks, "BLOCK_BYTES", 10 * len(row))
    same(reader.in_blocks((log[i : i + 100] for i in range(0, len(log), 100)), OPTIONS), reader.read(log, OPTIONS))


def test_a_head_whose_lines_end_twice_is_cut_at_the_line_feed(monkeypatch: pytest.MonkeyPatch) -> None:
    options = ReadOptions(timezone="UTC", kind="rss", columns={"time": "Time", "rss_db": "Level"})
    rows = b"".join(b"2025-03-02T10:00:%02d.5,-81.5\r\r\n" % second for second in range(40))
    reader = by_name("generic_csv")
    assert reader.in_blocks is not None
    monkeypatch.setattr(blocks, "BLOCK_BYTES", 200)
    data = b"Time,Level\r\r\n" + rows
    chunks = (data[i : i + 100] for i in range(0, len(data), 100))
    same(reader.in_blocks(chunks, options), reader.read(data, options))


def test_a_glued_row_before_a_cut_is_read_as_the_log_is() -> None:
    """Alone it looks like the row of a logger with further fields; what those are like the head of the log says."""
    rows = [b"%d,-78.69,35.72,79.9,44.2,2022-01-13 14:07:%02d.285580,3,14\n" % (i, i) for i in range(9)]
    glued = rows[4][:-1] + b",44.3,2022-01-13 14:07:32.286453,3,14\n"
    for lines in ([*rows[:4], glued, *rows[5:]], [row[:-1] + b",7,x\n" for row in rows], [*rows[:1], *[glued] * 9]):
        whole = by_name("vehicle_out").read(b"".join(lines), OPTIONS)
        same(in_two("vehicle_out", lines, OPTIONS), whole)
        assert whole.accepted == (10 if lines[1] == glued else sum(line != glued for line in lines))

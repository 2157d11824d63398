"""Invariants of every reader: it recognises only its format, accounts for each line, and has no raw exceptions."""

import io
import random

import numpy as np
import pytest
import scipy.io
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import AerpawCmpError, InputError
from aerpaw_cmp.logs import limits
from aerpaw_cmp.logs.readers import ReadOptions, by_name, catalogue, claims, identify
from aerpaw_cmp.logs.records import ReadResult
from aerpaw_parsers import drive_test
from tests.long import fuzz_inputs
from tests.parsers.samples import BINARY, CASES, NO_LOGS, OPTIONS, SAMPLES

SNIFFED = [case for case in CASES if case[0] != "generic_csv"]
_CONSOLES = ("quectel_console", "cell_search", "srsran_gnb", "oai_log")
_MARKUP = ("nemo_kml", "gnettrack_kml", "gpx", "dji_srt")
TALK = ("controller_log", "srsenb_log", "srsue_log", "vehicle_log", *_MARKUP, *_CONSOLES)
TEXT_CASES = [case for case in CASES if case[0] not in BINARY]


def check_law(reader: str, data: bytes) -> ReadResult | None:
    """Read a file. A clear error is an answer. Other exceptions and violated invariants fail the test."""
    try:
        result = limits.check(by_name(reader).read(data, OPTIONS))
    except AerpawCmpError:
        return None
    fuzz_inputs.check_law(result, data, reader in BINARY)
    assert all(s.attributes["ri_base"] in ("zero", "one") for s in result.streams if s.kind == "rank")
    return result


@pytest.mark.parametrize(("reader", "sample"), CASES)
def test_sample_is_accounted_for(reader: str, sample: str) -> None:
    data, accepted, rejected = SAMPLES[reader][sample]
    result = check_law(reader, data)
    assert result is not None
    assert (result.accepted, len(result.rejected)) == (accepted, rejected)
    assert result.reader == reader


@pytest.mark.parametrize(("reader", "sample"), SNIFFED)
def test_only_its_own_sniffer_accepts_a_sample(reader: str, sample: str) -> None:
    data = SAMPLES[reader][sample][0]
    assert [other.name for other in claims(data)] == [reader]
    assert identify(data).name == reader


def test_generic_csv_is_never_guessed() -> None:
    assert not any(
        by_name("generic_csv").sniff(data) for samples in SAMPLES.values() for data, _, _ in samples.values()
    )


@pytest.mark.parametrize(
    "reader", ["vehicle_out", "sounder_log", "quectel_csv", "quectel_ri", "nemo_csv", "srsenb_log"]
)
def test_the_sample_line_shown_to_users_is_a_record(reader: str) -> None:
    result = by_name(reader).read(by_name(reader).sample.encode() + b"\n", OPTIONS)
    assert (result.accepted, result.rejected) == (1, ())


def test_every_reader_has_a_sample() -> None:
    assert {reader.name for reader in catalogue() if reader.kinds} == set(SAMPLES)


@pytest.mark.parametrize("kind", NO_LOGS)
def test_what_is_no_log_is_named_and_taken_by_no_reader(kind: str) -> None:
    assert [reader.name for reader in claims(NO_LOGS[kind])] == [kind]
    with pytest.raises(InputError, match="not a log: "):
        identify(NO_LOGS[kind])
    with pytest.raises(InputError, match="not a log: "):
        by_name(kind).read(NO_LOGS[kind], OPTIONS)


def test_antenna_grids_of_matlab_are_no_flight() -> None:
    file = io.BytesIO()
    scipy.io.savemat(file, {"SA3300": np.zeros((61, 120)), "phi2": np.zeros((1, 120))}, do_compression=True)
    with pytest.raises(InputError, match="antenna gain grids"):
        identify(file.getvalue())
    file = io.BytesIO()
    scipy.io.savemat(file, {"results": np.zeros(4)})
    with pytest.raises(InputError, match="not a flight"):
        identify(file.getvalue())


@pytest.mark.parametrize(("reader", "sample"), TEXT_CASES)
def test_cut_at_every_byte(reader: str, sample: str) -> None:
    data = SAMPLES[reader][sample][0]
    step = max(1, len(data) // 20)  # long samples at places spread over them, and the end byte by byte
    for end in sorted({*range(0, len(data), step), *range(max(0, len(data) - 8), len(data))}):
        check_law(reader, data[:end])


@pytest.mark.parametrize("reader", BINARY)
def test_binary_files_cut_at_many_bytes(reader: str) -> None:
    for name, (data, _, _) in SAMPLES[reader].items():
        if name != "version_73":
            for end in {*range(0, min(300, len(data)), 3), *range(300, len(data), 7 + len(data) // 100)}:
                check_law(reader, data[:end])


@pytest.mark.parametrize(("reader", "sample"), CASES)
def test_sniffers_stand_any_cut(reader: str, sample: str) -> None:
    data = SAMPLES[reader][sample][0]
    for end in range(0, len(data), 1 + len(data) // 40):
        for other in catalogue():
            assert other.sniff(data[:end]) in (True, False)


@pytest.mark.parametrize(("reader", "sample"), TEXT_CASES)
def test_line_ends_do_not_matter(reader: str, sample: str) -> None:
    data = SAMPLES[reader][sample][0].replace(b"\r\n", b"\n")
    unix, dos = check_law(reader, data), check_law(reader, data.replace(b"\n", b"\r\n"))
    assert unix is not None
    assert dos is not None
    assert (unix.accepted, unix.blank, unix.rejected) == (dos.accepted, dos.blank, dos.rejected)
    for first, second in zip(unix.streams, dos.streams, strict=True):
        assert first.frame.equals(second.frame)


@pytest.mark.parametrize(("reader", "sample"), TEXT_CASES)
def test_trailing_text_without_line_end(reader: str, sample: str) -> None:
    data, accepted, rejected = SAMPLES[reader][sample]
    result = check_law(reader, data + b"trailing text")
    assert result is not None
    assert result.accepted == accepted
    # consoles and markup talk freely: there it is a comment
    assert len(result.rejected) == rejected + (reader not in TALK)


@pytest.mark.parametrize("reader", ["generic_csv", "nemo_csv", "quectel_ri", "aadm_snr"])
def test_byte_order_mark(reader: str) -> None:
    ((data, accepted, rejected),) = SAMPLES[reader].values()
    result = check_law(reader, b"\xef\xbb\xbf" + data)
    assert result is not None
    assert (result.accepted, len(result.rejected)) == (accepted, rejected)
    check_law(reader, b"\xef\xbb\xbf")


@pytest.mark.parametrize(("reader", "sample"), TEXT_CASES)
def test_nul_bytes_and_a_huge_line(reader: str, sample: str) -> None:
    data, accepted, _ = SAMPLES[reader][sample]
    result = check_law(reader, data + b"\0" * 4096 + b"\n" + b"1" * 1_000_000 + b"\n" + b",1" * 300_000 + b"\n")
    assert result is not None
    assert result.accepted == accepted


@pytest.mark.parametrize(("reader", "sample"), TEXT_CASES)
def test_a_last_record_without_line_end_is_flagged(reader: str, sample: str) -> None:
    lines = SAMPLES[reader][sample][0].split(b"\n")
    result = check_law(reader, b"\n".join(lines[:-1]) + b"\n")
    assert result is not None
    last = max(int(stream.frame["line"].max()) for stream in result.streams)
    cut = check_law(reader, b"\n".join(lines[:last]).rstrip(b"\r"))
    if cut is None or cut.accepted != result.accepted:
        assert (
            reader in ("sounder_log", "dji_srt") or sample == "pretty"
        )  # a truncated line is recognised by the layout, or by the end of an object
        return
    flagged = [flag for stream in cut.streams for flag in stream.frame.loc[stream.frame["line"] == last, "flag"]]
    assert flagged
    # a record ends with its own tag, a checksum, or fields behind the position
    closed = reader in ("gpx", "gnettrack_kml", "dji_srt", "nmea", "rtklib_pos")
    assert all(("unterminated_line" in flag) is not closed for flag in flagged)


@pytest.mark.parametrize("reader", SAMPLES)
@given(data=st.data())
@settings(max_examples=12, deadline=None)
def test_damaged_bytes(reader: str, data: st.DataObject) -> None:
    """Bytes overwritten, inserted and removed at random places of its own samples."""
    sample = bytearray(
        data.draw(st.sampled_from([s for name, (s, _, _) in SAMPLES[reader].items() if name != "version_73"]))
    )
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(sample) - 1))
        new = data.draw(
            st.binary(max_size=4) | st.sampled_from([b"\n", b"\r\n", b",", b"*", b"999999999999", b"-", b"."])
        )
        sample[at : at + data.draw(st.integers(0, 3))] = new
        if not sample:
            return
    check_law(reader, bytes(sample))
    assert all(other.sniff(bytes(sample)) in (True, False) for other in catalogue())


@pytest.mark.parametrize("at", [600, 1500, 3000, -400])
def test_damaged_hdf5(at: int) -> None:
    data = bytearray(SAMPLES["flight_mat"]["version_73"][0])
    data[at : at + 60] = b"\xff" * 60
    check_law("flight_mat", bytes(data))
    check_law("flight_mat", bytes(data[: len(data) + min(at, 0)]))


@given(st.binary(max_size=300))
@settings(max_examples=60, deadline=None)
def test_any_bytes(rubbish: bytes) -> None:
    for reader in catalogue():
        check_law(reader.name, rubbish)


_NAMES = ("rsrp", "NB1_PCI", "NB1_RSRP", "PCI_2", "RSRP_2", "pci", "nr_rsrp", "rscp", "sim1_rsrp", "sim2_rsrp", "rsrp_max",
          "operator", "sim slot", "device")  # fmt: skip
_CELLS = ("", "nan", "-", "A", "B", "7", "0", "2147483647")


@given(st.lists(st.sampled_from(_NAMES), min_size=2, max_size=9, unique=True), st.randoms(use_true_random=False))
@settings(max_examples=60, deadline=None)
def test_each_level_of_a_table_is_a_record_or_flagged(names: list[str], chance: random.Random) -> None:
    """The number of readings does not depend on the identities in other columns."""
    level, rows = -60.0, []
    for i in range(8):
        cells = [str(1_749_564_000 + i)]
        for name in names:
            level -= 0.25
            cells.append(f"{level}" if "rs" in name else chance.choice(_CELLS))
        rows.append(cells)
    data = "\n".join(",".join(cells) for cells in [["time", *names], *rows]) + "\n"
    assume(drive_test.READERS[0].sniff(data.encode()))
    result = drive_test.READERS[0].read(data.encode(), ReadOptions())
    shown = {value for item in result.streams for value in item.frame.select_dtypes("number").to_numpy().ravel()}
    rejected = {line.number for line in result.rejected}
    kept = [row for i, row in enumerate(rows) if i + 2 not in rejected]
    assert {float(cell) for row in kept for cell, name in zip(row[1:], names, strict=True) if "rs" in name} <= shown

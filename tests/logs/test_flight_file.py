"""The flight file: a round trip returns all records, and writing is atomic."""

import contextlib
import dataclasses
import io
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common import native
from aerpaw_cmp.common.errors import InputError, OutputError, UsageError
from aerpaw_cmp.logs.flight_file import IngestedFile, fill, read_flight, write_flight
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.records import COLUMNS, ReadResult, RejectedLine, Stream
from tests.frames import assert_same_frame
from tests.parsers import samples
from tests.parsers.samples import OPTIONS, SAMPLES


@pytest.fixture(scope="module", autouse=True)
def _no_child() -> Iterator[None]:
    """The reader without its process: that one is asked by test_native.py, and costs 0.3 s a file."""
    reader = native.READERS["hdf5"]()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native, "_in_child", lambda _kind, data: native.answer(reader, data))
        yield


TEXT = st.text(st.characters(exclude_categories=("Cs",)), max_size=12)  # NUL included: torn logs have it
FLOAT = st.floats(allow_nan=True, allow_infinity=True, width=64)


@st.composite
def streams(draw: st.DrawFn) -> Stream:
    kind = draw(st.sampled_from(sorted(COLUMNS)))
    rows = draw(st.integers(0, 12))
    column = lambda values: draw(st.lists(values, min_size=rows, max_size=rows))  # noqa: E731
    frame: dict[str, object] = {
        "time": np.array(column(st.integers(-(2**60), 2**60)), dtype="datetime64[ns]"),
        "line": np.array(column(st.integers(1, 2**40)), dtype=np.int64),
        "flag": pd.Series(column(TEXT), dtype=object),
    }
    for name in COLUMNS[kind]:
        frame[name] = np.array(column(FLOAT), dtype=np.float64)
    if draw(st.booleans()):
        frame["valid"] = np.array(column(st.booleans()), dtype=bool)
    attribute = TEXT | st.integers(-(2**53), 2**53) | st.booleans() | st.floats(allow_nan=False)
    return Stream(kind, draw(TEXT), pd.DataFrame(frame), draw(st.dictionaries(TEXT, attribute, max_size=4)))


@st.composite
def files(draw: st.DrawFn) -> IngestedFile:
    rejected = draw(st.lists(st.builds(RejectedLine, st.integers(1, 2**40), TEXT, TEXT), max_size=4))
    accepted, blank = draw(st.integers(0, 2**40)), draw(st.integers(0, 2**40))
    result = ReadResult(
        draw(TEXT), tuple(draw(st.lists(streams(), max_size=3))), accepted + blank + len(rejected), accepted, blank,
        tuple(rejected), tuple(draw(st.lists(TEXT, max_size=3))),
    )  # fmt: skip
    return IngestedFile(draw(TEXT), draw(TEXT), result)


def assert_same(left: list[IngestedFile], right: list[IngestedFile]) -> None:
    assert len(left) == len(right)
    for a, b in zip(left, right, strict=True):
        assert (a.path, a.sha256) == (b.path, b.sha256)
        for name in ("reader", "lines", "accepted", "blank", "rejected", "warnings"):
            assert getattr(a.result, name) == getattr(b.result, name)
        assert len(a.result.streams) == len(b.result.streams)
        for s, t in zip(a.result.streams, b.result.streams, strict=True):
            assert (s.kind, s.name, dict(s.attributes)) == (t.kind, t.name, dict(t.attributes))
            assert_same_frame(s.frame, t.frame, check_exact=True)


@given(st.lists(files(), max_size=3))
@settings(max_examples=60, deadline=None)
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, content: list[IngestedFile]) -> None:
    path = tmp_path_factory.mktemp("store") / "flight.h5"
    write_flight(path, content)
    assert_same(content, read_flight(path))


def all_samples(folder: Path) -> list[IngestedFile]:
    made = []
    for reader, kinds in SAMPLES.items():
        for name, (data, _, _) in kinds.items():
            own = samples.IQ_NAME if reader == "iq_burst" else f"{reader}_{name}"  # the burst's position is its name
            path = folder / own
            path.write_bytes(data)
            made += ingest(path, options=OPTIONS, reader=reader)
    return made


def test_round_trip_of_every_format(tmp_path: Path) -> None:
    content = all_samples(tmp_path)
    write_flight(tmp_path / "flight.h5", content)
    assert_same(content, read_flight(tmp_path / "flight.h5"))


def test_long_columns_are_compressed_and_equal(tmp_path: Path) -> None:
    rows = 20_000
    frame = pd.DataFrame(
        {
            "time": np.arange(rows).astype("datetime64[s]").astype("datetime64[ns]"),
            "line": np.arange(1, rows + 1),
            "flag": pd.Series(["", "repeated"] * (rows // 2), dtype=object),
            "state": pd.Series(["on", None, "off", ""] * (rows // 4), dtype=object),
            "rss_db": np.linspace(-80, -20, rows).round(1),
        }
    )
    content = [IngestedFile("a", "b", ReadResult("r", (Stream("rss", "s", frame),), rows, rows, 0))]
    write_flight(tmp_path / "f.h5", content)
    assert_same(content, read_flight(tmp_path / "f.h5"))
    assert (tmp_path / "f.h5").stat().st_size < rows * 28 / 4


def test_a_failure_leaves_the_old_file_and_no_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "flight.h5"
    write_flight(path, [])
    before = path.read_bytes()
    content = all_samples_of_one(tmp_path)

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(OutputError, match="No space left"):
        write_flight(path, content)
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["flight.h5", "log"]


class _Full(io.BytesIO):
    """A disk with a given number of free bytes."""

    def __init__(self, left: int, failure: BaseException) -> None:
        super().__init__()
        self.left, self.failure = left, failure

    def write(self, block: Any) -> int:
        self.left -= len(block)
        if self.left < 0:
            raise self.failure
        return super().write(block)


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_disk_that_is_full_anywhere_ends_in_its_own_error(tmp_path: Path, failure: BaseException) -> None:
    """HDF5 ends the process where a write of its own fails."""
    files = all_samples_of_one(tmp_path)
    large = pd.concat([files[0].result.streams[0].frame] * 40_000, ignore_index=True)
    streams = (dataclasses.replace(files[0].result.streams[0], frame=large),)
    files = [dataclasses.replace(files[0], result=dataclasses.replace(files[0].result, streams=streams))]
    enough = io.BytesIO()
    fill(enough, files)
    assert read_back(enough.getvalue(), tmp_path).equals(large)
    size = len(enough.getvalue())
    for left in (0, 100, 3_000, *range(5_000, size, size // 6), size - 40, size - 1):
        with pytest.raises(type(failure)) as caught:
            fill(_Full(left, failure), files)
        assert caught.value is failure


def read_back(content: bytes, folder: Path) -> pd.DataFrame:
    (folder / "back.h5").write_bytes(content)
    (file,) = read_flight(folder / "back.h5")
    return file.result.streams[0].frame


def test_the_writer_takes_no_copy_of_the_records(tmp_path: Path) -> None:
    """Peak of NumPy's and Python's memory while 32 MB of records are written: a few blocks of rows."""
    rows = 1_000_000
    frame = pd.DataFrame(
        {"time": np.arange(rows).astype("datetime64[ns]"), "line": np.arange(rows), "flag": [""] * rows}
    )
    frame["rss_db"] = np.random.default_rng(3).normal(size=rows)
    result = ReadResult(
        reader="x", streams=(Stream("rss", "x", frame),), lines=rows, accepted=rows, blank=0, rejected=()
    )
    with (tmp_path / "f.h5").open("w+b") as stream:
        tracemalloc.start()
        fill(stream, [IngestedFile("x", "0" * 64, result)])
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 16e6


def all_samples_of_one(folder: Path) -> list[IngestedFile]:
    (folder / "log").write_bytes(SAMPLES["vehicle_out"]["nine_fields"][0])
    return list(ingest(folder / "log", options=OPTIONS))


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A flight file as it is written."""
    folder = tmp_path_factory.mktemp("sealed")
    write_flight(folder / "flight.h5", all_samples_of_one(folder))
    return (folder / "flight.h5").read_bytes()


def test_files_that_are_no_flight_file(tmp_path: Path) -> None:
    path = tmp_path / "flight.h5"
    with pytest.raises(InputError, match="cannot be read"):
        read_flight(path)
    path.write_bytes(b"")
    with pytest.raises(InputError, match="not an HDF5 file"):
        read_flight(path)
    with h5py.File(path, "w") as book:
        book["a"] = 1
    with pytest.raises(InputError, match="another kind"):
        read_flight(path)
    with pytest.raises(UsageError, match="not an unchanged output"):
        write_flight(path, [])
    path.unlink()
    write_flight(path, [])
    with h5py.File(path, "a") as book:
        book.attrs["version"] = 99
    with pytest.raises(InputError, match="version 99"):
        read_flight(path)


def test_cut_at_many_bytes(tmp_path: Path) -> None:
    path = tmp_path / "flight.h5"
    write_flight(path, all_samples_of_one(tmp_path))
    data = path.read_bytes()[:-40]  # behind it the seal: without it the content is whole
    for end in range(0, len(data) - 1, max(1, len(data) // 150)):
        path.write_bytes(data[:end])
        with pytest.raises(InputError):
            read_flight(path)


@given(st.data())
@settings(max_examples=80, deadline=None)
def test_damaged_bytes_are_told_from_the_content(
    tmp_path_factory: pytest.TempPathFactory, sealed: bytes, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("damage") / "flight.h5"
    raw = bytearray(sealed)
    end = len(raw) - 40  # the seal itself may be lost without loss of content
    for _ in range(data.draw(st.integers(1, 8))):
        raw[data.draw(st.integers(0, end - 1))] ^= data.draw(st.integers(1, 255))
    if bytes(raw) == sealed:  # two changes of one byte that cancel
        return
    path.write_bytes(bytes(raw))
    with pytest.raises(InputError):
        read_flight(path)


@given(st.data())
@settings(max_examples=40, deadline=None)
def test_damage_without_a_seal_gives_a_clear_error_or_the_content(
    tmp_path_factory: pytest.TempPathFactory, sealed: bytes, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("unsealed") / "flight.h5"
    raw = bytearray(sealed[:-40])
    raw[data.draw(st.integers(4096, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(raw))
    with contextlib.suppress(InputError):  # any other exception fails the test
        read_flight(path)


def test_a_file_without_its_seal_is_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.h5"
    files = all_samples_of_one(tmp_path)
    write_flight(path, files)
    with_seal = read_flight(path)
    path.write_bytes(path.read_bytes()[:-40])
    assert [f.sha256 for f in read_flight(path)] == [f.sha256 for f in with_seal]


def test_other_programs_read_a_sealed_file(tmp_path: Path) -> None:
    path = tmp_path / "flight.h5"
    write_flight(path, all_samples_of_one(tmp_path))
    with h5py.File(path, "r") as book:
        assert book.attrs["version"] == 1
        assert len(book["files"]) == len(read_flight(path))

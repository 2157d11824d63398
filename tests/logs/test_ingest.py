"""Finding and naming logs, and messages for bad input."""

import gzip
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.cli.commands.logs import ACCOUNT, account_rows
from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.logs import ingest as room
from aerpaw_cmp.logs.flight_file import write_flight
from aerpaw_cmp.logs.ingest import Ingested, account_notes, ingest, read_log, summary
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.records import Stream
from aerpaw_cmp.logs.rows import Rows
from tests.parsers.samples import OPTIONS, SAMPLES

VEHICLE = SAMPLES["vehicle_out"]["ten_fields"][0]
SOUNDER = SAMPLES["sounder_log"]["runs_and_foot"][0]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "b" / "c").mkdir(parents=True)
    (tmp_path / "b" / "c" / "vehicle.txt").write_bytes(VEHICLE)
    (tmp_path / "a_power.txt").write_bytes(SOUNDER)
    (tmp_path / "notes.md").write_text("we flew\n")
    (tmp_path / "empty.txt").write_bytes(b"")
    (tmp_path / ".hidden").write_bytes(VEHICLE)
    return tmp_path


def test_a_folder_gives_its_logs_in_order_and_reports_the_rest(folder: Path) -> None:
    ingested = ingest(folder, options=OPTIONS)
    assert [(Path(file.path).name, file.result.reader) for file in ingested] == [
        ("a_power.txt", "sounder_log"), ("vehicle.txt", "vehicle_out"),
    ]  # fmt: skip
    assert [Path(skipped.path).name for skipped in ingested.skipped] == ["empty.txt", "notes.md"]
    assert "empty" in ingested.skipped[0].reason


def test_files_and_folders_together(folder: Path) -> None:
    ingested = ingest([folder / "b", str(folder / "a_power.txt")], options=OPTIONS)
    assert [file.result.reader for file in ingested] == ["vehicle_out", "sounder_log"]


def test_options_per_path(folder: Path) -> None:
    def options(path: Path) -> ReadOptions:
        return replace(OPTIONS, node="LW1" if path.name.startswith("a_") else None)

    nodes = {
        file.result.reader: file.result.streams[0].attributes.get("node") for file in ingest(folder, options=options)
    }
    assert nodes == {"sounder_log": "LW1", "vehicle_out": None}


def test_summary_is_the_contract(folder: Path) -> None:
    ingested = ingest(folder, options=OPTIONS)
    answer = json.loads(json.dumps(summary(ingested), allow_nan=False))
    assert set(answer) == {"files", "skipped", "warnings"}
    entry = answer["files"][1]
    assert {"path", "reader", "lines", "accepted", "rejected", "blank", "streams"} <= set(entry)
    assert (entry["lines"], entry["accepted"], entry["rejected"], entry["blank"]) == (3, 3, 0, 0)
    (stream,) = entry["streams"]
    assert list(stream) == ["kind", "name", "rows", "start", "end", "rate_hz", "attributes"]
    assert (stream["kind"], stream["name"], stream["rows"]) == ("telemetry", "vehicle", 3)
    assert pd.Timestamp(stream["start"]) == pd.Timestamp("2025-03-02T15:00:00.25Z")
    assert stream["rate_hz"] == pytest.approx(1.0)
    assert stream["attributes"] == dict(ingested[1].result.streams[0].attributes)
    assert any("no_fix" in text and "vehicle.txt" in text for text in answer["warnings"])


def test_the_account_for_people_names_lines_and_files(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    lines = VEHICLE.splitlines(keepends=True)
    (tmp_path / "a/vehicle.txt").write_bytes(lines[0] + b"torn,\n" + lines[1])
    (tmp_path / "b/vehicle.txt").write_bytes(VEHICLE)
    (tmp_path / "b/notes.md").write_text("words")
    account = summary(ingest(tmp_path, options=OPTIONS))
    folder, (first, second) = account_rows(account)
    assert folder == str(tmp_path)
    assert [first[0], second[0]] == ["a/vehicle.txt", "b/vehicle.txt"]
    row = dict(zip(ACCOUNT, first, strict=True))
    assert (row["lines"], row["accepted"], row["rejected"], row["blank"]) == ("3", "2", "1", "0")
    assert (row["streams (rows)"], row["start UTC"], row["s"]) == ("telemetry: vehicle 2", "2025-03-02 15:00:00", "1.0")
    account["files"][0]["streams"][0]["rate_hz"] = 5.9e-5
    assert account_rows(account)[1][0][7] == "1 in 4.7 h"
    notes = account_notes(account)
    assert any("a/vehicle.txt:2: rejected: " in note and "torn," in note for note in notes)
    assert any("notes.md: skipped: " in note for note in notes)
    assert account_rows(summary(Ingested())) == ("", [])


def test_a_wide_table_takes_one_line_unless_all_is_wanted(tmp_path: Path) -> None:
    (tmp_path / "wide.csv").write_text(
        "time," + ",".join(f"rssi_ch{i}_dbm" for i in range(47)) + "\n"
        + "".join(f"2025-06-01T10:00:{k:02d}Z" + ",-70" * 47 + "\n" for k in range(9))
    )  # fmt: skip
    account = summary(ingest(tmp_path))
    assert account_rows(account)[1][0][2] == "rss: 47 (--all)"
    assert account_rows(account, every_stream=True)[1][0][2].count(" 9") == 47


@pytest.mark.parametrize(
    ("paths", "folder", "names"),
    [
        (["logs/a.txt", "/abs/b.txt"], "", ["logs/a.txt", "/abs/b.txt"]),
        (["logs/a.txt", "../b.txt"], "", ["logs/a.txt", "../b.txt"]),
        (["logs/x/a.txt", "logs/b.txt"], "logs", ["x/a.txt", "b.txt"]),
        (["/f/a.txt", "/g/b.txt"], "/", ["f/a.txt", "g/b.txt"]),
        (["a.txt", "b.txt"], "", ["a.txt", "b.txt"]),
        (["logs/a.txt"], "", ["logs/a.txt"]),
    ],
)
def test_the_account_names_files_below_the_folder_they_share(paths: list[str], folder: str, names: list[str]) -> None:
    account = {"files": [{"path": path, "reader": "-", "lines": 0, "accepted": 0, "rejected": 0, "blank": 0,
                          "streams": []} for path in paths]}  # fmt: skip
    shared, rows = account_rows(account)
    assert shared == folder
    assert [row[0] for row in rows] == names


def test_relative_times_are_called_relative(tmp_path: Path) -> None:
    account = {"files": [{"path": "x", "reader": "r", "lines": 1, "accepted": 1, "rejected": 9, "blank": 0,
                          "warnings": [], "first_rejected": [{"number": 1, "reason": "torn", "text": "t"}],
                          "streams": [{"kind": "rank", "name": "a", "rows": 1, "start": "1969-12-31T23:59:59Z",
                                       "end": "1970-01-01T00:00:01.5Z", "rate_hz": None}]}], "skipped": []}  # fmt: skip
    assert account_rows(account)[1][0][-3:] == ["-", "relative", "2.5"]
    assert account_notes(account)[-1].startswith("x: and 8 more rejected lines")


def test_summary_of_a_single_sample_has_no_rate(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(VEHICLE.splitlines(keepends=True)[0])
    (stream,) = summary(ingest(tmp_path / "a", options=OPTIONS))["files"][0]["streams"]
    assert stream["rate_hz"] is None


def test_a_log_is_known_by_its_content_however_it_is_packed(tmp_path: Path) -> None:
    import bz2
    import hashlib
    import lzma
    import zipfile

    for name, pack in (("a.txt", bytes), ("b.gz", gzip.compress), ("c.bz2", bz2.compress), ("d.xz", lzma.compress)):
        (tmp_path / name).write_bytes(pack(VEHICLE))
    with zipfile.ZipFile(tmp_path / "e.zip", "w") as book:
        book.writestr("in/e.txt.gz", gzip.compress(VEHICLE))
    write_flight(tmp_path / "f.h5", ingest(tmp_path / "b.gz", options=OPTIONS))
    files = ingest([*sorted(tmp_path.glob("[a-e].*")), tmp_path / "f.h5"], options=OPTIONS)
    assert len(files) == 6
    assert {file.sha256 for file in files} == {hashlib.sha256(VEHICLE).hexdigest()}
    assert {file.result.accepted for file in files} == {3}


def test_one_of_several_logs_under_a_path_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(VEHICLE)
    (tmp_path / "b.txt").write_bytes(VEHICLE + VEHICLE.splitlines(keepends=True)[-1].replace(b"35.", b"36.", 1))
    write_flight(tmp_path / "f.h5", ingest(sorted(tmp_path.glob("*.txt")), options=OPTIONS))
    with pytest.raises(UsageError, match=r"2 logs under one path: a.txt, b.txt; expected one of them"):
        read_log(tmp_path, "f.h5", OPTIONS)
    for name in ("a.txt", "b.txt"):
        assert read_log(tmp_path, f"f.h5/{name}", OPTIONS).sha256 == read_log(tmp_path, name, OPTIONS).sha256
    with pytest.raises(InputError, match=r"0 of its logs are called 'c.txt'"):
        read_log(tmp_path, "f.h5/c.txt", OPTIONS)


def test_gzip_members_are_joined(tmp_path: Path) -> None:
    lines = VEHICLE.splitlines(keepends=True)
    (tmp_path / "a.gz").write_bytes(b"".join(gzip.compress(line) for line in lines))
    assert ingest(tmp_path / "a.gz", options=OPTIONS)[0].result.accepted == 3


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (b" \r\n\n\t\n", "empty"),
        (b"\0\1\2\3" * 500, "binary content"),
        (bytes(range(256)) * 20, "binary content"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "Git-LFS pointer"),
        (b"hello, world\n", "no reader recognises this content: 'hello, world'"),
        (gzip.compress(b"hello", mtime=0)[:-6], "gzip file ends too early"),
        (b"\x1f\x8b\x08\x00rubbish", "gzip"),
        (gzip.compress(b"", mtime=0), "empty"),
    ],
)
def test_a_named_file_that_is_no_log(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "log.txt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        ingest(path, options=OPTIONS)
    assert str(path) in str(caught.value)
    with pytest.raises(InputError):
        ingest(path, options=OPTIONS, reader="vehicle_out")


def test_missing_paths_are_reported_before_anything_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of them at once: a folder before them may take minutes."""
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "log.txt").write_text("a log\n")
    monkeypatch.setattr(room, "_below", lambda *_: pytest.fail("a path was read"))
    with pytest.raises(InputError, match=r"nothing\.txt: the file does not exist"):
        ingest([folder, tmp_path / "nothing.txt"], options=OPTIONS)
    with pytest.raises(InputError, match=r"2 of 3 paths cannot be read: .*a\.txt: the file .*; .*b\.txt: the file"):
        ingest([folder, tmp_path / "a.txt", tmp_path / "b.txt"], options=OPTIONS)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        ingest(tmp_path / "nothing.txt", options=OPTIONS)
    with pytest.raises(InputError):
        ingest("a\0b", options=OPTIONS)
    with pytest.raises(InputError):
        ingest("x" * 5000, options=OPTIONS)


def test_a_folder_without_logs(tmp_path: Path) -> None:
    (tmp_path / "notes.md").write_text("we flew\n")
    with pytest.raises(InputError, match="no log that a reader recognises"):
        ingest(tmp_path, options=OPTIONS)


def test_not_a_regular_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="not a regular file"):
        ingest(tmp_path / "pipe", options=OPTIONS)


def test_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "log.txt"
    path.write_bytes(VEHICLE)
    path.chmod(0)
    if os.access(path, os.R_OK):  # root reads everything: raise what an ordinary user would get

        def refuse(self: Path, _: str) -> bytes:
            raise PermissionError(13, "Permission denied", str(self))

        monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InputError, match="no permission"):
        ingest(path, options=OPTIONS)


def test_size_caps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "MAX_BYTES", 1000)
    (tmp_path / "big.txt").write_bytes(VEHICLE * 40)
    (tmp_path / "bomb.gz").write_bytes(gzip.compress(VEHICLE * 40))
    assert ingest(tmp_path / "big.txt", options=OPTIONS)[0].result.accepted == 120, "no size is refused"
    with pytest.raises(InputError, match="unpacks to more than 1000"):
        ingest(tmp_path / "bomb.gz", options=OPTIONS)


def test_wrong_reader_named(tmp_path: Path) -> None:
    (tmp_path / "log.txt").write_bytes(SOUNDER)
    with pytest.raises(InputError, match="found no record") as caught:
        ingest(tmp_path / "log.txt", options=OPTIONS, reader="vehicle_out")
    assert "another kind" in str(caught.value)
    with pytest.raises(UsageError, match="did you mean 'vehicle_out'"):
        ingest(tmp_path / "log.txt", options=OPTIONS, reader="vehicle_ot")


def test_missing_zone_is_a_usage_error_even_in_a_folder(folder: Path) -> None:
    with pytest.raises(UsageError, match="timezone:") as caught:
        ingest(folder)
    assert str(folder / "a_power.txt") in str(caught.value)


def test_files_that_are_no_logs_are_not_read_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "samples.iq").write_bytes(b"\x01\x00" * 500_000)
    (tmp_path / "vehicle.txt").write_bytes(VEHICLE)
    read_bytes = Path.read_bytes

    def watch(self: Path) -> bytes:
        assert self.name != "samples.iq"
        return read_bytes(self)

    monkeypatch.setattr(Path, "read_bytes", watch)
    assert [skipped.reason for skipped in ingest(tmp_path, options=OPTIONS).skipped] == [
        "binary content that no reader recognises"
    ]


@pytest.mark.parametrize("pack", [bytes, gzip.compress], ids=["plain", "gzip"])
def test_a_log_of_a_named_reader_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pack: Callable[[bytes], bytes]
) -> None:
    """A hint about another reader uses the first bytes alone, for logs of any size."""
    (tmp_path / "log").write_bytes(pack(VEHICLE * 2000))
    unlimited = []
    raw = room._raw

    def counted(place: Path, limit: int | None = None) -> bytes:
        unlimited.append(limit is None)
        return raw(place, limit)

    monkeypatch.setattr(room, "_raw", counted)
    assert read_log(tmp_path, "log", OPTIONS, reader="vehicle_out").result.accepted
    assert sum(unlimited) == 1
    with pytest.raises(InputError, match="the content is that of vehicle_out"):
        read_log(tmp_path, "log", OPTIONS, reader="sounder_log")
    assert sum(unlimited) == 1


def test_reader_errors_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "flight.mat"
    path.write_bytes(SAMPLES["flight_mat"]["two_channels"][0][:-40])
    with pytest.raises(InputError, match="damaged") as caught:
        ingest(path, options=OPTIONS)
    assert str(path) in str(caught.value)


def test_symlink_loops_end(tmp_path: Path) -> None:
    (tmp_path / "vehicle.txt").write_bytes(VEHICLE)
    (tmp_path / "loop").symlink_to(tmp_path)
    assert len(ingest(tmp_path, options=OPTIONS)) == 1


def test_a_folder_with_a_flight_file_has_each_log_once(tmp_path: Path) -> None:
    (tmp_path / "vehicle.txt").write_bytes(VEHICLE)
    logs = ingest(tmp_path, options=OPTIONS)
    write_flight(tmp_path / "flight.h5", logs)
    again = ingest(tmp_path, options=OPTIONS)
    assert [file.path for file in again] == [file.path for file in logs]
    assert [item.reason for item in again.skipped] == ["a flight file without further logs"]
    (tmp_path / "vehicle.txt").unlink()
    (alone,) = ingest(tmp_path, options=OPTIONS)
    assert (alone.sha256, alone.holder) == (logs[0].sha256, str(tmp_path / "flight.h5"))
    with pytest.raises(InputError, match="no log that reader 'pose_csv' can read"):
        ingest(tmp_path, reader="pose_csv")


def test_a_folder_says_why_nothing_was_read(tmp_path: Path) -> None:
    write_flight(tmp_path / "flight.h5", [])
    assert ingest(tmp_path / "flight.h5") == []
    with pytest.raises(
        InputError, match=r"recognises \(1 file tested\); flight.h5: a flight file without further logs"
    ):
        ingest(tmp_path)


def test_links_in_a_folder_are_told(tmp_path: Path) -> None:
    logs, far = tmp_path / "logs", tmp_path / "far"
    for folder in (logs, far):
        folder.mkdir()
        (folder / "a.txt").write_bytes(VEHICLE)
    (logs / "b.txt").symlink_to(far / "a.txt")
    (logs / "gone.txt").symlink_to(far / "nowhere")
    (logs / "far").symlink_to(far)
    (logs / "round").symlink_to(logs)
    ingested = ingest(logs, options=OPTIONS)
    assert [Path(f.path).name for f in ingested] == ["a.txt", "b.txt"]
    reasons = {Path(s.path).name: s.reason for s in ingested.skipped}
    assert reasons.keys() == {"far", "gone.txt", "round"}
    assert "link to a folder" in reasons["far"]


@pytest.mark.parametrize(
    ("column", "level", "said"),
    [
        ("rssi_0.1dBm", "-724", "rssi_0_1dbm': all 5 levels are below the floor of the reader"),
        (
            "E (dBuV/m)",
            "60.3",
            "not read, though they look like levels, identities, positions, times or flags: 'E (dBuV/m)'",
        ),
        ("rsrp_dbm", "-80", "the dates begin on 2004-09-17: if the week number of the GPS receiver rolled over"),
    ],
)
def test_a_level_or_date_that_cannot_be_right_is_reported(tmp_path: Path, column: str, level: str, said: str) -> None:
    path = tmp_path / "log.csv"
    rows = [f"2004-09-17T14:00:0{i}.000Z,35.72{i},-78.69,{level}" for i in range(5)]
    path.write_text("\n".join([f"utc,lat,lon,{column}", *rows]) + "\n")
    (file,) = ingest([path])
    assert any(said in text for text in file.result.warnings), file.result.warnings


def test_counts_from_1904_are_reported_as_dates_in_the_future(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("timestamp,rsrp\n3823772400.5,-80\n3823772401.5,-81\n")
    (file,) = ingest([path])
    assert any("the dates begin on 2091-03-03, in the future" in text for text in file.result.warnings)


def test_the_proposed_map_of_a_table_with_a_row_of_units_works(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("time,lat,lon,level\nUTC,deg,deg,0.1 dBm\n2025-03-02T15:00:00Z,35.73,-78.7001,-801\n")
    columns = {"time": "time [UTC]", "rss_db": "level [0.1 dBm]"}
    options = ReadOptions(columns=columns, kind="rss", unit="dBm")
    (file,) = ingest([path], options=options, reader="generic_csv")
    assert file.result.streams[0].frame["rss_db"].tolist() == pytest.approx([-80.1])


def test_heights_that_count_downwards_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = [f"2025-03-02T15:00:{10 * i}Z,35.73,-78.700{i},{-20 * i},-80" for i in range(1, 4)]
    path.write_text("\n".join(["time,lat,lon,height_above_takeoff_m,rsrp", *rows]) + "\n")
    (file,) = ingest([path])
    assert any("40 m below the take-off: do they count downwards" in text for text in file.result.warnings)


def test_three_series_of_one_name_are_three_series() -> None:
    rows = Rows("r", ReadOptions(), 1, np.zeros(1, int), np.zeros(1, "datetime64[ns]"), np.array([""], object))
    stream = Stream("rss", "x", pd.DataFrame({"time": rows.time, "line": [1], "flag": [""], "rss_db": [-70.0]}))
    assert [series.name for series in rows.result([stream] * 3).streams] == ["x", "x_again1", "x_again2"]

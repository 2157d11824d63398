"""The durable log: checksums, rotation, a full disk that comes back, a kill, and its reader."""

import errno
import os
import subprocess
import sys
import threading
import zlib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.live import log as log_module
from aerpaw_cmp.live.log import Clock, LogSettings, TapLog
from aerpaw_cmp.logs.files import SCHEMA, decode_record, encode_record
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_parsers.tap_jsonl import READER, decode_line
from benchmarks.simulated_modem import read_log
from tests.live.terminals import until


def header():
    return {"kind": "header", "schema": SCHEMA, "ri_base": "one"}


def make(folder, **values):
    log = TapLog(folder, header, LogSettings(**values))
    log.open()
    return log


def test_round_trip_and_rotation(tmp_path):
    log = make(tmp_path / "a/b", segment_bytes=2000)
    for i in range(100):
        assert log.append({"kind": "x", "i": i, "text": '"\x00\xff,"crc":"00000000"}'})
    log.close()
    assert len(log.paths) > 3
    bad = []
    records = list(read_log(tmp_path / "a/b", bad))
    assert not bad
    assert [r["i"] for r in records if r["kind"] == "x"] == list(range(100))
    assert [r["n"] for r in records] == list(range(len(records)))
    assert [r["segment"] for r in records if r["kind"] == "header"] == list(range(1, len(log.paths) + 1))
    results = [READER.read(path.read_bytes(), ReadOptions()) for path in log.paths]
    assert all(READER.sniff(path.read_bytes()) for path in log.paths)
    # each segment but the last says that it goes on
    assert [r.warnings for r in results] == [()] * (len(results) - 1) + [("no end record: the session was cut off",)]


def test_a_second_session_never_writes_into_the_first(tmp_path):
    first = make(tmp_path)
    before = first.paths[0].read_bytes()
    with pytest.raises(InputError, match=r"cannot write a log here.*a folder after -o"):
        make(tmp_path)  # same second, same process: the same name
    assert first.paths[0].read_bytes() == before
    first.close()


@settings(max_examples=200, deadline=None)
@given(
    st.dictionaries(
        st.text(max_size=10),
        st.one_of(st.integers(), st.text(max_size=30), st.none(), st.lists(st.text(max_size=5))),
        max_size=5,
    )
)
def test_any_record_survives_and_both_readers_agree(content):
    record = {"kind": "x", **{k: v for k, v in content.items() if k not in ("kind", "crc")}}
    line = encode_record(record)
    assert line.count(b"\n") == 1
    assert decode_record(line) == record == decode_line(line)


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 7))
def test_any_flipped_bit_or_cut_is_seen(place, bit):
    line = encode_record({"kind": "exchange", "sent_utc_ns": 1, "last_utc_ns": 2, "lines": ["+QNWCFG: 1,2"], "n": 7})[
        :-1
    ]
    damaged = bytearray(line)
    damaged[place % len(line)] ^= 1 << bit
    for decoder in (decode_record, decode_line):
        if bytes(damaged) != line:
            with pytest.raises(ValueError):
                decoder(bytes(damaged))
        with pytest.raises(ValueError):
            decoder(line[: place % len(line)])


@pytest.mark.parametrize(
    ("body", "reason"), [(b'{"kind":"x","a":' + b"[" * 9000 + b"]" * 9000, "nested too deeply"), (b"[1", "delimiter")]
)
def test_a_line_that_is_no_record_is_told_with_its_reason(body, reason):
    line = body + b',"crc":"%08x"}' % zlib.crc32(body)
    for decoder in (decode_record, decode_line):
        with pytest.raises(ValueError, match=reason):
            decoder(line)


FULL_DISK = """
import resource, signal, sys, time
from pathlib import Path
from aerpaw_cmp.live.log import LogSettings, TapLog
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # then a write beyond the limit is short, or fails with EFBIG
log = TapLog(Path(sys.argv[1]), lambda: {"kind": "header", "schema": "aerpaw-cmp-tap/1"},
             LogSettings(retry_s=0.01, patience_s=10.0, backlog_records=int(sys.argv[2])))
log.open()
written = [log.append({"kind": "x", "i": i}) for i in range(20)]
soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (log.paths[0].stat().st_size + 30, hard))
written += [log.append({"kind": "x", "i": i}) for i in range(20, 60)]
resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
until = time.monotonic() + 10
while log.fault and time.monotonic() < until:
    time.sleep(0.01)
written += [log.append({"kind": "x", "i": i}) for i in range(60, 80)]
log.close()
assert written == [True] * 20 + [False] * 40 + [True] * 20, written
said = log.messages()
assert len(said) == 2, said
print(*said, sep="\\n")
print(log.lost)
"""


def run_child(code, *arguments):
    root = Path(__file__).resolve().parents[2]
    # a limit on the size of files would leave cut bytecode behind
    environment = os.environ | {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], env=environment, text=True, capture_output=True, check=False
    )


def test_a_full_disk_is_told_at_once_and_nothing_is_lost_when_it_has_room_again(tmp_path):
    # RLIMIT_FSIZE in a child makes the kernel give short writes and then errors, as a full disk does
    done = run_child(FULL_DISK, tmp_path, 1000)
    assert done.returncode == 0, done.stderr
    first, second, lost = done.stdout.splitlines()
    assert "the log cannot be written" in first
    assert "records wait in memory" in first
    assert "accepts records again; 0 were lost" in second
    assert lost == "0"
    bad = []
    records = list(read_log(tmp_path, bad))
    assert not bad  # the short write was taken back
    assert [r["i"] for r in records if r["kind"] == "x"] == list(range(80))
    (disk,) = [r for r in records if r["kind"] == "disk"]
    assert disk["lost"] == 0


def test_what_memory_cannot_hold_is_counted(tmp_path):
    done = run_child(FULL_DISK, tmp_path, 25)
    assert done.returncode == 0, done.stderr
    records = list(read_log(tmp_path))
    written = [r["i"] for r in records if r["kind"] == "x"]
    (disk,) = [r for r in records if r["kind"] == "disk"]
    assert written == sorted(written)
    assert disk["lost"] == 80 - len(written)
    assert 14 <= disk["lost"] <= 15  # the thread holds one record when it tries the disk
    assert any(
        "record numbers are missing" in w
        for w in READER.read(next(tmp_path.iterdir()).read_bytes(), ReadOptions()).warnings
    )


def test_a_read_only_disk_is_named(tmp_path, monkeypatch):
    def refused(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(log_module.os, "open", refused)
    with pytest.raises(InputError, match=r"Read-only file system.*the disk is mounted read-only"):
        make(tmp_path)


def test_after_an_io_error_of_the_sync_a_new_segment_begins(tmp_path, monkeypatch):
    log = make(tmp_path, retry_s=0.0)
    log.append({"kind": "x", "i": 0})
    real = os.fdatasync

    def failing(fd):
        monkeypatch.setattr(log_module.os, "fdatasync", real)
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(log_module.os, "fdatasync", failing)
    log.sync()
    log.append({"kind": "x", "i": 1})
    log.close()
    assert "failing disk or card" in log.messages()[0]
    assert len(log.paths) == 2
    assert [r["i"] for r in read_log(tmp_path) if r["kind"] == "x"] == [0, 1]


def test_a_sync_that_fails_is_told_and_the_log_goes_on(tmp_path, monkeypatch):
    real, failed = os.fdatasync, threading.Event()

    def failing(fd):
        if threading.current_thread().name == "tap-log" and not failed.is_set():
            failed.set()
            raise OSError(errno.EIO, "Input/output error")
        real(fd)

    monkeypatch.setattr(log_module.os, "fdatasync", failing)
    log = TapLog(tmp_path, header, LogSettings(sync_interval_s=0.001, retry_s=0.0))
    log.open()
    log.append({"kind": "x", "i": 0})
    until(failed.is_set, 10.0)
    log.append({"kind": "x", "i": 1})
    log.close()
    assert "failing disk or card" in log.messages()[0]
    assert [r["i"] for r in read_log(tmp_path) if r["kind"] == "x"] == [0, 1]
    assert sum(r["kind"] == "disk" for r in read_log(tmp_path)) == 1


def test_a_sync_that_stalls_holds_the_polling_once(tmp_path, monkeypatch):
    """While fdatasync stalls, the record before it is in the kernel, and later records wait in memory."""
    real, hang, stalled = os.fdatasync, threading.Event(), threading.Event()

    def stalling(fd):
        if threading.current_thread().name == "tap-log":
            stalled.set()
            hang.wait(30)
        real(fd)

    settings = LogSettings(sync_interval_s=0.2, patience_s=0.1)
    log = TapLog(tmp_path, header, settings)
    log.open()
    monkeypatch.setattr(log_module.os, "fdatasync", stalling)
    assert log.append({"kind": "x", "i": 0})
    until(stalled.is_set, 10.0)
    assert not any(log.append({"kind": "x", "i": i}) for i in range(1, 30))
    hang.set()
    log.close()
    assert [r["i"] for r in read_log(tmp_path) if r["kind"] == "x"] == list(range(30))


def test_a_disk_that_stalls_does_not_hold_the_polling(tmp_path, monkeypatch):
    real, hang, written = os.write, threading.Event(), threading.Event()

    def stalling(fd, data):
        if threading.current_thread().name == "tap-log" and b'"i":3' in data:
            written.set()
            hang.wait(30)
        return real(fd, data)

    log = TapLog(tmp_path, header, LogSettings(patience_s=0.2, backlog_records=40))
    log.open()
    assert all(log.append({"kind": "x", "i": i}) for i in range(3))
    monkeypatch.setattr(log_module.os, "write", stalling)
    assert not log.append({"kind": "x", "i": 3})  # waited for, in vain
    assert written.is_set()
    assert not any(log.append({"kind": "x", "i": i}) for i in range(4, 34))
    hang.set()
    until(lambda: log.append({"kind": "y"}), 10.0)
    log.close()
    assert [r["i"] for r in read_log(tmp_path) if r["kind"] == "x"] == list(range(34))
    assert log.lost == 0


def test_a_stall_beyond_memory_is_counted(tmp_path, monkeypatch):
    real, hang = os.write, threading.Event()
    monkeypatch.setattr(log_module.os, "write", lambda fd, data: (b'"i"' in data and hang.wait(30), real(fd, data))[1])
    log = TapLog(tmp_path, header, LogSettings(patience_s=0.05, backlog_records=10))
    log.open()
    for i in range(31):
        log.append({"kind": "x", "i": i})
    hang.set()
    log.close()
    written = [r["i"] for r in read_log(tmp_path) if r["kind"] == "x"]
    assert written == [0, *range(21, 31)]
    assert log.lost == 20


def test_a_record_that_cannot_be_written_does_not_end_the_log(tmp_path):
    log = TapLog(tmp_path, header)
    log.open()
    log.append({"kind": "x", "bad": {1, 2}})
    log.append({"kind": "x", "i": 1})
    log.close()
    assert [r["i"] for r in read_log(tmp_path) if r["kind"] == "x"] == [1]
    assert "could not be written: TypeError" in log.messages()[0]
    assert log.lost == 1


def test_sync_interval(tmp_path, monkeypatch):
    synced = []
    real = os.fdatasync
    monkeypatch.setattr(log_module.os, "fdatasync", lambda fd: (synced.append(fd), real(fd))[1])
    log = make(tmp_path, sync_interval_s=0.0)
    at_start = len(synced)
    for i in range(5):
        log.append({"kind": "x", "i": i})
    until(lambda: len(synced) == at_start + 5, 10.0)
    log.close()


def test_the_interval_is_kept_by_steady_writing(tmp_path, monkeypatch):
    # a clock of our own: 10 s in steps of 0.1 s at an interval of 1 s ask for 9 or 10 syncs
    now = [0]
    asked = []
    log = TapLog(tmp_path, header, LogSettings(sync_interval_s=1.0), Clock(lambda: now[0], lambda: now[0]))
    log.open()
    monkeypatch.setattr(log_module.os, "fdatasync", asked.append)
    for i in range(100):
        now[0] += 100_000_000
        log.append({"kind": "x", "i": i})
    assert 9 <= len(asked) <= 10
    log.close()


@pytest.mark.skipif(os.geteuid() != 0, reason="dropping privileges needs root")
def test_a_folder_of_another_user(tmp_path):
    folder = tmp_path / "theirs"
    folder.mkdir(mode=0o755)
    code = (
        "import os, sys\nfrom pathlib import Path\nfrom aerpaw_cmp.live.log import TapLog\n"
        "os.setuid(65534)\nTapLog(Path(sys.argv[1]), dict).open()"
    )
    for part in (tmp_path, *tmp_path.parents):
        if part == Path("/tmp"):
            break
        part.chmod(0o755)
    done = run_child(code, folder)
    assert "InputError" in done.stderr
    assert "Permission denied" in done.stderr
    assert "belongs to another user" in done.stderr


# the reader --------------------------------------------------------------------------------------------------


def exchange(n, second, query, decoded, **more):
    start = 1_800_000_000_000_000_000 + int(second * 1e9)
    record = {
        "kind": "exchange",
        "query": query,
        "command": "AT",
        "sent_utc_ns": start,
        "last_utc_ns": start + 40_000_000,
    }
    return encode_record({**record, "status": "ok", "lines": [], "decoded": decoded, "flags": [], "n": n, **more})


def sample():
    return b"".join(
        [
            encode_record({**header(), "n": 0}),
            exchange(1, 0.0, "servingcell", {"rat": "NR5G-SA", "nr": {"rsrp_dbm": -80, "sinr_db": 20}}),
            exchange(2, 0.5, "nr5g_csi", {"rank": 2, "ri_raw": 2, "mcs": 9, "cqi": 8, "pmi": 1}),
            exchange(3, 1.0, "nr5g_csi", {"rank": None, "ri_raw": 0}, flags=["no_csi"]),
            exchange(4, 9.0, "nr5g_csi", {"rank": 3, "ri_raw": 3}),
            exchange(5, 9.5, "nr5g_csi", {}, status="timeout"),
            encode_record({"kind": "gap", "state": "closed", "reason": "gone", "duration_ns": 6_000_000_000, "n": 6}),
            encode_record({"kind": "end", "n": 7}),
        ]
    )


def test_reader():
    result = READER.read(sample(), ReadOptions(node="LW1"))
    assert (result.lines, result.accepted, result.blank, len(result.rejected)) == (8, 5, 3, 0)
    assert result.warnings == ("gap of 6.0 s: gone",)
    rank, rss = result.streams
    assert dict(rank.attributes) == {"clock": "utc", "node": "LW1", "ri_base": "one", "channel": "nr5g"}
    assert rank.frame["line"].tolist() == [3, 4, 5, 6]
    assert rank.frame["uncertainty_s"].tolist() == [0.02] * 4
    assert rss.attributes["unit"] == "dBm"


def test_reader_at_cuts_all_over_its_lines():
    data = sample()
    ends = [i for i, b in enumerate(data) if b == 10]
    near = {end + k for end in ends for k in range(-3, 4)}
    for cut in sorted({*range(0, len(data), 4), *near & set(range(len(data)))}):  # every byte about the line ends
        result = READER.read(data[:cut], ReadOptions())
        complete = sum(end < cut for end in ends)
        # a last line that lacks nothing but its line end is sound
        assert result.accepted + result.blank in (complete, complete + (cut in ends))
        assert len(result.rejected) <= 1
        assert all(line.reason.startswith("torn tail") for line in result.rejected)


@pytest.mark.parametrize(
    "tail", [b"\0" * 512, b"\xff\xfe", b'{"kind":"exchange"', b"[1,2]", b'{"kind":7,"crc":"00000000"}']
)
def test_reader_counts_bad_tails(tail):
    result = READER.read(sample() + tail, ReadOptions())
    assert len(result.rejected) == 1
    assert result.accepted == 5
    assert any("truncated" in w for w in result.warnings)
    middle = READER.read(sample() + tail + b"\n" + exchange(8, 10, "nr5g_csi", {"rank": 1, "ri_raw": 1}), ReadOptions())
    assert (len(middle.rejected), middle.accepted) == (1, 6)


def signed(text):
    return text + b',"crc":"%08x"}\n' % zlib.crc32(text)


@pytest.mark.parametrize(
    "line",
    [
        signed(b'{"kind":"exchange","n":1'),
        signed(b'{"kind":"exchange","sent_utc_ns":1e400,"last_utc_ns":2'),
        signed(b'{"kind":"exchange","sent_utc_ns":true,"last_utc_ns":2'),
        signed(b'{"kind":"exchange","sent_utc_ns":99999999999999999999999,"last_utc_ns":2'),
        signed(b'{"kind":"x","a":' + b"[" * 100_000 + b"]" * 100_000),
        signed(b'{"no":"kind"'),
        signed(b'{"kind":"exchange","sent_utc_ns":1,"last_utc_ns":2,"query":"nr5g_csi","decoded":[1],"flags":3'),
        signed(b'{"kind":"exchange","sent_utc_ns":1,"last_utc_ns":2,"query":"servingcell","decoded":{"nr":[1]}'),
        signed(b'{"kind":"gap","state":"closed","duration_ns":"x"'),
        signed(b'{"kind":"clock","step_ns":{}'),
        signed(
            b'{"kind":"exchange","sent_utc_ns":1,"last_utc_ns":2,"query":"nr5g_csi","decoded":{"rank":1'
            + b"0" * 400
            + b"}"
        ),
    ],
)
def test_reader_survives_crafted_records(line):
    result = READER.read(encode_record({**header(), "n": 0}) + line, ReadOptions())
    assert result.lines == 2


def test_reader_refuses_a_later_schema():
    data = encode_record({"kind": "header", "schema": "aerpaw-cmp-tap/2", "n": 0})
    assert READER.sniff(data)
    with pytest.raises(InputError, match="another version"):
        READER.read(data, ReadOptions())


def test_what_a_disk_that_stays_full_never_took_is_counted(tmp_path):
    log = make(tmp_path, backlog_records=30)
    records = log.records
    os.dup2(os.open("/dev/full", os.O_WRONLY), log._fd)
    assert not any(log.append({"kind": "x", "i": i}) for i in range(80))
    assert "the disk is full" in log.messages()[0]
    assert log.fault == os.strerror(errno.ENOSPC)
    log.close()
    assert (log.records - records, log.lost) == (0, 80)

"""The simulated modem, the followed telemetry and the CSV export."""

import threading

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.live.predict import Prediction, TelemetryFollower, predict_along
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import COLUMNS as RECORD_COLUMNS
from aerpaw_cmp.logs.records import ReadResult, Stream
from benchmarks.simulated_modem import FaultyModem
from tests.live.terminals import held


def test_what_two_threads_say_at_once_comes_one_behind_the_other():
    """Longer than the system's buffer of a terminal, so that each writer has to wait in the middle."""
    sent = [letter * 200_000 + b"\n" for letter in (b"a", b"b")]
    with FaultyModem() as modem, held(modem.port) as reader:
        threads = [threading.Thread(target=modem._write, args=(text,)) for text in sent]
        for thread in threads:
            thread.start()
        threads[0].join(0.1)  # both wait for the reader by now
        received = b""
        while len(received) < sum(map(len, sent)):
            received += reader.read(4096)
        for thread in threads:
            thread.join()
    assert sorted(received.splitlines(keepends=True)) == sent


def test_simulator_cleans_up(tmp_path):
    link = tmp_path / "by-id/modem"
    with FaultyModem(link=link) as modem:
        node = modem.node
        assert link.resolve() == node
        modem.unplug()
        assert not link.exists()
        modem.replug()
        assert link.resolve() == modem.node != node
    assert not link.is_symlink()


def test_simulator_never_removes_what_is_not_its_own_link(tmp_path):
    path = tmp_path / "precious"
    path.write_text("x")
    with pytest.raises(UsageError, match="the name is taken"):
        FaultyModem(link=path)
    assert path.read_text() == "x"
    name = tmp_path / "name"
    name.symlink_to(path)
    with pytest.raises(UsageError, match="the name is taken"):
        FaultyModem(link=name)
    assert name.is_symlink()
    name.unlink()
    name.symlink_to("/dev/ttyUSB2")  # the user's, to her modem
    with pytest.raises(UsageError, match="the name is taken"):
        FaultyModem(link=name)
    assert str(name.readlink()) == "/dev/ttyUSB2"
    name.unlink()
    with FaultyModem(link=name):
        name.unlink()
        name.symlink_to("/dev/ttyUSB2")
    assert str(name.readlink()) == "/dev/ttyUSB2", "put there while it ran"


# telemetry ---------------------------------------------------------------------------------------------------


def read_lines(data, options):
    rows = [line.split(",") for line in data.decode().splitlines()]
    content = {
        "time": pd.to_datetime([row[0] for row in rows]).astype("datetime64[ns]"),
        "line": range(len(rows)),
        "flag": "",
    }
    for name in RECORD_COLUMNS["telemetry"]:
        content[name] = np.full(len(rows), np.nan if name == "fix" else 0.0)
    content["altitude_m"] = [float(row[1]) for row in rows]
    return ReadResult("t", (Stream("telemetry", "t", pd.DataFrame(content)),), len(rows), len(rows), 0)


LINES = Reader("t", "", ("telemetry",), "", lambda _head: True, read_lines)


def second(i):
    return int(pd.Timestamp(f"2026-01-01T00:00:{i:02d}").value)


def test_growing_telemetry(tmp_path):
    path = tmp_path / "t.log"
    follower = TelemetryFollower(path, LINES, ReadOptions())

    def heights():
        follower.poll()
        return [sample.altitude_m for sample in follower.samples]

    assert heights() == []
    path.write_text("2026-01-01T00:00:00,1\n2026-01-01T00:00:01,2\n2026-01-01T00:0")
    assert heights() == [1.0, 2.0]
    assert heights() == [1.0, 2.0]
    with path.open("a") as file:
        file.write("0:02,3\n")
    assert heights() == [1.0, 2.0, 3.0]
    assert follower.at(second(1) + 400_000_000).altitude_m == 2.0
    assert follower.at(second(1) + 600_000_000).altitude_m == 3.0
    assert follower.at(second(5)) is None
    assert follower.at(second(4)).altitude_m == 3.0
    path.write_text("2026-01-01T00:00:30,4\n")  # a new flight under the old name
    assert heights() == [4.0]
    predict = predict_along(follower, lambda sample: Prediction(rank=round(sample.altitude_m)))
    now = predict(second(30))
    assert (now.rank, now.telemetry_age_s) == (4, 0.0)
    late = predict(second(40))
    assert (late.rank, late.telemetry_age_s) == (None, 10.0)


def test_only_the_end_of_long_telemetry_is_read(tmp_path):
    path = tmp_path / "t.log"
    path.write_text("".join(f"2026-01-01T00:00:{i % 60:02d},{i}\n" for i in range(6000)))
    follower = TelemetryFollower(path, LINES, ReadOptions())
    follower.poll()
    assert 500 < len(follower.samples) < 1000
    assert follower.samples[-1].altitude_m == 5999.0


def test_the_delay_of_telemetry_counts_new_lines_only(tmp_path):
    """A log that stopped is old. Its lines were not delayed."""
    path = tmp_path / "t.log"
    path.write_text("2026-01-01T00:00:00,1\n")
    follower = TelemetryFollower(path, LINES, ReadOptions())
    for _ in range(3):
        follower.poll()
    assert len(follower._delays) == 1

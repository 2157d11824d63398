"""The simulated modem, the followed telemetry and the CSV export."""

import threading

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.live.follow import TelemetryFollower, predict_along
from aerpaw_cmp.live.predict import Prediction
from aerpaw_cmp.live.serial import simulator
from aerpaw_cmp.live.serial.modem import decode
from aerpaw_cmp.live.serial.simulator import ModemSimSettings, ModemSimulator, load_recorded, ranks_of
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import COLUMNS as RECORD_COLUMNS
from aerpaw_cmp.logs.records import ReadResult, Stream
from tests.live.terminals import held

TRANSCRIPT = b"""AT+QNWCFG="nr5g_csi"
+QNWCFG: "nr5g_csi",21,3,9,11

OK
AT+QNWCFG="nr5g_csi"
+QNWCFG: "nr5g_csi",5,1,4,2

OK
at+qnwinfo;+qeng="servingcell"
+QNWINFO: "TDD NR5G","99999","NR5G BAND 78",633984
+QENG: "servingcell","NOCONN","NR5G-SA","TDD",999,99,0002A4001,77,1F,633984,78,12,-80,-11,25,1,-

OK
"""


def test_transcript_as_a_modem(tmp_path):
    path = tmp_path / "t.txt"
    path.write_bytes(TRANSCRIPT)
    modem = load_recorded(path)
    ranks = [decode("nr5g_csi", modem.reply('AT+QNWCFG="nr5g_csi"')[:-1]).values["rank"] for _ in range(4)]
    assert ranks == [3, 1, 3, 1]
    assert decode("servingcell", modem.reply('AT+QENG="servingcell"')[:-1]).values["nr"]["rsrp_dbm"] == -80
    assert modem.reply("AT+QNWINFO")[-1] == "OK"
    assert modem.reply("AT+QRSRP") == ("ERROR",)
    assert modem.reply("AT") == ("OK",)


def test_tap_of_a_transcript(modem, tap, tools, tmp_path):
    path = tmp_path / "t.txt"
    path.write_bytes(TRANSCRIPT)
    session = tap(modem(source=path).port)
    session.wait(lambda: len(tools.exchanges(tmp_path / "log", "nr5g_csi")) >= 4)
    session.end()
    ranks = [r["decoded"]["rank"] for r in tools.exchanges(tmp_path / "log", "nr5g_csi")]
    assert ranks[:4] == [3, 1, 3, 1]


def test_the_ranks_of_a_log_are_flown_again(tmp_path, monkeypatch):
    def read(data, options):
        rows = [line.split(",") for line in data.decode().split()]
        times = pd.Timestamp("2026-01-01") + pd.to_timedelta([float(row[0]) for row in rows], unit="s")
        ranks = [float(row[1]) for row in rows]
        frame = pd.DataFrame({"time": times, "line": range(len(rows)), "flag": "", "rank": ranks, "ri_raw": ranks})
        return ReadResult("r", (Stream("rank", "r", frame),), len(rows), len(rows), 0)

    reader = Reader("r", "", ("rank",), "", lambda _head: True, read)
    monkeypatch.setattr(simulator, "identify", lambda _data: reader)
    path = tmp_path / "rank.csv"
    path.write_text("10,1\n12,4\n14,nan\n15,2\n")
    rank = ranks_of(path, ReadOptions(timezone="UTC"))
    ranks = [rank(t) for t in (0.0, 1.9, 2.0, 3.9, 4.5, 5.0, 5.9, 6.1)]
    assert ranks == [1, 1, 4, 4, 0, 2, 2, 1]  # and again from the start


@pytest.mark.parametrize("content", [b"", b"\0" * 100, b"no answer here\n"])
def test_nothing_to_replay(tmp_path, content):
    path = tmp_path / "t.txt"
    path.write_bytes(content)
    with pytest.raises(InputError, match="no answer to any known command"):
        load_recorded(path)
    with pytest.raises(InputError):
        load_recorded(tmp_path / "missing.txt")


def test_what_two_threads_say_at_once_comes_one_behind_the_other():
    """Longer than the system's buffer of a terminal, so that each writer has to wait in the middle."""
    sent = [letter * 200_000 + b"\n" for letter in (b"a", b"b")]
    with ModemSimulator() as modem, held(modem.port) as reader:
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
    with ModemSimulator(ModemSimSettings(link=link)) as modem:
        node = modem.node
        assert link.resolve() == node
        modem.unplug()
        assert not link.exists()
        modem.replug()
        assert link.resolve() == modem.node != node
    assert not link.is_symlink()
    with pytest.raises(UsageError):
        ModemSimSettings(kind="toaster")


def test_simulator_never_removes_what_is_not_its_own_link(tmp_path):
    path = tmp_path / "precious"
    path.write_text("x")
    with pytest.raises(UsageError, match="the name is taken"):
        ModemSimulator(ModemSimSettings(link=path))
    assert path.read_text() == "x"
    name = tmp_path / "name"
    name.symlink_to(path)
    with pytest.raises(UsageError, match="the name is taken"):
        ModemSimulator(ModemSimSettings(link=name))
    assert name.is_symlink()
    name.unlink()
    name.symlink_to("/dev/ttyUSB2")  # the user's, to her modem
    with pytest.raises(UsageError, match="the name is taken"):
        ModemSimulator(ModemSimSettings(link=name))
    assert str(name.readlink()) == "/dev/ttyUSB2"
    name.unlink()
    with ModemSimulator(ModemSimSettings(link=name)):
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
        content[name] = np.zeros(len(rows))
    content["altitude_m"] = [float(row[1]) for row in rows]
    return ReadResult("t", (Stream("telemetry", "t", pd.DataFrame(content)),), len(rows), len(rows), 0)


LINES = Reader("t", "", ("telemetry",), "", lambda _head: True, read_lines)


def second(i):
    return int(pd.Timestamp(f"2026-01-01T00:00:{i:02d}").value)


def test_growing_telemetry(tmp_path):
    path = tmp_path / "t.log"
    follower = TelemetryFollower(path, reader=LINES, keep_s=5)
    assert follower.poll() == 0
    path.write_text("2026-01-01T00:00:00,1\n2026-01-01T00:00:01,2\n2026-01-01T00:0")
    assert follower.poll() == 2
    assert follower.latest().altitude_m == 2.0
    assert follower.poll() == 0
    with path.open("a") as file:
        file.write("0:02,3\n")
    assert follower.poll() == 1
    assert follower.at(second(1) + 400_000_000).altitude_m == 2.0
    assert follower.at(second(1) + 600_000_000).altitude_m == 3.0
    assert follower.at(second(5)) is None
    assert follower.at(second(4)).altitude_m == 3.0
    with path.open("a") as file:
        file.write("2026-01-01T00:00:20,9\n")
    follower.poll()
    assert follower.at(second(2)) is None  # forgotten
    path.write_text("2026-01-01T00:00:30,4\n")  # a new flight under the old name
    assert follower.poll() == 1
    assert follower.latest().altitude_m == 4.0
    predict = predict_along(follower, lambda sample: Prediction(rank=round(sample.altitude_m)))
    now = predict(second(30))
    assert (now.rank, now.telemetry_age_s) == (4, 0.0)
    late = predict(second(40))
    assert (late.rank, late.telemetry_age_s) == (None, 10.0)


def test_long_telemetry_is_read_from_its_end(tmp_path):
    path = tmp_path / "t.log"
    path.write_text("".join(f"2026-01-01T00:00:{i % 60:02d},{i}\n" for i in range(6000)))
    follower = TelemetryFollower(path, reader=LINES, keep_s=1e6)
    assert 2000 < follower.poll() < 3000
    assert follower.latest().altitude_m == 5999.0

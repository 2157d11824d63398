"""The tap on real pseudo-terminals: what it writes, what it survives, how it ends."""

import os
import re
import signal
import threading
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.live.log import Clock, LogSettings
from aerpaw_cmp.live.modem import OTHER_QUERIES
from aerpaw_cmp.live.ports import Schedule, TapSettings, TapStatus, format_status, stale_after_s
from aerpaw_cmp.live.predict import Prediction
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_parsers.tap_jsonl import READER
from benchmarks.simulated_modem import Faults
from tests.live.terminals import until
from tests.long.tap_common import run_tap


def kinds(records):
    return Counter(r["kind"] for r in records)


def served_and_read(modem, query_text):
    return [s.lines for s in modem.journal if s.read and s.command == query_text]


CSI = 'AT+QNWCFG="nr5g_csi"'


@pytest.mark.usefixtures("web")
def test_every_answer_is_in_the_log_once(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.005))
    session = tap(sim.port)
    session.wait(lambda: len(served_and_read(sim, CSI)) >= 15)
    summary = session.end()
    records, bad = tools.records_of(tmp_path / "log")
    assert not bad
    assert records[0]["kind"] == "header"
    assert records[-1]["kind"] == "end"
    assert records[-1]["reason"] == "test"
    assert [r["n"] for r in records[1:]] == sorted(r["n"] for r in records[1:])
    logged = tools.all_kept(sim, tmp_path / "log")  # the simulator's PMI makes each answer unique
    assert summary.exit_code == 0
    assert summary.answers["nr5g_csi"] == {"ok": len(logged)}
    asked = {r["query"] for r in records if r["kind"] == "exchange"}
    assert asked == {"sync", "identity", "firmware", "csi_ctrl", "nr5g_csi", *OTHER_QUERIES}
    for r in records:
        if r["kind"] == "exchange":
            assert r["sent_mono_ns"] < r["last_mono_ns"]
            assert r["status"] == "ok"
            assert r["last_utc_ns"] - r["sent_utc_ns"] == r["last_mono_ns"] - r["sent_mono_ns"]


def test_one_command_in_flight(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.02, jitter_s=0.03, seed=3))
    session = tap(sim.port)
    session.wait(lambda: len(sim.journal) >= 25)
    session.end()
    spans = [(r["sent_mono_ns"], r["last_mono_ns"]) for r in tools.exchanges(tmp_path / "log")]
    assert all(a[1] <= b[0] for a, b in pairwise(spans))


@pytest.mark.parametrize(
    "faults",
    [
        Faults(echo=True, latency_s=0.0),
        Faults(latency_s=0.0, bytewise_s=0.0005),
        Faults(latency_s=0.0, urc_every=1),
        Faults(latency_s=0.0, rubbish_every=1),
        Faults(latency_s=0.0, binary_echo=True),
        Faults(latency_s=0.0, glue=True),
    ],
    ids=["echo", "bytewise", "urc", "rubbish", "binary-echo", "glued"],
)
def test_faults_cost_no_answer(modem, tap, tools, tmp_path, faults):
    sim = modem(faults=faults)
    session = tap(sim.port)
    session.wait(lambda: len(served_and_read(sim, CSI)) >= 6)
    session.end()
    assert len(tools.all_kept(sim, tmp_path / "log")) >= 6
    answered = [r for r in tools.exchanges(tmp_path / "log", "nr5g_csi") if r["status"] == "ok"]
    assert all(r["decoded"]["rank"] is not None for r in answered)


def test_late_answers_are_kept_and_taken_for_nothing(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0, late_every=9, late_s=0.35))
    session = tap(sim.port, answer_timeout_s=0.2, probe_timeout_s=0.5)
    session.wait(lambda: len(sim.journal) >= 45)
    session.end()
    records, _ = tools.records_of(tmp_path / "log")
    exchanges = [r for r in records if r["kind"] == "exchange"]
    assert any(r["status"] == "timeout" for r in exchanges)
    assert any(r["kind"] == "late" and r["lines"] for r in records)
    tools.all_kept(sim, tmp_path / "log")
    for r in exchanges:  # no answer is recorded under another query
        if r["query"] == "nr5g_csi":
            assert all('"nr5g_csi"' in line for line in r["lines"])
            assert "no_csi_line" not in r["flags"]


def test_missing_final_result_times_out_and_keeps_the_lines(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0, no_final_every=7))
    session = tap(sim.port, answer_timeout_s=0.1, probe_timeout_s=0.3)
    session.wait(lambda: len(sim.journal) >= 40)
    session.end()
    timed_out = [
        r for r in tools.exchanges(tmp_path / "log") if r["status"] == "timeout" and r["query"] not in ("sync",)
    ]
    assert timed_out
    assert all(r["lines"] for r in timed_out)


@pytest.mark.usefixtures("web")
def test_unplug_and_back_under_another_number(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.005))
    session = tap(sim.port, reconnect_min_s=0.02, reconnect_max_s=0.05)
    session.wait(lambda: len(served_and_read(sim, CSI)) >= 3)
    first_node = sim.node
    sim.unplug()
    session.wait(lambda: any("lost" in text for text in session.said))
    records, _ = tools.records_of(tmp_path / "log")
    assert records[-1]["kind"] == "gap"  # on disk while it lasts
    assert records[-1]["state"] == "open"
    sim.replug()
    assert sim.node != first_node
    count = len(sim.journal)
    session.wait(lambda: len(sim.journal) > count + 15)
    summary = session.end()
    records, bad = tools.records_of(tmp_path / "log")
    assert not bad
    (closed,) = [r for r in records if r["kind"] == "gap" and r["state"] == "closed"]
    assert closed["port"]["device"] == str(sim.node)
    assert closed["missed"]["nr5g_csi"] == closed["duration_ns"] // 50_000_000
    assert summary.gaps == 1
    # the modem is set up again after the gap
    place = next(i for i, r in enumerate(records) if r["kind"] == "gap")
    assert [r["query"] for r in records[place:] if r["kind"] == "exchange"][:4] == [
        "sync",
        "identity",
        "firmware",
        "csi_ctrl",
    ]
    logged = {tuple(r["lines"]) for r in tools.exchanges(tmp_path / "log", "nr5g_csi")}
    assert {s.lines for s in sim.journal if s.command == CSI and s.read} <= logged


def test_the_end_inside_a_gap(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0))
    session = tap(sim.port)
    session.wait(lambda: len(sim.journal) > 8)
    sim.unplug()
    session.wait(lambda: any("lost" in text for text in session.said))
    summary = session.end()
    records, _ = tools.records_of(tmp_path / "log")
    assert [r["kind"] for r in records[-2:]] == ["gap", "end"]
    assert records[-2]["state"] == "closed"
    assert summary.gap_s > 0
    assert not session.statuses[-1].connected


def test_a_reset_modem_is_set_up_again(modem, tap, tools, tmp_path):
    sim = modem(csi_on=False, faults=Faults(latency_s=0.0))
    session = tap(sim.port, enable_csi=True)
    session.wait(lambda: sim.csi == [1, 1] and len(sim.journal) > 10)
    sim._modem.csi[:] = [0, 0]
    sim._write(b"\r\nRDY\r\n")
    session.wait(lambda: sim.csi == [1, 1])
    session.end()
    assert sim.csi == [0, 0]  # as it was before the tap
    assert tools.records_of(tmp_path / "log")[0][-1]["csi_restored"] is True


def test_csi_that_cannot_be_put_back_is_told(modem, tap, tools, tmp_path):
    sim = modem(csi_on=False, faults=Faults(latency_s=0.0))
    session = tap(sim.port, enable_csi=True)
    session.wait(lambda: sim.csi == [1, 1] and len(sim.journal) > 10)
    sim.unplug()
    session.wait(lambda: any("lost" in text for text in session.said))
    session.end()
    assert any("CSI reporting stays on" in text for text in session.said)
    assert tools.records_of(tmp_path / "log")[0][-1]["csi_restored"] is False


def test_csi_is_left_alone_without_the_flag(modem, tap, tools, tmp_path):
    sim = modem(csi_on=False, faults=Faults(latency_s=0.0))
    session = tap(sim.port)
    session.wait(lambda: len(served_and_read(sim, CSI)) >= 3)
    session.end()
    assert sim.csi == [0, 0]
    assert not [s.command for s in sim.journal if "csi_ctrl" in s.command and "," in s.command]
    assert any("--enable-csi" in text for text in session.said)


def test_csi_that_was_on_stays_on(modem, tap):
    sim = modem(csi_on=True, faults=Faults(latency_s=0.0))
    session = tap(sim.port, enable_csi=True)
    session.wait(lambda: len(served_and_read(sim, CSI)) >= 3)
    session.end()
    assert sim.csi == [1, 1]


def test_alarm_when_no_csi_comes(modem, tap, tools, tmp_path):
    sim = modem(rank=lambda _seconds: 0, faults=Faults(latency_s=0.0))
    session = tap(sim.port, no_csi_alarm_s=0.3)
    session.wait(lambda: any("no CSI for 0.3 s" in text for text in session.said))
    summary = session.end()
    assert (summary.exit_code, summary.alarms, summary.reason) == (0, 1, "test")
    assert session.statuses[-1].alarm
    assert kinds(tools.records_of(tmp_path / "log")[0])["alarm"] == 1


def test_silent_modem_is_a_gap(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0, silent_after=25))
    session = tap(sim.port, silent_s=0.5, answer_timeout_s=0.1, probe_timeout_s=0.1, reconnect_min_s=0.05)
    session.wait(lambda: any("has not answered for 0.5 s" in text for text in session.said))
    session.end()
    records, _ = tools.records_of(tmp_path / "log")
    (opened,) = [r for r in records if r["kind"] == "gap" and r["state"] == "open"]
    assert "has not answered" in opened["reason"]


@pytest.mark.usefixtures("web")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_signals_end_it_cleanly(modem, child, tools, tmp_path, name):
    sim = modem(csi_on=False, faults=Faults(latency_s=0.005))
    process = child(sim.port, enable_csi=True)
    until(lambda: len(served_and_read(sim, CSI)) >= 3)
    process.send_signal(getattr(signal, name))
    out, err = process.communicate(timeout=10)
    assert (process.returncode, err) == (0, "")
    assert name in out
    records, bad = tools.records_of(tmp_path / "log")
    assert not bad
    assert (records[-1]["kind"], records[-1]["reason"]) == ("end", name)
    assert sim.csi == [0, 0]


def test_sigkill_loses_no_answer(modem, child, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0))
    process = child(sim.port, ri_hz=100.0)
    until(lambda: len(served_and_read(sim, CSI)) >= 20)
    process.kill()
    process.wait()
    read = served_and_read(sim, CSI)
    records, bad = tools.records_of(tmp_path / "log")
    logged = [tuple(r["lines"]) for r in records if r["kind"] == "exchange" and r["query"] == "nr5g_csi"]
    assert logged[: len(read)] == read
    assert [line.torn_tail for line in bad] in ([], [True])
    result = READER.read(next((tmp_path / "log").glob("*.jsonl")).read_bytes(), ReadOptions())
    assert any("no end record" in w for w in result.warnings)


def test_clock_steps_are_recorded(modem, tap, tools, tmp_path):
    """A pause between the readings of both clocks is not a clock step."""
    step, pause = [0], [0.0]

    def wall():
        if pause[0]:
            time.sleep(pause[0])
        return time.time_ns() + step[0]

    sim = modem(faults=Faults(latency_s=0.0))
    session = tap(sim.port, options={"clock": Clock(wall, time.monotonic_ns)})
    session.wait(lambda: len(served_and_read(sim, CSI)) >= 12)  # on a busy machine, fewer may bring no first offset
    pause[0] = 0.056
    count = len(sim.journal)
    session.wait(lambda: len(sim.journal) > count + 3)
    pause[0], step[0] = 0.0, -3_600_000_000_000

    def steps():
        return [r["step_ns"] for r in tools.records_of(tmp_path / "log")[0] if r["kind"] == "clock"]

    session.wait(steps)
    session.end()
    (step_ns,) = steps()
    assert abs(step_ns + 3_600_000_000_000) < 1_000_000_000


def test_a_disk_fault_does_not_stop_the_polling(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0))
    session = tap(sim.port, log=LogSettings(retry_s=0.05))
    session.wait(lambda: len(served_and_read(sim, CSI)) >= 3)
    path = next((tmp_path / "log").iterdir())
    fd = next(int(f.name) for f in Path("/proc/self/fd").iterdir() if os.path.realpath(f) == str(path))
    duplicate = os.dup(fd)
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full, fd)  # from here on the kernel says ENOSPC
    count = len(sim.journal)
    session.wait(lambda: len(sim.journal) > count + 10)
    assert any("disk is full" in text for text in session.said)
    os.dup2(duplicate, fd)  # and now there is room again
    session.wait(lambda: any("accepts records again; 0 were lost" in text for text in session.said))
    os.close(duplicate)
    os.close(full)
    summary = session.end()
    assert (summary.lost_records, summary.exit_code) == (0, 0)
    assert tools.all_kept(sim, tmp_path / "log")


def test_personal_data_never_reach_the_log(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0))
    session = tap(sim.port)
    session.wait(lambda: len(served_and_read(sim, CSI)) >= 2)
    # invented: IMEI, IMSI, ICCID, number, message
    for line in (
        '+CLIP: "+4915123456789",145',
        "490154203237518",
        "+CIMI: 001010123456789",
        "+QCCID: 8949020000012345678F",
        '+CMT: "+4915123456789"',
        "secret message",
    ):
        sim._write(line.encode() + b"\r\n")
    count = len(sim.journal)
    session.wait(lambda: len(sim.journal) > count + 10)
    assert session.end().redacted == 6
    text = "".join(path.read_text() for path in (tmp_path / "log").iterdir())
    # time stamps, checksums and identifiers can contain a few digits of a number by chance
    answers = re.sub(r'"(\w+_ns|crc|session|boot_id)":"?[\w-]+', "", text)
    for secret in ("4915123", "490154", "00101012", "894902", "secret"):
        assert secret not in answers
    assert text.count('"kind":"unsolicited"') == 6


def test_predictions_stand_beside_the_answers(modem, tap, tools, tmp_path):
    threads = set()

    def predict(utc_ns):
        threads.add(threading.current_thread().name)
        return None if utc_ns % 3 == 0 else Prediction(rank=2, level_dbm=-50.0, east_m=1.0, north_m=2.0, up_m=30.0)

    sim = modem(rank=lambda _seconds: 3, faults=Faults(latency_s=0.0))
    session = tap(sim.port, options={"predict": predict})
    session.wait(lambda: len(served_and_read(sim, CSI)) >= 12)
    session.end()
    records, _ = tools.records_of(tmp_path / "log")
    answers = {r["sent_utc_ns"]: r for r in records if r["kind"] == "exchange"}
    predictions = [r for r in records if r["kind"] == "prediction"]
    assert len(predictions) >= 5
    assert threads == {"tap-prediction"}
    for r in predictions:
        assert answers[r["for_sent_utc_ns"]]["decoded"]["rank"] == r["measured"] == 3
        assert r.get("residual") == (None if r["predicted"] is None else 1)
        if r["predicted"] is not None:
            assert (r["east_m"], r["north_m"], r["up_m"], r["level_dbm"]) == (1.0, 2.0, 30.0, -50.0)
    assert "predicted" in format_status(session.statuses[-1])


def test_a_failing_prediction_does_not_end_the_log(modem, tap, tools, tmp_path):
    def predict(utc_ns):
        raise RuntimeError("no such tower")

    sim = modem(faults=Faults(latency_s=0.0))
    session = tap(sim.port, options={"predict": predict})
    session.wait(lambda: len(served_and_read(sim, CSI)) >= 6)
    session.end()
    assert [text for text in session.said if "no such tower" in text] == [
        "the prediction failed: RuntimeError: no such tower"
    ]


def test_a_broken_terminal_does_not_end_the_log(modem, tmp_path):
    def broken(status):
        raise BrokenPipeError

    sim = modem(faults=Faults(latency_s=0.0))
    settings = TapSettings(tmp_path / "log", str(sim.port), duration_s=1.0, status_s=0.1)
    assert run_tap(settings, on_status=broken).reason == "duration"


def test_a_hanging_terminal_does_not_hold_the_polling(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0))
    hang = threading.Event()
    settings = TapSettings(tmp_path / "log", str(sim.port), ri_hz=20.0, pause_s=0.0, duration_s=2.0, status_s=0.1)
    summary = run_tap(settings, on_status=lambda _status: hang.wait(60) and None)
    hang.set()
    assert summary.reason == "duration"
    assert len(tools.all_kept(sim, tmp_path / "log")) >= 20


def polled(answer_ns, until_ns):
    schedule = Schedule({"ri": 500, "a": 1000, "b": 1000})
    schedule.reset(0)
    counts, now = Counter(), 0
    while True:
        name, due = schedule.next(now)
        now = max(now, due)
        if now >= until_ns:
            return counts, schedule.missed
        schedule.started(name, now)
        counts[name] += 1
        now += answer_ns


def test_schedule_keeps_the_rates():
    counts, missed = polled(90, 10_000)
    assert counts == {"ri": 20, "a": 10, "b": 10}
    assert not sum(missed.values())


def test_schedule_of_a_slow_modem_prefers_the_first_and_tells_what_it_missed():
    counts, missed = polled(400, 100_000)
    assert 197 <= counts["ri"] + missed["ri"] <= 200  # the last slots wait
    assert counts["ri"] >= 120
    assert abs(counts["a"] - counts["b"]) <= 4
    assert missed["a"] > 0
    assert 97 <= counts["a"] + missed["a"] <= 100  # every slot is polled or missed, once


def test_a_modem_slower_than_the_rank_is_still_asked_for_its_levels():
    counts, missed = polled(600, 100_000)
    assert counts["a"] >= 15
    assert abs(counts["a"] - counts["b"]) <= 1
    assert counts["ri"] >= 120
    assert 196 <= counts["ri"] + missed["ri"] <= 200


def test_a_value_is_old_after_three_seconds_or_three_slow_periods():
    assert stale_after_s(0.5) == stale_after_s(1.0) == 3.0
    assert stale_after_s(4.0) == 12.0


def test_status_line():
    status = TapStatus(True, 3, -90, 21, 1.98, 1, 100, 2**21, 2**33)
    assert format_status(status) == "rank 3  RSRP -90 dBm  SINR 21 dB  2.0 Hz  1 gap  2.0 MiB  disk 8.0 GiB"
    status = TapStatus(False, None, None, None, 0.0, 0, 0, 0, None, alarm=True)
    assert format_status(status) == "NO PORT  RSRP -  SINR -  0.0 Hz  0 gaps  0.0 MiB  disk ?  NO CSI"


@pytest.mark.parametrize("values", [{"ri_hz": 0}, {"ri_hz": float("nan")}, {"duration_s": 0}, {"no_csi_alarm_s": 0}])
def test_wrong_settings(tmp_path, values):
    with pytest.raises(UsageError):
        TapSettings(tmp_path, **values)


def test_schedule_catches_up_after_a_short_stall_and_not_after_a_long_one():
    for stall, missed in ((900, 0), (1400, 0), (1900, 3)):
        schedule = Schedule({"ri": 500})
        schedule.reset(0)
        schedule.started("ri", 0)
        now, polls = 500 + stall, 0  # the slot at 500 is answered this late
        while schedule.next(now)[1] <= now:
            schedule.started("ri", now)
            polls += 1
        assert schedule.missed["ri"] == missed
        assert polls + missed == 1 + stall // 500, "every slot is polled or missed, once"


def test_an_unfinished_line_between_commands_is_in_the_gap_record(modem, tap, tools, tmp_path):
    """It belonged to no command, and went with the old framer: not a byte of it was in the log."""
    sim = modem(faults=Faults(latency_s=0.0))
    session = tap(sim.port, ri_hz=0.2, other_hz=0.0, reconnect_min_s=0.02, reconnect_max_s=0.05)
    session.wait(lambda: len(served_and_read(sim, CSI)) >= 1 or len(sim.journal) >= 5)
    time.sleep(0.3)  # nothing is in flight now
    sim._write(b'\r\n+QIND: "csq",2')
    time.sleep(0.2)
    sim.unplug()
    session.wait(lambda: any("lost" in text for text in session.said))
    sim.replug()
    count = len(sim.journal)
    session.wait(lambda: len(sim.journal) > count + 3)
    session.end()
    records, _ = tools.records_of(tmp_path / "log")
    (gap,) = [r for r in records if r["kind"] == "gap" and r["state"] == "open"]
    assert gap["partial"] == '+QIND: "csq",2'
    ends = [r for r in records if r["kind"] == "end"]
    assert ends[0]["received_bytes"] == sim.sent_bytes

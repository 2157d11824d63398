"""``tap`` as a job: several modems at once, the page's address, commands for the report."""

import threading
import time
from urllib.request import Request, urlopen

import pytest

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.jobs.live_tap import TOKEN, Shown, tap_modems
from aerpaw_cmp.live.ports import TapSettings
from benchmarks.simulated_modem import Faults, FaultyModem, read_log


def shown(web=None, **values):
    said = []
    return Shown(web=web, flight=None, telemetry=None, say=said.append, **values), said


@pytest.fixture
def modems(tmp_path):
    """Two modems: one reports rank 1, the other rank 4."""
    made = [
        FaultyModem(link=tmp_path / name, rank=lambda _s, k=k: k, faults=Faults(latency_s=0.0))
        for name, k in (("left", 1), ("right", 4))
    ]
    with made[0], made[1]:
        yield [str(modem.port) for modem in made]


def test_two_modems_are_logged_side_by_side(modems, tmp_path):
    settings = TapSettings(tmp_path / "log", ri_hz=20.0, pause_s=0.0, status_s=0.1, duration_s=1.5)
    statuses, (page, said) = [], shown("127.0.0.1:0")
    summaries = tap_modems(settings, modems, page, lambda name, status: statuses.append((name, status.connected)))
    assert [summary.reason for summary in summaries] == ["duration", "duration"]
    for name, rank in (("left", 1), ("right", 4)):
        records = list(read_log(tmp_path / "log" / name))
        ranks = {r["decoded"]["rank"] for r in records if r["kind"] == "exchange" and r["query"] == "nr5g_csi"}
        assert ranks == {rank}
        assert (name, True) in statuses
    assert said[0].startswith("the page: http://127.0.0.1:")


def test_a_modem_that_is_not_there_ends_all_at_the_start(modems, tmp_path):
    settings = TapSettings(tmp_path / "log", duration_s=60.0)
    start = time.monotonic()
    with pytest.raises(InputError, match="nowhere is not there"):
        tap_modems(settings, [modems[0], str(tmp_path / "nowhere")], shown()[0], lambda *_: None)
    assert time.monotonic() - start < 30.0


def test_ports_of_one_name_get_folders_of_their_own(tmp_path):
    links = [tmp_path / "a" / "modem", tmp_path / "b" / "modem"]
    with FaultyModem(link=links[0]) as first, FaultyModem(link=links[1]) as second:
        settings = TapSettings(tmp_path / "log", duration_s=0.3)
        tap_modems(settings, [str(first.port), str(second.port)], shown()[0], lambda *_: None)
    assert sorted(path.name for path in (tmp_path / "log").iterdir()) == ["modem-1", "modem-2"]


@pytest.mark.parametrize("web", ["8765", "nowhere"])
def test_an_address_that_is_none_is_refused_before_anything_is_written(modems, tmp_path, web):
    with pytest.raises(UsageError, match="--web"):
        tap_modems(TapSettings(tmp_path / "log"), modems[:1], shown(web)[0], lambda *_: None)
    assert not (tmp_path / "log").exists()


def test_the_token_of_the_environment_outlives_a_restart(modems, tmp_path, monkeypatch):
    monkeypatch.setenv(TOKEN, "field-day")
    page, said = shown("0.0.0.0:0")
    settings = TapSettings(tmp_path / "log", duration_s=3.0)
    tap = threading.Thread(target=tap_modems, args=(settings, modems[:1], page, lambda *_: None))
    tap.start()
    while not said:
        time.sleep(0.02)
    assert "field-day" not in said[0], "a token that was set is a secret, and standard error may be a journal"
    url = said[0].split()[3].replace("...", "field-day")
    assert url.startswith("http://127.0.0.1:")
    assert url.endswith("/?token=field-day")
    with urlopen(Request(url), timeout=5) as answer:
        assert b"<title>Live rank and level" in answer.read()
    tap.join()

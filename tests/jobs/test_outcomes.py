"""Outcomes of tasks: kept, taken again, never taken when damaged or stale; a lost worker costs its own task only."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.flight.overrides import overridden
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs import campaign, sample
from aerpaw_cmp.jobs.outcomes import OutcomeStore, task_key
from aerpaw_cmp.report.campaign_data import Failure, FlownTrack

TYPES = (campaign.Outcome, campaign.RssRow, campaign.RankRow, FlownTrack)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sample.write_sample(tmp_path_factory.mktemp("season") / "flight")


def track(number: float) -> campaign.Outcome:
    return campaign.Outcome(
        track=FlownTrack(flight=f"f{number:g}", time_s=np.arange(3.0), position_m=np.full((3, 3), number))
    )


def equal(one: campaign.Outcome, two: campaign.Outcome) -> bool:
    assert one.track is not None
    assert two.track is not None
    return one.track.flight == two.track.flight and np.array_equal(one.track.position_m, two.track.position_m)


def test_an_outcome_comes_back_as_it_was(tmp_path: Path) -> None:
    store = OutcomeStore(tmp_path, TYPES)
    store.save("a", track(2.5))
    found = store.load("a")
    assert equal(found, track(2.5))
    assert found.rss == ()
    assert store.load("b") is None


@pytest.mark.parametrize("place", [0, 100, -1])
def test_a_damaged_entry_is_told_and_not_used(tmp_path: Path, place: int) -> None:
    store = OutcomeStore(tmp_path, TYPES)
    store.save("a", track(1.0))
    file = tmp_path / "a.npz"
    content = bytearray(file.read_bytes())
    content[place] ^= 0xFF
    file.write_bytes(content)
    assert store.load("a") is None
    assert "damaged" in store.told[0]


def test_every_record_of_a_real_outcome_can_be_kept(flight: Path, tmp_path: Path) -> None:
    """One task of the sample flight, through the store and back: the same numbers, the same nested records."""
    quick = {"rss.lag": "off", "rss.bootstrap": 10, "rank.bootstrap": 10}
    settings = load_flight(flight)
    known = {
        key: value for key, value in quick.items() if hasattr(getattr(settings, key.split(".")[0]), key.split(".")[1])
    }
    task = campaign.Task(flight, "f", "as written", known, None)
    (first,) = campaign.run_tasks([task], 1, None, lambda *_: None, tmp_path)
    assert first.failure is None
    store, keys = campaign._kept([task], tmp_path)
    again = store.load(keys[0])
    assert repr(again.rank) == repr(first.rank)
    assert [row.rmse_db for row in again.rss] == [row.rmse_db for row in first.rss]
    assert np.array_equal(again.rss[0].measured_db, first.rss[0].measured_db, equal_nan=True)


def test_a_key_is_of_everything_that_matters(flight: Path) -> None:
    settings = load_flight(flight)
    key = task_key(settings, flight, None, "x")
    assert key == task_key(load_flight(flight), flight, None, "x")
    assert key != task_key(settings, flight, None, "y")
    assert key != task_key(overridden(settings, {"rt.max_depth": 1}), flight, None, "x")
    log = flight.parent / settings.logs[0].path
    before = log.read_bytes()
    try:
        log.write_bytes(before + b"\n")
        assert key != task_key(settings, flight, None, "x")
    finally:
        log.write_bytes(before)
    assert key == task_key(settings, flight, None, "x")


def tasks_of(flight: Path, count: int = 4) -> list[campaign.Task]:
    return [campaign.Task(flight, f"f{i}", "as written", {"rt.max_depth": 1 + i % 2}, None) for i in range(count)]


def test_what_is_kept_is_not_computed_again(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def one(task: campaign.Task) -> campaign.Outcome:
        asked.append(task.flight)
        if task.flight == "f3" and len(asked) < 6:
            return campaign.Outcome(failure=Failure(flight="f3", setting="as written", message="no luck"))
        return track(float(task.flight[1:]))

    monkeypatch.setattr(campaign, "run_task", one)
    tasks = tasks_of(flight)
    first = campaign.run_tasks(tasks, 1, None, lambda *_: None, tmp_path)
    assert asked == ["f0", "f1", "f2", "f3"]
    again = campaign.run_tasks(tasks, 1, None, lambda *_: None, tmp_path)
    assert asked[4:] == ["f3"], "only the failure is tried again"
    assert all(equal(a, b) for a, b in zip(first[:3], again[:3], strict=True))
    campaign.run_tasks(tasks, 1, None, lambda *_: None)
    assert len(asked) == 9, "nothing is kept unless asked for"


KILLED = """
import os, signal, sys
from pathlib import Path
from aerpaw_cmp.jobs import campaign
from aerpaw_cmp.report.campaign_data import FlownTrack
import numpy as np

def one(task):
    if task.flight == "f2":
        os.kill(os.getpid(), signal.SIGKILL)
    number = float(task.flight[1:])
    return campaign.Outcome(track=FlownTrack(flight=task.flight, time_s=np.arange(3.0), position_m=np.full((3, 3), number)))

campaign.run_task = one
flight = Path(sys.argv[1])
tasks = [campaign.Task(flight, f"f{i}", "as written", {"rt.max_depth": 1 + i % 2}, None) for i in range(4)]
campaign.run_tasks(tasks, 1, None, lambda *_: None, Path(sys.argv[2]))
"""


def test_after_sigkill_only_what_is_missing_is_computed(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = subprocess.run([sys.executable, "-c", KILLED, str(flight), str(tmp_path)], check=False)
    assert done.returncode == -signal.SIGKILL
    asked: list[str] = []
    monkeypatch.setattr(campaign, "run_task", lambda task: asked.append(task.flight) or track(float(task.flight[1:])))
    found = campaign.run_tasks(tasks_of(flight), 1, None, lambda *_: None, tmp_path)
    assert asked == ["f2", "f3"]
    assert all(equal(one, track(float(i))) for i, one in enumerate(found))


def lethal(task: campaign.Task) -> campaign.Outcome:
    """Ends its worker: once where a file says so, always for the task called poison."""
    if task.flight == "poison" or (task.flight == "f1" and not _happened(task)):
        os.kill(os.getpid(), signal.SIGKILL)
    return track(float(task.flight[1:]))


def _happened(task: campaign.Task) -> bool:
    mark = Path(os.environ["AERPAW_CMP_TEST_MARKS"]) / task.flight
    if mark.exists():
        return True
    mark.touch()
    return False


def marked(task: campaign.Task, mark: str) -> campaign.Outcome:
    Path(mark).touch()
    return lethal(task)


def test_a_lost_worker_costs_its_own_task_one_more_try(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fails on one pool for everything: there a killed worker loses all tasks."""
    monkeypatch.setenv("AERPAW_CMP_TEST_MARKS", str(tmp_path))
    monkeypatch.setattr(campaign, "_marked", marked)
    monkeypatch.setattr(campaign, "get_context", lambda _kind: __import__("multiprocessing").get_context("fork"))
    tasks = [*tasks_of(flight, 6), campaign.Task(flight, "poison", "as written", {}, None)]
    found = campaign.run_tasks(tasks, 2, None, lambda *_: None)
    assert [one.failure is None for one in found] == [True] * 6 + [False]
    assert found[-1].failure is not None
    assert "worker process ended" in found[-1].failure.message
    assert [one.track.flight for one in found[:6] if one.track is not None] == [f"f{i}" for i in range(6)]

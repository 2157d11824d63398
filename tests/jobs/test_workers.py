"""Workers of every kind give one result; what they lose, see or run differently is told."""

from __future__ import annotations

import builtins
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.jobs import workers
from aerpaw_cmp.jobs.workers import open_workers


@pytest.fixture(scope="module")
def seen() -> dict[str, Any]:
    """Real clusters: two workers of this machine, a scheduler that is started again, one that stays away."""
    pytest.importorskip("distributed", reason="distributed is not installed (extra 'dev')")
    script = Path(__file__).with_name("cluster_scenarios.py")
    # each worker forked from a server that has Dask loaded: a fresh interpreter for each takes two seconds
    environ = {**os.environ, "DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver"}
    done = subprocess.run(
        [sys.executable, str(script)], env=environ, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr[-3000:]
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_workers_of_this_machine_give_what_one_process_gives(seen: dict[str, Any]) -> None:
    local = seen["local"]
    assert local["count"] == 2
    assert local["squares"] == [i * i for i in range(25)]
    assert "2 workers of at most" in local["told"][0]
    assert local["memory_share"] <= 0.9


def test_a_killed_worker_costs_its_task_one_more_try(seen: dict[str, Any]) -> None:
    """The task that kills every time is lost alone; its neighbours, and the one that killed once, are there."""
    killed = seen["local"]["killed"]
    assert "worker process ended" in killed[5]
    assert killed[:5] + killed[6:] == [i * i for i in range(8) if i != 5]


def test_workers_that_see_no_file_or_run_other_code_are_named(seen: dict[str, Any]) -> None:
    local = seen["local"]
    assert local["good"] == "no error"
    assert local["unseen"].startswith("UsageError: 2 of 2 workers cannot do this campaign: ")
    assert "does not see" in local["unseen"]
    assert "nowhere" in local["unseen"]
    assert "runs other code" in local["other"]


def test_a_scheduler_that_is_started_again_goes_on(seen: dict[str, Any]) -> None:
    again = seen["restarted"]
    assert again["squares"] == [i * i for i in range(20)]
    assert any("went away" in text for text in again["told"])
    assert any("there again" in text for text in again["told"])


def test_a_scheduler_that_stays_away_or_never_was_is_one_message(seen: dict[str, Any]) -> None:
    assert seen["gone"].startswith("InputError: ")
    assert "run the same command again" in seen["gone"]
    assert "no scheduler answers" in seen["none"]


def test_without_dask_there_are_processes_and_a_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(workers, "_has_dask", lambda: False)
    with open_workers(3, progress=lambda text, *_: told.append(text)) as crew:
        assert isinstance(crew, workers.Processes)
    assert "aerpaw-cmp[cluster]" in told[0]
    real = builtins.__import__

    def without(name: str, *rest: object, **more: object) -> object:
        if name == "distributed":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(UsageError, match=r"aerpaw-cmp\[cluster\]"), open_workers(1, "tcp://127.0.0.1:1"):
        pass


class NoWorkers:
    """A client of a scheduler that loses its last worker and gets one when its absence was told twice."""

    status = "running"

    def __init__(self, told: list[str]) -> None:
        self._told = told

    def nthreads(self) -> dict[str, int]:
        return {} if len(self._told) < 2 else {"tcp://one": 1}

    def submit(self, function: Any, item: Any, pure: bool) -> Any:
        assert not pure
        return Later(self, function(item))


class Later:
    """Done when a worker is there."""

    status = "finished"

    def __init__(self, client: NoWorkers, value: Any) -> None:
        self._client, self._value = client, value

    def add_done_callback(self, _call: Any) -> None:
        """None is needed: the loop looks by itself."""

    def done(self) -> bool:
        return bool(self._client.nthreads())

    def result(self) -> Any:
        return self._value

    def release(self) -> None:
        """Nothing is held."""


def test_a_scheduler_without_workers_is_spoken_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """A season waited for half an hour without a word for workers that had given up while the machine was busy."""
    monkeypatch.setattr(workers, "NO_WORKER_S", 0.1)
    monkeypatch.setattr(workers, "_LOOKED_S", 0.05)
    told: list[str] = []
    crew = workers.Cluster(NoWorkers(told), "tcp://there", lambda text, _share=None: told.append(text))
    found: dict[int, Any] = {}
    crew.run(abs, [-2, 3], found.__setitem__)
    assert found == {0: 2, 1: 3}
    assert len(told) == 2
    assert "no worker is with the scheduler at tcp://there" in told[0]


def test_a_cluster_that_cannot_be_closed_costs_no_result() -> None:
    class Starting:
        def close(self) -> None:
            raise AssertionError("can only join a started process")

    with workers._closed_at_last(Starting()):
        found = 3
    assert found == 3
    with pytest.raises(KeyError, match="ours"), workers._closed_at_last(Starting()):
        raise KeyError("ours")

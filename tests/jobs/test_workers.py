"""Workers of every kind give one result; what they lose, see or run differently is told."""

from __future__ import annotations

import builtins
import json
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
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False, timeout=300)
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

"""One suite for every kind of workers, and what is particular to processes and to Dask."""

import json
import multiprocessing
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.jobs import workers
from aerpaw_cmp.jobs.workers import open_workers
from tests.jobs.worker_tasks import listening, scenarios


@pytest.fixture(scope="module")
def seen() -> dict[str, Any]:
    """Real clusters: one of two workers, a scheduler that ends in the middle."""
    pytest.importorskip("distributed", reason="distributed is not installed (extra 'dev')")
    script = Path(__file__).with_name("cluster_scenarios.py")
    # each worker forked from a server that has Dask loaded: a fresh interpreter for each takes two seconds
    environ = {**os.environ, "DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver"}
    done = subprocess.run(
        [sys.executable, str(script)], env=environ, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr[-3000:]
    scenarios: dict[str, Any] = json.loads(done.stdout)
    return scenarios


@pytest.fixture(scope="module", params=["in process", "processes", "Dask"])
def kind(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Outcomes of the suite for one kind of workers."""
    if request.param == "Dask":
        cluster: dict[str, Any] = request.getfixturevalue("seen")["cluster"]
        return cluster
    with open_workers(1 if request.param == "in process" else 2) as crew:
        return scenarios(crew, tmp_path_factory.mktemp("killed"))


def test_every_item_has_its_result_once(kind: dict[str, Any]) -> None:
    assert kind["count"] == (2 if "killed" in kind else 1)
    assert kind["squares"] == [i * i for i in range(25)]
    assert kind["no items"] == []


def test_the_message_of_a_task_reaches_the_caller_and_the_workers_go_on(kind: dict[str, Any]) -> None:
    assert kind["message"] == "InputError: numbers.txt, line 3: found 3; expected another number"
    assert kind["after a message"] == [4, 9]


def test_a_killed_worker_costs_its_task_one_more_try(kind: dict[str, Any]) -> None:
    """Only the task that ends its worker every time is lost. A result that cannot be sent back is lost, too."""
    if "killed" not in kind:
        pytest.skip("a task cannot end the process of the caller")
    assert "worker process ended" in kind["killed"][5]
    assert kind["killed"][:5] + kind["killed"][6:] == [i * i for i in range(8) if i != 5]
    assert "pickle" in kind["not picklable"][0]


def test_an_interrupt_ends_no_process_of_the_caller() -> None:
    own = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(120,))
    own.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            workers.Processes(2).run(time.sleep, [0.0, 60.0], interrupted)
        assert own.is_alive()
        assert multiprocessing.active_children() == [own]
    finally:
        own.kill()


def interrupted(_number: int, _result: object) -> None:
    raise KeyboardInterrupt


def test_workers_run_no_module_that_lies_in_the_working_folder(tmp_path: Path) -> None:
    """Return a third-party folder of logs with files that are named like modules that a new interpreter loads."""
    script, logs = tmp_path / "script.py", tmp_path / "logs"
    logs.mkdir()
    for name in ("multiprocessing", "pickle", "numpy", "signal"):
        (logs / f"{name}.py").write_text(f"open('ran_{name}', 'w').close()")
    script.write_text(
        "import os\nfrom aerpaw_cmp.jobs.workers import Processes\n"
        "if __name__ == '__main__':\n"
        "    Processes(2).run(os.path.abspath, ['a', 'b'], lambda number, place: print(number, place))\n"
    )
    done = subprocess.run([sys.executable, str(script)], cwd=logs, capture_output=True, text=True, check=True)
    assert sorted(done.stdout.splitlines()) == [f"0 {logs / 'a'}", f"1 {logs / 'b'}"]
    assert not list(logs.glob("ran_*"))


def test_workers_that_see_no_file_or_run_other_code_are_named(seen: dict[str, Any]) -> None:
    cluster = seen["cluster"]
    assert cluster["good"] == "no error"
    assert cluster["unseen"].startswith("UsageError: 2 of 2 workers cannot run this campaign: ")
    assert "does not see" in cluster["unseen"]
    assert "nowhere" in cluster["unseen"]
    assert "runs different code" in cluster["other"]


def test_a_scheduler_without_tls_is_refused(seen: dict[str, Any]) -> None:
    assert seen["cluster"]["plain"].startswith("UsageError: ")
    assert "is not protected" in seen["cluster"]["plain"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc lists sockets")
def test_nothing_listens_while_workers_of_this_machine_work() -> None:
    results: dict[int, Any] = {}
    with open_workers(2) as crew:
        assert crew.count == 2
        crew.run(listening, list(range(4)), results.__setitem__)
    assert results == {number: [] for number in range(4)}
    with socket.socket() as door:  # what the test would see
        door.bind(("127.0.0.1", 0))
        door.listen()
        # among the processes of tests that run at the same time
        assert f"tcp 0100007F:{door.getsockname()[1]:04X}" in listening(0)


def test_workers_end_with_their_parent_and_leave_nothing(tmp_path: Path) -> None:
    """SIGKILL in the middle of a task: no process and no temporary folder stays."""
    script = (
        "import sys, time; sys.path[:0] = sys.argv[2:]\n"
        "from aerpaw_cmp.jobs.workers import open_workers\n"
        "from tests.jobs.worker_tasks import sleeps\n"
        "if __name__ == '__main__':\n"
        "    with open_workers(2) as crew: crew.run(sleeps, [sys.argv[1]] * 2, print)\n"
    )
    (tmp_path / "main.py").write_text(script)
    (tmp_path / "tmp").mkdir()
    command = [sys.executable, str(tmp_path / "main.py"), str(tmp_path), str(Path(__file__).parents[2])]
    parent = subprocess.Popen(command, env={**os.environ, "TMPDIR": str(tmp_path / "tmp")})
    while len(began := [int(path.name) for path in tmp_path.iterdir() if path.name.isdigit()]) < 2:
        assert parent.poll() is None
        time.sleep(0.05)
    parent.kill()
    parent.wait()
    while any(Path(f"/proc/{process}").exists() for process in began):
        time.sleep(0.05)
    assert list((tmp_path / "tmp").iterdir()) == []


def test_a_scheduler_that_stays_away_or_never_was_is_one_message(seen: dict[str, Any]) -> None:
    assert seen["gone"].startswith("InputError: ")
    assert "run the same command again" in seen["gone"]
    assert "no scheduler answers" in seen["none"]


class NoWorkers:
    """A client of a scheduler that loses its last worker, and gets one after two reports of its absence."""

    status = "running"

    def __init__(self, messages: list[str]) -> None:
        self._messages = messages

    def nthreads(self) -> dict[str, int]:
        return {} if len(self._messages) < 2 else {"tcp://one": 1}

    def submit(self, function: Any, item: Any, pure: bool) -> Any:
        assert not pure
        return Later(self, function(item))


class Later:
    """Done when a worker is there."""

    status = "finished"

    def __init__(self, client: NoWorkers, value: Any) -> None:
        self._client, self._value = client, value

    def done(self) -> bool:
        return bool(self._client.nthreads())

    def result(self) -> Any:
        return self._value

    def release(self) -> None:
        """Do nothing."""


def test_a_scheduler_without_workers_is_spoken_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """A campaign waited silently for workers that had given up while the machine was busy."""
    monkeypatch.setattr(workers, "NO_WORKER_S", 0.1)
    monkeypatch.setattr(workers, "COUNT_EVERY_S", 0.05)
    messages: list[str] = []
    crew = workers.Cluster(NoWorkers(messages), lambda text, _share=None: messages.append(text))
    results: dict[int, Any] = {}
    crew.run(abs, [-2, 3], results.__setitem__)
    assert results == {0: 2, 1: 3}
    assert len(messages) == 2
    assert "the scheduler has had no worker" in messages[0]


def test_a_scheduler_that_goes_away_as_it_is_asked_is_one_message() -> None:
    """Dask's own error of a closed line ended a map with exit code 70."""

    class Gone:
        status = "running"

        def nthreads(self) -> dict[str, int]:
            raise OSError("Stream is closed")

    with pytest.raises(InputError, match="cannot be reached"):
        _ = workers.Cluster(Gone()).count

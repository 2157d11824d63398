"""Check stored task results: they are reused under any name, and ignored if damaged or out of date.

A task is tried twice.
"""

import dataclasses
import io
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.files import seal
from aerpaw_cmp.common.stages import logged
from aerpaw_cmp.common.versions import code_digest
from aerpaw_cmp.flight.settings import FlightFile, load_flight, overridden
from aerpaw_cmp.jobs import campaign, sample
from aerpaw_cmp.jobs.campaign import Outcome, Task, carry_out, compute, digest_of, kept_outcomes, planned_tasks
from aerpaw_cmp.jobs.tasks import OutcomeStore, task_inputs, task_key
from aerpaw_cmp.jobs.workers import InProcess, Lost, Workers
from aerpaw_cmp.report.campaign import Failure
from tests.jobs.campaign_rows import rss_row

pytestmark = pytest.mark.usefixtures("few_pictures")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sample.write_sample(tmp_path_factory.mktemp("season") / "flight")


@pytest.mark.parametrize("table", ["dictionary.yaml", "memory_weights.json", "dictionary.py"])
def test_a_changed_table_of_the_code_makes_stored_outcomes_out_of_date(
    table: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, read = code_digest.__wrapped__(), Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read(path) + (b"\n" if path.name == table else b""))
    assert code_digest.__wrapped__() != before


def run_tasks(tasks: list[Task], workers: Workers, keep: Path | None = None) -> list[Outcome]:
    """All tasks in order, as a campaign runs them."""
    store = None if keep is None else OutcomeStore(keep, Outcome)
    outcomes, orders = kept_outcomes(tasks, store, logged)
    compute(orders, workers, outcomes, store, logged)
    return [outcomes[number] for number in range(len(tasks))]


def outcome_of(number: float) -> Outcome:
    return Outcome(rss=(rss_row(f"f{number:g}", "USRP1", np.full(3, number), np.zeros(3)),))


def equal(left: Outcome, right: Outcome) -> bool:
    (mine,), (theirs,) = left.rss, right.rss
    return mine.flight == theirs.flight and np.array_equal(mine.measured_db, theirs.measured_db)


def test_an_outcome_comes_back_as_it_was(tmp_path: Path) -> None:
    store = OutcomeStore(tmp_path, Outcome)
    store.save("a", outcome_of(2.5))
    loaded = store.load("a")
    assert equal(loaded, outcome_of(2.5))
    assert loaded.rank == ()
    assert store.load("b") is None


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((0, 3)),
        np.array(["a", "längst"]),
        np.array([], dtype="datetime64[ns]"),
        np.arange(6).reshape(2, 3).T,
        np.array([np.nan, -0.0, 5e-324]),
        np.array([True, False]),
    ],
)
def test_arrays_of_every_kind_come_back(tmp_path: Path, array: np.ndarray) -> None:
    store = OutcomeStore(tmp_path, Outcome)
    row = rss_row("f", "USRP1", [0.0], [1.0], heading_deg=array, position_m=np.zeros((0, 3)))
    store.save("a", Outcome(rss=(row,)))
    (loaded,) = store.load("a").rss
    assert loaded.heading_deg.dtype == array.dtype
    assert loaded.heading_deg.shape == array.shape
    assert loaded.heading_deg.tobytes() == np.ascontiguousarray(array).tobytes()
    assert loaded.position_m.shape == (0, 3)


@pytest.mark.parametrize("place", [0, 100, -1])
def test_a_damaged_entry_is_told_and_not_used(tmp_path: Path, place: int) -> None:
    store = OutcomeStore(tmp_path, Outcome)
    store.save("a", outcome_of(1.0))
    file = tmp_path / "a.npz"
    content = bytearray(file.read_bytes())
    content[place] ^= 0xFF
    file.write_bytes(content)
    assert store.load("a") is None
    assert "damaged" in store.warnings[0]


# Used where a part of a forged entry is empty: NumPy pickles it.
PICKLED = np.array([{}], dtype=object)


@pytest.mark.parametrize(
    "forged",
    [
        b"",
        b"no archive",
        {"content": b"["},
        {"content": b"3"},
        {"content": b'{"rss": 3}'},
        {"content": b'{"rss": [{"flight": 3, "measured_db": 1}]}'},
        {"content": b'{"rss": [{"nothing": 3}]}'},
        {"content": b'{"rss": [{"flight": "f", "measured_db": {"array of the entry": "a7"}}]}', "a0": b"12"},
        {"content": b'{"rss": [{"flight": "f", "measured_db": {"array of the entry": ["a0"]}}]}', "a0": b"12345678"},
        {"content": b'{"failure": {"flight": "f"}}'},
        {"content": b"{}", "a0": b""},
        {"content": b"[" * 100_000 + b"]" * 100_000},
    ],
)
def test_a_forged_entry_is_told_and_not_used(tmp_path: Path, forged: bytes | dict[str, bytes]) -> None:
    """Sealed as ours is: anybody who can write there can do that."""
    entry = io.BytesIO(forged) if isinstance(forged, bytes) else io.BytesIO()
    if isinstance(forged, dict):
        parts = {name: np.frombuffer(part, dtype=np.uint8) if part else PICKLED for name, part in forged.items()}
        np.savez(entry, **parts)
    (tmp_path / "a.npz").write_bytes(seal(entry.getvalue(), b"aerpaw-cmp outcome"))
    store = OutcomeStore(tmp_path, Outcome)
    assert store.load("a") is None
    assert "that this tool did not write was not used" in store.warnings[0]


@pytest.mark.parametrize("place", ["a_file", "/proc/nowhere"])
def test_a_place_that_takes_nothing_is_a_usage_error(tmp_path: Path, place: str) -> None:
    (tmp_path / "a_file").touch()
    with pytest.raises(UsageError, match="task results cannot be stored in"):
        OutcomeStore(tmp_path / place, Outcome).check()
    OutcomeStore(tmp_path / "new", Outcome).check()
    assert list((tmp_path / "new").iterdir()) == []


def test_equal_arrays_are_kept_and_held_once(tmp_path: Path) -> None:
    """Channels of a tower share times and places: half of all that a campaign keeps."""
    store, place = OutcomeStore(tmp_path, Outcome), np.arange(3000.0).reshape(-1, 3)
    row = rss_row("f", "USRP1", [0.0], [1.0], heading_deg=place, position_m=place.copy())
    store.save("a", Outcome(rss=(row,)))
    assert (tmp_path / "a.npz").stat().st_size < 1.5 * place.nbytes
    (loaded,) = store.load("a").rss
    assert loaded.heading_deg is loaded.position_m


def key_of(settings: FlightFile, flight: Path) -> str:
    return task_key(settings, task_inputs(settings, flight, None))


def test_every_record_of_a_real_outcome_can_be_kept(flight: Path, tmp_path: Path) -> None:
    """One task of the sample flight, through the store and back: the same numbers, the same nested records."""
    changes = {"rss.lag": "off", "rss.advanced.lag_window_s": 10}
    task = Task(flight, "f", "as written", changes, None)
    (first,) = run_tasks([task], InProcess(), keep=tmp_path)
    assert first.failure is None
    key = digest_of(task)
    again = OutcomeStore(tmp_path, Outcome).load(key)
    assert repr(again.rank) == repr(first.rank)
    assert [row.rmse_db for row in again.rss] == [row.rmse_db for row in first.rss]
    assert np.array_equal(again.rss[0].measured_db, first.rss[0].measured_db, equal_nan=True)
    assert again.seconds > 0


def test_a_key_is_of_everything_that_matters_and_of_nothing_else(flight: Path) -> None:
    settings = load_flight(flight)
    key = key_of(settings, flight)
    assert key == key_of(load_flight(flight), flight)
    assert key != key_of(overridden(settings, {"rt.max_depth": 1}), flight)
    assert key != key_of(overridden(settings, {"rss.advanced.lag_window_s": 7}), flight)
    for aside in ({"flight.title": "other"}, {"rt.audit_links": 3}):
        assert key == key_of(overridden(settings, aside), flight), aside
    log = flight.parent / settings.logs[0].path
    before = log.read_bytes()
    try:
        log.write_bytes(before + b"\n")
        assert key != key_of(settings, flight)
    finally:
        log.write_bytes(before)
    assert key == key_of(settings, flight)


def tasks_of(flight: Path, count: int = 4) -> list[Task]:
    return [Task(flight, f"f{i}", "as written", {"rss.advanced.lag_window_s": 10.0 + i}, None) for i in range(count)]


def test_what_is_kept_is_not_computed_again(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def compute_but_f3(task: Task) -> Outcome:
        asked.append(task.flight)
        if task.flight == "f3" and len(asked) < 6:
            return Outcome(failure=Failure(flight="f3", setting="as written", message="no luck", traceback="line 1"))
        return outcome_of(float(task.flight[1:]))

    monkeypatch.setattr(campaign, "run_task", compute_but_f3)
    tasks = tasks_of(flight)
    first = run_tasks(tasks, InProcess(), keep=tmp_path)
    assert asked == ["f0", "f1", "f2", "f3"]
    assert first[3].failure is not None
    (stage,) = planned_tasks(tasks, dict(enumerate(first[:3])), 1)
    assert stage.seconds == pytest.approx(np.mean([outcome.seconds for outcome in first[:3]]))
    again = run_tasks(tasks, InProcess(), keep=tmp_path)
    assert asked[4:] == ["f3"], "only the failure is tried again"
    assert all(equal(a, b) for a, b in zip(first[:3], again[:3], strict=True))
    run_tasks(tasks, InProcess(), keep=tmp_path)
    assert len(asked) == 6
    run_tasks(tasks, InProcess())
    assert len(asked) == 10, "nothing is kept unless asked for"


def test_a_new_name_or_place_in_the_list_computes_nothing(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A setting put before the first, a label that is another: the outcomes are those that were kept, renamed."""
    asked: list[str] = []
    monkeypatch.setattr(campaign, "run_task", lambda task: asked.append(task.setting) or outcome_of(1.0))
    run_tasks([Task(flight, "f", "a", {}, None, True)], InProcess(), keep=tmp_path)
    first = Task(flight, "g", "first", {"rss.advanced.lag_window_s": 3}, None, True)
    outcomes = run_tasks([first, Task(flight, "g", "b", {}, None, False)], InProcess(), keep=tmp_path)
    assert asked == ["a", "first"]
    assert [row.flight for outcome in outcomes for row in outcome.rss] == ["g", "g"]


def test_a_worker_that_sees_other_files_fails_the_task(flight: Path) -> None:
    task = Task(flight, "f", "a", {}, None)
    outcome = carry_out(dataclasses.replace(task, key="0" * 64))
    assert outcome.failure is not None
    assert "sees other inputs" in outcome.failure.message


def test_a_log_that_changes_is_read_again_by_a_worker_that_lives_on(flight: Path, tmp_path: Path) -> None:
    """A worker of a cluster serves several campaigns.

    Its cache of logs depends on their content, not on their names.
    """
    for name in flight.parent.iterdir():
        shutil.copy(name, tmp_path) if name.is_file() else shutil.copytree(name, tmp_path / name.name)
    task = Task(tmp_path / flight.name, "f", "a", {}, None)
    before = campaign.flight_data(task)
    log = tmp_path / before.settings.logs[-1].path
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join(lines[: len(lines) // 2]))
    after = campaign.flight_data(task)
    assert len(after.files[-1].result.streams[0].frame) < len(before.files[-1].result.streams[0].frame)


KILLED = """
import os, signal, sys
from pathlib import Path
from aerpaw_cmp.jobs import campaign as campaign_tasks
from aerpaw_cmp.jobs.campaign import compute, kept_outcomes
from aerpaw_cmp.jobs.workers import InProcess
from tests.jobs.campaign_rows import rss_row

def compute_but_f2(task):
    if task.flight == "f2":
        os.kill(os.getpid(), signal.SIGKILL)
    return campaign_tasks.Outcome(rss=(rss_row(task.flight, "USRP1", [float(task.flight[1:])] * 3, [0.0] * 3),))

campaign_tasks.run_task = compute_but_f2
flight = Path(sys.argv[1])
tasks = [campaign_tasks.Task(flight, f"f{i}", "as written", {"rss.advanced.lag_window_s": 10.0 + i}, None) for i in range(4)]
store = campaign_tasks.OutcomeStore(Path(sys.argv[2]), campaign_tasks.Outcome)
outcomes, orders = kept_outcomes(tasks, store, print)
compute(orders, InProcess(), outcomes, store, print)
"""


def test_after_sigkill_only_what_is_missing_is_computed(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = subprocess.run([sys.executable, "-c", KILLED, str(flight), str(tmp_path)], check=False)
    assert done.returncode == -signal.SIGKILL
    asked: list[str] = []
    monkeypatch.setattr(
        campaign, "run_task", lambda task: asked.append(task.flight) or outcome_of(float(task.flight[1:]))
    )
    outcomes = run_tasks(tasks_of(flight), InProcess(), keep=tmp_path)
    assert asked == ["f2", "f3"]
    assert all(equal(outcome, outcome_of(float(i))) for i, outcome in enumerate(outcomes))


def test_a_lost_worker_costs_its_own_task_alone(flight: Path) -> None:
    class Loses(InProcess):
        def run(self, function: Any, items: Sequence[Any], on_result: Any) -> None:  # noqa: ARG002
            lost = Lost("its worker process ended")
            super().run(lambda task: lost if task.flight == "f1" else outcome_of(0.0), items, on_result)

    told = [outcome.failure and outcome.failure.message for outcome in run_tasks(tasks_of(flight, 3), Loses())]
    assert told == [None, "its worker process ended", None]


def test_a_fault_in_the_rows_of_a_flight_is_a_failure_of_that_flight(
    flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error outside the replay ended the complete campaign, because only the replay converted errors to messages."""
    nothing = SimpleNamespace(data=None, result=None)
    monkeypatch.setattr(campaign, "run_flight", lambda *_, **__: nothing)
    outcome = campaign.run_task(Task(flight, "f", "as written", {}, None))
    assert outcome.failure is not None
    assert "a fault of the program itself" in outcome.failure.message

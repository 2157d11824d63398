"""Status of a campaign, what is kept and what is to do; tasks handed to workers, outcomes gathered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...common.counting import counted
from ...common.errors import AerpawCmpError
from ...common.jsonable import named
from ...common.stages import Progress
from ...report.content.campaign import Failure
from ..tasks.outcomes import OutcomeStore
from ..tasks.workers import Lost, Workers
from .campaign_tasks import Done, Order, Outcome, Task, carry_out, digest_of, fitted_to


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskState:
    """One task of a campaign before it runs.

    ``seconds`` is what it cost, where it is stored; ``trouble`` says which input cannot be read.
    """

    task: Task
    stored: bool = False
    seconds: float | None = None
    trouble: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignStatus:
    """Answer of ``campaign --dry-run``.

    ``estimate_s`` is the time of what is to do with ``workers`` tasks side by side: for every task the mean cost of
    the kept tasks of its setting, else of all; None where nothing was measured yet.
    """

    name: str
    keep: str
    states: tuple[TaskState, ...]
    failures: tuple[Failure, ...]
    estimate_s: float | None
    workers: int

    @property
    def kept(self) -> int:
        """Tasks whose outcome is kept."""
        return sum(state.stored for state in self.states)

    @property
    def to_do(self) -> int:
        """Tasks that a run would compute."""
        return len(self.states) - self.kept

    def metrics(self) -> dict[str, Any]:
        """For ``--json``."""
        waiting = [state for state in self.states if not state.stored]
        return {
            "campaign": self.name,
            "tasks": len(self.states),
            **named(self, "keep kept to_do estimate_s workers"),
            "to_do_tasks": [{**named(s.task, "flight setting"), "trouble": s.trouble or None} for s in waiting],
            "failures": [named(failure, "flight setting message") for failure in self.failures],
        }


def campaign_status(
    name: str, tasks: Sequence[Task], failures: Sequence[Failure], store: OutcomeStore | None, *, workers: int = 1
) -> CampaignStatus:
    """Status of a campaign: what is kept, what is to do and how long that may take; nothing is computed.

    Parameters
    ----------
    name : str
        Of the campaign.
    tasks : sequence of Task
    failures : sequence of Failure
        Flights whose files cannot be read.
    store : OutcomeStore, optional
        None where nothing is kept.
    workers : int
        Tasks side by side, for the time.

    Returns
    -------
    CampaignStatus
        A state per task, and the time that what is left may take [s].
    """
    states = [TaskState(task=task) if store is None else _state(task, store) for task in tasks]
    by_setting: dict[str, list[float]] = {}
    for state in states:
        if state.seconds is not None:
            by_setting.setdefault(state.task.setting, []).append(state.seconds)
    everything = [seconds for some in by_setting.values() for seconds in some]
    estimate = None
    if everything:
        costs = [float(np.mean(by_setting.get(s.task.setting, everything))) for s in states if not s.stored]
        estimate = max(sum(costs) / max(workers, 1), max(costs, default=0.0))
    return CampaignStatus(
        name=name,
        keep="no place (--fresh)" if store is None else str(store.folder),
        states=tuple(states),
        failures=tuple(failures),
        estimate_s=estimate,
        workers=workers,
    )


def _state(task: Task, store: OutcomeStore) -> TaskState:
    """Outcome and cost of a task, by what the store says of itself."""
    try:
        key = digest_of(task)
    except (AerpawCmpError, OSError) as error:
        return TaskState(task=task, trouble=str(error))
    return TaskState(task=task, stored=store.has(key), seconds=store.seconds(key))


def kept_outcomes(
    tasks: Sequence[Task], store: OutcomeStore | None, progress: Progress
) -> tuple[dict[int, Outcome], dict[int, Order]]:
    """Outcomes that are there, and what is to be computed, by number."""
    outcomes: dict[int, Outcome] = {}
    orders = {number: Order(task=task) for number, task in enumerate(tasks)}
    if store is None:
        return outcomes, orders
    for number, task in enumerate(tasks):
        with suppress(AerpawCmpError, OSError):  # such a task will say itself what is wrong
            key = digest_of(task)
            orders[number] = Order(task=task, key=key)
            if isinstance(outcome := store.load(key), Outcome):
                outcomes[number] = fitted_to(task, outcome)
                del orders[number]
    for text in store.warnings:
        progress(text)
    if len(outcomes):
        progress(f"{len(outcomes)} of {counted(len(tasks), 'outcome')} kept from before in {store.folder}")
    return outcomes, orders


def compute(
    orders: Mapping[int, Order],
    workers: Workers,
    outcomes: dict[int, Outcome],
    store: OutcomeStore | None,
    progress: Progress,
) -> None:
    """Let the workers do what is to do; each outcome is put into ``outcomes`` and kept as soon as it comes.

    Parameters
    ----------
    orders : mapping of int to Order
        What is to do, by the number of its task.
    workers : Workers
    outcomes : dict of int to Outcome
        Gets the new ones.
    store : OutcomeStore, optional
        Keeps the new ones.
    progress : Progress
        Tasks done.
    """
    numbers, total, failed = list(orders), len(outcomes) + len(orders), 0

    def take(place: int, result: Done | Lost) -> None:
        nonlocal failed
        order = orders[numbers[place]]
        if isinstance(result, Lost):
            task = order.task
            lost = Failure(flight=task.flight, setting=task.setting, message=result.message)
            result = Done(outcome=Outcome(failure=lost))
        failure = result.outcome.failure
        if store is not None and order.key is not None and failure is None:
            store.save(order.key, result.outcome, result.seconds)
        outcomes[numbers[place]] = fitted_to(order.task, result.outcome)
        failed += failure is not None
        progress(f"flights\t{len(outcomes)} of {total} done, {failed} failed", len(outcomes) / total)

    if orders:
        workers.run(carry_out, [orders[number] for number in numbers], take)

"""Tasks of a campaign: what is kept and what is to do, handed to workers, outcomes gathered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress

from ...common.counting import counted
from ...common.errors import AerpawCmpError
from ...common.stages import PlannedStage, Progress
from ..tasks.outcomes import OutcomeStore
from ..tasks.workers import Lost, Workers
from .campaign_tasks import Order, Outcome, Task, carry_out, digest_of, failed_task, fitted_to


def planned_tasks(tasks: Sequence[Task], kept: Mapping[int, Outcome], workers: int) -> list[PlannedStage]:
    """Tasks of each setting, for a dry run; ``kept`` outcomes stand by the numbers of their tasks.

    A task to do takes as long as the kept ones of its setting took on average, else as all of them; unknown where
    none is kept. ``workers`` do so many side by side.
    """
    spent: dict[str, list[float]] = {}
    for number, outcome in kept.items():
        spent.setdefault(tasks[number].setting, []).append(outcome.seconds)
    every = [seconds for some in spent.values() for seconds in some]
    stages = []
    for setting in dict.fromkeys(task.setting for task in tasks):
        numbers = [number for number, task in enumerate(tasks) if task.setting == setting]
        left, known = len({*numbers} - {*kept}), spent.get(setting, every)
        seconds = left * sum(known) / len(known) / workers if known else None
        work = f"{counted(len(numbers), 'task')}, {len(numbers) - left} kept"
        stages.append(PlannedStage(f"flights, {setting}", work, seconds if left else 0.0))
    return stages


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

    def take(place: int, result: Outcome | Lost) -> None:
        nonlocal failed
        order = orders[numbers[place]]
        if isinstance(result, Lost):
            result = failed_task(order.task, result.message)
        if store is not None and order.key is not None and result.failure is None:
            store.save(order.key, result)
        outcomes[numbers[place]] = fitted_to(order.task, result)
        failed += result.failure is not None
        progress(f"flights\t{len(outcomes)} of {total} done, {failed} failed", len(outcomes) / total)

    if orders:
        workers.run(carry_out, [orders[number] for number in numbers], take)

"""One flight under one setting: what a worker is given, does and gives back, what is kept and what is to do."""

from __future__ import annotations

import dataclasses
import platform
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ...common.counting import counted
from ...common.errors import AerpawCmpError
from ...common.jsonable import named
from ...common.stages import PlannedStage, Progress
from ...common.versions import versions
from ...compare import offset
from ...compare.result import FlightResult, RankResult, RssResult
from ...flight.data import FlightData, RankSeries, RssSeries, gather, read_logs
from ...flight.gains.memory import with_learned
from ...flight.marks import among
from ...flight.overrides import Overrides, overridden
from ...flight.settings import FlightFile, RssSettings, load_flight
from ...flight.training import logs_of, series_mark
from ...report.campaign import Failure, RankRow, RssRow
from ..reporting.flight_run import run_flight
from ..tasks.manifest import stamp
from ..tasks.outcomes import OutcomeStore, task_inputs, task_key
from ..tasks.workers import Lost, Workers


@dataclass(frozen=True, slots=True)
class Task:
    """One flight file under one setting."""

    path: Path
    flight: str
    setting: str
    overrides: Overrides
    logs_root: Path | None
    reference: bool = True
    """Pairs of flights and the season are of this setting: places are kept."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Rows of one task, or why there are none, and what it cost [s]."""

    rss: tuple[RssRow, ...] = ()
    rank: tuple[RankRow, ...] = ()
    failure: Failure | None = None
    seconds: float = 0.0


def counted_once(tasks: Sequence[Task], outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Outcomes in the order of their tasks; a flight that holds the log of an earlier one is a failure that says so.

    A log that comes twice, renamed, copied or packed, would be pooled twice and predicted from itself.
    """
    home: dict[str, str] = {}
    marked: dict[str, str] = {}
    counted = []
    for task, outcome in zip(tasks, outcomes, strict=True):
        rows: list[RssRow | RankRow] = [*outcome.rss, *outcome.rank]
        again = sorted({log for row in rows for log in row.logs if home.setdefault(log, task.flight) != task.flight})
        message = f"the same log as {home[again[0]]} (SHA-256 {again[0][:12]}...)" if again else ""
        marks = {row.mark for row in rows if row.mark}
        others = [mark for mark, name in marked.items() if name != task.flight and not message]
        if copied := next((mark for mark in others if any(among(own, [mark]) for own in marks)), ""):
            message = f"readings of {marked[copied]} in another log"
        if message:
            outcome = failed_task(task, f"it holds {message}: it is counted once")
        else:
            marked |= dict.fromkeys(marks, task.flight)
        counted.append(outcome)
    return counted


@lru_cache(maxsize=512)
def _flight_file(path: Path, _size: int, _mtime_ns: int) -> FlightFile:
    return load_flight(path)


def _settings(task: Task) -> FlightFile:
    """Return the settings of a task; the learned antennas that they name must fit its overrides."""
    written = overridden(_flight_file(task.path, *stamp(task.path)), task.overrides)
    return with_learned(written, task.path.parent)


@lru_cache(maxsize=2)
def _logs(key: _Logs) -> Any:
    """The logs of a flight: settings after settings reads them once."""
    return read_logs(key.settings, key.folder, key.logs_root)


@dataclass(frozen=True, slots=True)
class _Logs:
    """Inputs on which the reading of logs depends; settings that do not matter to it do not count in comparisons."""

    folder: Path
    logs_root: Path | None
    text: str
    stamps: tuple[tuple[int, int], ...]
    settings: FlightFile = field(compare=False)


def flight_data(task: Task) -> FlightData:
    """Read and gather the flight of a task; errors as in :mod:`aerpaw_cmp.flight.data`."""
    settings = _settings(task)
    folder, root = task.path.parent, task.logs_root
    text = "\n".join([str(settings.timezone), *(log.model_dump_json() for log in settings.logs)])
    stamps = tuple(stamp((root or folder) / log.path) for log in settings.logs)
    return gather(settings, folder, _logs(_Logs(folder, root, text, stamps, settings)), root)


def run_task(task: Task) -> Outcome:
    """Replay and compare one flight under one setting; whatever goes wrong becomes a message."""
    try:
        flight_run = run_flight(flight_data(task), audit=False)
        return _rows_of(task, flight_run.data, flight_run.result)
    except AerpawCmpError as error:
        return failed_task(task, str(error), error)
    except Exception as error:  # one flight's fault must not cost the others their numbers
        return failed_task(task, f"a fault of the program itself: {type(error).__name__}: {error}", error)


def _rows_of(task: Task, data: FlightData, result: FlightResult) -> Outcome:
    """Outcome of a flight that was compared."""
    return Outcome(
        rss=tuple(
            _rss_row(task, data.settings.rss, compared, _identity(data, series))
            for compared, series in zip(result.rss, data.rss, strict=True)
        ),
        rank=tuple(
            row
            for compared, series in zip(result.rank, data.rank, strict=True)
            for row in _rank_rows(task, compared, _identity(data, series))
        ),
    )


def failed_task(task: Task, message: str, error: BaseException | None = None) -> Outcome:
    """The outcome of a task without numbers; the traceback of an error goes into a file of its own."""
    text = "" if error is None else "".join(traceback.format_exception(error))
    return Outcome(failure=Failure(flight=task.flight, setting=task.setting, message=message, traceback=text))


# --- as a worker does it --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """Order to a worker: paths and the digest of what the outcome depends on, as the first process sees it.

    ``key`` is None where an input cannot be read, or nothing is kept.
    """

    task: Task
    key: str | None = None


def carry_out(order: Order) -> Outcome:
    """Run a task; what runs in worker processes of every kind.

    The key is computed anew here: a worker that sees another file or runs other code fails the task instead of
    giving a wrong number under a right name.
    """
    task = order.task
    try:
        same = order.key is None or digest_of(task) == order.key
    except (AerpawCmpError, OSError) as error:
        return failed_task(task, f"an input can no longer be read: {error}", error)
    if not same:
        return failed_task(
            task,
            f"the worker on {platform.node()} sees other inputs, or runs another version of the program, than the "
            f"process that planned the campaign (aerpaw-cmp {versions()['aerpaw-cmp']} there); expected the same "
            "everywhere",
        )
    start = time.perf_counter()
    outcome = run_task(task)
    return dataclasses.replace(outcome, seconds=time.perf_counter() - start)


def digest_of(task: Task) -> str:
    """Digest of the settings and inputs on which the outcome of a task depends.

    Raises
    ------
    AerpawCmpError, OSError
        If an input cannot be read.
    """
    settings = _settings(task)
    return task_key(settings, task_inputs(settings, task.path, task.logs_root))


def fitted_to(task: Task, outcome: Outcome) -> Outcome:
    """An outcome under the names of this campaign; series of samples stay for the first setting alone.

    Of the others a row holds numbers: the memory of 4000 tasks is that of the flights.
    """

    def row(kept_row: RssRow) -> RssRow:
        named = dataclasses.replace(kept_row, flight=task.flight, setting=task.setting)
        if task.reference:
            return named
        none = np.zeros(0)
        return dataclasses.replace(
            named,
            difference=kept_row.moments,
            measured_db=none,
            simulated_dbm=none,
            position_m=np.zeros((0, 3)),
            heading_deg=None,
        )

    failure = outcome.failure and dataclasses.replace(outcome.failure, flight=task.flight, setting=task.setting)
    return dataclasses.replace(
        outcome,
        rss=tuple(map(row, outcome.rss)),
        rank=tuple(dataclasses.replace(item, flight=task.flight, setting=task.setting) for item in outcome.rank),
        failure=failure,
    )


# --- rows -----------------------------------------------------------------------------------------------------------


def _identity(data: FlightData, series: RssSeries | RankSeries) -> dict[str, Any]:
    """Fields of a row that say which log it is of, whatever the log is called or packed in."""
    return {"logs": logs_of(data, series), "mark": series_mark(series)}


def _rss_row(task: Task, rules: RssSettings, result: RssResult, identity: Mapping[str, Any]) -> RssRow:
    score, clock = result.score, result.further.clock
    # nothing is pooled or ranked from the flight that its antennas were learned from
    measured_db = np.full_like(result.measured_db, np.nan) if result.further.trained_on else result.measured_db
    return RssRow(
        flight=task.flight,
        setting=task.setting,
        **named(result, "tower channel unit simulated_dbm position_m"),
        **named(score, "offset_db rmse_db correlation n n_out_of_coverage rmse_ci95_db lag_s"),
        at_search_edge=score.at_edge,
        offset_ci95_db=score.intervals.offset_db,
        correlation_ci95=score.intervals.correlation,
        n_effective=score.intervals.autocorrelation.n_effective,
        lag_verdict="" if clock is None else clock.verdict,
        fitted=score.fitted_on_scored,
        baselines={name: model.rmse_db for name, model in result.baselines.items()},
        verdicts={
            name: result.further.compared_with[name].verdict
            for name in result.baselines
            if name in result.further.compared_with
        },
        span_db=rules.span_db,
        measured_db=measured_db,
        start_ns=int(result.time[0].astype("datetime64[ns]").astype(np.int64)) if len(result.time) else 0,
        heading_deg=result.geometry.get("heading_deg"),
        difference=offset.difference_moments(measured_db, result.simulated_dbm),
        **identity,
    )


def _rank_rows(task: Task, result: RankResult, identity: Mapping[str, Any]) -> list[RankRow]:
    score = result.score
    return [
        RankRow(
            flight=task.flight,
            setting=task.setting,
            tower=result.tower,
            **named(score, "n best_k"),
            best_k_ci95=score.curve.best_k_interval,
            k=k,
            n_out_of_coverage=fit.out_of_coverage,
            **named(fit, "agreement agreement_ci95 kappa total_variation total_variation_ci95 wasserstein"),
            commonest_agreement=result.further.commonest.agreement,
            **identity,
        )
        for k, fit in score.simulated.items()
    ]


# --- what is kept, what is to do -------------------------------------------------------------------------------------


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

"""The ``campaign`` job: compare many flights under many settings.

A campaign.yaml names flight files and, optionally, settings: labels with overrides of flight keys in dotted form
(``rt.max_depth: 1``). Every setting runs on every flight. A flight that cannot be read becomes a row with the error
message.

A task is one flight under one setting. Workers run tasks and return rows of numbers, which are stored. From the rows of
several flights, the job computes held-out errors, a ranking of settings, steps of offsets, and mean residuals by
position.
"""

from __future__ import annotations

import dataclasses
import platform
import time
import traceback
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

import numpy as np
import pandas as pd
from pydantic import Field

from ..common.errors import AerpawCmpError, InputError, UsageError, one_line
from ..common.grouping import lists_by_key
from ..common.stages import PlannedStage, Progress, Stages
from ..common.text import counted
from ..common.units import FloatArray, finite_mean
from ..common.versions import versions
from ..common.yamlfile import StrictModel, load_yaml
from ..compare import offset, verdict
from ..compare.result import RankResult, RssResult
from ..compare.statistics import Pass, PassPair, cell_means, pass_pairs
from ..compare.verdict import NightOffsets, NodeOffset, node_offsets, stepped
from ..flight.data import FlightData, RankSeries, RssSeries, gather, read_logs
from ..flight.gains import with_learned
from ..flight.settings import FlightFile, Overrides, load_flight, overridden
from ..flight.training import among, logs_of, series_mark
from ..logs.ingest import ingest
from ..logs.readers import ReadOptions
from ..logs.records import has_wall_clock
from ..report import campaign as page
from .flight_run import run_flight
from .options import DEFAULT, RunOptions
from .tasks import OutcomeStore, stamp, task_inputs, task_key
from .workers import Lost, Workers, open_workers


@dataclass(frozen=True, slots=True)
class Task:
    """One flight file under one setting.

    Parameters
    ----------
    reference : bool
        True for the setting whose flights are compared with each other. The positions of these flights are stored.
    key : str, optional
        Digest of the inputs as read by the process that plans the tasks. None if an input cannot be read or there is no
        store.
    """

    path: Path
    flight: str
    setting: str
    overrides: Overrides
    logs_root: Path | None
    reference: bool = True
    key: str | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """The rows of one task or its failure, and its computing time [s]."""

    rss: tuple[page.RssRow, ...] = ()
    rank: tuple[page.RankRow, ...] = ()
    failure: page.Failure | None = None
    seconds: float = 0.0


def counted_once(tasks: Sequence[Task], outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return outcomes in the order of their tasks, with a failure for each flight that repeats an earlier log.

    A log that occurs twice, even renamed, copied or packed, would be pooled twice and predicted from itself.
    """
    home: dict[str, str] = {}
    marked: dict[str, str] = {}
    counted = []
    for task, outcome in zip(tasks, outcomes, strict=True):
        rows: list[page.RssRow | page.RankRow] = [*outcome.rss, *outcome.rank]
        again = sorted({log for row in rows for log in row.logs if home.setdefault(log, task.flight) != task.flight})
        message = f"the same log as {home[again[0]]} (SHA-256 {again[0][:12]}...)" if again else ""
        marks = {row.mark for row in rows if row.mark}
        others = [mark for mark, name in marked.items() if name != task.flight and not message]
        if copied := next((mark for mark in others if any(among(own, [mark]) for own in marks)), ""):
            message = f"readings of {marked[copied]} in another log"
        if message:
            outcome = failed_task(task, f"it contains {message}, which is counted once")
        else:
            marked |= dict.fromkeys(marks, task.flight)
        counted.append(outcome)
    return counted


@lru_cache(maxsize=512)
def _flight_file(path: Path, _size: int, _mtime_ns: int) -> FlightFile:
    return load_flight(path)


def _settings(task: Task) -> FlightFile:
    """Return the settings of a task. Raise UsageError if the learned antennas do not fit the overrides."""
    written = overridden(_flight_file(task.path, *stamp(task.path)), task.overrides)
    return with_learned(written, task.path.parent)


@lru_cache(maxsize=2)
def _logs(key: _Logs) -> Any:
    """Return the logs of a flight. They are read once for all settings."""
    return read_logs(key.settings, key.folder, key.logs_root)


@dataclass(frozen=True, slots=True)
class _Logs:
    """The cache key of the logs of a flight.

    Two keys are equal if all settings that affect how logs are read are equal.
    """

    folder: Path
    logs_root: Path | None
    text: str
    stamps: tuple[tuple[int, int], ...]
    settings: FlightFile = field(compare=False)


def flight_data(task: Task) -> FlightData:
    """Read the flight of a task, with the errors of :mod:`aerpaw_cmp.flight.data`."""
    settings = _settings(task)
    folder, root = task.path.parent, task.logs_root
    text = "\n".join([str(settings.timezone), *(log.model_dump_json() for log in settings.logs)])
    stamps = tuple(stamp((root or folder) / log.path) for log in settings.logs)
    return gather(settings, folder, _logs(_Logs(folder, root, text, stamps, settings)), root)


def run_task(task: Task) -> Outcome:
    """Replay and compare one flight under one setting. Every exception becomes a message of the outcome."""
    try:
        data = flight_data(task)
        result = run_flight(data, audit=False).result
        rss = zip(result.rss, data.rss, strict=True)
        rank = zip(result.rank, data.rank, strict=True)
        return Outcome(
            rss=tuple(_rss_row(task, data, compared, series) for compared, series in rss),
            rank=tuple(row for compared, series in rank for row in _rank_rows(task, data, compared, series)),
        )
    except AerpawCmpError as error:
        return failed_task(task, str(error), error)
    except Exception as error:  # an error in one flight must not end the other tasks
        return failed_task(task, f"a fault of the program itself: {type(error).__name__}: {error}", error)


def failed_task(task: Task, message: str, error: BaseException | None = None) -> Outcome:
    """Return the outcome of a failed task: the message, and the traceback for a separate file."""
    text = "" if error is None else "".join(traceback.format_exception(error))
    return Outcome(failure=page.Failure(flight=task.flight, setting=task.setting, message=message, traceback=text))


# --- tasks of a worker --------------------------------------------------------------------------------------------


def carry_out(task: Task) -> Outcome:
    """Run a task. This function runs in worker processes of every kind.

    The key is computed again here, so that a worker with other files or other code fails the task instead of returning
    a wrong number.
    """
    try:
        same = task.key is None or digest_of(task) == task.key
    except (AerpawCmpError, OSError) as error:
        return failed_task(task, f"an input can no longer be read: {error}", error)
    if not same:
        return failed_task(
            task,
            f"the worker on {platform.node()} sees other inputs or runs another version of the program than the "
            f"process that planned the campaign (aerpaw-cmp {versions()['aerpaw-cmp']} there); expected the same "
            "inputs and version everywhere",
        )
    start = time.perf_counter()
    outcome = run_task(task)
    return dataclasses.replace(outcome, seconds=time.perf_counter() - start)


def digest_of(task: Task) -> str:
    """Return the digest of the settings and inputs on which the outcome of a task depends.

    Raises
    ------
    AerpawCmpError, OSError
        If an input cannot be read.
    """
    settings = _settings(task)
    return task_key(settings, task_inputs(settings, task.path, task.logs_root))


def fitted_to(task: Task, outcome: Outcome) -> Outcome:
    """Return a stored outcome with the flight and the setting of ``task``. Only the first setting keeps its samples.

    For all other settings, the rows contain only numbers, because the samples of thousands of tasks would not fit in
    memory.
    """
    names = {"flight": task.flight, "setting": task.setting}

    def row(stored: page.RssRow) -> page.RssRow:
        named = dataclasses.replace(stored, **names)  # type: ignore[arg-type]
        if task.reference:
            return named
        none, nowhere = np.zeros(0), np.zeros((0, 3))
        samples = {"measured_db": none, "simulated_dbm": none, "position_m": nowhere, "heading_deg": None}
        return dataclasses.replace(named, difference=stored.moments, **samples)  # type: ignore[arg-type]

    return dataclasses.replace(
        outcome,
        rss=tuple(map(row, outcome.rss)),
        rank=tuple(dataclasses.replace(item, **names) for item in outcome.rank),  # type: ignore[arg-type]
        failure=outcome.failure and dataclasses.replace(outcome.failure, **names),
    )


# --- rows -----------------------------------------------------------------------------------------------------------


def _rss_row(task: Task, data: FlightData, result: RssResult, series: RssSeries) -> page.RssRow:
    """Return the row of a channel. The log is identified by content, regardless of file name and packing."""
    score, clock = result.score, result.further.clock
    # exclude a flight from pooling and ranking if its antennas were learned from its own log
    measured_db = np.full_like(result.measured_db, np.nan) if result.further.trained_on else result.measured_db
    return page.RssRow(
        flight=task.flight,
        setting=task.setting,
        tower=result.tower, channel=result.channel, unit=result.unit, simulated_dbm=result.simulated_dbm,
        position_m=result.position_m,
        offset_db=score.offset_db, rmse_db=score.rmse_db, correlation=score.correlation, n=score.n,
        n_out_of_coverage=score.n_out_of_coverage, rmse_ci95_db=score.rmse_ci95_db, lag_s=score.lag_s,
        at_search_edge=score.at_edge,
        offset_ci95_db=score.intervals.offset_db,
        correlation_ci95=score.intervals.correlation,
        n_effective=score.intervals.n_effective,
        lag_verdict="" if clock is None else clock.verdict,
        fitted=score.fitted_on_scored,
        baselines={name: model.rmse_db for name, model in result.baselines.items()},
        verdicts={
            name: result.further.compared_with[name].verdict
            for name in result.baselines
            if name in result.further.compared_with
        },
        span_db=data.settings.rss.span_db,
        measured_db=measured_db,
        start_ns=int(result.time[0].astype("datetime64[ns]").astype(np.int64)) if len(result.time) else 0,
        heading_deg=result.geometry.get("heading_deg"),
        difference=offset.difference_moments(measured_db, result.simulated_dbm),
        logs=logs_of(data, series), mark=series_mark(series),
    )  # fmt: skip


def _rank_rows(task: Task, data: FlightData, result: RankResult, series: RankSeries) -> list[page.RankRow]:
    """Return a row for each K of a tower."""
    score = result.score
    return [
        page.RankRow(
            flight=task.flight,
            setting=task.setting,
            tower=result.tower,
            n=score.n, best_k=score.curve.best_k,
            best_k_ci95=score.curve.best_k_ci95,
            k=k,
            n_out_of_coverage=fit.out_of_coverage,
            agreement=fit.agreement, agreement_ci95=fit.agreement_ci95, kappa=fit.kappa,
            total_variation=fit.total_variation, total_variation_ci95=fit.total_variation_ci95,
            wasserstein=fit.wasserstein,
            commonest_agreement=result.further.commonest.agreement,
            logs=logs_of(data, series), mark=series_mark(series),
        )
        for k, fit in score.simulated.items()
    ]  # fmt: skip


# --- stored outcomes and remaining tasks ------------------------------------------------------------------------------


def planned_tasks(tasks: Sequence[Task], kept: Mapping[int, Outcome], workers: int) -> list[PlannedStage]:
    """Return the tasks of each setting for a dry run. ``kept`` has the stored outcomes by task number.

    The time of a task is the mean time of the stored tasks of its setting, divided by ``workers``. If its setting has
    no stored task, the mean is taken over all stored tasks. If there is no stored task, the time is unknown.
    """
    spent = lists_by_key((tasks[number].setting, outcome.seconds) for number, outcome in kept.items())
    every = [seconds for some in spent.values() for seconds in some]
    stages = []
    for setting in dict.fromkeys(task.setting for task in tasks):
        numbers = [number for number, task in enumerate(tasks) if task.setting == setting]
        left, known = len({*numbers} - {*kept}), spent.get(setting, every)
        seconds = left * sum(known) / len(known) / workers if known else None
        work = f"{counted(len(numbers), 'task')}, {len(numbers) - left} stored"
        stages.append(PlannedStage(f"flights, {setting}", work, seconds if left else 0.0))
    return stages


def kept_outcomes(
    tasks: Sequence[Task], store: OutcomeStore | None, progress: Progress
) -> tuple[dict[int, Outcome], dict[int, Task]]:
    """Return the stored outcomes and the remaining tasks with their keys, both by task number."""
    outcomes: dict[int, Outcome] = {}
    left = dict(enumerate(tasks))
    if store is None:
        return outcomes, left
    for number, task in enumerate(tasks):
        with suppress(AerpawCmpError, OSError):  # the task itself will report the error
            key = digest_of(task)
            left[number] = dataclasses.replace(task, key=key)
            if isinstance(outcome := store.load(key), Outcome):
                outcomes[number] = fitted_to(task, outcome)
                del left[number]
    for text in store.warnings:
        progress(text)
    if len(outcomes):
        progress(f"{len(outcomes)} of {counted(len(tasks), 'outcome')} stored before in {store.folder}")
    return outcomes, left


def compute(
    tasks: Mapping[int, Task],
    workers: Workers,
    outcomes: dict[int, Outcome],
    store: OutcomeStore | None,
    progress: Progress,
) -> None:
    """Let the workers run the remaining tasks. Each outcome is stored as soon as it arrives.

    Parameters
    ----------
    tasks : mapping of int to Task
        Tasks by task number.
    workers : Workers
    outcomes : dict of int to Outcome
        Receives the new outcomes.
    store : OutcomeStore, optional
        Stores the new outcomes.
    progress : Progress
        Receives the number of finished tasks.
    """
    numbers, total, failed = list(tasks), len(outcomes) + len(tasks), 0

    def take(place: int, result: Outcome | Lost) -> None:
        nonlocal failed
        task = tasks[numbers[place]]
        if isinstance(result, Lost):
            result = failed_task(task, result.message)
        if store is not None and task.key is not None and result.failure is None:
            store.save(task.key, result)
        outcomes[numbers[place]] = fitted_to(task, result)
        failed += result.failure is not None
        progress(f"flights\t{len(outcomes)} of {total} done, {failed} failed", len(outcomes) / total)

    if tasks:
        workers.run(carry_out, list(tasks.values()), take)


# Label of the setting of a campaign.yaml without ``settings``.
_AS_WRITTEN = "as written"


class CampaignFile(StrictModel):
    """The content of campaign.yaml."""

    campaign: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$")]
    title: str | None = None
    flights: list[str] = Field(default_factory=list)
    soundings: list[str] = Field(default_factory=list)
    timezone: str | None = None  # time zone of soundings whose times are local
    settings: dict[str, dict[str, Any]] = Field(default_factory=dict)


def load_campaign(path: Path) -> CampaignFile:
    """Read and check a campaign.yaml.

    Raises
    ------
    UsageError
        If the file is wrong, as for :func:`aerpaw_cmp.common.yamlfile.load_yaml`, or names neither flights nor
        soundings.
    """
    campaign = load_yaml(path, CampaignFile)
    if not campaign.flights + campaign.soundings:
        raise UsageError("no flights and no soundings", expected="flights: [FLIGHT.yaml, ...]", path=path)
    if campaign.timezone is not None and not campaign.soundings:
        raise UsageError(
            "'timezone' without 'soundings'", expected="the time zone of a flight in its own flight.yaml", path=path
        )
    return campaign


# --- the job --------------------------------------------------------------------------------------------------------


def run(
    campaign: CampaignFile,
    folder: Path,
    options: RunOptions = DEFAULT,
    *,
    keep: Path | None = None,
    stages: Stages | None = None,
) -> page.CampaignData:
    """Run all flights under all settings, and compute the numbers that need several flights.

    Parameters
    ----------
    campaign : CampaignFile
    folder : Path
        Folder to which relative paths of flight files refer.
    options : RunOptions
    keep : Path, optional
        Folder of stored outcomes. Outcomes are read from it and added to it.
    stages : Stages, optional

    Returns
    -------
    CampaignData
        Rows of every flight and setting, and repeats. ``failures`` contains the flights that failed.

    Raises
    ------
    UsageError
        If overrides are invalid, or two flights have the same name.
    """
    stages, progress, logs_root = stages or Stages(), options.progress, options.logs_root
    if options.scheduler is not None:  # workers may run in another folder
        folder, logs_root = folder.absolute(), None if logs_root is None else logs_root.absolute()
    tasks, files, failures = campaign_tasks(campaign, folder, logs_root)
    settings = campaign.settings or {_AS_WRITTEN: {}}
    store = None if keep is None else OutcomeStore(keep, Outcome)
    with stages("flights"):
        outcomes, left = kept_outcomes(tasks, store, progress)
    unread = [PlannedStage(failure.flight, one_line(failure.message)) for failure in failures]
    stages.checked(lambda: [*planned_tasks(tasks, outcomes, options.workers), *unread])
    if store is not None:
        store.check()
    inputs = _inputs_of(files, logs_root)
    with (
        open_workers(options.workers, options.scheduler if left else None, paths=inputs, progress=progress) as crew,
        stages("flights"),
    ):
        compute(left, crew, outcomes, store, progress)
    results = counted_once(tasks, [outcomes[number] for number in range(len(tasks))])
    rank = tuple(row for o in results for row in o.rank)
    failures += [o.failure for o in results if o.failure is not None]
    with stages("pool"):
        rows = [row for o in results for row in o.rss]
        repeated = repeats([r for r in rows if r.setting == next(iter(settings))])
    good = [t for t, o in zip(tasks, results, strict=True) if o.failure is None]
    return page.CampaignData(
        name=campaign.campaign,
        title=campaign.title or campaign.campaign,
        flights=tuple(dict.fromkeys([*files, *(f.flight for f in failures)])),
        settings=settings,
        rss=tuple(rows),
        rank=rank,
        rank_transfers=tuple(transfer_ranks(rank)),
        failures=tuple(failures),
        repeats=tuple(repeated),
        site=flight_data(good[0]).site if good else None,
        synthetic=tuple(name for name, (_, f) in files.items() if f.flight.synthetic),
        workers=options.workers,
    )


def campaign_tasks(
    campaign: CampaignFile, folder: Path, logs_root: Path | None = None
) -> tuple[list[Task], dict[str, tuple[Path, FlightFile]], list[page.Failure]]:
    """Return one task per setting and flight, the flight files by name, and the files that cannot be read.

    Raises
    ------
    UsageError
        If overrides are invalid, or two flights have the same name.
    """
    settings = campaign.settings or {_AS_WRITTEN: {}}
    files, failures = _flight_files(campaign, folder, settings)
    tasks = [
        Task(path, name, label, overrides, logs_root, reference=label == next(iter(settings)))
        for name, (path, _) in files.items()
        for label, overrides in settings.items()
    ]
    return tasks, files, failures


def _inputs_of(files: Mapping[str, tuple[Path, FlightFile]], logs_root: Path | None) -> list[Path]:
    """Return the existing flight files and logs. A missing file becomes a row of the result."""
    paths = [path for path, _ in files.values()]
    paths += [(logs_root or path.parent) / log.path for path, flight in files.values() for log in flight.logs]
    return [path for path in paths if path.exists()]


def _flight_files(
    campaign: CampaignFile, folder: Path, settings: Mapping[str, Overrides]
) -> tuple[dict[str, tuple[Path, FlightFile]], list[page.Failure]]:
    """Return the readable flight files by name, with all overrides checked, and the failures of other files."""
    files: dict[str, tuple[Path, FlightFile]] = {}
    failures = []
    for entry in campaign.flights:
        path = folder / entry
        try:
            flight = load_flight(path)
            with_learned(flight, path.parent)
        except (InputError, UsageError) as error:
            failures.append(page.Failure(flight=Path(entry).stem, setting="every setting", message=str(error)))
            continue
        name = flight.flight.name
        if name in files:
            raise UsageError(f"two flights are named {name!r}: {files[name][0]} and {path}", expected="one name each")
        files[name] = (path, flight)
        for label, overrides in settings.items():
            try:
                overridden(flight, overrides)
            except UsageError as error:
                raise UsageError(
                    f"settings.{label}: {error.found}", expected=error.expected, cause=error.cause
                ) from None
    return files, failures


# --- numbers of several flights: repeatability, K chosen on the other flights ----------------------------------------


def repeats(rows: Sequence[page.RssRow]) -> list[PassPair]:
    """Compare every pair of flights with a common tower and channel. ``rows`` are the rows of one setting."""
    passes = [
        Pass(
            flight=row.flight,
            position_m=row.position_m,
            residual_db=row.residual_db,
            heading_deg=row.heading_deg,
            tower=row.tower,
            channel=row.channel,
            level_db=row.measured_db,
        )
        for row in rows
    ]
    rule = {"radius_m": page.CampaignData.radius_m, "heading_within_deg": page.CampaignData.heading_within_deg}
    return pass_pairs(passes, cell_m=page.CampaignData.cell_m, **rule)


def transfer_ranks(rows: Sequence[page.RankRow]) -> list[page.RankTransfer]:
    """Choose K for each flight from the other flights with the same tower and values of K."""
    out = []
    for setting, tower in dict.fromkeys((row.setting, row.tower) for row in rows):
        by: dict[str, dict[float, page.RankRow]] = {}
        for row in rows:
            if (row.setting, row.tower) == (setting, tower) and np.isfinite(row.total_variation):
                by.setdefault(row.flight, {})[row.k] = row
        for flight, fits in by.items():
            other_flights = [at for name, at in by.items() if name != flight]
            common = [k for k in fits if other_flights and all(k in at for at in other_flights)]
            if not common:
                continue
            # use only values of K that all other flights have, because means over different flights cannot be compared
            chosen = min(common, key=lambda k: finite_mean([at[k].total_variation for at in other_flights]))
            best = min(fits, key=lambda k: fits[k].total_variation)
            out.append(
                page.RankTransfer(
                    setting=setting,
                    flight=flight,
                    tower=tower,
                    chosen_on=tuple(name for name in by if name != flight),
                    k=chosen,
                    total_variation=fits[chosen].total_variation,
                    kappa=fits[chosen].kappa,
                    own_k=best,
                    own_total_variation=fits[best].total_variation,
                )
            )
    return out


def with_season(
    data: page.CampaignData, reports: Mapping[str, str] | None = None, sounded: Sequence[NodeOffset] = ()
) -> page.CampaignData:
    """Return the campaign with held-out errors in its rows, and with the numbers that need several flights.

    Parameters
    ----------
    data : CampaignData
    reports : mapping of str to str, optional
        Address of the report of each flight, relative to the folder of the campaign.
    sounded : sequence of NodeOffset
        Node offsets from tower-to-tower soundings (:func:`soundings`). They replace the offsets of the flights.
    """
    rows = _held_out_rows(data.rss)
    season = page.CampaignSummary(reports=dict(reports or {}), nodes=tuple(sounded))
    if not rows:
        return dataclasses.replace(data, season=season)
    data = dataclasses.replace(data, rss=tuple(rows))
    started = _started_of(rows)
    order = sorted(data.flights, key=lambda name: (name not in started, started.get(name, 0)))
    season = dataclasses.replace(
        season,
        held_out=any(np.isfinite(row.held_out_rmse_db) for row in rows),
        started={name: _iso(ns) for name, ns in started.items()},
        ranking=tuple(rank_settings(rows, list(data.settings), order)),
        nodes=season.nodes or _flown(data.reference_rows, order, started),
        places_db=_places_db(data.reference_rows, data.cell_m),
    )
    return dataclasses.replace(data, season=season)


def _started_of(rows: Iterable[page.RssRow]) -> dict[str, int]:
    """Return the start of each flight [ns after 1970-01-01]. A flight that has only relative times has no start."""
    starts: dict[str, int] = {}
    for row in rows:
        if row.start_ns and has_wall_clock(np.datetime64(row.start_ns, "ns")):
            starts[row.flight] = min(row.start_ns, starts.get(row.flight, row.start_ns))
    return starts


def _iso(ns: int) -> str:
    return str(np.datetime64(ns, "ns").astype("datetime64[s]")) + "Z"


# --- held-out errors --------------------------------------------------------------------------------------------------


def _held_out_rows(rows: Sequence[page.RssRow]) -> list[page.RssRow]:
    """Return rows with the RMSE after the offset of the other flights of the same setting, tower and channel."""
    groups = lists_by_key(((row.setting, row.tower, row.channel, row.unit), i) for i, row in enumerate(rows))
    scored = list(rows)
    for members in groups.values():
        mine = [rows[i] for i in members]
        mean = np.array([row.moments.mean_db for row in mine])
        offset = verdict.left_out_offsets(
            [row.n if np.isfinite(m) else 0 for row, m in zip(mine, mean, strict=True)],
            mean,
            span_db=(min(row.span_db[0] for row in mine), max(row.span_db[1] for row in mine)),
        )
        error = verdict.error_at_offset(offset, [row.rmse_db for row in mine], [row.offset_db for row in mine], mean)
        for i, o, e in zip(members, offset, error, strict=True):
            scored[i] = dataclasses.replace(rows[i], held_out_offset_db=float(o), held_out_rmse_db=float(e))
    return scored


# --- settings ---------------------------------------------------------------------------------------------------------


def rank_settings(
    rows: Iterable[page.RssRow], settings: Sequence[str], flights: Sequence[str]
) -> list[page.SettingRank]:
    """Rank settings by their mean error over flights. Add the difference from the first setting on the same flights.

    Parameters
    ----------
    rows : iterable of RssRow
    settings : sequence of str
        Labels of the settings. Settings with equal errors keep this order.
    flights : sequence of str
        Flights that are compared.

    Returns
    -------
    list of SettingRank
        Smallest mean error first. Settings without a finite error are omitted.
    """
    table: dict[str, dict[str, dict[str, float]]] = {name: {} for name in settings}
    for row in rows:
        if np.isfinite(row.error_db):
            table[row.setting].setdefault(row.flight, {})[row.link] = row.error_db
    means = {name: np.array([np.mean(list(by.values())) for by in table[name].values()]) for name in settings}
    known = sorted((name for name in settings if len(means[name])), key=lambda name: float(means[name].mean()))
    choices = []
    for name in known:
        difference = verdict.mean_of_flights(_paired(table[name], table[known[0]], flights))
        choices.append(
            page.SettingRank(
                setting=name,
                n_flights=len(means[name]),
                mean_db=float(means[name].mean()),
                quantiles_db=tuple(np.quantile(means[name], (0.1, 0.5, 0.9)).tolist()),
                difference_db=difference.mean,
                difference_ci95_db=None if name == known[0] else (difference.low, difference.high),
                n_paired=difference.n,
                verdict="first" if name == known[0] else verdict.verdict_of(difference),
            )
        )
    return choices


def _paired(errors: Mapping[str, Any], base: Mapping[str, Any], flights: Sequence[str]) -> FloatArray:
    """Return the mean difference on the links that both settings scored, per flight in the order of ``flights``."""
    differences = []
    for flight in flights:
        links = sorted(set(errors.get(flight, ())) & set(base.get(flight, ())))
        if links:
            differences.append(float(np.mean([errors[flight][link] - base[flight][link] for link in links])))
    return np.array(differences)


# --- steps of offsets -------------------------------------------------------------------------------------------------


def _flown(rows: Sequence[page.RssRow], order: Sequence[str], started: Mapping[str, int]) -> tuple[NodeOffset, ...]:
    """Return the offsets of each tower and channel over the flights, and their steps.

    The part that all have in common is subtracted.
    """
    known = {(row.flight, row.link): row.moments.mean_db for row in rows}
    links = list(dict.fromkeys(row.link for row in rows))
    offsets = np.array([[known.get((flight, link), np.nan) for link in links] for flight in order])
    dates = [_iso(started[flight]) if flight in started else flight for flight in order]
    nodes = node_offsets(offsets, [("", link) for link in links])
    return tuple(stepped(name.removesuffix(" receives"), dates, values, len(nodes)) for name, values in nodes.items())


def soundings(paths: Sequence[Path], timezone: str | None) -> tuple[NodeOffset, ...]:
    """Return the offset of each tower radio per night (UTC), from soundings between towers.

    Parameters
    ----------
    paths : sequence of Path
        Logs, folders of logs, or a flight file of ``ingest -o``. Only streams with transmitter and receiver are used.
    timezone : str, optional
        Time zone of logs with local times.

    Raises
    ------
    InputError
        If no log names both ends of a link.
    """
    levels = []
    for file in ingest(paths, options=ReadOptions(timezone=timezone)):
        for stream in file.result.streams:
            link = stream.attributes
            if stream.kind == "rss" and link.get("unit") != "dB" and {"transmitter", "receiver"} <= link.keys():
                night = stream.frame["time"].dt.strftime("%Y-%m-%d")
                ends = {end: _radio(link, end) for end in ("transmitter", "receiver")}
                by_night = stream.frame["rss_db"].groupby(night).median()
                levels.append(pd.DataFrame({**ends, "band": link.get("frequency_hz", np.nan), "offset": -by_night}))
    if not levels:
        raise InputError("no log names transmitter and receiver", expected="soundings", path=paths[0])
    table = pd.concat(levels).rename_axis("night").reset_index()
    nights = sorted(table["night"].unique())
    nodes: dict[str, NightOffsets] = {}
    for band, part in table.groupby("band", dropna=False):
        wide = part.pivot_table("offset", "night", ["transmitter", "receiver"], aggfunc="median").reindex(nights)
        name = f"{band / 1e6:.0f} MHz, " if np.isfinite(band) else ""
        nodes |= {name + node: values for node, values in node_offsets(wide.to_numpy(), list(wide.columns)).items()}
    return tuple(stepped(node, nights, values, len(nodes)) for node, values in nodes.items())


def _radio(link: Mapping[str, Any], end: str) -> str:
    """Return tower, serial number and channel of one end of a link, if the log has them."""
    serial, channel = link.get(f"{end}_serial_number"), link.get(f"{end}_channel")
    return str(link[end]) + (f" {serial}" if serial else "") + (f":{channel}" if channel else "")


# --- positions
# -----------------------------------------------------------------------------------------------------------


def _places_db(rows: Sequence[page.RssRow], cell_m: float) -> dict[tuple[int, int], float]:
    """Return the mean residual of each cell of the plan over flights, towers and channels [dB]."""
    residuals: dict[tuple[int, int], list[float]] = {}
    for row in rows:
        scored = np.isfinite(row.residual_db) & np.isfinite(row.position_m).all(axis=1)
        cells, means, _ = cell_means(row.position_m, row.residual_db, scored, cell_m)
        for (east, north), residual in zip(cells.tolist(), means, strict=True):
            residuals.setdefault((east, north), []).append(residual)
    return {cell: float(np.mean(each)) for cell, each in residuals.items()}


# --- reports of the flights -------------------------------------------------------------------------------------------


def find_reports(flights: Iterable[str], folder: Path) -> dict[str, str]:
    """Return the address of the report of each flight, relative to the folder of the campaign's page, if it exists.

    Reports are next to that folder, in folders with the names of their flights.
    """
    return {
        name: quote(f"../{name}/report.html") for name in flights if (folder.parent / name / "report.html").is_file()
    }

"""Many flights and settings: run each, pool the offsets, fit on some flights and score on the others.

A campaign.yaml names flight files and, optionally, settings: labels with overrides of flight keys in dotted form
(``rt.max_depth: 1``). Every setting runs on every flight. A flight that cannot be read is a row with its message.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ..common.errors import AerpawCmpError, UsageError
from ..common.stages import Progress, silent
from ..common.units import AnyArray, FloatArray
from ..common.versions import versions
from ..common.yamlfile import load_yaml, nearest
from ..compare import rank, result, rss, statistics
from ..compare.result import FlightResult, RankResult, RssResult
from ..flight.data import FlightData, gather, read_logs
from ..flight.overrides import Overrides, overridden
from ..flight.settings import FlightFile, RssSettings, Settings, load_flight
from ..report import campaign_data
from ..report.campaign_data import (
    CampaignData,
    Failure,
    FlownRank,
    FlownTrack,
    RankHeldOutFold,
    RankRow,
    RssRow,
)
from . import over_flights
from .campaign_fit import fit_all
from .campaign_rank_fit import K_KEY, Criterion, fit_rank_all
from .flight_run import run_flight
from .outcomes import OutcomeStore, records_of, task_key
from .over_flights import RepeatSettings, pool_offsets, rank_repeats, repeats, transfer_ranks

Stage = Callable[[str], Any]

AS_WRITTEN = "as written"
"""Label of the only setting of a campaign that names none."""


class HeldOutSettings(Settings):
    """Parameters that are fitted on some flights and scored on all."""

    fit: Annotated[dict[str, list[float] | list[list[float]]], Field(min_length=1)]
    """Dotted flight key -> values to try, increasing. Keys below ``link``, ``rt`` or ``site``, or ``rss.lag``; for rank
    also ``rank.k``, and lists as values (slants)."""
    criterion: Literal["rmse", "kappa", "log_score", "total_variation"] = "rmse"
    """What the fit lowers or raises: the RMSE of RSS, or a number of the reported rank."""
    fit_on: list[str] | None = None
    """Names of the flights to fit on; without it each flight is left out once."""
    setting: str | None = None
    """Label of the setting that the fit starts from; by default the first."""
    samples: Annotated[int, Field(ge=50)] = 1000
    """Evenly spread samples per series that the search looks at; all of them are scored."""
    refine: bool = False
    """Search between the values, too."""


class CampaignFile(Settings):
    """The whole campaign.yaml."""

    campaign: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$")]
    title: str | None = None
    flights: Annotated[list[str], Field(min_length=1)]
    settings: dict[str, dict[str, Any]] = Field(default_factory=dict)
    calibration: Literal["link", "tower", "channel", "flight", "all"] = "link"
    held_out: HeldOutSettings | None = None
    repeatability: RepeatSettings = RepeatSettings()
    export: list[str] = Field(default_factory=list)
    """Formats of the samples: those of ``report.export`` of a flight."""


def load_campaign(path: Path) -> CampaignFile:
    """Read and check a campaign.yaml.

    Raises
    ------
    UsageError
        As :func:`aerpaw_cmp.common.yamlfile.load_yaml`; also an override that names no flight key, and values to
        try that do not increase.
    """
    campaign = load_yaml(path, CampaignFile)
    fit = campaign.held_out
    for key, values in (fit.fit if fit else {}).items():
        lists = bool(values) and isinstance(values[0], list)
        if not values or (not lists and np.any(np.diff(values) <= 0)):
            raise UsageError(f"held_out.fit.{key}: {values}", expected="increasing values", path=path)
        _check_key(key, lists, of_rank=fit is not None and fit.criterion != "rmse", path=path)
    labels = list(campaign.settings) or [AS_WRITTEN]
    if fit and fit.setting is not None and fit.setting not in labels:
        near = nearest(fit.setting, labels)
        cause = f"did you mean {near!r}?" if near else None
        raise UsageError(f"held_out.setting {fit.setting!r}", expected="one of settings", cause=cause, path=path)
    return campaign


def _check_key(key: str, lists: bool, *, of_rank: bool, path: Path) -> None:
    """A key of the fit that its criterion can be fitted over."""
    own = K_KEY if of_rank else "rss.lag"
    if key.split(".")[0] not in ("link", "rt", "site") and key != own:
        raise UsageError(
            f"held_out.fit.{key}",
            expected=f"a key below link, rt or site, or {own}",
            cause=None if key != K_KEY else "criterion: kappa, log_score or total_variation fits rank",
            path=path,
        )
    if lists and not of_rank:
        raise UsageError(f"held_out.fit.{key}: lists", expected="numbers; lists are tried for rank alone", path=path)


# --- one flight under one setting ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Task:
    """One flight file under one setting."""

    path: Path
    flight: str
    setting: str
    overrides: Overrides
    logs_root: Path | None
    reference: bool = True
    """Overlays are drawn for this setting: places and times are kept."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Rows of one task, or why there are none."""

    rss: tuple[RssRow, ...] = ()
    rank: tuple[RankRow, ...] = ()
    failure: Failure | None = None
    track: FlownTrack | None = None
    flown: tuple[FlownRank, ...] = ()


@lru_cache(maxsize=2)
def _logs(path: Path, logs: str, zone: str | None, logs_root: Path | None, settings: _ByText) -> Any:
    """The logs of a flight: settings after settings reads them once."""
    del logs, zone  # they make the key
    return read_logs(settings.value, path.parent, logs_root)


@dataclass(frozen=True, slots=True)
class _ByText:
    """Carries a value through a cache whose key is made of the other arguments."""

    value: FlightFile

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByText)

    def __hash__(self) -> int:
        return 0


def flight_data(task: Task) -> FlightData:
    """Read and gather the flight of a task; errors as in :mod:`aerpaw_cmp.flight.data`."""
    settings = overridden(load_flight(task.path), task.overrides)
    text = "\n".join(log.model_dump_json() for log in settings.logs)
    files = _logs(task.path, text, settings.timezone, task.logs_root, _ByText(settings))
    return gather(settings, task.path.parent, files, task.logs_root)


def run_task(task: Task) -> Outcome:
    """Replay and compare one flight under one setting; whatever goes wrong becomes a message.

    This runs in worker processes: it takes and gives plain data.
    """
    try:
        found = run_flight(flight_data(task), audit=False)
    except AerpawCmpError as error:
        return Outcome(failure=Failure(flight=task.flight, setting=task.setting, message=str(error)))
    except Exception as error:  # one flight's fault must not cost the others their numbers
        text = f"a fault of the program itself: {type(error).__name__}: {error}"
        return Outcome(failure=Failure(flight=task.flight, setting=task.setting, message=text))
    return Outcome(
        rss=tuple(_rss_row(task, found.data.settings.rss, one) for one in found.result.rss),
        rank=tuple(row for one in found.result.rank for row in _rank_rows(task, one)),
        track=_flown(task, found.result),
        flown=tuple(
            FlownRank(
                flight=task.flight,
                tower=one.tower,
                position_m=one.position_m,
                rank=one.measured,
                simulated=one.rank,
                time_s=_elapsed_s(one.time),
                start_ns=_start_ns(one.time),
            )
            for one in found.result.rank
            if task.reference
        ),
    )


def _flown(task: Task, result: FlightResult) -> FlownTrack:
    first = result.rss[0] if result.rss else result.rank[0]
    return FlownTrack(flight=task.flight, time_s=_elapsed_s(first.time), position_m=first.position_m)


def _start_ns(time: AnyArray) -> int:
    return int(time[0].astype("datetime64[ns]").astype(np.int64)) if len(time) else 0


def _elapsed_s(time: AnyArray) -> FloatArray:
    return np.asarray((time - time[:1]) / np.timedelta64(1, "s"), dtype=np.float64)


def _rss_row(task: Task, rules: RssSettings, found: RssResult) -> RssRow:
    score, clock = found.score, found.further.clock
    return RssRow(
        flight=task.flight,
        setting=task.setting,
        tower=found.tower,
        channel=found.channel,
        unit=found.unit,
        offset_db=score.offset_db,
        rmse_db=score.rmse_db,
        correlation=score.correlation,
        n=score.n,
        n_out_of_coverage=score.n_out_of_coverage,
        at_search_edge=score.at_edge,
        rmse_ci95_db=score.rmse_ci95_db,
        offset_ci95_db=score.intervals.offset_db,
        correlation_ci95=score.intervals.correlation,
        n_effective=score.intervals.autocorrelation.n_effective,
        lag_s=score.lag_s,
        lag_verdict="" if clock is None else clock.verdict,
        fitted=score.fitted_on_scored,
        baselines={name: model.rmse_db for name, model in found.baselines.items()},
        step_db=rules.step_db,
        span_db=rules.span_db,
        measured_db=found.measured_db,
        simulated_dbm=found.simulated_dbm,
        time_s=_elapsed_s(found.time) if task.reference else np.zeros(0),
        start_ns=_start_ns(found.time),
        position_m=found.position_m if task.reference else np.zeros((0, 3)),
        distance_m=found.geometry["distance_m"] if task.reference else np.zeros(0),
        heading_deg=found.geometry.get("heading_deg") if task.reference else None,
        within=found.further.repeatability,
    )


def _rank_rows(task: Task, found: RankResult) -> list[RankRow]:
    score = found.score
    return [
        RankRow(
            flight=task.flight,
            setting=task.setting,
            tower=found.tower,
            n=score.n,
            best_k=score.best_k,
            best_k_ci95=score.curve.best_k_interval,
            k=k,
            n_out_of_coverage=fit.out_of_coverage,
            agreement=fit.agreement,
            agreement_ci95=fit.agreement_ci95,
            kappa=fit.kappa,
            total_variation=fit.total_variation,
            total_variation_ci95=fit.total_variation_ci95,
            wasserstein=fit.wasserstein,
            commonest_agreement=found.further.commonest.agreement,
        )
        for k, fit in score.simulated.items()
    ]


def cluster_executor(address: str) -> Executor:
    """Workers of a running Dask scheduler, which must see the same files under the same paths.

    Raises
    ------
    UsageError
        Without the package ``distributed``, or if no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise UsageError(
            f"--cluster {address!r} needs the package 'distributed'", expected="pip install distributed"
        ) from None
    try:
        executor: Executor = Client(address, timeout="10s").get_executor()
    except (OSError, ValueError) as error:
        raise UsageError(f"--cluster {address!r}: no scheduler answers ({error})") from error
    return executor


TRIES = 2
"""A task in work when a worker is lost is tried again; after so many tries once more, alone; then it is a failure."""


def run_tasks(
    tasks: Sequence[Task], workers: int, cluster: str | None, progress: Progress, keep: Path | None = None
) -> list[Outcome]:
    """All tasks in order: here, in a pool of processes, or on a cluster.

    Parameters
    ----------
    tasks : sequence of Task
    workers : int
        Processes; with one the tasks run here.
    cluster : str, optional
        Address of a Dask scheduler, in place of processes.
    progress : Progress
        Gets a line per finished task.
    keep : Path, optional
        Folder of outcomes: what stands there is taken, what is computed is put there as soon as it is done.

    Returns
    -------
    list of Outcome
        In the order of the tasks; what goes wrong in one is its failure.
    """
    store, keys = (None, {}) if keep is None else _kept(tasks, keep)
    found: dict[int, Outcome] = {}
    if store is not None:
        found = {i: outcome for i, key in keys.items() if (outcome := store.load(key)) is not None}
        for text in store.told:
            progress(text)
        if found:
            progress(f"{len(found)} of {len(tasks)} outcomes are kept from before")

    def done(number: int, outcome: Outcome) -> None:
        found[number] = outcome
        if store is not None and outcome.failure is None and number in keys:
            store.save(keys[number], outcome)
        progress(f"{tasks[number].flight}: {tasks[number].setting}", len(found) / len(tasks))

    todo = [i for i in range(len(tasks)) if i not in found]
    if cluster is None and workers <= 1:
        for i in todo:
            done(i, run_task(tasks[i]))
    elif cluster is not None:
        with cluster_executor(cluster) as pool:
            _collect(pool, tasks, todo, done)
    elif todo:
        _in_processes(tasks, todo, workers, done)
    return [found[i] for i in range(len(tasks))]


def _kept(tasks: Sequence[Task], keep: Path) -> tuple[OutcomeStore, dict[int, str]]:
    """The store, and the key of every task whose inputs can be read."""
    keys = {}
    for number, task in enumerate(tasks):
        with suppress(AerpawCmpError, OSError):  # such a task will say itself what is wrong
            settings = overridden(load_flight(task.path), task.overrides)
            more = (task.flight, task.setting, task.reference)
            keys[number] = task_key(settings, task.path, task.logs_root, *more)
    return OutcomeStore(
        keep, records_of(sys.modules[__name__], over_flights, campaign_data, rank, result, rss, statistics)
    ), keys


def _collect(pool: Executor, tasks: Sequence[Task], todo: Sequence[int], done: Callable[[int, Outcome], None]) -> None:
    """Outcomes of a pool as they come; a lost one is a failure."""
    futures = {pool.submit(run_task, tasks[i]): i for i in todo}
    for future in as_completed(futures):
        error = future.exception()
        done(futures[future], future.result() if error is None else _lost(tasks[futures[future]], error))


def _lost(task: Task, error: BaseException) -> Outcome:
    text = f"its worker process ended: {error or type(error).__name__}"
    return Outcome(failure=Failure(flight=task.flight, setting=task.setting, message=text))


def _in_processes(
    tasks: Sequence[Task], todo: Sequence[int], workers: int, done: Callable[[int, Outcome], None]
) -> None:
    """A pool of processes that is made anew when a worker is lost: only what was running is tried again.

    A pool breaks as a whole, and does not say whose process ended. Each task leaves a mark when it begins, so that
    those in work are known; the others lost nothing. A task that was in work twice when a worker was lost runs a last
    time alone, so that it does not pay for its neighbour.
    """
    tries: Counter[int] = Counter()
    waiting = list(todo)
    with tempfile.TemporaryDirectory(prefix="aerpaw-cmp-tasks-") as marks:
        while waiting:
            together = [i for i in waiting if tries[i] < TRIES] or waiting[:1]
            lost = _round(tasks, together, min(workers, len(together)), Path(marks), done)
            for number, error in lost.items():
                mark = Path(marks) / str(number)
                if mark.exists():
                    mark.unlink()
                    tries[number] += 1
                if tries[number] > TRIES:
                    done(number, _lost(tasks[number], error))
            waiting = [i for i in waiting if (i in lost and tries[i] <= TRIES) or i not in together]


def _round(
    tasks: Sequence[Task], numbers: Sequence[int], workers: int, marks: Path, done: Callable[[int, Outcome], None]
) -> dict[int, BaseException]:
    """One pool, until it is through or breaks; gives the tasks that it did not finish."""
    lost: dict[int, BaseException] = {}
    # spawn: a forked child would inherit the threads of numerical libraries in an unknown state
    with ProcessPoolExecutor(max_workers=workers, mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(_marked, tasks[i], str(marks / str(i))): i for i in numbers}
        for future in as_completed(futures):
            number, error = futures[future], future.exception()
            if isinstance(error, BrokenExecutor):
                lost[number] = error
            else:
                done(number, future.result() if error is None else _lost(tasks[number], error))
    return lost


def _marked(task: Task, mark: str) -> Outcome:
    """Run a task; its mark stands from its beginning on."""
    Path(mark).touch()
    return run_task(task)


def run(
    campaign: CampaignFile,
    folder: Path,
    *,
    logs_root: Path | None = None,
    workers: int = 1,
    cluster: str | None = None,
    keep: Path | None = None,
    stage: Stage = lambda _name: nullcontext(),
    progress: Progress = silent,
) -> CampaignData:
    """All flights under all settings, and what can be said only of several flights.

    Parameters
    ----------
    campaign : CampaignFile
    folder : Path
        Against which the paths of flight files resolve.
    logs_root : Path, optional
        Against which the paths of logs resolve, in place of each flight file's folder.
    workers : int
        Processes.
    cluster : str, optional
        Address of a Dask scheduler, in place of processes here.
    keep : Path, optional
        Folder of outcomes, taken and added to.
    stage, progress : callable
        A context manager per named stage; lines of progress.

    Raises
    ------
    UsageError
        Overrides that no flight file could have, two flights of one name, an unknown flight in ``fit_on``.
    """
    settings = campaign.settings or {AS_WRITTEN: {}}
    files, failures = _flight_files(campaign, folder, settings)
    tasks = [
        Task(path, name, label, overrides, logs_root, reference=label == next(iter(settings)))
        for name, (path, _) in files.items()
        for label, overrides in settings.items()
    ]
    _check_names(campaign, files, failures)
    with stage("flights"):
        outcomes = run_tasks(tasks, workers, cluster, progress, keep) if tasks else []
    failures += [o.failure for o in outcomes if o.failure is not None]
    with stage("pool"):
        rows, pooled = pool_offsets([row for o in outcomes for row in o.rss], campaign.calibration)
        reference = [row for row in rows if row.setting == next(iter(settings))]
        found = repeats(reference, campaign.repeatability)
    folds: list[Any] = []
    rank_folds: list[RankHeldOutFold] = []
    trouble = ""
    if campaign.held_out is not None:
        with stage("held-out"):
            try:
                if campaign.held_out.criterion == "rmse":
                    folds = _held_out(campaign.held_out, tasks, rows, progress)
                else:
                    ranked = {row.flight for o in outcomes for row in o.rank}
                    rank_folds = _held_out_rank(campaign.held_out, campaign.held_out.criterion, tasks, ranked, progress)
            except AerpawCmpError as error:
                trouble = str(error)
    good = [t for t, o in zip(tasks, outcomes, strict=True) if o.failure is None]
    rank = tuple(row for o in outcomes for row in o.rank)
    tracks = {o.track.flight: o.track for o in reversed(outcomes) if o.track is not None}
    return CampaignData(
        name=campaign.campaign,
        title=campaign.title or campaign.campaign,
        generated=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        versions=versions(),
        calibration=campaign.calibration,
        flights=tuple(dict.fromkeys([*files, *(f.flight for f in failures)])),
        settings=settings,
        rss=tuple(rows),
        rank=rank,
        rank_transfers=tuple(transfer_ranks(rank)),
        tracks=tuple(tracks[name] for name in files if name in tracks),
        flown_ranks=tuple(one for o in outcomes for one in o.flown),
        failures=tuple(failures),
        pooled=tuple(pooled),
        repeats=tuple(found),
        rank_repeats=tuple(rank_repeats([f for o in outcomes for f in o.flown], campaign.repeatability.radius_m)),
        held_out=tuple(folds),
        held_out_rank=tuple(rank_folds),
        held_out_failure=trouble,
        radius_m=campaign.repeatability.radius_m,
        heading_within_deg=campaign.repeatability.heading_within_deg,
        cell_m=campaign.repeatability.cell_m,
        site=flight_data(good[0]).site if good else None,
        synthetic=tuple(name for name, (_, f) in files.items() if f.flight.synthetic),
        workers=workers,
    )


def _held_out(
    settings: HeldOutSettings, tasks: Sequence[Task], rows: Sequence[RssRow], progress: Progress
) -> list[Any]:
    """Fit under one setting on the flights that gave RSS under it."""
    label = settings.setting or tasks[0].setting if tasks else ""
    with_rss = {row.flight for row in rows if row.setting == label}
    flights = {task.flight: flight_data(task) for task in tasks if task.setting == label and task.flight in with_rss}
    return fit_all(
        flights,
        {key: [float(v) for v in values if not isinstance(v, list)] for key, values in settings.fit.items()},
        settings.fit_on,
        setting=label,
        samples=settings.samples,
        refine=settings.refine,
        progress=progress,
    )


def _held_out_rank(
    settings: HeldOutSettings, criterion: Criterion, tasks: Sequence[Task], ranked: set[str], progress: Progress
) -> list[RankHeldOutFold]:
    """Fit rank parameters under one setting on the flights that gave rank."""
    label = settings.setting or tasks[0].setting if tasks else ""
    flights = {t.flight: flight_data(t) for t in tasks if t.setting == label and t.flight in ranked}
    return fit_rank_all(
        flights,
        settings.fit,
        settings.fit_on,
        criterion=criterion,
        setting=label,
        samples=settings.samples,
        progress=progress,
    )


def _flight_files(
    campaign: CampaignFile, folder: Path, settings: Mapping[str, Overrides]
) -> tuple[dict[str, tuple[Path, FlightFile]], list[Failure]]:
    """Flight files that can be read, by name, every override tried on them; and those that cannot."""
    files: dict[str, tuple[Path, FlightFile]] = {}
    failures = []
    for entry in campaign.flights:
        path = folder / entry
        try:
            flight = load_flight(path)
        except UsageError as error:
            failures.append(Failure(flight=Path(entry).stem, setting="every setting", message=str(error)))
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


def _check_names(
    campaign: CampaignFile, files: Mapping[str, tuple[Path, FlightFile]], failures: Sequence[Failure]
) -> None:
    if campaign.held_out is None:
        return
    known = [*files, *(f.flight for f in failures)]
    for name in campaign.held_out.fit_on or []:
        if name not in known:
            near = nearest(name, known)
            raise UsageError(
                f"held_out.fit_on names {name!r}",
                expected="flights of the campaign: " + ", ".join(known),
                cause=f"did you mean {near!r}?" if near else None,
            )
    for path, flight in files.values():
        for key, values in campaign.held_out.fit.items():
            try:
                if key != K_KEY:
                    overridden(flight, {key: values[0]})
            except UsageError as error:
                raise UsageError(
                    f"held_out.fit for {path}: {error.found}", expected=error.expected, cause=error.cause
                ) from None

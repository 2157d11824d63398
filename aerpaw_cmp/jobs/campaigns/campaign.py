"""Many flights and settings: run each, pool the offsets, fit on some flights and score on the others.

A campaign.yaml names flight files and, optionally, settings: labels with overrides of flight keys in dotted form
(``rt.max_depth: 1``). Every setting runs on every flight. A flight that cannot be read is a row with its message.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ...common.errors import AerpawCmpError, InputError, UsageError
from ...common.stages import Progress, Stages
from ...common.versions import versions
from ...common.yamlfile import load_yaml, nearest
from ...compare.rss import LEARNED_HERE
from ...flight.overrides import Overrides, overridden
from ...flight.settings import FlightFile, Settings, load_flight
from ...report.campaign_data import CampaignData, Failure, HeldOutFold, RankHeldOutFold, RankRow, RssRow
from ..options import DEFAULT, RunOptions
from ..tasks.workers import open_workers
from .campaign_fit import HeldOutSettings, fit_all
from .campaign_plan import compute, kept_outcomes
from .campaign_rank_fit import K_KEY, fit_rank_all
from .campaign_tasks import Task, counted_once, flight_data, outcome_store
from .over_flights import RepeatSettings, pool_offsets, rank_repeats, repeats, transfer_ranks

AS_WRITTEN = "as written"
"""Label of the only setting of a campaign that names none."""


class CampaignFile(Settings):
    """The whole campaign.yaml."""

    campaign: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$")]
    title: str | None = None
    flights: Annotated[list[str], Field(min_length=1)]
    settings: dict[str, dict[str, Any]] = Field(default_factory=dict)
    calibration: Literal["link", "tower", "channel", "flight", "all"] = "link"
    held_out: HeldOutSettings | None = None
    repeatability: RepeatSettings = RepeatSettings()
    keep: str | None = None
    """Folder of outcomes, against this file's."""
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


# --- all of it --------------------------------------------------------------------------------------------------------


def run(
    campaign: CampaignFile,
    folder: Path,
    options: RunOptions = DEFAULT,
    *,
    keep: Path | None = None,
    stages: Stages | None = None,
) -> CampaignData:
    """All flights under all settings, and what can be said only of several flights.

    Parameters
    ----------
    campaign : CampaignFile
    folder : Path
        Against which the paths of flight files resolve.
    options : RunOptions
    keep : Path, optional
        Folder of outcomes, taken and added to.
    stages : Stages, optional

    Returns
    -------
    CampaignData
        Rows of every flight and setting, pooled offsets, repeats, folds; a flight that failed is among ``failures``.

    Raises
    ------
    UsageError
        Overrides that no flight file could have, two flights of one name, an unknown flight in ``fit_on``.
    """
    stages, progress, logs_root = stages or Stages(), options.progress, options.logs_root
    if options.scheduler is not None:  # workers may stand in another folder
        folder, logs_root = folder.absolute(), None if logs_root is None else logs_root.absolute()
    tasks, files, failures = campaign_tasks(campaign, folder, logs_root)
    settings = campaign.settings or {AS_WRITTEN: {}}
    store = None if keep is None else outcome_store(keep)
    if store is not None:
        store.check()
    with stages("flights"):
        outcomes, orders = kept_outcomes(tasks, store, progress)
    seen = _inputs_of(files, logs_root)
    with (
        open_workers(options.workers, options.scheduler if orders else None, paths=seen, progress=progress) as crew,
        stages("flights"),
    ):
        compute(orders, crew, outcomes, store, progress)
    results = counted_once(tasks, [outcomes[number] for number in range(len(tasks))])
    rank = tuple(row for o in results for row in o.rank)
    flown = tuple(one for o in results for one in o.flown)
    failures += [o.failure for o in results if o.failure is not None]
    with stages("pool"):
        rows, pooled = pool_offsets([row for o in results for row in o.rss], campaign.calibration)
        repeated = repeats([r for r in rows if r.setting == next(iter(settings))], campaign.repeatability)
        ranks_again = rank_repeats(flown, campaign.repeatability.radius_m)
    held_out = _Folds()
    if campaign.held_out is not None:
        with stages("held-out"):
            held_out = _folds(campaign.held_out, tasks, rows, rank, progress)
    good = [t for t, o in zip(tasks, results, strict=True) if o.failure is None]
    tracks = {o.track.flight: o.track for o in reversed(results) if o.track is not None}
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
        flown_ranks=flown,
        failures=tuple(failures),
        pooled=tuple(pooled),
        repeats=tuple(repeated),
        rank_repeats=tuple(ranks_again),
        held_out=held_out.rss,
        held_out_rank=held_out.rank,
        held_out_failure=held_out.failure,
        radius_m=campaign.repeatability.radius_m,
        heading_within_deg=campaign.repeatability.heading_within_deg,
        cell_m=campaign.repeatability.cell_m,
        site=flight_data(good[0]).site if good else None,
        synthetic=tuple(name for name, (_, f) in files.items() if f.flight.synthetic),
        workers=options.workers,
    )


def campaign_tasks(
    campaign: CampaignFile, folder: Path, logs_root: Path | None = None
) -> tuple[list[Task], dict[str, tuple[Path, FlightFile]], list[Failure]]:
    """Every setting on every flight, the flight files by name, and those that cannot be read.

    Raises
    ------
    UsageError
        Overrides that no flight file could have, two flights of one name, an unknown flight in ``fit_on``.
    """
    settings = campaign.settings or {AS_WRITTEN: {}}
    files, failures = _flight_files(campaign, folder, settings)
    _check_names(campaign, files, failures)
    tasks = [
        Task(path, name, label, overrides, logs_root, reference=label == next(iter(settings)))
        for name, (path, _) in files.items()
        for label, overrides in settings.items()
    ]
    return tasks, files, failures


def _inputs_of(files: Mapping[str, tuple[Path, FlightFile]], logs_root: Path | None) -> list[Path]:
    """Flight files and logs that are there; what is missing here is a row of the result."""
    paths = [path for path, _ in files.values()]
    paths += [(logs_root or path.parent) / log.path for path, flight in files.values() for log in flight.logs]
    return [path for path in paths if path.exists()]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Folds:
    """Fits on some flights with their scores on others, or the reason why there are none."""

    rss: tuple[HeldOutFold, ...] = ()
    rank: tuple[RankHeldOutFold, ...] = ()
    failure: str = ""


def _folds(
    settings: HeldOutSettings,
    tasks: Sequence[Task],
    rows: Sequence[RssRow],
    rank: Sequence[RankRow],
    progress: Progress,
) -> _Folds:
    """The held-out fit by its criterion; one that fails costs the other numbers of a campaign nothing."""
    of_rank = settings.criterion != "rmse"
    label, of = _tasks_of_fit(settings, tasks, rank if of_rank else rows)
    try:
        flights = {flight: flight_data(task) for flight, task in of.items()}
        if of_rank:
            return _Folds(rank=tuple(fit_rank_all(flights, settings, label, progress)))
        return _Folds(rss=tuple(fit_all(flights, settings, label, progress)))
    except AerpawCmpError as error:
        return _Folds(failure=str(error))


def _tasks_of_fit(
    settings: HeldOutSettings, tasks: Sequence[Task], rows: Sequence[RssRow] | Sequence[RankRow]
) -> tuple[str, dict[str, Task]]:
    """Label of the setting that a fit starts from, and the task of each flight that gave rows under it."""
    label = settings.setting or tasks[0].setting if tasks else ""
    learned = {row.flight for row in rows if isinstance(row, RssRow) and LEARNED_HERE in row.fitted}
    gave = {row.flight for row in rows if row.setting == label} - learned
    return label, {task.flight: task for task in tasks if task.setting == label and task.flight in gave}


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
        except (InputError, UsageError) as error:
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
    first = {key: values[0] for key, values in campaign.held_out.fit.items() if key != K_KEY}
    for path, flight in files.values():
        for key, value in first.items():
            try:
                overridden(flight, {key: value})
            except UsageError as error:
                raise UsageError(
                    f"held_out.fit for {path}: {error.found}", expected=error.expected, cause=error.cause
                ) from None

"""Many flights and settings: run each, pool the offsets, compare flights at the same places.

A campaign.yaml names flight files and, optionally, settings: labels with overrides of flight keys in dotted form
(``rt.max_depth: 1``). Every setting runs on every flight. A flight that cannot be read is a row with its message.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ...common.errors import InputError, UsageError, one_line
from ...common.jsonable import named
from ...common.stages import PlannedStage, Stages
from ...common.units import finite_mean
from ...common.yamlfile import StrictModel, load_yaml
from ...compare.offset import Pooling, pooled_moments
from ...compare.statistics.passes import Pass, PassPair, PassTable
from ...flight.gains.memory import with_learned
from ...flight.overrides import Overrides, overridden
from ...flight.settings import FlightFile, load_flight
from ...report.campaign import CampaignData, Failure, PooledOffset, RankRow, RankTransfer, Repeat, RssRow
from ..tasks.options import DEFAULT, RunOptions
from ..tasks.outcomes import OutcomeStore
from ..tasks.workers import open_workers
from .campaign_tasks import Outcome, Task, compute, counted_once, flight_data, kept_outcomes, planned_tasks

# Label of the only setting of a campaign that names none.
_AS_WRITTEN = "as written"


class CampaignFile(StrictModel):
    """The whole campaign.yaml."""

    campaign: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$")]
    title: str | None = None
    flights: list[str] = Field(default_factory=list)
    soundings: list[str] = Field(default_factory=list)
    timezone: str | None = None  # of soundings with local times
    settings: dict[str, dict[str, Any]] = Field(default_factory=dict)
    calibration: Literal["link", "tower", "channel", "flight", "all"] = "link"


def load_campaign(path: Path) -> CampaignFile:
    """Read and check a campaign.yaml.

    Raises
    ------
    UsageError
        As :func:`aerpaw_cmp.common.yamlfile.load_yaml`.
    """
    campaign = load_yaml(path, CampaignFile)
    if not campaign.flights + campaign.soundings:
        raise UsageError("no flights and no soundings", expected="flights: [FLIGHT.yaml, ...]", path=path)
    if campaign.timezone is not None and not campaign.soundings:
        raise UsageError(
            "'timezone' without 'soundings', whose times it is for",
            expected="the time zone of a flight in its own flight.yaml",
            path=path,
        )
    return campaign


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
        Rows of every flight and setting, pooled offsets, repeats; a flight that failed is among ``failures``.

    Raises
    ------
    UsageError
        Overrides that no flight file could have, two flights of one name.
    """
    stages, progress, logs_root = stages or Stages(), options.progress, options.logs_root
    if options.scheduler is not None:  # workers may stand in another folder
        folder, logs_root = folder.absolute(), None if logs_root is None else logs_root.absolute()
    tasks, files, failures = campaign_tasks(campaign, folder, logs_root)
    settings = campaign.settings or {_AS_WRITTEN: {}}
    store = None if keep is None else OutcomeStore(keep, Outcome)
    with stages("flights"):
        outcomes, orders = kept_outcomes(tasks, store, progress)
    unread = [PlannedStage(failure.flight, one_line(failure.message)) for failure in failures]
    stages.checked(lambda: [*planned_tasks(tasks, outcomes, options.workers), *unread])
    if store is not None:
        store.check()
    inputs = _inputs_of(files, logs_root)
    with (
        open_workers(options.workers, options.scheduler if orders else None, paths=inputs, progress=progress) as crew,
        stages("flights"),
    ):
        compute(orders, crew, outcomes, store, progress)
    results = counted_once(tasks, [outcomes[number] for number in range(len(tasks))])
    rank = tuple(row for o in results for row in o.rank)
    failures += [o.failure for o in results if o.failure is not None]
    with stages("pool"):
        rows, pooled = pool_offsets([row for o in results for row in o.rss], campaign.calibration)
        repeated = repeats([r for r in rows if r.setting == next(iter(settings))])
    good = [t for t, o in zip(tasks, results, strict=True) if o.failure is None]
    return CampaignData(
        name=campaign.campaign,
        title=campaign.title or campaign.campaign,
        calibration=campaign.calibration,
        flights=tuple(dict.fromkeys([*files, *(f.flight for f in failures)])),
        settings=settings,
        rss=tuple(rows),
        rank=rank,
        rank_transfers=tuple(transfer_ranks(rank)),
        failures=tuple(failures),
        pooled=tuple(pooled),
        repeats=tuple(repeated),
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
        Overrides that no flight file could have, two flights of one name.
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
    """Flight files and logs that are there; what is missing here is a row of the result."""
    paths = [path for path, _ in files.values()]
    paths += [(logs_root or path.parent) / log.path for path, flight in files.values() for log in flight.logs]
    return [path for path in paths if path.exists()]


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
            with_learned(flight, path.parent)
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


# --- what only several flights together can give: shared offsets, repeatability, K chosen on the others --------------


def pool_offsets(rows: Sequence[RssRow], per: Pooling) -> tuple[list[RssRow], list[PooledOffset]]:
    """Shared offsets of each setting, entered into the rows and listed by group."""
    pooled_rows: list[RssRow] = []
    groups: list[PooledOffset] = []
    for setting in dict.fromkeys(row.setting for row in rows):
        members = [row for row in rows if row.setting == setting]
        span = (min(r.span_db[0] for r in members), max(r.span_db[1] for r in members))
        fits = pooled_moments(
            {row.key: row.moments for row in members},
            per,
            span_db=span,
        )
        pooled = [
            dataclasses.replace(row, pooled_offset_db=fits[row.key].offset_db, pooled_rmse_db=fits[row.key].rmse_db)
            for row in members
        ]
        pooled_rows += pooled
        by_group: dict[str, list[RssRow]] = {}
        for row in pooled:
            by_group.setdefault(_group(row, per), []).append(row)
        groups += [_pooled(setting, name, some, fits) for name, some in by_group.items()]
    return pooled_rows, groups


def _group(row: RssRow, per: Pooling) -> str:
    joined = {"link": f"{row.flight} {row.link}", "all": "all"}
    return joined[per] if per in joined else str(getattr(row, per))


def _pooled(setting: str, name: str, rows: list[RssRow], fits: Mapping[Any, Any]) -> PooledOffset:
    offsets_db = np.array([row.offset_db for row in rows])
    offsets_db = offsets_db[np.isfinite(offsets_db)]
    nan = float("nan")
    return PooledOffset(
        setting=setting,
        group=name,
        members=tuple(f"{row.flight} {row.link}" for row in rows),
        offset_db=rows[0].pooled_offset_db,
        spread_db=float(offsets_db.std(ddof=1)) if len(offsets_db) > 1 else nan,
        range_db=(float(offsets_db.min()), float(offsets_db.max())) if len(offsets_db) else (nan, nan),
        own_rmse_db=finite_mean([row.rmse_db for row in rows]),
        pooled_rmse_db=finite_mean([row.pooled_rmse_db for row in rows]),
        at_search_edge=any(fits[row.key].at_edge for row in rows),
        units=tuple(dict.fromkeys(row.unit for row in rows)),
    )


def repeats(rows: Sequence[RssRow]) -> list[Repeat]:
    """Every pair of flights that share a tower and channel, of the rows of one setting, in their order."""
    passes = [
        Pass(
            **named(row, "flight position_m residual_db heading_deg"),
            link=f"{row.tower}\n{row.channel}",
            level_db=row.measured_db,
        )
        for row in rows
    ]
    rule = named(CampaignData, "radius_m heading_within_deg")
    pairs = PassTable(passes, CampaignData.cell_m).pairs(**rule)
    known = [int(np.isfinite(row.measured_db).sum()) for row in rows]
    ordered = sorted(pairs, key=lambda pair: (pair.first, pair.second))
    return [_repeat(pair, rows[pair.first], rows[pair.second], known[pair.first]) for pair in ordered]


def _repeat(pair: PassPair, first: RssRow, second: RssRow, known: int) -> Repeat:
    same = "n rmse_db rmse_ci95_db offset_db residual_rmse_db place_rmse_db place_correlation cells height_difference_m"
    return Repeat(
        tower=first.tower,
        channel=first.channel,
        first=first.flight,
        second=second.flight,
        share=pair.n / max(known, 1),
        single_db=pair.rmse_db / 2.0**0.5,
        **named(pair, same),
    )


def transfer_ranks(rows: Sequence[RankRow]) -> list[RankTransfer]:
    """K chosen on the other flights, for every flight that has others with the same tower and K."""
    out = []
    for setting, tower in dict.fromkeys((row.setting, row.tower) for row in rows):
        by: dict[str, dict[float, RankRow]] = {}
        for row in rows:
            if (row.setting, row.tower) == (setting, tower) and np.isfinite(row.total_variation):
                by.setdefault(row.flight, {})[row.k] = row
        for flight, fits in by.items():
            other_flights = [at for name, at in by.items() if name != flight]
            common = [k for k in fits if other_flights and all(k in at for at in other_flights)]
            if not common:
                continue
            # K that all other flights have: a mean over fewer of them would compare unlike flights
            chosen = min(common, key=lambda k: finite_mean([at[k].total_variation for at in other_flights]))
            best = min(fits, key=lambda k: fits[k].total_variation)
            out.append(
                RankTransfer(
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

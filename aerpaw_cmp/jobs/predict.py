"""The ``predict`` job: levels with intervals, serving tower and ranks at positions without a flight.

The module also corrects maps by flights: raw replay, prediction, standard deviation, and ranks of a learned receiver.
Levels of a map are in dBm, without the mean offset between the logs and the raw replay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ..common.content import KEY, MARKS, union
from ..common.errors import InputError, UsageError
from ..common.outputs import OutputFolder
from ..common.stages import PlannedStage, Progress, Stages
from ..common.text import counted
from ..common.units import AnyArray, BoolArray, FloatArray, IntArray
from ..compare.calibration import OFF, STATED_FIELDS, Base, by_degree, choose, fixed_base
from ..compare.gains import BAND, LinkSamples
from ..flight.data import FlightData, site_place, unread
from ..flight.drafting.proposals import latest_learned_links
from ..flight.gains import flight_of
from ..flight.settings import FlightFile, LinkSettings, LinksSettings
from ..flight.training import counted_once, flight_logs, knows, learned_patterns, marks_of
from ..maps.grid import Grid, Layer, LinkBudget
from ..propagation.geometry import Poses, rotation_from_aircraft
from ..report import maps as page
from ..report import prediction as pages
from ..site.antennas import MeasuredPattern
from ..site.learned import BAND as CARRIER_BAND
from ..site.learned import folder_of, read_learned
from ..site.site import Site
from ..site.siteyaml import load_site, site_model
from .calibrate import learned_antennas, observe
from .calibrate_rank import FittedReceiver, RankSamples, read_receiver
from .options import DEFAULT, RANKS, JobOutcome, RunOptions
from .sources import (
    PRIOR_SD_DB,
    Flown,
    NamedFlight,
    Prior,
    Source,
    Stored,
    TargetOptions,
    Targets,
    files_of,
    find_targets,
    is_settings,
    named_flights,
    outside,
    outside_area,
    sources_of,
    stored_model,
    target_files,
    track_m,
)

# Number of headings with equal weights that are used if the heading is not known.
HEADINGS = 8

# Largest number of targets per block. The number limits the memory that is used.
AT_ONCE = 50_000

# Column of the probability of lock, for receivers that can lose it.
P_LOCK = "p_lock"

_TILE_M = 100.0

# Largest number of targets at which the channel matrices of a receiver are evaluated.
MOST_RANKED = 50_000

# Distance that counts as much as a turn of 60 degrees when the nearest ranked target is chosen [m].
_NOSE_M = 50.0

_FLAG_CODES = {name: code for code, name in enumerate(["", *pages.FLAGS])}

# Receiver of each tower, the link with its arrays, and the folder of their files.
Receivers = Mapping[str, tuple[FittedReceiver, LinkSettings, Path]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """A prediction: the record of its page, and additional data for maps."""

    page: pages.PredictionPage
    targets: Targets
    model: Flown | Stored | Prior
    sources: Mapping[str, Source]

    @property
    def table(self) -> pd.DataFrame:
        """The rows of prediction.csv: one per target, tower and channel, then one per target and receiver."""
        return self.page.table

    def _repr_html_(self) -> str:
        """Return the summary and the first points for notebooks."""
        points = str(self.table.head(10).round(2).to_html(index=False, border=0))
        return f"<p>{escape(self.page.verdict)}</p>{points}"


def predict(
    where: Path,
    flights: Sequence[NamedFlight],
    options: TargetOptions | None = None,
    *,
    logs_root: Path | None = None,
    stages: Stages | None = None,
) -> Prediction:
    """Predict levels and ranks at the positions that WHERE names.

    Parameters
    ----------
    where : Path
        See :func:`.sources.find_targets`.
    flights : sequence of NamedFlight
        Flights to learn from. If there are none, the levels learned for the site are used, or else ray tracing with a
        wide prior.
    options : TargetOptions, optional
    logs_root : Path, optional
        Folder against which the paths of logs resolve.
    stages : Stages, optional

    Returns
    -------
    Prediction

    Raises
    ------
    UsageError, InputError
        If no source has a tower and band of the target, or there is no position to predict.
    """
    stages, options = stages or Stages(), options or TargetOptions()
    with stages("read"):
        known, remarks = counted_once([flight.load(logs_root) for flight in flights])
        site, place = site_of(where, flights, known, options.site)
        targets = find_targets(where, site, options, logs_root)
        unflown = None if known else _unflown(where, place, site, options)
        if unflown is not None:
            every = unflown.sources()
            if isinstance(unflown, Prior) and options.carrier_hz is None and (learned := latest_learned_links(place)):
                remarks.append(f"Not used: the antennas learned for {', '.join(learned)} have no level.")
            sources = {name: s for name, s in every.items() if s.tower in targets.towers} or every
        else:
            observed, about_logs = observe(known)
            sources = sources_of(known, observed)
            remarks += about_logs
        _check_shared(where, sources, targets.towers, "the flights received" if known else "the site has")
    work = f"{counted(len(targets.position_m), 'point')}: {', '.join(sources)}"
    stages.checked(lambda: [PlannedStage("choose, predict", work)])
    with stages("choose"):
        model = unflown or _best_model(targets, sources, known, place, remarks)
    with stages("predict"):
        receivers = _receivers(known, place, site)
        table = _table(targets, site, (sources, model, receivers), stages.progress)
    about = _model_fields(model, known, [receiver for receiver, _, _ in receivers.values()], table)
    cautioned = [f"{text}." for text in site.cautions(source.tower for source in sources.values())]
    page = pages.PredictionPage(
        name=targets.name,
        kind=targets.kind,
        heights_m=targets.heights_m,
        site=site,
        table=table,
        units={f"{s.tower} {s.channel}": s.unit for s in sources.values()},
        shape=None if targets.grid is None else targets.grid.shape,
        flown={f"{s.flight} {s.antenna}": track_m(s).T for source in sources.values() for s in source.samples},
        stages_s=stages.seconds,
        **about | {"warnings": (*cautioned, *about["warnings"], *remarks, *targets.remarks)},
    )
    return Prediction(page=page, targets=targets, model=model, sources=sources)


def _model_fields(
    model: Flown | Stored | Prior, known: Sequence[FlightData], receivers: Sequence[FittedReceiver], table: pd.DataFrame
) -> dict[str, Any]:
    """Return the fields of the page about the model and its training data."""
    guess = pages.outside_share(table)
    expected = (
        float(np.sqrt((table["slow_sd_db"] ** 2).mean())),
        float((table["q95_db"] - table["q05_db"]).mean()) / 2.0,
        pages.heading_words(table["yaw_deg"].to_numpy(np.float64)),
        float(table[P_LOCK].mean()) if P_LOCK in table else None,
    )
    logs, marks = ([getattr(receiver, key) for receiver in receivers] for key in (KEY, MARKS))
    fields: dict[str, Any] = {
        "flights": [data.settings.flight.name for data in known], KEY: union(*logs), MARKS: union(*marks),
        "candidates": [], "model": {},
    }  # fmt: skip
    if not isinstance(model, Flown):
        base = "prior" if isinstance(model, Prior) else "memory"
        fields["chosen"] = {"title": pages.TITLES[base], "base": base, "corrected": False, "field": OFF}
    if isinstance(model, Prior):
        origin = pages.PRIOR.format(carrier=model.link.carrier_hz / 1e9, power=model.link.transmit_power_dbm)
        verdict = pages.first_sentences(None, 0.0, *expected, origin=origin)
        off = outside_area(table[["east_m", "north_m"]].to_numpy(np.float64), model.site).mean()
        return fields | {"verdict": verdict, "warnings": pages.prior_cautions(PRIOR_SD_DB, float(off))}
    if isinstance(model, Stored):
        entries = {antenna.entry.command: antenna.entry for antenna in model.known.values()}.values()
        return fields | {
            "verdict": pages.first_sentences(None, guess, *expected),
            "warnings": [pages.OUTSIDE["remembered"].format(percent=100.0 * guess)] if guess > pages.MANY else [],
            "notes": pages.stored_model_notes([(m.entry, m.series) for m in model.known.values()]),
            "flights": [name for entry in entries for name in entry.flights],
            KEY: union(*(entry.trained_on for entry in entries), *logs),
            MARKS: union(*(end.marks for m in model.known.values() for end in (m.tower, m.uav)), *marks),
        }
    correction = model.correction
    key = correction.base, correction.title
    return fields | {
        "verdict": pages.first_sentences(correction, guess, *expected),
        "warnings": pages.cautions(correction, guess),
        "notes": pages.notes(correction),
        KEY: union(*map(flight_logs, known), *logs, *model.trained_on),
        MARKS: union(marks_of(known), *marks, *model.marks),
        "candidates": [
            {"base": pages.TITLES[base], "field": name, "rmse_db": correction.rmse_db[base, name], "crps_db": crps}
            for (base, name), crps in sorted(correction.crps_db.items(), key=lambda item: item[1])
        ],
        "model": asdict(correction.model),
        "chosen": {
            "title": f"{pages.TITLES[correction.base]}, {correction.title}",
            "base": correction.base,
            "corrected": correction.on,
            "field": correction.title,
            "sd_factor": correction.sd_factor,
            "rmse_db": correction.rmse_db[key],
            "crps_db": correction.crps_db[key],
            "left_out": "flights" if len(correction.flights) > 1 else "blocks",
        },
    }


# --- sources -------------------------------------------------------------------------------------------------------


def site_of(
    where: Path | None, flights: Sequence[NamedFlight], known: Sequence[FlightData], named: str | None = None
) -> tuple[Site, str | Path]:
    """Return the site of a prediction or plan: the named site, WHERE if it is a site, or the site of the flights.

    Parameters
    ----------
    where : Path or None
    flights : sequence of NamedFlight
    known : sequence of FlightData
        Data of the flights. All sites must have the same frame.
    named : str, optional
        ``--site``.

    Returns
    -------
    site : Site
    place : str or Path
        The site as an argument of :func:`~aerpaw_cmp.site.siteyaml.load_site`.

    Raises
    ------
    UsageError, InputError
        If there is no site, there are two sites, or a file does not exist.
    """
    if where is not None and where.suffix and not where.exists():
        raise InputError("no such file", expected="a site, a route, points or a flight.yaml", path=where)
    planned = None if where is None else flight_of(where)
    place: str | Path | None = named
    if place is None and where is not None and planned is None and (is_settings(where) or not where.exists()):
        place = str(where)
    if place is not None:
        site = load_site(place)
    elif known:
        site, place = known[0].site, site_place(flights[0].settings.site.file, flights[0].path.parent)
    elif where is not None and planned is not None:
        asked = unread(planned, where.parent)
        site, place = asked.site, asked.site_place
    else:
        raise UsageError("the site is not named", expected="--site SITE, or --with a flight")
    for data in known:
        east, north = site.frame.to_local(np.array([data.site.frame.latitude_deg]), [data.site.frame.longitude_deg])
        if np.hypot(east[0], north[0]) > 1.0:
            raise UsageError(
                f"flight {data.settings.flight.name} has site {data.site.name!r}, the prediction {site.name!r}",
                expected="flights of one site",
            )
    return site, place


def _unflown(where: Path, place: str | Path, site: Site, options: TargetOptions) -> Stored | Prior:
    """Return the model of a site without named flights: the levels learned for it, else ray tracing with a prior.

    The prior is used if the user names a carrier or a power, because learned levels include their own carrier and
    power.
    """
    stored = stored_model(place, site) if options.carrier_hz is None and options.tx_power_dbm is None else None
    if stored is not None:
        return stored
    stated, flight = site_model(place).coverage, flight_of(where)
    link = LinksSettings().rank if flight is None else flight.link.rss
    carrier_hz = options.carrier_hz or (stated.carrier_ghz or 0.0) * 1e9 or link.carrier_hz
    powers = (options.tx_power_dbm, stated.tx_power_dbm, link.transmit_power_dbm)
    budget = LinkBudget(tx_power_dbm=next(p for p in powers if p is not None))  # refuse a power in watts
    return Prior(site, LinkSettings(carrier_hz=carrier_hz, transmit_power_dbm=budget.tx_power_dbm))


def _check_shared(where: Path, sources: Mapping[str, Source], nodes: frozenset[str], who: str) -> None:
    """Raise UsageError if no source has one of the towers ``nodes`` (if there are any) and a band of the flight."""
    planned = flight_of(where)
    towers, bands = {s.tower for s in sources.values()}, {s.link.carrier_hz for s in sources.values()}
    links = [planned.link.rss, *planned.link.channels.values()] if planned is not None else []
    carriers = {link.carrier_hz for link in links if "carrier_hz" in link.model_fields_set}
    near = not carriers or any(abs(a / b - 1.0) <= CARRIER_BAND for a in carriers for b in bands)
    if (not nodes or nodes & towers) and near:
        return
    raise UsageError(
        f"{who} {', '.join(sorted(towers))} at {', '.join(f'{b / 1e9:g} GHz' for b in sorted(bands))}; "
        f"{where.name} needs {', '.join(sorted(nodes)) or 'any tower'}"
        + (f" at {', '.join(f'{c / 1e9:g} GHz' for c in sorted(carriers))}" if carriers else ""),
        expected="--with a flight that shares a tower and the band",
    )


def _best_model(
    targets: Targets, sources: Mapping[str, Source], known: Sequence[FlightData], place: str | Path, remarks: list[str]
) -> Flown:
    """Return the model with the best held-out predictions of the named flights.

    Parameters
    ----------
    targets : Targets
    sources : mapping of str to Source
    known : sequence of FlightData
    place : str or Path
        The site.
    remarks : list of str
        The function appends a remark about its choice.

    Returns
    -------
    Flown
    """
    samples = [s for source in sources.values() for s in source.samples]
    bases, learned = _bases(sources, known, place)
    beyond = bool(np.mean(outside(targets.position_m[targets.known], samples)) > 0.5)
    if beyond:
        remarks.append(
            "Most points are far from all flown positions, so spatial corrections with fitted lengths are not used."
        )
        bases.pop("none")
    correction = choose(samples, bases, STATED_FIELDS if beyond else ())
    used = learned.get(correction.base, ())
    return Flown(correction, sources, [item.trained_on for item in used], [item.marks for item in used])


def _bases(
    sources: Mapping[str, Source], known: Sequence[FlightData], place: str | Path
) -> tuple[dict[str, Base], dict[str, list[MeasuredPattern | FlightFile]]]:
    """Return the candidate models, and the learned patterns and settings that they use.

    A model that was learned from these flights is not a candidate, because it cannot be scored on them.
    """

    def each(gain: Callable[[Source, LinkSamples], FloatArray]) -> Base:
        return fixed_base(lambda s: gain(sources[s.antenna], s))

    bases: dict[str, Base] = {
        "learned": lambda train: by_degree(learned_antennas(train).predict),
        "free space": each(lambda _, s: np.zeros(len(s))),
        "none": each(lambda source, s: -source.free_space_db(s.position_m)),
    }
    links = [(s.link.build([s.tower], s.folder), s.folder) for s in sources.values()]
    near = {
        name: stored
        for name, stored in latest_learned_links(place).items()
        if name in sources and abs(stored.series.carrier_hz / sources[name].link.carrier_hz - 1.0) <= CARRIER_BAND
    }
    learned: dict[str, list[MeasuredPattern | FlightFile]] = {
        "replay": [
            *(p for link, folder in links for p in learned_patterns(link, folder, place)),
            *(data.settings for data in known),
        ],
        "memory": [end for stored in near.values() for end in (stored.tower, stored.uav)],
    }
    if not any(knows(data, learned["replay"]) for data in known):
        bases["replay"] = each(lambda source, s: source.replayed_db(s))
    if len(near) == len(sources) and not any(knows(data, learned["memory"]) for data in known):
        bases["memory"] = lambda _: by_degree(lambda s: near[s.antenna].gain_db(s))
    if len({s.flight for source in sources.values() for s in source.samples}) < 2:
        bases = {"free space": bases.pop("free space"), **bases}
    return bases, learned


# --- levels --------------------------------------------------------------------------------------------------------


def _table(
    targets: Targets,
    site: Site,
    learned: tuple[Mapping[str, Source], Flown | Stored | Prior, Receivers],
    progress: Progress,
) -> pd.DataFrame:
    """Return the table of a prediction: rows for every tower and channel, then rows for every receiver of ranks.

    Numbers are float32, because float64 would take gigabytes for a million points.

    Parameters
    ----------
    targets : Targets
    site : Site
    learned : tuple
        Sources, model, receivers.
    progress : callable

    Returns
    -------
    DataFrame
    """
    sources, model, receivers = learned
    level, slow, guess = _levels(targets, sources, model, progress)
    serving = _serving(level, slow, [source.channel for source in sources.values()])
    towers = pd.CategoricalDtype(list(dict.fromkeys([*(s.tower for s in sources.values()), *receivers])))
    channels = pd.CategoricalDtype(list(dict.fromkeys([*(s.channel for s in sources.values()), "rank"])))

    def rows(tower: str, channel: str, flag: IntArray, index: Any, values: Mapping[str, FloatArray]) -> pd.DataFrame:
        at, flags = targets.position_m[index], pd.CategoricalDtype(list(_FLAG_CODES))
        frame: pd.DataFrame = pd.DataFrame({
            "point": np.arange(len(targets), dtype=np.int32)[index],
            "time_s": targets.time_s[index],
            **dict(zip(("east_m", "north_m", "height_m"), at.T, strict=True)),
            "yaw_deg": targets.yaw_deg[index],
            "tower": pd.Series(tower, range(len(at)), dtype=towers),
            "channel": pd.Series(channel, range(len(at)), dtype=channels),
            **{name: np.asarray(value, dtype=np.float32) for name, value in values.items()},
            "flag": pd.Categorical.from_codes(flag, dtype=flags),
        })  # fmt: skip
        return frame

    parts, nothing = [], np.full(len(targets), np.nan, dtype=np.float32)
    for k, source in enumerate(sources.values()):
        values = _stated(model, source.antenna, level[k], slow[k]) | {"p_serving": serving[k]}
        values |= dict.fromkeys(RANKS, nothing) if receivers else {}
        flag = np.where(guess[k], _FLAG_CODES["outside_flown"], 0)
        flag[~np.isfinite(level[k])] = _FLAG_CODES["out_of_coverage"]
        flag[~targets.known] = _FLAG_CODES["no_position"]
        parts.append(rows(source.tower, source.channel, flag, slice(None), values))
    for tower, index, p in _ranks(targets, receivers, site, progress):
        values = dict(zip(RANKS, p.T, strict=True))
        parts.append(rows(tower, "rank", np.zeros(len(index), dtype=np.int64), index, values))
    table: pd.DataFrame = pd.concat(parts, ignore_index=True)
    return table


def _stated(model: Flown | Stored | Prior, antenna: str, level_db: AnyArray, slow_db: AnyArray) -> dict[str, AnyArray]:
    """Return the columns (n,) of a level: median, SD, interval, and P(lock) if the receiver can lose its lock."""
    lock = model.lost_lock(antenna, level_db) if isinstance(model, Stored) else None
    if lock is None:
        fading = model.fading(antenna)
        half, sd = fading.half_width_db(slow_db, BAND), fading.total_db(slow_db)
        ends = {"level_db": level_db, "sd_db": sd, "q05_db": level_db - half, "q95_db": level_db + half}
        return ends | {"slow_sd_db": slow_db}
    low, middle, high = (lock.quantile_db(share) for share in (0.5 - 0.5 * BAND, 0.5, 0.5 + 0.5 * BAND))
    sd = lock.sd_db(middle)  # means over 4 s have the same SD, because a loss of lock lasts longer than 4 s
    ends = {"level_db": level_db + middle, "sd_db": sd, "q05_db": level_db + low, "q95_db": level_db + high}
    parts = {"locked_db": level_db + lock.locked_db, "lost_db": level_db + lock.lost_db}
    spreads = {f"{name}_sd_db": np.full(len(sd), getattr(lock, f"{name}_sd_db")) for name in ("locked", "lost")}
    return ends | {"slow_sd_db": sd, P_LOCK: lock.probability} | parts | spreads


def _levels(
    targets: Targets, sources: Mapping[str, Source], model: Flown | Stored | Prior, progress: Progress
) -> tuple[AnyArray, AnyArray, BoolArray]:
    """Return level, standard deviation of 4 s means (series, n) [dB], and True where the model extrapolates.

    All headings have equal weights if the heading is unknown.
    """
    level, slow = np.full((2, len(sources), len(targets)), np.nan, dtype=np.float32)
    guess: BoolArray = np.zeros(level.shape, dtype=np.bool_)
    for k, source in enumerate(sources.values()):
        for rows, share in _in_parts(targets):
            position, yaw = targets.position_m[rows], targets.yaw_deg[rows]
            up = np.broadcast_to(targets.up, targets.position_m.shape)[rows]
            each = [source.targets(position, np.where(np.isfinite(yaw), yaw, turn), up) for turn in _turns(yaw)]
            level[k, rows], slow[k, rows], guess[k, rows] = model.levels(each)
            level[k, rows] += source.free_space_db(position)
            progress(f"predict {source.antenna}", share)
    return level, slow, guess


def _in_parts(targets: Targets) -> Iterator[tuple[IntArray, float]]:
    """Yield blocks of neighbouring targets with a position, and the share of targets that is done after each block."""
    known = np.flatnonzero(targets.known)
    tile = np.floor(targets.position_m[known, :2] / _TILE_M)
    known = known[np.lexsort(tile.T)]
    for start in range(0, len(known), AT_ONCE):
        rows = known[start : start + AT_ONCE]
        yield rows, (start + len(rows)) / len(known)


def _turns(yaw_deg: FloatArray) -> FloatArray:
    """Return the headings that are tried for unknown headings [deg], or a single value if all headings are known."""
    count = 1 if np.isfinite(yaw_deg).all() else HEADINGS
    return np.asarray(np.arange(count) * (360.0 / HEADINGS))


def _serving(level: AnyArray, slow: AnyArray, channels: Sequence[str]) -> AnyArray:
    """Return the probability (series, n) that each tower is the strongest of its channel.

    The method is Gauss-Hermite quadrature over the level of the tower. The levels of towers are independent.
    """
    from scipy.special import ndtr

    # for a given level of the tower, multiply the probabilities that the other towers are weaker
    nodes, weight = np.polynomial.hermite_e.hermegauss(24)
    out: AnyArray = np.where(np.isfinite(level), np.float32(1.0), np.float32(np.nan))
    # a tower without a path never serves
    filled, sd = np.nan_to_num(level, nan=-1e9), np.nan_to_num(slow, nan=1.0)
    for k, channel in enumerate(channels):
        others = [j for j, name in enumerate(channels) if name == channel and j != k]
        if not others:
            continue
        total = np.zeros(level.shape[1])
        for node, w in zip(nodes, weight / weight.sum(), strict=True):
            at = filled[k] + node * sd[k]
            total += w * np.prod([ndtr((at - filled[j]) / sd[j]) for j in others], axis=0)
        out[k] *= total
    return out


# --- ranks ---------------------------------------------------------------------------------------------------------


def _receivers(known: Sequence[FlightData], place: str | Path, site: Site) -> Receivers:
    """Return the receivers that the flights name or that are stored for the site, by tower."""
    out: dict[str, tuple[FittedReceiver, LinkSettings, Path]] = {}
    for data in known:
        if data.settings.rank.receiver is not None:
            for tower, fitted in read_receiver(data.folder / data.settings.rank.receiver).items():
                out.setdefault(tower, (fitted, data.settings.link.rank, data.folder))
    link, folder = LinksSettings().rank, Path()
    if known:
        link, folder = known[0].settings.link.rank, known[0].folder
    for entry in read_learned(place).entries.values():
        for file in dict.fromkeys(receiver.file for receiver in entry.receivers):
            for tower, fitted in read_receiver(folder_of(place) / file).items():
                out.setdefault(tower, (fitted, link, folder))
    return {tower: fitted for tower, fitted in out.items() if tower in site.towers}


def _ranks(
    targets: Targets, receivers: Receivers, site: Site, progress: Progress
) -> Iterator[tuple[str, IntArray, FloatArray]]:
    """Yield tower, rows (n,) of the targets and probabilities (n, 4) of the ranks for every receiver.

    If there are more targets than :data:`MOST_RANKED`, each has the probabilities of the nearest ranked target.
    """
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(targets.known)
    some = rows[:: -(-len(rows) // MOST_RANKED)]
    for tower, (receiver, settings, folder) in receivers.items():
        link = settings.build([tower], folder)
        if {len(link.uav_array), len(link.tower_arrays[tower])} != {4}:
            continue
        position, yaw, each = targets.position_m[some], targets.yaw_deg[some], []
        turns = _turns(yaw).tolist()
        few = len(some) * len(turns) <= MOST_RANKED  # rank few targets at all headings at once, to limit memory
        asked = [turns] if few and not np.isfinite(yaw).any() else [[turn] for turn in turns]
        for together in asked:
            heading = np.where(np.isfinite(yaw), yaw, together[0])
            samples = RankSamples(
                flight="",
                tower=tower,
                tower_m=np.asarray(site.towers[tower].position_m),
                poses=Poses(position, rotation_from_aircraft(0.0 * heading, 0.0 * heading, heading)),
                rank=np.full(len(some), np.nan),
                link=link,
                # set points of a grid hours apart, so that a receiver that averages over seconds does not mix them
                time_s=targets.time_s[some] if targets.kind == "route" else 1e4 * np.arange(float(len(some))),
            )
            each.append(receiver.forecast(samples, [turn - together[0] for turn in together])[0])
            progress(f"predict rank {tower}", len(each) / len(asked))
        p = np.mean(each, axis=0)
        if len(some) < len(rows):
            p = p[cKDTree(_place_and_nose(targets, some)).query(_place_and_nose(targets, rows))[1]]
        yield tower, rows, p


def _place_and_nose(targets: Targets, rows: IntArray) -> FloatArray:
    """Return position and heading (n, 5), scaled so that equal distances [m] change ranks equally."""
    yaw = np.radians(np.nan_to_num(targets.yaw_deg[rows]))
    return np.column_stack([targets.position_m[rows], _NOSE_M * np.sin(yaw), _NOSE_M * np.cos(yaw)])


def run_predict(
    where: Path, flights: Sequence[Path], target: TargetOptions, options: RunOptions = DEFAULT
) -> JobOutcome:
    """Predict and write ``prediction.csv``, ``.nc``, ``.html`` and figures.

    Parameters
    ----------
    where : Path
        See :func:`.sources.find_targets`.
    flights : sequence of Path
        Flight files, or calibration.yaml files that list flight files. If there are none, the learned levels of the
        site are used.
    target : TargetOptions
    options : RunOptions
        ``out`` is ``reports/prediction-NAME`` by default.

    Returns
    -------
    JobOutcome
    """
    known = named_flights(flights)
    if known and (target.carrier_hz is not None or target.tx_power_dbm is not None):
        raise UsageError(
            "--with and --carrier-ghz or --tx-power-dbm", expected="only --with: flights state carrier and power"
        )
    inputs = [*target_files(where, target.site, options.logs_root), *files_of(known, options.logs_root)]
    folder = options.out or Path("reports") / f"prediction-{where.stem}"
    stages = options.stages("predict", inputs, folder)
    with OutputFolder(folder, job="predict", inputs=inputs, force=options.force) as output:
        prediction = predict(where, known, target, logs_root=options.logs_root, stages=stages)
        with output.filling() as place:
            options.progress("page")
            written, remarks = pages.write_prediction(prediction.page, place)
        for text in remarks:
            options.progress(text)
        return JobOutcome(
            folder=folder, metrics=pages.prediction_metrics(prediction.page), files=output.placed(written)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectedLevel:
    """The levels of one tower and channel at one height, each (n,) in index order. ``raw_dbm`` is for heading north."""

    link: str
    height_m: float
    raw_dbm: FloatArray
    corrected_dbm: FloatArray
    sd_db: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectedMaps:
    """All corrected maps of a run, and the page of the prediction.

    ``ranks`` contains probabilities (n, 4) by tower and height, NaN where unknown.
    """

    levels: tuple[CorrectedLevel, ...]
    ranks: dict[tuple[str, float], FloatArray]
    prediction: pages.PredictionPage

    def layers(self, grid: Grid) -> Iterator[Layer]:
        """Yield the layers of page and files: corrected and raw level, and standard deviation."""
        for item in self.levels:
            layer = partial(Layer, link=item.link, height_m=item.height_m)
            for version, values in (("corrected", item.corrected_dbm), ("raw", item.raw_dbm)):
                yield layer(
                    name=f"rss_{version}", quantity="RSS, raw and corrected", unit="dBm", version=version,
                    values=grid.raster(values),
                )  # fmt: skip
            yield layer(name="rss_sd", quantity="SD of the corrected RSS", unit="dB", values=grid.raster(item.sd_db))

    def rss_maps(self, grid: Grid) -> Iterator[page.RssMap]:
        """Yield the maps and distributions of raw and corrected levels for figures."""
        for version in ("raw", "corrected"):
            for item in self.levels:
                values = item.raw_dbm if version == "raw" else item.corrected_dbm
                yield page.RssMap(
                    tower=item.link,
                    antennas=version,
                    height_m=item.height_m,
                    values=grid.raster(values),
                    coverage=float(np.isfinite(values).mean()),
                )

    def rank_maps(self, grid: Grid) -> Iterator[page.RankMap]:
        """Yield the most probable rank for figures and the linked map, with mean probabilities as shares."""
        for (tower, height), p in self.ranks.items():
            share = np.concatenate([[np.isnan(p[:, 0]).mean()], np.nan_to_num(p).mean(axis=0)])
            rank = likeliest(p)
            values = grid.raster(np.where(rank > 0, rank, np.nan))
            yield page.RankMap(name="rank_learned", height_m=height, values=values, share=share, tower=tower)


def likeliest(p: FloatArray) -> FloatArray:
    """Return the most probable rank (n,) for probabilities (n, 4), 0 if they are NaN."""
    return np.where(np.isnan(p[:, 0]), 0, np.nan_to_num(p).argmax(axis=1) + 1)


def corrected_maps(
    site: str,
    spacing_m: float,
    heights_m: tuple[Sequence[float], Sequence[float]],
    flights: Sequence[NamedFlight],
    logs_root: Path | None = None,
    stages: Stages | None = None,
) -> CorrectedMaps:
    """Predict the grid of a map from flights, and replay the same links without correction.

    Parameters
    ----------
    site : str
        The site, as for the command ``map``.
    spacing_m : float
    heights_m : (sequence of float, sequence of float)
        Heights at which levels are predicted, and heights at which ranks are predicted.
    flights : sequence of NamedFlight
        Flights to learn from.
    logs_root : Path, optional
    stages : Stages, optional

    Returns
    -------
    CorrectedMaps

    Raises
    ------
    UsageError, InputError
        The same as in :func:`predict`.
    """
    options = TargetOptions(heights_m=tuple(sorted({*heights_m[0], *heights_m[1]})), spacing_m=spacing_m)
    prediction = predict(Path(site), flights, options, logs_root=logs_root, stages=stages)
    grid = prediction.targets.grid
    assert grid is not None
    levels = (level for source in prediction.sources.values() for level in _map_levels(prediction, source, len(grid)))
    return CorrectedMaps(
        levels=tuple(level for level in levels if level.height_m in heights_m[0]),
        ranks={key: p for key, p in _map_ranks(prediction, len(grid)) if key[1] in heights_m[1]},
        prediction=prediction.page,
    )


def _map_levels(prediction: Prediction, source: Source, n: int) -> Iterator[CorrectedLevel]:
    table = prediction.table
    mine = table[(table["tower"] == source.tower) & (table["channel"] == source.channel)]
    position = prediction.targets.position_m
    raw = source.replayed_db(source.targets(position, np.zeros(len(position)))) + source.free_space_db(position)
    assert isinstance(prediction.model, Flown)  # only named flights correct a map
    level = mine["level_db"].to_numpy() - prediction.model.offset_db(source.antenna)
    for k, height in enumerate(prediction.targets.heights_m):
        part = slice(k * n, (k + 1) * n)
        yield CorrectedLevel(
            link=source.antenna.replace(".", " ", 1),
            height_m=height,
            raw_dbm=raw[part],
            corrected_dbm=level[part],
            sd_db=mine["sd_db"].to_numpy()[part],
        )


def _map_ranks(prediction: Prediction, n: int) -> Iterator[tuple[tuple[str, float], FloatArray]]:
    ranks = prediction.table[prediction.table["channel"] == "rank"]
    for tower, rows in ranks.groupby("tower", sort=False, observed=True):
        p = np.full((len(prediction.targets), 4), np.nan)
        p[rows["point"].to_numpy()] = rows[list(RANKS)].to_numpy()
        for k, height in enumerate(prediction.targets.heights_m):
            yield (str(tower), height), p[k * n : (k + 1) * n]

"""The ``predict`` job: level, its interval, probabilities and ranks where nobody has flown yet."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ...common.errors import InputError, UsageError
from ...common.provenance import union
from ...common.stages import Progress, Stages
from ...common.units import BoolArray, FloatArray, IntArray
from ...compare.calibration import Observed
from ...compare.correction import BIN_S, Base, Correction, Predictor, between_blocks_db, choose, fixed_base
from ...compare.direction_gain import LinkSamples
from ...compare.spread import BAND, Spread, fading_of
from ...flight.data import FlightData, RssSeries, load_data
from ...flight.learned_gain import pair_db
from ...flight.replay import replay_poses
from ...flight.settings import load_flight
from ...flight.track import body_rotation
from ...flight.training import common, counted_once, flight_logs, learned_patterns
from ...propagation.arrays import Poses
from ...propagation.field.baselines import free_space_dbm
from ...report.prediction_words import first_words
from ...site.learned import BAND as CARRIER_BAND
from ...site.learned import folder_of, read_learned
from ...site.site import Site
from ...site.siteyaml import load_site
from ..benchmarks.entrants import learned_base
from ..learning.calibrate import observe
from ..learning.calibrate_rank import FittedReceiver, RankSamples, read_receiver
from .where import Asked, Targets, find_targets, flight_of, is_settings, level_samples

HEADINGS = 8
"""Directions of the nose that count alike where it is not known."""

HULL_M = 60.0
HULL_UP_M = 20.0
"""Targets further than this from every sample that is known are flagged, horizontally and in height [m]."""

AT_ONCE = 50_000
"""Targets that are predicted together: bounds the memory."""

REPLAYED_AT_ONCE = 20_000

MOST_DIRECTIONS = 5_000
"""Of more targets at a time, learned antennas are evaluated once per degree of direction."""

RANKS = ("p_rank1", "p_rank2", "p_rank3", "p_rank4")


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Link of one tower and channel, as the first flight that has it describes it."""

    data: FlightData
    series: RssSeries

    @property
    def antenna(self) -> str:
        """``tower.channel``."""
        return f"{self.series.tower}.{self.series.channel}"

    @property
    def tower_m(self) -> FloatArray:
        """Place of the array (3,)."""
        return np.asarray(self.data.site.towers[self.series.tower].position_m)

    def free_space_db(self, position_m: FloatArray) -> FloatArray:
        """Level (n,) of free space [dBm]."""
        link = self.series.link
        place = self.tower_m[None, :]
        return np.asarray(free_space_dbm(place, position_m, link.carrier_hz, link.transmit_power_dbm)[:, 0])

    def samples(self, position_m: FloatArray, yaw_deg: FloatArray) -> LinkSamples:
        """Targets (n,) of a level aircraft as samples without a level."""
        end = self.series.tower, self.series.channel
        return level_samples(end, self.tower_m, position_m, yaw_deg, np.zeros(len(yaw_deg)))

    def replayed_db(self, samples: LinkSamples) -> FloatArray:
        """Replayed level above free space (n,) of a level aircraft [dB]; NaN without a path."""
        data, series = self.data, self.series
        link = series.link.build([series.tower], data.folder)
        body, world = samples.at_uav, -samples.at_tower
        turn = np.arctan2(world[:, 1], world[:, 0]) - np.arctan2(body[:, 1], body[:, 0])
        flat = np.zeros(len(turn))
        known = data.settings.rt.attitude != "ignored"
        rotation = body_rotation(flat, flat, 90.0 - np.degrees(turn) if known else flat + 90.0)
        level = np.empty(len(samples))
        for start in range(0, len(samples), REPLAYED_AT_ONCE):
            part = slice(start, start + REPLAYED_AT_ONCE)
            poses = Poses(samples.position_m[part], rotation[part])
            replayed = replay_poses(data.site, data.settings.rt, link, poses)
            field = replayed.rss_dbm if data.settings.rss.field == "coherent" else replayed.rss_power_dbm
            level[part] = field[:, 0] + pair_db(link, poses, self.tower_m[None, :])
        return np.asarray(level - self.free_space_db(samples.position_m))


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """All that a run of ``predict`` found; ``table`` has a row per target, tower and channel (and receiver)."""

    targets: Targets
    site: Site
    table: pd.DataFrame
    correction: Correction
    sources: Mapping[str, Source]
    trained_on: tuple[str, ...]
    flights: tuple[str, ...]
    threshold_db: float | None
    warnings: tuple[str, ...]
    samples: Sequence[LinkSamples]

    @property
    def key(self) -> tuple[str, str]:
        """Of the base and the residual field that were chosen."""
        return self.correction.base, self.correction.title

    @property
    def sentence(self) -> str:
        """First words of terminal and page."""
        return first_words(self.correction, self.outside)

    def _repr_html_(self) -> str:
        """First words and the first points for notebooks."""
        points = str(self.table.head(10).round(2).to_html(index=False, border=0))
        return f"<p>{escape(self.sentence)}</p>{points}"

    @property
    def outside(self) -> float:
        """Share of the points beyond the flown places."""
        levels = self.table[self.table["channel"] != "rank"]
        return float((levels["flag"] == "outside_flown").mean())


def predict(
    where: Path,
    flights: Sequence[Path],
    asked: Asked | None = None,
    *,
    threshold_db: float | None = None,
    logs_root: Path | None = None,
    stages: Stages | None = None,
) -> Prediction:
    """Predict levels and ranks at the places that WHERE names.

    Parameters
    ----------
    where : Path
        See :func:`.where.find_targets`.
    flights : sequence of Path
        Flight files to learn from.
    asked : Asked, optional
    threshold_db : float, optional
        P(level > threshold) is given for it, in the unit of the logs.
    logs_root : Path, optional
        Where logs resolve.
    stages : Stages, optional

    Returns
    -------
    Prediction

    Raises
    ------
    UsageError, InputError
        No flight that shares a tower and band, no place to predict.
    """
    stages = stages or Stages()
    with stages("read"):
        planned = flight_of(where)
        datas = [load_data(load_flight(path), path.parent, logs_root) for path in flights]
        if not datas:
            raise UsageError(
                "no flight to learn from", expected="--with flight.yaml (repeatable), a flight of this site"
            )
        known, said = counted_once(datas)
        observed, warnings = observe(known)
        site = site_of(where, known)
        _check_shared(where, planned, known, site)
        targets = find_targets(where, site, asked or Asked(), logs_root)
    sources = sources_of(known, observed)
    with stages("choose"):
        samples = [o.samples for o in observed if o.samples.antenna in sources]
        beyond = bool(np.mean(_outside(targets, samples)[targets.known]) > 0.5)
        bases = _bases(sources, known, samples)
        if beyond:
            said = [*said, "Most points lie outside the flown places: models that remember places are left out."]
            bases.pop("none")
        correction = choose(samples, bases, beyond=beyond)
    with stages("predict"):
        parts = [
            _levels(targets, source, correction, samples, threshold_db, stages.progress) for source in sources.values()
        ]
        table = pd.concat(parts, ignore_index=True)
        table["p_serving"] = _serving(table, len(targets), len(parts))
        receivers = _receivers(known, site)
        ranks = _ranks(targets, receivers, site)
        table = pd.concat([table, *ranks], ignore_index=True).reindex(columns=_columns(table, bool(ranks)))
    notes = [w for w in warnings if "scored" not in w]
    return Prediction(
        targets=targets,
        site=site,
        table=table,
        correction=correction,
        sources=sources,
        trained_on=union(*map(flight_logs, known), *(one.trained_on for one, _ in receivers.values())),
        flights=tuple(data.settings.flight.name for data in known),
        threshold_db=threshold_db,
        warnings=(*said, *notes, *targets.remarks),
        samples=samples,
    )


def site_of(where: Path, known: Sequence[FlightData]) -> Site:
    """Of WHERE where it is a site, else of the flights; all must share a frame."""
    site = known[0].site
    if where.suffix and not where.exists():
        raise InputError("no such file", expected="a site, a route, points or a flight.yaml", path=where)
    if (is_settings(where) and flight_of(where) is None) or not where.exists():
        site = load_site(where if where.is_file() else str(where))
    for data in known:
        east, north = site.frame.to_local(np.array([data.site.frame.latitude_deg]), [data.site.frame.longitude_deg])
        if np.hypot(east[0], north[0]) > 1.0:
            raise UsageError(
                f"flight {data.settings.flight.name} has site {data.site.name!r}, the prediction {site.name!r}",
                expected="flights of one site",
            )
    return site


def _check_shared(where: Path, planned: Any, known: Sequence[FlightData], site: Site) -> None:
    """UsageError where the flights share no tower with the site, or none with the planned flight and its band."""
    towers = {s.tower for data in known for s in data.rss}
    bands = {s.link.carrier_hz for data in known for s in data.rss}
    wanted = {log.node for log in planned.logs if log.node} if planned is not None else set(site.towers) | towers
    links = [planned.link.rss, *planned.link.channels.values()] if planned is not None else []
    carriers = {link.carrier_hz for link in links if "carrier_hz" in link.model_fields_set}
    near = not carriers or any(abs(a / b - 1.0) <= CARRIER_BAND for a in carriers for b in bands)
    if (not wanted or wanted & towers) and near:
        return
    heard = ", ".join(f"{t}" for t in sorted(towers)) or "no tower"
    raise UsageError(
        f"the flights heard {heard} at {', '.join(f'{b / 1e9:g} GHz' for b in sorted(bands)) or 'no band'}; "
        f"{where.name} asks for {', '.join(sorted(wanted)) or 'any tower'}"
        + (f" at {', '.join(f'{c / 1e9:g} GHz' for c in sorted(carriers))}" if carriers else ""),
        expected="--with a flight that shares a tower and the band",
    )


def sources_of(known: Sequence[FlightData], observed: Sequence[Observed]) -> dict[str, Source]:
    """Towers that stand still and their channels that a flight heard, by antenna."""
    heard = {o.samples.antenna for o in observed if np.isfinite(o.samples.residual_db).any()}
    out: dict[str, Source] = {}
    for data in known:
        for series in data.rss:
            source = Source(data=data, series=series)
            if source.antenna in heard and series.tower not in data.nodes and series.unit != "dB":
                out.setdefault(source.antenna, source)
    if not out:
        raise InputError("no flight has levels of a tower that stands still", expected="RSS logs with positions")
    return out


def _bases(
    sources: Mapping[str, Source], known: Sequence[FlightData], samples: Sequence[LinkSamples]
) -> dict[str, Base]:
    """Models that may carry the prediction; those that learned from these very flights elsewhere are left out."""

    def each(gain: Callable[[Source, LinkSamples], FloatArray]) -> Base:
        return fixed_base(lambda s: gain(sources[s.antenna], s))

    bases: dict[str, Base] = {
        "learned": lambda train: _by_degree(learned_base(train)),
        "free space": each(lambda _, s: np.zeros(len(s))),
        "none": each(lambda source, s: -source.free_space_db(s.position_m)),
    }
    logs = union(*map(flight_logs, known))
    learned = [
        p.trained_on
        for source in sources.values()
        for p in learned_patterns(source.series.link.build([source.series.tower], source.data.folder))
    ]
    if not common(logs, [*learned, *(data.settings.trained_on for data in known)]):
        bases["replay"] = each(lambda source, s: source.replayed_db(s))
    if len({s.flight for s in samples}) < 2:
        bases = {"free space": bases.pop("free space"), **bases}
    return bases


def _by_degree(predictor: Predictor) -> Predictor:
    """A model of directions that takes many samples a degree at a time (gains have lengths of 11 degrees and more).

    What a degree has is kept: later parts of a run, and other headings, ask for much the same directions.
    """
    known: dict[str, tuple[IntArray, FloatArray]] = {}

    def predict(samples: LinkSamples) -> tuple[FloatArray, FloatArray]:
        if len(samples) <= MOST_DIRECTIONS:
            return predictor(samples)
        cells = np.zeros(len(samples), dtype=np.int64)
        for ray in (samples.at_tower, samples.at_uav):
            for angle in (np.arctan2(ray[:, 1], ray[:, 0]), np.arcsin(np.clip(ray[:, 2], -1.0, 1.0))):
                cells = 361 * cells + np.round(np.degrees(angle)).astype(np.int64) + 180
        asked, first, member = np.unique(cells, return_index=True, return_inverse=True)
        keys, values = known.get(samples.antenna, (np.zeros(0, dtype=np.int64), np.zeros((2, 0))))
        new = ~np.isin(asked, keys)
        if new.any():
            keys, values = np.append(keys, asked[new]), np.hstack([values, predictor(samples.part(first[new]))])
            order = np.argsort(keys)
            keys, values = known[samples.antenna] = keys[order], values[:, order]
        gain, sd = values[:, np.searchsorted(keys, asked)[member.ravel()]]
        return gain, sd

    return predict


# --- levels --------------------------------------------------------------------------------------------------------


def _levels(
    targets: Targets,
    source: Source,
    correction: Correction,
    samples: Sequence[LinkSamples],
    threshold_db: float | None,
    progress: Progress,
) -> pd.DataFrame:
    """Rows of one tower and channel."""
    n, mine = len(targets), [s for s in samples if s.antenna == source.antenna]
    sd_db, kurtosis = fading_of(mine, BIN_S)
    fading = Spread(own_sd_db=0.0, noise_sd_db=0.0, fading_sd_db=sd_db, fading_kurtosis=kurtosis, bin_s=BIN_S)
    level, slow = np.full((2, n), np.nan)
    good = np.flatnonzero(targets.known)
    for start in range(0, len(good), AT_ONCE):
        rows = good[start : start + AT_ONCE]
        level[rows], slow[rows] = _over_headings(targets, rows, source, correction)
        progress(f"predict {source.antenna}", (start + len(rows)) / len(good))
    beyond = between_blocks_db(correction.channels[source.antenna])
    slow = np.where(_outside(targets, mine), np.hypot(slow, beyond), slow)
    half = fading.half_width_db(slow, BAND)
    frame: pd.DataFrame = pd.DataFrame(
        {
            "point": np.arange(n),
            "time_s": targets.time_s,
            **dict(zip(("east_m", "north_m", "height_m"), targets.position_m.T, strict=True)),
            "yaw_deg": targets.yaw_deg,
            "tower": source.series.tower,
            "channel": source.series.channel,
            "level_db": level,
            "sd_db": fading.total_db(slow),
            "slow_sd_db": slow,
            "q05_db": level - half,
            "q95_db": level + half,
        }
    )
    if threshold_db is not None:
        from scipy.special import ndtr

        frame["p_above"] = ndtr((level - threshold_db) / frame["sd_db"].to_numpy())
    frame["flag"] = _flags(targets, mine, level)
    return frame


def _over_headings(
    targets: Targets, rows: Any, source: Source, correction: Correction
) -> tuple[FloatArray, FloatArray]:
    """Level and standard deviation of 4 s means (m,); all headings count alike where none is known."""
    position, yaw = targets.position_m[rows], targets.yaw_deg[rows]
    free = source.free_space_db(position)
    each = [source.samples(position, np.where(np.isfinite(yaw), yaw, turn)) for turn in _turns(yaw)]
    level, sd = correction.over_headings(each, whole=int(targets.known.sum()))
    return free + level, sd


def _turns(yaw_deg: FloatArray) -> FloatArray:
    """Headings that count alike where one is not known [deg]."""
    count = 1 if np.isfinite(yaw_deg).all() else HEADINGS
    return np.asarray(np.arange(count) * (360.0 / HEADINGS))


def _outside(targets: Targets, flown: Sequence[LinkSamples]) -> BoolArray:
    """Targets (n,) that are further than :data:`HULL_M` or :data:`HULL_UP_M` from every sample."""
    from scipy.spatial import cKDTree

    scaled = np.array([HULL_M, HULL_M, HULL_UP_M])
    places = np.concatenate([s.position_m for s in flown])
    out = np.zeros(len(targets), dtype=np.bool_)
    out[targets.known] = cKDTree(places / scaled).query(targets.position_m[targets.known] / scaled)[0] > 1.0
    return out


def _flags(targets: Targets, mine: Sequence[LinkSamples], level: FloatArray) -> list[str]:
    """Flag of each target for the reader: empty, or why its level is a guess or missing."""
    flag = np.where(_outside(targets, mine), "outside_flown", "").astype(object)
    flag[~targets.known] = "no_position"
    flag[targets.known & ~np.isfinite(level)] = "out_of_coverage"
    return list(flag)


def _serving(table: pd.DataFrame, n: int, series: int) -> FloatArray:
    """Probability that each row's tower is the strongest at its target, among the towers of its channel.

    By Gauss-Hermite quadrature over the row's own level; levels of towers are taken as independent.
    """
    from scipy.special import ndtr

    nodes, weight = np.polynomial.hermite_e.hermegauss(24)
    out = np.ones(len(table))
    groups = [table["channel"].iloc[k * n] for k in range(series)]
    level, sd = (np.nan_to_num(table[c].to_numpy().reshape(series, n), nan=f)
                 for c, f in (("level_db", -1e9), ("slow_sd_db", 1.0)))  # fmt: skip
    for k in range(series):
        total = np.zeros(n)
        others = [j for j in range(series) if groups[j] == groups[k] and j != k]
        for node, w in zip(nodes, weight / weight.sum(), strict=True):
            at = level[k] + node * sd[k]
            total += w * np.prod([ndtr((at - level[j]) / sd[j]) for j in others], axis=0)
        out[k * n : (k + 1) * n] = total
    return np.where(np.isfinite(table["level_db"]), out, np.nan)


# --- ranks ---------------------------------------------------------------------------------------------------------


def _receivers(known: Sequence[FlightData], site: Site) -> dict[str, tuple[FittedReceiver, FlightData]]:
    """Receivers that the flights name or the site remembers, by tower, with the flight that says the arrays."""
    out: dict[str, tuple[FittedReceiver, FlightData]] = {}
    for data in known:
        if data.settings.rank.receiver is not None:
            for tower, one in read_receiver(data.folder / data.settings.rank.receiver).items():
                out.setdefault(tower, (one, data))
    memory = read_learned(known[0].settings.site.file)
    for entry in memory.entries.values():
        for remembered in entry.receivers:
            path = folder_of(known[0].settings.site.file) / remembered.file
            for tower, one in read_receiver(path).items():
                out.setdefault(tower, (one, known[0]))
    return {tower: one for tower, one in out.items() if tower in site.towers}


def _ranks(
    targets: Targets, receivers: Mapping[str, tuple[FittedReceiver, FlightData]], site: Site
) -> list[pd.DataFrame]:
    """Rows of every tower with a receiver."""
    out = []
    rows = np.flatnonzero(targets.known)
    for tower, (receiver, data) in receivers.items():
        if not len(rows):
            continue
        position, yaw = targets.position_m[rows], targets.yaw_deg[rows]
        link = data.settings.link.rank.build([tower], data.folder)
        if {len(link.uav_array), len(link.tower_arrays[tower])} != {4}:
            continue
        each = []
        for turn in _turns(yaw):
            heading = np.where(np.isfinite(yaw), yaw, turn)
            samples = RankSamples(
                flight="",
                tower=tower,
                tower_m=np.asarray(site.towers[tower].position_m),
                poses=Poses(position, body_rotation(0.0 * heading, 0.0 * heading, heading)),
                rank=np.full(len(rows), np.nan),
                link=link,
                time_s=targets.time_s[rows] if targets.kind == "route" else 1e4 * np.arange(float(len(rows))),
            )
            each.append(receiver.forecast(samples)[0])
        p = np.mean(each, axis=0)
        frame: pd.DataFrame = pd.DataFrame(
            {
                "point": rows,
                "time_s": targets.time_s[rows],
                **dict(zip(("east_m", "north_m", "height_m"), position.T, strict=True)),
                "yaw_deg": yaw,
                "tower": tower,
                "channel": "rank",
                **dict(zip(RANKS, p.T, strict=True)),
                "flag": "",
            }
        )
        out.append(frame)
    return out


def _columns(table: pd.DataFrame, ranked: bool) -> list[str]:
    names = [name for name in table.columns if name not in ("flag", "slow_sd_db")]
    return [*names, "slow_sd_db", *(RANKS if ranked else ()), "flag"]

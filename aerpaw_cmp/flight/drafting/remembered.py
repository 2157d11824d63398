"""Learned antennas of a site for a flight: those that the levels of the flight itself support."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...common.errors import InputError, UsageError
from ...common.jsonable import named
from ...common.units import FloatArray
from ...compare.gains.direction_gain import LinkSamples
from ...compare.gains.evidence import LEAST_ODDS, MAST, Evidence, FlightEvidence, KnownProcess, table_moments
from ...compare.gains.spread import Spread
from ...site.antenna import learned
from ...site.antenna.known_directions import KnownDirections, read_known
from ...site.antenna.named import check_logs
from ...site.antenna.pair_gain import read_pair
from ...site.antenna.sphere_pattern import SpherePattern, read_sphere_csv
from ..data import RATIOS, FlightData, RssSeries, quantity_of
from ..gains.learned_gain import pair_and_sd_db, sphere_angles, spread_of
from ..gains.memory import with_learned
from ..marks import among
from ..observed import observed_series
from ..settings import FlightFile
from ..training import flight_logs, marks_of

if TYPE_CHECKING:
    from .node import Taught


@dataclass(frozen=True, kw_only=True)
class Remembered:
    """Learned antennas of one tower and channel of a site."""

    name: str
    """Of the entry."""
    entry: learned.Entry
    series: learned.LearnedSeries
    tower: SpherePattern
    uav: SpherePattern
    known: KnownDirections

    @property
    def level(self) -> learned.LearnedLevel:
        """Level of the log; only of series that have it."""
        assert self.series.level is not None
        return self.series.level

    @property
    def spread(self) -> Spread:
        """Error model of a level besides the standard deviation of the gains."""
        return spread_of(self.series.spread)

    @property
    def prior_variance_db2(self) -> float:
        """Variance of the gains of both ends in directions that nobody has flown."""
        return self.tower.largest_sd_db**2 + self.uav.largest_sd_db**2

    @cached_property
    def airframe(self) -> KnownProcess:
        """Gain of the UAV with its covariance."""
        return KnownProcess(
            gain_db=lambda at: self.uav.gain_dbi(*sphere_angles(at)),
            sd_db=lambda at: self.uav.gain_sd_db(*sphere_angles(at)),
            directions=self.known.directions,
            covariance_db2=self.known.covariance_db2,
        )

    def gain_db(self, samples: LinkSamples) -> tuple[FloatArray, FloatArray]:
        """Gain of both ends (n,) and its standard deviation (n,) [dB]."""
        ends = {"uav": (self.uav, samples.at_uav), "tower": (self.tower, samples.at_tower)}
        pair_db, sd_db = pair_and_sd_db(ends)
        return pair_db + sum(pattern.gain_dbi(*sphere_angles(direction)) for pattern, direction in ends.values()), sd_db

    def moments(self, samples: LinkSamples) -> tuple[FloatArray, FloatArray]:
        """Return mean (n,) and covariance (n, n) of the gain of both ends [dB, dB^2]."""
        angles = sphere_angles(samples.at_tower)
        uav_db, covariance = self.airframe.moments(samples.at_uav)
        covariance += table_moments(MAST, self.tower.gain_sd_db(*angles), samples.at_tower)
        both = np.concatenate([samples.at_uav, samples.at_tower], axis=1)
        pair_db = 0.0 if self.tower.pair is None else self.tower.pair.at(both, np.zeros(len(both)))[0]
        return uav_db + self.tower.gain_dbi(*angles) + pair_db, covariance


def every_antenna(site: str | Path) -> list[Remembered]:
    """Return the learned antennas of a site, of all entries, the latest entry last.

    Raises
    ------
    UsageError, InputError
        Learned models that are damaged, or a table that is not as it was written.
    """
    folder, out = learned.folder_of(site), []
    for name, entry in sorted(learned.read_learned(site).entries.items(), key=lambda item: item[1].made):
        named = learned.Named(entry=entry, part="", folder=folder)
        for series in entry.series:
            files = (series.tower_file, series.uav_file)
            tower, uav = (read_sphere_csv(folder / file, named.written(file)) for file in files)
            check_logs((*tower.trained_on, *uav.trained_on), named, folder / series.tower_file)
            if (pair := series.pair) is not None:
                place, written = folder / pair.file, named.written(pair.file)
                tower.pair = read_pair(place, pair.length, pair.prior_sd_db, written)
            known = read_known(folder / series.known_file, named.written(series.known_file))
            out.append(Remembered(name=name, entry=entry, series=series, tower=tower, uav=uav, known=known))
    return out


def remembered(site: str | Path) -> dict[str, Remembered]:
    """Return the learned antennas of the towers of a site by ``tower.channel``, the latest made of each.

    Raises
    ------
    UsageError, InputError
        As :func:`every_antenna`.
    """
    return {f"{known.series.tower}.{known.series.channel}": known for known in every_antenna(site)}


# Exponent of the distance beside antennas that were learned under free space.
_TAUGHT_SLOPE_SD = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """Learned antennas and receiver for a draft, by name, each with a sentence on what to expect."""

    antennas: Mapping[str, str] = field(default_factory=dict)
    antennas_about: str = ""
    """Source and odds of the antennas; if none fits, the odds of the best one."""
    carrier_hz: float | None = None
    receiver: str | None = None
    receiver_about: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Nodes:
    """Nodes of a draft that are no towers of the site and whose place is well known, and the towers of the site."""

    placed: frozenset[str] = frozenset()
    fixed: Sequence[str] = ()


def propose(
    data: FlightData, place: str | Path, site: str, nodes: Nodes = Nodes(), *, carrier_known: bool = False
) -> Proposal:
    """Return the learned antennas that the levels of a flight support, and the rank receiver of its tower.

    Antennas of both ends are compared with the levels of each series; if none fits, the airframes alone with all
    series together. The antenna of a node that other flights placed is compared at any node that is well placed.

    Parameters
    ----------
    data : FlightData
        Without learned antennas.
    place : str or Path
        The site, as :func:`.read_learned` takes it.
    site : str
        Its name in the names of the antennas.
    nodes : Nodes
    carrier_known : bool
        The carriers of ``data`` are those of the experiment, and antennas of other bands do not fit.

    Returns
    -------
    Proposal

    Raises
    ------
    UsageError, InputError
        As :func:`every_antenna`.
    """
    ranked = {(s.tower, quantity_of(data, s)) for s in data.rank}
    entries = learned.read_learned(place).entries
    fitted = (n for n, entry in entries.items() if any((r.tower, r.quantity) in ranked for r in entry.receivers))
    receiver = next(fitted, None)
    ranks = Proposal(
        receiver=f"{site}/{receiver}" if receiver else None,
        receiver_about=entries[receiver].about() if receiver else "",
    )
    if data.track is None or not data.rss or not entries:
        return ranks
    found = _antennas_for(data, every_antenna(place), site, nodes, carrier_known=carrier_known)
    return replace(found, **named(ranks, "receiver receiver_about"))


def _antennas_for(
    data: FlightData, known: Sequence[Remembered], site: str, nodes: Nodes, *, carrier_known: bool
) -> Proposal:
    """Return the antennas of the entry with the largest odds, or of the airframe with the largest odds."""
    # a ratio to the noise counts if there is no level
    levels = [s for s in data.rss if s.channel.lower() not in RATIOS] or list(data.rss)
    evidence = FlightEvidence([observed_series(data, series)[0].samples for series in levels])
    chosen: dict[str, dict[str, tuple[Remembered, Evidence]]] = {}
    for number, series in enumerate(levels):
        for item in known:
            band = learned.BAND if carrier_known else math.inf
            if not _same_place(item.series, series.tower, nodes) or not _in_band(item, series, band):
                continue
            named_odds = _named_odds(data, series, item)
            odds, best = evidence.of_link(number, item.moments).with_prior(named_odds), chosen.setdefault(item.name, {})
            key = f"{series.tower}.{series.channel}"
            if odds.over_own >= LEAST_ODDS and odds.over_turned > 0.0:
                best[key] = max(best.get(key, (item, odds)), (item, odds), key=lambda pair: pair[1].over_own)
    entry = max(chosen, key=lambda name: sum(e.over_own for _, e in chosen[name].values()), default="")
    if fits := chosen.get(entry):
        first = next(iter(fits.values()))[0]
        names = {key: f"{site}/{entry}_{k.series.tower}.{k.series.channel}" for key, (k, _) in fits.items()}
        return Proposal(
            antennas=names | {"uav": f"{site}/{entry}_uav"},
            antennas_about=f"{first.entry.about()}; {_odds(_pooled([odds for _, odds in fits.values()]))}",
            carrier_hz=first.series.carrier_hz,
        )
    return _airframe_for(data, known, site, evidence, band=learned.AIRFRAME_BAND if carrier_known else math.inf)


def _airframe_for(
    data: FlightData, known: Sequence[Remembered], site: str, evidence: FlightEvidence, *, band: float
) -> Proposal:
    """Return the airframe alone that the levels support; without an antenna, the odds of the best one."""
    own, marks = set(flight_logs(data)), marks_of([data])
    tried: dict[str, tuple[Remembered, Evidence]] = {}
    for item in known:
        # a receiver that loses its lock, and flights that do not predict each other, say nothing about other flights
        silent = item.series.lock is not None or not item.series.shares_airframe
        same_log = own & set(item.entry.trained_on) or any(among(mark, item.uav.marks) for mark in marks)
        near = all(_in_band(item, series, band) for series in data.rss)
        if not silent and not same_log and near and item.series.uav_file not in tried:
            tried[item.series.uav_file] = item, evidence.of_airframe(item.airframe)
    if not tried:
        return Proposal()
    best, odds = max(tried.values(), key=lambda pair: min(pair[1].over_own, pair[1].over_turned))
    if not odds.fits:
        text = f"none of the learned airframes fits these levels; the best one, {best.name}: {_odds(odds)}"
        return Proposal(antennas_about=text)
    return Proposal(
        antennas={"uav": f"{site}/{best.name}_uav"},
        antennas_about=f"the airframe alone, {best.entry.about()}, there with its tower antenna; {_odds(odds)}",
        carrier_hz=None if math.isfinite(band) else best.series.carrier_hz,
    )


# Log odds of antennas of both ends before any level: with the names of its tower and channel, or of its receiver; and
# with levels in another unit, which are those of another receiver. Levels of field flights decide by 13 and more.
_SAME_NAME, _OTHER_UNIT = 4.0, -3.0


def _named_odds(data: FlightData, series: RssSeries, item: Remembered) -> float:
    """Return the log odds that names give to the learned antennas of both ends."""
    learned_series = item.series
    receiver = data.settings.logs[int(series.log[0])].receiver if len(series.log) else ""
    if receiver and learned_series.receiver:
        return _SAME_NAME if receiver == learned_series.receiver else -math.inf
    same = (series.tower, series.channel) == (learned_series.tower, learned_series.channel)
    other = learned_series.level is not None and learned_series.level.unit != series.unit
    return (_SAME_NAME if same else 0.0) + (_OTHER_UNIT if other else 0.0)


def _in_band(item: Remembered, series: RssSeries, band: float) -> bool:
    return abs(series.link.carrier_hz / item.series.carrier_hz - 1.0) <= band


def _pooled(each: Sequence[Evidence]) -> Evidence:
    """Return the evidence of several series together."""
    own, turned = (sum(getattr(e, key) for e in each) for key in ("over_own", "over_turned"))
    return Evidence(over_own=own, over_turned=turned)


# Larger odds are not told from certainty.
_MOST_ODDS = 1000.0


def _odds(odds: Evidence) -> str:
    """Return the odds of antennas as words.

    Examples
    --------
    >>> _odds(Evidence(over_own=4.0, over_turned=20.0))
    'odds 55:1 against a gain of its own, more than 1000:1 against rotated copies'
    """

    def ratio(nat: float) -> str:
        if nat > math.log(_MOST_ODDS):
            return f"more than {_MOST_ODDS:.0f}:1"
        return f"{math.exp(nat):.0f}:1" if nat > 0.0 else f"1:{math.exp(min(-nat, 20.0)):.0f}"

    turned = "" if math.isinf(odds.over_turned) else f", {ratio(odds.over_turned)} against rotated copies"
    return f"odds {ratio(odds.over_own)} against a gain of its own{turned}"


def searching_airframe(site: str | Path, towers: Collection[str], log: tuple[str, str]) -> SpherePattern | None:
    """Return the airframe that was learned with nodes at many places, for the search of a node; None if none fits.

    Only for levels of the channel sounder: such an airframe was learned with a receiver that loses its lock.

    Parameters
    ----------
    site : str or Path
        As :func:`.read_learned` takes it.
    towers : collection of str
        Of the site: what was learned with one of them says little about a search.
    log : (SHA-256, mark)
        Of the log, which must not have been learned from.
    """
    nodes = (ends for tower, each in taught(site, log, loses_lock=True).items() if tower not in towers for ends in each)
    return next((ends.uav for ends in nodes if isinstance(ends.uav, SpherePattern)), None)


def taught(site: str | Path, log: tuple[str, str], *, loses_lock: bool) -> dict[str, list[Taught]]:
    """Return the learned antennas of both ends by tower; none if the learned models are damaged.

    Parameters
    ----------
    site : str or Path
    log : (SHA-256, mark)
        A tower whose antennas were learned from this log has an empty list.
    loses_lock : bool
        Those of receivers that lose their lock, or all others.
    """
    from ...compare.learning.locate import LevelModel  # a draft's alone, and a report loads this module
    from .node import Taught

    out: dict[str, list[Taught]] = {}
    with suppress(InputError, UsageError):
        for known in every_antenna(site):
            if (known.series.lock is not None) != loses_lock:
                continue
            each = out.setdefault(known.series.tower, [])
            if log[0] in known.entry.trained_on or among(log[1], known.uav.marks):
                continue
            model = LevelModel(
                slope=2.0,
                slope_sd=_TAUGHT_SLOPE_SD,
                elevation_sd_db=known.spread.own_sd_db,
                shadow_sd_db=float(np.hypot(known.spread.own_sd_db, known.series.sd_db)),
                scatter_sd_db=known.spread.noise_sd_db,
            )
            each.append(Taught(tower=known.tower, uav=known.uav, model=model, moments=known.moments))
        return out
    return {}


def offered(data: FlightData) -> FlightFile | None:
    """Return the settings of a flight with the learned antennas that its levels support; None if none fits."""
    site = data.settings.site.file
    own = frozenset(data.settings.towers)  # as the rovers of other flights were: placed by their own flight
    nodes = Nodes(placed=own, fixed=[name for name in data.site.towers if name not in own])
    try:
        known = propose(data, data.site_place, str(Path(site).with_suffix("")), nodes, carrier_known=True)
    except (InputError, UsageError):
        return None
    if not known.antennas:
        return None
    settings = with_learned(data.settings.model_copy(update={"antennas": dict(known.antennas)}), data.folder)
    return settings if settings.link != data.settings.link else None


def errors_elsewhere(antennas: Mapping[str, str], series: RssSeries, folder: Path) -> learned.Errors | None:
    """Return the errors on held-out flights of the learned antennas of a tower and channel; None without such."""
    name = antennas.get(f"{series.tower}.{series.channel}")
    if name is None or "uav" not in antennas:
        return None
    try:
        return learned.find_named(name, folder).entry.errors
    except (InputError, UsageError):
        return None


def lock_elsewhere(antennas: Mapping[str, str], folder: Path) -> learned.LearnedLock | None:
    """Return P(lock) of the receiver that the airframe of a flight was learned with; None if it never loses lock."""
    try:
        named = learned.find_named(antennas["uav"], folder)
    except (KeyError, InputError, UsageError):
        return None
    return next((s.lock for s in named.entry.series if s.lock is not None), None)


def _same_place(s: learned.LearnedSeries, tower: str, nodes: Nodes) -> bool:
    """Check whether an antenna hangs at a tower, or at a node that other flights carried to their places."""
    return s.tower == tower or (tower in nodes.placed and s.tower not in nodes.fixed)

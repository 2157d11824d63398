"""Part of a site's memory that a draft takes: only what fits the tower, the channel, the reader and so the band."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...common.errors import InputError, UsageError
from ...common.units import FloatArray
from ...compare.gains.direction_gain import LinkSamples
from ...compare.gains.spread import NO_SPREAD, Spread
from ...site.antenna import learned
from ...site.antenna.named import check_logs
from ...site.antenna.sphere_pattern import SpherePattern, read_sphere_csv
from ..data import FlightData, RssSeries
from ..gains.learned_gain import pair_and_sd_db, sphere_angles
from ..gains.memory import with_learned
from ..marks import among
from ..settings import FlightFile

if TYPE_CHECKING:
    from .node import Taught


@dataclass(frozen=True, slots=True, kw_only=True)
class Remembered:
    """Antennas of one tower and channel that a site remembers."""

    entry: learned.Entry
    series: learned.LearnedSeries
    tower: SpherePattern
    uav: SpherePattern

    @property
    def level(self) -> learned.LearnedLevel:
        """Level of the log; only of memories that keep it."""
        assert self.series.level is not None
        return self.series.level

    @property
    def spread(self) -> Spread:
        """Spread of a level besides the standard deviation of the gains."""
        return Spread.from_text(self.tower.notes) or NO_SPREAD

    @property
    def prior_variance_db2(self) -> float:
        """Variance of the gains of both ends in directions that nobody has flown."""
        return self.tower.largest_sd_db**2 + self.uav.largest_sd_db**2

    def gain_db(self, samples: LinkSamples) -> tuple[FloatArray, FloatArray]:
        """Gain of both ends (n,) and its standard deviation (n,) [dB]."""
        ends = {"uav": (self.uav, samples.at_uav), "tower": (self.tower, samples.at_tower)}
        pair_db, sd_db = pair_and_sd_db(ends)
        return pair_db + sum(pattern.gain_dbi(*sphere_angles(direction)) for pattern, direction in ends.values()), sd_db


def remembered(site: str | Path) -> dict[str, Remembered]:
    """Antennas of the towers of a site that its memory holds, by ``tower.channel``; the latest made of each.

    Raises
    ------
    UsageError, InputError
        A memory or a table that is damaged.
    """
    folder, out = learned.folder_of(site), {}
    # the latest last: it takes the place of earlier ones
    for entry in sorted(learned.read_learned(site).entries.values(), key=lambda entry: entry.made):
        for series in entry.series:
            tower, uav = (read_sphere_csv(folder / file) for file in (series.tower_file, series.uav_file))
            named = learned.Named(entry=entry, part="", folder=folder)
            check_logs((*tower.trained_on, *uav.trained_on), named, folder / series.tower_file)
            out[f"{series.tower}.{series.channel}"] = Remembered(entry=entry, series=series, tower=tower, uav=uav)
    return out


# Exponent of the distance beside antennas that were learned under free space.
_TAUGHT_SLOPE_SD = 0.2

# Tower, channel and reader of a level of the draft; tower, ``rank`` and its quantity of a rank.
_SeriesKey = tuple[str, str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """Learned antennas and receiver for a draft, by name, each with a sentence on what to expect."""

    antennas: Mapping[str, str]
    antennas_about: str
    carrier_hz: float | None
    receiver: str | None
    receiver_about: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Nodes:
    """Nodes of a draft that are no towers of the site and whose place is well known, and the towers of the site."""

    placed: frozenset[str] = frozenset()
    fixed: Sequence[str] = ()


def propose(known: learned.Learned, site: str, series: Sequence[_SeriesKey], nodes: Nodes = Nodes()) -> Proposal:
    """The entry that fits most series: tower antennas where the tower fits too, else the airframe alone.

    The antenna of a node that flights placed themselves goes with any such node: it was learned over several places.

    Parameters
    ----------
    known : Learned
        The memory of the site.
    site : str
        Its name in the names of the antennas.
    series : sequence of (tower, channel, reader)
    nodes : Nodes

    Returns
    -------
    Proposal
        Empty where nothing fits.
    """
    series = [(tower, channel, learned.receiver_of(reader)) for tower, channel, reader in series]
    antennas: dict[str, str] = {}
    about, carrier = "", None
    fits = {name: _fits(entry, series, nodes) for name, entry in known.entries.items()}
    # exact fits count first: tuples compare so
    best = max(fits, key=lambda name: fits[name], default=None)
    if best is not None and fits[best] > (0, 0):
        entry = known.entries[best]
        exact = [s for s in entry.series if (s.tower, s.channel, s.reader) in series]
        alike = exact or [s for s in entry.series if any(_alike(s, key, nodes) for key in series)]
        antennas = {f"{s.tower}.{s.channel}": f"{site}/{best}_{s.tower}.{s.channel}" for s in exact}
        antennas |= {
            f"{tower}.{channel}": f"{site}/{best}_{s.tower}.{s.channel}"
            for s in alike
            for tower, channel, reader in series
            if _placed(s, tower, nodes) and _alike(s, (tower, channel, reader), nodes)
        }
        alone = "the airframe alone fits: {}, there with its tower antenna"
        about = entry.about() if antennas else alone.format(entry.about())
        antennas["uav"] = f"{site}/{best}_uav"
        carrier = alike[0].carrier_hz
    ranked = {(tower, quantity) for tower, channel, quantity in series if channel == "rank"}
    fitted = (n for n, entry in known.entries.items() if any((r.tower, r.quantity) in ranked for r in entry.receivers))
    receiver = next(fitted, None)
    return Proposal(
        antennas=antennas,
        antennas_about=about,
        carrier_hz=carrier,
        receiver=f"{site}/{receiver}" if receiver else None,
        receiver_about=known.entries[receiver].about() if receiver else "",
    )


def searching_airframe(
    site: str | Path, towers: Collection[str], series: tuple[str, str], log: tuple[str, str]
) -> SpherePattern | None:
    """The airframe that flights taught with a node of theirs, for the search of a node; None where none fits.

    Parameters
    ----------
    site : str or Path
        As :func:`.read_learned` takes it.
    towers : collection of str
        Of the site: what was learned with one of them says little about a search.
    series : (channel, reader)
    log : (SHA-256, mark)
        Of the log, which must not have been learned from.

    Returns
    -------
    SpherePattern or None
    """
    with suppress(InputError, UsageError):
        unseen = (entry for entry in learned.read_learned(site).entries.values() if log[0] not in entry.trained_on)
        every = (s for entry in unseen for s in entry.series if s.tower not in towers)
        files = (s.uav_file for s in every if (s.channel, s.reader) == (series[0], learned.receiver_of(series[1])))
        airframes = (read_sphere_csv(learned.folder_of(site) / file) for file in files)
        return next((airframe for airframe in airframes if not among(log[1], airframe.marks)), None)
    return None


def taught(site: str | Path, series: tuple[str, str], log: tuple[str, str]) -> dict[str, Taught | None]:
    """Antennas at both ends that flights taught for a channel and reader, by tower; a damaged memory has none.

    Parameters
    ----------
    site : str or Path
    series : (channel, reader)
    log : (SHA-256, mark)
        Of the log: None of a tower whose antennas were learned from it.
    """
    from ...compare.learning.locate import LevelModel  # a draft's alone, and a report loads this module
    from .node import Taught

    def unseen(known: Remembered) -> Taught | None:
        if log[0] in known.entry.trained_on or among(log[1], known.uav.marks):
            return None
        model = LevelModel(
            slope=2.0,
            slope_sd=_TAUGHT_SLOPE_SD,
            elevation_sd_db=known.spread.own_sd_db,
            shadow_sd_db=float(np.hypot(known.spread.own_sd_db, known.series.sd_db)),
            scatter_sd_db=known.spread.noise_sd_db,
        )
        return Taught(tower=known.tower, uav=known.uav, model=model)

    with suppress(InputError, UsageError):
        same = (series[0], learned.receiver_of(series[1]))
        every = remembered(site).values()
        return {k.series.tower: unseen(k) for k in every if (k.series.channel, k.series.reader) == same}
    return {}


def offered(data: FlightData) -> FlightFile | None:
    """The settings of a flight with the antennas that its site remembers; None where nothing fits its towers.

    Airframes alone are not offered: what an airframe is worth without its tower antenna was not measured.
    """
    site = data.settings.site.file
    series = [(s.tower, s.channel, data.files[int(number)].result.reader)
              for s in data.rss for number in np.unique(s.log)]  # fmt: skip
    try:
        own = frozenset(data.settings.towers)  # as the rovers of other flights were: placed by their own flight
        nodes = Nodes(placed=own, fixed=[name for name in data.site.towers if name not in own])
        known = propose(learned.read_learned(data.site_place), str(Path(site).with_suffix("")), series, nodes)
    except (InputError, UsageError):
        return None
    # one is the airframe, alone
    if len(known.antennas) < 2:
        return None
    settings = with_learned(data.settings.model_copy(update={"antennas": dict(known.antennas)}), data.folder)
    return settings if settings.link != data.settings.link else None


def errors_elsewhere(antennas: Mapping[str, str], series: RssSeries, folder: Path) -> learned.Errors | None:
    """Errors on flights left out of the learned antennas of a tower and channel; None where no such are used."""
    name = antennas.get(f"{series.tower}.{series.channel}")
    if name is None or "uav" not in antennas:
        return None
    try:
        return learned.find_named(name, folder).entry.errors
    except (InputError, UsageError):
        return None


def lock_elsewhere(antennas: Mapping[str, str], series: RssSeries, folder: Path) -> learned.LearnedLock | None:
    """P(lock) that other flights taught with the airframe of a flight; None without one for such a channel."""
    try:
        named = learned.find_named(antennas["uav"], folder)
    except (KeyError, InputError, UsageError):
        return None
    locks = [s.lock for s in named.entry.series if s.channel == series.channel and s.lock is not None]
    return locks[0] if locks else None


# Readers of one receiver: merged flights of the sounder hold the readings of its own logs.
SOUNDER = {"flight_mat", "sounder_log"}


def _placed(s: learned.LearnedSeries, tower: str, nodes: Nodes) -> bool:
    return tower in nodes.placed and s.tower not in nodes.fixed


def _alike(s: learned.LearnedSeries, key: _SeriesKey, nodes: Nodes) -> bool:
    """Check whether a series has the channel and the receiver of one that was learned from, whatever its tower."""
    tower, channel, reader = key
    same = s.reader == reader or (_placed(s, tower, nodes) and {s.reader, reader} <= SOUNDER)
    return s.channel == channel and same


def _fits(entry: learned.Entry, series: Sequence[_SeriesKey], nodes: Nodes) -> tuple[int, int]:
    """Series of an entry that fit exactly, and those of another tower."""
    exact = sum((s.tower, s.channel, s.reader) in series for s in entry.series)
    return exact, sum(any(_alike(s, key, nodes) for key in series) for s in entry.series)

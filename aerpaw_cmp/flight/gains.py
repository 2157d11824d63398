"""Learned gains of a link, losses of its paths, and learned antennas in flight settings.

The replay uses patterns. This module adds the learned gain of both ends together and its error model, the losses of a
path (foliage, reflections), and notes about foliage models.

It also replaces the names of learned antennas and receivers in flight settings by files. Reading a flight.yaml does not
do this, so a job that replays a flight or lists its inputs calls :func:`with_learned`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..common.errors import InputError, UsageError
from ..common.geodesy import azimuth_rad, elevation_rad
from ..common.units import FloatArray, wavelength_m
from ..compare.gains import NO_SPREAD, Spread, link_directions
from ..propagation.field import foliage
from ..propagation.geometry import Link, PathSet, Pattern, Poses, single_element
from ..propagation.options import Loss, Run, Search
from ..propagation.replay import replay
from ..site.learned import LearnedSpread, Named, SpherePattern, UnknownName, find_named, learned_antenna, receiver_file
from ..site.site import Site
from .settings import (
    AntennaSettings,
    ArraySettings,
    Caution,
    FlightFile,
    LinkSettings,
    Overrides,
    RtSettings,
    joined,
    load_flight,
    overridden,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedGain:
    """The learned gain of a link in the direction of the direct path, at the poses of a replay.

    Parameters
    ----------
    pair_db : (poses,)
        Gain of both ends together, to add to the level [dB]. Zero if it was not learned.
    sd_db : (poses,)
        Standard deviation of the sum of learned gains [dB].
    spread : Spread
        Error model of the level, excluding ``sd_db``. The error model of the tower's antenna is used if this antenna is
        learned, otherwise that of the UAV's antenna.
    """

    pair_db: FloatArray
    sd_db: FloatArray
    spread: Spread


def learned_gain(link: Link, poses: Poses, source_m: FloatArray) -> LearnedGain | None:
    """Return the learned gain of a link to one tower, or None if neither antenna is learned.

    Parameters
    ----------
    link : Link
        Link with one tower.
    poses : Poses
    source_m : (1, 3) or (poses, 3)
        Centre of the tower's array [m].

    Returns
    -------
    LearnedGain or None
    """
    towards = dict(zip(("uav", "tower"), link_directions(source_m, poses.position_m, poses.rotation), strict=True))
    (tower_array,) = link.tower_arrays.values()
    ends: dict[str, tuple[SpherePattern, FloatArray]] = {}
    for end, array in (("uav", link.uav_array), ("tower", tower_array)):
        pattern = array.patterns[0]
        if isinstance(pattern, SpherePattern):
            ends[end] = pattern, np.asarray(towards[end] @ array.mount)
    if not ends:
        return None
    pair_db, sd_db = pair_and_sd_db(ends)
    stated = (pattern.spread for pattern, _ in reversed(ends.values()) if pattern.spread is not None)
    return LearnedGain(pair_db=pair_db, sd_db=sd_db, spread=spread_of(next(stated, None)))


def spread_of(stated: LearnedSpread | None) -> Spread:
    """Return the error model of a learned antenna. An antenna without error model has only the error of its gain."""
    return NO_SPREAD if stated is None else Spread(**stated.model_dump())


def pair_and_sd_db(ends: Mapping[str, tuple[SpherePattern, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Return the gain of both ends together (n,), and the standard deviation (n,) of all learned gains [dB].

    ``ends`` contains a pattern and directions (n, 3) in its frame, for ``uav``, ``tower`` or both.
    """
    square = sum(pattern.gain_sd_db(*sphere_angles(direction)) ** 2 for pattern, direction in ends.values())
    sd_db = np.sqrt(square)
    if len(ends) == 2:
        (uav, at_uav), (tower, at_tower) = ends["uav"], ends["tower"]
        # the gain of a pair applies only to the two patterns with which it was learned
        if tower.pair is not None and uav.trained_on == tower.trained_on:  # from one calibration
            return tower.pair.at(np.concatenate([at_uav, at_tower], axis=1), sd_db)
    return np.zeros(len(sd_db)), sd_db


def sphere_angles(direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return zenith angle and azimuth (...,) [rad] of directions (..., 3)."""
    return 0.5 * np.pi - elevation_rad(direction), azimuth_rad(direction)


def mean_gain_db(patterns: Sequence[Pattern], theta_rad: FloatArray, phi_rad: FloatArray) -> FloatArray:
    """Return the mean gain (n,) of the elements of an array in directions of its frame, limited to at least -60 dBi."""
    fields = [pattern.field(theta_rad, phi_rad) for pattern in patterns]
    power = sum(np.abs(e_theta) ** 2 + np.abs(e_phi) ** 2 for e_theta, e_phi in fields)
    # limit nulls to -60 dB, because no pattern is accurate below that
    return np.asarray(10.0 * np.log10(np.maximum(power / len(patterns), 1e-6)))


def pair_db(link: Link, poses: Poses, source_m: FloatArray) -> FloatArray | float:
    """Return the learned gain (poses,) of both ends together, to add to the level [dB], or 0 if none is learned."""
    gain = learned_gain(link, poses, source_m)
    return 0.0 if gain is None else gain.pair_db


# --- losses of a path ------------------------------------------------------------------------------------------------


def _foliage_loss(site: Site, rt: RtSettings, carrier_hz: float) -> Loss | None:
    """Return the loss in tree crowns and woods, or None if the site has no trees or foliage is switched off."""
    if not site.wooded or rt.foliage == "none":
        return None
    site = site.under(rt.foliage)
    model, evergreen = (
        foliage.foliage_model(
            rt.foliage,
            carrier_hz,
            in_leaf=in_leaf,
            gamma_db_per_m=rt.advanced.gamma_db_per_m,
            maximum_db=rt.advanced.maximum_loss_db,
        )
        for in_leaf in (rt.leaves == "in", True)
    )
    index, wavelength = foliage.crown_index(site.trees), wavelength_m(carrier_hz)

    def loss(paths: PathSet, sources_m: FloatArray, targets_m: FloatArray) -> FloatArray:
        source, target = sources_m[paths.tower], targets_m[paths.pose]
        # a path passes single trees and woods one after the other, so their losses add
        trees_db = foliage.foliage_loss_db(source, paths.vertices_m, target, index, model)
        return trees_db + foliage.stand_loss_db(site, source, paths.vertices_m, target, model, wavelength, evergreen)

    return loss


def _reflection_loss(_site: Site, rt: RtSettings, _carrier_hz: float) -> Loss | None:
    """Return a loss of ``rt.reflection_loss_db`` per reflection, or None if it is 0."""
    if rt.reflection_loss_db == 0.0:
        return None
    return lambda paths, _sources_m, _targets_m: np.asarray(rt.reflection_loss_db * paths.depth, dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class PathLoss:
    """A loss of a path in addition to its field. Replay, ``explain``, model comparison and audit apply it.

    Parameters
    ----------
    name : str
        Name of the loss in ``explain``.
    off : mapping
        Keys and values of ``rt`` that switch the loss off. A model of the comparison includes a loss only if it sets
        these keys.
    of : callable
        ``of(site, rt, carrier_hz)`` returns the loss as a function, or None if no path has this loss.
    expected : callable
        ``expected(rt)`` returns the values from which the audit computes the loss a second time: fields of
        :class:`~aerpaw_cmp.propagation.check.reference.ExpectedLoss`.
    """

    name: str
    off: Mapping[str, Any]
    of: Callable[[Site, RtSettings, float], Loss | None]
    expected: Callable[[RtSettings], dict[str, Any]]


LOSSES: tuple[PathLoss, ...] = (
    PathLoss(
        name="foliage",
        off={"foliage": "none"},
        of=_foliage_loss,
        expected=lambda rt: {
            "model": rt.foliage,
            "gamma_db_per_m": rt.advanced.gamma_db_per_m,
            "maximum_db": rt.advanced.maximum_loss_db,
            "in_leaf": rt.leaves == "in",
        },
    ),
    PathLoss(
        name="rough surfaces",
        off={"reflection_loss_db": 0.0},
        of=_reflection_loss,
        expected=lambda rt: {"reflection_db": rt.reflection_loss_db},
    ),
)


def without_losses() -> dict[str, Any]:
    """Return the keys of ``rt`` that switch all losses off."""
    return {key: value for loss in LOSSES for key, value in loss.off.items()}


def path_losses(site: Site, rt: RtSettings, carrier_hz: float) -> dict[str, Loss]:
    """Return the losses of paths by name. Each loss is a function like the result of :func:`path_loss`."""
    every = ((declared.name, declared.of(site, rt, carrier_hz)) for declared in LOSSES)
    return {name: loss for name, loss in every if loss is not None}


def path_loss(site: Site, rt: RtSettings, carrier_hz: float) -> Loss | None:
    """Return the sum of all losses of a path in addition to its field.

    Parameters
    ----------
    site : Site
        Site with its trees, woods and ground.
    rt : RtSettings
    carrier_hz : float

    Returns
    -------
    callable or None
        ``loss(paths, sources_m (towers, 3), targets_m (poses, 3)) -> (paths,)`` [dB], infinite if a path is blocked.
        None if no path has a loss.
    """
    losses = list(path_losses(site, rt, carrier_hz).values())
    if len(losses) < 2:
        return losses[0] if losses else None

    def loss(paths: PathSet, sources_m: FloatArray, targets_m: FloatArray) -> FloatArray:
        return np.asarray(sum(each(paths, sources_m, targets_m) for each in losses), dtype=np.float64)

    return loss


# An arbitrary carrier, because sight lines do not depend on the frequency.
_ANY_HZ = 3.4e9


def sight_shares(site: Site, tower: str, poses_m: FloatArray) -> tuple[float, float]:
    """Return the shares of sight lines from a tower to poses (n, 3) [m] through woods, and behind buildings."""
    source = site.towers[tower].position_m
    array = single_element()
    poses = Poses(poses_m, np.broadcast_to(np.eye(3), (len(poses_m), 3, 3)))
    # without a cache, because a draft needs this result only once
    seen = replay(site, Link(_ANY_HZ, {tower: array}, array), poses, Search(max_depth=0), run=Run(cache_dir=""))
    return float((direct_foliage_m(source, poses_m, site) > 0.0).mean()), float(1.0 - len(seen.paths) / len(poses_m))


def direct_foliage_m(tower_m: FloatArray, poses_m: FloatArray, site: Site) -> FloatArray:
    """Return the length (n,) [m] inside crowns and woods of lines from a tower (3,) or (n, 3) to poses (n, 3) [m]."""
    source = np.broadcast_to(tower_m, poses_m.shape)
    in_crowns = foliage.foliage_depth_m(source, np.zeros((len(poses_m), 0, 3)), poses_m, site.trees)
    return in_crowns + foliage.stand_depth_m(site, source, poses_m)


def load_with_learned(path: str | Path, learned: Path | None = None, overrides: Overrides | None = None) -> FlightFile:
    """Return the settings of a flight.yaml, with names of learned antennas and receiver replaced by files.

    Parameters
    ----------
    path : str or Path
    learned : Path, optional
        calibrated.yaml whose settings replace those of the flight file, including its named antennas.
    overrides : mapping, optional
        Values of dotted keys. Overrides are applied before antenna names are replaced, because an antenna must fit the
        carrier.
    """
    settings = with_learned(overridden(load_flight(path), overrides or {}), Path(path).parent)
    return settings if learned is None else joined(settings, learned)


def flight_of(path: Path) -> FlightFile | None:
    """Return the settings of a flight file, or None if the path is another kind of file."""
    if path.suffix.lower() not in (".yaml", ".yml") or not path.is_file():
        return None
    text = path.read_text(encoding="utf-8", errors="replace")
    return load_with_learned(path) if re.search(r"^flight\s*:", text, re.MULTILINE) else None


@dataclass(slots=True)
class _Ends:
    """The links of a flight, to which learned antennas are added, and cautions about antennas that do not fit."""

    rss: LinkSettings
    channels: dict[str, LinkSettings]
    cautions: list[Caution] = field(default_factory=list)
    used: dict[str, Named] = field(default_factory=dict)

    def link(self, channel: str | None) -> LinkSettings:
        """Return the link of a channel: ``link.rss`` for None and for a channel without an entry."""
        return self.rss if channel is None else self.channels.get(channel, self.rss)

    def use(self, key: str, channel: str | None, name: str, named: Named) -> None:
        """Use a learned antenna at the end that a key names. Channel None is the link of all other channels."""
        tower, link = key.partition(".")[0], self.link(channel)
        before = link.uav if key == "uav" else link.towers.get(tower, link.tower)
        instead = "an isotropic antenna is used instead" if before == ArraySettings() else "the 'link' antenna is used"
        try:
            file, known = learned_antenna(named, "uav" if key == "uav" else "tower", link.carrier_hz)
        except (InputError, UsageError) as error:
            text = f"the learned antenna {name} is not used ({_reason(error)}); {instead}"
            self.cautions.append(Caution(key=f"antennas.{key}", channel=channel, text=text))
            return
        if before != ArraySettings():
            text = f"the learned antenna {name} replaces the array of 'link'"
            self.cautions.append(Caution(key=f"antennas.{key}", channel=channel, text=text, used=True))
        array = ArraySettings(antenna=AntennaSettings(model="sphere", file=str(file), learned=known))
        end: dict[str, Any] = {"uav": array} if key == "uav" else {"towers": {**link.towers, tower: array}}
        self.used[key] = named
        if channel is None:
            self.rss = link.model_copy(update=end)
        else:
            self.channels[channel] = link.model_copy(update=end)


def with_learned(settings: FlightFile, folder: Path) -> FlightFile:
    """Return the settings with names of learned antennas and receiver replaced by files.

    The airframe (``antennas.uav``) is the UAV antenna of every channel. An antenna that does not fit (another band, a
    damaged table) is not used. :attr:`.FlightFile.cautions` contains the reason, and the run continues.

    Parameters
    ----------
    settings : FlightFile
    folder : Path
        Folder of the flight file, which may contain sites that are not packaged.

    Raises
    ------
    UnknownName
        If no learned model has the name, or if the only model with this name is for the other end of the link.
    UsageError
        If a key of ``antennas`` is neither ``uav`` nor ``TOWER.CHANNEL``.
    """
    ends = _Ends(settings.link.rss, dict(settings.link.channels))
    # use the airframe last, because it applies to every channel, and an antenna of a tower can add a channel
    for key, name in sorted(settings.antennas.items(), key=lambda item: item[0] == "uav"):
        tower, _, channel = key.partition(".")
        if key != "uav" and not (tower and channel):
            raise UsageError(f"unknown key 'antennas.{key}'", expected="'uav' or 'TOWER.CHANNEL', such as LW1.USRP1")
        named = _named(name, folder, "uav" if key == "uav" else "tower", f"antennas.{key}")
        for each in (None, *list(ends.channels)) if key == "uav" else (channel,):
            if isinstance(named, Caution):
                ends.cautions.append(replace(named, channel=each))
            else:
                ends.use(key, each, name, named)
    content: dict[str, Any] = {}
    if ends.used:
        link = {"rss": ends.rss, "channels": ends.channels} if ends.channels else {"rss": ends.rss}
        content["link"] = settings.link.model_copy(update=link)
    if settings.antennas:
        content["antennas"] = {key: name for key, name in settings.antennas.items() if key in ends.used}
    receiver = settings.rank.receiver
    if receiver is not None and "/" in receiver and not (folder / receiver).is_file():
        content["rank"] = settings.rank.model_copy(update={"receiver": _receiver(settings, receiver, folder, ends)})
    lent = ends.channels.keys() - settings.link.channels.keys()
    return settings.changed(content, cautions=ends.cautions, learned=ends.used, lent=lent)


def antennas_used(series: Sequence[tuple[str, str, LinkSettings]]) -> tuple[str, ...]:
    """Return one sentence per pair of antennas. The sentence names the channels if not all channels use this pair.

    Examples
    --------
    >>> antennas_used([("LW1", "A", LinkSettings(carrier_hz=3.3e9)), ("LW1", "B", LinkSettings(carrier_hz=3.3e9))])
    ('Antennas: isotropic at the tower, isotropic at the UAV.',)
    """
    pairs: dict[str, list[str]] = {}
    for tower, channel, link in series:
        ends = (_antenna_name(array.antenna) for array in (link.towers.get(tower, link.tower), link.uav))
        pairs.setdefault("{} at the tower, {} at the UAV".format(*ends), []).append(f"{tower} {channel}")
    if len(pairs) == 1:
        return (f"Antennas: {next(iter(pairs))}.",)
    return tuple(f"Antennas of {', '.join(names)}: {what}." for what, names in pairs.items())


def _antenna_name(antenna: AntennaSettings) -> str:
    if antenna.file is None:
        return {"iso": "isotropic"}.get(antenna.model, antenna.model)
    return Path(antenna.file).name.removesuffix(".gz").removesuffix(".csv")


def _named(name: str, folder: Path, end: str, key: str) -> Named | Caution:
    """Return the learned model of a name, or a caution if the learned models cannot be read."""
    try:
        return find_named(name, folder, end)
    except UnknownName as error:
        raise UnknownName(f"{key}: {error.found}", expected=error.expected, cause=error.cause) from None
    except (InputError, UsageError) as error:
        return Caution(key=key, channel=None, text=f"{name} is not used ({_reason(error)})")


def _receiver(settings: FlightFile, name: str, folder: Path, ends: _Ends) -> str | None:
    """Return the file of a rank receiver, or None and add a caution to ``ends`` if the receiver does not fit."""
    if Path(name).suffix == ".json":  # a missing file is reported when it is read
        return name
    named = _named(name, folder, "receiver", "rank.receiver")
    if not isinstance(named, Caution):
        try:
            return str(receiver_file(named, settings.link.rank.carrier_hz))
        except (InputError, UsageError) as error:
            named = Caution(key="rank.receiver", channel="rank", text=f"{name} is not used ({_reason(error)})")
    ends.cautions.append(named)
    return None


def _reason(error: InputError | UsageError) -> str:
    """Return an error as text: what was found, in which file, and what was expected."""
    where = f" in {Path(error.path).name}" if error.path else ""
    return f"{error.found}{where}; expected: {error.expected}"


def foliage_notes(wooded: bool, rt: RtSettings, carriers_hz: Collection[float]) -> tuple[str, ...]:
    """Return notes about extrapolations and assumptions of the foliage models. Empty for a site without trees."""
    if not wooded or rt.foliage != "attenuating":
        return ()
    notes = []
    if rt.advanced.gamma_db_per_m is None or rt.advanced.maximum_loss_db is None:
        notes += [note for carrier in sorted(carriers_hz) if (note := p833_note(carrier))]
    if rt.leaves == "out":
        notes.append(
            f"Trees out of leaf: gamma in leaf divided by {1 / foliage.LEAFLESS_FACTOR:g}. That is an assumption of "
            "this tool: ITU-R P.833 states about 20 % near 1 GHz, and no value at this carrier."
        )
    return tuple(notes)


def p833_note(carrier_hz: float) -> str | None:
    """Return the note that the table of P.833 is extrapolated, or None if the carrier is within the table."""
    low, high = foliage.P833_TABLE[0][0], foliage.P833_TABLE[-1][0]
    if low <= carrier_hz / 1e6 <= high:
        return None
    model = foliage.P833.at(carrier_hz)
    return (
        f"Trees at {carrier_hz / 1e9:g} GHz: an extrapolation of ITU-R P.833, whose table of woodland covers {low:g} "
        f"to {high:g} MHz. With leaves, gamma = {model.gamma_db_per_m:.2f} dB/m and A_m = {model.maximum_db:.0f} dB. "
        "Other extrapolations have 0.45 to 0.7 dB/m at 3.4 GHz, so try several values of gamma."
    )

"""Links that can be predicted: of the flights that were named, or of the memory of the site."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...common.errors import InputError
from ...common.geodesy import azimuth_rad
from ...common.jsonable import named
from ...common.units import BoolArray, FloatArray
from ...compare.gains.direction_gain import LinkSamples
from ...compare.gains.spread import NO_SPREAD, LostLock, Spread, fading_of, student_factor
from ...compare.learning.calibration import Observed
from ...compare.learning.correction import BIN_S, Correction, Predictor, between_blocks_db, by_degree
from ...compare.level.detection import DetectionForecast
from ...flight.data import FlightData, RssSeries, load_data
from ...flight.drafting.remembered import Remembered, remembered
from ...flight.gains.learned_gain import pair_db
from ...flight.gains.memory import load_with_learned
from ...flight.replay import replay_poses
from ...flight.settings import FlightFile, LinkSettings, RssSettings, RtSettings
from ...propagation.field.baselines import free_space_dbm
from ...propagation.geometry.arrays import Poses, rotation_from_aircraft
from ...site.site import Site
from ..learning.calibrate import load_calibration
from ..tasks.manifest import inputs_of_flight
from .where import UPRIGHT, is_settings, level_samples

_REPLAYED_AT_ONCE = 20_000


@dataclass(frozen=True, slots=True)
class NamedFlight:
    """A flight file that ``--with`` names."""

    path: Path
    settings: FlightFile

    def load(self, logs_root: Path | None) -> FlightData:
        """Its logs and track."""
        return load_data(self.settings, self.path.parent, logs_root)


def named_flights(paths: Sequence[Path]) -> list[NamedFlight]:
    """Flight files, and those that a calibration.yaml lists.

    Raises
    ------
    UsageError, InputError
        As of any settings file.
    """
    out = []
    for path in paths:
        text = path.read_text(encoding="utf-8", errors="replace") if is_settings(path) and path.is_file() else ""
        listed = text.startswith("calibration:") or "\ncalibration:" in text
        each = [path.parent / name for name in load_calibration(path).flights] if listed else [path]
        out += [NamedFlight(file, load_with_learned(file)) for file in each]
    return out


def files_of(flights: Sequence[NamedFlight], logs_root: Path | None) -> list[Path]:
    """Every file that the flights are read from."""
    return [file for flight in flights for file in inputs_of_flight(flight.settings, flight.path, logs_root)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Link of one tower and channel, as the first flight that has it describes it, or the memory of the site.

    Parameters
    ----------
    tower, channel, unit : str
    link : LinkSettings
    site : Site
    folder : Path
        Where antenna files resolve.
    rt, rss : RtSettings, RssSettings
        How a replay goes, and which sum of its paths counts.
    samples : tuple of LinkSamples
        Of the flights that have it.
    """

    tower: str
    channel: str
    unit: str
    link: LinkSettings
    site: Site
    folder: Path = Path()
    rt: RtSettings = field(default_factory=RtSettings)
    rss: RssSettings = field(default_factory=RssSettings)
    samples: tuple[LinkSamples, ...] = ()

    @classmethod
    def of(cls, data: FlightData, series: RssSeries, samples: Sequence[LinkSamples]) -> Source:
        """As a flight has it; ``samples`` are those of all flights."""
        of_series = tuple(s for s in samples if (s.tower, s.channel) == (series.tower, series.channel))
        return cls(
            **named(series, "tower channel unit link"),
            **named(data, "site folder"),
            **named(data.settings, "rt rss"),
            samples=of_series,
        )

    @property
    def antenna(self) -> str:
        """``tower.channel``."""
        return f"{self.tower}.{self.channel}"

    @property
    def tower_m(self) -> FloatArray:
        """Place of the array (3,)."""
        return np.asarray(self.site.towers[self.tower].position_m)

    def free_space_db(self, position_m: FloatArray) -> FloatArray:
        """Level (n,) of free space [dBm]."""
        place, link = self.tower_m[None, :], self.link
        return np.asarray(free_space_dbm(place, position_m, link.carrier_hz, link.transmit_power_dbm)[:, 0])

    def targets(self, position_m: FloatArray, yaw_deg: FloatArray, up: FloatArray = UPRIGHT) -> LinkSamples:
        """Targets (n,) of an aircraft of an upward axis (3,) or (n, 3) as samples without a level."""
        time_s = np.zeros(len(yaw_deg))
        return level_samples((self.tower, self.channel), self.tower_m, position_m, yaw_deg, time_s, up)

    def replayed_db(self, samples: LinkSamples) -> FloatArray:
        """Replayed level above free space (n,) of a level aircraft [dB]; NaN without a path."""
        link = self.link.build([self.tower], self.folder)
        turn = azimuth_rad(-samples.at_tower) - azimuth_rad(samples.at_uav)
        flat = np.zeros(len(turn))
        known = self.rt.attitude != "ignored"
        rotation = rotation_from_aircraft(flat, flat, 90.0 - np.degrees(turn) if known else flat + 90.0)
        level = np.empty(len(samples))
        for start in range(0, len(samples), _REPLAYED_AT_ONCE):
            part = slice(start, start + _REPLAYED_AT_ONCE)
            poses = Poses(samples.position_m[part], rotation[part])
            total = replay_poses(self.site, self.rt, link, poses).level_dbm(self.rss.field)
            level[part] = total[:, 0] + pair_db(link, poses, self.tower_m[None, :])
        return np.asarray(level - self.free_space_db(samples.position_m))


def track_m(samples: LinkSamples) -> FloatArray:
    """Some 500 positions (n, 2) of a flight, for drawings."""
    return np.asarray(samples.position_m[:: max(1, len(samples) // 500), :2])


def sources_of(known: Sequence[FlightData], observed: Sequence[Observed]) -> dict[str, Source]:
    """Towers that stand still and their channels that a flight heard, by antenna."""
    measured = [o.samples for o in observed if np.isfinite(o.samples.residual_db).any()]
    out: dict[str, Source] = {}
    for data in known:
        for series in data.rss:
            source = Source.of(data, series, measured)
            if source.samples and series.tower not in data.nodes and series.unit != "dB":
                out.setdefault(source.antenna, source)
    if not out:
        raise InputError("no flight has levels of a tower that stands still", expected="RSS logs with positions")
    return out


# --- models --------------------------------------------------------------------------------------------------------

# Targets further than this from every sample that is known are flagged, horizontally and in height.
_HULL_M, _HULL_UP_M = 60.0, 20.0

# Level above free space and standard deviation of 4 s means (n,) [dB], and where the model is a guess.
Levels = tuple[FloatArray, FloatArray, BoolArray]


@dataclass(frozen=True, slots=True)
class Flown:
    """The model that the named flights taught: a base with or without a residual field."""

    correction: Correction
    sources: Mapping[str, Source]
    trained_on: Sequence[Sequence[str]] = ()
    marks: Sequence[Sequence[str]] = ()
    """SHA-256 of what its base knows besides the named flights."""

    def levels(self, each: Sequence[LinkSamples], run_targets: int) -> Levels:
        """Levels at targets as seen with each of some headings, which count alike; ``run_targets``: their count."""
        antenna = each[0].antenna
        level, slow = self.correction.over_headings(each, all_targets=run_targets)
        guess = outside(each[0].position_m, self.sources[antenna].samples)
        # the field's offset of a new flight is normal; few flights tell little of its spread, as in the memory
        flights, fitted = len({s.flight for s in self.sources[antenna].samples}), self.correction
        wider = math.sqrt((1.0 + 1.0 / flights) * (student_factor(flights) ** 2 - 1.0))
        slow = np.hypot(slow, fitted.sd_factor * wider * fitted.model.offset_sd_db)
        beyond = between_blocks_db(self.correction.channels[antenna])
        return level, np.where(guess, np.hypot(slow, beyond), slow), guess

    def fading(self, antenna: str) -> Spread:
        """Spread of samples about their means over 4 s."""
        sd_db, kurtosis = fading_of(self.sources[antenna].samples, BIN_S)
        return dataclasses.replace(NO_SPREAD, fading_sd_db=sd_db, fading_kurtosis=kurtosis, bin_s=BIN_S)

    def lost_lock(self, antenna: str, level_db: FloatArray) -> LostLock | None:  # noqa: ARG002
        """None: of the named flights only the level is learned."""
        return None

    def offset_db(self, antenna: str) -> float:
        """Mean of logged minus replayed levels [dB]."""
        source = self.sources[antenna]
        binned = [samples.binned(BIN_S) for samples in source.samples]
        return float(np.nanmean([np.nanmean(b.residual_db - source.replayed_db(b)) for b in binned]))


class Memory:
    """The model that the site remembers: antennas and level of each channel, from flights that are not named.

    Parameters
    ----------
    known : mapping of str to Remembered
        By antenna (``tower.channel``), each with a level.
    site : Site
    """

    def __init__(self, known: Mapping[str, Remembered], site: Site) -> None:
        self.known, self._site = known, site
        self._gain_db: Predictor = by_degree(lambda samples: known[samples.antenna].gain_db(samples))

    def levels(self, each: Sequence[LinkSamples], run_targets: int) -> Levels:  # noqa: ARG002
        """As :meth:`Flown.levels`; a guess where flights taught less than half of the variance, or off the site."""
        memory = self.known[each[0].antenna]
        gains, sds = (np.stack(part) for part in zip(*map(self._gain_db, each), strict=True))
        level, spread, gain_variance = memory.level, memory.spread, (sds**2).mean(axis=0)
        variance_db2 = spread.own_sd_db**2 + spread.noise_sd_db**2 + level.sd_db**2
        west, east, south, north = self._site.area_m
        off = np.any(np.abs(each[0].position_m[:, :2] - (0.5 * (west + east), 0.5 * (south + north)))
                     > (0.5 * (east - west), 0.5 * (north - south)), axis=1)  # fmt: skip
        guess = off | (gain_variance > 0.5 * memory.prior_variance_db2)
        return gains.mean(axis=0) + level.offset_db, np.sqrt(gain_variance + gains.var(axis=0) + variance_db2), guess

    def fading(self, antenna: str) -> Spread:
        """As :meth:`Flown.fading`."""
        return dataclasses.replace(self.known[antenna].spread, own_sd_db=0.0, noise_sd_db=0.0)

    def lost_lock(self, antenna: str, level_db: FloatArray) -> LostLock | None:
        """Forecast in two parts about levels in lock (n,) [dB], of a receiver that loses its lock."""
        memory = self.known[antenna]
        lock, level = memory.series.lock, memory.level
        if lock is None:
            return None
        above_db = level_db - level.offset_db - level.transmit_power_dbm - lock.gain_db
        return LostLock(
            probability=DetectionForecast(level_db=0.0, per_db=lock.per_db, share=lock.share).probability(above_db),
            locked_db=lock.locked_db + lock.locked_per_db * above_db - level_db,
            lost_db=lock.lost_db + lock.lost_per_db * above_db - level_db,
            locked_sd_db=float(np.hypot(lock.locked_sd_db, level.sd_db)),
            lost_sd_db=lock.lost_sd_db,
        )

    def offset_db(self, antenna: str) -> float:
        """Mean of logged levels minus those of the antennas [dB]."""
        return self.known[antenna].level.offset_db

    def sources(self) -> dict[str, Source]:
        """Links by antenna, with isotropic ends."""
        out = {}
        for antenna, memory in self.known.items():
            series, level = memory.series, memory.level
            link = LinkSettings(carrier_hz=series.carrier_hz, transmit_power_dbm=level.transmit_power_dbm)
            out[antenna] = Source(
                tower=series.tower,
                channel=series.channel,
                unit=level.unit,
                link=link,
                site=self._site,
                rss=RssSettings(field="power"),
            )
        return out


def memory_of(place: str | Path, site: Site) -> Memory | None:
    """Return the model of the antennas and levels learned for a site; None if no level of its towers was learned."""
    known = {
        name: entry
        for name, entry in remembered(place).items()
        if entry.series.level and entry.series.tower in site.towers
    }
    return Memory(known, site) if known else None


# Standard deviations of a prediction before any flight [dB]. Offset: transmit power, cables and receiver gain that
# nobody measured. Antennas: the gain of two unknown antennas over directions (a dipole's nulls, mast, airframe).
# Shadowing: 3GPP TR 36.777, table B-3, gives 4.2 dB (LoS) and 6 dB (NLoS) for rural aerial links. Fading: Rayleigh's
# 5.6 dB is the worst case. `benchmarks/first_flight_prediction.py` checks the sum on flights.
PRIOR_OFFSET_DB, PRIOR_ANTENNA_DB, PRIOR_SHADOWING_DB, PRIOR_FADING_DB = 10.0, 8.0, 6.0, 5.0


@dataclass(frozen=True, slots=True)
class Prior:
    """The model before any flight: ray tracing with isotropic antennas, and a wide error that is stated.

    Parameters
    ----------
    site : Site
    link : LinkSettings
        Carrier and transmit power.
    towers : tuple of str
        The towers that are predicted.
    """

    site: Site
    link: LinkSettings
    towers: tuple[str, ...]

    def sources(self) -> dict[str, Source]:
        """Return one link per tower, with isotropic ends and woods that attenuate."""
        rt = RtSettings(foliage="attenuating")
        return {
            f"{tower}.level": Source(
                tower=tower, channel="level", unit="dBm", link=self.link, site=self.site, rt=rt,
                rss=RssSettings(field="power"),
            )
            for tower in self.towers
        }  # fmt: skip

    def levels(self, each: Sequence[LinkSamples], run_targets: int) -> Levels:  # noqa: ARG002
        """Return level above free space and standard deviation (n,) [dB]; no heading matters to isotropic antennas."""
        level = self.sources()[each[0].antenna].replayed_db(each[0])
        return level, np.where(np.isfinite(level), self.slow_sd_db, np.nan), np.ones(len(level), dtype=np.bool_)

    @property
    def slow_sd_db(self) -> float:
        """Standard deviation of a mean over 4 s on a first flight [dB]."""
        return math.sqrt(PRIOR_OFFSET_DB**2 + PRIOR_ANTENNA_DB**2 + PRIOR_SHADOWING_DB**2)

    def fading(self, antenna: str) -> Spread:  # noqa: ARG002
        """Return the spread of samples about their means over 4 s."""
        return dataclasses.replace(NO_SPREAD, fading_sd_db=PRIOR_FADING_DB)

    def lost_lock(self, antenna: str, level_db: FloatArray) -> LostLock | None:  # noqa: ARG002
        """Return None: no receiver is known."""
        return None

    def offset_db(self, antenna: str) -> float:  # noqa: ARG002
        """Return 0: no level was measured [dB]."""
        return 0.0


def outside(position_m: FloatArray, flown: Sequence[LinkSamples]) -> BoolArray:
    """Targets (n,) that are further than :data:`_HULL_M` or :data:`_HULL_UP_M` from every sample."""
    from scipy.spatial import cKDTree

    scaled = np.array([_HULL_M, _HULL_M, _HULL_UP_M])
    places = np.concatenate([s.position_m for s in flown])
    return np.asarray(cKDTree(places / scaled).query(position_m / scaled, distance_upper_bound=1.0)[0] > 1.0)

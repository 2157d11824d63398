"""The live prediction of a tap: the replay at the current pose, its map for the page, and a simulated repeat flight."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..common.errors import InputError, UsageError
from ..common.units import MINIMUM_HEIGHT_M, FloatArray
from ..compare.rank import channel_rank
from ..flight.data import choose_site, gather, read_logs
from ..flight.gains import load_with_learned
from ..flight.replay import replay_poses
from ..flight.settings import FlightFile, LogSettings
from ..live.predict import Predict, Prediction, TelemetryFollower, TelemetrySample, predict_along
from ..live.simulator import flight_rank
from ..logs.readers import by_name
from ..logs.writers import format_vehicle_out
from ..maps.grid import Grid
from ..propagation.geometry import Link, Poses, rotation_from_aircraft
from ..report.live import live_map
from ..site.site import Site

_MAP_HEIGHTS_M = (10.0, 30.0, 50.0, 70.0, 90.0, 110.0)
# Number of cells on the longer side of the background map.
_MAP_CELLS = 70
_DEMO_OFFSET_DB = -38.0
_DEMO_FADING_DB = 2.5


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveTwin:
    """A flight file prepared for predictions at a pose. ``k`` is the value of K for ranks."""

    settings: FlightFile
    site: Site
    link: Link
    telemetry: Path
    k: float

    @classmethod
    def of(cls, flight: Path, telemetry: Path | None = None) -> LiveTwin:
        """Prepare a flight file.

        Parameters
        ----------
        flight : Path
            flight.yaml. The prediction uses the link, the tower and the middle K of ``rank`` in this file.
        telemetry : Path, optional
            The growing telemetry log. Default: the first telemetry log of the flight file.
        """
        settings = load_with_learned(flight)
        site = choose_site(settings.site, flight.parent)
        link = settings.link.rank.build([settings.rank.tower], flight.parent)
        k = sorted(settings.rank.k)[len(settings.rank.k) // 2]
        return cls(
            settings=settings,
            site=site,
            link=link,
            telemetry=telemetry or flight.parent / _telemetry_log(settings).path,
            k=k,
        )

    def predictor(self) -> Predict:
        """Return the prediction function for one modem, which reads the telemetry log."""
        log = _telemetry_log(self.settings)
        reader = by_name(log.reader or "vehicle_out")
        follower = TelemetryFollower(self.telemetry, reader, log.options(self.settings.timezone))
        return predict_along(follower, self.at)

    def at(self, sample: TelemetrySample) -> Prediction:
        """Return the prediction at a pose of the telemetry."""
        if not np.isfinite([sample.latitude_deg, sample.longitude_deg, sample.altitude_m]).all():
            return Prediction()
        place, rotation = self._pose(sample)
        rank, level = self._replayed(place[None], rotation[None])
        east, north, up = map(float, place)
        return Prediction(
            rank=int(rank[0]) or None,
            level_dbm=float(level[0]) if rank[0] else None,
            east_m=east,
            north_m=north,
            up_m=up,
        )

    def map(self) -> dict[str, Any]:
        """Return predicted rank and level over the site at several heights, for a level UAV with heading north."""
        east_min, east_max, north_min, north_max = self.site.area_m
        spacing = max(20.0, max(east_max - east_min, north_max - north_min) / _MAP_CELLS)
        grid = Grid.over_area(self.site.area_m, spacing)
        places = np.concatenate([grid.positions_m(height) for height in _MAP_HEIGHTS_M])
        level = rotation_from_aircraft(np.asarray(0.0), np.asarray(0.0), np.asarray(0.0))
        rank, level_dbm = self._replayed(places, np.broadcast_to(level, (len(places), 3, 3)))
        shape = (len(_MAP_HEIGHTS_M), len(grid.north_m), len(grid.east_m))
        values = rank.reshape(shape), level_dbm.reshape(shape)
        return live_map(self.site, self.settings.rank.tower, self.k, _MAP_HEIGHTS_M, grid, values)

    def _pose(self, sample: TelemetrySample) -> tuple[FloatArray, FloatArray]:
        east, north = self.site.frame.to_local(sample.latitude_deg, sample.longitude_deg)
        ground = float(self.site.ground_under_m(np.array([east]), np.array([north]))[0])
        up = max(sample.altitude_m + self.site.takeoff_ground_m, ground + MINIMUM_HEIGHT_M)
        place, attitude = np.array([float(east), float(north), up]), self.settings.rt.attitude
        if attitude == "ignored" or not np.isfinite(sample.yaw_deg):
            return place, np.eye(3)
        roll, pitch = (0.0, 0.0) if attitude == "level" else (sample.roll_deg, sample.pitch_deg)
        return place, rotation_from_aircraft(np.asarray(roll), np.asarray(pitch), np.asarray(sample.yaw_deg))

    def _replayed(self, places_m: FloatArray, rotations: FloatArray) -> tuple[Any, FloatArray]:
        """Return rank (n,) at ``k`` and level (n,) [dBm]."""
        replayed = replay_poses(self.site, self.settings.rt, self.link, Poses(places_m, rotations), engine="image")
        return channel_rank(replayed.h[:, 0], self.k), replayed.rss_dbm[:, 0]


def _telemetry_log(settings: FlightFile) -> LogSettings:
    return next((entry for entry in settings.logs if entry.reader in (None, "vehicle_out")), settings.logs[0])


class FlownAgain:
    """A simulated repeat of a flight that starts now, for ``modem-sim``: rank, RSRP, and a growing telemetry log.

    Parameters
    ----------
    flight : Path
        flight.yaml with a telemetry log and, for the ranks, a rank log.
    telemetry : Path
        New file for the telemetry.
    """

    def __init__(self, flight: Path, telemetry: Path) -> None:
        twin = LiveTwin.of(flight)
        files = read_logs(twin.settings, flight.parent)
        streams = [stream for file in files for stream in file.result.streams if stream.kind == "telemetry"]
        if not streams or not len(streams[0].frame):
            raise InputError("no telemetry in it", expected="a flight with a vehicleOut log", path=flight)
        self._frame, self._zone = streams[0].frame.sort_values("time"), twin.settings.timezone or "UTC"
        times = self._frame["time"].to_numpy().astype("datetime64[ns]")
        self._seconds = (times - times[0]) / np.timedelta64(1, "s")
        self._lasts_s = float(self._seconds[-1]) + 1.0
        self._level = self._levels(twin)
        measured = gather(twin.settings, flight.parent, files).rank
        self._ranks = measured[0] if measured else None
        self._rank_seconds = (measured[0].time - times[0]) / np.timedelta64(1, "s") if measured else self._seconds
        self._start_ns, self._written = time.time_ns(), 0
        try:
            self._file = telemetry.open("xb", buffering=0)
        except FileExistsError:
            raise UsageError("the file exists", expected="a new name after --telemetry", path=telemetry) from None

    def _levels(self, twin: LiveTwin) -> FloatArray:
        """Return the RSRP at each line of the telemetry: the replay, an offset, and fading."""
        names = ("latitude_deg", "longitude_deg", "altitude_m", "roll_deg", "pitch_deg", "yaw_deg")
        rows = self._frame[list(names)].to_numpy(dtype="float64")
        poses = [twin._pose(TelemetrySample(0, *row)) for row in rows]
        level = twin._replayed(np.stack([p for p, _ in poses]), np.stack([r for _, r in poses]))[1]
        fading = np.random.default_rng(7).normal(0.0, _DEMO_FADING_DB, len(level))
        # -140 dBm is the lowest RSRP that a modem reports
        return np.asarray(np.nan_to_num(level + _DEMO_OFFSET_DB + fading, nan=-140.0))

    def rank(self, seconds: float) -> int:
        """Return the rank of the flight's first rank log, else of the built-in flight, at a time. 0: no CSI."""
        if self._ranks is None:
            return flight_rank(seconds)
        at = int(np.searchsorted(self._rank_seconds, seconds % self._lasts_s, side="right")) - 1
        return 0 if at < 0 else int(np.nan_to_num(self._ranks.rank[at]))

    def rsrp(self, seconds: float) -> float:
        """Return the RSRP at a time after the start [dBm]."""
        return float(np.interp(seconds % self._lasts_s, self._seconds, self._level))

    def __call__(self) -> None:
        """Write the telemetry lines that are due."""
        elapsed = (time.time_ns() - self._start_ns) / 1e9
        while self._due() <= elapsed:
            row = self._frame.iloc[[self._written % len(self._frame)]].copy()
            row["time"] = np.datetime64(self._start_ns + int(self._due() * 1e9), "ns")
            line = format_vehicle_out(row, self._zone).partition(b",")[2]  # replace the line number
            self._written += 1
            self._file.write(b"%d," % self._written + line)

    def _due(self) -> float:
        rounds, line = divmod(self._written, len(self._frame))
        return rounds * self._lasts_s + float(self._seconds[line])

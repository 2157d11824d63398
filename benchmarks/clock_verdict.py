"""How often a clock that is off is found, and how often one that is not is called off: simulated and real flights.

Simulated: zigzags of 6 to 12 minutes around a tower, two channels, two-ray level, shadowing correlated over place, fast
fading, and a UAV pattern that the model does not know; lags of 0.5 to 10 s of either sign are planted. Real (needs the
field logs): every flight with levels and positions, as logged and with the radio times shifted; the clocks of these
logs agree within about a second, so an "ok" farther than that from what was planted is a false one. Models are free
space, two-ray and, for dataset 12, the flight files of tests/field.

    AERPAW_CMP_FIELD_DATA=DIR python benchmarks/clock_verdict.py [--flights 40] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.io import loadmat

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.flight.clock import ClockChannel, ClockEstimate, judge_clock
from aerpaw_cmp.flight.data import gather, read_logs
from aerpaw_cmp.flight.lag import direction_terms
from aerpaw_cmp.flight.replay import estimate_clocks
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.flight.track import Track
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.propagation.field.baselines import free_space_dbm, two_ray_dbm
from aerpaw_cmp.site.siteyaml import load_site

Level = Callable[[np.ndarray], np.ndarray]
PLANTED_S = (0.5, 1.0, 2.0, 5.0, 10.0)
TRUE_WITHIN_S = 1.0
"""The clocks of the real logs agree this far [s]."""


# --- simulated -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Route:
    """A zigzag with sharp turns: position (n, 3) [m] and heading [deg] at true time."""

    at: np.ndarray
    corner: np.ndarray

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Route:
        legs = int(rng.integers(8, 16))
        corner = np.column_stack([
            np.where(np.arange(legs + 1) % 2, 1, -1) * rng.uniform(150, 300) + rng.uniform(-20, 20, legs + 1),
            np.linspace(-250, 250, legs + 1),
            rng.uniform(35, 60) + rng.uniform(-5, 5, legs + 1),
        ])  # fmt: skip
        seconds = np.linalg.norm(np.diff(corner, axis=0), axis=1) / rng.uniform(7, 11)
        return cls(np.concatenate([[0.0], np.cumsum(seconds)]), corner)

    def position(self, t: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(t, self.at, self.corner[:, i]) for i in range(3)])

    def relative_deg(self, t: np.ndarray) -> np.ndarray:
        """Direction of the tower off the nose."""
        ahead = self.position(t + 0.5) - self.position(t - 0.5)
        place = self.position(t)
        return np.degrees(np.arctan2(-place[:, 0], -place[:, 1]) - np.arctan2(ahead[:, 0], ahead[:, 1]))


def two_ray(position: np.ndarray) -> np.ndarray:
    """A ground that reflects half of the field."""
    wave = 2j * np.pi * 3.3e9 / 299_792_458.0
    direct, ground = (np.sqrt((position[:, :2] ** 2).sum(axis=1) + (position[:, 2] + h) ** 2) for h in (-10.0, 10.0))
    return 20 * np.log10(np.abs(np.exp(-wave * direct) / direct - 0.5 * np.exp(-wave * ground) / ground))


def shadowing(rng: np.random.Generator, sigma_db: float) -> Callable[[np.ndarray], np.ndarray]:
    """Correlated over place (about 40 m), by random waves."""
    wave, phase = rng.normal(0, 1 / 40.0, (60, 2)), rng.uniform(0, 2 * np.pi, 60)
    return lambda p: sigma_db * np.sqrt(2 / 60) * np.cos(p[:, :2] @ wave.T + phase).sum(axis=1)


def simulated(rng: np.random.Generator, lag_s: float) -> ClockEstimate:
    """A flight whose radio shows ``lag_s`` more."""
    route = Route.drawn(rng)
    t = np.arange(0.0, route.at[-1], 0.25)
    shade, pattern = shadowing(rng, 3.0), rng.uniform(0, 360, 2)

    def terms(times: np.ndarray) -> np.ndarray:
        p = route.position(times)
        azimuth = np.degrees(np.arctan2(p[:, 0], p[:, 1]))
        elevation = np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])))
        return direction_terms(azimuth, elevation, route.relative_deg(times))

    place = route.position(t)
    heard = two_ray(place) + shade(place)
    channels = [
        ClockChannel(
            name=f"channel {i}",
            times=t + lag_s,
            measured_db=heard
            + 1.5 * np.cos(np.radians(route.relative_deg(t) - pattern[i]))
            + rng.normal(0, 2.0, len(t)),
            predictor=lambda times: two_ray(route.position(times)),
            terms=terms,
        )
        for i in range(2)
    ]
    return judge_clock(channels, window_s=15.0)


def simulated_table(flights: int) -> dict[str, object]:
    """Verdicts and errors over planted lags, and of flights without any."""
    rng = np.random.default_rng(14)
    rows, errors = [], []
    for _ in range(flights):
        lag = float(rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(0.5), np.log(10.0))))
        found = simulated(rng, lag)
        error = found.radio_minus_telemetry_s - lag
        errors.append(abs(error))
        rows.append((found.verdict, abs(error) <= 0.3, found.reason if found.verdict != "ok" else ""))
    still = [simulated(rng, 0.0) for _ in range(flights)]
    ok = [good for verdict, good, _ in rows if verdict == "ok"]
    return {
        "flights": flights,
        "ok": len(ok) / flights,
        "ok_and_within_0.3_s": sum(ok) / flights,
        "false_ok": sum(not good for good in ok),
        "median_error_s": float(np.median(errors)),
        "why_not": dict(Counter(reason.split(";")[0][:60] for _, _, reason in rows if reason)),
        "unshifted_verdicts": dict(Counter(found.verdict for found in still)),
        "unshifted_false_ok": sum(f.verdict == "ok" and abs(f.radio_minus_telemetry_s) > 0.3 for f in still),
    }


# --- real ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Real:
    """A real flight: channels of one receiver, the track and the tower's place."""

    name: str
    time: np.ndarray
    levels: Mapping[str, np.ndarray]
    track: Track
    tower_m: np.ndarray
    carrier_hz: float

    def judged(self, model: str, shift_s: float) -> ClockEstimate:
        """With the radio times shifted."""
        shift = np.timedelta64(round(shift_s * 1e9), "ns")

        def position(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            poses = self.track.pose_at(times)
            high = poses.position_m[:, 2] > 5.0
            return np.where(high[:, None], poses.position_m, np.nan), poses.heading_deg

        def level(times: np.ndarray) -> np.ndarray:
            place, ends = position(times)[0], (self.carrier_hz, 30.0)
            known = np.isfinite(place).all(axis=1)
            out = np.full(len(place), np.nan)
            ray = free_space_dbm if model == "free space" else two_ray_dbm
            out[known] = ray(self.tower_m[None], place[known], *ends)[:, 0]
            return out

        def terms(times: np.ndarray) -> np.ndarray:
            place, heading = position(times)
            line = place - self.tower_m
            azimuth = np.degrees(np.arctan2(line[:, 0], line[:, 1]))
            elevation = np.degrees(np.arctan2(line[:, 2], np.hypot(line[:, 0], line[:, 1])))
            return direction_terms(azimuth, elevation, azimuth + 180 - heading)

        return judge_clock(
            [
                ClockChannel(name=name, times=self.time + shift, measured_db=values, predictor=level, terms=terms)
                for name, values in self.levels.items()
            ],
            model=model,
            window_s=15.0,
        )


def real_flights(root: Path) -> Iterator[Real]:
    """Every flight of the field folder with levels and positions."""
    frame = SiteFrame(35.72750947, -78.69595819)
    options = ReadOptions(timezone="America/New_York")
    rovers = [
        tuple(float(v) for v in line.split(","))
        for line in (root / "sounder" / "rover_positions.txt").read_text().splitlines()[:3]
    ]
    towers = load_site("lake_wheeler").towers
    lw1 = np.asarray(towers["LW1"].position_m, dtype=float)
    for path in [*sorted((root / "dataset12").glob("*.mat")), *sorted((root / "afar").glob("*.mat")),
                 *sorted((root / "sounder").glob("*.mat"))]:  # fmt: skip
        (file,) = ingest([path], options=options)
        streams = file.result.streams
        telemetry = next(s.frame for s in streams if s.kind == "telemetry")
        rss = {s.name: s.frame for s in streams if s.kind == "rss" and s.name != "quality"}
        place = lw1
        if "loc_" in path.stem:
            latitude, longitude = rovers[int(path.stem.rsplit("_", 1)[1]) - 1]
            east, north = frame.to_local(latitude, longitude)
            place = np.array([float(east), float(north), 1.5])
        first = next(iter(rss.values()))
        levels = {name: f["rss_db"].to_numpy(float) for name, f in rss.items() if len(f) == len(first)}
        thin = slice(None, None, max(1, len(first) // 6000))
        yield Real(
            f"{path.parent.name}/{path.stem}", first["time"].to_numpy()[thin],
            {name: values[thin] for name, values in levels.items()}, Track(telemetry, frame), place, 3.3e9,
        )  # fmt: skip
    for path in sorted((root / "lte").glob("*.mat")):
        data = {k: np.ravel(v) for k, v in loadmat(path).items() if k in ("mX", "mY", "mZ", "timestamp_meas", "RSRP")}
        time = pd.to_datetime(data["timestamp_meas"], unit="s").to_numpy()
        table = pd.DataFrame({
            "time": time, "longitude_deg": data["mX"], "latitude_deg": data["mY"], "altitude_m": data["mZ"],
        })  # fmt: skip
        thin = slice(None, None, 3)
        yield Real(
            f"lte/{path.stem}", time[thin], {"RSRP": data["RSRP"][thin].astype(float)}, Track(_bare(table), frame),
            lw1, 3.51e9,
        )  # fmt: skip
    telemetry, snr = ingest(
        [root / "telemetry" / "2025-05-24_vehicleOut.txt", root / "aadm" / "snr_log.csv"], options=options
    )
    track = Track(next(s.frame for s in telemetry.result.streams if s.kind == "telemetry"), frame)
    for stream in snr.result.streams:
        tower = next((name for name in towers if name.lower() in stream.name.lower()), None)
        if tower:
            yield Real(
                f"aadm/{tower}", stream.frame["time"].to_numpy(), {"snr": stream.frame["rss_db"].to_numpy(float)},
                track, np.asarray(towers[tower].position_m, dtype=float), 3.3e9,
            )  # fmt: skip
    for path in sorted((root / "nr_rank").glob("*.csv")):
        (file,) = ingest([path], options=ReadOptions(timezone="America/New_York", time_origin="2024-07-02T12:00:00"))
        table = next(s.frame for s in file.result.streams if s.kind == "rank").assign(fix=3, satellites=10)
        for name in (
            "roll_deg",
            "pitch_deg",
            "yaw_deg",
            "velocity_north_mps",
            "velocity_east_mps",
            "velocity_down_mps",
        ):
            table[name] = np.nan
        yield Real(
            f"nr_rank/{path.stem}", table["time"].to_numpy(), {"rsrp": table["rsrp_dbm"].to_numpy(float)},
            Track(table, frame), lw1, 3.4e9,
        )  # fmt: skip


def _bare(table: pd.DataFrame) -> pd.DataFrame:
    """Positions without attitude and velocity as telemetry."""
    names = ["roll_deg", "pitch_deg", "yaw_deg", *(f"velocity_{axis}_mps" for axis in ("north", "east", "down"))]
    return table.assign(fix=3, satellites=10, flag="", **dict.fromkeys(names, np.nan))


def real_table(root: Path) -> list[dict[str, object]]:
    """One row per flight and model: the verdict as logged, and what shifts of the radio times did."""
    rows: list[dict[str, object]] = []
    for flight in real_flights(root):
        for model in ("free space", "two-ray"):
            rows.append(_row(flight.name, model, flight.judged(model, 0.0)))
            for planted in PLANTED_S:
                for sign in (-1, 1) if planted == 5.0 else (1,):
                    found = flight.judged(model, sign * planted)
                    rows.append(_row(flight.name, model, found, sign * planted))
    for name in ("dataset12_40m", "dataset12_70m", "dataset12_40m_mount", "dataset12_70m_mount"):
        path = Path(__file__).parents[1] / "tests" / "field" / f"{name}.yaml"
        settings = load_flight(path)
        data = gather(settings, path.parent, read_logs(settings, path.parent, root), root)
        clock = next(c for c in estimate_clocks(data) if c is not None).result
        rows.append({
            "flight": name, "model": "its flight file", "planted_s": 0.0, "verdict": clock.verdict,
            "found_s": clock.radio_minus_telemetry_s, "explained": clock.checks.get("explained"),
            "reason": clock.reason,
            "false_ok": clock.verdict == "ok" and abs(clock.radio_minus_telemetry_s) > TRUE_WITHIN_S,
        })  # fmt: skip
    return rows


def _row(name: str, model: str, found: ClockEstimate, planted: float = 0.0) -> dict[str, object]:
    return {
        "flight": name,
        "model": model,
        "planted_s": planted,
        "verdict": found.verdict,
        "found_s": found.radio_minus_telemetry_s,
        "explained": found.explained,
        "reason": found.reason,
        "false_ok": found.verdict in ("ok", "agree") and abs(found.radio_minus_telemetry_s - planted) > TRUE_WITHIN_S,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=40, help="simulated flights")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    table = simulated_table(arguments.flights)
    root = os.environ.get("AERPAW_CMP_FIELD_DATA")
    rows = real_table(Path(root)) if root else []
    if arguments.json:
        print(json.dumps({"simulated": table, "real": rows}))
        return
    for name, value in table.items():
        print(f"{name:22s} {value}")
    for row in rows:
        if row["planted_s"] == 0.0 or row["verdict"] in ("ok", "agree"):
            print(
                f"{row['flight']!s:45s} {row['model']!s:16s} planted {row['planted_s']:+5.1f}  {row['verdict']!s:10s}"
                f" {row['found_s']:+6.2f} s  explains {row['explained'] or float('nan'):.2f}  {str(row['reason'])[:70]}"
            )
    still = [row for row in rows if row["planted_s"] == 0.0]
    print(
        f"real, as logged: {len(still)} flights x models, {sum(bool(r['false_ok']) for r in still)} false ok; shifted: "
        f"{len(rows) - len(still)}, {sum(r['verdict'] == 'ok' for r in rows)} ok, "
        f"{sum(bool(r['false_ok']) for r in rows if r['planted_s'])} of them false"
    )


if __name__ == "__main__":
    main()

"""RMSE of simple to detailed models on the two real RSS flights around LW1 (needs the field logs).

The UAV transmits at 3.3 GHz and LW1 receives on two channels, at 40 m and at 70 m. Every model has its own best
offset per flight and channel and nothing else fitted, but for the azimuths of the three antennas (the UAV's, and one
per channel at the tower) in the rows that say so: those are fitted on one flight and scored on the other. The last rows
also learn, on the other flight, how much gain mast and airframe add per azimuth (compare/installed.py). Both flights
follow one route, so such a correction may learn the place together with the antenna.
Each model is scored on several footings: samples as they are; both sides averaged in power over four seconds; over
stretches of path of 40 wavelengths and of 20 m, the local mean that a ray model without fast fading can predict, where
every stretch counts once however long the UAV hovered there (a third of the samples are hover at three waypoints); and
the samples of cruise alone (heights within 5 m of the commonest, the filter of the authors of these data). A bound is
printed too: what the best azimuths of all, chosen for every flight and channel on the samples that are scored, would
reach.

    AERPAW_CMP_FIELD_DATA=DIR python benchmarks/field_models.py [--quick] [--json]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from aerpaw_cmp.common.units import BoolArray, FloatArray, wavelength_m
from aerpaw_cmp.compare.heldout import HeldOutFit, fit_held_out
from aerpaw_cmp.compare.installed import InstalledFit, LinkAngles, fit_installed
from aerpaw_cmp.compare.offset import grid_offset
from aerpaw_cmp.compare.rss import local_mean_db, stretch_means_db, stretches
from aerpaw_cmp.flight.data import FlightData, gather, read_logs
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.propagation.arrays import Isotropic, Link, Pattern, Poses, rotation_from_yaw_pitch_roll, single_element
from aerpaw_cmp.propagation.field.baselines import free_space_dbm, two_ray_dbm
from aerpaw_cmp.propagation.field.foliage import CrownIndex, foliage_loss_db, foliage_model
from aerpaw_cmp.propagation.options import Field, Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.antennas import read_gain_grid
from aerpaw_cmp.site.installed import InstalledPattern

TOWER = "LW1"
CARRIER_HZ = 3.3e9
WINDOW_S = 4.0
SPAN_DB = (-100.0, 100.0)
PAPER = {"uav": 315.0, "tower": 45.0}
"""Azimuths that arXiv 2502.10324 states for its arrays [deg, counter-clockwise from east]."""
PUBLISHED = {"USRP1": 120.0, "USRP2": PAPER["tower"]}
"""Azimuths of the tower antennas in print. 120 deg is what the authors of the data set take for its first channel in
the code beside arXiv 2603.10362, found by them from flights of this set; the second has none but the paper's."""
CRUISE_M = 5.0
FLIGHTS = {
    name: Path(__file__).parents[1] / "tests" / "field" / f"{name}.yaml" for name in ("dataset12_40m", "dataset12_70m")
}


@dataclasses.dataclass(frozen=True, slots=True)
class Flight:
    """Samples above the flight file's lowest height: seconds (n,), poses, level [dB] by channel."""

    data: FlightData
    time_s: FloatArray
    poses: Poses
    measured_db: Mapping[str, FloatArray]

    def thinned(self, step: int) -> Flight:
        """Every ``step``-th sample."""
        poses = Poses(self.poses.position_m[::step], self.poses.rotation[::step])
        return Flight(self.data, self.time_s[::step], poses, {c: m[::step] for c, m in self.measured_db.items()})


@dataclasses.dataclass(frozen=True, slots=True)
class Patterns:
    """Measured gain of the antennas."""

    tower: Pattern
    uav: Pattern


Model = Callable[[Flight, str], FloatArray]
"""``model(flight, channel) -> level_db`` (n,)."""


def read_flight(path: Path, root: Path) -> Flight:
    """One flight; both channels share their instants."""
    settings = load_flight(path)
    data = gather(settings, path.parent, read_logs(settings, path.parent, root), root)
    assert data.track is not None
    time_stamp = data.rss[0].time
    pose = data.track.pose_at(time_stamp)
    with np.errstate(invalid="ignore"):
        keep = pose.valid & (pose.position_m[:, 2] >= settings.rss.minimum_height_m)
    return Flight(
        data,
        ((time_stamp - time_stamp[0]) / np.timedelta64(1, "s"))[keep],
        Poses(pose.position_m[keep], pose.rotation[keep]),
        {series.channel: series.measured_db[keep] for series in data.rss},
    )


def yaw_deg(angle: float) -> FloatArray:
    """Mount turned by an azimuth."""
    return rotation_from_yaw_pitch_roll(np.radians(angle), 0.0, 0.0)  # type: ignore[arg-type]


def traced(
    flight: Flight,
    tower: tuple[Pattern, float] = (Isotropic(), 0.0),
    uav: tuple[Pattern, float] = (Isotropic(), 0.0),
    *,
    depth: int = 0,
    attitude: bool = True,
    trees: bool = False,
    power: bool = False,
) -> FloatArray:
    """Level (n,) [dBm] by the image engine with a pattern and a mount azimuth at each end."""
    site = flight.data.site
    link = Link(
        CARRIER_HZ, {TOWER: single_element(tower[0], yaw_deg(tower[1]))}, single_element(uav[0], yaw_deg(uav[1]))
    )
    rotation = flight.poses.rotation if attitude else np.broadcast_to(np.eye(3), flight.poses.rotation.shape)
    loss = None
    if trees:
        crowns, leafy = CrownIndex(site.trees), foliage_model("attenuating", CARRIER_HZ)

        def loss(paths: Any, sources: FloatArray, targets: FloatArray) -> FloatArray:
            return foliage_loss_db(sources[paths.tower], paths.vertices_m, targets[paths.pose], crowns, leafy)

    found = replay(site, link, Poses(flight.poses.position_m, rotation), Search(max_depth=depth), Field(loss=loss))
    return (found.rss_power_dbm if power else found.rss_dbm)[:, 0]


def baseline(formula: Callable[..., FloatArray]) -> Model:
    """Free space or two-ray."""

    def level(flight: Flight, _channel: str) -> FloatArray:
        ends = flight.data.site.towers[TOWER].position_m[None, :], flight.poses.position_m
        return formula(*ends, CARRIER_HZ)[:, 0]

    return level


def published_model(patterns: Patterns, *, attitude: bool) -> Model:
    """Azimuths in print, nothing of these flights but the offset."""

    def level(flight: Flight, channel: str) -> FloatArray:
        ends = (patterns.tower, PUBLISHED[channel]), (patterns.uav, PAPER["uav"])
        return traced(flight, *ends, attitude=attitude)

    return level


def fixed_models(patterns: Patterns) -> dict[str, Model]:
    """Models in which nothing but the offset is fitted."""
    tower, uav = (patterns.tower, PAPER["tower"]), (patterns.uav, PAPER["uav"])
    nose = (patterns.uav, 0.0)

    def model(*ends: tuple[Pattern, float], **options: Any) -> Model:
        return lambda flight, _channel: traced(flight, *ends, **options)

    return {
        "free space": baseline(free_space_dbm),
        "two-ray, closed form": baseline(two_ray_dbm),
        "isotropic, line of sight + ground, coherent": model(depth=1),
        "isotropic, line of sight + ground, power sum": model(depth=1, power=True),
        "measured patterns at the paper's azimuths": model(tower, uav, attitude=False),
        "patterns at published azimuths": published_model(patterns, attitude=False),
        "patterns at published azimuths + attitude": published_model(patterns, attitude=True),
        "measured patterns + attitude (UAV forward)": model(tower, nose),
        "measured patterns + attitude + ground, coherent": model(tower, nose, depth=1),
        "measured patterns + attitude + ground, power sum": model(tower, nose, depth=1, power=True),
        "measured patterns + attitude + illustrative trees": model(tower, nose, trees=True),
    }


def fit_mount(flights: Mapping[str, Flight], patterns: Patterns, train: str, test: str, step_deg: float) -> HeldOutFit:
    """Azimuths of the UAV antenna and of each channel's tower antenna, fitted on ``train``."""
    thin = {name: flight.thinned(4) for name, flight in flights.items()}
    kept: dict[tuple[str, str, float, float], FloatArray] = {}

    def residual(flight: str, channel: str, tower: float, uav: float) -> FloatArray:
        key = (flight, channel, tower, uav)
        if key not in kept:
            level = traced(thin[flight], (patterns.tower, tower), (patterns.uav, uav))
            for name, measured in thin[flight].measured_db.items():
                kept[flight, name, tower, uav] = (measured - level) - np.mean(measured - level)
        return kept[key]

    def objective(angles: Mapping[str, float], flight: str) -> FloatArray:
        channels = thin[flight].measured_db
        return np.concatenate([residual(flight, c, angles[c], angles["uav"]) for c in channels])

    grid = np.arange(0.0, 360.0, step_deg)
    names = ["uav", *next(iter(flights.values())).measured_db]
    start = {"uav": 0.0, **dict.fromkeys(names[1:], PAPER["tower"])}
    return fit_held_out(
        objective, dict.fromkeys(names, grid), [train], [test], start=start, largest_grid=60_000, circular=names
    )


def transferred_models(patterns: Patterns, mounts: Mapping[str, HeldOutFit]) -> dict[str, Model]:
    """Models with the mount fitted on the other flight; ``mounts`` by the flight to be scored."""

    def model(**options: Any) -> Model:
        def level(flight: Flight, channel: str) -> FloatArray:
            angles = mounts[flight.data.settings.flight.name].parameters
            return traced(flight, (patterns.tower, angles[channel]), (patterns.uav, angles["uav"]), **options)

        return level

    return {
        "patterns + attitude + mount of the other flight": model(),
        "mount of the other flight, heading only": _level_flight(model()),
        "mount of the other flight + ground, power sum": model(depth=1, power=True),
        "mount of the other flight + ground, coherent": model(depth=1),
        "mount of the other flight + illustrative trees": model(trees=True),
    }


FURTHER: dict[str, dict[str, list[float]]] = {
    "tilt of the UAV antenna": {"uav_pitch": [-15, -5, 0, 5, 15], "uav_roll": [-15, -5, 0, 5, 15]},
    "tilt of the tower antennas": {"tower_pitch": [-15, -5, 0, 5, 15], "tower_roll": [-15, -5, 0, 5, 15]},
    "path-loss exponent": {"exponent": [1.2, 1.6, 2.0, 2.4, 2.8]},
    "clock of the radio": {"lag_s": [-2, -1, 0, 1, 2]},
    "tower height and place": {"up": [0, 2, 5], "east": [-6, 0, 6], "north": [-6, 0, 6]},
    "ground reflection, power sum, of any strength": {"ground": [0.0, 0.3, 0.6, 1.0]},
}
"""What could be wrong besides azimuths, with values to start from; the simplex goes on between them."""


def with_parameter(flight: Flight, patterns: Patterns, mount: Mapping[str, float], channel: str,
                   given: Mapping[str, float]) -> FloatArray:  # fmt: skip
    """Line of sight (and ground) in closed form with one more parameter (n,) [dB]."""
    place = flight.data.site.towers[TOWER].position_m + [given.get(axis, 0.0) for axis in ("east", "north", "up")]
    target = flight.poses.position_m
    tower = turned(mount[channel], given.get("tower_pitch", 0.0), given.get("tower_roll", 0.0))
    uav = flight.poses.rotation @ turned(mount["uav"], given.get("uav_pitch", 0.0), given.get("uav_roll", 0.0))

    def ray(leaves: FloatArray, arrives: FloatArray) -> FloatArray:
        gain = gain_dbi(patterns.tower, leaves @ tower) + gain_dbi(patterns.uav, np.einsum("nji,nj->ni", uav, -arrives))
        return gain - 10.0 * given.get("exponent", 2.0) * np.log10(np.linalg.norm(leaves, axis=1))

    level = ray(target - place, target - place)
    if given.get("ground", 0.0) > 0.0:
        down = target * [1, 1, -1] - place
        bounced = ray(down, down * [1, 1, -1]) + 20.0 * np.log10(given["ground"])
        level = 10.0 * np.log10(10.0 ** (level / 10.0) + 10.0 ** (bounced / 10.0))
    return np.interp(flight.time_s - given.get("lag_s", 0.0), flight.time_s, level)


def gain_dbi(pattern: Any, direction: FloatArray) -> FloatArray:
    """Gain towards directions (n, 3) in the device frame."""
    across = np.hypot(direction[:, 0], direction[:, 1])
    return pattern.gain_dbi(np.arctan2(across, direction[:, 2]), np.arctan2(direction[:, 1], direction[:, 0]))


def turned(yaw: float, pitch: float, roll: float) -> FloatArray:
    """Mount from angles in degrees."""
    return rotation_from_yaw_pitch_roll(*np.radians([yaw, pitch, roll]))


def further_parameters(
    flights: Mapping[str, Flight], patterns: Patterns, mounts: Mapping[str, HeldOutFit]
) -> dict[str, Any]:
    """Each set of FURTHER fitted on one flight beside that flight's azimuths, scored on the other."""
    thin = {name: flight.thinned(4) for name, flight in flights.items()}
    found: dict[str, Any] = {}
    for what, values in FURTHER.items():
        rows = []
        for test, mount in mounts.items():

            def objective(given: Mapping[str, float], name: str, mount: HeldOutFit = mount) -> FloatArray:
                flight = thin[name]
                parts = [
                    m - with_parameter(flight, patterns, mount.parameters, c, given)
                    for c, m in flight.measured_db.items()
                ]
                return np.concatenate([part - part.mean() for part in parts])

            start = {name: 2.0 if name == "exponent" else 0.0 for name in values}
            fit = fit_held_out(objective, values, mount.fitted_on, [test], start=start)
            rows.append(
                {
                    "fitted_on": fit.fitted_on[0],
                    "parameters": dict(fit.parameters),
                    "gain_on_itself_db": fit.start_rmse_db[fit.fitted_on[0]] - fit.train_rmse_db[fit.fitted_on[0]],
                    "gain_on_the_other_db": fit.start_rmse_db[test] - fit.test_rmse_db[test],
                }
            )
        found[what] = rows
    return found


def angles_of(flight: Flight, tower_deg: float, uav_deg: float) -> LinkAngles:
    """Directions of both ends in each other's device frame."""
    ray = flight.poses.position_m - flight.data.site.towers[TOWER].position_m
    at_tower = ray @ yaw_deg(tower_deg)
    at_uav = np.einsum("nji,nj->ni", flight.poses.rotation @ yaw_deg(uav_deg), -ray)

    def of(v: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.arctan2(v[:, 1], v[:, 0]), np.arctan2(np.hypot(v[:, 0], v[:, 1]), v[:, 2])

    return LinkAngles(*of(at_uav), *of(at_tower))


def fit_added_gain(flight: Flight, patterns: Patterns, mount: Mapping[str, float]) -> InstalledFit:
    """Added gain per azimuth of both ends from one flight, with a mount fitted on that same flight."""
    residual, angles = {}, {}
    for channel, measured in flight.measured_db.items():
        level = traced(flight, (patterns.tower, mount[channel]), (patterns.uav, mount["uav"]))
        residual[channel] = measured - level
        angles[channel] = angles_of(flight, mount[channel], mount["uav"])
    return fit_installed(residual, angles)


def installed_model(patterns: Patterns, mounts: Mapping[str, HeldOutFit], gains: Mapping[str, InstalledFit]) -> Model:
    """Mount and added gain, both of the other flight."""

    def level(flight: Flight, channel: str) -> FloatArray:
        name = flight.data.settings.flight.name
        mount, gain = mounts[name].parameters, gains[name]
        tower = InstalledPattern(patterns.tower, gain.tower_db[channel])
        uav = InstalledPattern(patterns.uav, gain.uav_db)
        return traced(flight, (tower, mount[channel]), (uav, mount["uav"]))

    return level


def _level_flight(model: Model) -> Model:
    def level(flight: Flight, channel: str) -> FloatArray:
        nose = flight.poses.rotation[:, :, 0]
        heading = np.arctan2(nose[:, 1], nose[:, 0])
        flat = rotation_from_yaw_pitch_roll(heading, np.zeros_like(heading), np.zeros_like(heading))
        return model(dataclasses.replace(flight, poses=Poses(flight.poses.position_m, flat)), channel)

    return level


def cruise(flight: Flight) -> BoolArray:
    """Samples (n,) within 5 m of the commonest height."""
    height = flight.poses.position_m[:, 2]
    whole, count = np.unique(np.round(height), return_counts=True)
    return np.asarray(np.abs(height - whole[count.argmax()]) < CRUISE_M)


WAVELENGTHS_40_M = 40.0 * wavelength_m(CARRIER_HZ)
FOOTINGS = ("as_logged", "mean_4s", "mean_40_wavelengths", "mean_20m", "cruise")


def footing_pair(flight: Flight, footing: str, measured: FloatArray, level: FloatArray) -> tuple[FloatArray, ...]:
    """Both sides (m,) as a footing compares them."""
    sides = (measured, level)
    if footing == "mean_4s":
        return tuple(local_mean_db(flight.time_s, side, WINDOW_S) for side in sides)
    if footing in ("mean_40_wavelengths", "mean_20m"):
        stretch = stretches(flight.poses.position_m, 20.0 if footing == "mean_20m" else WAVELENGTHS_40_M)
        return tuple(stretch_means_db(stretch, side) for side in sides)
    keep = cruise(flight) if footing == "cruise" else np.ones(len(measured), np.bool_)
    return tuple(side[keep] for side in sides)


def score(flights: Mapping[str, Flight], model: Model) -> dict[str, Any]:
    """RMSE [dB] per flight and channel, and their means, on every footing."""
    cells: dict[str, dict[str, float]] = {footing: {} for footing in FOOTINGS}
    for name, flight in flights.items():
        for channel, measured in flight.measured_db.items():
            level = model(flight, channel)
            for footing in FOOTINGS:
                pair = footing_pair(flight, footing, measured, level)
                cells[footing][f"{name} {channel}"] = grid_offset(*pair, span_db=SPAN_DB).rmse_db
    return {footing: {**row, "mean": float(np.mean(list(row.values())))} for footing, row in cells.items()}


def bounds(flights: Mapping[str, Flight], patterns: Patterns, step_deg: float) -> dict[str, Any]:
    """Least RMSE [dB] that azimuths chosen for each flight and channel on the scored samples reach, in half steps."""
    azimuths = np.arange(0.0, 360.0, step_deg / 2.0)
    found: dict[str, Any] = {}
    for footing in ("as_logged", "cruise"):
        cells = {}
        for name, flight in flights.items():
            keep = cruise(flight) if footing == "cruise" else np.ones(len(flight.time_s), np.bool_)
            ray = (flight.poses.position_m - flight.data.site.towers[TOWER].position_m)[keep]
            body = np.einsum("nji,nj->ni", flight.poses.rotation[keep], -ray)
            uav = np.stack([gain_dbi(patterns.uav, body @ yaw_deg(a)) for a in azimuths])
            tower = np.stack([gain_dbi(patterns.tower, ray @ yaw_deg(a)) for a in azimuths])
            distance_db = 20.0 * np.log10(np.linalg.norm(ray, axis=1))
            for channel, measured in flight.measured_db.items():
                residual = measured[keep] + distance_db
                spread = np.array([np.std(residual - one - tower, axis=1) for one in uav])
                cells[f"{name} {channel}"] = float(spread.min())
        found[footing] = {**cells, "mean": float(np.mean(list(cells.values())))}
    return found


def scatter(flights: Mapping[str, Flight]) -> dict[str, Any]:
    """Scatter of the measured level about its 4 s mean [dB], how far two channels share it, share of hover."""
    found = {}
    for name, flight in flights.items():
        speed = np.linalg.norm(np.gradient(flight.poses.position_m, axis=0), axis=1) / np.gradient(flight.time_s)
        quick = {c: m - local_mean_db(flight.time_s, m, WINDOW_S) for c, m in flight.measured_db.items()}
        found[name] = {
            "within_4s_db": {c: float(np.std(q)) for c, q in quick.items()},
            "correlation_of_channels": float(np.corrcoef(*quick.values())[0, 1]),
            "share_below_1_mps": float(np.mean(speed < 1.0)),
        }
    return found


def table(root: Path, step_deg: float) -> dict[str, Any]:
    """All models on both flights."""
    antennas = root / "antennas" / "rad_pat.mat"
    patterns = Patterns(read_gain_grid(antennas, "RMWB3300_normal"), read_gain_grid(antennas, "SA3300"))
    flights = {name: read_flight(path, root) for name, path in FLIGHTS.items()}
    rows = {name: score(flights, model) for name, model in fixed_models(patterns).items()}
    one, two = FLIGHTS
    mounts = {test: fit_mount(flights, patterns, train, test, step_deg) for train, test in ((one, two), (two, one))}
    rows |= {name: score(flights, model) for name, model in transferred_models(patterns, mounts).items()}
    gains = {
        test: fit_added_gain(flights[train], patterns, mounts[test].parameters)
        for train, test in ((one, two), (two, one))
    }
    rows["mount and added gain of the other flight"] = score(flights, installed_model(patterns, mounts, gains))
    iso = Patterns(Isotropic(), Isotropic())
    control = {
        test: fit_added_gain(flights[train], iso, mounts[test].parameters) for train, test in ((one, two), (two, one))
    }
    rows["control: isotropic + added gain of the other flight"] = score(flights, installed_model(iso, mounts, control))
    own = {one: mounts[two], two: mounts[one]}
    rows["mount of the same flight (fitted on what is scored)"] = score(
        flights, transferred_models(patterns, own)["patterns + attitude + mount of the other flight"]
    )
    added = {test: dataclasses.asdict(fit) for test, fit in gains.items()}
    return {
        "rows": rows,
        "bounds": bounds(flights, patterns, step_deg),
        "scatter": scatter(flights),
        "further": further_parameters(flights, patterns, mounts),
        "added_gain": added,
        "mounts": {test: fit.as_dict() for test, fit in mounts.items()},
        "grid_step_deg": step_deg,
    }


def _rounded(values: tuple[float, ...]) -> str:
    return "[" + ", ".join(f"{v:.2f}" for v in values) + "]"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="azimuths on a grid of 30 degrees")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--logs-root", type=Path, default=os.environ.get("AERPAW_CMP_FIELD_DATA") or None)
    arguments = parser.parse_args()
    if arguments.logs_root is None or not Path(arguments.logs_root).is_dir():
        print("field_models: AERPAW_CMP_FIELD_DATA names no folder of real logs; nothing measured", file=sys.stderr)
        return
    begin = time.process_time()
    found = table(Path(arguments.logs_root), 30.0 if arguments.quick else 10.0)
    found["cpu_s"] = time.process_time() - begin
    if arguments.json:
        print(json.dumps(found))
        return
    columns = [c for c in next(iter(found["rows"].values()))["as_logged"] if c != "mean"]
    print("RMSE [dB] after the best offset; last columns: mean of the four on each footing")
    heads = [*(c.removeprefix("dataset12_") for c in columns), "as logged", "4 s", "40 lambda", "20 m", "cruise"]
    print(" " * 64 + " ".join(f"{head:>10s}" for head in heads))
    for name, row in found["rows"].items():
        values = [*(row["as_logged"][c] for c in columns), *(row[footing]["mean"] for footing in FOOTINGS)]
        print(f"{name:64s}" + " ".join(f"{value:10.2f}" for value in values))
    for footing, row in found["bounds"].items():
        cells = " ".join(f"{row[c]:10.2f}" for c in columns)
        print(f"{'bound: best azimuths per flight and channel, ' + footing:64s}{cells} {row['mean']:10.2f}")
    for name, row in found["scatter"].items():
        each = ", ".join(f"{c} {value:.2f} dB" for c, value in row["within_4s_db"].items())
        shared = row["correlation_of_channels"]
        hover = 100.0 * row["share_below_1_mps"]
        print(f"scatter within 4 s, {name}: {each}; correlation of the channels {shared:.2f}; {hover:.0f} % hover")
    for test, fit in found["mounts"].items():
        angles = ", ".join(f"{name} {value:.0f} deg" for name, value in fit["parameters"].items())
        print(f"mount applied to {test}, fitted on {fit['fitted_on'][0]}: {angles}")
    for test, fit in found["added_gain"].items():
        tower = "; ".join(f"{c} {_rounded(v)}" for c, v in fit["tower_db"].items())
        print(f"added gain applied to {test}: order {fit['order']}, UAV {_rounded(fit['uav_db'])}; {tower}")
    print("what else was fitted on one flight: gain in RMSE [dB] on that flight, and on the other")
    for what, fits in found["further"].items():
        for fit in fits:
            print(
                f"  {what:46s} {fit['fitted_on']}: {fit['gain_on_itself_db']:+.2f}, {fit['gain_on_the_other_db']:+.2f}"
            )
    print(f"{found['cpu_s']:.1f} s of processor time")


if __name__ == "__main__":
    main()

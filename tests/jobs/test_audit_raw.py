"""Check that the audit from raw bytes reports nothing on a correct flight.

tests/long/outside_faults.py injects faults below it.
"""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.replay import replay_flight
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs.audit_flight import expectations
from aerpaw_cmp.propagation.check.reference import Pattern
from aerpaw_cmp.site.learned import read_sphere_csv, sphere_csv, sphere_grid, unit_mean_gain
from tests.raw_checks import Account, raw_checked

ORIGIN = (35.7275, -78.696)
# Height of the take-off point above the ground of the origin.
TAKEOFF_M = 2.5
# The radios show later times than the telemetry.
AHEAD_S = 0.8

SITE = f"""
name: raw
origin: {{latitude_deg: {ORIGIN[0]}, longitude_deg: {ORIGIN[1]}, takeoff_ground_m: {TAKEOFF_M}}}
towers:
  T1: {{latitude_deg: 35.7285, longitude_deg: -78.6950, antenna_height_m: 12}}
  T2: {{latitude_deg: 35.7260, longitude_deg: -78.6975, antenna_height_m: 9}}
"""

FLIGHT = f"""
flight: raw
site: site.yaml
timezone: America/New_York
logs:
  - {{path: 2025-06-01_10_00_00_vehicleOut.txt}}
  - {{path: T1_power_log.txt, node: T1, channel: A}}
  - {{path: T2_power_log.txt, node: T2, channel: A}}
  - {{path: modem_ri.csv, reader: quectel_ri, node: T1}}
link:
  rss:
    carrier_hz: 3.3e9
    uav_transmits: true
    tower: {{antenna: {{model: sphere, file: tower.csv}}, yaw_deg: 30}}
    uav: {{antenna: {{model: sphere, file: uav.csv}}, roll_deg: 90, slant_deg: 20}}
rt: {{engine: image, max_depth: 1, attitude: logged, audit_links: 20}}
rss: {{lag: {AHEAD_S}}}
rank: {{tower: T1}}
"""


def write_flight(folder: Path) -> Path:
    """Write a flight of two minutes that rotates all the time, with antennas that have lobes.

    Return its flight.yaml.
    """
    t = np.arange(0.0, 120.0)
    north, east = 35.7275 + 1.5e-5 * t, -78.6975 + 1.2e-5 * t
    up = 40 + 5 * np.sin(t / 9)
    angles = np.column_stack([0.2 * np.sin(1.1 * t), 0.35 * t % (2 * math.pi) - math.pi, 0.25 * np.cos(0.9 * t)])
    rows = [
        f'{n + 1},{east[n]:.9f},{north[n]:.9f},{up[n]:.3f},"({p:.9f},{y:.9f},{r:.9f})","(1.0,1.0,0.0)",48.0,'
        f"2025-06-01 10:{n // 60:02d}:{n % 60:02d}.000000,4,18\n"
        for n, (p, y, r) in enumerate(angles)
    ]
    (folder / "2025-06-01_10_00_00_vehicleOut.txt").write_text("".join(rows), encoding="utf-8")
    rng = np.random.default_rng(8)
    for tower in ("T1", "T2"):
        seconds = np.round(AHEAD_S + np.arange(2.0, 117.0, 0.4), 3)
        lines = [
            f"[2025-06-01 10:{int(s) // 60:02d}:{s % 60:09.6f}] {4 * n:07o} {level:15.6f}\n"
            for n, (s, level) in enumerate(zip(seconds, rng.normal(-50, 4, len(seconds)), strict=True))
        ]
        (folder / f"{tower}_power_log.txt").write_text("".join(lines), encoding="utf-8")
    ranks = [
        f"{n},2025-06-01 10:{n // 60:02d}:{n % 60:02d}.000,{east[n]:.9f},{north[n]:.9f},{up[n]:.3f},{1 + n % 3}\n"
        for n in range(5, 110)
    ]
    head = "ID,Time and date,Longitude,Latitude,Altitude,NR RI\n"
    (folder / "modem_ri.csv").write_text(head + "".join(ranks), encoding="utf-8")
    for name, seed in (("tower", 1), ("uav", 2)):
        _, _, vectors = sphere_grid(10.0)
        gain = sum(4.0 * np.tanh(vectors @ axis) for axis in np.random.default_rng(seed).normal(size=(3, 3)))
        gain = unit_mean_gain(np.asarray(gain))
        (folder / f"{name}.csv").write_text(sphere_csv(gain, np.ones_like(gain)), encoding="utf-8")
    (folder / "site.yaml").write_text(SITE, encoding="utf-8")
    flight = folder / "flight.yaml"
    flight.write_text(FLIGHT, encoding="utf-8")
    return flight


def checked(flight: Path) -> Account:
    """The flight read, replayed and audited from its bytes."""
    data = load_data(load_flight(flight), flight.parent)
    replays = replay_flight(data).all
    return raw_checked(data, replays, expectations(data, replays))


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_flight(tmp_path_factory.mktemp("raw"))


def test_a_right_flight_is_recomputed_to_rounding(flight: Path) -> None:
    audit = checked(flight)
    assert audit.failures == []
    assert audit.count["measured level"] >= 40
    assert audit.count["simulated level"] >= 80
    assert audit.count["rotation"] >= 100
    for kind, most in {"position": 1e-3, "rotation": 1e-9, "measured level": 1e-9, "simulated level": 1e-3}.items():
        assert audit.most(kind) < most, kind


def test_the_take_off_ground_carries_the_ranks_too(flight: Path) -> None:
    data = load_data(load_flight(flight), flight.parent)
    (series,) = data.rank
    assert series.position_m is not None
    place, valid = data.poses_at(series.time).position_m, data.poses_at(series.time).valid
    assert series.position_m[valid][:, 2] == pytest.approx(place[valid][:, 2], abs=1e-6)


def gain_table(data: bytes) -> Pattern:
    """Field of an antenna table a second time: cubic splines of the amplitude, solved with Fourier transforms."""
    lines = [line for line in data.decode("utf-8-sig").splitlines() if line.strip() and line[0] != "#"]
    gains = {}
    for cells in list(csv.reader(lines))[1:]:
        gains[round(float(cells[0]) % 360, 6), round(float(cells[1]), 6)] = float(cells[2])
    azimuths = sorted({azimuth for azimuth, _ in gains})
    elevations = sorted({elevation for _, elevation in gains}, reverse=True)
    amplitude = np.array([[10 ** (gains[azimuth, up] / 20) for azimuth in azimuths] for up in elevations])
    amplitude[[0, -1]] = np.sqrt((amplitude[[0, -1]] ** 2).mean(axis=1, keepdims=True))  # a pole is one direction
    over = np.roll(amplitude[-2:0:-1], len(azimuths) // 2, axis=1)  # beyond the pole, on the opposite meridian
    knots = np.concatenate([amplitude, over])
    for axis in (0, 1):  # B-splines through the knots: c[k-1] + 4 c[k] + c[k+1] = 6 y[k], on a circle
        n = knots.shape[axis]
        response = ((4 + 2 * np.cos(2 * np.pi * np.arange(n) / n)) / 6).reshape((-1, 1) if axis == 0 else (1, -1))
        knots = np.fft.ifft(np.fft.fft(knots, axis=axis) / response, axis=axis).real
    return lambda theta, phi: (complex(max(_spline_at(knots, theta, phi), 0.0)), 0j)


def _spline_at(knots: FloatArray, theta_rad: float, phi_rad: float) -> float:
    rows, row_weights = _taps(theta_rad, knots.shape[0])
    columns, column_weights = _taps(phi_rad, knots.shape[1])
    return float(row_weights @ knots[np.ix_(rows, columns)] @ column_weights)


def _taps(angle_rad: float, count: int) -> tuple[list[int], FloatArray]:
    """The four knots about an angle on a circle, and their cubic weights."""
    at = angle_rad % (2 * math.pi) / (2 * math.pi) * count
    first = math.floor(at)
    t = at - first
    weights = [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]
    return [(first + k) % count for k in (-1, 0, 1, 2)], np.array(weights) / 6


def test_a_table_of_gain_is_looked_up_alike_everywhere(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    gain = rng.uniform(-15, 5, (19, 36))
    file = tmp_path / "antenna.csv"
    file.write_text(sphere_csv(gain, np.ones_like(gain), ("a note",)), encoding="utf-8")
    pattern, mine = read_sphere_csv(file), gain_table(file.read_bytes())
    for _ in range(200):
        theta, phi = math.acos(rng.uniform(-1, 1)), rng.uniform(-7, 7)
        expected = complex(pattern.field(np.array(theta), np.array(phi))[0])
        assert mine(theta, phi)[0] == pytest.approx(expected, abs=1e-9)

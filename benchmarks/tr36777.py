"""Coupling loss and geometry of 3GPP TR 36.777's RMa-AV and UMa-AV scenarios, with this engine's antennas and geometry.

19 sites of three sectors on hexagons (annex A.1), each sector a column of eight elements of TR 38.901 with an electric
downtilt; the gain of every link is that of H in an empty site against free space, so that elements, mounts, phases and
units of the engine are in it. Path loss, probability of a line of sight and shadowing are those of annex B, for aerial
UEs at one height. Geometry is the wide-band ratio of the serving sector to all others. The tables print percentiles.

The constants were held against annex B of the report (v15.0.0) as the Python package tr3gpp transcribes it, and against
two public implementations: NIST's MATLAB model for sensing (path loss, probability of sight) and NVIDIA's Aerial RAN
(shadowing in sight). All agree, except that NIST's has 4 pi for 40 pi in the loss of RMa-AV out of sight.

Independent check: the large-scale calibration of TR 38.901, 7.9.6.1, has targets in UMa-AV at a height of 200 m, seen
from isotropic sites at 6 GHz; `calibration` runs it with lengths taken from this engine's H, beside the percentiles of
nine companies (R1-2509126). It covers sites, units, the path loss in sight and its shadowing; not sector antennas,
RMa-AV or links out of sight: annex C of TR 36.777 has their curves as drawings alone, and no table of them was found.

Run: python benchmarks/tr36777.py [--ues N] [--seed S] [--json]
"""

import argparse
import json
from dataclasses import dataclass

import numpy as np

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.common.units import db_from_power, power_from_db, wavelength_m
from aerpaw_cmp.propagation.geometry import Array, Link, rotation_from_yaw_pitch_roll, single_element
from aerpaw_cmp.propagation.replay import trace
from aerpaw_cmp.site.antennas import TR38901
from aerpaw_cmp.site.site import Site, Tower

ELEMENTS, SPACING = 8, 0.8
HEIGHTS_M = (50.0, 100.0, 200.0, 300.0)
PERCENTILES = (5, 50, 95)
GROUND = "constant with permittivity=15 conductivity=0.01"  # no path meets it


@dataclass(frozen=True)
class Scenario:
    """A scenario of annex A.1: distance of sites, height of their antennas, carrier, downtilt."""

    apart_m: float
    tower_m: float
    carrier_hz: float
    tilt_deg: float


# Loss of a target [dB] by percentile, as nine companies of R1-2509126 have it: least, most.
PUBLISHED_DB = {5: (164.3, 165.1), 50: (177.0, 177.8), 95: (183.3, 183.9)}

SCENARIOS = {"RMa-AV": Scenario(1732.0, 35.0, 0.7e9, 6.0), "UMa-AV": Scenario(500.0, 25.0, 2.0e9, 10.0)}


def sight_probability(name: str, across_m: np.ndarray, height_m: float) -> np.ndarray:
    """Table B-1, above 10 m (RMa-AV) or 22.5 m (UMa-AV)."""
    least = {"RMa-AV": 40.0, "UMa-AV": 100.0}[name]
    if height_m > least:
        return np.ones_like(across_m)
    log = np.log10(height_m)
    p, d = (
        (max(15021.0 * log - 16053.0, 1000.0), max(1350.8 * log - 1602.0, 18.0))
        if name == "RMa-AV"
        else (4300.0 * log - 3800.0, max(460.0 * log - 700.0, 18.0))
    )
    far = np.maximum(across_m, d)
    return d / far + np.exp(-far / p) * (1.0 - d / far)


def path_loss_db(name: str, length_m: np.ndarray, height_m: float, carrier_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Table B-2: with and without a line of sight, above 10 m (RMa-AV) or 22.5 m (UMa-AV)."""
    ghz, log, far = carrier_hz / 1e9, np.log10(height_m), np.log10(length_m)
    free = 20.0 * np.log10(40.0 * np.pi * ghz / 3.0)
    if name == "RMa-AV":
        clear = max(23.9 - 1.8 * log, 20.0) * far + free
        return clear, np.maximum(clear, -12.0 + (35.0 - 5.3 * log) * far + free)
    return 28.0 + 22.0 * far + 20.0 * np.log10(ghz), -17.5 + (46.0 - 7.0 * log) * far + free


def shadowing_db(name: str, height_m: float) -> tuple[float, float]:
    """Table B-3: standard deviations with and without a line of sight."""
    clear = 4.2 * np.exp(-0.0046 * height_m) if name == "RMa-AV" else 4.64 * np.exp(-0.0066 * height_m)
    return float(clear), 6.0


def sites_m(apart_m: float) -> np.ndarray:
    """Nineteen places (19, 2) on hexagons."""
    steps = [(q, r) for q in range(-2, 3) for r in range(-2, 3) if abs(q + r) <= 2]
    return np.array([(apart_m * (q + r / 2.0), apart_m * r * np.sqrt(3.0) / 2.0) for q, r in steps])


def sectors(scenario: Scenario) -> tuple[Site, Link]:
    """An empty site of 57 towers, and their columns of elements at 30, 150 and 270 deg from east."""
    column = np.zeros((ELEMENTS, 3))
    column[:, 2] = (np.arange(ELEMENTS) - (ELEMENTS - 1) / 2.0) * SPACING * wavelength_m(scenario.carrier_hz)
    towers, arrays = {}, {}
    for number, (east, north) in enumerate(sites_m(scenario.apart_m)):
        for sector in range(3):
            name = f"S{number}-{sector}"
            towers[name] = Tower(name, 0.0, 0.0, float(east), float(north), scenario.tower_m)
            mount = rotation_from_yaw_pitch_roll(np.radians(30.0 + 120.0 * sector), 0.0, 0.0)
            arrays[name] = Array(column, np.zeros(ELEMENTS), (TR38901(),), mount)
    link = Link(scenario.carrier_hz, arrays, single_element(), uav_transmits=False, noise_floor_dbm=-np.inf)
    return Site("hexagons", SiteFrame(0.0, 0.0), towers, ground_material=GROUND), link


def peak_dbi(name: str) -> float:
    """Gain of a sector where its beam points: 8 dBi of an element and 9.03 dB of eight, less what the tilt costs."""
    scenario = SCENARIOS[name]
    site, link = sectors(scenario)
    away, tilt = 100.0, np.radians(scenario.tilt_deg)
    first = np.asarray(next(iter(site.towers.values())).position_m)
    ue = first + away * np.array([np.cos(np.radians(30.0)), np.sin(np.radians(30.0)), -np.tan(tilt)])
    h = trace(site, link, ue[None], max_depth=0).h[0, 0, 0]
    spread = wavelength_m(scenario.carrier_hz) / (4.0 * np.pi * away / np.cos(tilt))
    return float(db_from_power(np.abs(h @ weights(scenario)) ** 2 / spread**2))


def weights(scenario: Scenario) -> np.ndarray:
    """Phases of the elements (8,) that tilt the beam down."""
    place = (np.arange(ELEMENTS) - (ELEMENTS - 1) / 2.0) * SPACING
    return np.exp(2j * np.pi * place * np.sin(np.radians(scenario.tilt_deg))) / np.sqrt(ELEMENTS)


def run(name: str, height_m: float, ues: int, rng: np.random.Generator) -> dict[str, dict[str, float]]:
    """Percentiles of coupling loss [dB] and geometry [dB] of UEs dropped in the middle cell's three sectors."""
    scenario = SCENARIOS[name]
    site, link = sectors(scenario)
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, ues), scenario.apart_m / np.sqrt(3.0) * np.sqrt(rng.uniform(size=ues))
    place = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(ues, height_m)])
    h = trace(site, link, place, max_depth=0).h[:, :, 0]  # poses, sectors, elements
    towers = np.array([tower.position_m for tower in site.towers.values()])
    ray = place[:, None] - towers
    length, across = np.linalg.norm(ray, axis=2), np.hypot(ray[..., 0], ray[..., 1])
    spread = wavelength_m(scenario.carrier_hz) / (4.0 * np.pi * length)
    gain_db = db_from_power(np.abs(h @ weights(scenario)) ** 2 / spread**2 + 1e-12)
    clear, blocked = path_loss_db(name, length, height_m, scenario.carrier_hz)
    per_site = rng.uniform(size=(ues, len(towers) // 3)).repeat(3, axis=1)  # sectors of a site share their link
    sight = per_site < sight_probability(name, across, height_m)
    deviate = rng.normal(size=(ues, len(towers) // 3)).repeat(3, axis=1)
    shadow = np.where(sight, *shadowing_db(name, height_m)) * deviate
    coupling = np.where(sight, clear, blocked) + shadow - gain_db
    power = power_from_db(-coupling)
    best = power.max(axis=1)
    geometry = db_from_power(best / (power.sum(axis=1) - best))
    return {
        what: {f"p{p}": round(float(np.percentile(values, p)), 2) for p in PERCENTILES}
        for what, values in (("coupling_loss_db", coupling.min(axis=1)), ("geometry_db", geometry))
    } | {"gain_db": {"largest": round(float(gain_db.max()), 2)}}


def calibration(targets: int, rng: np.random.Generator) -> dict[str, float]:
    """Percentiles of the loss site, target, site [dB] of targets in the middle cell: table 7.9.6.1-1 of TR 38.901.

    Four best sites of nineteen; both ways share their shadowing; scattering -12.81 dBsm.
    """
    scenario, carrier_hz, height_m, scattering_db = SCENARIOS["UMa-AV"], 6e9, 200.0, -12.81
    names = {f"S{n}": place for n, place in enumerate(sites_m(scenario.apart_m))}
    towers = {name: Tower(name, 0.0, 0.0, float(e), float(n), scenario.tower_m) for name, (e, n) in names.items()}
    site = Site("hexagons", SiteFrame(0.0, 0.0), towers, ground_material=GROUND)
    link = Link(carrier_hz, dict.fromkeys(towers, single_element()), single_element(), noise_floor_dbm=-np.inf)
    square = rng.uniform(-scenario.apart_m, scenario.apart_m, (8 * targets, 2))
    sides = np.array([(np.cos(turn), np.sin(turn)) for turn in np.radians([0.0, 60.0, 120.0])])
    place = square[(np.abs(square @ sides.T) <= scenario.apart_m / 2.0).all(axis=1)][:targets]
    h = trace(site, link, np.column_stack([place, np.full(len(place), height_m)]), max_depth=0).h[:, :, 0, 0]
    length = wavelength_m(carrier_hz) / (4.0 * np.pi * np.abs(h))
    clear, _ = path_loss_db("UMa-AV", length, height_m, carrier_hz)
    shadow = rng.normal(0.0, shadowing_db("UMa-AV", height_m)[0], clear.shape)
    spread_db = db_from_power(wavelength_m(carrier_hz) ** 2 / (4.0 * np.pi))
    loss = np.sort(2.0 * (clear + shadow) + spread_db - scattering_db, axis=1)[:, :4]
    return {f"p{p}": round(float(np.percentile(loss, p)), 2) for p in PERCENTILES}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ues", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    result = {
        name: {f"{height:g} m": run(name, height, options.ues, rng) for height in HEIGHTS_M} for name in SCENARIOS
    }
    proof = calibration(options.ues, rng)
    if options.json:
        print(json.dumps(result | {"calibration": proof}))
        return
    print("UMa-AV calibration of TR 38.901, 7.9.6.1, targets at 200 m: loss [dB], here and in R1-2509126")
    for p, (least, most) in PUBLISHED_DB.items():
        print(f"  {p:>3} %  {proof[f'p{p}']:.1f}   {least:.1f} to {most:.1f}")
    for name, rows in result.items():
        print(f"{name}: coupling loss to the serving sector and geometry, 5th / 50th / 95th percentile [dB]")
        print(f"  gain where a beam points {peak_dbi(name):.2f} dBi")
        for height, row in rows.items():
            loss, geometry = ([f"{v:7.1f}" for v in row[key].values()] for key in ("coupling_loss_db", "geometry_db"))
            words = f"{' '.join(loss)}   {' '.join(geometry)}   largest gain {row['gain_db']['largest']}"
            print(f"  {height:>6}  {words}")


if __name__ == "__main__":
    main()

"""Share of the 90 % regions of `locate` that contain the node, over simulated flights in ten worlds and a mixed one.

A flight has a route (lawnmower, circle, or line there and back), a node near it, and a path-loss exponent. Its levels
have two rays over the ground, shadowing that is correlated over place, and fading. Some worlds also have antenna
patterns at both ends, a receiver floor, a mast or a node far outside. In the mixed world, these properties are drawn
for each flight, and the shares are also printed by the node's distance from the track. `locate` does not know any of
the properties. A flight takes 0.3 s.

    python benchmarks/located_nodes.py [--flights 30] [--seed 1] [--only TEXT]
"""

import argparse
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import interpn

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.compare.locate import LevelTrack, level_track, locate

WAVELENGTH_M, REFLECTION, FADING_DB = 0.09, 0.6, 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """Properties of the flights of one world.

    Parameters
    ----------
    route : str
        ``lawnmower``, ``circle`` or ``line``; empty: drawn, half of the flights being lawnmowers.
    exponent : (low, high)
    shadow_db, shadow_m : float
        Standard deviation and correlation length of the shadowing.
    pattern_db, lobes : float
        Standard deviation of the gain of each end over direction, and how narrow its lobes are.
    below_floor : float
        Share of the levels below the receiver's floor.
    height_m : float, optional
        Height of the node, drawn by default.
    outside : bool
        The node is 150 to 300 m outside the circle about the route.
    """

    route: str = ""
    exponent: tuple[float, float] = (2.0, 3.5)
    shadow_db: float = 6.0
    shadow_m: float = 50.0
    pattern_db: float = 0.0
    lobes: float = 3.0
    below_floor: float = 0.0
    height_m: float | None = None
    outside: bool = False


WORLDS: Mapping[str, World] = {
    "default": World(),
    "shadowing of 10 dB over 100 m": World(shadow_db=10.0, shadow_m=100.0),
    "free space": World(exponent=(2.0, 2.0), shadow_db=0.5, shadow_m=20.0),
    "patterns of 6 dB": World(pattern_db=6.0),
    "patterns of 10 dB with broad lobes": World(pattern_db=10.0, lobes=1.5),
    "node outside": World(outside=True),
    "floor under half of the levels": World(below_floor=0.5),
    "node at 25 m": World(height_m=25.0),
    "circle": World(route="circle"),
    "line": World(route="line"),
}

MIXED, RINGS_M = "mixed", ((0.0, 100.0), (100.0, 200.0), (200.0, 300.0), (300.0, np.inf))


def mixed(rng: np.random.Generator) -> World:
    """Return a world whose properties are drawn. The ranges are wider than those of the other worlds."""
    shadow_db, shadow_m, lobes = rng.uniform((0.5, 20.0, 1.0), (12.0, 130.0, 4.0))
    return World(
        exponent=(1.8, 3.8), shadow_db=shadow_db, shadow_m=shadow_m, lobes=lobes, outside=bool(rng.random() < 0.25),
        pattern_db=rng.choice((0.0, 3.0, 8.0, 11.0)), below_floor=rng.choice((0.0, 0.0, 0.25, 0.6)),
    )  # fmt: skip


def route(kind: str, rng: np.random.Generator) -> FloatArray:
    """Return positions (n, 3) [m] of a route, one per second."""
    if kind == "lawnmower":
        length, speed, apart = rng.uniform(250.0, 500.0), rng.uniform(5.0, 10.0), rng.uniform(50.0, 60.0)
        along, legs = np.arange(0.0, length, speed) - 0.5 * length, int(rng.integers(4, 8))
        flat = np.concatenate([
            np.column_stack([along * (-1) ** leg, np.full(len(along), (leg - 0.5 * legs) * apart)])
            for leg in range(legs)
        ])  # fmt: skip
    elif kind == "circle":
        radius, count, turns = rng.uniform(100.0, 200.0), int(rng.uniform(180, 400)), rng.uniform(1.0, 2.0)
        angle = 2.0 * np.pi * turns * np.arange(count) / count
        flat = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    else:
        way = 6.0 * np.arange(int(rng.uniform(100, 300)))
        way = np.minimum(way, way.max() - way)
        flat = np.column_stack([way - 0.5 * way.max(), 0.1 * rng.normal(size=len(way)).cumsum()])
    turn = rng.uniform(0.0, 2.0 * np.pi)
    flat = flat @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return np.column_stack([flat, np.full(len(flat), 40.0 if kind == "circle" else 30.0)])


def pattern(sd_db: float, lobes: float, rng: np.random.Generator) -> Callable[[FloatArray], FloatArray]:
    """Return a random smooth gain (n,) [dB] over unit vectors (n, 3)."""
    centres, ways = (
        v / np.linalg.norm(v, axis=1)[:, None] for v in (rng.normal(size=(24, 3)), rng.normal(size=(500, 3)))
    )
    weights = rng.normal(size=24)

    def raw(at: FloatArray) -> FloatArray:
        return np.asarray(np.exp(lobes * (at @ centres.T - 1.0)) @ weights)

    mean, scale = raw(ways).mean(), sd_db / raw(ways).std()
    return lambda at: scale * (raw(at) - mean)


def flight(world: World, rng: np.random.Generator) -> tuple[LevelTrack, FloatArray]:
    """Return the levels of a simulated flight, and the position (2,) [m] of its node."""
    position = route(world.route or ("lawnmower", "circle", "line", "lawnmower")[rng.integers(4)], rng)
    low, high = position[:, :2].min(axis=0), position[:, :2].max(axis=0)
    if world.outside:
        angle, away = rng.uniform(0.0, 2.0 * np.pi), 0.5 * np.hypot(*(high - low)) + rng.uniform(150.0, 300.0)
        at = 0.5 * (low + high) + away * np.array([np.cos(angle), np.sin(angle)])
    else:
        at = rng.uniform(low - 60.0, high + 60.0)
    height = world.height_m if world.height_m is not None else float(rng.choice([1.5, 10.0], p=[0.7, 0.3]))
    ray = position - [*at, height]
    away = np.linalg.norm(ray, axis=1)
    apart = np.linalg.norm(position[:, None] - position, axis=-1)
    root = np.linalg.cholesky(np.exp(-apart / world.shadow_m) + 1e-6 * np.eye(len(away)))
    longer = np.sqrt(away**2 + 4.0 * height * position[:, 2]) - away
    level = -10.0 * rng.uniform(*world.exponent) * np.log10(away)
    level += 20.0 * np.log10(np.abs(1.0 - REFLECTION * np.exp(-2j * np.pi * longer / WAVELENGTH_M)))
    level += world.shadow_db * root @ rng.normal(size=len(away)) + FADING_DB * rng.normal(size=len(away))
    if world.pattern_db:
        for side in (1.0, -1.0):
            level += pattern(world.pattern_db, world.lobes, rng)(side * ray / away[:, None])
    floor = float(np.quantile(level, world.below_floor)) if world.below_floor else -np.inf
    return level_track(np.arange(len(away)), position, np.maximum(level, floor), floor_db=floor), at


def flights(name: str, count: int, seed: int) -> Iterator[tuple[LevelTrack, FloatArray]]:
    """Return the flights of a world. Equal seeds make equal flights."""
    rng = np.random.default_rng([seed, [*WORLDS, MIXED].index(name)])
    return (flight(WORLDS.get(name) or mixed(rng), rng) for _ in range(count))


def judged(track: LevelTrack, at: FloatArray) -> tuple[float, float, float, bool, float]:
    """Return the share of the posterior in cells likelier than the node's, error, radius [m], and ``placed``.

    The last number is the node's distance from the track [m].
    """
    estimate = locate(track)
    regions, away_m = estimate.regions, float(np.hypot(*(track.position_m[:, :2] - at).T).min())
    axes, held = (regions.east_m, regions.north_m), regions.likelier()
    likelier = float(interpn(axes, held, at, "nearest", bounds_error=False, fill_value=1.0)[0])
    return likelier, float(np.hypot(*(estimate.place_m[:2] - at))), estimate.radius90_m, estimate.placed, away_m


def main() -> None:
    """Print a row per world."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=30, help="flights per world")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="worlds whose name contains this text")
    args = parser.parse_args()
    print(f"{'world':36s} 90 % has node  50 %  error [m]  radius [m]  not placed")
    for name in [name for name in (*WORLDS, MIXED) if args.only in name]:
        rows = [judged(*simulated) for simulated in flights(name, args.flights, args.seed)]
        shares, errors, radii, placed, away = (np.array(values) for values in zip(*rows, strict=True))
        inside = [100.0 * float((shares[placed] < part).mean()) for part in (0.9, 0.5)]
        middle = [float(np.median(values[placed])) for values in (errors, radii)]
        print(
            f"{name:36s} {inside[0]:10.1f} % {inside[1]:5.1f} {middle[0]:10.0f} {middle[1]:11.0f} {(~placed).sum():9d}",
            flush=True,
        )
        for near, far in RINGS_M if name == MIXED else ():
            ring = placed & (near <= away) & (away < far)
            print(f"  node {near:g} to {far:g} m from the track: {(shares[ring] < 0.9).sum()} of {ring.sum()}")


if __name__ == "__main__":
    main()

"""Paths with other interactions than reflections: diffraction, diffuse scattering and refraction, as Sionna has them.

Their coefficients are Sionna's own, in float32: at range the phases hold no information. So their power is added to
that of the reflections, and they are no part of H and of ranks. What is added is right where phases do not decide:
diffraction is asked for in the shadow alone, where the direct path is missing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np

from ...common.errors import UsageError
from ...common.units import AnyArray, BoolArray, ComplexArray, FloatArray, IntArray, amplitude_from_db
from ..arrays import Link, Poses
from ..field.sum import radiated
from ..paths import PathSet

Interaction = Literal["reflection", "diffraction", "scattering", "refraction"]

REFLECTED, SCATTERED, REFRACTED, DIFFRACTED = 1, 2, 4, 8
"""Sionna's numbers of the kinds; 0 is no interaction."""

KINDS = {"diffraction": DIFFRACTED, "scattering": SCATTERED, "refraction": REFRACTED}

SCATTERING_SAMPLES = 10_000
"""Most rays per tower of the search for scattered paths: each that is scattered makes a path to every pose it sees."""

ROWS_AT_ONCE = 20_000

SAME_M = 0.01
"""Paths of one link and of the same kinds whose points are this near are one."""


@dataclass(frozen=True, slots=True)
class OtherSearch:
    """What one call of PathSolver looks for besides reflections.

    Parameters
    ----------
    diffraction, refraction, scattering : bool
    scattering_coefficient : float
        Share of the reflected amplitude that is scattered, of every material.
    """

    diffraction: bool = False
    refraction: bool = False
    scattering: bool = False
    scattering_coefficient: float = 0.0


def other_searches(interactions: Iterable[str], scattering_coefficient: float | None) -> tuple[OtherSearch, ...]:
    """Searches that the interactions of ``rt`` need besides the one for reflections.

    Scattered paths are searched by themselves, with fewer rays: paths that are scattered and diffracted or refracted
    are left out.

    Raises
    ------
    UsageError
        An unknown interaction; scattering without its coefficient.
    """
    wanted = set(interactions)
    if unknown := wanted - {"reflection", *KINDS}:
        raise UsageError(f"unknown interaction {min(unknown)!r}", expected=", ".join(("reflection", *KINDS)))
    searches = []
    if wanted & {"diffraction", "refraction"}:
        searches.append(OtherSearch(diffraction="diffraction" in wanted, refraction="refraction" in wanted))
    if "scattering" in wanted:
        if scattering_coefficient is None or not 0.0 < scattering_coefficient <= 1.0:
            raise UsageError(
                f"interaction 'scattering' with scattering_coefficient {scattering_coefficient}",
                expected="a number above 0 and up to 1",
                cause="materials of ITU-R P.2040 state none",
            )
        searches.append(OtherSearch(scattering=True, scattering_coefficient=scattering_coefficient))
    return tuple(searches)


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherPaths:
    """Paths with at least one interaction that is no reflection, in float32's digits.

    Parameters
    ----------
    pose, tower : (paths,) int
    kinds : (paths, max_depth) int
        From tower to UAV: ``REFLECTED``, ``SCATTERED``, ``REFRACTED``, ``DIFFRACTED``, 0 where unused.
    faces : (paths, max_depth) int
        Face of each interaction, -1 where unused and at edges.
    vertices_m : (paths, max_depth, 3)
        Points of interaction, NaN where unused.
    jones : (paths, 2, 2) complex
        From the (theta, phi) components that leave the tower to those that arrive, lambda / (4 pi) included.
    departure_rad, arrival_rad : (paths, 2)
        Zenith and azimuth in site axes, away from the tower and away from the UAV.
    """

    pose: IntArray
    tower: IntArray
    kinds: IntArray
    faces: IntArray
    vertices_m: FloatArray
    jones: ComplexArray
    departure_rad: FloatArray
    arrival_rad: FloatArray

    def __len__(self) -> int:
        return len(self.pose)

    def select(self, rows: AnyArray) -> OtherPaths:
        """The paths of a mask or of indices."""
        return OtherPaths(**{column.name: getattr(self, column.name)[rows] for column in fields(self)})

    def once(self) -> OtherPaths:
        """Each path once, in the order of poses and towers: an edge is found from both of its faces."""
        if not len(self):
            return self
        points = np.nan_to_num(np.round(self.vertices_m / SAME_M), nan=-1.0).reshape(len(self), -1)
        keys = np.column_stack([self.pose, self.tower, self.kinds, points.astype(np.int64)])
        return self.select(np.unique(keys, axis=0, return_index=True)[1])

    @property
    def geometry(self) -> PathSet:
        """Points as a path set, whose depth counts every interaction."""
        return PathSet(self.pose, self.tower, (self.kinds > 0).sum(axis=1), self.faces, self.vertices_m)

    @property
    def reflections(self) -> PathSet:
        """The same, whose depth counts reflections alone, since only they lose something at a rough surface."""
        count = ((self.kinds == REFLECTED) | (self.kinds == SCATTERED)).sum(axis=1)
        return replace(self.geometry, depth=count)

    def named(self) -> dict[str, int]:
        """Number of paths by what they are made of, such as "reflection + diffraction"."""
        bits, count = np.unique(np.bitwise_or.reduce(self.kinds, axis=1), return_counts=True)
        every = {"reflection": REFLECTED, **KINDS}
        return {
            " + ".join(name for name, bit in every.items() if number & bit): int(n)
            for number, n in zip(bits.tolist(), count, strict=True)
        }

    @classmethod
    def joined(cls, parts: Iterable[OtherPaths], max_depth: int) -> OtherPaths:
        """The paths of all parts, whose depths may differ."""
        padded = [cls.empty(max_depth), *(part._padded(max_depth) for part in parts)]
        return cls(**{one.name: np.concatenate([getattr(p, one.name) for p in padded]) for one in fields(cls)})

    def _padded(self, depth: int) -> OtherPaths:
        more = depth - self.kinds.shape[1]
        if not more:
            return self
        return replace(
            self,
            kinds=np.pad(self.kinds, ((0, 0), (0, more))),
            faces=np.pad(self.faces, ((0, 0), (0, more)), constant_values=-1),
            vertices_m=np.pad(self.vertices_m, ((0, 0), (0, more), (0, 0)), constant_values=np.nan),
        )

    @classmethod
    def empty(cls, max_depth: int) -> OtherPaths:
        """No path at all."""
        zero, flat = np.zeros(0, dtype=np.int64), np.zeros((0, max_depth), dtype=np.int64)
        return cls(
            pose=zero,
            tower=zero,
            kinds=flat,
            faces=flat,
            vertices_m=np.zeros((0, max_depth, 3)),
            jones=np.zeros((0, 2, 2), dtype=np.complex128),
            departure_rad=np.zeros((0, 2)),
            arrival_rad=np.zeros((0, 2)),
        )


def path_powers(paths: OtherPaths, link: Link, poses: Poses, loss_db: FloatArray | None = None) -> FloatArray:
    """Mean over element pairs of ``|h|^2`` of each path alone (paths,), as plane waves over the arrays.

    Patterns, slants and attitude are this package's own, in float64; between them stand Sionna's coefficients.

    Parameters
    ----------
    paths : OtherPaths
    link : Link
    poses : Poses
    loss_db : (paths,), optional
        Further loss of each path, such as foliage.

    Returns
    -------
    (paths,)
        Relative to isotropic elements of one polarisation: path gain times patterns.
    """
    power, arrays = np.zeros(len(paths)), list(link.tower_arrays.values())
    for tower, array in enumerate(arrays):
        mine = np.flatnonzero(paths.tower == tower)
        for start in range(0, len(mine), ROWS_AT_ONCE):
            rows = mine[start : start + ROWS_AT_ONCE]
            turn = poses.rotation[paths.pose[rows]] @ link.uav_array.mount
            mount = np.broadcast_to(array.mount, (len(rows), 3, 3))
            away, basis = _basis(paths.departure_rad[rows])
            sent = np.einsum("bip,ipt->bpt", basis, radiated(array, mount, away))
            away, basis = _basis(paths.arrival_rad[rows])
            received = np.einsum("aip,ipu->apu", basis, radiated(link.uav_array, turn, away))
            h = np.einsum("apu,pab,bpt->put", received, paths.jones[rows], sent, optimize=True)
            power[rows] = (h.real**2 + h.imag**2).mean(axis=(1, 2))
    return power if loss_db is None else power * amplitude_from_db(-loss_db) ** 2


def _basis(angles_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions (3, paths) of zenith and azimuth, and their unit vectors (2, 3, paths) of theta and phi."""
    theta, phi = angles_rad.T
    (st, ct), (sp, cp) = (np.sin(theta), np.cos(theta)), (np.sin(phi), np.cos(phi))
    return np.stack([st * cp, st * sp, ct]), np.stack([[ct * cp, ct * sp, -st], [-sp, cp, 0.0 * sp]])


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherInteractions:
    """What the other interactions add to a replay.

    Parameters
    ----------
    asked : tuple of str
    power : (poses, towers)
        Added to the mean over element pairs of ``|H|^2``.
    paths : (poses, towers) int
        How many.
    kinds : dict of str to int
        Paths by what they are made of.
    rss_dbm, rss_power_dbm : (poses, towers)
        Of the reflections alone.
    has_path : (poses, towers) bool
        Of the reflections alone.
    """

    asked: tuple[str, ...]
    power: FloatArray
    paths: IntArray
    kinds: dict[str, int] = field(default_factory=dict)
    rss_dbm: FloatArray
    rss_power_dbm: FloatArray
    has_path: BoolArray

    def part(self, start: int, stop: int) -> OtherInteractions:
        """Of poses ``start`` to ``stop``; ``kinds`` stay those of the whole."""
        names = ("power", "paths", "rss_dbm", "rss_power_dbm", "has_path")
        return replace(self, **{name: getattr(self, name)[start:stop] for name in names})


def summary(parts: Iterable[tuple[FloatArray, OtherInteractions]]) -> dict[str, Any]:
    """Paths, links and share of the power, for metrics and the page.

    Parameters
    ----------
    parts : iterable of ((poses, towers) power of the reflections, OtherInteractions)
    """
    paths = links = dark = 0
    shares: list[FloatArray] = []
    replays: dict[int, dict[str, int]] = {}  # channels that share a replay share its kinds
    for reflected, other in parts:
        replays[id(other.kinds)] = other.kinds
        has = other.power > 0.0
        paths += int(other.paths.sum())
        links += int(has.sum())
        dark += int((has & (reflected <= 0.0)).sum())
        shares.append((other.power[has] / (other.power[has] + reflected[has])).ravel())
    kinds = sum((Counter(one) for one in replays.values()), Counter[str]())
    every = np.concatenate(shares) if shares else np.zeros(0)
    return {
        "paths": paths,
        "kinds": dict(sorted(kinds.items())),
        "links": links,
        "links_without_reflections": dark,
        "median_power_share": float(np.median(every)) if len(every) else None,
        "in_ranks": False,
    }

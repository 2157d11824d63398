"""Channel matrices by the compiled kernel: what :mod:`aerpaw_cmp.propagation.channel` knows, as columns for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import ModuleType
from typing import Any

import numpy as np

from ..common.units import AnyArray, ComplexArray, FloatArray, IntArray, wavelength_m
from ..site.antennas import TR38901, HalfWaveDipole, Isotropic, MeasuredPattern
from .arrays import Array, Link, Pattern, Poses
from .compiled import column, in_threads
from .paths import Faces, PathSet

PATHS_PER_CHUNK = 4096
"""Paths of a call of the kernel: some milliseconds of work for a thread."""


@dataclass(frozen=True, slots=True)
class _End:
    """Elements of one end, spread over the pairs (p,) of a link."""

    places_m: FloatArray
    slants: FloatArray
    kinds: IntArray
    starts: IntArray
    given: tuple[tuple[Pattern, AnyArray], ...]
    """Patterns that the kernel does not know, each with its pairs."""


class _Grids:
    """Spline coefficients of measured patterns, one after another."""

    def __init__(self) -> None:
        self._layers: list[FloatArray] = [np.zeros(1)]
        self._starts: dict[int, tuple[int, int, int]] = {}

    def start(self, pattern: MeasuredPattern) -> tuple[int, int, int]:
        if id(pattern) not in self._starts:
            layers = pattern.spline_layers
            self._starts[id(pattern)] = (sum(map(len, self._layers)), *layers[0].shape)
            self._layers += [layer.ravel() for layer in layers]
        return self._starts[id(pattern)]

    def values(self) -> FloatArray:
        return np.concatenate(self._layers)


def _kind(kernels: ModuleType, pattern: Pattern) -> int:
    """How the kernel evaluates a pattern; a class derived from a known one may mean something else."""
    if type(pattern) is MeasuredPattern:
        return int(kernels.GAIN_GRID if len(pattern.spline_layers) == 1 else kernels.FIELD_GRID)
    known = {Isotropic: kernels.ISOTROPIC, HalfWaveDipole: kernels.DIPOLE, TR38901: kernels.TR38901}
    return int(known.get(type(pattern), kernels.GIVEN))


def _end(kernels: ModuleType, array: Array, element: IntArray, grids: _Grids) -> _End:
    patterns = array.patterns if len(array.patterns) > 1 else array.patterns * len(array)
    kinds = np.array([_kind(kernels, pattern) for pattern in patterns], dtype=np.int64)
    starts = np.zeros((len(array), 3), dtype=np.int64)
    for index, pattern in enumerate(patterns):
        if isinstance(pattern, MeasuredPattern) and kinds[index] != kernels.GIVEN:
            starts[index] = grids.start(pattern)
    unknown = {id(p): p for p, kind in zip(patterns, kinds, strict=True) if kind == kernels.GIVEN}
    given = tuple((p, np.flatnonzero([patterns[e] is p for e in element])) for p in unknown.values())
    slants = np.stack([np.cos(array.slant_rad), np.sin(array.slant_rad)])
    return _End(
        places_m=column(array.positions_m.T[:, element]),
        slants=column(slants[:, element]),
        kinds=column(kinds[element], np.int64),
        starts=column(starts[element], np.int64),
        given=given,
    )


def evaluate(
    kernels: ModuleType,
    paths: PathSet,
    faces: Faces,
    electric: tuple[ComplexArray, FloatArray],
    sources_m: FloatArray,
    poses: Poses,
    link: Link,
    loss_db: FloatArray | None,
    threads: int | None = None,
) -> tuple[ComplexArray, FloatArray]:
    """H (poses, towers, n_rx, n_tx) and the power (paths,) of each path alone.

    Parameters
    ----------
    kernels : module
    paths, faces, sources_m, poses, link, loss_db
        As for :func:`aerpaw_cmp.propagation.channel.channel_matrices`.
    electric : (faces + 1,), (faces + 1,)
        Permittivity and thickness [m] of each face.
    threads : int, optional

    Returns
    -------
    h : (poses, towers, n_rx, n_tx) complex
        Coherent sum over paths; zero without a path.
    power : (paths,)
        Mean over element pairs of ``|h|^2`` of each path alone.
    """
    arrays = list(link.tower_arrays.values())
    ports, uavs = len(arrays[0]), len(link.uav_array)
    pair = np.arange(ports * uavs)
    grids = _Grids()
    towers = [_end(kernels, array, pair % ports, grids) for array in arrays]
    uav = _end(kernels, link.uav_array, pair // ports, grids)
    wavelength = wavelength_m(link.carrier_hz)
    order = _by_link(paths, len(arrays))
    some = paths if order is None else paths.select(order)
    h = np.empty((len(poses) * len(arrays), len(pair), 2))
    h.fill(0.0)  # touched here: threads that meet fresh pages wait for each other in the kernel of the system
    power = np.zeros(len(paths))
    known: dict[str, Any] = {
        "pose": column(some.pose, np.int64),
        "tower": column(some.tower, np.int64),
        "depth": column(some.depth, np.int64),
        "sequence": column(some.faces, np.int64),
        "loss_db": np.zeros(0) if loss_db is None else column(loss_db if order is None else loss_db[order]),
        "normal": column(faces.normal).reshape(-1, 3),
        "offset_m": column(faces.offset_m),
        "eta": column(np.column_stack([electric[0].real, electric[0].imag, electric[1] / wavelength])),
        "wavelength": float(wavelength),
        "sources_m": column(sources_m),
        "mounts": column(np.stack([array.mount for array in arrays])),
        "tower_m": np.stack([end.places_m for end in towers]),
        "tower_slants": np.stack([end.slants for end in towers]),
        "tower_kinds": np.stack([end.kinds for end in towers]),
        "tower_starts": np.stack([end.starts for end in towers]),
        "positions_m": column(poses.position_m),
        "rotations": column(poses.rotation),
        "uav_mount": column(link.uav_array.mount),
        "uav_m": uav.places_m,
        "uav_slants": uav.slants,
        "uav_kinds": uav.kinds,
        "uav_starts": uav.starts,
        "grids": grids.values(),
        "real": not any((end.kinds >= kernels.FIELD_GRID).any() for end in (*towers, uav)),
        "out": pair if not link.uav_transmits else (pair % ports) * uavs + pair // ports,
        "h": h,
        "path_power": power,
    }
    ends = (towers, uav) if any(end.given for end in (*towers, uav)) else None

    def run(part: tuple[int, int]) -> None:
        given = np.zeros((1, 8, 1)) if ends is None else _given(kernels, known, *ends, *part)
        kernels.fields(*_ordered(kernels, known, *part, given, only_directions=False))

    in_threads(run, _parts(some.pose), threads)
    if order is not None:
        power[order] = power.copy()
    shape = (ports, uavs) if link.uav_transmits else (uavs, ports)
    return h.view(np.complex128).reshape(len(poses), len(arrays), *shape), power


def _ordered(
    kernels: ModuleType, known: dict[str, Any], start: int, stop: int, given: FloatArray, *, only_directions: bool
) -> list[Any]:
    """Arguments of ``kernels.fields`` in its order: a dispatcher takes names slowly."""
    values = {**known, "start": start, "stop": stop, "given": given, "only_directions": only_directions}
    return [values[name] for name in kernels.FIELD_ARGUMENTS]


def _given(
    kernels: ModuleType, known: dict[str, Any], towers: Sequence[_End], uav: _End, start: int, stop: int
) -> FloatArray:
    """Fields (paths, 8, pairs) of patterns that only Python knows, in the directions that the kernel finds."""
    at = np.zeros((stop - start, 8, len(known["out"])))
    kernels.fields(*_ordered(kernels, known, start, stop, at, only_directions=True))
    fields = np.zeros_like(at)
    tower_of = known["tower"][start:stop]
    ends = [(end, np.flatnonzero(tower_of == number), 0, 0) for number, end in enumerate(towers)]
    for end, rows, direction, out in [*ends, (uav, np.arange(stop - start), 3, 4)]:
        for pattern, pairs in end.given:
            x, y, z = (at[rows[:, None], direction + axis, pairs] for axis in range(3))
            e_theta, e_phi = pattern.field(np.arctan2(np.hypot(x, y), z), np.arctan2(y, x))
            for offset, value in enumerate((e_theta.real, e_theta.imag, e_phi.real, e_phi.imag)):
                fields[rows[:, None], out + offset, pairs] = value
    return fields


def _by_link(paths: PathSet, towers: int) -> IntArray | None:
    """Order of the paths by pose and tower, None where they have it: threads must not share a link."""
    key = paths.pose * towers + paths.tower
    return None if (np.diff(key) >= 0).all() else np.argsort(key, kind="stable")


def _parts(pose: IntArray) -> list[tuple[int, int]]:
    """Runs (start, stop) of paths between poses."""
    edges = [0]
    while edges[-1] < len(pose):
        stop = min(edges[-1] + PATHS_PER_CHUNK, len(pose))
        if stop < len(pose):  # to the end of the pose
            stop = int(np.searchsorted(pose, pose[stop - 1], side="right"))
        edges.append(stop)
    return list(pairwise(edges))

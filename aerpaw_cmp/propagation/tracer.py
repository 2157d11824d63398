"""The replay of a flight: paths by an engine, channel matrices and RSS from the paths."""

from __future__ import annotations

import os
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..common.errors import UsageError
from ..common.units import BoolArray, ComplexArray, FloatArray, IntArray, power_from_db
from ..site.site import Site
from . import image
from .arrays import Array, Link, Poses
from .cache import PathCache
from .compiled import beams, switch, warn_once
from .crowns import Crowns
from .effort import Estimate, OnEstimate
from .faces import inside_solids
from .field.sum import Fields, channel_matrices, mean_pair_power, rss_dbm
from .interactions import (
    SCATTERING_SAMPLES,
    OtherInteractions,
    OtherPaths,
    OtherSearch,
    other_searches,
    path_powers,
)
from .paths import Faces, PathSet
from .power_cut import CHECKED_POSES, ROUNDING, longest_m, loss_in_words, within_cut
from .relevance import idle_objects, in_words
from .samples import Choice, Samples, enough_samples, spread
from .scene import Scene, Settings
from .surfaces import Surfaces

Engine = Literal["sionna", "image"]
Device = Literal["auto", "cpu", "cuda"]
Visibility = Literal["centre", "pairs"]
Loss = Callable[[PathSet, FloatArray, FloatArray], FloatArray]
"""``loss(paths, sources_m, targets_m) -> (paths,)`` dB; segments run source, ``paths.vertices_m``, target."""


@dataclass(frozen=True, slots=True, repr=False)
class Replay:
    """What a replay found.

    Parameters
    ----------
    rss_dbm : (poses, towers)
        Coherent: from ``|H|^2``, see :func:`aerpaw_cmp.propagation.field.sum.rss_dbm`. NaN without a path.
    rss_power_dbm : (poses, towers)
        From the sum of the paths' powers.
    h : (poses, towers, n_rx, n_tx) complex128
        Zero without a path.
    has_path : (poses, towers) bool
    paths : PathSet
    faces : Faces
    seconds : float
        Of this call: path search (or reading the cache) and fields.
    search_seconds : float
        Of the path search alone, when it was made: an entry of the cache remembers it.
    engine : str
    left_out : list of str
        What was not modelled, for the report.
    towers : tuple of str
        Order of the tower axis.
    from_cache : bool
        Nothing was searched.
    samples : int
        Rays per tower; 0 for an engine without rays.
    samples_reason : str
        Why so many, where the number was found by pilots.
    pairs_differ : (poses, towers) bool, optional
        Links whose element pairs do not all have the paths of the array centres; only with ``visibility="pairs"``.
    surfaces : Surfaces, optional
        What the faces are made of, where the site is a scene of triangles.
    other : OtherInteractions, optional
        What diffraction, scattering and refraction add to both levels and to ``has_path``, where they were asked for;
        ``h`` and ``paths`` are of reflections alone.
    """

    rss_dbm: FloatArray
    rss_power_dbm: FloatArray
    h: ComplexArray
    has_path: BoolArray
    paths: PathSet
    faces: Faces
    seconds: float
    search_seconds: float
    engine: str
    towers: tuple[str, ...]
    left_out: list[str] = field(default_factory=list)
    from_cache: bool = False
    samples: int = 0
    samples_reason: str = ""
    pairs_differ: BoolArray | None = None
    surfaces: Surfaces | None = None
    other: OtherInteractions | None = None

    def of_reflections(self) -> Replay:
        """The replay without what other interactions add: what its paths and H are."""
        other = self.other
        if other is None:
            return self
        return replace(
            self, rss_dbm=other.rss_dbm, rss_power_dbm=other.rss_power_dbm, has_path=other.has_path, other=None
        )

    def __repr__(self) -> str:
        """One line: the arrays are too large to be shown."""
        return (
            f"Replay({len(self.has_path)} poses, towers {', '.join(self.towers)}, engine {self.engine!r}, "
            f"{len(self.paths)} paths, coverage {100 * self.has_path.mean():.0f} %, {self.seconds:.2f} s)"
        )

    def to_xarray(self) -> Any:
        """The replay as an ``xarray.Dataset`` with dimensions pose, tower, n_rx, n_tx.

        Returns
        -------
        xarray.Dataset
            ``rss_dbm``, ``rss_power_dbm``, ``has_path``, ``h_real`` and ``h_imag`` with units as attributes.

        Raises
        ------
        UsageError
            If xarray is not installed.
        """
        try:
            import xarray
        except ImportError:
            raise UsageError(
                "xarray is not installed", expected="pip install 'aerpaw-cmp[geo]'", cause="to_xarray() needs it"
            ) from None
        level = {"units": "dBm", "long_name": "received power, coherent sum of the paths"}
        power = {"units": "dBm", "long_name": "received power, sum of the paths' powers"}
        ports = ("pose", "tower", "n_rx", "n_tx")
        return xarray.Dataset(
            {
                "rss_dbm": (("pose", "tower"), self.rss_dbm, level),
                "rss_power_dbm": (("pose", "tower"), self.rss_power_dbm, power),
                "has_path": (("pose", "tower"), self.has_path),
                "h_real": (ports, self.h.real, {"units": "1"}),
                "h_imag": (ports, self.h.imag, {"units": "1"}),
            },
            coords={"tower": list(self.towers)},
            attrs={"engine": self.engine, "seconds": self.seconds},
        )


def replay(
    site: Site,
    link: Link,
    poses: Poses,
    engine: Engine = "image",
    *,
    max_depth: int = 2,
    samples: Samples = "auto",
    batch: int = 50,
    loss: Loss | None = None,
    crowns: Crowns | None = None,
    cache_dir: str | Path | None = None,
    relevance_db: float | None = None,
    visibility: Visibility = "centre",
    threads: int | None = None,
    device: Device = "auto",
    whole: Whole | None = None,
    interactions: Sequence[str] = ("reflection",),
    scattering_coefficient: float | None = None,
    power_cut_db: float | None = None,
    check_power_cut: bool = True,
    only: BoolArray | None = None,
    progress: Callable[[float], None] | None = None,
    on_estimate: OnEstimate | None = None,
) -> Replay:
    """Replay a flight.

    Parameters
    ----------
    site : Site
    link : Link
        Its ``tower_arrays`` name towers of the site.
    poses : Poses
    engine : {"image", "sionna"}
        Exhaustive image method, or Sionna's PathSolver as path finder.
    max_depth : int
        Largest number of reflections, 0 to 3.
    samples : int or "auto"
        ``sionna`` only: rays per tower; "auto" raises the number until two pilots find the same paths
        (:mod:`aerpaw_cmp.propagation.samples`).
    batch : int
        ``sionna`` only: poses per call.
    loss : callable, optional
        Further loss per path [dB], such as foliage.
    crowns : Crowns, optional
        Crowns that reflect: their paths are added to those of the engine, whichever it is. What crowns stop is the
        business of ``loss``.
    cache_dir : path, optional
        Keep paths here, ``""`` for no cache. Default: ``AERPAW_CMP_CACHE``, else ``~/.cache/aerpaw-cmp``, for the
        ``sionna`` engine; the ``image`` engine is faster than a cache unless one is named.
    relevance_db : float, optional
        Say in ``left_out`` which buildings move no RSS by more than this (:mod:`aerpaw_cmp.propagation.relevance`).
    visibility : {"centre", "pairs"}
        Whether all element pairs have the paths of the array centres, or each its own (``image`` only; as many
        searches as a link has element pairs). ``paths`` are those of the centres in any case.
    threads : int, optional
        Of compiled code (default: the cores this process may use); results do not depend on it.
    device : {"auto", "cpu", "cuda"}
        Of Sionna's search; "auto" is a GPU where Dr.Jit finds one.
    whole : Whole, optional
        What the poses are a part of.
    interactions : sequence of {"reflection", "diffraction", "scattering", "refraction"}
        ``sionna`` only, but for reflections: the others' power is added to RSS, never to H
        (:mod:`aerpaw_cmp.propagation.interactions`).
    scattering_coefficient : float, optional
        Of every material, where "scattering" is asked for.
    power_cut_db : float, optional
        Leave out paths at least this much weaker than free space over their link by their length alone
        (:mod:`aerpaw_cmp.propagation.power_cut`).
    check_power_cut : bool
        Search a few poses without the cut and say in ``left_out`` what it costs.
    only : (towers, poses) bool, optional
        Links that count; the others have no path and are not searched for.
    progress : callable, optional
        Called with the share done.
    on_estimate : callable, optional
        Told before a search among thousands of faces what it will take; without one, a long search is a warning.

    Returns
    -------
    Replay

    Raises
    ------
    UsageError
        Unknown tower or engine, a scene too large for ``image``, a ``relevance_db`` that is not positive, other
        interactions than reflections with ``image``.
    """
    if engine not in ("image", "sionna"):
        raise UsageError(f"unknown engine {engine!r}", expected="'image' or 'sionna'")
    if visibility == "pairs" and engine != "image":
        raise UsageError(
            "visibility 'pairs' with engine 'sionna'",
            expected="engine 'image', or visibility 'centre'",
            cause="each element pair is searched for its own paths",
        )
    if relevance_db is not None and not relevance_db > 0.0:
        raise UsageError(f"relevance_db {relevance_db:g}", expected="a positive number of dB")
    if power_cut_db is not None and not power_cut_db > 0.0:
        raise UsageError(f"power_cut_db {power_cut_db:g}", expected="a positive number of dB")
    searches = other_searches(interactions, scattering_coefficient)
    if searches and (engine != "sionna" or max_depth == 0):
        raise UsageError(
            f"interactions {', '.join(interactions)} with "
            + (f"engine {engine!r}" if engine != "sionna" else "max_depth 0"),
            expected="engine 'sionna' and a max_depth of 1 or more, or reflections alone",
            cause="the image engine knows reflections; every interaction counts in max_depth",
        )
    started = time.perf_counter()
    poses, refused = _within_reach(site, poses)
    scene = Scene.of(site, link, poses)
    if whole is not None:
        scene = replace(scene, extent_m=whole.extent_m, pairs=whole.pairs)
    if only is not None:
        scene = replace(scene, excluded=scene.excluded | ~only)
    left_out = [*refused, *_buried_towers(site, link)]
    settings = Settings(
        engine=engine,
        max_depth=max_depth,
        samples=0 if samples == "auto" else samples,
        batch=batch,
        variant={"cpu": "llvm", "cuda": "cuda"}.get(device),
        threads=threads,
        power_cut_db=power_cut_db,
    )
    choice = None
    cache = _cache(engine, cache_dir)
    if engine == "sionna" and samples == "auto":
        choice = _choose_samples(scene, link, poses, settings, cache)
        settings = replace(settings, samples=choice.samples)
    paths, search_seconds, from_cache = _search_or_read(scene, link, poses, settings, cache, progress, on_estimate)
    left_out += cache.warnings if cache else []
    if power_cut_db is not None and check_power_cut:
        left_out += _loss_of_cut(site, scene, link, poses, settings, loss, cache)
    paths, blocked = _above_terrain(site, scene, poses, paths)
    left_out += blocked
    if crowns is not None and scene.surfaces is not None:
        left_out += ["reflections off crowns: they are not searched in a scene of triangles"]
    elif crowns is not None:
        scene, bounces = scene.with_bounces(site, poses, crowns, max_depth)
        if power_cut_db is not None:
            bounces = within_cut(bounces, scene.sources_m, poses.position_m, power_cut_db)
        paths = image.merge([paths, bounces], max_depth, None)
        left_out += ["paths over a crown and a building, or over two crowns"] if max_depth > 1 else []
    others = None
    if searches:
        others = _other_powers(site, scene, link, poses, settings, searches, loss, cache)
        left_out.append(NOT_IN_RANKS)
    result, idle = _evaluate(scene, link, poses, paths, settings, loss, relevance_db)
    left_out += idle
    if others is not None:
        result = _with_others(result, link, tuple(interactions), *others)
    if visibility == "pairs":
        result = _by_pairs(site, link, poses, result, settings, loss, crowns, only)
    return replace(
        result,
        seconds=time.perf_counter() - started,
        search_seconds=search_seconds,
        left_out=left_out,
        from_cache=from_cache,
        samples=settings.samples if engine == "sionna" else 0,
        samples_reason=choice.reason if choice else "",
    )


@dataclass(frozen=True, slots=True)
class Whole:
    """What a part of a replay must know of the others, so that it is the same as in one piece.

    Parameters
    ----------
    extent_m : (points, 3)
        Points that span all poses: they set the tolerance of the path search.
    pairs : int
        Element pairs of all links: they decide whether compiled code is worth loading.
    """

    extent_m: FloatArray
    pairs: int


LEVELS_AT_ONCE = 1024
"""Poses of which levels are made at once."""

LONG_SEARCH_S = 60.0
"""A search that will take longer is a warning where nobody asked to be told."""

MANY_FACES = 400
"""Faces beyond which sequences of two reflections are found by compiled beams; the paths are the same."""

PAIRS_DIFFER = 1e-9
"""Of the root of a link's power: more than rounding between H of the centres' paths and of each pair's own."""


def _by_pairs(
    site: Site,
    link: Link,
    poses: Poses,
    centre: Replay,
    settings: Settings,
    loss: Loss | None,
    crowns: Crowns | None,
    only: BoolArray | None,
) -> Replay:
    """Each element pair with its own paths: every tower element is a source, every UAV element a pose."""
    names, arrays = list(link.tower_arrays), list(link.tower_arrays.values())
    ports, uav = len(arrays[0]), link.uav_array
    singles = {
        f"{name} {port}": _single(array, port)
        for name, array in zip(names, arrays, strict=True)
        for port in range(ports)
    }
    h = np.zeros((len(poses), len(names), len(uav), ports), dtype=np.complex128)
    power = np.zeros((len(poses), len(names)))
    turn = poses.rotation @ uav.mount
    scene = Scene.of(site, link, poses)
    offsets = np.concatenate([array.positions_m @ array.mount.T for array in arrays])
    several = replace(
        scene,
        sources_m=np.repeat(scene.sources_m, ports, axis=0) + offsets,
        usable=np.repeat(scene.usable, ports, axis=0),
        excluded=np.repeat(scene.excluded if only is None else scene.excluded | ~only, ports, axis=0),
    )
    for element in range(len(uav)):
        spots = Poses(poses.position_m + turn @ uav.positions_m[element], poses.rotation)
        one = replace(link, tower_arrays=singles, uav_array=_single(uav, element), uav_transmits=False)
        paths, _ = _above_terrain(site, several, spots, _search(several, one, spots, settings, None))
        geometry = several
        if crowns is not None and several.surfaces is None:
            geometry, bounces = several.with_bounces(site, spots, crowns, settings.max_depth)
            paths = image.merge([paths, bounces], settings.max_depth, None)
        loss_db = None if loss is None else loss(paths, geometry.sources_m, spots.position_m)
        fields = channel_matrices(paths, geometry.faces, geometry.sources_m, spots, one, loss_db)
        h[:, :, element] = fields.h[..., 0, 0].reshape(len(poses), len(names), ports)
        power += fields.power.reshape(len(poses), len(names), ports).sum(axis=2) / (ports * len(uav))
    h = np.ascontiguousarray(h.swapaxes(2, 3)) if link.uav_transmits else h
    level = rss_dbm(mean_pair_power(h), link.transmit_power_dbm, link.noise_floor_dbm)
    covered = np.isfinite(level)
    h = np.where(covered[:, :, None, None], h, 0.0)
    size = np.sqrt(np.maximum(mean_pair_power(h), mean_pair_power(centre.h)))
    return replace(
        centre,
        rss_dbm=level,
        rss_power_dbm=rss_dbm(power, link.transmit_power_dbm, link.noise_floor_dbm),
        h=h,
        has_path=covered,
        pairs_differ=np.abs(h - centre.h).max(axis=(2, 3)) > PAIRS_DIFFER * size,
    )


def _single(array: Array, element: int) -> Array:
    """One element of an array, in the centre of its own."""
    pattern = array.patterns[element if len(array.patterns) > 1 else 0]
    return Array(np.zeros((1, 3)), array.slant_rad[element : element + 1], (pattern,), array.mount)


def _choose_samples(scene: Scene, link: Link, poses: Poses, settings: Settings, cache: PathCache | None) -> Choice:
    """Rays per tower at which two pilots on a batch of poses, spread over the flight, find the same paths."""
    some = spread(np.flatnonzero(np.isfinite(poses.position_m).all(axis=1)), settings.batch)
    part = replace(scene, excluded=scene.excluded[:, some])
    few = Poses(poses.position_m[some], poses.rotation[some])

    def pilot(samples: int) -> PathSet:
        return _search_or_read(part, link, few, replace(settings, samples=samples), cache, None)[0]

    return enough_samples(pilot, scene.faces, len(some))


def _loss_of_cut(
    site: Site, scene: Scene, link: Link, poses: Poses, settings: Settings, loss: Loss | None, cache: PathCache | None
) -> list[str]:
    """What the power cut costs at a few poses, spread over the flight, that are searched without it."""
    some = spread(np.flatnonzero(np.isfinite(poses.position_m).all(axis=1)), CHECKED_POSES)
    cut_db = settings.power_cut_db
    if not len(some) or cut_db is None:
        return []
    few = Poses(poses.position_m[some], poses.rotation[some])
    part = replace(scene, excluded=scene.excluded[:, some])
    whole, _, _ = _search_or_read(part, link, few, replace(settings, power_cut_db=None), cache, None)
    whole, _ = _above_terrain(site, part, few, whole)
    kept = within_cut(whole, scene.sources_m, few.position_m, cut_db)
    level = []
    for paths in (whole, kept):
        loss_db = None if loss is None else loss(paths, scene.sources_m, few.position_m)
        h = channel_matrices(paths, scene.faces, scene.sources_m, few, link, loss_db, threads=settings.threads).h
        level.append(rss_dbm(mean_pair_power(h), link.transmit_power_dbm, link.noise_floor_dbm))
    both = np.isfinite(level[0]) & np.isfinite(level[1])
    lost = int((np.isfinite(level[0]) & ~np.isfinite(level[1])).sum())
    change = level[1][both] - level[0][both]
    return [loss_in_words(cut_db, len(whole), len(whole) - len(kept), len(some), change, lost)]


REACH_M = 100_000.0
"""Poses further than this from every tower [m] are no poses of the site."""


def _within_reach(site: Site, poses: Poses) -> tuple[Poses, list[str]]:
    """Poses with those that cannot be replayed as unknown (NaN): each alone, so that the others keep their paths.

    Tolerances grow with the size of the scene: one pose at 1e12 m would change the paths of all. A pose without a
    rotation has no field.
    """
    towers = np.array([tower.position_m for tower in site.towers.values()]).reshape(-1, 3)
    if len(poses) and len(towers) and np.isfinite(poses.position_m).all() and np.isfinite(poses.rotation).all():
        low, high = poses.position_m.min(axis=0), poses.position_m.max(axis=0)
        if (np.maximum(np.abs(low - towers), np.abs(high - towers)) <= REACH_M).all(axis=1).any():
            return poses, []  # the usual flight, decided by its box
    known = np.isfinite(poses.position_m).all(axis=1)
    turned = np.isfinite(poses.rotation).all(axis=(1, 2))
    with np.errstate(over="ignore", invalid="ignore"):
        far = np.ones(len(poses), dtype=np.bool_)
        for place in towers:
            far &= ~(np.abs(poses.position_m - place).max(axis=1) <= REACH_M)
    far &= known
    bad = far | ~turned
    if not bad.any():
        return poses, []
    reasons = [
        (far, f"poses further than {REACH_M / 1000:g} km from every tower"),
        (known & ~far & ~turned, "poses without a rotation"),
    ]
    lines = [f"{int(mask.sum())} {what}: no path was searched for them" for mask, what in reasons if mask.any()]
    position = np.where(bad[:, None], np.nan, poses.position_m)
    rotation = np.where(bad[:, None, None], np.eye(3), poses.rotation)
    return Poses(position, rotation), lines


def _buried_towers(site: Site, link: Link) -> list[str]:
    """Towers whose antenna is inside a building, said so: a wrong footprint would look like a dead tower."""
    lines = []
    names = list(link.tower_arrays)
    places = np.array([site.towers[name].position_m for name in names]).reshape(-1, 3)
    for number in np.flatnonzero(inside_solids(site, places)):
        name = names[number]
        for building in site.buildings:
            if inside_solids(replace(site, buildings=(building,)), places[number : number + 1]).any():
                lines.append(f"{name}: its antenna is inside {building.name}, so it has no path at all")
    return lines


def _search_or_read(
    scene: Scene,
    link: Link,
    poses: Poses,
    settings: Settings,
    cache: PathCache | None,
    progress: Callable[[float], None] | None,
    on_estimate: OnEstimate | None = None,
) -> tuple[PathSet, float, bool]:
    """Paths, the seconds of their search, and whether they were read from the cache."""
    key = cache.key(scene, poses.position_m, link.carrier_hz, settings) if cache else ""
    kept = cache.load(key) if cache else None
    if kept:
        return *kept, True
    started = time.perf_counter()
    paths = _search(scene, link, poses, settings, progress, on_estimate)
    seconds = time.perf_counter() - started
    if cache:
        cache.save(key, paths, seconds)
    return paths, seconds, False


def _search(
    scene: Scene,
    link: Link,
    poses: Poses,
    settings: Settings,
    progress: Callable[[float], None] | None,
    on_estimate: OnEstimate | None = None,
) -> PathSet:
    """Paths by the engine that the settings name, those left out that the power cut does."""
    paths = _by_engine(scene, link, poses, settings, progress, on_estimate)
    if settings.power_cut_db is None:
        return paths
    return within_cut(paths, scene.sources_m, poses.position_m, settings.power_cut_db)


def _longest_m(scene: Scene, poses: Poses, settings: Settings) -> float | FloatArray:
    """Longest path that need be searched for, a little more than counts."""
    if settings.power_cut_db is None:
        return float(np.inf)
    return longest_m(scene.sources_m, poses.position_m, settings.power_cut_db) * (1.0 + ROUNDING)


def _long_search(estimate: Estimate) -> None:
    if estimate.seconds > LONG_SEARCH_S:
        warnings.warn(f"the path search takes {estimate}", RuntimeWarning, stacklevel=2)


def _by_beams(scene: Scene, settings: Settings) -> bool:
    """Whether the image engine searches by compiled beams: a scene of triangles, or many faces."""
    if settings.engine != "image":
        return False
    if scene.surfaces is not None:
        return True
    if settings.max_depth < 2 or len(scene.faces) <= MANY_FACES or find_spec("numba") is None:
        return False
    state = beams()
    if state.kernels is None and switch() != "never":
        warn_once(state.reason)
    return state.kernels is not None


def estimate_search(
    site: Site,
    link: Link,
    poses: Poses,
    *,
    max_depth: int = 2,
    power_cut_db: float | None = None,
    threads: int | None = None,
) -> Estimate | None:
    """What the path search of the image engine will take, from its first faces.

    Parameters
    ----------
    site, link, poses, max_depth, power_cut_db, threads
        As for :func:`replay`.

    Returns
    -------
    Estimate or None
        None where there are few faces: a replay of some poses tells it.
    """
    poses, _ = _within_reach(site, poses)
    scene = Scene.of(site, link, poses)
    settings = Settings("image", max_depth, power_cut_db=power_cut_db)
    if not _by_beams(scene, settings):
        return None
    from . import growth, prisms  # compiled: loaded where there are many faces

    solids = scene.surfaces is None
    return growth.estimate(
        scene.surfaces or prisms.solid_surfaces(scene.faces, scene.sources_m, poses.position_m),
        scene.sources_m,
        poses.position_m,
        max_depth=max_depth,
        usable=scene.usable,
        excluded=scene.excluded,
        longest_m=_longest_m(scene, poses, settings),
        threads=threads,
        solids=solids,
    )


def _by_engine(
    scene: Scene,
    link: Link,
    poses: Poses,
    settings: Settings,
    progress: Callable[[float], None] | None,
    on_estimate: OnEstimate | None,
) -> PathSet:
    if _by_beams(scene, settings):
        from . import growth, prisms  # compiled: loaded where there are many faces

        options: dict[str, Any] = {
            "max_depth": settings.max_depth,
            "usable": scene.usable,
            "excluded": scene.excluded,
            "longest_m": _longest_m(scene, poses, settings),
            "threads": settings.threads,
            "on_estimate": on_estimate or _long_search,
            "progress": progress,
        }
        ends = scene.sources_m, poses.position_m
        if scene.surfaces is not None:
            return growth.grow_paths(scene.surfaces, *ends, **options)[0]
        return prisms.find_paths(scene.faces, *ends, extent_m=scene.extent_m, **options)[0]
    if settings.engine == "image":
        return image.find_paths(
            scene.faces,
            scene.sources_m,
            poses.position_m,
            max_depth=settings.max_depth,
            usable=scene.usable,
            excluded=scene.excluded,
            extent_m=scene.extent_m,
            progress=progress,
        )
    from . import sionna

    return sionna.find_paths(
        scene.faces,
        scene.sources_m,
        poses.position_m,
        carrier_hz=link.carrier_hz,
        max_depth=settings.max_depth,
        samples=settings.samples,
        batch=settings.batch,
        usable=scene.usable,
        excluded=scene.excluded,
        surfaces=scene.surfaces,
        variant=settings.variant,
        progress=progress,
    )


NOT_IN_RANKS = "other interactions than reflections in H and ranks: their power is added to RSS alone"


def _other_powers(
    site: Site,
    scene: Scene,
    link: Link,
    poses: Poses,
    settings: Settings,
    searches: Sequence[OtherSearch],
    loss: Loss | None,
    cache: PathCache | None,
) -> tuple[FloatArray, IntArray, dict[str, int]]:
    """Power and number (poses, towers) of the paths with other interactions, and what they are made of."""
    shape = (len(poses), len(scene.sources_m))
    power, count, kinds = np.zeros(shape), np.zeros(shape, dtype=np.int64), Counter[str]()
    for search in searches:
        for others in _others(scene, link, poses, settings, search, cache):
            clear = _clear_of_terrain(site, scene, poses, others.geometry)
            paths = others.select(clear)
            loss_db = None if loss is None else loss(paths.reflections, scene.sources_m, poses.position_m)
            if loss_db is not None:
                paths, loss_db = paths.select(np.isfinite(loss_db)), loss_db[np.isfinite(loss_db)]
            np.add.at(power, (paths.pose, paths.tower), path_powers(paths, link, poses, loss_db))
            np.add.at(count, (paths.pose, paths.tower), 1)
            kinds.update(paths.named())
    return power, count, dict(sorted(kinds.items()))


def _others(
    scene: Scene, link: Link, poses: Poses, settings: Settings, search: OtherSearch, cache: PathCache | None
) -> Iterator[OtherPaths]:
    """Paths of one search, batch by batch; scattered ones, of which each link has hundreds, are not kept."""
    cache = None if search.scattering else cache
    samples = min(settings.samples, SCATTERING_SAMPLES) if search.scattering else settings.samples
    key = cache.key(scene, poses.position_m, link.carrier_hz, settings, search) if cache else ""
    kept = cache.load_others(key) if cache else None
    if kept is not None:
        yield kept
        return
    from . import sionna

    batches = sionna.find_others(
        scene.faces,
        scene.sources_m,
        poses.position_m,
        carrier_hz=link.carrier_hz,
        search=search,
        max_depth=settings.max_depth,
        samples=samples,
        batch=settings.batch,
        usable=scene.usable,
        excluded=scene.excluded,
        surfaces=scene.surfaces,
        variant=settings.variant,
    )
    if cache is None:
        yield from batches
        return
    joined = OtherPaths.joined(batches, settings.max_depth)
    cache.save_others(key, joined)
    yield joined


def _with_others(
    result: Replay,
    link: Link,
    asked: tuple[str, ...],
    power: FloatArray,
    count: IntArray,
    kinds: dict[str, int],
) -> Replay:
    """Levels with the power of other interactions: a level never falls by it."""
    other = OtherInteractions(
        asked=asked,
        power=power,
        paths=count,
        kinds=kinds,
        rss_dbm=result.rss_dbm,
        rss_power_dbm=result.rss_power_dbm,
        has_path=result.has_path,
    )

    def raised(known: FloatArray) -> FloatArray:
        own = np.where(np.isfinite(known), power_from_db(np.nan_to_num(known) - link.transmit_power_dbm), 0.0)
        summed = rss_dbm(own + power, link.transmit_power_dbm, link.noise_floor_dbm)
        return np.asarray(np.where(power > 0.0, summed, known))

    level = raised(result.rss_dbm)
    return replace(
        result,
        rss_dbm=level,
        rss_power_dbm=raised(result.rss_power_dbm),
        has_path=result.has_path | np.isfinite(level),
        other=other,
    )


def _cache(engine: str, cache_dir: str | Path | None) -> PathCache | None:
    if cache_dir is None:
        if engine != "sionna":
            return None
        cache_dir = os.environ.get("AERPAW_CMP_CACHE") or Path.home() / ".cache" / "aerpaw-cmp"
    return PathCache(Path(cache_dir)) if str(cache_dir) else None


def _above_terrain(site: Site, scene: Scene, poses: Poses, paths: PathSet) -> tuple[PathSet, list[str]]:
    """Paths that the site's elevation model lets through.

    The traced ground is a plane per tower; the terrain only blocks. It is asked on the direct line between the ends,
    whose shadow a ground reflection shares; a path over walls alone is asked on each of its segments.
    """
    if site.dem is None or len(paths) == 0:
        return paths, []
    clear = _clear_of_terrain(site, scene, poses, paths)
    lost = int((~clear).sum())
    return paths.select(clear), [
        f"{lost} of {len(paths)} paths end at the terrain of the elevation model"
    ] if lost else []


def _clear_of_terrain(site: Site, scene: Scene, poses: Poses, paths: PathSet) -> BoolArray:
    """Paths (paths,) that the elevation model lets through."""
    if site.dem is None or len(paths) == 0:
        return np.ones(len(paths), dtype=np.bool_)
    source, target = scene.sources_m[paths.tower], poses.position_m[paths.pose]
    ground = np.append(scene.faces.solid < 0, False)  # the last entry stands for "no face"
    over_ground = ground[paths.faces].any(axis=1)
    straight = (paths.depth == 0) | over_ground
    clear = np.ones(len(paths), dtype=np.bool_)
    clear[straight] = site.dem.clear(source[straight], target[straight])
    rows = np.flatnonzero(~straight)
    start = source[rows]
    for step in range(paths.vertices_m.shape[1] + 1):
        last = step == paths.vertices_m.shape[1]
        corner = target[rows] if last else paths.vertices_m[rows, step]
        end = np.where(np.isfinite(corner), corner, target[rows])
        clear[rows] &= site.dem.clear(start, end)
        start = end
    return clear


def _evaluate(
    scene: Scene,
    link: Link,
    poses: Poses,
    paths: PathSet,
    settings: Settings,
    loss: Loss | None,
    relevance_db: float | None,
) -> tuple[Replay, list[str]]:
    """Fields of the paths, and which buildings hardly matter to them; times are the caller's."""
    loss_db = None if loss is None else loss(paths, scene.sources_m, poses.position_m)
    work = scene.pairs or None
    fields = channel_matrices(
        paths,
        scene.faces,
        scene.sources_m,
        poses,
        link,
        loss_db,
        threads=settings.threads,
        work=work,
    )
    has_path = np.zeros((len(poses), len(scene.sources_m)), dtype=np.bool_)
    if loss_db is None:
        has_path[paths.pose, paths.tower] = True
    else:
        open_ = np.isfinite(loss_db)  # an infinite loss is an obstacle
        has_path[paths.pose[open_], paths.tower[open_]] = True
    idle: list[str] = []
    if relevance_db is not None:
        labels, _ = idle_objects(paths, scene.faces, fields.path_power, mean_pair_power(fields.h), relevance_db)
        idle = in_words(labels, relevance_db)
    level_dbm, power_dbm = _levels(fields, has_path, link)
    return Replay(
        rss_dbm=level_dbm,
        rss_power_dbm=power_dbm,
        h=fields.h,
        has_path=has_path,
        paths=paths,
        faces=scene.faces,
        seconds=0.0,
        search_seconds=0.0,
        engine=settings.engine,
        towers=tuple(link.tower_arrays),
        surfaces=scene.surfaces,
    ), idle


def _levels(fields: Fields, has_path: BoolArray, link: Link) -> tuple[FloatArray, FloatArray]:
    """Levels (poses, towers) of H and of the summed powers; below the noise floor H and ``has_path`` become nothing."""
    h, sent, floor = fields.h, link.transmit_power_dbm, link.noise_floor_dbm
    level_dbm, power_dbm = np.empty(has_path.shape), np.empty(has_path.shape)
    for first in range(0, len(h), LEVELS_AT_ONCE):  # in the cache; a second thread would gain nothing
        part = slice(first, first + LEVELS_AT_ONCE)
        level_dbm[part] = rss_dbm(mean_pair_power(h[part]), sent, floor)
        power_dbm[part] = rss_dbm(fields.power[part], sent, floor)
        above_floor = np.isfinite(level_dbm[part])
        if not above_floor.all():
            h[part][~above_floor] = 0.0
        has_path[part] &= above_floor
    return level_dbm, power_dbm

"""Speed against error of the engines on this machine, for ``aerpaw-cmp bench`` and the report."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from shapely import affinity
from shapely.geometry import Point, box

from ..common.geodesy import SiteFrame
from ..common.stages import Progress, silent
from ..common.units import ComplexArray, FloatArray, wavelength_m
from ..propagation.arrays import Link, Poses, rotation_from_aircraft, tower_comparison_array, uav_comparison_array
from ..propagation.check.audit import RANK_K, Difference, compare
from ..propagation.field.sum import mean_pair_power, rss_dbm
from ..propagation.options import Run, Search
from ..propagation.replay import Replay, replay
from ..propagation.scene import Scene
from ..site.site import Building, Site, Tower


@dataclass(frozen=True, slots=True)
class Row:
    """One way to replay the same poses, and how far it is from the reference.

    The reference is the image engine at the chosen depth on all poses. ``None`` where a column has no meaning:
    Sionna's own explicit arrays and thinned poses give no path list to compare.

    Parameters
    ----------
    engine : {"image", "sionna"}
    samples : int or None
        Rays per tower and batch.
    arrays : {"float64", "synthetic", "explicit"}
        Who evaluates H: this package, or Sionna with plane waves or with every element traced.
    depth : int
    thinning : int
        Every n-th pose is replayed; RSS is interpolated, rank taken from the nearest.
    seconds : float
        Warm: kernels were compiled and one batch run before.
    links_per_s : float
        Pose-tower pairs answered per second.
    peak_mib : float
        Largest resident memory of the whole process during the run.
    missing_paths, extra_paths : int or None
    rss_max_error_db, rss_rms_error_db : float
        Over links that both cover; NaN when there is none.
    coverage_differs : int
        Links that only one of the two covers.
    rank_disagreement : dict of float to float
        Share of links whose rank differs, for each K.
    """

    engine: str
    samples: int | None
    arrays: str
    depth: int
    thinning: int
    seconds: float
    links_per_s: float
    peak_mib: float
    missing_paths: int | None
    extra_paths: int | None
    rss_max_error_db: float
    rss_rms_error_db: float
    coverage_differs: int
    rank_disagreement: dict[float, float]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON: NaN becomes None, K becomes text."""
        result: dict[str, Any] = {name: getattr(self, name) for name in self.__slots__}
        for name, value in result.items():
            if isinstance(value, float) and not np.isfinite(value):
                result[name] = None
        result["rank_disagreement"] = {f"{k:g}": share for k, share in self.rank_disagreement.items()}
        return result


def speed_against_error(
    site: Site,
    link: Link,
    poses: Poses,
    *,
    samples: Sequence[int] = (1_000, 10_000, 100_000, 1_000_000),
    arrays: Sequence[str] = ("synthetic", "explicit", "float64"),
    explicit_poses: int = 50,
    depth: int = 2,
    depths: Sequence[int] = (0, 1, 2, 3),
    thinning: Sequence[int] = (2, 5),
    batch: int = 50,
    ks: Sequence[float] = RANK_K,
    progress: Progress | None = None,
) -> list[Row]:
    """Rows of speed against error.

    Parameters
    ----------
    site, link, poses
        What to replay. Rows of Sionna's own arrays need isotropic elements.
    samples : sequence of int
        Rays of the Sionna rows; empty for none.
    arrays : sequence of {"synthetic", "explicit", "float64"}
        Which Sionna rows.
    explicit_poses : int
        Explicit arrays multiply the work by the element pairs: their rows take this many poses, evenly spread.
    depth : int
        Of the reference and the Sionna rows.
    depths, thinning : sequence of int
        Further rows of the image engine.
    batch : int
        Poses per PathSolver call.
    ks : sequence of float
    progress : callable, optional
        Told what runs.

    Returns
    -------
    list of Row
        Image engine first: once Sionna is loaded the process stays larger.
    """
    run = _Runner(
        site=site, link=link, poses=poses, depth=depth, ks=tuple(ks), batch=batch, progress=progress or silent
    )
    rows = [run.image(d) for d in depths]
    rows += [run.thinned(n) for n in thinning]
    for count in samples:
        for kind in arrays:
            if kind == "float64":
                rows.append(run.sionna(count))
            else:
                rows.append(run.own_arrays(count, kind == "explicit", explicit_poses))
    return rows


class _Runner:
    """Runs rows against one reference."""

    def __init__(
        self, site: Site, link: Link, poses: Poses, depth: int, ks: tuple[float, ...], batch: int, progress: Progress
    ) -> None:
        self.site, self.link, self.poses, self.depth = site, link, poses, depth
        self.ks, self.batch, self.progress = ks, batch, progress
        self.all = np.arange(len(poses))
        self.reference = replay(site, link, poses, Search(max_depth=depth))

    def image(self, depth: int) -> Row:
        self.progress(f"image engine, depth {depth}")
        with _Memory() as memory:
            result = replay(self.site, self.link, self.poses, Search(max_depth=depth))
        difference = compare(result, self.reference, self.all, self.ks)
        return self._row(
            engine="image",
            samples=None,
            arrays="float64",
            depth=depth,
            thinning=1,
            seconds=result.seconds,
            peak_mib=memory.peak_mib,
            difference=difference,
            poses=len(self.poses),
        )

    def thinned(self, step: int) -> Row:
        self.progress(f"image engine, one of {step} positions")
        chosen = self.all[::step]
        with _Memory() as memory:
            result = replay(self.site, self.link, _take(self.poses, chosen), Search(max_depth=self.depth))
        nearest = np.minimum((self.all + step // 2) // step, len(chosen) - 1)
        level = np.stack([_between(self.all, chosen, column, nearest) for column in result.rss_dbm.T], axis=1)
        left_out = np.flatnonzero(self.all % step)  # poses that were replayed have no error, and say nothing
        difference = self._difference(result.h[nearest[left_out]], level[left_out], self.all[left_out])
        return self._row(
            engine="image",
            samples=None,
            arrays="float64",
            depth=self.depth,
            thinning=step,
            seconds=result.seconds,
            peak_mib=memory.peak_mib,
            difference=difference,
            poses=len(self.poses),
        )

    def sionna(self, samples: int) -> Row:
        self.progress(f"sionna, {samples} samples")
        self._replay_sionna(samples, self.all[: self.batch])  # compiles the kernels
        with _Memory() as memory:
            result = self._replay_sionna(samples, self.all)
        difference = compare(result, self.reference, self.all, self.ks)
        return self._row(
            engine="sionna",
            samples=samples,
            arrays="float64",
            depth=self.depth,
            thinning=1,
            seconds=result.seconds,
            peak_mib=memory.peak_mib,
            difference=difference,
            poses=len(self.poses),
        )

    def _replay_sionna(self, samples: int, chosen: Any) -> Replay:
        search = Search("sionna", max_depth=self.depth, samples=samples, batch=self.batch)
        return replay(self.site, self.link, _take(self.poses, chosen), search, run=Run(cache_dir=""))

    def own_arrays(self, samples: int, explicit: bool, most: int) -> Row:
        from ..propagation.search.sionna import own_channels

        name = "explicit" if explicit else "synthetic"
        self.progress(f"sionna, {samples} samples, its own {name} arrays")
        chosen = self.all
        if explicit and most < len(chosen):
            chosen = np.unique(np.linspace(0, len(chosen) - 1, most).round().astype(np.int64))
        # explicit arrays multiply sources and targets: smaller batches bound the memory
        batch = min(self.batch, 10) if explicit else self.batch
        poses = _take(self.poses, chosen)
        scene = Scene.of(self.site, self.link, poses)

        def channels(some: Poses) -> ComplexArray:
            return own_channels(
                scene.faces, scene.sources_m, some, self.link,
                explicit=explicit, max_depth=self.depth, samples=samples, batch=batch, usable=scene.usable,
            )  # fmt: skip

        channels(_take(poses, np.arange(min(batch, len(poses)))))
        with _Memory() as memory:
            started = time.perf_counter()
            h = channels(poses)
            seconds = time.perf_counter() - started
        difference = self._difference(h, rss_dbm(mean_pair_power(h), self.link.transmit_power_dbm), chosen)
        return self._row(
            engine="sionna",
            samples=samples,
            arrays=name,
            depth=self.depth,
            thinning=1,
            seconds=seconds,
            peak_mib=memory.peak_mib,
            difference=difference,
            poses=len(chosen),
        )

    def _difference(self, h: ComplexArray, level: FloatArray, chosen: Any) -> Difference:
        from ..compare.rank import channel_rank

        expected = self.reference.rss_dbm[chosen]
        both = np.isfinite(level) & np.isfinite(expected)
        error = np.abs(level[both] - expected[both])
        return Difference(
            missing_paths=-1,
            extra_paths=-1,
            reference_paths=0,
            rss_max_error_db=float(error.max()) if error.size else float("nan"),
            rss_rms_error_db=float(np.sqrt((error**2).mean())) if error.size else float("nan"),
            coverage_differs=int((np.isfinite(level) != np.isfinite(expected)).sum()),
            rank_disagreement={
                float(k): float(np.mean(channel_rank(h, k) != channel_rank(self.reference.h[chosen], k)))
                for k in self.ks
            },
        )

    def _row(
        self, engine: str, samples: int | None, arrays: str, depth: int, thinning: int, seconds: float, peak_mib: float,
        difference: Difference, poses: int,
    ) -> Row:  # fmt: skip
        listed = difference.missing_paths >= 0
        return Row(
            engine=engine,
            samples=samples,
            arrays=arrays,
            depth=depth,
            thinning=thinning,
            seconds=seconds,
            links_per_s=poses * len(self.link.tower_arrays) / max(seconds, 1e-9),
            peak_mib=peak_mib,
            missing_paths=difference.missing_paths if listed else None,
            extra_paths=difference.extra_paths if listed else None,
            rss_max_error_db=difference.rss_max_error_db,
            rss_rms_error_db=difference.rss_rms_error_db,
            coverage_differs=difference.coverage_differs,
            rank_disagreement=difference.rank_disagreement,
        )


def _take(poses: Poses, chosen: Any) -> Poses:
    return Poses(poses.position_m[chosen], poses.rotation[chosen])


def _between(at: Any, known: Any, values: FloatArray, nearest: Any) -> FloatArray:
    """Values interpolated over the pose index; where a neighbour is NaN, the nearest decides."""
    good = np.isfinite(values)
    if not good.any():
        return np.full(len(at), np.nan)
    line = np.interp(at, known[good], values[good])
    return np.asarray(np.where(good[nearest], line, np.nan))


class _Memory:
    """Largest resident memory of this process while the block runs, sampled every 5 ms (0 where /proc is missing)."""

    def __init__(self) -> None:
        self.peak_mib = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> _Memory:
        self._look()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        self._look()

    def _watch(self) -> None:
        while not self._stop.wait(0.005):
            self._look()

    def _look(self) -> None:
        try:
            text = Path("/proc/self/status").read_text()
        except OSError:
            return
        for line in text.splitlines():
            if line.startswith("VmRSS:"):
                self.peak_mib = max(self.peak_mib, int(line.split()[1]) / 1024.0)


def path_search(
    poses: int = 1000, samples: int = 1_000_000, *, batch: int = 50, buildings: int = 12, repeats: int = 5
) -> dict[str, Any]:
    """Path search of the image engine against Sionna's PathSolver, both warm, in this one run.

    Parameters
    ----------
    poses, buildings : int
        Size of :func:`random_scene`.
    samples, batch : int
        Of PathSolver.
    repeats : int
        Runs of the image engine before, and as many after Sionna's; the median counts. The load of the machine may
        change in between.

    Returns
    -------
    dict
        ``seconds_image``, ``seconds_sionna``, ``ratio``, ``paths_image``, ``paths_sionna``, ``missing_paths``,
        ``extra_paths`` and ``rss_max_error_db`` (image against Sionna), and the conditions.
    """
    from ..propagation.search import mirror, sionna

    site, link, some = random_scene(poses, buildings=buildings)
    scene = Scene.of(site, link, some)

    def search() -> float:
        started = time.perf_counter()
        mirror.find_paths(
            scene.faces,
            scene.sources_m,
            some.position_m,
            max_depth=2,
            usable=scene.usable,
            excluded=scene.excluded,
        )
        return time.perf_counter() - started

    search()
    times = [search() for _ in range(repeats)]
    # compiles the kernels
    replay(
        site, link, _take(some, np.arange(batch)), Search("sionna", samples=samples, batch=batch), run=Run(cache_dir="")
    )
    theirs = replay(site, link, some, Search("sionna", samples=samples, batch=batch), run=Run(cache_dir=""))
    times += [search() for _ in range(repeats)]
    difference = compare(replay(site, link, some), theirs, np.arange(poses))
    seconds = float(np.median(times))
    return {
        "ratio": theirs.search_seconds / seconds,
        "seconds_image": seconds,
        "seconds_sionna": theirs.search_seconds,
        "paths_image": difference.reference_paths - difference.missing_paths + difference.extra_paths,
        "paths_sionna": difference.reference_paths,
        "missing_paths": difference.missing_paths,
        "extra_paths": difference.extra_paths,
        "rss_max_error_db": difference.rss_max_error_db,
        "poses": poses,
        "samples": samples,
        "batch": batch,
        "faces": len(scene.faces),
        "depth": 2,
        "versions": sionna.engine_versions(),
    }


def random_scene(poses: int, *, buildings: int = 12, towers: int = 1, seed: int = 1) -> tuple[Site, Link, Poses]:
    """A scene to measure on: rotated boxes 4 to 12 m high in a field of 600 m, a winding flight 20 to 60 m up.

    Parameters
    ----------
    poses, buildings, towers : int
    seed : int

    Returns
    -------
    site, link, poses
        The link has the arrays of the paper's measurement comparison.
    """
    rng = np.random.default_rng(seed)
    places = rng.uniform(-200, 200, (towers, 2))
    places[0] = 0.0
    made: list[Building] = []
    while len(made) < buildings:
        east, north = rng.uniform(-300, 300, 2)
        half = rng.uniform((5, 5), (20, 12))
        shape = box(east - half[0], north - half[1], east + half[0], north + half[1])
        shape = affinity.rotate(shape, rng.uniform(0, 180))
        near_tower = min(shape.distance(Point(p)) for p in places) < 10
        if near_tower or any(shape.distance(b.footprint) < 3 for b in made):
            continue
        made.append(Building(f"building {len(made) + 1}", shape, float(rng.uniform(4, 12))))
    named = {f"LW{i + 1}": Tower(f"LW{i + 1}", 35.7, -78.7, float(p[0]), float(p[1])) for i, p in enumerate(places)}
    site = Site("random boxes", SiteFrame(35.7275, -78.696), named, tuple(made))
    # a Lissajous curve of 4.6 km crosses the whole field
    along = np.linspace(0.0, 2.0 * np.pi, poses, endpoint=False)
    position = np.column_stack(
        [290 * np.sin(3 * along + 0.4), 290 * np.sin(2 * along), 40.0 + 20.0 * np.sin(5 * along + 1.0)]
    )
    angles = 10.0 * np.sin(np.outer([7, 11, 1], along))
    carrier_hz = 3.4e9
    link = Link(
        carrier_hz,
        dict.fromkeys(named, tower_comparison_array()),
        uav_comparison_array(wavelength_m(carrier_hz)),
        uav_transmits=False,
    )
    return site, link, Poses(position, rotation_from_aircraft(angles[0], angles[1], 18 * angles[2]))

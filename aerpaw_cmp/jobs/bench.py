"""The ``bench`` job: speed against error of the engines, and speed compared with other programs."""

from __future__ import annotations

import io
import os
import statistics
import time
import timeit
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from shapely import affinity
from shapely.geometry import Point, box

from ..common.geodesy import SiteFrame
from ..common.stages import Progress, begin_peak, logged, peak_mib
from ..common.text import counted
from ..common.units import wavelength_m
from ..propagation.check.audit import RANK_K, compare
from ..propagation.geometry import Link, Poses, rotation_from_aircraft, tower_comparison_array, uav_comparison_array
from ..propagation.options import Run, Search
from ..propagation.replay import Replay, replay
from ..site.site import Building, Site, Tower

# Largest number of reflections of the reference and of the Sionna rows.
_DEPTH = 2

# Poses per PathSolver call.
BATCH = 50

# Runs of each image row.
_REPEATS = 5

Row: TypeAlias = "dict[str, Any]"


def run_bench(
    *,
    poses: int = 200,
    samples: tuple[int, ...] = (1_000, 10_000, 100_000, 1_000_000),
    ratios: bool = True,
    progress: Progress = logged,
) -> dict[str, Any]:
    """Measure speed against error of the replay, and the speed of each part relative to another program.

    Parameters
    ----------
    poses : int
        Number of replayed poses.
    samples : tuple of int
        Rays per tower of the sionna engine.
    ratios : bool
        Also measure the engines of other programs.
    progress : Progress

    Returns
    -------
    dict
        ``conditions``, ``replay.rows``, ``ratios`` and ``details``.
    """
    site, link, some = random_scene(poses)
    rows = speed_against_error(site, link, some, samples=samples, progress=progress)
    measured = _against_peers(rows, progress) if ratios else {}
    scene = {"poses": poses, "towers": list(link.tower_arrays), "buildings": len(site.buildings)}
    return {
        "conditions": scene | {"cpus": os.cpu_count()},
        "replay": {"rows": rows},
        "ratios": {name: value["ratio"] for name, value in measured.items() if value is not None},
        "details": measured,
    }


def _against_peers(rows: Sequence[Row], progress: Progress) -> dict[str, Row | None]:
    """Return the speed relative to each other program. None if it is not installed or was not measured."""
    searches = path_search_ratios(rows)
    progress("Kriging against PyKrige, reading against pandas")
    return {
        **{f"path_search_image_vs_sionna_{name}": searches.get(name) for name in ("equal_error", "1e6")},
        "kriging_vs_pykrige": kriging_vs_pykrige(),
        "ingest_vs_pandas": ingest_vs_pandas(),
    }


# --- speed against error --------------------------------------------------------------------------------------------


def speed_against_error(
    site: Site,
    link: Link,
    poses: Poses,
    *,
    samples: Sequence[int] = (1_000, 10_000, 100_000, 1_000_000),
    depths: Sequence[int] = (0, 1, 2, 3),
    progress: Progress = logged,
) -> list[Row]:
    """Replay the same poses in several ways, and compare each with the image engine at depth 2.

    Parameters
    ----------
    site, link, poses
        Inputs of the replay.
    samples : sequence of int
        Rays of the Sionna rows. If empty, there are no Sionna rows.
    depths : sequence of int
        Depths of the rows of the image engine.
    progress : callable
        Receives the name of the row that is being measured.

    Returns
    -------
    list of dict
        The image engine is first, because Sionna increases the memory of the process permanently. A row has

        - ``engine``, ``samples`` (rays per tower and batch), ``arrays`` (type of H), ``depth``
        - ``seconds`` (wall time, warm), ``search_seconds`` (of the path search), ``links_per_s`` (pose-tower
          pairs), ``peak_mib`` (process; 0: unknown)
        - ``missing_paths``, ``extra_paths``, ``coverage_differs`` (links with a level in one replay only)
        - ``rss_max_error_db``, ``rss_rms_error_db`` over links with a level in both replays (None if there are none)
        - ``rank_disagreement`` by K
    """
    reference = replay(site, link, poses, Search(max_depth=_DEPTH))
    rows = []
    for depth in depths:
        progress(f"image engine, depth {depth}")
        rows.append(_replayed(site, link, poses, reference, Search(max_depth=depth)))
    for count in samples:
        progress(f"sionna, {counted(count, 'sample')}")
        search = Search("sionna", max_depth=_DEPTH, samples=count, batch=BATCH)
        rows.append(_replayed(site, link, poses, reference, search))
    return rows


def _replayed(site: Site, link: Link, poses: Poses, reference: Replay, search: Search) -> Row:
    """Replay all poses with an engine and return its row."""
    sionna = search.engine == "sionna"
    # replay without the cache: otherwise only the time of reading the cache would be measured
    alone = Run(cache_dir="")
    if sionna:
        replay(site, link, poses[:BATCH], search, run=alone)  # compiles the kernels
    begin_peak()
    started = time.perf_counter()
    # the search of the image engine takes a few hundredths of a second, so a single run would mainly show the load of
    # the machine
    runs = [replay(site, link, poses, search, run=alone) for _ in range(1 if sionna else _REPEATS)]
    seconds, result = (time.perf_counter() - started) / len(runs), runs[-1]
    difference = compare(result, reference, np.arange(len(poses)), RANK_K)
    errors = {"rss_max_error_db": difference.rss_max_error_db, "rss_rms_error_db": difference.rss_rms_error_db}
    return {
        "engine": search.engine,
        "samples": search.samples if sionna else None,
        "arrays": "float64",
        "depth": search.max_depth,
        "missing_paths": difference.missing_paths,
        "extra_paths": difference.extra_paths,
        "coverage_differs": difference.coverage_differs,
        **{name: value if np.isfinite(value) else None for name, value in errors.items()},
        "seconds": seconds,
        "search_seconds": statistics.median(run.search_seconds for run in runs),
        "peak_mib": peak_mib(),
        "rank_disagreement": {f"{k:g}": share for k, share in difference.rank_disagreement.items()},
        "links_per_s": len(poses) * len(link.tower_arrays) / max(seconds, 1e-9),
    }


# --- comparison with peers --------------------------------------------------------------------------------------------


def path_search_ratios(rows: Sequence[Row]) -> dict[str, Row]:
    """Return how many times faster the image engine's search is than each Sionna row of :func:`speed_against_error`.

    Returns
    -------
    dict
        Sionna rows with their ``ratio``, by the number of samples (``1e3``). The key ``equal_error`` has the row with
        the smallest number of samples that finds as many paths as the largest number. A comparison with more samples
        would favour the image engine. Empty without Sionna rows.
    """
    image = next(row for row in rows if row["engine"] == "image" and row["depth"] == _DEPTH)
    sionna = [
        {**row, "ratio": row["search_seconds"] / image["search_seconds"]} for row in rows if row["engine"] == "sionna"
    ]
    at = {f"{row['samples']:.0e}".replace("e+0", "e"): row for row in sionna}
    enough = [row for row in sionna if row["missing_paths"] <= sionna[-1]["missing_paths"]]
    return {**at, "equal_error": enough[0]} if sionna else {}


def median_seconds(action: Callable[[], Any], repeats: int) -> float:
    """Return the median processor time after a warm-up. Other running programs hardly affect it."""
    return statistics.median(timeit.repeat(action, timer=time.process_time, number=1, repeat=repeats + 1)[1:])


def kriging_vs_pykrige(positions: int = 2556) -> Row | None:
    """Compare Kriging with PyKrige's compiled part, with 20 neighbours and one exponential variogram."""
    try:
        from pykrige.ok import OrdinaryKriging as Peer
    except ImportError:
        return None
    from ..maps.kriging import OrdinaryKriging

    generator = np.random.default_rng(2)
    points, targets = generator.uniform(-1000.0, 1000.0, (2, positions, 2))
    rank = generator.integers(1, 5, positions).astype(np.float64)

    def ours() -> Any:
        return OrdinaryKriging(lambda d: 0.9 * np.exp(-3.0 * d / 900.0), 20, np.inf).fit(points, rank).predict(targets)

    def peer() -> Any:
        model = Peer(*points.T, rank, "exponential", {"psill": 0.9, "range": 900.0, "nugget": 0.1})
        return model.execute("points", *targets.T, backend="C", n_closest_points=20)

    return _compared(ours, peer, positions=positions)


def ingest_vs_pandas(lines: int = 20_523) -> Row:
    """Compare the reader of power logs with ``pandas.read_csv(engine="c")``, on a log as long as a real flight.

    The reader returns UTC times, levels, flags and the account of every line. pandas returns only text and numbers.
    """
    import pandas as pd

    from ..logs.readers import ReadOptions, by_name
    from ..logs.writers import format_power_log

    zone = "America/New_York"
    times = np.datetime64("2025-03-02T15:00:00", "ns") + np.arange(lines) * np.timedelta64(32_760_000, "ns")
    data = format_power_log(times, np.random.default_rng(1).normal(-40, 12, lines), zone)
    reader, options = by_name("sounder_log"), ReadOptions(timezone=zone)
    return _compared(
        lambda: reader.read(data, options),
        lambda: pd.read_csv(io.BytesIO(data), engine="c", header=None, sep=r"\s+"),
        lines=lines,
    )


def _compared(ours: Callable[[], Any], peer: Callable[[], Any], **about: int) -> Row:
    """Return the seconds of both programs and their ratio."""
    seconds, theirs = median_seconds(ours, 5), median_seconds(peer, 5)
    return {"ratio": theirs / seconds, "seconds_ours": seconds, "seconds_peer": theirs, **about}


def random_scene(poses: int, *, buildings: int = 12, towers: int = 1, seed: int = 1) -> tuple[Site, Link, Poses]:
    """Return a random scene: rotated boxes of 4 to 12 m height in a field of 600 m, and a flight at 20 to 60 m.

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
    boxes: list[Building] = []
    while len(boxes) < buildings:
        east, north = rng.uniform(-300, 300, 2)
        half = rng.uniform((5, 5), (20, 12))
        shape = box(east - half[0], north - half[1], east + half[0], north + half[1])
        shape = affinity.rotate(shape, rng.uniform(0, 180))
        near_tower = min(shape.distance(Point(p)) for p in places) < 10
        if near_tower or any(shape.distance(b.footprint) < 3 for b in boxes):
            continue
        boxes.append(Building(f"building {len(boxes) + 1}", shape, float(rng.uniform(4, 12))))
    named = {f"LW{i + 1}": Tower(f"LW{i + 1}", 35.7, -78.7, float(p[0]), float(p[1])) for i, p in enumerate(places)}
    site = Site("random boxes", SiteFrame(35.7275, -78.696), named, tuple(boxes))
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

"""Path search beside PathSolver, ingest beside pandas, ranks beside NumPy's SVD: how many times faster each is.

Both sides run in one process; 1 000 places of the bench scene (61 faces, depth 2) and a power log. Kriging beside
PyKrige is benchmarks/kriging.py.

    python benchmarks/peers.py [--quick]
"""

from __future__ import annotations

import argparse
import io
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from aerpaw_cmp.compare.rank import channel_rank
from aerpaw_cmp.jobs.bench import BATCH, DEPTH, random_scene
from aerpaw_cmp.propagation.arrays import Poses
from aerpaw_cmp.propagation.check.audit import compare
from aerpaw_cmp.propagation.options import Run, Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.scene import Scene


def path_search(poses: int = 1000, samples: int = 1_000_000, *, repeats: int = 5) -> dict[str, Any]:
    """Path search of the image engine against Sionna's PathSolver, both warm, in this one run.

    Parameters
    ----------
    poses : int
        Of :func:`random_scene`.
    samples : int
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
    from aerpaw_cmp.propagation.search import mirror, sionna

    site, link, some = random_scene(poses)
    scene = Scene.of(site, link, some)
    rays, alone = Search("sionna", samples=samples, batch=BATCH), Run(cache_dir="")

    def search() -> float:
        started = time.perf_counter()
        mirror.find_paths(scene.faces, scene.links_to(some), max_depth=DEPTH)
        return time.perf_counter() - started

    search()
    times = [search() for _ in range(repeats)]
    replay(site, link, Poses(some.position_m[:BATCH], some.rotation[:BATCH]), rays, run=alone)  # compiles the kernels
    theirs = replay(site, link, some, rays, run=alone)
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
        "batch": BATCH,
        "faces": len(scene.faces),
        "depth": DEPTH,
        "versions": sionna.engine_versions(),
    }


def median_seconds(action: Callable[[], Any], repeats: int = 5) -> float:
    """Median processor time after a warm-up (none for a single run): other work on the machine does not count."""
    if repeats > 1:
        action()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return statistics.median(times)


def path_search_ratios(
    poses: int = 1000, samples: tuple[int, ...] = (1_000, 10_000, 100_000, 1_000_000)
) -> dict[str, Any]:
    """Path search of the image engine against PathSolver with ``samples`` (increasing), and at equal error.

    Returns
    -------
    dict
        ``at`` maps samples to the numbers of :func:`path_search`; ``equal_error``
        is the entry of the fewest samples with which PathSolver finds as many of the paths as with the most: more
        samples than that buy it nothing, so a ratio to more of them flatters us.
    """
    most = path_search(poses, samples[-1])
    at = {samples[-1]: most}
    for count in samples[:-1]:
        at[count] = path_search(poses, count, repeats=3)
        if at[count]["extra_paths"] <= most["extra_paths"]:
            break
    enough = min(n for n, measured in at.items() if measured["extra_paths"] <= most["extra_paths"])
    return {"at": {f"{n:.0e}": measured for n, measured in sorted(at.items())}, "equal_error": at[enough]}


def ingest_vs_pandas(lines: int, repeats: int = 1) -> dict[str, Any]:
    """Reading a synthetic power log, against ``pandas.read_csv(engine="c")`` on the same bytes.

    Ours gives UTC times, levels, flags and the account of every line; pandas columns of text and numbers.
    """
    import pandas as pd

    from aerpaw_cmp.logs.readers import ReadOptions, by_name
    from aerpaw_cmp.logs.writers import format_power_log

    zone = "America/New_York"
    generator = np.random.default_rng(1)
    times = np.datetime64("2025-03-02T15:00:00", "ns") + np.arange(lines) * np.timedelta64(32_760_000, "ns")
    data = format_power_log(times, generator.normal(-40, 12, lines), zone)
    reader, options = by_name("sounder_log"), ReadOptions(timezone=zone)
    ours = median_seconds(lambda: reader.read(data, options), repeats)
    theirs = median_seconds(lambda: pd.read_csv(io.BytesIO(data), engine="c", header=None, sep=r"\s+"), repeats)
    return {"ratio": theirs / ours, "seconds_ours": ours, "seconds_pandas": theirs, "lines": lines}


def ranks_vs_svd(links: int, k: float = 10.0) -> dict[str, Any]:
    """Ranks of 4 x 4 channels, against the singular values of ``numpy.linalg.svd``."""
    parts = np.random.default_rng(3).normal(size=(2, links, 4, 4))
    h = parts[0] + 1j * parts[1]

    def plain() -> Any:
        s = np.linalg.svd(h, compute_uv=False)
        return (s * k > s[:, :1]).sum(axis=1)

    differ = int((plain() != channel_rank(h, k)).sum())
    ours, theirs = median_seconds(lambda: channel_rank(h, k), 5), median_seconds(plain, 3)
    return {"ratio": theirs / ours, "seconds_ours": ours, "links": links, "differ": differ}


def main() -> None:
    """Print ratios, and seconds where an issue asks for them, as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="100 places, few rays, lines and links")
    quick = parser.parse_args().quick
    search = path_search_ratios(100, (1_000, 10_000)) if quick else path_search_ratios(1_000, (1_000, 10_000, 100_000))
    ranks = ranks_vs_svd(1_000 if quick else 100_000)
    ratios = {
        "path search, image engine / PathSolver at equal error": search["equal_error"]["ratio"],
        "path search, image engine / PathSolver with 1e5 samples": search["at"].get("1e+05", {}).get("ratio"),
        "ingest / pandas (C engine), 1 000 000 lines": ingest_vs_pandas(10_000 if quick else 1_000_000)["ratio"],
        "ranks of 100 000 4 x 4 links / numpy.linalg.svd": ranks["ratio"],
    }
    print(json.dumps({"ratios": ratios, "ranks": ranks}))


if __name__ == "__main__":
    main()

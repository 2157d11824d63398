"""Compiled code against NumPy, in one process, in pairs: a whole replay on one thread, and on two.

1. CPU seconds of a replay in NumPy and compiled, one after the other, ``--pairs`` times; the same paths, H and ranks;
2. wall seconds of the compiled replay on one thread and on two (on an idle machine), and the CPU seconds outside the
   parts that threads share, with the ratio that they allow (on a loaded machine);
3. how far the field kernel is from what the processor can do: its operations, counted, against the most multiplications
   and additions of this machine without fused ones, which the kernel must not use (both measured in this run);
4. with ``--cold``: seconds of a first replay in a new process, NumPy and compiled, for growing sizes: where they cross.

Run: python benchmarks/kernel.py [--poses 10000] [--pairs 3] [--cold] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from typing import Any

import numpy as np

from aerpaw_cmp.compare.rank import channel_rank
from aerpaw_cmp.jobs.bench import random_scene
from aerpaw_cmp.propagation import compiled
from aerpaw_cmp.propagation.field.sum import channel_matrices
from aerpaw_cmp.propagation.options import Run
from aerpaw_cmp.propagation.replay import Replay, replay
from aerpaw_cmp.propagation.scene import Scene

TOWERS = 5
FLOPS = {"pair": 213, "reflection": 115, "slab": 105}
"""Additions, multiplications, divisions and roots of the field: per element pair of a path (isotropic), per
reflection of a pair, and more where the face is a slab; a sine with its cosine counts 36, an exponential 20."""


def timed(mode: str, case, threads: int | None = 1) -> tuple[Replay, float, float]:
    """A replay with its CPU and wall seconds."""
    os.environ[compiled.SWITCH] = mode
    cpu, wall = time.process_time(), time.perf_counter()
    found = replay(*case, run=Run(threads=threads))
    return found, time.process_time() - cpu, time.perf_counter() - wall


def serial(case) -> tuple[float, float]:
    """CPU seconds of a compiled replay, and those outside the parts that threads share."""
    modules: tuple[Any, ...] = (compiled,)
    real, shared = compiled.in_threads, 0.0

    def watched(*arguments):
        nonlocal shared
        start = time.process_time()
        found = real(*arguments)
        shared += time.process_time() - start
        return found

    for module in modules:
        module.in_threads = watched
    try:
        cpu = timed("always", case)[1]
    finally:
        for module in modules:
            module.in_threads = real
    return cpu, cpu - shared


def pairs(poses: int, count: int) -> dict[str, object]:
    case = random_scene(poses, towers=TOWERS)
    timed("always", case)
    alone = [serial(case) for _ in range(count)]
    total, outside = (float(x) for x in np.median(alone, axis=0))
    rows = []
    for _ in range(count):
        numpy, slow, _ = timed("never", case)
        ours, fast, one = timed("always", case)
        two = timed("always", case, 2)[2]
        rows.append((slow, fast, one, two))
    ranks = {k: int((channel_rank(numpy.h, k) != channel_rank(ours.h, k)).sum()) for k in (10, 100, 1000)}
    slow, fast, one, two = np.median(rows, axis=0)
    return {
        "poses": poses,
        "towers": TOWERS,
        "paths": len(ours.paths),
        "numpy_cpu_s": slow,
        "compiled_cpu_s": fast,
        "ratio": float(np.median([a / b for a, b, _, _ in rows])),
        "two_threads_wall_ratio": float(np.median([a / b for _, _, a, b in rows])),
        "two_threads_wall_ratio_best_pair": float(max(a / b for _, _, a, b in rows)),
        "serial_cpu_s": outside,
        "serial_share": outside / total,
        "two_threads_ratio_allowed": 2.0 / (1.0 + outside / total),
        "same_paths": bool(np.array_equal(numpy.paths.faces, ours.paths.faces)),
        "h_worst_relative": float(np.abs(numpy.h - ours.h).max() / np.abs(numpy.h).max()),
        "ranks_that_differ": ranks,
    }


def arithmetic(poses: int) -> dict[str, float]:
    """Operations of the field kernel per second, against those of a loop that does nothing else."""
    from numba import njit

    @njit(error_model="numpy", nogil=True)
    def loop(x, a, b, rounds):
        for _ in range(rounds):
            for i in range(len(x)):
                y = x[i]
                y = y * a + b
                y = y * a + b
                y = y * a + b
                y = y * a + b
                y = y * a + b
                y = y * a + b
                y = y * a + b
                y = y * a + b
                x[i] = y

    x = np.ones(128)
    loop(x, 0.5, 0.5, 1)
    rounds = 200_000

    def wall(threads: int) -> float:
        start = time.perf_counter()
        compiled.in_threads(lambda own: loop(own, 0.5, 0.5, rounds), [x.copy(), x.copy()], threads)
        return time.perf_counter() - start

    scaling = max(wall(1) / wall(2) for _ in range(5))
    peaks = []
    site, link, some = random_scene(poses, towers=TOWERS)
    os.environ[compiled.SWITCH] = "always"
    found = replay(site, link, some)
    scene = Scene.of(site, link, some)
    seconds = []
    for _ in range(3):
        start = time.process_time()
        loop(x, 0.5, 0.5, rounds)
        peaks.append(rounds * len(x) * 16 / (time.process_time() - start))
        start = time.process_time()
        channel_matrices(found.paths, scene.faces, scene.sources_m, some, link, threads=1)
        seconds.append(time.process_time() - start)
    each = 16
    reflections = int(found.paths.depth.sum())
    slabs = int((scene.faces.solid[found.paths.faces] >= 0)[found.paths.faces >= 0].sum())
    flops = each * (FLOPS["pair"] * len(found.paths) + FLOPS["reflection"] * reflections + FLOPS["slab"] * slabs)
    return {
        "field_cpu_s": min(seconds),
        "nanoseconds_per_pair_and_path": 1e9 * min(seconds) / (each * len(found.paths)),
        "flops": float(flops),
        "gflop_per_s": flops / min(seconds) / 1e9,
        "most_gflop_per_s": max(peaks) / 1e9,
        "most_two_threads_wall_ratio": scaling,
        "share_of_most": flops / min(seconds) / max(peaks),
    }


def cold(sizes: tuple[int, ...] = (1000, 3000, 5000, 10_000)) -> list[dict[str, float]]:
    """CPU seconds of a new process for one replay, its start included."""
    rows = []
    for size in sizes:
        row: dict[str, float] = {"poses": size, "pairs_of_links": size * TOWERS * 16}
        for mode in ("never", "always"):
            line = (
                "import time\nfrom aerpaw_cmp.jobs.bench import random_scene\n"
                "from aerpaw_cmp.propagation.options import Run\nfrom aerpaw_cmp.propagation.replay import replay\n"
                f"case = random_scene({size}, towers={TOWERS})\nreplay(*case, run=Run(threads=1))\n"
                "print(time.process_time())"
            )
            environment = os.environ | {compiled.SWITCH: mode}
            said = subprocess.run([sys.executable, "-c", line], env=environment, capture_output=True, check=True)
            row[f"{mode}_cpu_s"] = float(said.stdout)
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=10_000)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--cold", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    result: dict[str, object] = {
        "machine": platform.processor() or platform.machine(),
        "cores": compiled.thread_count(None),
        "load": os.getloadavg()[0],
        "replay": pairs(options.poses, options.pairs),
        "arithmetic": arithmetic(options.poses),
    }
    if options.cold:
        result["cold"] = cold()
    if options.json:
        print(json.dumps(result))
        return
    for name, value in result.items():
        for row in value if isinstance(value, list) else [value]:
            print(f"{name}: {row}")


if __name__ == "__main__":
    main()

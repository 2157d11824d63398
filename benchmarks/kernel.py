"""Compiled code against NumPy, in one process, in pairs: a whole replay on one thread, and on two.

1. CPU seconds of a replay in NumPy and compiled, one after the other, ``--pairs`` times; the same paths, H and ranks;
2. wall seconds of the compiled replay on one thread and on two (on an idle machine), and the CPU seconds outside the
   parts that threads share, with the ratio that they allow (on a loaded machine);
3. how far the field kernel is from what the processor can do: its operations, counted, against the most multiplications
   and additions of this machine without fused ones, which the kernel must not use (both measured in this run);
4. seconds and peak memory of a flight of ``--long`` poses, replayed in parts that are made as they are asked for
   (a process of its own per length), compiled and, for the shortest, in NumPy; and what a process with compiled code
   holds before it has any pose, step by step;
5. the field on a CUDA device, where there is one;
6. with ``--cold``: seconds of a first replay in a new process, NumPy and compiled, for growing sizes: where they cross.

Run: python benchmarks/kernel.py [--poses 10000] [--pairs 3] [--long 100000 1000000] [--cold] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from aerpaw_cmp.compare.rank import channel_rank
from aerpaw_cmp.propagation import compiled, compiled_field, compiled_search
from aerpaw_cmp.propagation.arrays import Poses
from aerpaw_cmp.propagation.bench import random_scene
from aerpaw_cmp.propagation.channel import channel_matrices
from aerpaw_cmp.propagation.scene import Scene
from aerpaw_cmp.propagation.tracer import POSES_PER_PART, Replay, replay, replay_parts

TOWERS = 5
FLOPS = {"pair": 213, "reflection": 115, "slab": 105}
"""Additions, multiplications, divisions and roots of `propagation/kernels.py`: per element pair of a path (isotropic),
per reflection of a pair, and more where the face is a slab; a sine with its cosine counts 36, an exponential 20."""


def timed(mode: str, case, threads: int | None = 1) -> tuple[Replay, float, float]:
    """A replay with its CPU and wall seconds."""
    os.environ[compiled.SWITCH] = mode
    cpu, wall = time.process_time(), time.perf_counter()
    found = replay(*case, threads=threads)
    return found, time.process_time() - cpu, time.perf_counter() - wall


def serial(case) -> tuple[float, float]:
    """CPU seconds of a compiled replay, and those outside the parts that threads share."""
    modules: tuple[Any, ...] = (compiled, compiled_field, compiled_search)
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


def on_gpu(poses: int) -> dict[str, object]:
    """Wall seconds of the field on a CUDA device, against the CPU's on all its threads; or why there is none."""
    from aerpaw_cmp.propagation import cuda_field

    if reason := cuda_field.available():
        return {"run": False, "reason": reason}
    site, link, some = random_scene(poses, towers=TOWERS)
    os.environ[compiled.SWITCH] = "always"
    found, scene = replay(site, link, some), Scene.of(site, link, some)
    row: dict[str, object] = {"run": True}
    for device in ("cpu", "cuda", "cuda"):  # the first run on the device compiles
        start = time.perf_counter()
        h = channel_matrices(found.paths, scene.faces, scene.sources_m, some, link, device=device).h
        row[f"{device}_wall_s"] = time.perf_counter() - start
        row[f"{device}_h_worst_relative"] = float(np.abs(h - found.h).max() / np.abs(found.h).max())
    return row


def peak_mib() -> float:
    """Largest resident memory of this process; what its parent had does not count, as it does for getrusage."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def long_flight(poses: int) -> dict[str, float]:
    """A flight in parts; RSS and ranks are kept, everything else is let go."""
    site, link, _ = random_scene(2, towers=TOWERS)
    step = POSES_PER_PART

    def parts():
        for start in range(0, poses, step):
            along = 2.0 * np.pi * np.arange(start, min(start + step, poses)) / poses
            place = np.column_stack(
                [290 * np.sin(3 * along + 0.4), 290 * np.sin(2 * along), 40.0 + 20.0 * np.sin(5 * along + 1.0)]
            )
            yield Poses(place, np.broadcast_to(np.eye(3), (len(along), 3, 3)))

    before = peak_mib()
    if compiled.switch() != "never":
        compiled.load("kernels"), compiled.load("search_kernels")
    loaded = peak_mib()
    rss, cpu = 0, time.process_time()
    for part in replay_parts(site, link, parts(), extent_m=np.array([[-290.0, -290, 20], [290, 290, 60]]), threads=1):
        rss += int(np.isfinite(part.rss_dbm).sum())
    return {
        "poses": poses,
        "links": poses * TOWERS,
        "links_with_a_path": rss,
        "cpu_s": time.process_time() - cpu,
        "peak_mib": peak_mib(),
        "before_mib": before,
        "with_kernels_mib": loaded,
        "compiled": float(compiled.switch() != "never" and compiled.load("kernels").kernels is not None),
    }


MEMORY = """
import json, sys
from pathlib import Path
rows = {}
def row(name):
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    rows[name] = {key: int(status[key].split()[0]) / 1024 for key in ("VmRSS", "RssAnon", "RssFile")}
import numpy; row("NumPy")
from aerpaw_cmp.propagation import bench, compiled, tracer; row("aerpaw_cmp.propagation")
case = bench.random_scene(2); row("a site (pyproj)")
import llvmlite.binding; row("llvmlite")
import numba; row("numba")
from numba.core.registry import cpu_target
cpu_target.target_context.refresh(); cpu_target.typing_context.refresh(); row("its functions, scipy.linalg too")
compiled.load("kernels"), compiled.load("search_kernels"); row("our kernels, read from their cache")
print(json.dumps(rows))
"""
"""Resident memory [MiB] of a process, step by step: of files (shared with other processes) and its own."""


def memory() -> dict[str, dict[str, float]]:
    """What is held before the first pose."""
    said = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, check=True, text=True)
    return dict(json.loads(said.stdout))


def cold(sizes: tuple[int, ...] = (1000, 3000, 5000, 10_000)) -> list[dict[str, float]]:
    """CPU seconds of a new process for one replay, its start included."""
    rows = []
    for size in sizes:
        row: dict[str, float] = {"poses": size, "pairs_of_links": size * TOWERS * 16}
        for mode in ("never", "always"):
            line = (
                "import time\nfrom aerpaw_cmp.propagation.bench import random_scene\n"
                "from aerpaw_cmp.propagation.tracer import replay\n"
                f"case = random_scene({size}, towers={TOWERS})\nreplay(*case, threads=1)\nprint(time.process_time())"
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
    parser.add_argument("--long", type=int, nargs="*", default=[100_000, 1_000_000])
    parser.add_argument("--cold", action="store_true")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--only-long", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only_long:
        print(json.dumps(long_flight(options.only_long)))
        return
    result: dict[str, object] = {
        "machine": platform.processor() or platform.machine(),
        "cores": compiled.thread_count(None),
        "load": os.getloadavg()[0],
        "replay": pairs(options.poses, options.pairs),
        "arithmetic": arithmetic(options.poses),
        "gpu": on_gpu(options.poses),
    }
    command = [sys.executable, __file__, "--only-long"]
    modes = [(n, "auto") for n in options.long] + [(n, "never") for n in sorted(options.long)[:1]]
    if modes:
        result["memory"] = [{"after": step, **row} for step, row in memory().items()]
    result["long"] = [
        json.loads(
            subprocess.run(
                [*command, str(n)],
                check=True,
                capture_output=True,
                text=True,
                env=os.environ | {compiled.SWITCH: mode},
            ).stdout
        )
        for n, mode in modes
    ]
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

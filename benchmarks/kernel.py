"""Compiled code against NumPy, in one process, in pairs: a whole replay on one thread, and on two.

1. CPU seconds of a replay in NumPy and compiled, one after the other, ``--pairs`` times; the same paths, H and ranks;
2. wall seconds of the compiled replay on one thread and on two (on an idle machine);
3. with ``--cold``: seconds of a first replay in a new process, NumPy and compiled, for growing sizes: where they cross.

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

import numpy as np

from aerpaw_cmp.compare.rank import channel_rank
from aerpaw_cmp.jobs.bench import random_scene
from aerpaw_cmp.propagation import compiled
from aerpaw_cmp.propagation.options import Run
from aerpaw_cmp.propagation.replay import Replay, replay

TOWERS = 5


def timed(mode: str, case, threads: int | None = 1) -> tuple[Replay, float, float]:
    """A replay with its CPU and wall seconds."""
    os.environ[compiled.SWITCH] = mode
    cpu, wall = time.process_time(), time.perf_counter()
    found = replay(*case, run=Run(threads=threads))
    return found, time.process_time() - cpu, time.perf_counter() - wall


def pairs(poses: int, count: int) -> dict[str, object]:
    case = random_scene(poses, towers=TOWERS)
    timed("always", case)
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
        "same_paths": bool(np.array_equal(numpy.paths.faces, ours.paths.faces)),
        "h_worst_relative": float(np.abs(numpy.h - ours.h).max() / np.abs(numpy.h).max()),
        "ranks_that_differ": ranks,
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

"""Compare times with peers: path search with PathSolver, ingest with pandas, ranks with NumPy's SVD.

Both programs run in one process, on 1 000 positions of the bench scene (61 faces, depth 2) and on a power log. Kriging
is compared with PyKrige in benchmarks/kriging.py.

    python benchmarks/peers.py [--quick]
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from aerpaw_cmp.compare.rank import channel_rank
from aerpaw_cmp.jobs.bench import median_seconds, path_search_ratios, random_scene, speed_against_error

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.ingest import contest, write_sounder


def utc_vs_pandas(lines: int) -> float:
    """Reading a power log, against ``pandas.read_csv(engine="c")`` and its times in UTC, by processor time."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "power.txt"
        write_sounder(place, lines)
        ours, theirs = (contest(who, "sounder_log", place)["cpu_s"] for who in ("ours", "pandas"))
    return theirs / ours


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
    samples = (1_000, 10_000) if quick else (1_000, 10_000, 100_000)
    rows = speed_against_error(*random_scene(100 if quick else 1_000), samples=samples, depths=(2,))
    search = path_search_ratios(rows)
    ranks = ranks_vs_svd(1_000 if quick else 100_000)
    ratios = {
        "path search, image engine / PathSolver at equal error": search["equal_error"]["ratio"],
        "path search, image engine / PathSolver with 1e5 samples": search.get("1e5", {}).get("ratio"),
        "ingest / pandas (C engine, times in UTC), 1 000 000 lines": utc_vs_pandas(10_000 if quick else 1_000_000),
        "ranks of 100 000 4 x 4 links / numpy.linalg.svd": ranks["ratio"],
    }
    print(json.dumps({"ratios": ratios, "ranks": ranks}))


if __name__ == "__main__":
    main()

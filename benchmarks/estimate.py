"""How well ``--dry-run`` foretells the CPU seconds of a report.

    python benchmarks/estimate.py [FLIGHT ...] [--logs-root DIR] [--audit none]

Each flight is planned and then run, in one process; every stage is a line. Without FLIGHT the sample flight, on which
the constants of ``aerpaw_cmp/jobs/plan.py`` were measured, so that only other flights judge them.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

from aerpaw_cmp.jobs import run
from aerpaw_cmp.jobs.options import RunOptions
from aerpaw_cmp.jobs.plan import PROBE_S, probe

SAMPLE = Path(__file__).parents[1] / "sample_logs" / "flight.yaml"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("flights", nargs="*", type=Path, default=[SAMPLE])
    parser.add_argument("--logs-root", type=Path)
    parser.add_argument("--audit", default="none")
    options = parser.parse_args()
    time.perf_counter = time.process_time  # in every module: other work on the machine does not count
    found, known = 1e3 * probe(), 1e3 * PROBE_S
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, probe {found:.1f} ms (in the plan {known:.1f})")
    for flight in options.flights:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "report"
            given = run.ReportOptions(audit=options.audit), RunOptions(out=out, logs_root=options.logs_root)
            start = time.process_time()
            plan = run.plan_report(flight, *given)
            planning = time.process_time() - start
            os.environ["AERPAW_CMP_CACHE"] = str(Path(folder) / "cache")
            start = time.process_time()
            metrics = run.run_report(flight, *given).metrics
            took = time.process_time() - start
        guess: dict[str, float] = {}
        for stage in plan.stages:
            guess[stage.name.split()[0]] = guess.get(stage.name.split()[0], 0.0) + (stage.seconds or 0.0)
        planned = plan.seconds - guess["imports"]
        print(f"\n{flight}: planned {planned:.1f} s without imports, took {took:.1f}; planning {planning:.1f} s")
        for name, seconds in metrics["stages"].items():
            if isinstance(seconds, float):
                stage = name.removesuffix("_s")
                print(f"  {stage:10} planned {guess.get(stage, 0.0):6.2f}   took {seconds:6.2f}")


if __name__ == "__main__":
    main()

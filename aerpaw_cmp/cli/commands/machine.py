"""``bench``, ``doctor``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from ...common.text import counted
from ..app import command
from ..shown import answered, records, say, show


@command(
    "bench",
    examples=[
        "aerpaw-cmp bench --quick",
        "aerpaw-cmp bench --poses 500 --json",
        "aerpaw-cmp bench --quick --report reports/flight",
    ],
)
def bench(
    poses: Annotated[int, Option(min=2, help="Poses of the flight that is replayed.")] = 200,
    quick: Annotated[bool, Option("--quick", help="Few poses, at most 1e4 samples, no peers.")] = False,
    report: Annotated[Path | None, Option(help="Folder of a report: what accuracy costs on its flight, too.")] = None,
) -> None:
    """Speed against error on this machine."""
    from ...jobs import bench as job

    if quick:
        result = job.run_bench(poses=min(poses, 40), samples=(1_000, 10_000), ratios=False, report=report, progress=say)
    else:
        result = job.run_bench(poses=poses, report=report, progress=say)
    if answered(result):
        return
    rows = [
        {**row, "ranks": ", ".join(f"{k}: {share:.3f}" for k, share in row["rank_disagreement"].items())}
        for row in result["replay"]["rows"]
    ]
    columns = {
        "engine": "engine", "samples": "samples:.0e", "depth": "depth", "s": "seconds:.3g",
        "links/s": "links_per_s:.3g", "peak MiB": "peak_mib:.0f", "missing": "missing_paths", "extra": "extra_paths",
        "RSS error dB max": "rss_max_error_db:.2g", "rms": "rss_rms_error_db:.2g", "rank disagreement per K": "ranks",
    }  # fmt: skip
    records(rows, columns, f"Speed against error ({_conditions(result['conditions'])})")
    costs = [{**row, "note": "fastest sufficient" * row["fastest_sufficient"]} for row in result.get("models", ())]
    if costs:
        columns = {"model": "model", "s": "seconds:.3g", "RMSE dB": "rmse_heldout_db:.1f", "": "note"}
        records(costs, columns, "What accuracy costs on the flight of the report")
    for name, ratio in result["ratios"].items():
        show(f"{name}: {ratio:.3g} times")


def _conditions(at: Mapping[str, Any]) -> str:
    """Conditions of a benchmark in words."""
    towers = ", ".join(at["towers"])
    buildings = counted(at["buildings"], "building")
    return f"{counted(at['poses'], 'position')}, towers {towers}, {buildings}, {at['cpus']} CPUs"


@command(
    "doctor",
    examples=[
        "aerpaw-cmp doctor",
        "aerpaw-cmp doctor --json",
    ],
)
def doctor() -> int:
    """Check this machine."""
    from ...machine import doctor as doctor_room

    checks = doctor_room.checks()
    if not answered(doctor_room.as_dict(checks)):
        records(checks, {"check": "name", "status": "status", "found": "found", "remedy": "remedy"})
    return 1 if any(c.status == "fail" for c in checks) else 0

"""``bench``, ``doctor``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from .app import Json, command
from .shown import number, print_json, say, table


@command(
    "bench",
    examples=[
        "aerpaw-cmp bench --quick",
        "aerpaw-cmp bench --poses 500 --json",
    ],
)
def bench(
    poses: Annotated[int, typer.Option(min=2, help="Poses of the flight that is replayed.")] = 200,
    quick: Annotated[bool, typer.Option("--quick", help="Few poses, at most 1e4 samples, no peers.")] = False,
    as_json: Json = False,
) -> None:
    """Speed against error on this machine."""
    from ..jobs import bench as job

    if quick:
        result = job.run_bench(poses=min(poses, 40), samples=(1_000, 10_000), ratios=False, progress=say)
    else:
        result = job.run_bench(poses=poses, progress=say)
    if as_json:
        print_json(result)
        return
    rows = []
    for r in result["replay"]["rows"]:
        rows.append(
            [
                r["engine"],
                "-" if r["samples"] is None else f"{r['samples']:.0e}",
                r["arrays"],
                str(r["depth"]),
                f"{r['seconds']:.3g}",
                f"{r['links_per_s']:.3g}",
                f"{r['peak_mib']:.0f}",
                "-" if r["missing_paths"] is None else f"{r['missing_paths']} / {r['extra_paths']}",
                f"{number(r['rss_max_error_db'], '{:.2g}')} / {number(r['rss_rms_error_db'], '{:.2g}')}",
                ", ".join(f"{k}: {share:.3f}" for k, share in r["rank_disagreement"].items()),
            ]
        )
    header = [
        "engine",
        "samples",
        "arrays",
        "depth",
        "s",
        "links/s",
        "peak MiB",
        "missing / extra",
        "RSS error dB max / rms",
    ]
    table([*header, "rank disagreement per K"], rows, f"Speed against error ({_conditions(result['conditions'])})")
    for name, ratio in result["ratios"].items():
        print(f"{name}: {ratio:.3g} times")


def _conditions(made: Mapping[str, Any]) -> str:
    """Conditions of a benchmark in words."""
    towers = ", ".join(made["towers"])
    return f"{made['poses']} positions, towers {towers}, {made['buildings']} buildings, {made['cpus']} CPUs"


@command(
    "doctor",
    examples=[
        "aerpaw-cmp doctor",
        "aerpaw-cmp doctor --json",
    ],
)
def doctor(as_json: Json = False) -> int:
    """Check this machine."""
    from ..machine import doctor as doctor_room

    checks = doctor_room.checks()
    if as_json:
        print_json(doctor_room.as_dict(checks))
    else:
        table(["check", "status", "found", "remedy"], [[c.name, c.status, c.found, c.remedy or "-"] for c in checks])
    return 1 if any(c.status == "fail" for c in checks) else 0

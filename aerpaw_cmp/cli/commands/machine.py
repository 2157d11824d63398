"""``bench``, ``doctor``."""

from __future__ import annotations

from typing import Annotated, Any

from typer import Option

from ...common.text import counted
from ..app import command
from ..shown import answered, records, say, show


@command("bench", examples=["aerpaw-cmp bench --quick", "aerpaw-cmp bench --poses 500 --json"])
def bench(
    poses: Annotated[int, Option(min=2, help="Number of poses in the replayed flight.")] = 200,
    quick: Annotated[
        bool, Option("--quick", help="Use few poses, at most 1e4 samples, and no comparison with other programs.")
    ] = False,
) -> None:
    """Measure speed and error of the replay on this machine."""
    from ...jobs import bench as job

    few: dict[str, Any] = {"poses": min(poses, 40), "samples": (1_000, 10_000), "ratios": False}
    result = job.run_bench(progress=say, **(few if quick else {"poses": poses}))
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
    at = result["conditions"]
    about = (
        f"{counted(at['poses'], 'position')}, towers {', '.join(at['towers'])}, {counted(at['buildings'], 'building')}"
    )
    records(rows, columns, f"Speed against error ({about}, {at['cpus']} CPUs)")
    for name, ratio in result["ratios"].items():
        show(f"{name}: {ratio:.3g} times")


@command("doctor", examples=["aerpaw-cmp doctor", "aerpaw-cmp doctor --json"])
def doctor() -> int:
    """Check this machine."""
    from ...machine.doctor import as_dict, checks, ready

    found = checks()
    if not answered(as_dict(found)):
        records(found, {"check": "name", "status": "status", "found": "found", "remedy": "remedy"})
    return 0 if ready(found) else 1

"""``campaign``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from ...common.counting import counted
from ...common.stages import duration
from ...jobs.options import RunOptions
from ..app import Export, Force, Json, LogsRoot, Scheduler, Workers, command, output
from ..shown import number, print_json, records, say, show, table


@command(
    "campaign",
    examples=[
        "aerpaw-cmp campaign campaign.yaml --workers 4",
        "aerpaw-cmp campaign campaign.yaml -o reports/spring --keep outcomes --strict",
        "aerpaw-cmp campaign campaign.yaml --scheduler tls://scheduler:8786 --keep /shared/outcomes",
        "aerpaw-cmp campaign campaign.yaml --dry-run",
    ],
)
def campaign(
    campaign_yaml: Annotated[Path, Argument(metavar="CAMPAIGN", help="campaign.yaml")],
    out: Annotated[Path | None, output("Output folder  [default: reports/<campaign>]")] = None,
    logs_root: LogsRoot = None,
    workers: Workers = 1,
    scheduler: Scheduler = None,
    keep: Annotated[
        Path | None, Option(help="Folder for task outcomes; a rerun computes missing outcomes only.")
    ] = None,
    fresh: Annotated[bool, Option("--fresh", help="Ignore stored outcomes and store none.")] = False,
    dry_run: Annotated[
        bool, Option("--dry-run", help="List finished tasks, open tasks and the time estimate; compute nothing.")
    ] = False,
    strict: Annotated[bool, Option("--strict", help="Exit code 1 when a flight or a stated check failed.")] = False,
    export: Export = None,
    force: Force = False,
    as_json: Json = False,
) -> int:
    """Many flights and settings, with what can be said only of several flights."""
    from ...jobs import run

    options = RunOptions(out=out, logs_root=logs_root, force=force, workers=workers, scheduler=scheduler, progress=say)
    if dry_run:
        status = run.campaign_status(campaign_yaml, options, keep=keep, fresh=fresh)
        print_json(status.metrics()) if as_json else _print_status(status)
        return 0
    outcome = run.run_campaign(campaign_yaml, options, keep=keep, fresh=fresh, export=export or ())
    if as_json:
        print_json(outcome.metrics)
    else:
        _print_campaign_summary(outcome)
    for check in outcome.failed_checks:
        say.warn(f"failed: {check}")
    if not (outcome.metrics["rss"] or outcome.metrics["rank"]):
        return 3
    return 1 if strict and outcome.failed_checks else 0


# Tasks of a list on the terminal; --json has them all.
_SHOWN = 20


def _print_status(status: Any) -> None:
    time = "no time was measured yet" if status.estimate_s is None else f"about {duration(status.estimate_s)}"
    if not status.to_do:
        time = "nothing to compute"
    show(
        f"{status.name}: {counted(len(status.states), 'task')}, {status.kept} kept in {status.keep}, "
        f"{status.failed} failed the last time, {status.to_do} to do, {time} with {counted(status.workers, 'worker')}"
    )
    rows = [[s.task.flight, s.task.setting, (s.failure or s.trouble)[:100]] for s in status.states if not s.stored]
    if rows:
        title = "To do" if len(rows) <= _SHOWN else f"To do: the first {_SHOWN} of {len(rows)}"
        table(["flight", "setting", "last failure"], rows[:_SHOWN], title)
    for failure in status.failures:
        show(f"{failure.flight}: {failure.message}")


def _print_campaign_summary(outcome: Any) -> None:
    m = outcome.metrics
    names = list(next(iter(m["mean_rmse_db"].values()), {}))
    rows = [[s, *[number(by[f], "{:.2f}") for f in names]] for s, by in m["mean_rmse_db"].items()]
    if names:
        table(["setting", *names], rows, "Mean RMSE over towers and channels (dB), own offsets")
    heads = {"setting": "setting", "flight": "flight", "tower": "tower", "K": "k:g"}
    numbers = {"total variation": "total_variation:.3f", "agreement": "agreement:.2f", "kappa": "kappa:.2f"}
    records(m["rank"], heads | numbers, "Rank")
    show(f"report: {outcome.folder / 'campaign.html'}")

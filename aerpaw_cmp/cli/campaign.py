"""``campaign``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from .app import Export, Force, Json, LogsRoot, Out, command
from .shown import number, print_json, say, table


@command(
    "campaign",
    examples=[
        "aerpaw-cmp campaign campaign.yaml --workers 4",
        "aerpaw-cmp campaign campaign.yaml -o reports/spring --keep outcomes --strict",
        "aerpaw-cmp campaign campaign.yaml --cluster tcp://scheduler:8786 --json",
    ],
)
def campaign(
    campaign_yaml: Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="campaign.yaml")],
    out: Out = None,
    logs_root: LogsRoot = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes that share the flights and settings.")] = 1,
    cluster: Annotated[Optional[str], typer.Option(help="Address of a Dask scheduler, in place of processes.")] = None,  # noqa: UP045
    keep: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder of the outcomes of single tasks; a rerun computes only what is missing there."),
    ] = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Keep no outcomes and take none.")] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Exit code 1 when a flight or a stated check failed.")
    ] = False,
    export: Export = None,
    force: Force = False,
    as_json: Json = False,
) -> int:
    """Many flights and settings, with what can be said only of several flights."""
    from ..jobs import run

    outcome = run.run_campaign(
        campaign_yaml,
        out=out,
        logs_root=logs_root,
        workers=workers,
        cluster=cluster,
        keep=None if fresh else keep or run.outcomes_folder(),
        force=force,
        export=export or (),
        progress=say,
    )
    if as_json:
        print_json(outcome.metrics)
    else:
        _print_campaign_summary(outcome)
    for check in outcome.failed_checks:
        say.warn(f"failed: {check}")
    if outcome.nothing_done:
        return 3
    return 1 if strict and outcome.failed_checks else 0


def _print_campaign_summary(outcome: Any) -> None:
    m = outcome.metrics
    names = list(next(iter(m["mean_rmse_db"].values()), {}))
    rows = [[s, *[number(by[f], "{:.2f}") for f in names]] for s, by in m["mean_rmse_db"].items()]
    if names:
        table(["setting", *names], rows, "Mean RMSE over towers and channels (dB), own offsets")
    rows = [
        [
            r["setting"],
            r["flight"],
            r["tower"],
            f"{r['k']:g}",
            number(r["total_variation"], "{:.3f}"),
            number(r["agreement"], "{:.2f}"),
            number(r["kappa"], "{:.2f}"),
        ]
        for r in m["rank"]
    ]
    if rows:
        table(["setting", "flight", "tower", "K", "total variation", "agreement", "kappa"], rows, "Rank")
    rows = [
        [g["setting"], g["group"], number(g["offset_db"], "{:.1f}"), number(g["spread_db"], "{:.2f}"),
         number(g["own_rmse_db"], "{:.2f}"), number(g["pooled_rmse_db"], "{:.2f}")]
        for g in m["calibration"]["groups"]
    ]  # fmt: skip
    if rows and m["calibration"]["per"] != "link":
        header = ["setting", "group", "offset dB", "spread of own dB", "RMSE own dB", "RMSE shared dB"]
        table(header, rows, f"Offsets shared per {m['calibration']['per']}")
    rows = [
        [f"{p['tower']} {p['channel']}", f"{p['first']}, {p['second']}", str(p["n"]), number(p["rmse_db"], "{:.2f}"),
         number(p["place_correlation"], "{:.2f}")]
        for p in m["repeatability"]["pairs"]
    ]  # fmt: skip
    if rows:
        table(["link", "flights", "pairs", "differ by dB", "residual corr. by place"], rows, "Same places, two flights")
    rows = [
        [", ".join(fold["fitted_on"]), r["flight"], f"{r['tower']} {r['channel']}",
         "fitted here" if r["fitted_here"] else "transferred", number(r["start_rmse_db"], "{:.2f}"),
         number(r["rmse_db"], "{:.2f}"), number(r["transferred_rmse_db"], "{:.2f}")]
        for fold in m["held_out"]["folds"]
        for r in fold["scores"]
    ]  # fmt: skip
    if rows:
        header = [
            "fitted on",
            "flight",
            "link",
            "parameters",
            "as written dB",
            "with the fit dB",
            "offset transferred dB",
        ]
        table(header, rows, "Held-out fit, RMSE")
    for fold in m["held_out"]["folds"]:
        print(
            f"fitted on {', '.join(fold['fitted_on'])}: "
            + ", ".join(f"{k} = {v:g}" for k, v in fold["parameters"].items())
        )
    print(f"report: {outcome.folder / 'campaign.html'}")

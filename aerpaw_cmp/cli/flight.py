"""``report``, ``calibrate``, ``simulate``, ``sample``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..common.errors import one_line
from ..jobs.options import RunOptions
from .app import DryRun, Export, Force, Json, LogsRoot, command
from .shown import number, print_files, print_json, print_plan, say, table


@command(
    "report",
    examples=[
        "aerpaw-cmp report sample_logs/flight.yaml",
        "aerpaw-cmp report flight.yaml -o reports/mine --audit none",
        "aerpaw-cmp report flight.yaml --dry-run",
        "aerpaw-cmp report flight.yaml --figures all --style paper",
        "aerpaw-cmp report flight.yaml --export geojson,kmz",
        "aerpaw-cmp report flight.yaml --with calibrated.yaml",
        "aerpaw-cmp report flight.yaml --against prediction",
        "aerpaw-cmp report flight.yaml --strict --json --quiet",
    ],
)
def report(
    flight: Annotated[Path, typer.Argument(help="flight.yaml")],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="Output folder  [default: reports/<flight>]")
    ] = None,
    logs_root: LogsRoot = None,
    engine: Annotated[Literal["image", "sionna"] | None, typer.Option(help="Path search  [default: rt.engine]")] = None,
    audit: Annotated[
        str | None, typer.Option(help="Number of audited links, 'full' or 'none'  [default: rt.audit_links]")
    ] = None,
    recommend: Annotated[
        Path | None, typer.Option("--recommend", help="Write a flight.yaml with the recommended model.")
    ] = None,
    learned: Annotated[
        Path | None,
        typer.Option("--with", metavar="CALIBRATED", help="calibrated.yaml with antennas, ground and receiver."),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option("--against", metavar="PREDICTION", help="Score what 'predict' said of this flight (its folder)."),
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit code 1 when a stated check failed.")] = False,
    figures: Annotated[
        Literal["page", "none", "svg", "png", "pdf", "all"],
        typer.Option(help="Figures to draw: those of the page, none, or all in one format or in every format."),
    ] = "page",
    style: Annotated[
        Literal["screen", "paper"], typer.Option(help="Figure style: screen, or paper (IEEE width, fonts embedded).")
    ] = "screen",
    export: Export = None,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: Json = False,
) -> int:
    """Replay a flight, calibrate, compare, report."""
    from ..jobs import run

    asked = run.ReportOptions(
        engine=engine,
        audit=audit,
        recommend=recommend,
        learned=learned,
        against=against,
        figures=figures,
        style=style,
        export=export or (),
    )
    options = RunOptions(out=out, logs_root=logs_root, force=force, progress=say)
    if dry_run:
        print_plan(run.plan_report(flight, asked, options), as_json)
        return 0
    outcome = run.run_report(flight, asked, options)
    if as_json:
        print_json(outcome.metrics)
    else:
        _print_report_summary(outcome)
    return max(_verdict(outcome, strict), _nothing_compared(outcome.metrics))


def _nothing_compared(metrics: Mapping[str, Any]) -> int:
    """1 where no channel and no rank has samples enough to compare, which is said; 0 else."""
    from ..compare.memory import FEWEST

    channels = [m for channels in metrics["rss"].values() for m in channels.values()]
    most = max([m["n"] for m in (*channels, *metrics["rank"].values())], default=0)
    if most >= FEWEST or any(m.get("trained_on") for m in channels):
        return 0
    say.warn(f"check failed: nothing was compared: {most} samples have measurement, pose and path; expected {FEWEST}")
    return 1


def _verdict(outcome: Any, strict: bool) -> int:
    """Say each stated check that failed; 1 where that is asked to be a failure."""
    for check in outcome.failed_checks:
        say.warn(f"check failed: {check}")
    return 1 if strict and outcome.failed_checks else 0


_WARNINGS = 10
"""Warnings of a report that are also said here."""


def _print_ladder(ladder: Sequence[Mapping[str, Any]]) -> None:
    """One line per model; over several channels the range of its errors, which the page has one by one."""
    models = dict.fromkeys(m["model"] for m in ladder)
    rows = []
    for model in models:
        mine = [m for m in ladder if m["model"] == model]
        errors = [m["rmse_heldout_db"] for m in mine if m["rmse_heldout_db"] is not None]
        shown = (
            f"{min(errors):.2f}" if len(errors) == 1 else f"{min(errors):.2f} .. {max(errors):.2f}" if errors else "-"
        )
        star = "* " if any(m["recommended"] for m in mine) else ""
        rows.append([star + model, shown, number(max(m["seconds"] for m in mine), "{:.1f}")])
    if rows:
        heads = ["model", "RMSE dB", "s"]
        table(heads, rows, "Model comparison (cross-validated); * simplest replay within 1 SE of the best")


def _print_forecasts(rank: Mapping[str, Any]) -> None:
    """The forecast of the fitted receivers, where one was scored."""
    rows = []
    for tower, m in rank.items():
        found = m.get("receiver")
        if found and found.get("kappa") is not None:
            low, high = found["kappa_ci95"]
            rows.append([
                tower, number(found["kappa"], "{:.2f}"), f"{number(low, '{:.2f}')} .. {number(high, '{:.2f}')}",
                *(number(found[name], "{:.3f}") for name in _FORECAST), str(m["n"]),
            ])  # fmt: skip
    if rows:
        heads = ["tower", "kappa", "95 %", "agreement", "commonest", "log score", "constant", "n"]
        table(heads, rows, "Rank forecast by the fitted receiver")


_FORECAST = ("agreement", "majority_agreement", "log_score", "constant_log_score")


def _print_report_summary(outcome: Any) -> None:
    from ..compare.memory import FEWEST
    from ..compare.result import BASELINE_TITLE

    rows = []
    for tower, channels in outcome.metrics["rss"].items():
        for channel, m in channels.items():
            ci, many = m.get("rmse_ci95_db") or [None, None], m["n"] >= FEWEST
            rows.append(
                [
                    tower,
                    channel,
                    number(m["offset_db"], "{:.1f}"),
                    number(m["rmse_db"] if many else None, "{:.2f}"),
                    f"{number(ci[0], '{:.2f}')} .. {number(ci[1], '{:.2f}')}",
                    *(number(m["baselines"][n]["rmse_db"] if many else None, "{:.2f}") for n in BASELINE_TITLE),
                    number(m["correlation"], "{:.2f}"),
                    str(m["n"]),
                    str(m["n_out_of_coverage"]),
                ]
            )
    if rows:
        table(
            ["tower", "channel", "offset dB", "RMSE dB", "95 %", *BASELINE_TITLE.values(), "corr.", "n", "out of cov."],
            rows,
            "RSS, measured against replayed",
        )
    _print_ladder(outcome.metrics.get("ladder", ()))
    rows = []
    for tower, m in outcome.metrics["rank"].items():
        for k, s in m["simulated"].items():
            rows.append(
                [tower, k, number(s["agreement"], "{:.3f}"), number(s["total_variation"], "{:.3f}"), str(m["n"])]
            )
    if rows:
        table(["tower", "K", "agreement", "total variation", "n"], rows, "Rank, measured against replayed")
    _print_forecasts(outcome.metrics["rank"])
    if "against" in outcome.metrics:
        print(outcome.metrics["against"]["sentence"])
    warnings = [one_line(text) for text in outcome.metrics["warnings"]]
    for text in warnings[:_WARNINGS]:
        say.warn(f"warning: {text}")
    if len(warnings) > _WARNINGS:
        say.warn(f"and {len(warnings) - _WARNINGS} more warnings, all in the report")
    print(f"report: {outcome.folder / 'report.html'}")
    if audited := (outcome.metrics.get("rt") or {}).get("audit"):
        print(audited["summary"])


@command(
    "calibrate",
    examples=[
        "aerpaw-cmp calibrate calibration.yaml -o learned.yaml",
        "aerpaw-cmp calibrate calibration.yaml --logs-root /data/flights --json",
        "aerpaw-cmp calibrate calibration.yaml --into-site my_site.yaml",
        "aerpaw-cmp calibrate calibration.yaml --score next_flight.yaml --score another.yaml",
    ],
)
def calibrate(
    calibration_yaml: Annotated[Path, typer.Argument(metavar="CALIBRATION", help="calibration.yaml")],
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="FILE",
            help="File for the learned settings  [default: <calibration>.calibrated.yaml]",
        ),
    ] = None,
    logs_root: LogsRoot = None,
    into_site: Annotated[
        str | None,
        typer.Option(
            "--into-site", metavar="SITE", help="Site that stores the learned antennas; drafts then use them by name."
        ),
    ] = None,
    score: Annotated[
        list[Path] | None, typer.Option(help="flight.yaml to score with the learned settings; repeatable.")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Learn antennas and ground from several flights."""
    from ..jobs import run

    options = RunOptions(out=out, logs_root=logs_root, force=force, progress=say)
    outcome = run.run_calibrate(calibration_yaml, options, into_site=into_site, score=score or ())
    if as_json:
        print_json(outcome.metrics)
        return
    from ..compare.calibration import BASELINES

    m = outcome.metrics
    rows = []
    for name, scores in [*m["scores"].items(), *((f"control: {k}", v) for k, v in m["controls"].items())]:
        means = [sum(s[key] for s in scores) / len(scores) if scores else None
                 for key in ("rmse_db", "rmse_4s_db", *BASELINES)]  # fmt: skip
        rows.append([name.replace("_", " "), *(number(v, "{:.2f}") for v in means), str(len(scores))])
    if rows:
        heads = ["left out", "RMSE dB", "4 s means dB", *(f"{title} dB" for title in BASELINES.values()), "series"]
        table(heads, rows, "Scores on what was left out, means")
    rows = [
        [split.replace("_", " "), one["flight"], one["tower"], number(one["kappa"], "{:.3f}"),
         number(one["agreement"], "{:.3f}"), number(one["majority_agreement"], "{:.3f}"),
         number(one["log_score"], "{:.3f}"), number(one["constant_log_score"], "{:.3f}"),
         number(one["total_variation_expected"], "{:.3f}")]
        for split, scores in m["rank"].items()
        for one in scores
    ]  # fmt: skip
    if rows:
        heads = ["left out", "flight", "tower", "kappa", "agree", "commonest", "log score", "constant", "TV"]
        table(heads, rows, "Rank on what was left out")
    for text in [*m["words"], *m["warnings"]]:
        print(text)
    print(outcome.files[0])
    page = outcome.folder / "calibration.html"
    print(page if page.exists() else outcome.folder)


@command(
    "simulate",
    examples=[
        "aerpaw-cmp simulate plan/flight.yaml",
        "aerpaw-cmp simulate plan/flight.yaml -o planned --json",
    ],
)
def simulate(
    flight: Annotated[Path, typer.Argument(help="flight.yaml with flight.plan")],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="Output folder  [default: simulated/<flight>]")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Forward-simulate a planned flight into logs of the real formats."""
    from ..jobs import run

    print_files(run.run_simulate(flight, out=out, force=force, progress=say), as_json)


@command(
    "sample",
    examples=[
        "aerpaw-cmp sample",
        "aerpaw-cmp sample -o try_it",
    ],
)
def sample(
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="DIR", help="Folder for flight.yaml and the logs.")
    ] = Path("sample"),
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Copy the sample flight into a folder of your own."""
    from ..jobs.sample import write_sample

    flight = write_sample(out, force=force)
    if as_json:
        print_json({"flight": str(flight)})
        return
    print(f"flight: {flight}")
    print(f"next: aerpaw-cmp report {flight}")

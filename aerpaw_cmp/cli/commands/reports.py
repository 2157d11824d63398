"""Commands that explain and compare reports: ``explain``, ``diff``, ``campaign``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Argument, Option

from ...common.errors import one_line
from ...common.text import counted
from ...jobs.options import RunOptions
from ..app import LogsRoot, command, of_run
from ..shown import answered, number, records, say, show, table


@command(
    "explain",
    examples=[
        "aerpaw-cmp sample -o sample && aerpaw-cmp explain sample/flight.yaml --time 20 --tower LW1",
        "aerpaw-cmp explain flight.yaml --time 2025-06-01T14:00:20Z --tower LW1 --channel USRP2 --json",
    ],
)
def explain(
    flight: Annotated[Path, Argument(help="flight.yaml")],
    time: Annotated[str, Option(help="Seconds after the first sample, or ISO 8601 (time_utc of rss.csv).")],
    tower: Annotated[str, Option(help="Tower of the link.")],
    channel: Annotated[
        str | None, Option(help="Channel of the RSS logs, or 'rank'  [default: first log of the tower]")
    ] = None,
    engine: Annotated[Literal["image", "sionna"] | None, Option(help="Path search  [default: rt.engine]")] = None,
    logs_root: LogsRoot = None,
) -> None:
    """List every path of a link at one time, term by term."""
    from ...jobs.explain import run_explain

    explanation = run_explain(
        flight, time=time, tower=tower, channel=channel, engine=engine, logs_root=logs_root, progress=say
    )
    if not answered(explanation.as_dict()):
        _print_explanation(explanation)


def _print_explanation(explanation: Any) -> None:
    east, north, up = explanation.position_m
    show(
        f"{explanation.flight}: {explanation.tower} {explanation.channel} at {explanation.time_utc} "
        f"({explanation.time_s:.1f} s)"
    )
    show(f"UAV at {east:.2f} m east, {north:.2f} m north, {up:.2f} m up; {explanation.carrier_hz / 1e9:g} GHz")
    rows = [
        [p.words, f"{p.length_m:.2f}", f"{p.delay_ns:.1f}",
         f"{p.departure_azimuth_deg:.1f} / {p.departure_elevation_deg:.1f}",
         f"{p.arrival_azimuth_deg:.1f} / {p.arrival_elevation_deg:.1f}", f"{p.level_dbm:.2f}", f"{p.phase_deg:.1f}"]
        for p in explanation.paths
    ]  # fmt: skip
    heads = ["path", "m", "ns", "departure az / el deg", "arrival az / el deg", "dBm", "phase deg"]
    if rows:
        table(heads, rows, f"{counted(len(rows), 'path')} by engine {explanation.engine}")
        # take the order of the terms from the paths with the most interactions, which have the most terms
        deepest_first = sorted(explanation.paths, key=lambda path: -path.depth)
        names = list(dict.fromkeys(name for path in deepest_first for name in path.terms_db))
        power = f"{explanation.transmit_power_dbm:+.2f}"
        terms = [
            [p.words, power, *(number(p.terms_db.get(name), "{:+.2f}") for name in names), f"{p.level_dbm:.2f}"]
            for p in explanation.paths
        ]
        table(["path", "transmitted dBm", *(f"{name} dB" for name in names), "level dBm"], terms, "Terms")
    bounces = [{"path": path.words, **asdict(bounce)} for path in explanation.paths for bounce in path.bounces]
    angle = {"path": "path", "face": "face", "material": "material", "incidence deg": "incidence_deg:.1f"}
    records(bounces, angle | {"|TE| dB": "te_db:.2f", "|TM| dB": "tm_db:.2f"}, "Reflections")
    levels = [number(level, "{:.2f}") for level in (explanation.level_dbm, explanation.power_sum_dbm)]
    show(f"coherent sum {levels[0]} dBm, sum of powers {levels[1]} dBm")
    if explanation.measured_db is not None:
        show(f"measured {number(explanation.measured_db, '{:.2f}')} {explanation.unit}, before any offset")
    for path, reason in explanation.absent:
        show(f"not there: {path}: {reason}")
    for note in explanation.notes:
        show(f"note: {note}")


@command(
    "diff",
    examples=[
        "aerpaw-cmp diff reports/monday reports/friday",
        "aerpaw-cmp diff reports/a reports/b --strict",
        "aerpaw-cmp diff reports/a reports/b --json > changes.json",
    ],
)
def diff(
    first: Annotated[Path, Argument(help="Folder of a report.")],
    second: Annotated[Path, Argument(help="The other report of the same flight.")],
    strict: Annotated[
        bool, Option("--strict", help="End with exit code 1 if a number differs by more than 0.01 dB.")
    ] = False,
) -> int:
    """Compare two reports of a flight: settings, inputs, versions, and numbers on common samples."""
    from ...jobs.diff_reports import diff_metrics, run_diff

    comparison = run_diff(first, second)
    if not answered(diff_metrics(comparison)):
        _print_diff(comparison)
    return 1 if strict and comparison.differences else 0


# Largest number of changes of one kind that are printed.
_SHOWN = 20


def _print_diff(comparison: Any) -> None:
    from ...jobs.diff_reports import in_short, verdict

    show(verdict(comparison))
    for text in comparison.remarks:
        say.warn(f"warning: {one_line(text)}")
    for title, items in (("setting", comparison.settings), ("version", comparison.versions)):
        for item in items[:_SHOWN]:
            show(one_line(f"{title} {item['key']}: {in_short(item['first'])} -> {in_short(item['second'])}"))
        if len(items) > _SHOWN:
            show(f"and {len(items) - _SHOWN} more {title}s")
    for item in comparison.inputs:
        show(one_line(f"input {item['path']} ({item['role']}): {item['what']}"))
    _print_numbers(comparison)


def _print_numbers(comparison: Any) -> None:
    levels = {
        "tower": "tower", "channel": "channel", "common samples": "samples", "RMSE first dB": "rmse.other_rmse_db:.3f",
        "second": "rmse.rmse_db:.3f", "change": "rmse.difference_db:+.3f", "95 %": "rmse.difference_ci95_db:+.3f",
        "second is": "rmse.verdict", "offset": "offset_db.difference:+.1f", "replay": "simulated_max_db:.3f",
    }  # fmt: skip
    title = "RSS on common samples, second minus first; offset and replay: change, largest change in dB"
    records(comparison.levels, levels, title)
    ranks = {
        "tower": "tower", "K": "k", "common samples": "samples", "ranks changed": "n_changed",
        "agreement": "agreement.difference:+.1%", "95 % of it": "agreement.ci95:+.1%",
        "kappa": "kappa.difference:+.3f", "95 % of kappa": "kappa.ci95:+.3f",
    }  # fmt: skip
    records(comparison.ranks, ranks, "Rank on common samples, second minus first")


@command(
    "campaign",
    examples=[
        "aerpaw-cmp campaign campaign.yaml --workers 4",
        "aerpaw-cmp campaign campaign.yaml -o reports/spring --keep outcomes --strict",
        "aerpaw-cmp campaign campaign.yaml --scheduler tls://scheduler:8786 --keep /shared/outcomes",
        "aerpaw-cmp campaign campaign.yaml --dry-run",
    ],
    options=of_run("Output folder  [default: reports/<campaign>]", "logs_root", "workers", "scheduler", "dry", "force"),
)
def campaign(
    options: RunOptions,
    campaign_yaml: Annotated[Path, Argument(metavar="CAMPAIGN", help="campaign.yaml")],
    keep: Annotated[
        Path | None, Option(help="Folder for task outcomes; a rerun computes only missing outcomes.")
    ] = None,
    fresh: Annotated[bool, Option("--fresh", help="Ignore stored outcomes and store none.")] = False,
    strict: Annotated[bool, Option("--strict", help="Also end with exit code 1 if a check failed.")] = False,
) -> int:
    """Compare many flights under many settings."""
    from ...jobs import run

    outcome = run.run_campaign(campaign_yaml, options, keep=keep, fresh=fresh)
    if not answered(outcome.metrics):
        _print_campaign_summary(outcome)
    for check in outcome.failed_checks:
        say.warn(f"failed: {check}")
    if not (outcome.metrics["rss"] or outcome.metrics["rank"] or outcome.metrics["season"]["nodes"]):
        # return the exit code of a wrong input, because no flight could be compared with any of the settings
        return 3
    return 1 if outcome.metrics["failures"] or (strict and outcome.failed_checks) else 0


def _print_campaign_summary(outcome: Any) -> None:
    m = outcome.metrics
    names = list(next(iter(m["mean_rmse_db"].values()), {}))
    rows = [[s, *[number(by[f], "{:.2f}") for f in names]] for s, by in m["mean_rmse_db"].items()]
    if names:
        title = "Mean RMSE over towers and channels (dB), each with its own offset"
        unscored = any(cell == "-" for row in rows for cell in row[1:])
        table(["setting", *names], rows, title + ("; dash: not scored, the page states why" if unscored else ""))
    heads = {"setting": "setting", "flight": "flight", "tower": "tower", "K": "k:g"}
    numbers = {"total variation": "total_variation:.3f", "agreement": "agreement:.0%", "kappa": "kappa:.2f"}
    records(m["rank"], heads | numbers, "Rank")
    for sentence in m["season"]["steps"]:
        show(sentence)
    show(f"report: {outcome.folder / 'campaign.html'}")

"""``report``, ``calibrate``, ``simulate``, ``sample``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from ...common.errors import typed
from ...common.text import counted
from ...jobs.options import AGAINST_DISTANCE_M, RunOptions
from ..app import Figures, Force, command, of_run, output
from ..shown import answered, number, page_table, print_files, records, say, show, table, warn_all


@command(
    "report",
    examples=[
        "aerpaw-cmp sample -o sample && aerpaw-cmp report sample/flight.yaml",
        "aerpaw-cmp report flight.yaml -o reports/mine --audit none",
        "aerpaw-cmp report flight.yaml --dry-run",
        "aerpaw-cmp report flight.yaml --figures all",
        "aerpaw-cmp report flight.yaml --kmz --netcdf",
        "aerpaw-cmp report flight.yaml --with calibrated.yaml",
        "aerpaw-cmp report flight.yaml --against prediction",
        "aerpaw-cmp report flight.yaml --against matlab.csv --against sionna_map.npz",
        "aerpaw-cmp report flight.yaml --strict --json --quiet",
    ],
    options=of_run("Output folder  [default: reports/<flight>]", "logs_root", "dry", "force"),
)
def report(
    options: RunOptions,
    flight: Annotated[Path, Argument(help="flight.yaml")],
    audit: Annotated[
        str | None,
        Option(help="Number of audited links, 'full' or 'none'; ignores the cache  [default: rt.audit_links]"),
    ] = None,
    recommend: Annotated[Path | None, Option(help="Write a flight.yaml with the recommended model.")] = None,
    learned: Annotated[
        Path | None, Option("--with", metavar="CALIBRATED", help="calibrated.yaml with antennas, ground and receiver.")
    ] = None,
    against: Annotated[
        list[Path] | None,
        Option(
            metavar="PREDICTION",
            help="Score a prediction of this flight: a folder of 'predict', or CSV, NetCDF, .npz or logs of another "
            "program; repeatable.",
        ),
    ] = None,
    against_distance: Annotated[
        float, Option(min=0.01, help="Largest distance from a sample to a predicted position [m].")
    ] = AGAINST_DISTANCE_M,
    strict: Annotated[bool, Option("--strict", help="End with exit code 1 if a check failed.")] = False,
    figures: Figures = "none",
    kmz: Annotated[bool, Option("--kmz", help="Also write samples.kmz for Google Earth and QGIS.")] = False,
    netcdf: Annotated[bool, Option("--netcdf", help="Also write rss.nc and rank.nc for xarray and MATLAB.")] = False,
) -> int:
    """Replay a flight, calibrate the prediction, compare it with the logs, and write the report."""
    from ...jobs import run

    chosen = run.ReportOptions(
        audit=audit,
        recommend=recommend,
        learned=learned,
        against=tuple(against or ()),
        against_distance_m=against_distance,
        figures=figures,
        kmz=kmz,
        netcdf=netcdf,
    )
    outcome = run.run_report(flight, chosen, options)
    if not answered(outcome.metrics):
        _print_report_summary(outcome)
    refused = bool(outcome.metrics.get("referee_refused"))
    return max(_verdict(outcome, strict), _nothing_compared(outcome.metrics), refused)


def _nothing_compared(metrics: Mapping[str, Any]) -> int:
    """Return 1 and warn if no channel and no rank has enough samples to compare, otherwise 0."""
    from ...compare.statistics import FEWEST

    channels = [m for channels in metrics["rss"].values() for m in channels.values()]
    # do not warn if the antenna of a channel was learned from this log, because such a channel is deliberately not
    # scored
    most = max([m["n"] for m in (*channels, *metrics["rank"].values())], default=0)
    if most >= FEWEST or any(m.get("trained_on") for m in channels):
        return 0
    samples = f"{counted(most, 'sample')} with measurement, pose and path"
    say.warn(f"check failed: nothing was compared: {samples}; expected {FEWEST}")
    return 1


def _verdict(outcome: Any, strict: bool) -> int:
    """Warn about each failed check. Return 1 if ``strict`` is set and a check failed, otherwise 0."""
    for check in outcome.failed_checks:
        say.warn(f"check failed: {check}")
    return 1 if strict and outcome.failed_checks else 0


def _print_models(models: Sequence[Mapping[str, Any]]) -> None:
    """Print a table of the distinct models with scores over all channels. The page also lists each channel."""
    notes = {"recommended": "recommended", "fastest_sufficient": "fastest sufficient"}
    rows = [{**row, "note": ", ".join(notes[key] for key in notes if row[key])} for row in models if row["distinct"]]
    columns = {
        "model": "model", "RMSE dB": "rmse_heldout_db:.1f", "minus best": "difference_to_best_db:.2f",
        "95 %": "difference_to_best_ci95_db:.2f", "s": "seconds:.1f", "": "note",
    }  # fmt: skip
    same = len(models) - len(rows)
    more = f" ({same} more within 0.01 dB of a row above on every channel)" if same else ""
    records(rows, columns, f"Models, cross-validated over all channels{more}")


def _print_forecasts(rank: Mapping[str, Any]) -> None:
    """Print the scores of the rank forecasts of fitted receivers, if there are any."""
    known = [{"tower": tower, **(m.get("receiver") or {}), "n": m["n"]} for tower, m in rank.items()]
    columns = {
        "tower": "tower", "kappa": "kappa:.2f", "95 %": "kappa_ci95:.2f", "agreement": "agreement:.0%",
        "commonest": "majority_agreement:.0%", "log score": "log_score:.3f", "constant": "constant_log_score:.3f",
        "n": "n",
    }  # fmt: skip
    known = [forecast for forecast in known if forecast.get("kappa") is not None]
    records(known, columns, "Rank forecast by the fitted receiver")


def _print_report_summary(outcome: Any) -> None:
    """Print the summary of the report's page, then its tables and warnings."""
    from ...compare.result import BASELINE_TITLE
    from ...compare.statistics import FEWEST
    from ...report.flight import prediction_card

    show(" ".join([outcome.metrics["sentence"], *outcome.metrics["offsets"]]))
    links = [
        {
            **m, "tower": tower, "channel": channel, "ci95_db": m.get("rmse_ci95_db"),
            **{name: model["rmse_db"] if m["n"] >= FEWEST else None
               for name, model in {"rmse_db": m, **m["baselines"]}.items()},
        }
        for tower, channels in outcome.metrics["rss"].items()
        for channel, m in channels.items()
    ]  # fmt: skip
    columns = {
        "tower": "tower", "channel": "channel", "offset dB": "offset_db:.1f", "RMSE dB": "rmse_db:.1f",
        "95 %": "ci95_db:.1f", **{title: f"{name}:.1f" for name, title in BASELINE_TITLE.items()},
        "corr.": "correlation:.2f", "n": "n", "out of coverage": "n_out_of_coverage",
    }  # fmt: skip
    records(links, columns, "RSS, measured against replayed")
    _print_models(outcome.metrics.get("models", ()))
    thresholds = [
        {"tower": tower, "k": k, **fit, "n": m["n"]}
        for tower, m in outcome.metrics["rank"].items()
        for k, fit in m["simulated"].items()
    ]
    columns = {"tower": "tower", "K": "k", "agreement": "agreement:.0%", "total variation": "total_variation:.3f"}
    records(thresholds, {**columns, "n": "n"}, "Rank, measured against replayed")
    _print_forecasts(outcome.metrics["rank"])
    for verdict in outcome.metrics.get("referee", []):
        show(verdict["sentence"])
        for item in prediction_card(verdict).tables[:3]:
            page_table(item)
        for remark in verdict["remarks"]:
            say.warn(remark)
    for text in outcome.metrics["antennas"]:
        show(text)
    warn_all(outcome.metrics["warnings"])
    if "recommended" in outcome.metrics:
        show(outcome.metrics["recommended"])
    show(f"report: {outcome.folder / 'report.html'}")
    if audited := (outcome.metrics.get("rt") or {}).get("audit"):
        show(audited["summary"])


@command(
    "calibrate",
    examples=[
        "aerpaw-cmp calibrate flight.yaml another.yaml",
        "aerpaw-cmp calibrate calibration.yaml -o learned.yaml",
        "aerpaw-cmp calibrate calibration.yaml --logs-root /data/flights --json",
        "aerpaw-cmp calibrate calibration.yaml --into-site my_site.yaml",
        "aerpaw-cmp calibrate calibration.yaml --score next_flight.yaml --score another.yaml",
    ],
    options=of_run(
        "File for the learned settings  [default: <calibration>.calibrated.yaml]",
        "logs_root",
        "dry",
        "force",
        metavar="FILE",
    ),
)
def calibrate(
    options: RunOptions,
    flights: Annotated[list[Path], Argument(metavar="FLIGHT", help="flight.yaml files, or a calibration.yaml.")],
    into_site: Annotated[
        str | None, Option(metavar="SITE", help="Site that stores the learned antennas; drafts then use them by name.")
    ] = None,
    score: Annotated[
        list[Path] | None, Option(help="flight.yaml to score with the learned settings; repeatable.")
    ] = None,
) -> None:
    """Learn antennas and ground from several flights."""
    from ...jobs import run

    outcome = run.run_calibrate(flights[0], options, further=flights[1:], into_site=into_site, score=score or ())
    if answered(outcome.metrics):
        return
    from ...compare.calibration import BASELINES

    m = outcome.metrics
    rows = []
    for name, scores in [*m["scores"].items(), *((f"control: {k}", v) for k, v in m["controls"].items())]:
        means = [sum(s[key] for s in scores) / len(scores) if scores else None
                 for key in ("rmse_db", "rmse_4s_db", *BASELINES)]  # fmt: skip
        kind = name.removesuffix("_left_out").replace("_", " ")
        rows.append([kind, *(number(v, "{:.1f}") for v in means), str(len(scores))])
    if rows:
        heads = ["held out", "RMSE dB", "4 s means dB", *(f"{title} dB" for title in BASELINES.values()), "channels"]
        table(heads, rows, "Mean scores on held-out data")
    forecasts = [f | {"split": split.removesuffix("_left_out")} for split, scores in m["rank"].items() for f in scores]
    columns = {
        "held out": "split", "flight": "flight", "tower": "tower", "kappa": "kappa:.3f", "agree": "agreement:.0%",
        "commonest": "majority_agreement:.0%", "log score": "log_score:.3f", "constant": "constant_log_score:.3f",
        "TV": "total_variation_expected:.3f",
    }  # fmt: skip
    records(forecasts, columns, "Rank on held-out data")
    for text in [*m["words"], *m["warnings"]]:
        show(text)
    show(outcome.files[0])
    page = outcome.folder / "calibration.html"
    show(page if page.exists() else outcome.folder)


@command(
    "simulate",
    examples=["aerpaw-cmp simulate plan/flight.yaml", "aerpaw-cmp simulate plan/flight.yaml -o planned --json"],
    options=of_run("Output folder  [default: simulated/<flight>]", "dry", "force"),
)
def simulate(options: RunOptions, flight: Annotated[Path, Argument(help="flight.yaml with flight.plan")]) -> None:
    """Simulate a planned flight and write its logs in the real formats."""
    from ...jobs import run

    outcome = run.run_simulate(flight, options)
    warn_all(outcome.warnings)
    print_files(outcome.files)


@command("sample", examples=["aerpaw-cmp sample", "aerpaw-cmp sample -o try_it"])
def sample(
    out: Annotated[Path, output("Folder for flight.yaml and the logs.")] = Path("sample"), force: Force = False
) -> None:
    """Copy the sample flight into a folder of your own."""
    from ...jobs.sample import write_sample

    flight = write_sample(out, force=force)
    if answered({"flight": str(flight)}):
        return
    show(f"flight: {flight}")
    show(f"next: aerpaw-cmp report {typed(flight)}")

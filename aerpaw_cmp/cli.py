"""Arguments, exit codes, progress: the only module that prints."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from .common.commands import COMMANDS
from .common.errors import UsageError, one_line

app = typer.Typer(add_completion=False, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)
site_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)
app.add_typer(site_app, name="site", help=COMMANDS["site"])

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output and nothing else there.")]
Out = Annotated[Optional[Path], typer.Option("-o", "--out", help="Where the results go.")]  # noqa: UP045  typer on 3.10
Force = Annotated[bool, typer.Option("--force", help="Replace also what this tool did not write; never an input.")]
LogsRoot = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option("--logs-root", help="Folder against which the paths of the logs resolve."),
]


def main(arguments: list[str]) -> int:
    """Run the command line and give its exit code; ``__main__`` turns exceptions into messages."""
    try:
        result = app(args=arguments, prog_name="aerpaw-cmp", standalone_mode=False)
    except typer.Abort as error:
        raise KeyboardInterrupt from error
    except Exception as error:
        # typer may vendor click: what counts is the shape of a usage error, not its module
        if hasattr(error, "format_message") and hasattr(error, "exit_code"):
            raise UsageError(error.format_message()) from error
        raise
    finally:
        _say.end()
    return result if isinstance(result, int) else 0


class _Progress:
    """Progress on standard error, so that standard output stays clean.

    On a terminal a share is a bar with the time left; elsewhere every quarter is a line.
    """

    def __init__(self) -> None:
        self._bar: Any = None
        self._quarters: dict[str, int] = {}

    def __call__(self, text: str, fraction: float | None = None, /) -> None:
        if fraction is None:
            self.end()
            print(text, file=sys.stderr, flush=True)
        elif sys.stderr.isatty():
            self._draw(text, fraction)
        elif int(4 * fraction) > self._quarters.get(text, 0):
            self._quarters[text] = int(4 * fraction)
            print(f"{text} {100 * fraction:.0f} %", file=sys.stderr, flush=True)

    def _draw(self, text: str, fraction: float) -> None:
        if self._bar is None or self._bar.tasks[0].description != text:
            self.end()
            self._bar = _bar()
            self._bar.add_task(text, total=1.0)
            self._bar.start()
        self._bar.update(self._bar.tasks[0].id, completed=fraction)
        if fraction >= 1.0:
            self.end()

    def end(self) -> None:
        """Leave the bar as it stands."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def _bar() -> Any:
    from rich import progress
    from rich.console import Console

    columns = (
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(),
        progress.TaskProgressColumn(),
        progress.TimeRemainingColumn(compact=True, elapsed_when_finished=True),
    )
    return progress.Progress(*columns, console=Console(stderr=True))


_say = _Progress()


def _print_json(value: dict[str, Any]) -> None:
    print(json.dumps(value, indent=1, allow_nan=False))


_FIXED = 20
"""Columns up to this width (numbers, times) are never broken."""


def _table(columns: list[str], rows: list[list[str]], title: str | None = None, width: int | None = None) -> None:
    """A table; where the terminal is too narrow for it, a paragraph per row."""
    from rich.cells import cell_len
    from rich.console import Console
    from rich.table import Table

    console = Console(width=width if width or sys.stdout.isatty() else 160)
    needs = [max(map(cell_len, [*name.split(), *(row[i] for row in rows)])) for i, name in enumerate(columns)]
    roomy = sum(max(need, cell_len(name)) + 3 for need, name in zip(needs, columns, strict=True)) < console.width
    if sum(min(need, _FIXED) + 3 for need in needs) + 1 > console.width:
        _paragraphs(columns, rows, title, console.width)
        return
    table = Table(title=title, title_justify="left")
    for column, need in zip(columns, needs, strict=True):
        table.add_column(column, overflow="fold", width=None if roomy or need > _FIXED else need)
    for row in rows:
        table.add_row(*[cell.replace("[", r"\[") for cell in row])
    console.print(table)


def _paragraphs(columns: list[str], rows: list[list[str]], title: str | None, width: int) -> None:
    """Rows as text: the first cell, then names and values."""
    import textwrap

    if title:
        print(title)
    for row in rows:
        lines = [""]
        for name, cell in zip(columns[1:], row[1:], strict=True):
            item = f"{name} {cell}"
            if lines[-1] and len(lines[-1]) + len(item) + 7 > width:  # 7: indent and separator
                lines.append("")
            lines[-1] += f" | {item}" if lines[-1] else item
        print(row[0])
        for line in lines:
            print(textwrap.fill(line, width, initial_indent="    ", subsequent_indent="      ", break_on_hyphens=False))


@app.command(help=COMMANDS["ingest"])
def ingest(
    paths: Annotated[list[Path], typer.Argument(help="Log files and folders.")],
    out: Out = None,
    draft: Annotated[Optional[Path], typer.Option(help="Also write a first flight.yaml that names these logs.")] = None,  # noqa: UP045
    reader: Annotated[Optional[str], typer.Option(help="Reader of all files, in place of sniffing.")] = None,  # noqa: UP045
    timezone: Annotated[Optional[str], typer.Option(help="IANA zone of zone-less clocks.")] = None,  # noqa: UP045
    time_origin: Annotated[Optional[str], typer.Option(help="ISO time of logs with relative times.")] = None,  # noqa: UP045
    ri_base: Annotated[Optional[str], typer.Option(help="zero or one: what the source prints for rank 1.")] = None,  # noqa: UP045
    columns: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--map", metavar="COLUMN=QUANTITY", help="What a column of a CSV holds: time, rss_db, rank, ..."),
    ] = None,
    unit: Annotated[Optional[str], typer.Option(help="Unit of levels where the file does not fix it.")] = None,  # noqa: UP045
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Read logs, account for every line, write the flight file."""
    from .jobs import run
    from .logs.ingest import ACCOUNT, account_notes, account_rows

    if ri_base not in (None, "zero", "one"):
        raise UsageError(f"--ri-base {ri_base!r}", expected="zero or one")
    options = {"timezone": timezone, "time_origin": time_origin, "ri_base": ri_base, "unit": unit}
    if columns:
        options |= run.mapping(columns)
        reader = reader or "generic_csv"
    summary = run.run_ingest(paths, out=out, draft=draft, reader=reader, force=force, **options)
    if as_json:
        _print_json(summary)
        return
    folder, rows = account_rows(summary)
    _table(list(ACCOUNT), rows, f"files below {folder}" if folder else None)
    for note in account_notes(summary):
        _say(note)
    if out is not None:
        print(f"wrote {out}")
    if draft is not None:
        for remark in summary["draft"]:
            _say(remark)
        for place in summary["drafts"]:
            print(f"wrote {place}")


@app.command(help=COMMANDS["formats"])
def formats(as_json: Json = False) -> None:
    """List the readers with a sample line each."""
    from .logs.readers import catalogue

    readers = sorted(catalogue(), key=lambda r: r.name)
    if as_json:
        _print_json(
            {
                "readers": [
                    {"name": r.name, "title": r.title, "kinds": list(r.kinds), "sample": r.sample} for r in readers
                ]
            }
        )
        return
    _table(
        ["reader", "what", "streams", "a line of it"],
        [[r.name, r.title, ", ".join(r.kinds), r.sample] for r in readers],
    )


@app.command(help=COMMANDS["report"])
def report(
    flight: Annotated[Path, typer.Argument(help="flight.yaml")],
    out: Out = None,
    logs_root: LogsRoot = None,
    engine: Annotated[Optional[str], typer.Option(help="image or sionna, in place of rt.engine.")] = None,  # noqa: UP045
    audit: Annotated[Optional[str], typer.Option(help="Number of audited links, 'full' or 'none'.")] = None,  # noqa: UP045
    recommend: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--recommend", help="Write the flight file with the settings of the model that the scene needs."),
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit code 1 when a stated check failed.")] = False,
    figures: Annotated[
        str,
        typer.Option(help="What is drawn: page (what it shows), none, or every figure as svg, png, pdf, all."),
    ] = "page",
    style: Annotated[
        str, typer.Option(help="Look of the figures: screen, or paper (IEEE width, fonts embedded).")
    ] = "screen",
    force: Force = False,
    as_json: Json = False,
) -> int:
    """Replay a flight, calibrate, compare, report."""
    from .jobs import run

    outcome = run.run_report(
        flight,
        out=out,
        logs_root=logs_root,
        engine=engine,
        audit=audit,
        recommend=recommend,
        force=force,
        figures=figures,
        style=style,
        progress=_say,
    )
    if as_json:
        _print_json(outcome.metrics)
    else:
        _print_report_summary(outcome)
    failed = outcome.failed_checks
    for check in failed:
        _say(f"check failed: {check}")
    return 1 if strict and failed else 0


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
        rows.append([star + model, shown, _number(sum(m["seconds"] for m in mine), "{:.1f}")])
    if rows:
        heads = ["model", "RMSE dB", "s"]
        _table(heads, rows, "Models on stretches left out; * simplest within one standard error of the best")


def _print_report_summary(outcome: Any) -> None:
    rows = []
    for tower, channels in outcome.metrics["rss"].items():
        for channel, m in channels.items():
            ci = m.get("rmse_ci95_db") or [None, None]
            rows.append(
                [
                    tower,
                    channel,
                    _number(m["offset_db"], "{:.1f}"),
                    _number(m["rmse_db"], "{:.2f}"),
                    f"{_number(ci[0], '{:.2f}')} .. {_number(ci[1], '{:.2f}')}",
                    _number(m["baselines"]["free_space"]["rmse_db"], "{:.2f}"),
                    _number(m["baselines"]["two_ray"]["rmse_db"], "{:.2f}"),
                    _number(m["correlation"], "{:.2f}"),
                    str(m["n"]),
                    str(m["n_out_of_coverage"]),
                ]
            )
    if rows:
        _table(
            ["tower", "channel", "offset dB", "RMSE dB", "95 %", "free space", "two-ray", "corr.", "n", "out of cov."],
            rows,
            "RSS, measured against replayed",
        )
    _print_ladder(outcome.metrics.get("ladder", ()))
    rows = []
    for tower, m in outcome.metrics["rank"].items():
        for k, s in m["simulated"].items():
            rows.append(
                [tower, k, _number(s["agreement"], "{:.3f}"), _number(s["total_variation"], "{:.3f}"), str(m["n"])]
            )
    if rows:
        _table(["tower", "K", "agreement", "total variation", "n"], rows, "Rank, measured against replayed")
    warnings = [one_line(text) for text in outcome.metrics["warnings"]]
    for text in warnings[:_WARNINGS]:
        _say(f"warning: {text}")
    if len(warnings) > _WARNINGS:
        _say(f"and {len(warnings) - _WARNINGS} more warnings, all in the report")
    print(f"report: {outcome.folder / 'report.html'}")


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


@app.command(help=COMMANDS["simulate"])
def simulate(
    flight: Annotated[Path, typer.Argument(help="flight.yaml with flight.plan")],
    out: Out = None,
    force: Force = False,
) -> None:
    """Forward-simulate a planned flight into logs of the real formats."""
    from .jobs import run

    for path in run.run_simulate(flight, out=out, force=force, progress=_say):
        print(path)


@app.command(help=COMMANDS["sample"])
def sample(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder that gets flight.yaml and the logs.")] = Path(
        "sample"
    ),
    force: Force = False,
) -> None:
    """Copy the sample flight into a folder of your own."""
    from .jobs.sample import write_sample

    flight = write_sample(out, force=force)
    print(f"flight: {flight}")
    print(f"next: aerpaw-cmp report {flight}")


@app.command(help=COMMANDS["doctor"])
def doctor(as_json: Json = False) -> int:
    """Check this machine."""
    from .machine import doctor as doctor_room

    checks = doctor_room.checks()
    if as_json:
        _print_json(doctor_room.as_dict(checks))
    else:
        _table(["check", "status", "found", "remedy"], [[c.name, c.status, c.found, c.remedy or "-"] for c in checks])
    return 1 if any(c.status == "fail" for c in checks) else 0


@app.command(help=COMMANDS["tap"])
def tap(
    port: Annotated[str | None, typer.Argument(help="Serial port; without it the first AT port of a Quectel.")] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder of the log segments.")] = Path("tap"),
    status: Annotated[bool, typer.Option("--status/--no-status", help="A status line on standard error.")] = True,
    enable_csi: Annotated[
        bool, typer.Option("--enable-csi", help="Switch CSI reporting on; restored on exit.")
    ] = False,
    ri_hz: Annotated[float, typer.Option(help="Rate of the rank indicator.")] = 2.0,
    other_hz: Annotated[float, typer.Option(help="Rate of each other query.")] = 1.0,
    no_csi_alarm: Annotated[Optional[float], typer.Option(help="Bell when no CSI came for so many seconds.")] = None,  # noqa: UP045
    no_csi_exit: Annotated[bool, typer.Option("--no-csi-exit", help="End with exit code 1 on that alarm.")] = False,
    sync_s: Annotated[float, typer.Option(help="Longest time between a record and its sync to disk.")] = 1.0,
    duration: Annotated[Optional[float], typer.Option(help="End by itself after so many seconds.")] = None,  # noqa: UP045
    wait: Annotated[float, typer.Option(help="Wait so many seconds for the port to appear.")] = 0.0,
    replay: Annotated[Optional[Path], typer.Option(help="Tap a transcript or tap log instead of a port.")] = None,  # noqa: UP045
    export: Annotated[Optional[str], typer.Option(help="csv: write the log below OUT as a table and end.")] = None,  # noqa: UP045
    flight: Annotated[Optional[Path], typer.Option(help="flight.yaml: also show the rank the replay predicts.")] = None,  # noqa: UP045
    telemetry: Annotated[Path | None, typer.Option(help="The growing vehicleOut file that --flight follows.")] = None,
    force: Force = False,
) -> int:
    """Log the modem's rank indicator until interrupted."""
    if export is not None:
        if export != "csv":
            raise UsageError(f"--export {export!r}", expected="csv")
        from .live.export import export_csv

        print(export_csv(out, out / "tap.csv", force=force))
        return 0
    _needs_posix("tap")
    from .live.log import LogSettings
    from .live.session import TapSettings, format_status
    from .live.tap import run_tap

    settings = TapSettings(
        folder=out,
        port=port,
        ri_hz=ri_hz,
        other_hz=other_hz,
        enable_csi=enable_csi,
        no_csi_alarm_s=no_csi_alarm,
        no_csi_exit=no_csi_exit,
        duration_s=duration,
        wait_for_port_s=wait,
        replay=replay,
        log=LogSettings(sync_interval_s=sync_s),
    )
    predict = None
    if flight is not None:
        from .jobs.run import live_prediction

        predict = live_prediction(flight, telemetry)
    terminal = sys.stderr.isatty()

    def show(now: Any) -> None:
        if now.message:
            print(("\r\033[K" if terminal else "") + now.message, file=sys.stderr, flush=True)
        if status:
            line = format_status(now)
            print(f"\r\033[K{line}" if terminal else line, end="" if terminal else "\n", file=sys.stderr, flush=True)
        if now.alarm:
            print("\a", end="", file=sys.stderr, flush=True)

    summary = run_tap(settings, on_status=show, predict=predict)
    rates = ", ".join(f"{name} {rate:.2f} Hz" for name, rate in summary.rates_hz.items())
    _say(
        ("\n" if terminal else "") + f"ended: {summary.reason}; {summary.records} records, {summary.gaps} gaps; {rates}"
    )
    for segment in summary.segments:
        print(segment)
    return int(summary.exit_code)


def _needs_posix(command: str) -> None:
    """Ports are opened with termios and locked with fcntl, which not every system has."""
    import importlib

    for name in ("fcntl", "termios", "pty"):
        try:
            importlib.import_module(name)
        except ImportError:
            raise UsageError(
                f"'{command}' needs Python's {name}, which this system does not have",
                expected="Linux (another POSIX system may do)",
                cause="Windows; logs of a tap can be read, reported and exported on every system",
            ) from None


@app.command("modem-sim", help=COMMANDS["modem-sim"])
def modem_sim(
    link: Annotated[Optional[Path], typer.Option(help="Symbolic link to the port, kept right.")] = None,  # noqa: UP045
    source: Annotated[
        Path | None, typer.Option(help="What to play: a transcript, a tap log, or any log with ranks.")
    ] = None,
    kind: Annotated[str, typer.Option(help="modem, gps, diag, silent or rubbish.")] = "modem",
    fault: Annotated[Optional[list[str]], typer.Option(help="NAME=VALUE, e.g. echo=true, unplug_every_s=20.")] = None,  # noqa: UP045
) -> int:
    """Serve a pseudo-terminal that behaves like an RM502Q-AE until interrupted."""
    _needs_posix("modem-sim")
    from .live.simulator import ModemSimSettings, run_modem_sim

    settings = ModemSimSettings(link=link, source=source, kind=kind, faults=_faults(fault or []))  # type: ignore[arg-type]  # checked there
    return run_modem_sim(settings, on_ready=lambda port: print(port, flush=True))


def _faults(pairs: list[str]) -> Any:
    """Faults from NAME=VALUE pairs."""
    import dataclasses

    from .live.simulator import Faults

    known: dict[str, Any] = {f.name: f.default for f in dataclasses.fields(Faults)}
    values: dict[str, Any] = {}
    for pair in pairs:
        name, _, text = pair.partition("=")
        if name not in known:
            raise UsageError(f"--fault {pair!r}", expected="NAME=VALUE with one of " + ", ".join(known))
        kind: Any = type(known[name])
        try:
            values[name] = text.lower() in ("", "1", "true", "yes") if kind is bool else kind(text)
        except ValueError as error:
            raise UsageError(f"--fault {pair!r}", expected=f"a value of type {kind.__name__}") from error
    return Faults(**values)


@app.command(help=COMMANDS["bench"])
def bench(
    poses: Annotated[int, typer.Option(min=2, help="Poses of the flight that is replayed.")] = 200,
    quick: Annotated[bool, typer.Option("--quick", help="Few poses, at most 1e4 samples, no peers.")] = False,
    as_json: Json = False,
) -> None:
    """Speed against error on this machine."""
    from .jobs import run

    if quick:
        result = run.run_bench(poses=min(poses, 40), samples=(1_000, 10_000), ratios=False, progress=_say)
    else:
        result = run.run_bench(poses=poses, progress=_say)
    if as_json:
        _print_json(result)
        return
    rows = []
    for r in result["replay"]["rows"]:
        what = "" if r["thinning"] == 1 else f", 1 in {r['thinning']} poses"
        rows.append(
            [
                f"{r['engine']}{what}",
                "-" if r["samples"] is None else f"{r['samples']:.0e}",
                r["arrays"],
                str(r["depth"]),
                f"{r['seconds']:.3g}",
                f"{r['links_per_s']:.3g}",
                f"{r['peak_mib']:.0f}",
                "-" if r["missing_paths"] is None else f"{r['missing_paths']} / {r['extra_paths']}",
                f"{_number(r['rss_max_error_db'], '{:.2g}')} / {_number(r['rss_rms_error_db'], '{:.2g}')}",
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
    _table([*header, "rank disagreement per K"], rows, f"Speed against error; {result['conditions']}")
    for name, ratio in result["ratios"].items():
        print(f"{name}: {ratio:.3g} times")
    if result["report"]:
        seconds = {name.removeprefix("seconds_"): value for name, value in result["report"].items()}
        print("report: " + ", ".join(f"{name} {value:.1f} s" for name, value in seconds.items()))


@site_app.command("import", help="Map data (GeoJSON, OSM XML, Overpass JSON, KML, KMZ) to a site.yaml.")
def site_import(
    files: Annotated[list[Path], typer.Argument(help="Map files.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The site.yaml to write.")],
    base: Annotated[str, typer.Option(help="Site whose towers and settings are kept.")] = "lake_wheeler",
    untagged: Annotated[Optional[str], typer.Option(help="building, forest or geofence: areas without a tag.")] = None,  # noqa: UP045
    force: Force = False,
) -> None:
    """Import footprints."""
    from .jobs import run

    for line in run.run_site_import(files, out, base=base, untagged=untagged, force=force):
        _say(line)
    print(out)


@site_app.command("show", help="Plan view, 3-D picture and a standalone page of a site.")
def site_show(
    site: Annotated[Optional[str], typer.Argument(help="site.yaml or packaged site; else the flight's.")] = None,  # noqa: UP045
    out: Out = None,
    flight: Annotated[Optional[Path], typer.Option(help="Draw the track of this flight.yaml.")] = None,  # noqa: UP045
    logs_root: LogsRoot = None,
    pose: Annotated[Optional[int], typer.Option(help="Draw the paths to this point of the track.")] = None,  # noqa: UP045
    export: Annotated[bool, typer.Option("--export", help="Also PLY + Mitsuba XML for sionna.rt.load_scene.")] = False,
    force: Force = False,
) -> None:
    """Look at a site."""
    from .jobs import run

    shown = run.run_site_show(site, out, flight=flight, logs_root=logs_root, pose=pose, export=export, force=force)
    for path in shown:
        print(path)


@app.command("map", help=COMMANDS["map"])
def map_(
    site: Annotated[str, typer.Argument(help="site.yaml, or the name of a packaged site.")] = "lake_wheeler",
    out: Out = None,
    quick: Annotated[bool, typer.Option("--quick", help="A coarse map in seconds: 120 m, three heights.")] = False,
    foliage: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(help="none, attenuating, opaque or all; may be repeated. Default: all."),
    ] = None,
    crown_reflections: Annotated[
        bool, typer.Option("--crown-reflections/--no-crown-reflections", help="Opaque crowns reflect, too.")
    ] = True,
    spacing: Annotated[Optional[float], typer.Option(help="Between positions [m]. Default: 30.")] = None,  # noqa: UP045
    rss_altitude: Annotated[
        Optional[list[float]],  # noqa: UP045
        typer.Option(help="Height of RSS maps [m]; may be repeated. Default: 30, 70, 110."),
    ] = None,
    rank_altitude: Annotated[
        Optional[list[float]],  # noqa: UP045
        typer.Option(help="Height of rank maps [m]; may be repeated. Default: 3 and 30 to 110 by 10."),
    ] = None,
    k: Annotated[
        Optional[list[float]],  # noqa: UP045
        typer.Option("-k", "--k", help="Singular-value ratio; may be repeated. Default: 10, 100, 1000."),
    ] = None,
    carrier_ghz: Annotated[Optional[float], typer.Option(help="Default: 3.4.")] = None,  # noqa: UP045
    engine: Annotated[Optional[str], typer.Option(help="image or sionna.")] = None,  # noqa: UP045
    max_depth: Annotated[Optional[int], typer.Option(min=0, max=3, help="Reflections. Default: 2.")] = None,  # noqa: UP045
    samples: Annotated[Optional[int], typer.Option(min=1, help="Rays per tower, sionna only. Default: 1e6.")] = None,  # noqa: UP045
    flight: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="flight.yaml whose track trains the test 'along a flight'."),
    ] = None,
    logs_root: LogsRoot = None,
    threshold_dbm: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(help="A level below it is out of coverage. Default: only no path is."),
    ] = None,
    study: Annotated[bool, typer.Option("--study/--no-study", help="Correlation and interpolation, too.")] = True,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Coverage and rank maps of a site, Kriging of rank."""
    from .jobs import run

    if engine not in (None, "image", "sionna"):
        raise UsageError(f"--engine {engine!r}", expected="image or sionna")
    modes = None if not foliage or "all" in foliage else tuple(dict.fromkeys(foliage))
    outcome = run.run_map(
        site,
        out=out,
        quick=quick,
        flight=flight,
        logs_root=logs_root,
        force=force,
        progress=_say,
        foliage=modes,
        crown_reflections=crown_reflections,
        spacing_m=spacing,
        rss_altitudes_m=tuple(sorted(set(rss_altitude))) if rss_altitude else None,
        rank_altitudes_m=tuple(sorted(set(rank_altitude))) if rank_altitude else None,
        ks=tuple(sorted(set(k))) if k else None,
        carrier_hz=None if carrier_ghz is None else carrier_ghz * 1e9,
        engine=engine,
        max_depth=max_depth,
        samples=samples,
        threshold_dbm=threshold_dbm,
        study=study,
    )
    if as_json:
        _print_json(outcome.metrics)
        return
    rows = [[p["where"], p["what"], p["paper"], p["ours"]] for p in outcome.metrics["paper"]]
    _table(["where", "what", "paper", "here"], rows, "What the paper states, and what this run gives")
    for path in outcome.files:
        if path.parent == outcome.folder:
            print(path)


@app.command(help=COMMANDS["calibrate"])
def calibrate(
    calibration_yaml: Annotated[Path, typer.Argument(metavar="CALIBRATION", help="calibration.yaml")],
    out: Out = None,
    logs_root: LogsRoot = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Learn antennas and ground from several flights."""
    from .jobs import run

    outcome = run.run_calibrate(calibration_yaml, out=out, logs_root=logs_root, force=force, progress=_say)
    if as_json:
        _print_json(outcome.metrics)
        return
    m = outcome.metrics
    rows = []
    for name, scores in [*m["scores"].items(), *((f"control: {k}", v) for k, v in m["controls"].items())]:
        means = [sum(s[key] for s in scores) / len(scores) if scores else None
                 for key in ("rmse_db", "rmse_4s_db", "free_space_rmse_db")]  # fmt: skip
        rows.append([name.replace("_", " "), *(_number(v, "{:.2f}") for v in means), str(len(scores))])
    if rows:
        heads = ["left out", "RMSE dB", "4 s means dB", "free space dB", "series"]
        _table(heads, rows, "Scores on what was left out, means")
    rows = [
        [split.replace("_", " "), one["flight"], one["tower"], _number(one["kappa"], "{:.3f}"),
         _number(one["agreement"], "{:.3f}"), _number(one["majority_agreement"], "{:.3f}"),
         _number(one["log_score"], "{:.3f}"), _number(one["constant_log_score"], "{:.3f}"),
         _number(one["total_variation_expected"], "{:.3f}")]
        for split, scores in m["rank"].items()
        for one in scores
    ]  # fmt: skip
    if rows:
        heads = ["left out", "flight", "tower", "kappa", "agree", "commonest", "log score", "constant", "TV"]
        _table(heads, rows, "Rank on what was left out")
    for text in [*m["words"], *m["warnings"]]:
        print(text)
    print(outcome.file)
    page = outcome.folder / "calibration.html"
    print(page if page.exists() else outcome.folder)


@app.command(help=COMMANDS["campaign"])
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
    force: Force = False,
    as_json: Json = False,
) -> int:
    """Many flights and settings, with what can be said only of several flights."""
    from .jobs import run

    outcome = run.run_campaign(
        campaign_yaml,
        out=out,
        logs_root=logs_root,
        workers=workers,
        cluster=cluster,
        keep=None if fresh else keep or run.outcomes_folder(),
        force=force,
        progress=_say,
    )
    if as_json:
        _print_json(outcome.metrics)
    else:
        _print_campaign_summary(outcome)
    for check in outcome.failed_checks:
        _say(f"failed: {check}")
    if outcome.nothing_done:
        return 3
    return 1 if strict and outcome.failed_checks else 0


def _print_campaign_summary(outcome: Any) -> None:
    m = outcome.metrics
    names = list(next(iter(m["mean_rmse_db"].values()), {}))
    rows = [[s, *[_number(by[f], "{:.2f}") for f in names]] for s, by in m["mean_rmse_db"].items()]
    if names:
        _table(["setting", *names], rows, "Mean RMSE over towers and channels (dB), own offsets")
    rows = [
        [
            r["setting"],
            r["flight"],
            r["tower"],
            f"{r['k']:g}",
            _number(r["total_variation"], "{:.3f}"),
            _number(r["agreement"], "{:.2f}"),
            _number(r["kappa"], "{:.2f}"),
        ]
        for r in m["rank"]
    ]
    if rows:
        _table(["setting", "flight", "tower", "K", "total variation", "agreement", "kappa"], rows, "Rank")
    rows = [
        [g["setting"], g["group"], _number(g["offset_db"], "{:.1f}"), _number(g["spread_db"], "{:.2f}"),
         _number(g["own_rmse_db"], "{:.2f}"), _number(g["pooled_rmse_db"], "{:.2f}")]
        for g in m["calibration"]["groups"]
    ]  # fmt: skip
    if rows and m["calibration"]["per"] != "link":
        header = ["setting", "group", "offset dB", "spread of own dB", "RMSE own dB", "RMSE shared dB"]
        _table(header, rows, f"Offsets shared per {m['calibration']['per']}")
    rows = [
        [f"{p['tower']} {p['channel']}", f"{p['first']}, {p['second']}", str(p["n"]), _number(p["rmse_db"], "{:.2f}"),
         _number(p["place_correlation"], "{:.2f}")]
        for p in m["repeatability"]["pairs"]
    ]  # fmt: skip
    if rows:
        _table(
            ["link", "flights", "pairs", "differ by dB", "residual corr. by place"], rows, "Same places, two flights"
        )
    rows = [
        [", ".join(fold["fitted_on"]), r["flight"], f"{r['tower']} {r['channel']}",
         "fitted here" if r["fitted_here"] else "transferred", _number(r["start_rmse_db"], "{:.2f}"),
         _number(r["rmse_db"], "{:.2f}"), _number(r["transferred_rmse_db"], "{:.2f}")]
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
        _table(header, rows, "Held-out fit, RMSE")
    for fold in m["held_out"]["folds"]:
        print(
            f"fitted on {', '.join(fold['fitted_on'])}: "
            + ", ".join(f"{k} = {v:g}" for k, v in fold["parameters"].items())
        )
    print(f"report: {outcome.folder / 'campaign.html'}")

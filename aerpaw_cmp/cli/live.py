"""``tap``, ``modem-sim``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal, Optional

import typer

from ..common.errors import UsageError
from .app import Force, Json, command
from .shown import print_files, print_json, say


@command(
    "tap",
    examples=[
        "aerpaw-cmp tap",
        "aerpaw-cmp tap /dev/ttyUSB2 -o taplog --no-csi-alarm 5 --duration 600",
        "aerpaw-cmp tap --replay taplog --no-status",
        "aerpaw-cmp tap -o taplog --export csv",
    ],
)
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
    export: Annotated[
        Optional[Literal["csv"]],  # noqa: UP045
        typer.Option(help="Write the log below OUT as a table and end."),
    ] = None,
    flight: Annotated[Optional[Path], typer.Option(help="flight.yaml: also show the rank the replay predicts.")] = None,  # noqa: UP045
    telemetry: Annotated[Path | None, typer.Option(help="The growing vehicleOut file that --flight follows.")] = None,
    force: Force = False,
    as_json: Json = False,
) -> int:
    """Log the modem's rank indicator until interrupted."""
    if export is not None:
        from ..common.jsonable import json_safe
        from ..live.export import export_csv

        exported = export_csv(out, out / "tap.csv", force=force)
        if as_json:
            print_json(json_safe(exported))
        else:
            print(exported)
        return 0
    _needs_posix("tap")
    from ..common.jsonable import json_safe
    from ..live.log import LogSettings
    from ..live.session import TapSettings, format_status
    from ..live.tap import run_tap

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
        from ..jobs.run import live_prediction

        predict = live_prediction(flight, telemetry)
    terminal = sys.stderr.isatty()
    status = status and not say.quiet

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
    say(
        ("\n" if terminal else "") + f"ended: {summary.reason}; {summary.records} records, {summary.gaps} gaps; {rates}"
    )
    if as_json:
        print_json(json_safe(summary))
    else:
        print_files(summary.segments)
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


@command(
    "modem-sim",
    examples=[
        "aerpaw-cmp modem-sim --link /tmp/modem",
        "aerpaw-cmp modem-sim --source taplog --fault echo=true --fault unplug_every_s=20",
    ],
)
def modem_sim(
    link: Annotated[Optional[Path], typer.Option(help="Symbolic link to the port, kept right.")] = None,  # noqa: UP045
    source: Annotated[
        Path | None, typer.Option(help="What to play: a transcript, a tap log, or any log with ranks.")
    ] = None,
    kind: Annotated[
        Literal["modem", "gps", "diag", "silent", "rubbish"], typer.Option(help="What the port behaves like.")
    ] = "modem",
    fault: Annotated[Optional[list[str]], typer.Option(help="NAME=VALUE, e.g. echo=true, unplug_every_s=20.")] = None,  # noqa: UP045
    as_json: Json = False,
) -> int:
    """Serve a pseudo-terminal that behaves like an RM502Q-AE until interrupted."""
    _needs_posix("modem-sim")
    from ..live.simulator import ModemSimSettings, run_modem_sim

    settings = ModemSimSettings(link=link, source=source, kind=kind, faults=_faults(fault or []))  # type: ignore[arg-type]  # checked there

    def ready(port: object) -> None:
        if as_json:
            print_json({"port": str(port)})
        else:
            print(port, flush=True)

    return run_modem_sim(settings, on_ready=ready)


def _faults(pairs: list[str]) -> Any:
    """Faults from NAME=VALUE pairs."""
    import dataclasses

    from ..live.simulator import Faults

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

"""``tap``, ``modem-sim``."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option
from typer.core import TyperCommand

from ...common.errors import UsageError, one_line
from ...common.text import counted
from ..app import command, output
from ..shown import answered, print_files, say, show

WEB = "127.0.0.1:8765"


class WebCommand(TyperCommand):
    """A command with an option ``--web`` that may be used without an address."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse arguments, with the default address after ``--web`` if no address (a colon and no slash) follows."""
        words = []
        for index, word in enumerate(args):
            words.append(word)
            following = args[index + 1] if index + 1 < len(args) else ""
            if word == "--web" and (":" not in following or "/" in following or following.startswith("-")):
                words.append(WEB)
        return super().parse_args(ctx, words)


@command(
    "tap",
    examples=[
        "aerpaw-cmp tap",
        "aerpaw-cmp tap /dev/ttyUSB2 -o taplog --no-csi-alarm 5 --duration 600",
        "aerpaw-cmp tap /tmp/modem -o taplog --web --flight sample/flight.yaml",
    ],
    kind=WebCommand,
)
def tap(
    port: Annotated[
        list[str] | None, Argument(help="One or more serial ports  [default: the first AT port of a Quectel modem]")
    ] = None,
    out: Annotated[Path, output("Folder of the log segments; with several ports, each port has a subfolder.")] = Path(
        "tap"
    ),
    status: Annotated[bool, Option("--status/--no-status", help="Show a status line on standard error.")] = True,
    enable_csi: Annotated[bool, Option("--enable-csi", help="Switch CSI reporting on; restored on exit.")] = False,
    ri_hz: Annotated[float, Option(help="Rate at which the rank indicator is queried [Hz].")] = 2.0,
    no_csi_alarm: Annotated[
        float | None, Option(help="Ring the terminal bell after this many seconds without CSI.")
    ] = None,
    duration: Annotated[float | None, Option(help="Stop after this many seconds.")] = None,
    web: Annotated[
        str | None,
        Option(help=f"Also serve a page of the flight, protected by a token, at HOST:PORT [default: {WEB}]."),
    ] = None,
    flight: Annotated[Path | None, Option(help="flight.yaml for which rank and level are also predicted.")] = None,
    telemetry: Annotated[Path | None, Option(help="Growing vehicleOut log with the poses for --flight.")] = None,
) -> int:
    """Log the modem's rank indicator until interrupted."""
    _needs_posix("tap")
    from ...common.jsonable import json_safe

    if telemetry is not None and flight is None:
        raise UsageError("--telemetry without --flight", expected="--flight FILE, the flight that has this telemetry")
    from ...jobs.live_tap import Shown, tap_modems
    from ...live.ports import TapSettings

    shown = Shown(web=web, flight=flight, telemetry=telemetry, say=say)
    settings = TapSettings(
        folder=out, ri_hz=ri_hz, enable_csi=enable_csi, no_csi_alarm_s=no_csi_alarm, duration_s=duration
    )
    line = StatusLine(status and not say.quiet)
    summaries = tap_modems(settings, port or [None], shown, on_status=line)
    for summary in summaries:
        rates = ", ".join(f"{name} {rate:.2f} Hz" for name, rate in summary.rates_hz.items())
        lost = (
            f", {counted(summary.lost_records, 'record')} lost (the disk could not store them)"
            if summary.lost_records
            else ""
        )
        say(
            f"{line.end}ended: {summary.reason}; {counted(summary.records, 'record')}{lost}, "
            f"{counted(summary.gaps, 'gap')}; {rates}"
        )
    if not answered(json_safe(summaries[0] if len(summaries) == 1 else {"modems": summaries})):
        print_files([path for summary in summaries for path in summary.segments])
    return max(summary.exit_code for summary in summaries)


class StatusLine:
    """The status line of the modems on standard error. On a terminal, each new status overwrites the previous one."""

    def __init__(self, enabled: bool) -> None:
        self._enabled, self._terminal = enabled, sys.stderr.isatty()
        self._lines: dict[str, str] = {}

    @property
    def end(self) -> str:
        """Return the text that ends the status line: a line break on a terminal, else empty."""
        return "\n" if self._terminal else ""

    def __call__(self, name: str, now: Any) -> None:
        """Show the status of a modem. The name is empty if there is only one modem."""
        from ...live.ports import format_status

        head = f"{name}: " if name else ""
        if now.message:
            # "\r\033[K" moves the cursor to the beginning of the line, and clears the line
            print(("\r\033[K" if self._terminal else "") + one_line(head + now.message), file=sys.stderr, flush=True)
        self._lines[name] = one_line(head + format_status(now))
        if self._enabled and self._terminal:
            print("\r\033[K" + " | ".join(self._lines.values()), end="", file=sys.stderr, flush=True)
        elif self._enabled:
            print(self._lines[name], file=sys.stderr, flush=True)
        if now.alarm:
            # "\a" rings the terminal's bell
            print("\a", end="", file=sys.stderr, flush=True)


def _needs_posix(command: str) -> None:
    """Raise UsageError on a system without termios, fcntl and pty, which are needed to open and lock ports."""
    import importlib

    for name in ("fcntl", "termios", "pty"):
        try:
            importlib.import_module(name)
        except ImportError:
            raise UsageError(
                f"'{command}' needs Python's {name}, which this system does not have",
                expected="Linux (another POSIX system may do)",
                cause="Windows; logs recorded by a tap can be read on any system",
            ) from None


@command(
    "modem-sim",
    examples=[
        "aerpaw-cmp modem-sim --link /tmp/modem",
        "aerpaw-cmp modem-sim --link demo/modem --flight sample/flight.yaml --telemetry demo/vehicleOut.txt",
    ],
)
def modem_sim(
    link: Annotated[Path | None, Option(help="Symbolic link to the port, updated when the port changes.")] = None,
    flight: Annotated[
        Path | None,
        Option(help="flight.yaml of a flight to repeat in real time, with its ranks; requires --telemetry."),
    ] = None,
    telemetry: Annotated[
        Path | None, Option(help="New telemetry file for --flight; it grows during the flight.")
    ] = None,
) -> int:
    """Serve a pseudo-terminal that behaves like an RM502Q-AE until interrupted."""
    _needs_posix("modem-sim")
    from ...live.ports import Stop
    from ...live.simulator import FlightModem, ModemSimulator

    if (flight is None) != (telemetry is None):
        raise UsageError(
            "--flight and --telemetry are only valid together", expected="the flight and its new telemetry file"
        )
    flown = None
    if flight is not None and telemetry is not None:
        from ...jobs.live_twin import FlownAgain

        flown = FlownAgain(flight, telemetry)
    modem = FlightModem() if flown is None else FlightModem(flown.rank, rsrp=flown.rsrp)
    with Stop() as stop, ModemSimulator(modem, link=link) as simulator:
        if not answered({"port": str(simulator.port)}):
            show(simulator.port)
        while not stop.count:
            time.sleep(0.1)
            if flown is not None:
                flown()
    return 0

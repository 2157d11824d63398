"""``tap`` as a job: one modem or several, with a page where it is wanted."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shlex
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ...common.counting import counted
from ...live.feed import Feed
from ...live.session import TapSettings, TapStatus, TapSummary
from ...live.stop import Stop
from ...live.tap import run_tap

# Environment variable with the token of a page beyond the loopback: so that it outlives a restart of the tap.
TOKEN = "AERPAW_CMP_WEB_TOKEN"


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """The page and the prediction that a tap shows.

    Parameters
    ----------
    web : str, optional
        HOST:PORT of the page; None: no page.
    flight, telemetry : Path, optional
        flight.yaml that predicts, and the growing telemetry log.
    say : callable
        Gets a line for the terminal.
    """

    web: str | None
    flight: Path | None
    telemetry: Path | None
    say: Callable[[str], None]


def tap_modems(
    settings: TapSettings, ports: Sequence[str | None], shown: Shown, on_status: Callable[[str, TapStatus], None]
) -> list[TapSummary]:
    """Tap one modem or several until a signal or the set time ends it.

    Parameters
    ----------
    settings : TapSettings
        Of each; ``port`` and, of several, a folder in ``folder`` are set here.
    ports : sequence of str or None
        None: the first AT port of a Quectel modem.
    shown : Shown
    on_status : callable
        Gets the name of the modem (empty where there is only one) and its status.

    Returns
    -------
    list of TapSummary
        In the order of the ports.

    Raises
    ------
    InputError, UsageError
        If a port, the folder or the page's address cannot be used, at the start.
    """
    names = _names([port or "modem" for port in ports])
    twin = _twin(shown)
    stop = Stop()
    with contextlib.ExitStack() as stack:
        stack.callback(stop.close)
        feed = None
        if shown.web is not None:
            feed = Feed(names)
            _serve(stack, feed, twin, shown, ", ".join(names))
        stack.enter_context(stop.on_signals())  # nothing is logged before, so nothing has to end in order
        sessions = []
        for number, (port, name) in enumerate(zip(ports, names, strict=True)):
            alone = len(ports) == 1
            each = dataclasses.replace(settings, port=port, folder=settings.folder if alone else settings.folder / name)
            sessions.append(
                partial(
                    run_tap,
                    each,
                    on_status=partial(on_status, "" if alone else name),
                    watch=None if feed is None else partial(feed.put, number),
                    stop=stop,
                    predict=None if twin is None else twin.predictor(),
                )
            )
        summaries = [sessions[0]()] if len(sessions) == 1 else _together(sessions, stop)
        if feed is not None:
            feed.end(_ended(settings.folder, summaries, twin))
    return summaries


def _twin(shown: Shown) -> Any:
    if shown.flight is None:
        return None
    from .live_twin import LiveTwin

    return LiveTwin.of(shown.flight, shown.telemetry)


def _serve(stack: contextlib.ExitStack, feed: Feed, twin: Any, shown: Shown, title: str) -> None:
    """Build the page, serve it as long as the stack lasts, and say where."""
    from ...live.web import Address, Page, WebServer
    from ...report.pages.live import live_page

    address = Address.parse(shown.web or "")
    background = None if twin is None else twin.map()
    page = Page(*live_page(background, title if background is None else background.title))
    server = stack.enter_context(WebServer(feed, page, address, token=os.environ.get(TOKEN)))
    known = f"  (... is the value of {TOKEN})" if os.environ.get(TOKEN) else ""
    shown.say("the page: " + "  ".join(server.urls) + known)


def _together(sessions: Sequence[Callable[[], TapSummary]], stop: Stop) -> list[TapSummary]:
    """Run sessions at once, each in its thread; the first fault at a start ends all."""
    results: list[TapSummary | BaseException | None] = [None] * len(sessions)

    def run(number: int) -> None:
        try:
            results[number] = sessions[number]()
        # whatever ends one session ends all, and the main thread raises it again
        except BaseException as error:
            results[number] = error
            stop("error")

    threads = [threading.Thread(target=run, args=(number,), name=f"tap-{number}") for number in range(len(sessions))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for result in results:
        if isinstance(result, BaseException):
            raise result
    return [result for result in results if isinstance(result, TapSummary)]


def _names(paths: Sequence[str]) -> list[str]:
    """Short names, each once."""
    names = [Path(path).name or path for path in paths]
    return [name if names.count(name) == 1 else f"{name}-{number}" for number, name in enumerate(names, 1)]


def _ended(folder: Path, summaries: Sequence[TapSummary], twin: Any) -> dict[str, Any]:
    records, gaps = sum(s.records for s in summaries), sum(s.gaps for s in summaries)
    lost = sum(s.lost_records for s in summaries)
    at = time.strftime("%H:%M:%S", time.gmtime())
    counts = f"{counted(records, 'record')}, {counted(gaps, 'gap')}" + (
        f", {counted(lost, 'record')} lost" if lost else ""
    )
    text = f"The tap ended at {at} UTC ({summaries[0].reason}): {counts}. The log is in {folder}."
    return {"text": text, "commands": _report_commands(folder, twin)}


def _report_commands(folder: Path, twin: Any) -> list[str]:
    """Commands that make the report of a tapped flight."""
    log = shlex.quote(str(folder))
    telemetry = "VEHICLEOUT_LOG" if twin is None else shlex.quote(str(twin.telemetry))
    zone = "ZONE" if twin is None else twin.settings.timezone
    return [
        f"aerpaw-cmp ingest {log} {telemetry} --timezone {zone} --draft flight.yaml",
        "aerpaw-cmp report flight.yaml",
    ]

"""The ``tap`` job: one modem or several, and the live page."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ..common.errors import typed
from ..common.text import counted
from ..live.feed import Feed
from ..live.ports import Stop, TapSettings, TapStatus, TapSummary
from ..live.tap import Tap

# Environment variable with the token of a page that is served beyond the loopback. With it, the token is the same after
# a restart.
TOKEN = "AERPAW_CMP_WEB_TOKEN"


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """The page and the prediction that a tap shows.

    Parameters
    ----------
    web : str, optional
        HOST:PORT of the page. None means no page.
    flight, telemetry : Path, optional
        flight.yaml of the prediction, and the growing telemetry log.
    say : callable
        Receives a line for the terminal.
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
        Settings of each modem. This function sets ``port`` and, for several modems, a subfolder of ``folder``.
    ports : sequence of str or None
        None means the first AT port of a Quectel modem.
    shown : Shown
    on_status : callable
        Receives the name of the modem (empty if there is only one) and its status.

    Returns
    -------
    list of TapSummary
        One summary per port, in the order of the ports.

    Raises
    ------
    InputError, UsageError
        If a port, the folder or the page's address cannot be used, at the start.
    """
    names = _names([port or "modem" for port in ports])
    twin = None
    if shown.flight is not None:
        from .live_twin import LiveTwin

        twin = LiveTwin.of(shown.flight, shown.telemetry)
    with contextlib.ExitStack() as stack:
        feed = None
        if shown.web is not None:
            feed = Feed(names)
            _serve(stack, feed, twin, shown, ", ".join(names))
        stop = stack.enter_context(Stop())  # an earlier signal ends the process, because no log is open yet
        alone = len(ports) == 1
        # create predictors one after the other, because each of them replays the planned route
        predictors = [None if twin is None else twin.predictor() for _ in ports]

        def session(number: int) -> TapSummary:
            folder = settings.folder if alone else settings.folder / names[number]
            return Tap(
                dataclasses.replace(settings, port=ports[number], folder=folder),
                stop,
                on_status=partial(on_status, "" if alone else names[number]),
                watch=None if feed is None else partial(feed.put, number),
                predict=predictors[number],
            ).run()

        summaries = [session(0)] if alone else _together(session, len(ports), stop)
        if feed is not None:
            feed.end(_ended(settings.folder, summaries, twin))
    return summaries


def _serve(stack: contextlib.ExitStack, feed: Feed, twin: Any, shown: Shown, title: str) -> None:
    """Build the page, print its address, and serve the page until ``stack`` is closed."""
    from ..live.web import Address, Page, WebServer
    from ..report.live import live_page

    address = Address.parse(shown.web or "")
    if twin is not None:
        title = twin.settings.flight.title or twin.settings.flight.name
    page = Page(*live_page(None if twin is None else twin.map(), title))
    server = stack.enter_context(WebServer(feed, page, address, token=os.environ.get(TOKEN)))
    known = f"  (... is the value of {TOKEN})" if os.environ.get(TOKEN) else ""
    shown.say("the page: " + "  ".join(server.urls) + known)


def _together(session: Callable[[int], TapSummary], count: int, stop: Stop) -> list[TapSummary]:
    """Run sessions in parallel threads. An error in one session ends all sessions."""

    def run(number: int) -> TapSummary:
        try:
            return session(number)
        except BaseException:
            stop("error")
            raise

    with ThreadPoolExecutor(count, "tap") as threads:
        return list(threads.map(run, range(count)))


def _names(paths: Sequence[str]) -> list[str]:
    """Return short, unique names for the ports of several modems."""
    names = [Path(path).name or path for path in paths]
    return [name if names.count(name) == 1 else f"{name}-{number}" for number, name in enumerate(names, 1)]


def _ended(folder: Path, summaries: Sequence[TapSummary], twin: Any) -> dict[str, Any]:
    """Return the text and the commands that the page shows after the tap has ended."""
    records, gaps = sum(s.records for s in summaries), sum(s.gaps for s in summaries)
    lost = sum(s.lost_records for s in summaries)
    at = time.strftime("%H:%M:%S", time.gmtime())
    counts = f"{counted(records, 'record')}, {counted(gaps, 'gap')}" + (
        f", {counted(lost, 'record')} lost" if lost else ""
    )
    text = f"The tap ended at {at} UTC ({summaries[0].reason}): {counts}. The log is in {folder}."
    telemetry = "VEHICLEOUT_LOG" if twin is None else typed(twin.telemetry)
    zone = "ZONE" if twin is None else twin.settings.timezone
    ingest = f"aerpaw-cmp ingest {typed(folder)} {telemetry} --timezone {zone} --draft flight.yaml"
    return {"text": text, "commands": [ingest, "aerpaw-cmp report flight.yaml"]}

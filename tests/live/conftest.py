"""A tap on a simulated modem, on a real pseudo-terminal, in this process or in its own."""

import contextlib
import json
import socket
import threading
import time

import pytest

from aerpaw_cmp.live.feed import Feed
from aerpaw_cmp.live.modem import QUERIES
from aerpaw_cmp.live.ports import Stop, TapSettings
from aerpaw_cmp.live.tap import Tap
from aerpaw_cmp.live.web import Address, Limits, Page, WebServer
from benchmarks.simulated_modem import BadLine, FaultyModem, read_log
from tests.long.tap_common import free_port, start_tap

PAGE = Page(b"<!doctype html><title>t</title>", "default-src 'none'")


class Browser:
    """A browser that reads the events of a page or accepts nothing. It reconnects when it is dropped."""

    @classmethod
    def of(cls, web, *, reads=True):
        return cls(web.address.port, web.token, reads=reads)

    def __init__(self, port, token, *, reads=True):
        self.messages, self.connections, self._cursor = [], 0, ""
        self._port, self._token, self._reads, self._stop = port, token, reads, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        while not self._stop.wait(0.05):
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self._port), 5) as link:
                link.sendall(
                    f"GET /events?token={self._token}&from={self._cursor} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()
                )
                self.connections += 1
                self._read(link)

    def _read(self, link):
        if not self._reads:
            self._stop.wait()
            return
        link.settimeout(0.5)
        for line in link.makefile("r", encoding="ascii"):
            if line.startswith("id: "):
                self._cursor = line[4:].strip()
            elif line.startswith("data: "):
                self.messages.append(json.loads(line[6:]))

    def close(self):
        self._stop.set()
        self._thread.join(timeout=5)


@pytest.fixture(params=["alone", "web"])
def web(request):
    """Return whether a page is open at the same time: one browser that reads it and one that does not."""
    return request.param == "web"


@contextlib.contextmanager
def page_open(wanted):
    """Yield a feed with its server and two browsers, or None if no page is wanted."""
    if not wanted:
        yield None
        return
    feed = Feed(["modem"])
    with WebServer(feed, PAGE, Address("127.0.0.1", 0), limits=Limits(send_s=0.5)) as server:
        browsers = [Browser.of(server), Browser.of(server, reads=False)]
        yield feed
        feed.digest()
        until = time.monotonic() + 5
        while not browsers[0].messages and time.monotonic() < until:
            time.sleep(0.02)
        for browser in browsers:
            browser.close()
    assert browsers[0].messages


class Session:
    """A tap that runs in a thread of the test."""

    def __init__(self, settings, **options):
        self.stop = Stop()
        self.said = []
        self.statuses = []
        self.error = None
        self.summary = None
        self._settings, self._options = settings, options
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _status(self, status):
        self.statuses.append(status)
        if status.message:
            self.said.append(status.message)

    def _run(self):
        try:
            self.summary = Tap(self._settings, self.stop, on_status=self._status, **self._options).run()
        except Exception as error:
            self.error = error

    def end(self):
        self.stop("test")
        self._thread.join(timeout=20)
        assert not self._thread.is_alive()
        self.stop.close()
        if self.error is not None:
            raise self.error
        return self.summary

    def wait(self, condition, timeout=15.0):
        """Wait until the condition is true, and fail the test if it never is."""
        until = time.monotonic() + timeout
        while not condition():
            assert self.error is None, self.error
            assert time.monotonic() < until, f"never came; said {self.said}"
            time.sleep(0.02)


def records_of(folder):
    bad: list[BadLine] = []
    if not any(folder.glob("tap_*.jsonl")):  # the tap may not have come so far
        return [], bad
    return list(read_log(folder, bad)), bad


def exchanges(folder, query=None):
    return [r for r in records_of(folder)[0] if r["kind"] == "exchange" and query in (None, r["query"])]


def all_kept(sim, folder, query="nr5g_csi"):
    """Return the logged answers. Each answer that was read must be there once, in order, and no others."""
    command = QUERIES[query].text
    logged = []
    for r in records_of(folder)[0]:
        own = r["kind"] == "exchange" and r["query"] == query and r["status"] == "ok"
        if own or (r["kind"] == "late" and r["lines"] and f'"{query}"' in r["lines"][0]):
            logged.append(tuple(r["lines"]))
    assert logged == [s.lines for s in sim.journal if s.command == command][: len(logged)]
    assert len(logged) >= sum(s.read for s in sim.journal if s.command == command)
    return logged


@pytest.fixture
def tools():
    class Tools:
        pass

    tools = Tools()
    tools.Session, tools.records_of, tools.exchanges = Session, records_of, exchanges
    tools.all_kept, tools.Browser, tools.page_open, tools.page = all_kept, Browser, page_open, PAGE
    return tools


@pytest.fixture
def modem(tmp_path):
    """Return a function that makes simulated modems. All of them end with the test."""
    with contextlib.ExitStack() as stack:

        def make(**settings):
            settings.setdefault("link", tmp_path / "modem")
            return stack.enter_context(FaultyModem(**settings))

        yield make


@pytest.fixture
def tap(tmp_path, request):
    """Return a function that makes taps with fast settings on a port. Those that still run are ended with the test."""
    running = []
    pages = contextlib.ExitStack()
    feed = pages.enter_context(page_open("web" in request.fixturenames and request.getfixturevalue("web")))

    def make(port, *, options=None, **settings):
        values = {
            "ri_hz": 20.0, "other_hz": 2.0, "pause_s": 0.0, "status_s": 0.1, "probe_timeout_s": 3.0,
            "folder": tmp_path / "log",
        } | settings  # fmt: skip
        watch = {} if feed is None else {"watch": lambda item: feed.put(0, item)}
        session = Session(TapSettings(port=None if port is None else str(port), **values), **watch, **(options or {}))
        running.append(session)
        return session

    yield make
    for session in running:
        if session._thread.is_alive():
            session.stop("test over")
            session.stop("test over")
            session._thread.join(timeout=10)
    pages.close()


@pytest.fixture
def child(tmp_path, request):
    """Makes taps in their own processes."""
    processes, browsers = [], []
    watched = "web" in request.fixturenames and request.getfixturevalue("web")

    def make(port, **settings):
        values = {"folder": tmp_path / "log", "ri_hz": 20.0, "other_hz": 2.0, "pause_s": 0.0} | settings
        if watched:
            values["web"] = free_port()
            browsers.append(Browser(values["web"], "benchmark"))
        processes.append(start_tap(port, **values))
        return processes[-1]

    yield make
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()
    for browser in browsers:
        browser.close()
        assert browser.messages

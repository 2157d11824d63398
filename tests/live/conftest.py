"""A tap on a simulated modem, on a real pseudo-terminal, in this process or in its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from aerpaw_cmp.live.log import BadLine, read_log
from aerpaw_cmp.live.modem import QUERIES
from aerpaw_cmp.live.simulator import ModemSimSettings, ModemSimulator
from aerpaw_cmp.live.tap import Stop, TapSettings, run_tap

CHILD = """
import json, sys
from pathlib import Path
from aerpaw_cmp.common.errors import AerpawCmpError
from aerpaw_cmp.live.log import LogSettings
from aerpaw_cmp.live.tap import TapSettings, run_tap
values = json.loads(sys.argv[1])
log = LogSettings(**values.pop("log", {}))
print("ready", flush=True)
try:
    summary = run_tap(TapSettings(folder=Path(values.pop("folder")), log=log, **values))
except AerpawCmpError as error:
    print(error, file=sys.stderr)
    sys.exit(error.exit_code)
print(summary.reason, flush=True)
sys.exit(summary.exit_code)
"""


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
            self.summary = run_tap(self._settings, on_status=self._status, stop=self.stop, **self._options)
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
        """Poll until the condition holds; fails the test if it never does."""
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
    """Every answer that the modem saw read stands in the log once, in order, and nothing that it did not send."""
    command = QUERIES[query].text
    kept = []
    for r in records_of(folder)[0]:
        own = r["kind"] == "exchange" and r["query"] == query and r["status"] == "ok"
        if own or (r["kind"] == "late" and r["lines"] and f'"{query}"' in r["lines"][0]):
            kept.append(tuple(r["lines"]))
    assert kept == [s.lines for s in sim.journal if s.command == command][: len(kept)]
    assert len(kept) >= sum(s.read for s in sim.journal if s.command == command)
    return kept


@pytest.fixture
def tools():
    class Tools:
        pass

    tools = Tools()
    tools.Session, tools.records_of, tools.exchanges = Session, records_of, exchanges
    tools.all_kept = all_kept
    return tools


@pytest.fixture
def modem(tmp_path):
    """Makes simulators; all end with the test."""
    import contextlib

    with contextlib.ExitStack() as stack:

        def make(**settings):
            settings.setdefault("link", tmp_path / "modem")
            return stack.enter_context(ModemSimulator(ModemSimSettings(**settings)))

        yield make


@pytest.fixture
def tap(tmp_path):
    """Makes taps with fast settings on a port; what still runs is ended with the test."""
    running = []

    def make(port, *, options=None, **settings):
        values = {
            "ri_hz": 20.0,
            "other_hz": 2.0,
            "pause_s": 0.0,
            "status_s": 0.1,
            "probe_timeout_s": 3.0,
            "folder": tmp_path / "log",
        } | settings
        session = Session(TapSettings(port=str(port), **values), **(options or {}))
        running.append(session)
        return session

    yield make
    for session in running:
        if session._thread.is_alive():
            session.stop("test over")
            session.stop("test over")
            session._thread.join(timeout=10)


@pytest.fixture
def child(tmp_path):
    """Makes taps in their own processes."""
    processes = []
    root = Path(__file__).resolve().parents[2]

    def make(port, *, popen=None, **settings):
        values = {"port": str(port), "folder": str(tmp_path / "log"), "ri_hz": 20.0, "other_hz": 2.0, "pause_s": 0.0}
        values |= settings
        environment = os.environ | {"PYTHONPATH": f"{root}{os.pathsep}{root / 'parsers'}"}
        process = subprocess.Popen(
            [sys.executable, "-c", CHILD, json.dumps(values)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            cwd="/",
            **(popen or {}),
        )
        processes.append(process)
        return process

    yield make
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()

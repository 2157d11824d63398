"""Common parts of the long tests of the tap: a tap in a separate process on a simulated modem."""

import json
import os
import platform
import random
import socket
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

CSI = 'AT+QNWCFG="nr5g_csi"'

CHILD = """
import json, sys
from pathlib import Path
from aerpaw_cmp.common.errors import AerpawCmpError
from aerpaw_cmp.live.log import LogSettings
from aerpaw_cmp.live.ports import TapSettings
from tests.long.tap_common import run_tap
values = json.loads(sys.argv[1])
log = LogSettings(**values.pop("log", {}))
show = values.pop("show_status", False)
if capture := values.pop("capture", None):  # a copy of what the kernel gives, a file per opening of the port
    import itertools
    from aerpaw_cmp.live.ports import SerialPort
    numbers, opened, read = itertools.count(), SerialPort.__init__, SerialPort.read

    def begin(self, *arguments):
        opened(self, *arguments)
        self.copy = open(f"{capture}-{next(numbers):06}.bin", "ab", buffering=0)

    def copied(self, *arguments):
        data = read(self, *arguments)
        self.copy.write(data)
        return data

    SerialPort.__init__, SerialPort.read = begin, copied
watch = None
if web := values.pop("web", None):  # a page at this port
    from aerpaw_cmp.live.feed import Feed
    from aerpaw_cmp.live.web import Address, Page, WebServer
    from aerpaw_cmp.report.live import live_page
    feed = Feed(["modem"])
    WebServer(feed, Page(*live_page(None, "benchmark")), Address("127.0.0.1", web), token="benchmark").__enter__()
    watch = lambda item: feed.put(0, item)
try:
    summary = run_tap(TapSettings(folder=Path(values.pop("folder")), log=log, **values),
                      on_status=(lambda status: None) if show else None, watch=watch)
except AerpawCmpError as error:
    print(error, file=sys.stderr)
    sys.exit(error.exit_code)
print(json.dumps({"answers": summary.answers, "rates_hz": summary.rates_hz, "missed": summary.missed,
                  "gaps": summary.gaps, "gap_s": summary.gap_s, "duration_s": summary.duration_s,
                  "records": summary.records, "lost_records": summary.lost_records, "reason": summary.reason}))
sys.exit(summary.exit_code)
"""


def run_tap(settings: Any, **options: Any) -> Any:
    """A tap in this process, until its set time or a signal ends it."""
    from aerpaw_cmp.live.ports import Stop
    from aerpaw_cmp.live.tap import Tap

    with Stop() as stop:
        return Tap(settings, stop, **options).run()


def start_tap(port: Path, folder: Path, **settings: Any) -> subprocess.Popen[str]:
    """Start a tap in a separate process, which prints its summary as JSON."""
    values = {"port": str(port), "folder": str(folder), **settings}
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'parsers'}"}
    command = [sys.executable, "-c", CHILD, json.dumps(values)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


BROWSER = """
import base64, json, signal, socket, struct, sys, time
port, rows, holes, delays, connections, cursor, ended = int(sys.argv[1]), 0, 0, [], 0, "", []
signal.signal(signal.SIGTERM, lambda *_: ended.append(1))
while not ended:
    try:
        with socket.create_connection(("127.0.0.1", port), 2) as link:
            link.settimeout(1.5)
            target = f"/events?token=benchmark&from={cursor}"
            link.sendall(f"GET {target} HTTP/1.1\\r\\nHost: 127.0.0.1\\r\\n\\r\\n".encode())
            connections += 1
            for line in link.makefile("r"):
                if line.startswith("id: "):
                    cursor = line[4:].strip()
                elif line.startswith("data: "):
                    message = json.loads(line[6:])
                    first, data = message["modems"][0]["rows"]
                    values = struct.iter_unpack("<4f", base64.b64decode(data))
                    times = [message["start_ms"] / 1e3 + value[0] for value in values]
                    holes += first != rows
                    rows = first + len(times)
                    delays += [time.time() - times[-1]] if len(times) else []
                if ended:
                    break
    except OSError:
        time.sleep(0.2)
delays.sort()
print(json.dumps({"rows": rows, "holes": holes, "connections": connections,
                  "median_s": delays[len(delays) // 2] if delays else None,
                  "p99_s": delays[int(0.99 * (len(delays) - 1))] if delays else None}))
"""


def start_browser(port: int) -> subprocess.Popen[str]:
    """Start a reader of the page's events in a separate process. On SIGTERM it prints what it received."""
    return subprocess.Popen([sys.executable, "-c", BROWSER, str(port)], stdout=subprocess.PIPE, text=True)


def damaged(chance: random.Random) -> bytes:
    """A request that is damaged in one of many ways."""
    request = bytearray(
        b"GET /events?token=benchmark&from=00000000-1-2-3 HTTP/1.1\r\nHost: 127.0.0.1\r\nLast-Event-ID: 1\r\n\r\n"
    )
    kind = chance.randrange(5)
    if kind == 0:
        return bytes(chance.randrange(256) for _ in range(chance.randrange(600))) + b"\r\n\r\n"
    if kind == 1:
        return bytes(request[: chance.randrange(len(request))])
    if kind == 2:
        many = b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * chance.choice([50, 2000])
        return chance.choice([b"GET /" + b"a" * 70_000, many]) + b"\r\n\r\n"
    if kind == 3:
        parts = [b"/", b"..", b"%2e%2e", b"%00", b"etc", b"passwd", b"?token=", b"&", b"[", b"\\", b"events", b"\xff"]
        return (
            b"GET "
            + b"".join(chance.choice(parts) for _ in range(10))
            + b"?token=benchmark HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
        )
    for _ in range(chance.randrange(1, 12)):
        request[chance.randrange(len(request))] = chance.randrange(256)
    return bytes(request) + b"\r\n\r\n"


def free_port() -> int:
    """Return a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def cpu_s(pid: int) -> float:
    """User and system time of a process and its threads so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def read_lines(journal: Iterable[Any]) -> list[tuple[str, tuple[str, ...]]]:
    """Command and lines of the answers that the simulator saw read to the end."""
    return [(served.command, served.lines) for served in list(journal) if served.read]


def resident_kib(pid: int) -> int:
    """Return the resident memory of a process [KiB], or 0 if it ended."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    return 0


def conditions() -> dict[str, object]:
    """Return the conditions that the numbers depend on."""
    load = [round(x, 2) for x in os.getloadavg()]
    return {"python": platform.python_version(), "kernel": platform.release(), "cores": os.cpu_count(), "load": load}


def show(result: dict[str, object], as_json: bool) -> None:
    """Print a result."""
    if as_json:
        print(json.dumps(result))
        return
    for key, value in result.items():
        print(f"{key:28} {value}")

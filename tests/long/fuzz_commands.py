"""Run random command lines: none may end with exit code 70 or a traceback, without a message, or never.

    python -m tests.long.fuzz_commands [--calls 10000] [--seed 1]

Each call is a fork of this process, so that imports are paid for once. These parts of a call are random:

- the command, and the spelling of every path (relative, absolute, ``..``, links, members of archives, odd and impossible
  names);
- the working folder, which may have been removed;
- the standard descriptors (closed, full, a pipe without a reader);
- a signal at a random moment.

The script prints the exit codes, and each violation with the options that repeat it (``--seed N --only CALL``).

A call must end within its time, with a code of the table in ``aerpaw_cmp/__main__.py`` other than 70. If the code is not
0 and standard error is open, the call must print the reason. It must leave no hidden file next to an output.
"""

import argparse
import collections
import gzip
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path

SAMPLE = Path(__file__).resolve().parents[2] / "sample_logs"
LOGS = ("UAV/2025-06-01_10_00_00_vehicleOut.txt", "UAV/modem_ri.csv", "LW1/USRP1_power_log.txt")
LINES = 30
CODES = {0, 1, 2, 3, 141}
# On a busy machine a call may wait for half a minute.
SECONDS = 120.0
ODD = "ol d\n\udcff"
INSIDE = ("logs", "set.zip", "empty", "link.txt", "nowhere", "round", "flight.yaml", "bad.yaml", "campaign.yaml", ODD,
          "missing.txt", "set.zip/modem_ri.csv", "set.zip/abs/modem_ri.csv", "set.zip/../modem_ri.csv",
          "logs/modem_ri.csv/x")  # fmt: skip
ALONE = ("", ".", "..", "/", "-", "--", "~", "/dev/null", "/proc/self/mem", "n" * 300, "a\nb", "\udc80", "%s", "*")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True, slots=True)
class Call:
    """A command line and the state of the process that runs it."""

    words: list[str]
    folder: str
    descriptors: tuple[str, str, str]
    by: int
    """Signal that is sent, 0 for none."""
    after_s: float


def furnish(root: Path) -> None:
    """Files of all kinds below a folder."""
    for name in ("logs", "out", "empty", ODD, "gone"):
        (root / name).mkdir()
    pieces = {Path(name).name: b"".join((SAMPLE / name).read_bytes().splitlines(True)[:LINES]) for name in LOGS}
    for name, data in pieces.items():
        (root / "logs" / name).write_bytes(data)
        (root / ODD / name).write_bytes(data)
        (root / "logs" / f"{name}.gz").write_bytes(gzip.compress(data))
    with zipfile.ZipFile(root / "set.zip", "w") as book:
        for name, data in pieces.items():
            for spelt in (name, f"/abs/{name}", f"../{name}", f"a/./{name}", f"a//{name}"):
                book.writestr(spelt, data)
    (root / "logs" / "junk.bin").write_bytes(bytes(range(256)))
    (root / "logs" / "none.txt").write_bytes(b"")
    (root / "link.txt").symlink_to(root / "logs" / "modem_ri.csv")
    (root / "nowhere").symlink_to("no/such/place")
    (root / "round").symlink_to("round")
    os.mkfifo(root / "fifo")
    shutil.copy(SAMPLE / "flight.yaml", root / "flight.yaml")
    (root / "campaign.yaml").write_text("campaign: c\nflights: [flight.yaml]\n")
    (root / "bad.yaml").write_text("flight: [\n")


def spelling(draw: random.Random, root: Path, folder: str) -> str:
    """A path in one of the ways a person, a script or an accident writes it."""
    inside = [*INSIDE, *(f"logs/{path.name}" for path in (root / "logs").iterdir())]
    name = draw.choice(sorted(inside))
    ways: list[Callable[[], str]] = [
        lambda: str(root / name),
        lambda: os.path.relpath(root / name, folder) if Path(folder).is_dir() else name,
        lambda: f"./{name}",
        lambda: f"{root}//logs/../{name}",
        lambda: f"//{root}/{name}",
        lambda: f"{name}/",
        lambda: draw.choice(ALONE),
    ]
    return draw.choices(ways, [6, 6, 2, 1, 1, 1, 1])[0]()


def drawn(draw: random.Random, root: Path) -> Call:
    """A call by chance."""
    folders = [root, root / "logs", "/", root / "gone", root / ODD]
    folder = str(draw.choices(folders, [5, 3, 1, 1, 1])[0])

    def path() -> str:
        return spelling(draw, root, folder)

    def ingest() -> list[str]:
        words = ["ingest", *([str(root / "fifo")] if draw.random() < 0.02 else [])]
        words += [*(path() for _ in range(draw.randint(1, 4))), "--timezone", "America/New_York"]
        if draw.random() < 0.5:
            words += ["-o", draw.choice([path(), str(root / "out" / "f.h5"), "f.h5", str(root / "no" / "f.h5")])]
        if draw.random() < 0.2:
            words += ["--draft", draw.choice([path(), str(root / "out" / "flight.yaml")])]
        return words + draw.choice([[], [], ["--force"], ["--json"], ["-q"], ["--reader", "quectel_ri"]])

    jobs = ["report", "simulate", "campaign", "calibrate", "map"]
    lines: list[Callable[[], list[str]]] = [
        ingest,
        lambda: draw.choice([[], ["--help"], ["--version"], ["formats"], ["formats", "--json"], ["reprot"], [path()]]),
        lambda: [draw.choice(jobs), path(), "--dry-run", "-o", path()],
        lambda: ["diff", path(), path()],
        lambda: ["explain", path(), "--time", draw.choice(["now", "2025-06-01T14:00:10Z", ""])],
        lambda: ["site", draw.choice(["import", "show", "export"]), path(), "-o", path()],
        lambda: [draw.choice(["sample", "modem-sim"]), path(), draw.choice(["-q", "--json", "-x"])],
        lambda: ["tap", "--port", path(), "-o", path(), "--duration", "0.2"],
    ]
    words = draw.choices(lines, [60, 8, 6, 4, 3, 5, 5, 4])[0]()
    descriptors = tuple(draw.choices(["open", "closed", "full", "gone"], [8, 1, 1, 1])[0] for _ in range(3))
    by = draw.choice(SIGNALS) if draw.random() < 0.3 else 0
    return Call(words, folder, descriptors, by, draw.expovariate(1 / 0.03))  # type: ignore[arg-type]


def child(call: Call, root: Path, said: Path) -> None:
    """Replace the child process by the call. This function never returns."""
    main = next(iter(entry_points(group="console_scripts", name="aerpaw-cmp"))).load()

    if call.folder.endswith("gone"):
        (root / "removed").mkdir()
        os.chdir(root / "removed")
        (root / "removed").rmdir()
    else:
        os.chdir(call.folder)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), 1)
    os.dup2(1, 2)
    for number, state in enumerate(call.descriptors):
        if state == "full" and number:
            os.dup2(os.open("/dev/full", os.O_RDWR), number)
        elif state == "gone" and number:
            read, write = os.pipe()
            os.dup2(write, number)
            os.close(read)
    for number, name in enumerate(("stdin", "stdout", "stderr")):  # as the interpreter begins
        there = call.descriptors[number] != "closed"
        setattr(sys, name, open(number, "w" if number else "r", closefd=False) if there else None)  # noqa: SIM115
        if not there:
            os.close(number)
    for number in SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    code = 70
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        code = main(call.words)
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
    except KeyboardInterrupt:
        code = 130 if call.by else 70  # before or after the command: the interpreter says it
        said.write_text("KeyboardInterrupt")
    except BaseException as error:
        Path(said).write_text(f"Traceback: {error!r}")
    finally:
        os._exit(code)


def violation(call: Call, root: Path, said: Path) -> tuple[str, str]:
    """The exit of a call, and what is wrong with it."""
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # until the fork is the command
    process = os.fork()
    if process == 0:
        child(call, root, said)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    begun, sent, status = time.monotonic(), not call.by, 0
    while not (ended := os.waitpid(process, os.WNOHANG))[0]:
        now = time.monotonic() - begun
        if not sent and now > call.after_s:
            os.kill(process, call.by)
            sent = True
        if now > SECONDS:
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
            return "hang", f"does not end within {SECONDS:g} s"
        time.sleep(0.001)
    status = ended[1]
    text = said.read_bytes().decode("utf-8", "replace") if said.exists() else ""
    said.unlink(missing_ok=True)
    hidden = list(root.rglob(".*.aerpaw-*"))
    for path in hidden:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        return f"signal {number}", "" if number == call.by else f"ended by signal {number}: {text}"
    code = os.WEXITSTATUS(status)
    if code not in CODES | ({128 + call.by} if call.by else set()):
        return str(code), f"exit code {code}: {text}"
    if "Traceback" in text:
        return str(code), text
    if code not in (0, 141) and call.descriptors[1:] == ("open", "open") and not text:
        return str(code), f"exit code {code} without a word"
    return str(code), f"left {hidden}" if hidden else ""


def run(calls: int, seed: int, only: int | None = None) -> tuple[dict[str, int], list[str]]:
    """Return the number of runs per exit code, and the violations."""
    from aerpaw_cmp.logs.readers import catalogue

    catalogue()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    exits: collections.Counter[str] = collections.Counter()
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as home:
        root = Path(home).resolve() / "w"
        os.environ["AERPAW_CMP_CACHE"] = str(Path(home, "cache"))
        for number in range(calls):
            if not root.exists() or number % 200 == 0 or only is not None:
                shutil.rmtree(root, ignore_errors=True)
                root.mkdir()
                furnish(root)
            call = drawn(random.Random(f"{seed}/{number}"), root)
            if only not in (None, number):
                continue
            code, fault = violation(call, root, Path(home, "said"))
            exits[code] += 1
            if fault:
                wrong.append(f"call {number}: {call}\n  {fault}")
    return dict(exits), wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, help="Number of one call, drawn again.")
    given = parser.parse_args()
    exits, wrong = run(given.calls, given.seed, given.only)
    for text in wrong:
        print(text)
    shown = ", ".join(f"{code}: {count}" for code, count in sorted(exits.items()))
    print(f"{sum(exits.values())} command lines, {len(wrong)} violations; exits {shown}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

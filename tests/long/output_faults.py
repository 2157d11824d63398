"""Kill each writing command, and fill or break its disk: is the output under its final name complete?

The script runs six commands (ingest, site import, simulate, report, campaign, map) on small jobs: eight seconds of
flight, a map of a few cells, two figures per page. Each run is a fork of this process, so that imports are paid for
once. The numbers and pictures of report, campaign and map are reused from the first run, and all files are written
again. A library in C (output_faults.c, built here, loaded by LD_PRELOAD) counts the calls that change the disk below the
output folder (open to write, write, rename, link, unlink, mkdir, rmdir, chmod, fsync, ftruncate). It acts at the n-th:

- ``kill``: SIGKILL before the call, after it, or in the middle of a write. Four of five kills are of this kind, spread
  evenly over all calls of the run. The fifth is a SIGKILL at a random moment of the command.
- ``full``: ENOSPC at the n-th call and at every later one that takes space, for every n.
- ``broken``: EIO at the n-th call alone, for every n. ``read-only``: EROFS from the first call on.
- ``removed``: the folder above the output is removed at the n-th call, for ten n.
- ``limit``: a real limit on the size of files (RLIMIT_FSIZE), and a real full tmpfs if one can be mounted.

Two variants of each job are written one after the other into one target. After each of them, these checks are made:

- Inputs are unchanged.
- The target is complete according to its SHA-256 list, and belongs to one variant. (Files that two clean runs write
  identically are compared.) It exists if it existed before.
- An error has exit code 3 and one message that names the output, and leaves no other file.
- The next run removes what a kill left.

At the end, the first job is run with a planted fault that writes in place, as an earlier version did. The checks must
detect it.
"""

import argparse
import collections
import contextlib
import ctypes
import errno
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, BinaryIO

HERE = Path(__file__).resolve().parent
SAMPLE = HERE.parents[1] / "sample_logs"
VARIANTS = ("a", "b")
NOTHING, BEFORE, AFTER, FAIL, COMMAND = range(5)
ERRORS = {"full": (errno.ENOSPC, 1), "broken": (errno.EIO, 0), "read-only": (errno.EROFS, 1)}


@dataclass(frozen=True, slots=True)
class Job:
    """A command in two variants, to which the target is added by ``-o``."""

    name: str
    kind: str
    """file or folder."""
    commands: dict[str, list[str]]


@dataclass(slots=True)
class Tally:
    """Counts of one job."""

    calls: int = 0
    seconds: float = 0.0
    done: collections.Counter[str] = field(default_factory=collections.Counter)
    violations: list[str] = field(default_factory=list)


# --- the small jobs -----------------------------------------------------------------------------------------------


def installed_program() -> Callable[[list[str]], int]:
    """The program as its users start it."""
    main: Callable[[list[str]], int] = next(iter(entry_points(group="console_scripts", name="aerpaw-cmp"))).load()
    return main


def make_inputs(folder: Path, wanted: list[str] | None = None) -> dict[str, Job]:
    """Inputs of both variants below ``folder``, and the wanted commands on them."""
    import yaml

    main = installed_program()

    plan = yaml.safe_load((SAMPLE / "flight.yaml").read_text(encoding="utf-8"))
    plan["flight"]["plan"] |= {
        "waypoints": [{"east_m": -50, "north_m": 10, "height_m": 40}, {"east_m": 50, "north_m": 10, "height_m": 40}],
        "bad_lines": 0, "clock_shift_s": {}, "telemetry_interval_s": 0.2,
    }  # fmt: skip
    plan["logs"] = [log for log in plan["logs"] if "USRP" not in log["path"] or log["path"].startswith("LW1/USRP1")]
    plan["flight"]["plan"]["offsets_db"] = {"LW1": {"USRP1": 0.0}}
    del plan["link"]["channels"]["USRP2"]
    plan |= {"rt": {"engine": "image", "max_depth": 1, "audit_links": 0}, "rss": {"lag": "off"}}
    commands: dict[str, dict[str, list[str]]] = collections.defaultdict(dict)
    for seed, variant in enumerate(VARIANTS):
        place = folder / variant
        place.mkdir(parents=True)
        plan["flight"]["plan"]["seed"] = seed
        plan["flight"]["plan"]["speed_mps"] = 9.0 + seed
        flight = place / "flight.yaml"
        flight.write_text(yaml.safe_dump(plan), encoding="utf-8")
        if wanted != ["site import"] and main(["simulate", str(flight), "-o", str(place / "flown")]):
            raise SystemExit("the small flight could not be simulated")
        flown = place / "flown" / "flight.yaml"
        (place / "campaign.yaml").write_text(f"campaign: {variant}\nflights: [flown/flight.yaml]\n", encoding="utf-8")
        (place / "map.json").write_text(json.dumps(_buildings(20 + seed)), encoding="utf-8")
        site = place / "site.yaml"
        if main(["site", "import", str(place / "map.json"), "-o", str(site)]):  # imports what the forks need, too
            raise SystemExit("the small map could not be imported")
        small = ["--spacing", "500", "--rss-altitude", "30", "--rank-altitude", "30", "-k", "10", "--foliage", "none"]
        commands["ingest"][variant] = ["ingest", str(flown.parent), "--timezone", "America/New_York"]
        commands["site import"][variant] = ["site", "import", str(place / "map.json")]
        commands["simulate"][variant] = ["simulate", str(flight)]
        commands["report"][variant] = ["report", str(flown)]
        commands["campaign"][variant] = ["campaign", str(place / "campaign.yaml")]
        carrier = ["--carrier-ghz", str(3.4 + seed / 10)]
        commands["map"][variant] = ["map", str(site), *small, *carrier, "--max-depth", "0", "--no-study"]
    kinds = {"ingest": "file", "site import": "file"}
    chosen = {name: by for name, by in commands.items() if not wanted or name in wanted}
    return {name: Job(name, kinds.get(name, "folder"), by) for name, by in chosen.items()}


def _buildings(count: int) -> dict[str, Any]:
    square = ((0, 0), (0, 1), (1, 1), (1, 0), (0, 0))
    corners = [[[-78.7 + (2 * i + a) * 1e-4, 35.727 + b * 1e-4] for a, b in square] for i in range(count)]
    return {
        "type": "FeatureCollection",
        "features": [
            {"type": "Feature", "properties": {"building": "yes"}, "geometry": {"type": "Polygon", "coordinates": [c]}}
            for c in corners
        ],
    }


# Of the present run.
_variant = ["a"]


def compute_once(jobs: dict[str, Job], folder: Path) -> None:
    """Numbers and pictures are those of the first run of a variant, and two pictures per page are enough.

    What is tried here is the writing; reading, checking, pages, tables and exports are made anew in every run.
    """
    from typer import main as typer_main

    main = installed_program()
    from aerpaw_cmp.flight import replay
    from aerpaw_cmp.jobs import campaign, coverage_map, flight_run
    from aerpaw_cmp.maps import export
    from aerpaw_cmp.report import canvas
    from aerpaw_cmp.report import flight_figures as figures
    from aerpaw_cmp.report import maps as maps_figures

    for room in (figures, maps_figures):
        specs: Callable[..., Any] = room.figure_specs
        room.figure_specs = lambda data, _specs=specs: list(_specs(data))[:2]  # type: ignore[attr-defined]
    computed = ((replay, "replay_flight"), (flight_run, "run_flight"), (campaign, "run"), (coverage_map, "make_maps"))
    for room, name in computed:
        setattr(room, name, _remembered(getattr(room, name), lambda *_, **__: ""))
    canvas.render = _remembered(canvas.render, lambda spec, *_, **__: str(spec.name))
    export.Scale.legend = _remembered(export.Scale.legend, lambda scale, *_, **__: str(scale.key))  # type: ignore[method-assign]
    typer_main.get_command = _remembered(typer_main.get_command, lambda *_, **__: "")  # the options of all commands
    for job in jobs.values():
        for variant in VARIANTS if job.kind == "folder" else ():
            _variant[0] = variant
            if main([*job.commands[variant], "-o", str(folder / job.name / variant)]):
                raise SystemExit(f"the small {job.name} failed")


def _remembered(function: Callable[..., Any], name: Callable[..., str]) -> Callable[..., Any]:
    known: dict[tuple[str, str], Any] = {}

    def answer(*arguments: Any, **keys: Any) -> Any:
        key = (_variant[0], name(*arguments))
        if key not in known:
            known[key] = function(*arguments, **keys)
        return known[key]

    return answer


# --- one run --------------------------------------------------------------------------------------------------------


class Runs:
    """Runs of one job as forks of this process.

    Parameters
    ----------
    job : Job
    root : Path
        The output is ``root/reports/NAME``; faults act below ``root``.
    shim : ctypes.CDLL
    """

    def __init__(self, job: Job, root: Path, shim: ctypes.CDLL) -> None:
        self.job, self.root, self.shim = job, root, shim
        self.folder = root / "reports"
        self.target = self.folder / {"ingest": "flight.h5", "site import": "site.yaml"}.get(job.name, "result")
        self.stable: dict[str, dict[str, str]] = {}
        self.pipe: int | None = None

    def start(
        self, variant: str, fault: tuple[int, int, int, int, str] = (0, NOTHING, 0, 0, ""), limit: int | None = None
    ) -> int:
        """Begin a run and return its process id. ``fault`` is (at, kind, error, sticky, command)."""
        main = installed_program()

        self.folder.mkdir(parents=True, exist_ok=True)
        if self.pipe is not None:
            os.close(self.pipe)
        self.pipe, said = os.pipe()  # no file: the limit on their size would hold for it, too
        child = os.fork()
        if child:
            os.close(said)
            return child
        code = 70
        _variant[0] = variant
        try:
            sys.stdout = sys.stderr = os.fdopen(os.dup(said), "w", encoding="utf-8")
            if limit is not None:
                sys.dont_write_bytecode = True  # cut by the limit it would stay in the tree
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            at, kind, error, sticky, command = fault
            self.shim.fault_arm(os.fsencode(self.root), at, kind, error, sticky, command.encode())
            code = main([*self.job.commands[variant], "-o", str(self.target)])
            sys.stdout.flush()
            sys.stderr.flush()
            os.write(said, f"\ncalls {self.shim.fault_count()}\n".encode())
        except BaseException as error:
            os.write(said, f"{type(error).__name__}: {error}\n".encode())
        finally:
            os._exit(code)

    def clean(self, variant: str) -> int:
        """Do a run without a fault, which must succeed. Return its number of calls."""
        code = os.waitstatus_to_exitcode(os.waitpid(self.start(variant), 0)[1])
        if code:
            raise SystemExit(f"{self.job.name} without a fault: exit {code}: {self.said()}")
        return int(self.said().rsplit("calls ", 1)[1])

    def said(self) -> str:
        """Return and forget the output of the last run."""
        assert self.pipe is not None
        with os.fdopen(self.pipe, "rb") as stream:
            self.pipe = None
            return stream.read().decode("utf-8", errors="replace")

    # --- what is there

    def content(self) -> dict[str, str]:
        """SHA-256 of the results by name."""
        if self.target.is_file():
            return {"": _digest(self.target)}
        files = (p for p in self.target.rglob("*") if p.is_file() and ".aerpaw-" not in p.name)
        return {p.relative_to(self.target).as_posix(): _digest(p) for p in files}

    def litter(self) -> list[str]:
        """Everything below the root that is neither target nor in it, and hidden places in it."""
        from aerpaw_cmp.site.learned import folder_of

        memory = folder_of(self.target)  # copied from the base of a site
        own = (self.folder, self.target, *([memory, *memory.iterdir()] if (memory / "learned.yaml").exists() else []))
        names = [p for p in self.root.rglob("*") if p not in own]
        return sorted(
            str(p.relative_to(self.root)) for p in names if self.target not in p.parents or ".aerpaw-" in p.name
        )

    def learn(self) -> None:
        """Return the files that two clean runs of a variant write equally, which distinguish the variants."""
        for variant in VARIANTS:
            seen = []
            for number in range(2):
                time.sleep(1.1 * number)  # pages and numbers name the second of their run
                self.reset()
                self.clean(variant)
                seen.append(self.content())
            self.stable[variant] = {name: digest for name, digest in seen[0].items() if seen[1].get(name) == digest}
        both = self.stable[VARIANTS[0]].items() & self.stable[VARIANTS[1]].items()
        for name, _ in both:
            for variant in VARIANTS:
                del self.stable[variant][name]
        if not all(self.stable.values()):
            raise SystemExit(f"{self.job.name}: nothing tells the variants apart")

    def reset(self) -> None:
        """No output."""
        shutil.rmtree(self.root, ignore_errors=True)
        self.folder.mkdir(parents=True)

    def wrong(self, before: bool) -> str | None:
        """Return what is incomplete or not of one run. None if nothing is."""
        digests = self.content()
        if not os.path.lexists(self.target) or not digests:
            return "the output that was there is gone" if before else None
        variants = [v for v in VARIANTS if all(digests[n] == d for n, d in self.stable[v].items() if n in digests)]
        if not variants:
            return "files of two runs"
        return self._wrong_file() if self.job.kind == "file" else self._wrong_folder(digests)

    def _wrong_file(self) -> str | None:
        from aerpaw_cmp.common.outputs import is_sealed
        from aerpaw_cmp.logs.flight_file import is_flight_file

        complete = is_flight_file if self.job.name == "ingest" else is_sealed
        return None if complete(self.target) else "the file is not whole"

    def _wrong_folder(self, digests: dict[str, str]) -> str | None:
        from aerpaw_cmp.common.outputs import SUMS, read_sums

        sums = read_sums(self.target)
        if sums is None:
            return "the folder has no list"
        if sums != {name: digest for name, digest in digests.items() if name != SUMS}:
            return "the folder is not what its list says"
        return None


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _tree(folder: Path) -> dict[str, str]:
    return {str(p): _digest(p) for p in sorted(folder.rglob("*")) if p.is_file()}


# --- the faults -----------------------------------------------------------------------------------------------------


def try_job(
    job: Job, inputs: Path, work: Path, shim: ctypes.CDLL, kills: int, chance: random.Random, *, errors: bool = True
) -> Tally:
    """Inject all faults into one job. Without ``errors``, only kill it."""
    runs, tally = Runs(job, work / "root", shim), Tally()
    original = _tree(inputs)
    runs.learn()
    runs.reset()
    runs.clean("a")
    start = time.perf_counter()
    tally.calls = runs.clean("b")
    tally.seconds = time.perf_counter() - start

    def check(what: str, before: bool) -> None:
        tally.done[what.split()[0]] += 1
        wrong = runs.wrong(before)
        if wrong is None and _tree(inputs) != original:
            wrong = "an input was changed"
        if wrong is not None:
            tally.violations.append(f"{job.name}: {what}: {wrong}")
            runs.reset()

    for number in range(kills):
        if number % 25 == 0:
            _next_run_clears(runs, tally, absent=number % 50 == 0)
        before = os.path.lexists(runs.target)
        variant = VARIANTS[number % 2]
        if number % 5 < 4:
            at, kind = 1 + number * tally.calls // kills, (BEFORE, AFTER)[number // 2 % 2]
            child, what = runs.start(variant, (at, kind, 0, 0, "")), f"kill {kind} at call {at}"
        else:
            moment = chance.uniform(0.0, tally.seconds)
            child, what = runs.start(variant), f"kill after {moment:.4f} s"
            time.sleep(moment)
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        tally.done["killed"] += code == -signal.SIGKILL
        check(what, before)

    _next_run_clears(runs, tally, absent=False)
    for what, variant, fault, limit in _errors(runs, tally.calls) if errors else ():
        if not os.path.lexists(runs.target):
            _next_run_clears(runs, tally, absent=False)
        before = os.path.lexists(runs.target)
        code = os.waitstatus_to_exitcode(os.waitpid(runs.start(variant, fault, limit), 0)[1])
        check(what, before and not what.startswith("removed"))
        said = [line for line in runs.said().splitlines() if line.startswith("aerpaw-cmp: ")]
        reported = code == 0 or (code == 3 and len(said) == 1 and str(runs.folder) in said[0])
        if not reported:
            tally.violations.append(f"{job.name}: {what}: exit {code}, said {said}")
        if rest := runs.litter():
            if code:
                tally.violations.append(f"{job.name}: {what}: left {rest}")
            tally.done["left for the next run"] += 1
            _next_run_clears(runs, tally, absent=False)
        tally.done["told"] += code == 3
    _next_run_clears(runs, tally, absent=False)
    return tally


def _next_run_clears(runs: Runs, tally: Tally, *, absent: bool) -> None:
    """Check that a run without faults succeeds after a fault and leaves only the target.

    With ``absent``, remove the target afterwards.
    """
    runs.clean("a")
    if rest := runs.litter():
        tally.violations.append(f"{runs.job.name}: after a clean run there is {rest}")
        runs.reset()
    if absent:
        runs.reset()


def _errors(runs: Runs, calls: int) -> Iterator[tuple[str, str, tuple[int, int, int, int, str], int | None]]:
    """Errors of the disk: name, variant, fault, limit on the size of files."""
    number = 0
    for name, (error, sticky) in ERRORS.items():
        for at in range(1, 2 if name == "read-only" else calls + 1):
            number += 1
            yield f"{name} from call {at}", VARIANTS[number % 2], (at, FAIL, error, sticky, ""), None
    for at in sorted({1 + i * (calls - 1) // 9 for i in range(10)}):
        command = f"rm -rf {runs.folder}"
        yield f"removed at call {at}", VARIANTS[at % 2], (at, COMMAND, 0, 0, command), None
    runs.folder.mkdir(parents=True, exist_ok=True)
    for limit in (0, 1, 512, 4096, 20_480):
        yield f"limit of {limit} bytes", VARIANTS[limit % 2], (0, NOTHING, 0, 0, ""), limit


def try_full_tmpfs(job: Job, work: Path, shim: ctypes.CDLL) -> str:
    """A tmpfs of 300 kB with 30 kB left: a real full disk."""
    runs = Runs(job, work / "tmpfs" / "root", shim)
    disk = work / "tmpfs"
    disk.mkdir(exist_ok=True)
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", disk], check=False).returncode:
        return "not tried: no right to mount"
    try:
        runs.folder.mkdir(parents=True)
        (disk / "filler").write_bytes(bytes(270_000))
        code = os.waitstatus_to_exitcode(os.waitpid(runs.start("a"), 0)[1])
        return f"exit {code}, left {runs.litter()}, wrote {sorted(runs.content())[:1]}"
    finally:
        subprocess.run(["umount", disk], check=True)


def plant() -> None:
    """Write in place and in order, as the tool once did: the checks must see it."""
    from aerpaw_cmp.common import outputs

    @contextlib.contextmanager
    def in_place(self: outputs.OutputFolder) -> Iterator[Path]:
        self.target.mkdir(parents=True, exist_ok=True)
        with outputs.explained_os_errors(self.named):
            yield self.target
            names = [p for p in self.target.rglob("*") if p.is_file() and p.name != outputs.SUMS]
            rows = "".join(f"{_digest(p)}  {p.relative_to(self.target).as_posix()}\n" for p in sorted(names))
            (self.target / outputs.SUMS).write_text(f"# aerpaw-cmp: planted\n{rows}")

    def straight(self: outputs.OutputFile, content: bytes | Callable[[BinaryIO], None]) -> None:
        with outputs.explained_os_errors(self.named), self.target.open("w+b") as stream:
            content(stream) if callable(content) else stream.write(content)

    outputs.OutputFolder.filling = in_place  # type: ignore[method-assign]
    outputs.OutputFile.write = straight  # type: ignore[method-assign]


# --- all of it ------------------------------------------------------------------------------------------------------


def build_shim(folder: Path) -> Path:
    """The library of faults, compiled."""
    library = folder / "output_faults.so"
    command = [os.environ.get("CC", "cc"), "-shared", "-fPIC", "-O1", "-o", library, HERE / "output_faults.c", "-ldl"]
    subprocess.run(command, check=True)
    return library


def main() -> int:
    """Run, count, print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200, help="per command")
    parser.add_argument("--jobs", nargs="*", help="some of the commands")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--preloaded", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.preloaded is None:
        with tempfile.TemporaryDirectory(prefix="output_faults_") as folder:
            library = build_shim(Path(folder))
            command = [sys.executable, __file__, *sys.argv[1:], "--preloaded", folder]
            return subprocess.run(command, env={**os.environ, "LD_PRELOAD": str(library)}, check=False).returncode
    work = arguments.preloaded
    shim = ctypes.CDLL(str(work / "output_faults.so"))
    os.environ.pop("LD_PRELOAD", None)
    os.environ.setdefault("XDG_CACHE_HOME", str(work / "cache"))
    inputs = work / "inputs"
    with Path(os.devnull).open("w") as quiet, contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet):
        jobs = make_inputs(inputs, arguments.jobs)
        if any(job.kind == "folder" for job in jobs.values()):
            compute_once(jobs, work / "first")
    chance, total, everything = random.Random(arguments.seed), collections.Counter[str](), {}
    violations: list[str] = []
    for name, job in jobs.items():
        tally = try_job(job, inputs, work, shim, arguments.kills, chance)
        everything[name] = {
            "calls": tally.calls, "seconds_of_a_run": round(tally.seconds, 3), **tally.done,
            "violations": len(tally.violations),
        }  # fmt: skip
        if job.name in ("ingest", "report"):
            everything[name]["full_tmpfs"] = try_full_tmpfs(job, work, shim)
        print(name, json.dumps(everything[name]), file=sys.stderr, flush=True)
        total += tally.done
        violations += tally.violations
    plant()
    planted = try_job(next(iter(jobs.values())), inputs, work, shim, 14, chance, errors=False)
    conditions = {"kills_per_command": arguments.kills, "seed": arguments.seed, "python": sys.version.split()[0]}
    result = {**conditions, "jobs": everything, "total": total, "violations": violations[:20], "n": len(violations)}
    result["planted_fault"] = {"kills": planted.done["kill"], "violations": len(planted.violations)}
    print(json.dumps(result, indent=1))
    return 1 if violations or not planted.violations else 0


if __name__ == "__main__":
    sys.exit(main())

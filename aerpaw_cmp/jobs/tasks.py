"""Tasks of a campaign or a map: their inputs, their stored outcomes, and the workers that run them.

Every file that a report was made from, besides the logs: settings, site, antennas, elevation, reference powers.

Whatever text of the flight file or of the site file names a file is one (:mod:`aerpaw_cmp.common.yamlfile`).

Outcomes of a campaign's tasks and audits, kept by what they depend on: nothing finished is computed twice.

Independent tasks on workers: here, in processes of this machine, or on a Dask cluster; one function, one result.

Tasks are functions of small records (paths, settings, hashes) that can be pickled. A lost worker costs what was
being done: that runs again, alone, and only a task that loses its worker even then is :class:`Lost`.

Processes of this machine are talked to by pipes that only they and this process hold: nothing listens. A scheduler and
its workers unpickle what they are sent, and so run code for whoever reaches them: only TLS is spoken with them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import logging
import multiprocessing
import os
import platform
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor
from concurrent.futures import wait as wait_for
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import import_module, metadata
from multiprocessing import get_context
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from pydantic import ConfigDict, TypeAdapter

from ..common.content import trained_on
from ..common.errors import AerpawCmpError, InputError, UsageError, parsing
from ..common.files import LARGEST_TABLE, read_sealed, write_sealed
from ..common.outputs import file_digest
from ..common.stages import Progress, logged
from ..common.text import counted
from ..common.units import AnyArray
from ..common.yamlfile import input_files, named_files
from ..flight.gains import load_with_learned
from ..flight.settings import FlightFile
from ..report.flight_data import InputFile
from ..site.learned import read_table
from ..site.siteyaml import inputs_of_site, site_files


def other_inputs(
    settings: FlightFile, flight: Path, logs_root: Path | None = None, learned: Path | None = None
) -> tuple[InputFile, ...]:
    """The flight file, the site file and every file that either names, but for the logs.

    Parameters
    ----------
    settings : FlightFile
        As checked.
    flight : Path
        The flight file.
    logs_root : Path, optional
        Where logs and antenna files resolve besides the folder of the flight file.
    learned : Path, optional
        calibrated.yaml of ``report --with``.

    Returns
    -------
    tuple of InputFile
        Path as it is named (the packaged site: as the package names it), SHA-256, and as role the key that names it.
        They have no lines to account for.
    """
    content = settings.model_dump(exclude={"logs"})
    roots = [flight.parent] if logs_root is None else [logs_root, flight.parent]
    entries = {os.path.realpath(flight): _entry(flight.name, flight, "flight file")}
    if learned is not None:
        entries[os.path.realpath(learned)] = _entry(learned.name, learned, "learned settings")
    for key, text, place in named_files(content, roots):
        if key != "site.file":
            entries.setdefault(os.path.realpath(place), _entry(text, place, key))
    for text, role, place in site_files(settings.site.file, flight.parent):
        entries.setdefault(os.path.realpath(place), _entry(text, place, role))
    return tuple(entries.values())


def inputs_of_flight(settings: FlightFile, flight: Path, logs_root: Path | None = None) -> list[Path]:
    """Every file that a flight is read from, its site's too: no output may replace one."""
    return [*input_files(settings, flight, logs_root), *inputs_of_site(settings.site.file, flight.parent)]


def inputs_of_flights(flights: Iterable[Path], logs_root: Path | None = None) -> list[Path]:
    """Inputs of several flight files; of one that is wrong the file alone."""
    files: list[Path] = []
    for flight in flights:
        files.append(flight)
        with suppress(AerpawCmpError, OSError):
            files += inputs_of_flight(load_with_learned(flight), flight, logs_root)
    return files


def stamp(path: Path) -> tuple[int, int]:
    """Size and time of a file: a worker that lives for days must see that it was changed; zeros where there is none."""
    try:
        status = os.stat(path)  # noqa: PTH116
    except OSError:
        return 0, 0
    return status.st_size, status.st_mtime_ns


def digest_of(place: Path) -> str:
    """SHA-256 of a file, computed once for its size and time: a campaign asks with every task."""
    return _digest(place, *stamp(place))


@lru_cache(maxsize=1024)
def _digest(place: Path, _size: int, _mtime_ns: int) -> str:
    return file_digest(place)


@lru_cache(maxsize=1024)
def _learned_on(place: Path, size: int, _mtime_ns: int) -> tuple[str, ...]:
    """SHA-256 of the logs that a file says it was learned from."""
    if size > LARGEST_TABLE:
        return ()
    return trained_on(read_table(place, "an input").decode("utf-8", errors="replace"))


def _entry(name: str, place: Path, role: str) -> InputFile:
    return InputFile(path=name, sha256=digest_of(place), role=role, learned_on=_learned_on(place, *stamp(place)))


# Raised whenever the form of an entry changes.
LAYOUT = 8

_SEAL = b"aerpaw-cmp outcome"


# Entry points of readers: those of other packages count with their version.
READERS = "aerpaw_cmp.readers"


class OutcomeStore:
    """Records by key: ``<key>.npz``, sealed by the digest of its content.

    Parameters
    ----------
    folder : Path
        Made when the first entry is written.
    kind : type
        Dataclass of an outcome; an entry is held against its fields, and nothing else is ever built from a file.

    Attributes
    ----------
    warnings : list of str
        Damaged entries that were not used.
    """

    def __init__(self, folder: Path, kind: type) -> None:
        self.folder = folder
        # a list, since pydantic takes no configuration beside a dataclass
        self._kind = TypeAdapter(list[kind], config=ConfigDict(arbitrary_types_allowed=True, extra="forbid"))  # type: ignore[valid-type]
        self.warnings: list[str] = []

    def check(self) -> None:
        """UsageError where nothing can be kept in the folder, before anything runs."""
        probe = self.folder / f".probe-{os.getpid()}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise UsageError(
                f"outcomes cannot be kept in {self.folder}: {error.strerror or error}",
                expected="a folder that may be written",
                cause="a disk that is full or read-only, or a file in the way",
            ) from None

    def load(self, key: str) -> Any | None:
        """The outcome of a key, or None where there is no sound entry."""
        file = self.folder / f"{key}.npz"
        try:
            content = read_sealed(file, _SEAL)
        except ValueError:
            self.warnings.append(f"a damaged outcome was not used, its task is computed anew: {file}")
            return None
        if content is None:
            return None
        try:
            # a pickle in a shared folder would run whatever its writer wanted
            with parsing(file, any_shape=True), np.load(io.BytesIO(content), allow_pickle=False) as parts:
                arrays = {name: parts[name] for name in parts.files}
                return self._kind.validate_python([_with_arrays(json.loads(arrays["content"].tobytes()), arrays)])[0]
        except InputError:
            self.warnings.append(f"an outcome that this tool did not write was not used: {file}")
            return None

    def save(self, key: str, outcome: Any) -> None:
        """Write an entry whole or not at all; nothing where the disk does not take it."""
        arrays = _Arrays()
        text = json.dumps(_plain(outcome, arrays), default=lambda number: number.item())
        content = np.frombuffer(text.encode(), dtype=np.uint8)
        entry = io.BytesIO()
        np.savez(entry, content=content, **arrays.by_name)  # type: ignore[arg-type]
        write_sealed(self.folder / f"{key}.npz", entry.getvalue(), _SEAL)


# Key of the name of an array, in its place in the JSON.
_ARRAY = "array of the entry"


def _plain(value: Any, arrays: _Arrays) -> Any:
    """A record as JSON takes it."""
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name), arrays) for field in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return {_ARRAY: arrays.put(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item, arrays) for key, item in value.items()}
    return [_plain(item, arrays) for item in value] if isinstance(value, (tuple, list)) else value


def _with_arrays(value: Any, arrays: Mapping[str, AnyArray]) -> Any:
    """JSON with the arrays in their places."""
    if isinstance(value, dict):
        named = value.get(_ARRAY)
        return arrays[named] if named else {key: _with_arrays(item, arrays) for key, item in value.items()}
    return [_with_arrays(item, arrays) for item in value] if isinstance(value, list) else value


class _Arrays:
    """Arrays by name, each once: channels of a tower share times and places, half of all that is kept."""

    def __init__(self) -> None:
        self.by_name: dict[str, AnyArray] = {}
        self._names: dict[tuple[str, tuple[int, ...], bytes], str] = {}

    def put(self, array: AnyArray) -> str:
        """The name of an array."""
        if array.dtype.hasobject:  # these would be pickled
            raise TypeError("an outcome holds no arrays of objects")
        name = self._names.setdefault((array.dtype.str, array.shape, array.tobytes()), f"a{len(self._names)}")
        self.by_name[name] = array
        return name


# Settings that a campaign's outcome does not depend on: names, the plan of a simulation, pages, the audit.
_WITHOUT_EFFECT: dict[str, Any] = {"flight": True, "report": True, "rt": {"audit_links"}}


def task_inputs(settings: FlightFile, flight: Path, logs_root: Path | None) -> list[dict[str, str]]:
    """Role, path and SHA-256 of every file that an outcome depends on, logs last.

    Raises
    ------
    OSError
        If a log cannot be read.
    UsageError
        If the site cannot.
    """
    entries = [
        {"role": other_input.role, "path": other_input.path, "sha256": other_input.sha256}
        for other_input in other_inputs(settings, flight, logs_root)
        if other_input.role != "flight file"  # what it says stands in the settings, overrides included
    ]
    for log in settings.logs:
        path = (logs_root or flight.parent) / log.path
        entries.append({"role": "log", "path": log.path, "sha256": digest_of(path)})
    return entries


def task_key(settings: FlightFile, inputs: Iterable[Mapping[str, str]], *more: object) -> str:
    """Digest of what an outcome depends on: settings that matter, content of every input, code, and ``more``.

    Labels do not: a flight or a setting that gets another name keeps its outcomes.
    """
    digest = hashlib.sha256()
    digest.update("\n".join([str(LAYOUT), code_digest(), *map(str, more)]).encode())
    digest.update(settings.model_dump_json(exclude=_WITHOUT_EFFECT).encode())
    for entry in inputs:
        digest.update(f"{entry['role']} {entry['sha256']}\n".encode())
    return digest.hexdigest()


@cache
def code_digest() -> str:
    """Digest of the source of this program and of the versions of what it computes with."""
    digest = hashlib.sha256()
    for name in ("aerpaw_cmp", "aerpaw_parsers"):
        with contextlib.suppress(ImportError):
            root = Path(str(import_module(name).__file__)).parent
            for path in sorted(root.rglob("*.py")):
                digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    for name in ("numpy", "scipy", "sionna-rt"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            digest.update(f"{name} {metadata.version(name)}".encode())
    for plugin in sorted({str(p.dist and (p.dist.name, p.dist.version)) for p in metadata.entry_points(group=READERS)}):
        digest.update(plugin.encode())
    return digest.hexdigest()


# What is done with an item; it can be pickled.
Task = Callable[[Any], Any]

# Gets the number of an item and the result of its task, or :class:`Lost`.
_OnResult = Callable[[int, Any], None]

# Time for a scheduler to answer, after which one without a worker is spoken of, and between counts of workers.
CONNECT_S, NO_WORKER_S, COUNT_EVERY_S = 10.0, 30.0, 2.0


@dataclass(frozen=True, slots=True)
class Lost:
    """In place of a result: the worker ended, again and again, or the task could not be sent or brought back."""

    message: str


_ENDED = Lost("its worker process ended, time after time: out of memory, or killed")


class Workers(Protocol):
    """Runs tasks side by side."""

    @property
    def count(self) -> int:
        """Tasks at a time."""

    def run(self, function: Task, items: Sequence[Any], on_result: _OnResult) -> None:
        """``function`` of every item, in any order; ``on_result`` gets number and result as they come."""


class InProcess:
    """One after the other, in this process."""

    count = 1

    def run(self, function: Task, items: Sequence[Any], on_result: _OnResult) -> None:  # noqa: D102
        for number, item in enumerate(items):
            on_result(number, function(item))


# --- processes of this machine --------------------------------------------------------------------------------------


class Processes:
    """Processes of this machine; where one ends, others take the place of all, and what was in work runs alone."""

    def __init__(self, count: int) -> None:
        self.count = count

    def run(self, function: Task, items: Sequence[Any], on_result: _OnResult) -> None:  # noqa: D102
        waiting = deque(range(len(items)))
        while waiting:
            for number in self._through(function, items, waiting, on_result):  # alone: none pays for its neighbour
                if self._through(function, items, deque([number]), on_result):
                    on_result(number, _ENDED)

    def _through(self, function: Task, items: Sequence[Any], waiting: deque[int], on_result: _OnResult) -> list[int]:
        """Run what waits, ``count`` at a time, until none is left or a process ends; gives the tasks in work then."""
        active: dict[Future[Any], int] = {}
        others = multiprocessing.active_children()  # of the program that called from Python
        with _away() as folder:
            # spawn: a forked child would inherit the threads of numerical libraries in an unknown state
            pool = ProcessPoolExecutor(min(self.count, len(waiting)), get_context("spawn"), _begin, (folder,))
        try:
            while waiting or active:
                while waiting and len(active) < self.count:
                    with _away():
                        future = pool.submit(function, items[waiting[0]])
                    active[future] = waiting.popleft()
                ready = wait_for(active, return_when=FIRST_COMPLETED).done
                for future in sorted(ready, key=lambda f: isinstance(f.exception(), BrokenProcessPool)):
                    try:
                        result = future.result()
                    except BrokenProcessPool:
                        raise
                    except Exception as error:
                        result = Lost(f"its worker process ended: {str(error).strip() or type(error).__name__}")
                    on_result(active.pop(future), result)
        except BrokenProcessPool:
            return list(active.values())
        finally:
            if active:  # no task is waited for
                for process in set(multiprocessing.active_children()).difference(others):
                    process.kill()
            pool.shutdown(cancel_futures=True)
        return []


@contextlib.contextmanager
def _away() -> Iterator[Path]:
    """Start processes elsewhere: a new interpreter looks for modules in its folder, and a stranger's may hold some.

    Yields the folder that one comes back to.
    """
    folder = Path.cwd()
    os.chdir(Path(os.__file__).parent)
    try:
        yield folder
    finally:
        os.chdir(folder)


def _begin(folder: Path) -> None:
    """Begin a process: in the folder of the first one, ending with it, and deaf to Ctrl-C, which is for that one."""
    os.chdir(folder)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):
        signal.signal(number, signal.SIG_DFL)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    """End with the first process, in the middle of a task too."""
    if (parent := multiprocessing.parent_process()) is not None:
        wait([parent.sentinel])
        os._exit(1)


# --- Dask -----------------------------------------------------------------------------------------------------------


class Cluster:
    """Workers of a Dask scheduler.

    Parameters
    ----------
    client : distributed.Client
    progress : Progress
        Told when no worker is there.
    """

    def __init__(self, client: Any, progress: Progress = logged) -> None:
        self._client, self._progress = client, progress
        self._counted_s = self._staffed_s = time.monotonic()

    @property
    def count(self) -> int:
        """Threads of all workers that are there now."""
        return max(1, sum(self._threads().values()))

    def _threads(self) -> dict[str, int]:
        """Threads of each worker; InputError where the scheduler goes away as it is asked."""
        try:
            return dict(self._client.nthreads())
        except OSError:
            raise self._gone() from None

    def run(self, function: Task, items: Sequence[Any], on_result: _OnResult) -> None:  # noqa: D102
        killed = self._through(function, items, range(len(items)), on_result)
        for number in killed:  # a last time, so that none pays for its neighbour
            if self._through(function, items, [number], on_result):
                on_result(number, _ENDED)

    def _through(self, function: Task, items: Sequence[Any], numbers: Iterable[int], on_result: _OnResult) -> list[int]:
        """Run some; gives those that lost their worker too often, as Dask counts."""
        killed: list[int] = []
        active = {self._client.submit(function, items[number], pure=False): number for number in numbers}
        while active:
            ready = [future for future in active if future.done()]
            if not ready:
                self._check_scheduler()
                time.sleep(0.05)
            for future in ready:
                number, result = active.pop(future), self._result(future)
                if result is None:
                    killed.append(number)
                else:
                    on_result(number, result[0])
                future.release()
        return killed

    def _result(self, future: Any) -> tuple[Any] | None:
        """Result of a task that is done, or how it was lost; None where its workers were lost again and again."""
        try:
            return (future.result(),)
        except CancelledError:  # with its scheduler
            raise self._gone() from None
        except Exception as error:
            if type(error).__name__ == "KilledWorker":
                return None
            return (Lost(f"its worker process ended: {str(error).strip() or type(error).__name__}"),)

    def _check_scheduler(self) -> None:
        """InputError where it is gone; where it has had no worker for a while, that is said."""
        if self._client.status != "running":
            raise self._gone()
        now = time.monotonic()
        if now - self._counted_s < COUNT_EVERY_S:
            return
        self._counted_s = now
        if self._threads():
            self._staffed_s = now
        elif now - self._staffed_s > NO_WORKER_S:
            self._progress(f"the scheduler has had no worker for {NO_WORKER_S:.0f} s; finished tasks are kept")
            self._staffed_s = now

    def _gone(self) -> InputError:
        return InputError(
            "the scheduler of the workers went away",
            cause="it was stopped; what was finished is kept, run the same command again",
        )


@contextlib.contextmanager
def open_workers(
    workers: int,
    scheduler: str | None = None,
    *,
    paths: Sequence[Path] = (),
    progress: Progress = logged,
) -> Iterator[Workers]:
    """Workers for the tasks of a job.

    Parameters
    ----------
    workers : int
        On this machine; 1 runs the tasks in this process.
    scheduler : str, optional
        Address of a Dask scheduler (``tls://``), in place of workers here.
    paths : sequence of Path
        Files and folders that every worker of a scheduler has to see.
    progress : Progress
        How many workers a scheduler has, and the address of its dashboard.

    Yields
    ------
    Workers
        Closed at the end of the block.

    Raises
    ------
    UsageError
        No scheduler answers, ``distributed`` is missing, or workers run other code or do not see the files.
    """
    if scheduler is not None:
        with _scheduler(scheduler, paths, progress) as cluster:
            yield cluster
    elif workers <= 1:
        yield InProcess()
    else:
        yield Processes(workers)


def _quiet() -> None:
    """No log lines of distributed on the terminal: what matters is told once, in our words."""
    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)


@contextlib.contextmanager
def _scheduler(address: str, paths: Sequence[Path], progress: Progress) -> Iterator[Cluster]:
    """Workers of a running scheduler."""
    try:
        from distributed import Client

        _quiet()
    except ImportError:
        raise UsageError(
            f"--scheduler {address!r} needs the package 'distributed'", expected="pip install 'aerpaw-cmp[cluster]'"
        ) from None
    if not address.startswith("tls://"):
        raise UsageError(
            f"--scheduler {address!r} is not protected: whoever reaches it runs programs as you, here and there",
            expected="tls://HOST:PORT, with certificates in Dask's configuration (docs/campaign.md)",
        )
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError, ImportError) as error:
        raise UsageError(
            f"--scheduler {address!r}: no scheduler answers ({error})",
            cause="no certificates in Dask's configuration (distributed.comm.tls)"
            if isinstance(error, TypeError)
            else None,
        ) from error
    cluster = Cluster(client, progress)
    try:
        check_workers(client, paths)
        dashboard = client.scheduler_info().get("services", {}).get("dashboard")
        page = f"; dashboard {client.dashboard_link}" if dashboard else ""
        progress(f"{counted(len(client.nthreads()), 'worker')}, {counted(cluster.count, 'task')} at a time{page}")
        yield cluster
    finally:
        with contextlib.suppress(Exception):
            client.close(timeout=5)


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerFacts:
    """Facts that a worker states about itself."""

    host: str
    version: str
    code: str
    missing: tuple[str, ...]


def _worker_facts(paths: Sequence[str]) -> WorkerFacts:
    """Of the process that this runs in."""
    from .. import __version__

    return WorkerFacts(
        host=platform.node(),
        version=__version__,
        code=code_digest(),
        missing=tuple(path for path in paths if not os.access(path, os.R_OK)),
    )


def check_workers(client: Any, paths: Sequence[Path]) -> None:
    """One message for all workers that run other code or do not see the files.

    Raises
    ------
    UsageError
        Naming worker, host and what is wrong.
    """
    answers = client.run(_worker_facts, [str(path.absolute()) for path in paths], on_error="return")
    ours = _worker_facts([])
    wrong = [f"{worker}: {text}" for worker, facts in answers.items() if (text := _trouble(facts, ours))]
    if wrong:
        more = f"; and {len(wrong) - 4} more" if len(wrong) > 4 else ""
        raise UsageError(
            f"{len(wrong)} of {len(answers)} workers cannot do this campaign: " + "; ".join(wrong[:4]) + more,
            expected="the same aerpaw-cmp on every worker, and the same files under the same paths",
            cause="another environment, or a disk that is not mounted there",
        )


def _trouble(facts: Any, ours: WorkerFacts) -> str:
    if isinstance(facts, BaseException):
        return f"aerpaw-cmp cannot be loaded there ({type(facts).__name__}: {facts})"
    if facts.code != ours.code:
        what = f"aerpaw-cmp {facts.version}, here {ours.version}" if facts.version != ours.version else "another state"
        return f"{facts.host} runs other code ({what} of the program or of NumPy, SciPy, Sionna RT)"
    if facts.missing:
        more = f" and {len(facts.missing) - 1} more" if len(facts.missing) > 1 else ""
        return f"{facts.host} does not see {facts.missing[0]}{more}"
    return ""

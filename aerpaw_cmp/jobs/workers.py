"""Independent tasks on workers: here, in processes of this machine, or on a Dask cluster; one function, one result.

Tasks are functions of small records (paths, settings, hashes) that can be pickled. A lost worker costs what it was
doing: that task runs again, a last time alone, and only one that loses its worker even then is :class:`Lost`.

Processes of this machine are talked to by pipes that only they and this process hold: nothing listens. A scheduler and
its workers unpickle what they are sent, and so run code for whoever reaches them: only TLS is spoken with them.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import pickle
import platform
import shutil
import signal
import tempfile
import threading
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Protocol, TypeVar

from ..common.errors import AerpawCmpError, InputError, UsageError
from ..common.stages import Progress, silent
from .outcomes import code_digest
from .place import open_place

Item = TypeVar("Item")
Result = TypeVar("Result")

TRIES = 2
"""A task in work when a worker is lost is tried again; after so many tries once more, alone."""

CONNECT_S = 10.0
"""How long a scheduler may take to answer."""

RECONNECT_S = 60.0
"""How long a scheduler that went away is waited for."""

NO_WORKER_S = 30.0
"""A scheduler that has had no worker for so long is spoken of, again and again."""

_LOOKED_S = 2.0
"""How often workers are counted."""


@dataclass(frozen=True, slots=True)
class Lost:
    """In place of a result: the worker ended, again and again, or the task could not be sent or brought back."""

    message: str


class Workers(Protocol):
    """Runs tasks side by side."""

    @property
    def count(self) -> int:
        """Tasks at a time."""

    def run(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        done: Callable[[int, Result | Lost], None],
    ) -> None:
        """``function`` of every item, in any order; ``done`` gets number and result as they come."""


class Here:
    """One after the other, in this process."""

    count = 1

    def run(  # noqa: D102
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        done: Callable[[int, Result | Lost], None],
    ) -> None:
        for number, item in enumerate(items):
            done(number, function(item))


# --- processes of this machine --------------------------------------------------------------------------------------


class Processes:
    """Processes of this machine, each with a pipe of its own; one that ends is known, and another takes its place."""

    def __init__(self, count: int) -> None:
        self.count = count

    def run(  # noqa: D102
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        done: Callable[[int, Result | Lost], None],
    ) -> None:
        tries: Counter[int] = Counter()
        with contextlib.ExitStack() as stack:
            crew = [stack.enter_context(_Worker(function)) for _ in range(min(self.count, len(items)))]
            killed = _through(crew, items, range(len(items)), tries, done)
            for number in killed:  # a last time, so that none pays for its neighbour
                if _through(crew[:1], items, [number], tries, done):
                    done(number, Lost("its worker process ended, time after time: out of memory, or killed"))


def _through(
    crew: Sequence[_Worker],
    items: Sequence[Any],
    numbers: Iterable[int],
    tries: Counter[int],
    done: Callable[[int, Any], None],
) -> list[int]:
    """Run some tasks; gives those that lost their worker too often."""
    waiting, killed = deque(numbers), list[int]()
    active: dict[Connection, tuple[_Worker, int]] = {}
    while waiting or active:
        for worker in crew:
            if waiting and worker.pipe not in active:
                number = waiting.popleft()
                worker.send(items[number])
                active[worker.pipe] = worker, number
        for pipe in wait(list(active)):
            assert isinstance(pipe, Connection)
            worker, number = active.pop(pipe)
            try:
                succeeded, content = pickle.loads(pipe.recv_bytes())
            except (EOFError, OSError):
                worker.start_anew()
                tries[number] += 1
                (waiting if tries[number] < TRIES else killed).append(number)
                continue
            done(number, content if succeeded else Lost(f"its worker process ended: {content}"))
    return killed


class _Worker:
    """A process that runs a function of what it is sent, as a context; killed where the block is left by an error."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self._function = function
        self._start()

    def _start(self) -> None:
        # spawn: a forked child would inherit the threads of numerical libraries in an unknown state
        context = get_context("spawn")
        self.pipe, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(there, self._function), daemon=True)  # type: ignore[attr-defined]
        self._process.start()
        there.close()

    def send(self, item: Any) -> None:
        with contextlib.suppress(OSError):  # one that has ended is seen where its answer is awaited
            self.pipe.send((item,))

    def start_anew(self) -> None:
        self._end(kill=True)
        self._start()

    def __enter__(self) -> _Worker:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._end(kill=kind is not None)

    def _end(self, *, kill: bool) -> None:
        with contextlib.suppress(OSError):
            self.pipe.send(None)
        if not kill:
            self._process.join(5.0)
        self._process.kill()
        self._process.join()
        self.pipe.close()


def _serve(pipe: Connection, function: Callable[[Any], Any]) -> None:
    """Answer until the pipe says no more, or is closed: the process that holds its other end is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the first process
    for number in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):
        signal.signal(number, signal.SIG_DFL)
    threading.Thread(target=_follow_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        while (order := pipe.recv()) is not None:
            try:
                answer = pickle.dumps((True, function(*order)))
            except Exception as error:
                answer = pickle.dumps((False, str(error).strip() or type(error).__name__))
            pipe.send_bytes(answer)


def _follow_parent() -> None:
    """End with the first process, in the middle of a task too."""
    if (parent := multiprocessing.parent_process()) is not None:
        wait([parent.sentinel])
        os._exit(1)


def _ended(error: BaseException) -> Lost:
    if type(error).__name__ == "KilledWorker":
        return Lost("its worker process ended, time after time: out of memory, or killed")
    return Lost(f"its worker process ended: {str(error).strip() or type(error).__name__}")


# --- Dask -----------------------------------------------------------------------------------------------------------


_CUT = object()
"""In place of a result: the task ended, and the way back was cut."""


def _outcome(future: Any) -> tuple[BaseException | None, Any]:
    """The error and the result of a task that is done; its ``status`` may say so later than ``done()`` does."""
    try:
        return None, future.result()
    except (CancelledError, OSError, TimeoutError) as error:
        return (error, None) if future.status == "error" else (None, _CUT)
    except Exception as error:
        return error, None


class Cluster:
    """Workers of a Dask scheduler; a window of tasks is with it at a time, so that its memory does not grow.

    Parameters
    ----------
    client : distributed.Client
    address : str, optional
        Of a scheduler that can be reached again after it went away; without it, its end is the end.
    progress : Progress
    """

    def __init__(self, client: Any, address: str | None = None, progress: Progress = silent) -> None:
        self._client, self._address, self._progress = client, address, progress

    @property
    def count(self) -> int:
        """Threads of all workers that are there now."""
        return max(1, sum(self._client.nthreads().values())) if self._client.status == "running" else 1

    def run(  # noqa: D102
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        done: Callable[[int, Result | Lost], None],
    ) -> None:
        killed = self._through(function, items, range(len(items)), done, alone=False)
        for number in killed:  # a last time, so that none pays for its neighbour
            self._through(function, items, [number], done, alone=True)

    def _through(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        numbers: Iterable[int],
        done: Callable[[int, Result | Lost], None],
        *,
        alone: bool,
    ) -> list[int]:
        """Run some; gives those that lost their worker too often."""
        waiting = deque(numbers)
        active: dict[Any, int] = {}
        killed: list[int] = []
        came = threading.Event()
        window, looked, seen = self.count, time.monotonic(), time.monotonic()
        while waiting or active:
            if time.monotonic() - looked > _LOOKED_S:  # workers may join and leave
                window, looked = self.count, time.monotonic()
                seen = self._looked_for_workers(seen)
            try:
                while waiting and len(active) < 2 * window + 2:
                    number = waiting.popleft()
                    future = self._client.submit(function, items[number], pure=False)
                    active[future] = number
                    future.add_done_callback(lambda _future: came.set())
            except Exception:
                if self._client.status == "running":
                    raise
                waiting.appendleft(number)
            came.wait(0.5)
            came.clear()
            for future in [f for f in active if f.done()]:
                number = active.pop(future)
                error, result = _outcome(future)
                if error is None and result is _CUT:
                    waiting.appendleft(number)
                    continue
                if error is None:
                    done(number, result)
                elif type(error).__name__ == "KilledWorker" and not alone:
                    killed.append(number)
                else:
                    done(number, _ended(error))
                future.release()
            if self._client.status != "running":
                waiting.extendleft(sorted(active.values(), reverse=True))
                active.clear()
                self._reconnect()
        return killed

    def _looked_for_workers(self, seen_s: float) -> float:
        """When a worker was last there, or its absence was last told [s]."""
        if self._client.status == "running" and not self._client.nthreads():
            if time.monotonic() - seen_s < NO_WORKER_S:
                return seen_s
            place = f" at {self._address}" if self._address else ""
            self._progress(
                f"no worker is with the scheduler{place} since {NO_WORKER_S:.0f} s: waiting; what was finished is kept"
            )
        return time.monotonic()

    def _reconnect(self) -> None:
        """Wait for the scheduler to come back; InputError where it does not."""
        from distributed import Client

        with contextlib.suppress(Exception):
            self._client.close(timeout=1)
        if self._address is None:
            raise InputError("the scheduler of the workers has ended", cause="out of memory, or it was killed")
        self._progress(f"the scheduler {self._address} went away: waiting up to {RECONNECT_S:.0f} s for it")
        end = time.monotonic() + RECONNECT_S
        while time.monotonic() < end:
            with contextlib.suppress(OSError, ValueError):
                self._client = Client(self._address, timeout="3s", set_as_default=False)
                self._progress(f"the scheduler {self._address} is there again")
                return
            time.sleep(1.0)
        raise InputError(
            f"the scheduler {self._address} went away and did not come back within {RECONNECT_S:.0f} s",
            cause="it was stopped; what was finished is kept, run the same command again",
        )

    def close(self) -> None:
        """Leave the scheduler."""
        with contextlib.suppress(Exception):
            self._client.close(timeout=5)


@contextlib.contextmanager
def open_workers(
    workers: int,
    scheduler: str | None = None,
    *,
    paths: Sequence[Path] = (),
    keep: str | None = None,
    progress: Progress = silent,
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
    keep : str, optional
        Folder or URL of outcomes that it has to reach.
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
        with _scheduler(scheduler, paths, keep, progress) as cluster:
            yield cluster
    elif workers <= 1:
        yield Here()
    else:
        remove_left_folders(Path(tempfile.gettempdir()))
        yield Processes(workers)


def remove_left_folders(root: Path) -> list[Path]:
    """Remove folders that local clusters of 0.3 left where they were killed.

    Parameters
    ----------
    root : Path
        The folder of temporary files.

    Returns
    -------
    list of Path
        The removed ones: of this user, no links, and no process works in them or has a file of them open. None where
        the system does not tell (no ``/proc``).
    """
    if not Path("/proc/self/fd").is_dir() or not hasattr(os, "getuid"):
        return []
    mine = [
        folder
        for folder in root.glob("aerpaw-cmp-dask-*")
        if folder.is_dir() and not folder.is_symlink() and folder.stat().st_uid == os.getuid()
    ]
    used = _places_in_use() if mine else set()
    left = [folder for folder in mine if not any(place.is_relative_to(folder.resolve()) for place in used)]
    for folder in left:
        shutil.rmtree(folder, ignore_errors=True)
    return left


def _places_in_use() -> set[Path]:
    """Working folders and open files of the processes that this user may look at."""
    places = set()
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            for link in (process / "cwd", *(process / "fd").iterdir()):
                with contextlib.suppress(OSError):
                    places.add(link.readlink())
    return places


def _quiet() -> None:
    """No log lines of distributed on the terminal: what matters is told once, in our words."""
    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)


@contextlib.contextmanager
def _scheduler(address: str, paths: Sequence[Path], keep: str | None, progress: Progress) -> Iterator[Cluster]:
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
            expected="tls://HOST:PORT, with certificates in Dask's configuration (docs/howto/cluster.md)",
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
    cluster = Cluster(client, address, progress)
    try:
        check_workers(client, paths, keep)
        there = client.scheduler_info().get("services", {}).get("dashboard")
        page = f"; dashboard {client.dashboard_link}" if there else ""
        progress(f"{len(client.nthreads())} workers, {cluster.count} tasks at a time{page}")
        yield cluster
    finally:
        cluster.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerFacts:
    """What a worker says of itself."""

    host: str
    python: str
    version: str
    code: str
    missing: tuple[str, ...]


def worker_facts(paths: Sequence[str], keep: str | None = None, probe: str = "") -> WorkerFacts:
    """Of the process that this runs in."""
    from .. import __version__

    missing = [path for path in paths if not os.access(path, os.R_OK)]
    if keep is not None:
        try:
            if open_place(keep).read(probe) is None:
                missing.append(f"what is kept in {keep}")
        except AerpawCmpError as error:
            missing.append(str(error))
    return WorkerFacts(
        host=platform.node(),
        python=platform.python_version(),
        version=__version__,
        code=code_digest(),
        missing=tuple(missing),
    )


def check_workers(client: Any, paths: Sequence[Path], keep: str | None = None) -> None:
    """One message for all workers that run other code or do not see the files.

    Raises
    ------
    UsageError
        Naming worker, host and what is wrong.
    """
    texts, probe = [str(path.absolute()) for path in paths], f"probe-{uuid.uuid4().hex}"
    if keep is not None:
        open_place(keep).write(probe, b"seen?")
    try:
        answers = client.run(worker_facts, texts, keep, probe, on_error="return")
    finally:
        if keep is not None:
            open_place(keep).remove(probe)
    here = worker_facts([])
    wrong = [f"{worker}: {text}" for worker, facts in answers.items() if (text := _trouble(facts, here))]
    if wrong:
        more = f"; and {len(wrong) - 4} more" if len(wrong) > 4 else ""
        raise UsageError(
            f"{len(wrong)} of {len(answers)} workers cannot do this campaign: " + "; ".join(wrong[:4]) + more,
            expected="the same aerpaw-cmp on every worker, and the same files under the same paths",
            cause="another environment, or a disk that is not mounted there",
        )


def _trouble(facts: Any, here: WorkerFacts) -> str:
    if isinstance(facts, BaseException):
        return f"aerpaw-cmp cannot be loaded there ({type(facts).__name__}: {facts})"
    if facts.code != here.code:
        other = f"aerpaw-cmp {facts.version}, here {here.version}" if facts.version != here.version else "another state"
        return f"{facts.host} runs other code ({other} of the program or of NumPy, SciPy, Sionna RT)"
    if facts.missing:
        more = f" and {len(facts.missing) - 1} more" if len(facts.missing) > 1 else ""
        return f"{facts.host} does not see {facts.missing[0]}{more}"
    return ""

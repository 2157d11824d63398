"""Workers for independent tasks: in this process, in processes of this machine, or on a Dask cluster.

All kinds of workers have the interface :class:`Workers` and pass the same tests. A task is a function of a small record
that can be pickled. If a worker process ends, the tasks that it was running are repeated one at a time. A task whose
worker ends again becomes :class:`Lost`.

Processes of this machine communicate through pipes that no other process can open. A Dask scheduler and its workers
unpickle everything that they receive. Every user who can connect can therefore execute code, so connections must use
TLS.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import platform
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor
from concurrent.futures import wait as wait_for
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from .. import __version__
from ..common.errors import AerpawCmpError, InputError, UsageError
from ..common.stages import Progress, logged
from ..common.text import counted

# not from a module that loads pandas and SciPy: each worker process imports this file before its task
from ..common.versions import code_digest

# A function of one item that can be pickled.
Task = Callable[[Any], Any]

# A function that receives the number of an item and the result of its task, or :class:`Lost`.
_OnResult = Callable[[int, Any], None]

# Waiting times [s]: for a scheduler to answer, before a scheduler without workers is reported, and between counts of
# workers.
CONNECT_S, NO_WORKER_S, COUNT_EVERY_S = 10.0, 30.0, 2.0


@dataclass(frozen=True, slots=True)
class Lost:
    """The result of a task whose worker ended twice, or if the task or its result could not be pickled."""

    message: str


_ENDED = Lost("its worker process ended repeatedly: out of memory, or killed")


class Workers(ABC):
    """Workers that run tasks at the same time."""

    @property
    @abstractmethod
    def count(self) -> int:
        """The number of tasks that run at the same time."""

    @abstractmethod
    def _run_waiting(self, task: Task, items: Sequence[Any], waiting: deque[int], on_result: _OnResult) -> list[int]:
        """Run waiting items by number until a worker ends. Return the numbers of the tasks that ended with it."""

    def run(self, task: Task, items: Sequence[Any], on_result: _OnResult) -> None:
        """Run a task on every item, in any order.

        Parameters
        ----------
        task : callable
        items : sequence
        on_result : callable
            Receives the number and the result of each item once. The call is made in this process, as soon as the
            result is known.

        Raises
        ------
        AerpawCmpError
            The error of a task.
        InputError
            If the scheduler of the workers is lost.
        """
        waiting = deque(range(len(items)))
        while waiting:
            # repeat tasks one at a time, so that a task that ends its worker does not end other tasks
            for number in self._run_waiting(task, items, waiting, on_result):
                if self._run_waiting(task, items, deque([number]), on_result):
                    on_result(number, _ENDED)


def _outcome(future: Any) -> Any:
    """Return the result of a finished future, or :class:`Lost`. Raise the errors of tasks and of lost workers."""
    try:
        return future.result()
    except (AerpawCmpError, BrokenProcessPool, CancelledError):
        raise
    except Exception as error:
        if type(error).__name__ == "KilledWorker":
            raise
        return Lost(f"its worker process ended: {str(error).strip() or type(error).__name__}")


class InProcess(Workers):
    """The calling process, which runs one task after the other."""

    count = 1

    def _run_waiting(self, task: Task, items: Sequence[Any], waiting: deque[int], on_result: _OnResult) -> list[int]:
        while waiting:
            number = waiting.popleft()
            on_result(number, task(items[number]))
        return []


class Processes(Workers):
    """Processes of this machine. If one process ends, all processes are replaced."""

    count = 1

    def __init__(self, count: int) -> None:
        self.count = count

    def _run_waiting(self, task: Task, items: Sequence[Any], waiting: deque[int], on_result: _OnResult) -> list[int]:
        active: dict[Future[Any], int] = {}
        others = multiprocessing.active_children()  # processes that the calling program started
        with _in_trusted_folder() as folder:
            # spawn: a forked child would inherit the threads of numerical libraries in an unknown state
            pool = ProcessPoolExecutor(min(self.count, len(waiting)), get_context("spawn"), _start_worker, (folder,))
        try:
            while waiting or active:
                while waiting and len(active) < self.count:
                    with _in_trusted_folder():
                        future = pool.submit(task, items[waiting[0]])
                    active[future] = waiting.popleft()
                ready = wait_for(active, return_when=FIRST_COMPLETED).done
                for future in sorted(ready, key=lambda f: isinstance(f.exception(), BrokenProcessPool)):
                    result = _outcome(future)
                    on_result(active.pop(future), result)
        except BrokenProcessPool:
            return list(active.values())
        finally:
            if active:  # end the processes instead of waiting for running tasks
                for process in set(multiprocessing.active_children()).difference(others):
                    process.kill()
            pool.shutdown(cancel_futures=True)
        return []


@contextlib.contextmanager
def _in_trusted_folder() -> Iterator[Path]:
    """Change to a trusted folder while processes start, and yield the present working folder.

    A new interpreter imports modules from its working folder, which can be a folder of logs from someone else.
    """
    folder = Path.cwd()
    os.chdir(Path(os.__file__).parent)
    try:
        yield folder
    finally:
        os.chdir(folder)


def _start_worker(folder: Path) -> None:
    """Start a worker process in the folder of its parent. The worker ignores Ctrl-C and ends with the parent."""
    os.chdir(folder)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):
        signal.signal(number, signal.SIG_DFL)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    """End this process when its parent ends, even during a task."""
    if (parent := multiprocessing.parent_process()) is not None:
        wait([parent.sentinel])
        os._exit(1)


class Cluster(Workers):
    """Workers of a Dask scheduler.

    Parameters
    ----------
    client : distributed.Client
    progress : Progress
        Receives a message if the scheduler has no workers.
    """

    def __init__(self, client: Any, progress: Progress = logged) -> None:
        self._client, self._progress = client, progress
        self._counted_s = self._staffed_s = time.monotonic()

    @property
    def count(self) -> int:
        """The number of threads of all connected workers."""
        return max(1, sum(self._threads().values()))

    def _threads(self) -> dict[str, int]:
        """Return the number of threads per worker. Raise an InputError if the scheduler is lost."""
        try:
            return dict(self._client.nthreads())
        except OSError:
            raise self._scheduler_lost() from None

    def _run_waiting(self, task: Task, items: Sequence[Any], waiting: deque[int], on_result: _OnResult) -> list[int]:
        killed: list[int] = []
        active = {self._client.submit(task, items[number], pure=False): number for number in waiting}
        waiting.clear()
        while active:
            ready = [future for future in active if future.done()]
            if not ready:
                self._check_scheduler()
                time.sleep(0.05)
            for future in ready:
                number = active.pop(future)
                try:
                    on_result(number, _outcome(future))
                except CancelledError:
                    raise self._scheduler_lost() from None
                except Exception as error:
                    if type(error).__name__ != "KilledWorker":
                        raise
                    killed.append(number)  # Dask has repeated the task several times
                future.release()
        return killed

    def _check_scheduler(self) -> None:
        """Raise an InputError if the scheduler is lost. Report a scheduler that has had no worker for a while."""
        if self._client.status != "running":
            raise self._scheduler_lost()
        now = time.monotonic()
        if now - self._counted_s < COUNT_EVERY_S:
            return
        self._counted_s = now
        if self._threads():
            self._staffed_s = now
        elif now - self._staffed_s > NO_WORKER_S:
            self._progress(f"the scheduler has had no worker for {NO_WORKER_S:.0f} s; finished tasks are stored")
            self._staffed_s = now

    def _scheduler_lost(self) -> InputError:
        return InputError(
            "the scheduler of the workers cannot be reached",
            cause="it was stopped; finished tasks are stored, run the same command again",
        )


@contextlib.contextmanager
def open_workers(
    workers: int, scheduler: str | None = None, *, paths: Sequence[Path] = (), progress: Progress = logged
) -> Iterator[Workers]:
    """Open workers for the tasks of a job, and close them at the end of the block.

    Parameters
    ----------
    workers : int
        Number of processes on this machine. 1 runs the tasks in this process.
    scheduler : str, optional
        Address of a Dask scheduler (``tls://``), whose workers are used instead.
    paths : sequence of Path
        Files and folders that every worker of a scheduler must be able to read.
    progress : Progress
        Shows the number of workers of a scheduler and the address of its dashboard.

    Yields
    ------
    Workers

    Raises
    ------
    UsageError
        If no scheduler answers, ``distributed`` is missing, or workers run other code or cannot read the files.
    """
    if scheduler is not None:
        with _scheduler(scheduler, paths, progress) as cluster:
            yield cluster
    elif workers <= 1:
        yield InProcess()
    else:
        yield Processes(workers)


def _hide_log_lines() -> None:
    """Hide the log lines of distributed: this module reports what matters."""
    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)


@contextlib.contextmanager
def _scheduler(address: str, paths: Sequence[Path], progress: Progress) -> Iterator[Cluster]:
    """Connect to a running scheduler, and yield its workers."""
    try:
        from distributed import Client

        _hide_log_lines()
    except ImportError:
        raise UsageError(
            f"--scheduler {address!r} needs the package 'distributed'", expected="pip install 'aerpaw-cmp[cluster]'"
        ) from None
    if not address.startswith("tls://"):
        raise UsageError(
            f"--scheduler {address!r} is not protected: anyone who reaches it can run programs as you, here and on "
            "the workers",
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


def check_workers(client: Any, paths: Sequence[Path]) -> None:
    """Check that all workers run the same code and can read the files.

    Raises
    ------
    UsageError
        If the workers differ. The message lists workers, hosts and differences.
    """
    names = [str(path.absolute()) for path in paths]
    answers = client.run(_difference, names, code_digest(), __version__, on_error="return")
    wrong = [
        f"{worker}: aerpaw-cmp cannot be loaded there ({type(answer).__name__}: {answer})"
        if isinstance(answer, BaseException)
        else f"{worker}: {answer}"
        for worker, answer in answers.items()
        if answer
    ]
    if wrong:
        more = f"; and {len(wrong) - 4} more" if len(wrong) > 4 else ""
        raise UsageError(
            f"{len(wrong)} of {len(answers)} workers cannot run this campaign: " + "; ".join(wrong[:4]) + more,
            expected="the same aerpaw-cmp on every worker, and the same files under the same paths",
            cause="another environment, or a disk that is not mounted there",
        )


def _difference(paths: Sequence[str], code: str, version: str) -> str:
    """Return how this worker process differs from the planning process, or an empty text if both are equal.

    Parameters
    ----------
    paths : sequence of str
        Files and folders that the worker must be able to read.
    code, version : str
        Digest of the code and version of the planning process.

    Returns
    -------
    str
    """
    if code_digest() != code:
        what = "another state" if __version__ == version else f"aerpaw-cmp {__version__}, here {version}"
        return f"{platform.node()} runs different code ({what} of the program or of NumPy, SciPy, Sionna RT)"
    missing = [path for path in paths if not os.access(path, os.R_OK)]
    more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
    return f"{platform.node()} does not see {missing[0]}{more}" if missing else ""

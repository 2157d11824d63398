"""Named stages of a job, with progress and durations."""

from __future__ import annotations

import ctypes
import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Protocol

from .interrupts import raise_interrupt


class Progress(Protocol):
    """A function that receives the current step and, if known, the share that is done (0 to 1).

    Calls with the same text and a growing share form one progress bar. A text without a share is shown as a
    separate line.
    """

    def __call__(self, text: str, fraction: float | None = None, /) -> object: ...  # noqa: D102


_LOGGER = logging.getLogger("aerpaw_cmp")
# do not print the log by default, because this package is also a library. Users add a handler or call basicConfig.
_LOGGER.addHandler(logging.NullHandler())


def logged(text: str, fraction: float | None = None, /) -> None:
    """Log progress of Python calls on the logger ``aerpaw_cmp``: steps as INFO, shares as DEBUG."""
    if fraction is None:
        _LOGGER.info(text)
    else:
        _LOGGER.debug("%s %.0f %%", text, 100 * fraction)


def duration(seconds: float) -> str:
    """Return a duration as text in seconds, minutes or hours.

    Examples
    --------
    >>> duration(12), duration(600), duration(9000)
    ('12 s', '10 min', '2.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


@dataclass(frozen=True, slots=True)
class PlannedStage:
    """A planned stage. ``work`` is its input, ``seconds`` its measured or estimated time [s], None if unknown."""

    name: str
    work: str
    seconds: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Plan of what a command would do.

    Parameters
    ----------
    job : str
    inputs : tuple of Path
        Files that would be read.
    output : Path
        The path that would be written. The dry run has confirmed that it can be written.
    stages : tuple of PlannedStage
    """

    job: str
    inputs: tuple[Path, ...]
    output: Path
    stages: tuple[PlannedStage, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the plan as plain values for JSON."""
        return {
            "job": self.job,
            "inputs": [str(path) for path in self.inputs],
            "output": str(self.output),
            "stages": [asdict(stage) for stage in self.stages],
        }


class NotRun(Exception):  # noqa: N818  # not an error: a dry run ends with it
    """The exception that ends a dry run where the computation would begin. ``plan`` contains what a run would do."""

    def __init__(self, plan: Plan) -> None:
        super().__init__(f"{plan.job} was not run")
        self.plan = plan


@dataclass(slots=True)
class Stages:
    """Seconds of each named stage, in order.

    Parameters
    ----------
    progress : Progress
        Receives the name of each stage when it begins.
    seconds : dict of str to float
        Time of each stage [s]. The times of stages with the same name are added.
    plan : Plan, optional
        Plan of a dry run.

    Examples
    --------
    >>> stages = Stages()
    >>> with stages("read"):
    ...     pass
    >>> list(stages.seconds)
    ['read']
    """

    progress: Progress = logged
    seconds: dict[str, float] = field(default_factory=dict)
    plan: Plan | None = None

    def checked(self, rest: Callable[[], Iterable[PlannedStage]]) -> None:
        """End a dry run with :class:`NotRun`. A job calls this before it computes the remaining stages, ``rest``."""
        if self.plan is not None:
            done = (PlannedStage(name, "done", seconds) for name, seconds in self.seconds.items())
            raise NotRun(replace(self.plan, stages=(*done, *rest())))

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time one stage. A repeated stage is announced once. A swallowed interrupt is raised first."""
        raise_interrupt()
        if name not in self.seconds:
            self.progress(name)
        # use a monotonic clock, because the time of day may be set while a job runs
        start = time.perf_counter()
        try:
            yield
        finally:
            # store the time even after a failure or an interrupt, because the page reports the time spent
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            give_memory_back()


def begin_peak() -> None:
    """Reset the high-water mark of this process's memory, if the system can (proc(5))."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_mib() -> float:
    """Return the high-water mark of this process's memory [MiB]. NaN if the system does not report it."""
    try:
        return float(Path("/proc/self/status").read_text(encoding="ascii").split("VmHWM:")[1].split()[0]) / 1024.0
    except (OSError, IndexError):
        return float("nan")


def give_memory_back() -> None:
    """Return freed pages to the system, if the C library can (glibc: ``malloc_trim``).

    A stage frees most of its memory in small pieces between blocks that are still in use. After a stage that processes
    a flight of ten hours, a quarter of a GiB of such free pieces would remain allocated.
    """
    trim = getattr(_library(), "malloc_trim", None)
    if trim is not None:
        trim(ctypes.c_size_t(0))


@cache
def _library() -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL(None)
    except (OSError, TypeError):  # this system cannot look up symbols of the running program
        return None

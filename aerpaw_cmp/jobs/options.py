"""Options of every job besides its own settings, and the outcome that every job gives back."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..common.stages import Plan, Progress, Stages, logged

# A sample is scored by the nearest predicted position of another program within this distance [m].
AGAINST_DISTANCE_M = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """Options of a run: where results go and logs lie, what may be replaced, who computes, who is told.

    Parameters
    ----------
    out : Path, optional
        Results; each job has a default.
    logs_root : Path, optional
        Folder against which the paths of logs resolve.
    force : bool
        Replace also what this tool did not write, or what was changed since; never an input.
    workers : int
        Of this machine; 1 computes in this process.
    scheduler : str, optional
        Address of a Dask scheduler, in place of workers here.
    progress : Progress
        Gets stages and the share done.
    dry : bool
        Check and write nothing: the job ends by :class:`~aerpaw_cmp.common.stages.NotRun` where computing would begin.
    """

    out: Path | None = None
    logs_root: Path | None = None
    force: bool = False
    workers: int = 1
    scheduler: str | None = None
    progress: Progress = logged
    dry: bool = False

    def stages(self, job: str, inputs: Iterable[Path], output: Path) -> Stages:
        """Stages of a job; those of a dry run end it."""
        plan = Plan(job=job, inputs=tuple(inputs), output=output) if self.dry else None
        return Stages(self.progress, plan=plan)


DEFAULT = RunOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOutcome:
    """Outcome of a job; one that fails raises with what was found, what was expected and the likely cause.

    Parameters
    ----------
    folder : Path
    metrics : dict
        Its metrics.json; empty of a job that measures nothing.
    files : tuple of Path
        What was written, the page first.
    failed_checks : tuple of str
        Stated checks that did not hold.
    warnings : tuple of str
        Sentences for the terminal, of a job whose metrics have none.
    """

    folder: Path
    metrics: dict[str, Any] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    failed_checks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

"""Options that every job has in addition to its settings, and the outcome that every job returns."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..common.stages import Plan, Progress, Stages, logged

# Largest distance from a sample to the predicted position of another program by which it is scored [m].
AGAINST_DISTANCE_M = 5.0

# Largest height of positions of maps and predictions [m]. Drones fly lower; a larger number is a typing error.
HIGHEST_M = 10_000.0

# Columns with the predicted probability of each rank.
RANKS = ("p_rank1", "p_rank2", "p_rank3", "p_rank4")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """Options of a run: folders of results and logs, permission to replace files, workers and progress.

    Parameters
    ----------
    out : Path, optional
        Folder or file of the results. Each job has a default.
    logs_root : Path, optional
        Folder to which the paths of logs are relative.
    force : bool
        Also replace files that this tool did not write, or that were changed since then. Inputs are never replaced.
    workers : int
        Processes on this machine. 1 computes in this process.
    scheduler : str, optional
        Address of a Dask scheduler, used instead of local processes.
    progress : Progress
        Receives the name of each stage and the share that is done.
    dry : bool
        Only check the inputs: the job raises :class:`~aerpaw_cmp.common.stages.NotRun` before the computation.
    """

    out: Path | None = None
    logs_root: Path | None = None
    force: bool = False
    workers: int = 1
    scheduler: str | None = None
    progress: Progress = logged
    dry: bool = False

    def stages(self, job: str, inputs: Iterable[Path], output: Path) -> Stages:
        """Return the stages of a job. In a dry run, they end the job before it computes."""
        plan = Plan(job=job, inputs=tuple(inputs), output=output) if self.dry else None
        return Stages(self.progress, plan=plan)


DEFAULT = RunOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOutcome:
    """The outcome of a job that ran to its end.

    Parameters
    ----------
    folder : Path
    metrics : dict
        Content of metrics.json. The dict is empty for a job without metrics.
    files : tuple of Path
        Files that were written, the page first.
    failed_checks : tuple of str
        Sentences about requested checks that failed.
    warnings : tuple of str
        Sentences for the terminal that are not in the metrics.
    """

    folder: Path
    metrics: dict[str, Any] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    failed_checks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

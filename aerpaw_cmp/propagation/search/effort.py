"""Running of a search among thousands of faces, and the estimate beforehand of its cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Estimated cost of a search.

    Parameters
    ----------
    seconds : float
        Of an idle machine, all sources.
    sources, first_faces, sequences : int
        ``first_faces`` of one source, ``sequences`` of all.
    memory_mib : float
        Geometry and trees; sequences are streamed.
    """

    seconds: float
    sources: int
    first_faces: int
    sequences: int
    memory_mib: float

    def times(self, sources: int) -> Estimate:
        """The estimate of so many sources like this one."""
        return replace(self, seconds=self.seconds * sources, sources=sources, sequences=self.sequences * sources)

    def __str__(self) -> str:
        many = "1 tower" if self.sources == 1 else f"{self.sources} towers"
        seconds = f"{self.seconds:.2g}" if self.seconds < 100 else f"{self.seconds:.0f}"
        return (
            f"about {seconds} s for {many}: {self.first_faces} first faces, some {self.sequences} sequences, "
            f"streamed in {max(1, round(self.memory_mib))} MiB"
        )


Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchRun:
    """Options of running a search; nothing here changes a number.

    Parameters
    ----------
    threads : int, optional
        Of compiled code (default: the cores this process may use).
    progress : callable, optional
        Called with the share done.
    on_estimate : callable, optional
        Called before a search among thousands of faces with what it will take; without one, a long search is a
        warning.
    """

    threads: int | None = None
    progress: Progress | None = None
    on_estimate: Callable[[Estimate], None] | None = None

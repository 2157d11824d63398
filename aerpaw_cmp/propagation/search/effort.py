"""What a search among thousands of faces takes: told before it begins, and counted after."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """What a search took.

    Parameters
    ----------
    sequences : int
        Sequences of at least one face that were followed.
    candidates : int
        Paths before anything was asked to hide them.
    hidden : int
        First faces in the shadow of one convex face, over all sources.
    seconds : float
        Wall clock.
    estimate_s : float
        What was expected after the first faces.
    """

    sequences: int = 0
    candidates: int = 0
    hidden: int = 0
    seconds: float = 0.0
    estimate_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """What a search will take.

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


OnEstimate = Callable[[Estimate], None]

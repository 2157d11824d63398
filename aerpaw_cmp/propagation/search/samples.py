"""Number of rays that PathSolver needs here: raised until two pilots agree.

PathSolver finds a wall of solid angle W with the chance ``1 - exp(-N W / 4 pi)``, so what a scene needs depends on its
smallest and farthest walls. Pilots on a batch of poses spread over the flight, each with four times the rays of the one
before, end when two find the same paths; the larger number of the two is taken. A wall that both miss and that other
poses see can still be lost: the audit by the image engine says so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ...common.counting import counted
from ..geometry.paths import Faces, PathSet
from .mirror import plane_keys, planes_of

# Rays per tower of the first pilot.
FIRST = 10_000

_FACTOR = 4

# Rays per tower at which pilots end in any case.
MOST = 2_560_000


@dataclass(frozen=True, slots=True)
class Choice:
    """Rays per tower and why."""

    samples: int
    reason: str


def enough_samples(pilot: Callable[[int], PathSet], faces: Faces, poses: int) -> Choice:
    """The number of rays at which two pilots agree.

    Parameters
    ----------
    pilot : callable
        ``pilot(samples)`` gives the paths of the pilot's poses.
    faces : Faces
    poses : int
        Of the pilot, for the words.

    Returns
    -------
    Choice
    """
    plane = planes_of(faces)
    samples = FIRST
    before = pilot(samples)
    while samples < MOST:
        samples *= _FACTOR
        paths = pilot(samples)
        # the paths themselves, not their number: one may be lost while another is found
        if set(plane_keys(paths, plane)) == set(plane_keys(before, plane)):
            words = f"{samples // _FACTOR:,} and {samples:,} rays a tower found the same {counted(len(paths), 'path')}"
            return Choice(samples, f"{words} at {counted(poses, 'pose')}".replace(",", " "))
        before = paths
    words = f"{samples:,} rays a tower still found other paths than {samples // _FACTOR:,} at {counted(poses, 'pose')}"
    return Choice(samples, words.replace(",", " "))

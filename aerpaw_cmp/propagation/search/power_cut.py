"""The power cut: paths so much longer than their link that they are weak are left out, and what that costs is checked.

A path of length ``L`` arrives with at most ``lambda / (4 pi L)`` between isotropic elements, for no reflection
coefficient exceeds 1 and losses only take away. Over a link of length ``d`` it is therefore at least
``20 log10(L / d)`` dB below free space, and a cut of ``X`` dB may leave out what is longer than ``d 10^(X / 20)``:
each path that goes is weaker than that, and ``n`` of them together than ``n 10^(-X / 20)`` of the free-space amplitude.
How many there are only a full search knows; so one is made of a few poses (:func:`loss_in_words`).
"""

from __future__ import annotations

import numpy as np

from ...common.units import FloatArray, amplitude_from_db
from ..paths import PathSet, path_lengths

CHECKED_POSES = 12
"""Poses, spread over the flight, that are searched without the cut."""

ROUNDING = 1e-9
"""A search may keep paths this much longer, relatively; what goes is decided in one place."""


def longest_m(sources_m: FloatArray, targets_m: FloatArray, cut_db: float) -> FloatArray:
    """Longest path (towers, poses) [m] that a cut leaves; NaN positions have no limit."""
    gap = np.stack([np.linalg.norm(targets_m - source, axis=1) for source in sources_m.reshape(-1, 3)])
    return np.asarray(np.where(np.isfinite(gap), gap * float(amplitude_from_db(cut_db)), np.inf))


def within_cut(paths: PathSet, sources_m: FloatArray, targets_m: FloatArray, cut_db: float) -> PathSet:
    """The paths that a cut leaves.

    Parameters
    ----------
    paths : PathSet
    sources_m, targets_m : (towers, 3), (poses, 3)
    cut_db : float

    Returns
    -------
    PathSet
        Lines of sight stay in any case.
    """
    gap = np.linalg.norm(targets_m[paths.pose] - sources_m[paths.tower], axis=1)
    short = path_lengths(paths, sources_m, targets_m) <= gap * float(amplitude_from_db(cut_db))
    return paths.select(short | (paths.depth == 0))


def loss_in_words(cut_db: float, whole: int, left_out: int, poses: int, change_db: FloatArray, lost: int) -> str:
    """Describe the effect of a cut, as the full search of a few poses shows it.

    Parameters
    ----------
    cut_db : float
    whole, left_out : int
        Paths of these poses, and those of them that the cut leaves out.
    poses : int
    change_db : (links,)
        Change of RSS of the links that have a level either way.
    lost : int
        Links that the cut leaves without a path.

    Returns
    -------
    str
    """
    ratio = float(amplitude_from_db(cut_db))
    worst = float(np.abs(change_db).max(initial=0.0))
    gone = f", {lost} links without any path" if lost else ""
    return (
        f"rt.advanced.power_cut_db {cut_db:g}: paths more than {ratio:.3g} times as long as their link, each at least "
        f"{cut_db:g} dB below free space there (isotropic elements); checked by a full search of {poses} poses: "
        f"{left_out} of {whole} paths, RSS changed by {worst:.2g} dB at most{gone}"
    )

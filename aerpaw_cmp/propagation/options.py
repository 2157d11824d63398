"""The options of a replay, in addition to site, link and poses: path search, further losses, cache and progress."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..common.units import BoolArray, FloatArray
from .geometry import PathSet

Engine = Literal["image", "sionna"]
# Values of ``rt.diffraction``. The searches for these paths are in :data:`aerpaw_cmp.propagation.edges.DIFFRACTION`.
Diffraction = Literal["none", "edges"]
Samples = int | Literal["auto"]
# ``loss(paths, sources_m, targets_m) -> (paths,)`` [dB], for the segments from source over ``paths.vertices_m`` to
# target.
Loss = Callable[[PathSet, FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class Search:
    """Options that determine the paths, in addition to the scene.

    Parameters
    ----------
    engine : {"image", "sionna"}
        Exhaustive image method, or Sionna's PathSolver as path finder.
    max_depth : int
        Largest number of reflections, 0 to 3.
    samples : int or "auto"
        ``sionna`` only: rays per tower; "auto" raises the number until two pilot searches find the same paths
        (:func:`aerpaw_cmp.propagation.engines.enough_samples`).
    batch : int
        ``sionna`` only: poses per call.
    further : tuple of callable
        Searches ``(scene, poses, link)`` of further kinds of paths, such as
        :func:`aerpaw_cmp.propagation.edges.over_edges`. Further paths are part of H, levels and ranks for both engines.
    links : (towers, poses) bool, optional
        Links to search. Other links have no path.
    """

    engine: Engine = "image"
    # The value of the paper's ray tracing.
    max_depth: int = 2
    samples: Samples = "auto"
    batch: int = 50
    further: tuple[Callable[..., Any], ...] = ()
    links: BoolArray | None = None


@dataclass(frozen=True, slots=True)
class Field:
    """Options that determine the field of the paths, in addition to arrays and materials.

    Parameters
    ----------
    loss : callable, optional
        Further loss per path [dB], such as foliage; infinite if the path is blocked.
    """

    loss: Loss | None = None

    def loss_db(self, paths: PathSet, sources_m: FloatArray, targets_m: FloatArray) -> FloatArray | None:
        """Return further loss (paths,) [dB] between sources and targets (poses, 3). None if there is no loss model.

        Sources are (towers, 3), or (poses, 1, 3) for a tower that moves.
        """
        if self.loss is not None and sources_m.ndim == 3:
            # use the pose as the tower, because a loss looks up its source by tower, but here each pose has a separate
            # source
            paths, sources_m = replace(paths, tower=paths.pose), sources_m[:, 0]
        return None if self.loss is None else self.loss(paths, sources_m, targets_m)


def extent_of(points_m: FloatArray) -> FloatArray:
    """Return two corners (2, 3) of the box of the known points (n, 3), for :class:`Run`."""
    known = points_m[np.isfinite(points_m).all(axis=1)]
    # two corners are enough, because they determine the same tolerance as all points
    return np.stack([known.min(axis=0), known.max(axis=0)]) if len(known) else known


Progress = Callable[[float], object]


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Options of running a replay. No option changes a result.

    Parameters
    ----------
    cache_dir : path, optional
        Folder in which paths are stored, ``""`` for no cache. Default for the ``sionna`` engine: ``AERPAW_CMP_CACHE``,
        else ``~/.cache/aerpaw-cmp``. The ``image`` engine is faster than a cache, and uses it only if this folder is
        given.
    extent_m : (points, 3), optional
        Points that span all poses of a job, if the poses are only a part of the job. The span determines the tolerance
        of the path search, so that a part has the same paths as in a replay of all poses.
    progress : callable, optional
        Called with the completed share.
    """

    cache_dir: str | Path | None = None
    extent_m: FloatArray | None = None
    progress: Progress | None = None

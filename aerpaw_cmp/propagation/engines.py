"""Path search by the requested engine, with a cache of earlier searches.

The cache is content-addressed. Paths depend on the faces, the ends and the search, but not on arrays, attitude or
power, so one entry is valid for every array.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from .. import __version__
from ..common.content import content_digest
from ..common.files import cache_folder, read_sealed, write_sealed
from ..common.text import counted
from ..common.units import FloatArray, spread_out
from ..common.versions import version
from .compiled import is_allowed, warn_once, why_missing
from .geometry import Faces, Link, PathSet, Poses
from .options import Run, Search
from .scene import Scene
from .search import mirror

# Number of faces above which paths with two reflections are searched by compiled beams. The result is the same.
MANY_FACES = 400

# PathSolver finds a wall of solid angle W with probability ``1 - exp(-N W / 4 pi)``, so the required rays depend on the
# smallest and farthest walls. Pilot searches on a batch of poses use more and more rays, until two of them find the
# same paths. A wall that both searches miss can still be lost at other poses. The audit reports such a wall. The
# constant is the number of rays per tower of the first pilot search.
FIRST = 10_000

_FACTOR = 4

# Largest number of rays per tower of a pilot search.
MOST = 2_560_000


def path_cache(search: Search, run: Run) -> PathCache | None:
    """Return the path cache of a replay, or None if it does not use one."""
    folder = run.cache_dir
    if folder is None:
        # do not cache paths of the image engine, which finds them faster than they can be read from a file
        if search.engine != "sionna":
            return None
        folder = cache_folder()
    return PathCache(Path(folder)) if str(folder) else None


@dataclass(frozen=True, slots=True)
class Choice:
    """The chosen number of rays per tower, and the reason for the choice."""

    samples: int
    reason: str


def enough_samples(pilot: Callable[[int], PathSet], faces: Faces, poses: int) -> Choice:
    """Find the number of rays at which two pilot searches agree.

    Parameters
    ----------
    pilot : callable
        ``pilot(samples)`` returns the paths of the poses of the pilot search.
    faces : Faces
    poses : int
        Number of poses of the pilot search, for the explanation.

    Returns
    -------
    Choice
    """
    plane = mirror.planes_of(faces)
    samples = FIRST
    before = pilot(samples)
    while samples < MOST:
        samples *= _FACTOR
        paths = pilot(samples)
        # compare the paths and not their number, because one path may be lost while another is found
        if set(mirror.plane_keys(paths, plane)) == set(mirror.plane_keys(before, plane)):
            words = (
                f"{samples // _FACTOR:,} and {samples:,} rays per tower found the same {counted(len(paths), 'path')}"
            )
            return Choice(samples, f"{words} at {counted(poses, 'pose')}".replace(",", " "))
        before = paths
    words = (
        f"{samples:,} rays per tower still found other paths than {samples // _FACTOR:,} at {counted(poses, 'pose')}"
    )
    return Choice(samples, words.replace(",", " "))


def chosen_samples(scene: Scene, link: Link, poses: Poses, search: Search, cache: PathCache | None) -> Choice | None:
    """Find the rays per tower at which two pilot searches on a batch of poses find the same paths.

    Parameters
    ----------
    scene, link, poses, search
        The same as in :func:`search_or_read`.
    cache : PathCache or None

    Returns
    -------
    Choice or None
        None if the number is given, or if the engine does not cast rays.
    """
    if search.engine != "sionna" or search.samples != "auto":
        return None
    known = np.flatnonzero(np.isfinite(poses.position_m).all(axis=1))
    some = known[spread_out(len(known), search.batch)]
    part = replace(scene, excluded=scene.excluded[:, some])
    few = poses[some]

    def pilot(samples: int) -> PathSet:
        # use the cache, because otherwise each report would repeat the pilot searches
        return search_or_read(part, link, few, replace(search, samples=samples), Run(), cache)[0]

    return enough_samples(pilot, scene.faces, len(some))


def search_or_read(
    scene: Scene, link: Link, poses: Poses, search: Search, run: Run, cache: PathCache | None
) -> tuple[PathSet, float, bool]:
    """Return paths, the seconds of their search, and whether they were read from the cache.

    Parameters
    ----------
    scene : Scene
    link : Link
    poses : Poses
    search : Search
        Search settings, with a number of samples if rays are cast.
    run : Run
    cache : PathCache or None

    Returns
    -------
    paths : PathSet
    seconds : float
    from_cache : bool
    """
    key = cache.key(scene, poses.position_m, link.carrier_hz, search) if cache else ""
    entry = cache.load(key) if cache else None
    if entry:
        return *entry, True
    started = time.perf_counter()
    paths = search_paths(scene, link, poses, search, run)
    seconds = time.perf_counter() - started
    if cache:
        cache.save(key, paths, seconds)
    return paths, seconds, False


def search_paths(scene: Scene, link: Link, poses: Poses, search: Search, run: Run) -> PathSet:
    """Return paths by the engine of ``search``.

    Parameters
    ----------
    scene, link, poses, search, run
        The same as in :func:`search_or_read`.

    Returns
    -------
    PathSet
    """
    depth = search.max_depth
    links = scene.links_to(poses)
    if by_beams(scene, search):
        from .search import beams  # compiled code, which is loaded only for many faces

        if scene.surfaces is not None:
            return beams.grow_paths(scene.surfaces, links, run, max_depth=depth)
        return beams.find_paths(scene.faces, links, run, max_depth=depth, extent_m=run.extent_m)
    if search.engine == "image":
        return mirror.find_paths(scene.faces, links, max_depth=depth, extent_m=run.extent_m, progress=run.progress)
    from .search import sionna

    return sionna.find_paths(
        scene.faces, links, search, carrier_hz=link.carrier_hz, surfaces=scene.surfaces, progress=run.progress,
    )  # fmt: skip


def by_beams(scene: Scene, search: Search) -> bool:
    """Check whether the image engine searches by compiled beams, as in a scene of triangles or among many faces."""
    if search.engine != "image":
        return False
    if scene.surfaces is not None:
        return True
    if search.max_depth < 2 or len(scene.faces) <= MANY_FACES or not is_allowed() or find_spec("numba") is None:
        return False
    reason = why_missing()
    if reason:
        warn_once(reason)
    return not reason


# ------------------------------------------------------------------------------------------------------- the cache

# Version of the entries. Increase it if the entries or the search change.
LAYOUT = 4

# Columns of an entry. The terrain changes paths after the search.
_STORED = ("pose", "tower", "depth", "faces", "vertices_m")

# Mark that is written after the entry, before the SHA-256 of all preceding bytes.
_SEAL = b"AERPAWCP"


class PathCache:
    """A cache of path sets, stored as ``<sha256>.npz`` in one folder.

    Parameters
    ----------
    folder : Path
        Folder, which is created when the first entry is saved.

    Attributes
    ----------
    warnings : list of str
        Messages about damaged entries.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.warnings: list[str] = []

    def key(self, scene: Scene, targets_m: FloatArray, carrier_hz: float, search: Search) -> str:
        """Return the digest of everything that determines the paths.

        Parameters
        ----------
        scene : Scene
            Faces, sources and obstacles.
        targets_m : (n, 3)
            Poses [m].
        carrier_hz : float
            Carrier frequency, only used for Sionna: paths of the image engine do not depend on it.
        search : Search
            Engine, depth, samples and other search options.

        Returns
        -------
        str
            SHA-256, in hexadecimal.
        """
        faces, surfaces = scene.faces, scene.surfaces
        decides: list[object] = [__version__, LAYOUT, search.engine, search.max_depth, search.samples, search.batch]
        if search.engine == "sionna":
            # include the versions, because another version of Sionna's tracer may find other paths
            decides += [[version(name) for name in ("sionna-rt", "mitsuba", "drjit")], carrier_hz, faces.material]
        columns = (faces.normal, faces.offset_m, faces.along, faces.lower, faces.upper, faces.solid)
        mesh = None if surfaces is None else (surfaces.corners_m, surfaces.first)
        # include which links and mirrors are used, because they also change the result
        links = (scene.sources_m, scene.usable, scene.excluded, targets_m)
        return content_digest(decides, faces.polygon, columns, mesh, links)

    def load(self, key: str) -> tuple[PathSet, float] | None:
        """Return the paths and the seconds of their search. None if there is no valid entry (see ``warnings``)."""
        place = self.folder / f"{key}.npz"
        try:
            entry = read_sealed(place, _SEAL)
        except ValueError:
            self.warnings.append(
                f"a damaged entry of the path cache was ignored, and the paths were searched again: {place}"
            )
            return None
        if entry is None:
            return None
        # do not allow pickles: an entry in a shared folder must not run code
        with np.load(io.BytesIO(entry), allow_pickle=False) as columns:
            return PathSet(**{name: columns[name] for name in _STORED}), float(columns["seconds"])

    def save(self, key: str, paths: PathSet, seconds: float) -> None:
        """Write an entry atomically."""
        entry, columns = io.BytesIO(), {name: getattr(paths, name) for name in _STORED}
        np.savez(entry, seconds=np.float64(seconds), **columns)
        write_sealed(self.folder / f"{key}.npz", entry.getvalue(), _SEAL)

"""Content-addressed cache of paths on disk.

Paths depend on the faces, the ends and the search, not on arrays, attitude or power: one entry serves every array.
"""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..common.files import read_sealed, write_sealed
from ..common.units import AnyArray, FloatArray
from ..common.versions import version
from .options import Search
from .paths import PathSet
from .scene import Scene

# Raised whenever the entries or the search change.
LAYOUT = 4

# Stands behind the entry, before the SHA-256 of all bytes in front of it.
_SEAL = b"AERPAWCP"

_COLUMNS = ("pose", "tower", "depth", "faces", "vertices_m")


class PathCache:
    """Path sets as ``<sha256>.npz`` in one folder.

    Parameters
    ----------
    folder : Path
        Created when the first entry is saved.

    Attributes
    ----------
    warnings : list of str
        Entries that were damaged, for people.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.warnings: list[str] = []

    def key(
        self,
        scene: Scene,
        targets_m: FloatArray,
        carrier_hz: float,
        search: Search,
    ) -> str:
        """Digest of everything that decides the paths.

        Parameters
        ----------
        scene : Scene
            Faces, sources and what hides them.
        targets_m : (n, 3)
            Poses [m].
        carrier_hz : float
            Counts for Sionna alone: an image path is the same at every frequency.
        search : Search
            Engine, depth, samples and the rest.

        Returns
        -------
        str
            SHA-256, in hexadecimal.
        """
        digest = hashlib.sha256()
        versions = [__version__, str(LAYOUT)]
        if search.engine == "sionna":
            versions += [version(name) for name in ("sionna-rt", "mitsuba", "drjit")]
            versions += [str(carrier_hz), *scene.faces.material]
        text = "\n".join([*versions, *(f"{k}={v}" for k, v in sorted(search.deciding.items()))])
        digest.update(text.encode())
        faces = scene.faces
        for polygon in faces.polygon:
            digest.update(b"-" if polygon is None else polygon.wkb)
        if scene.surfaces is not None:
            digest.update(scene.surfaces.corners_m.tobytes() + scene.surfaces.first.tobytes())
        columns = (faces.normal, faces.offset_m, faces.along, faces.lower, faces.upper, faces.solid)
        for column in (*columns, scene.sources_m, scene.usable, scene.excluded, targets_m):
            digest.update(str(column.shape).encode() + np.ascontiguousarray(column).tobytes())
        return digest.hexdigest()

    def load(self, key: str) -> tuple[PathSet, float] | None:
        """Paths and the seconds that their search took; None where there is no whole entry (see ``warnings``)."""
        columns = self._columns(key)
        if columns is None:
            return None
        return PathSet(*(columns[name] for name in _COLUMNS)), float(columns["seconds"])

    def _columns(self, key: str) -> dict[str, AnyArray] | None:
        place = self.folder / f"{key}.npz"
        try:
            entry = read_sealed(place, _SEAL)
        except ValueError:
            self.warnings.append(
                f"a damaged entry of the path cache was not used, the paths were searched anew: {place}"
            )
            return None
        if entry is None:
            return None
        with np.load(io.BytesIO(entry), allow_pickle=False) as columns:
            return {name: columns[name] for name in columns.files}

    def save(self, key: str, paths: PathSet, seconds: float) -> None:
        """Write an entry; another process sees either nothing or all of it."""
        self._write(key, {"seconds": np.float64(seconds), **{column: getattr(paths, column) for column in _COLUMNS}})

    def _write(self, key: str, columns: dict[str, Any]) -> None:
        entry = io.BytesIO()
        np.savez(entry, **columns)
        write_sealed(self.folder / f"{key}.npz", entry.getvalue(), _SEAL)

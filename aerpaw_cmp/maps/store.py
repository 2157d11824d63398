"""Tiles of a map in a Zarr store: written as they come, read back as a map; one that is half written is gone on with.

The store has the variables of ``maps.nc`` (:mod:`aerpaw_cmp.maps.netcdf`), a tile a chunk. ``tile_paths`` says which
tiles are there; a tile is entered when its chunks are written, so that a killed run costs what was in work.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..common.errors import UsageError, one_line
from ..common.geodesy import SiteFrame
from ..common.outputs import explained_os_errors, files_below, foreign_entries, hidden_name
from .grid import Grid
from .job import MapResult
from .netcdf import maps_dataset
from .tiles import PLANES, Tiling, over_grid

LEDGER = "tile_paths"
_NOT_COMPUTED = -1
_JOB = "aerpaw_cmp_job"
# Files of a store of Zarr 3, as names below its folder.
_OURS = re.compile(r"zarr\.json|\w+/(zarr\.json|c(/\d+)*)")
_NAMES = dict(zip(PLANES, ("rss_siso", "rss_mimo", "rss_sd", "rank", "spread", "condition"), strict=True))


class TileStore:
    """A store that tiles of one job are written to.

    Parameters
    ----------
    path : Path
        Folder of the store; made by :meth:`begin`.
    tiling : Tiling
    job : mapping
        All that the values depend on, as JSON takes it; a store of another job is refused.
    force : bool
        Replace the store of another job.

    Raises
    ------
    UsageError
        zarr is not installed, or what has the name is no store of this job.
    """

    def __init__(self, path: Path, tiling: Tiling, job: Mapping[str, Any], *, force: bool = False) -> None:
        try:
            import zarr
        except ImportError:
            raise UsageError(
                "zarr is not installed, and a map in tiles is a Zarr store",
                expected="pip install 'aerpaw-cmp[geo]' with Python 3.11 or newer, or a larger --spacing",
            ) from None
        self.path, self.tiling, self._zarr, self._job = path, tiling, zarr, json.loads(json.dumps(job))
        if os.path.lexists(path) and self._is_other_job(force):
            with explained_os_errors(path):
                self._refuse_foreign()
                shutil.rmtree(path)

    def _refuse_foreign(self) -> None:
        """UsageError where a store that is to be replaced holds what this tool did not write."""
        names = (file.relative_to(self.path).as_posix() for file in files_below(self.path))
        if foreign := next(foreign_entries(self.path, filter(_OURS.fullmatch, names)), None):
            raise UsageError(
                f"the store holds what this tool did not write: {one_line(foreign)}",
                expected="another name after -o: a store is replaced as a whole",
                path=self.path,
            )

    def _is_other_job(self, force: bool) -> bool:
        """Check whether a store may be replaced; UsageError where it is neither this job's nor to be replaced."""
        try:
            job = json.loads(self._zarr.open_group(self.path, mode="r").attrs[_JOB])
        except (OSError, ValueError, LookupError, TypeError):
            raise UsageError(
                "the folder exists, and it is no map store of this tool",
                expected="another name after -o, or this folder moved away",
                cause="data of another program, or a damaged zarr.json",
                path=self.path,
            ) from None
        differs = sorted(key for key in {*job, *self._job} if job.get(key) != self._job.get(key))
        if differs and not force:
            key = differs[0]
            more = f" and {len(differs) - 1} more" if len(differs) > 1 else ""
            raise UsageError(
                f"the store holds tiles of another job: {key}{more} differs ({job.get(key)}, now {self._job.get(key)})",
                expected="another name after -o, or --force to replace the store",
                path=self.path,
            )
        return bool(differs)

    def begin(self, empty: Mapping[str, MapResult], frame: SiteFrame, about: Mapping[str, str]) -> list[int]:
        """Make the store unless it is there; the tiles that it lacks.

        Parameters
        ----------
        empty : mapping of str to MapResult
            Maps of any tile, by foliage mode: their form.
        frame : SiteFrame
        about : mapping of str to str
            Attributes of the store.

        Returns
        -------
        list of int
            Numbers of the tiles.
        """
        self._frame, self._about = frame, about
        with explained_os_errors(self.path):
            if not self.path.exists():
                part = hidden_name(self.path, "part")
                shutil.rmtree(part, ignore_errors=True)
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._make(part, maps_dataset(empty, frame, about))
                part.rename(self.path)
            self._group = self._zarr.open_group(self.path, mode="r+")
            return [int(number) for number in np.flatnonzero(self.paths() == _NOT_COMPUTED)]

    def _make(self, part: Path, like: Any) -> None:
        grid = self.tiling.grid
        planes = [name for name, variable in like.variables.items() if {"y", "x"} <= {*variable.dims}]
        axes = like.drop_vars(planes).assign_coords(
            x=("x", grid.east_m, like.x.attrs), y=("y", grid.north_m, like.y.attrs)
        )
        axes.to_zarr(part, mode="w", consolidated=False)
        group = self._zarr.open_group(part, mode="r+")
        for name in planes:
            variable = like[name].variable
            leading = variable.shape[:-2]
            tile = np.minimum(self.tiling.cells, grid.shape).tolist()
            plain = {
                key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in variable.attrs.items()
            }
            group.create_array(
                name, shape=(*leading, *grid.shape), chunks=(*leading, *tile),
                dtype=variable.dtype, fill_value=np.nan if variable.dtype.kind == "f" else 0,
                dimension_names=variable.dims, attributes=plain,
            )  # fmt: skip
        group.create_array(
            LEDGER, shape=self.tiling.shape, chunks=(1, 1), dtype=np.int64, fill_value=_NOT_COMPUTED,
            dimension_names=("tile_y", "tile_x"),
            attributes={"long_name": "paths of each tile", "comment": "-1: not computed yet"},
        )  # fmt: skip
        group.attrs[_JOB] = json.dumps(self._job)

    def paths(self) -> Any:
        """Paths of each tile (tile rows, tile columns); -1 of one that is not there."""
        return np.asarray(self._group[LEDGER][:])

    def write(self, number: int, maps: Mapping[str, MapResult], paths: int) -> None:
        """Write one tile; :class:`~aerpaw_cmp.common.errors.OutputError` where the disk does not take it.

        Parameters
        ----------
        number : int
        maps : mapping of str to MapResult
            By foliage mode.
        paths : int
            How many there are.
        """
        rows, columns = self.tiling.part(number)
        with explained_os_errors(self.path):
            for name, variable in maps_dataset(maps, self._frame, self._about).variables.items():
                if {"y", "x"} <= {*variable.dims}:
                    self._group[name][..., rows, columns] = variable.values
            self._group[LEDGER][divmod(number, self.tiling.shape[1])] = paths

    def read(self, empty: Mapping[str, MapResult], step: int) -> dict[str, MapResult]:
        """Maps of every ``step``-th position each way, by foliage mode; ``empty`` as for :meth:`begin`."""
        full = self.tiling.grid
        grid = Grid(full.east_m[::step], full.north_m[::step], full.spacing_m * step)
        maps = {}
        for number, (mode, like) in enumerate(empty.items()):
            values = {}
            for field, name in _NAMES.items():
                plane = np.asarray(self._group[name][number, ..., ::step, ::step])
                leading = range(plane.ndim - 2)[::-1]
                kind = np.int8 if field == "rank" else np.float64
                values[field] = plane.transpose(*leading, -2, -1).reshape(*plane.shape[-3::-1], -1).astype(kind)
            maps[mode] = over_grid(like, grid, values)
        return maps

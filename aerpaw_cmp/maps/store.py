"""Tiles of a map: towers and buildings that can reach a tile, a file per finished tile, and a Zarr store of all.

A killed run loses only the tiles that were being computed. The same command then computes these and all remaining
tiles. A tile file contains its SHA-256, the number of paths, and the planes of :data:`PLANES` as 32-bit floats. A tile
file cannot contain executable code. A tile whose file has a different length or digest is computed again.

A tile is evaluated with the towers and buildings that can reach it. With at most one reflection over level ground, a
path seen from above is the line between its ends, or two lines from a tower to a wall and on to the tile. Therefore, no
relevant building is omitted if all buildings are used that touch

- the convex hull of tower and tile (which also contains the reflections off ground and roofs), or
- the hull of tower and wall, or the hull of wall and tile, for each wall whose beam from the mirrored tower may reach
  the tile.

With more reflections, terrain or a scene of triangles, all buildings are used.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from ..common.errors import InputError, UsageError
from ..common.files import read_bounded, write_whole
from ..common.geodesy import SiteFrame
from ..common.outputs import explained_os_errors
from ..common.units import AnyArray, BoolArray, FloatArray, wavelength_m
from ..propagation.geometry import corners, site_faces
from ..propagation.scene import REACH_M
from ..propagation.search.mirror import REACH_SLACK_M, Growth
from ..site.site import Site, Tower
from .export import maps_dataset
from .grid import Grid, MapResult, serving_tower, voronoi_borders

# A building within this distance of a hull is used [m]. The distance is far larger than rounding errors.
NEAR_M = 0.01

# Largest level above free space [dB]: the level of ten paths in phase, each as strong as the direct path.
_IN_PHASE_DB = 20.0

# Fields of a :class:`~aerpaw_cmp.maps.grid.MapResult` with a value per position.
PLANES = ("rss_siso_dbm", "rss_mimo_dbm", "level_sd_db", "rank", "spread_db", "condition_db")


@dataclass(frozen=True, slots=True)
class Tiling:
    """A grid in square tiles with ``cells`` positions per side, numbered like positions.

    Tiles at the edge may be smaller.
    """

    grid: Grid
    cells: int

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of rows and columns of tiles."""
        rows, columns = self.grid.shape
        return -(-rows // self.cells), -(-columns // self.cells)

    def __len__(self) -> int:
        return self.shape[0] * self.shape[1]

    def part(self, number: int) -> tuple[slice, slice]:
        """Return the rows and columns of the grid that belong to one tile."""
        row, column = divmod(number, self.shape[1])
        rows, columns = self.grid.shape
        return (
            slice(row * self.cells, min((row + 1) * self.cells, rows)),
            slice(column * self.cells, min((column + 1) * self.cells, columns)),
        )

    def grid_of(self, number: int) -> Grid:
        """Return the positions of one tile."""
        rows, columns = self.part(number)
        return Grid(self.grid.east_m[columns], self.grid.north_m[rows], self.grid.spacing_m)

    def joined(
        self, tiles: Iterable[tuple[Mapping[str, MapResult], int]], step: int = 1
    ) -> tuple[dict[str, MapResult], int]:
        """Return the maps of the complete grid by foliage mode, and the number of paths.

        Parameters
        ----------
        tiles : iterable of (mapping of str to MapResult, int)
            Maps by foliage mode and number of paths of each tile, in the order of the tiles.
        step : int
            The maps contain every ``step``-th position along either axis. The paths to all positions are counted.
        """
        grid = Grid(self.grid.east_m[::step], self.grid.north_m[::step], self.grid.spacing_m * step)
        rasters: dict[tuple[str, str], AnyArray] = {}
        maps: Mapping[str, MapResult] = {}
        total = 0
        for number, (maps, paths) in enumerate(tiles):
            total += paths
            part = self.part(number)
            inner = tuple(slice(-axis.start % step, None, step) for axis in part)
            outer = tuple(slice(-(-axis.start // step), -(-axis.stop // step)) for axis in part)
            for mode, name in itertools.product(maps, PLANES):
                plane = getattr(maps[mode], name)
                if number == 0:
                    rasters[mode, name] = np.empty((*plane.shape[:-1], *grid.shape), dtype=plane.dtype)
                tile = plane.reshape(*plane.shape[:-1], *maps[mode].grid.shape)
                rasters[mode, name][..., outer[0], outer[1]] = tile[..., inner[0], inner[1]]
        flat = {key: raster.reshape(*raster.shape[:-2], -1) for key, raster in rasters.items()}
        return {m: over_grid(like, grid, {name: flat[m, name] for name in PLANES}) for m, like in maps.items()}, total


def over_grid(like: MapResult, grid: Grid, values: Mapping[str, Any]) -> MapResult:
    """Return a map over another grid, with its values of :data:`PLANES`, serving towers and their borders."""
    return replace(
        like,
        grid=grid,
        serving=serving_tower(grid.points_m, like.towers_m),
        borders=voronoi_borders(like.towers_m, grid.area_m),
        **values,
    )


def range_m(carrier_hz: float, power_dbm: float, floor_dbm: float) -> float:
    """Return the distance beyond which no level is above a floor [m].

    ``power_dbm`` is the transmit power plus the gain of the arrays when all elements add in phase. The level is at most
    :data:`_IN_PHASE_DB` above free space.
    """
    spare_db = power_dbm + _IN_PHASE_DB - floor_dbm
    return float(wavelength_m(carrier_hz) / (4 * np.pi) * 10 ** (spare_db / 20))


class Reach:
    """An index of the towers and buildings of a site that can reach a tile.

    Parameters
    ----------
    site : Site
    reach_m : float
        Distance beyond which a tower is out of coverage, such as :func:`range_m`.
    max_depth : int
        Largest number of reflections.
    """

    def __init__(self, site: Site, reach_m: float, *, max_depth: int) -> None:
        self.site, self._reach_m, self._depth = site, reach_m, max_depth
        self._every = max_depth > 1 or site.dem is not None or site.scene is not None or not site.buildings
        footprints = shapely.envelope([building.footprint for building in site.buildings])
        places = [tower.position_m[:2] for tower in site.towers.values()]
        spans = (site.area_m, np.ravel(places), shapely.bounds(footprints).ravel())
        farthest = np.nanmax(np.abs(np.concatenate(spans)))
        # corners (2, 3) of a box around the site in any rotation. The box sets equal tolerances for all tiles.
        self.extent_m = np.sqrt(2.0) * farthest * np.array([[-1.0] * 3, [1.0] * 3])
        if self._every:
            return
        faces = site_faces(site)
        bounds = shapely.bounds(footprints) + NEAR_M * np.array([-1.0, -1.0, 1.0, 1.0])
        self._near = shapely.STRtree(shapely.box(*bounds.T))
        self._ends = corners(faces, 1e9)[:, :2, :2]  # plan view: the ends of each wall's lower edge
        self._is_wall = (faces.solid >= 0) & (faces.normal[:, 2] == 0.0)
        self._growth = Growth.of(faces, self.extent_m, REACH_SLACK_M, max_depth=1, budget=len(faces) + 1)

    def of(self, box_m: FloatArray) -> Site:
        """Return the site with the towers and buildings that reach a box (lowest and highest corner, 3)."""
        every, reach = self.site.towers.items(), self._reach_m
        towers = {name: tower for name, tower in every if np.linalg.norm(_box_distances(tower, box_m)) <= reach}
        if not any(_box_distances(tower, box_m).max() <= REACH_M for tower in towers.values()):
            towers = {}
        if self._every:
            return replace(self.site, towers=towers)
        near = np.zeros(len(self.site.buildings), dtype=np.bool_)
        for tower in towers.values():
            near |= self._buildings_in_reach(tower, box_m)
        buildings = tuple(self.site.buildings[number] for number in np.flatnonzero(near))
        return replace(self.site, towers=towers, buildings=buildings)

    def _buildings_in_reach(self, tower: Tower, box_m: FloatArray) -> BoolArray:
        """Check which buildings (buildings,) can reflect or block paths from one tower into a box."""
        at, (west, south), (east, north) = tower.position_m[:2], *box_m[:, :2]
        tile = np.array([[west, south], [east, south], [east, north], [west, north]])
        lines = [shapely.linestrings(np.vstack([at, tile])[None])]
        if self._depth:
            # consider only walls: seen from above, a path over ground or roof is on the line between its ends
            lit = self._growth.mirrors(tower.position_m, box_m)
            lit = lit[self._is_wall[lit]]
            walls = self._ends[lit]
            every = np.broadcast_to(tile, (len(lit), *tile.shape))
            ways = np.insert(walls, 2, at, axis=1), np.concatenate([walls, every], axis=1)
            lines += map(shapely.linestrings, ways)
        near = np.zeros(len(self.site.buildings), dtype=np.bool_)
        for shapes in map(shapely.convex_hull, lines):
            near[self._near.query(shapes, predicate="intersects")[1]] = True
        return near


def _box_distances(tower: Tower, box_m: FloatArray) -> FloatArray:
    """Return the distances (2,) from a tower to the nearest point of a box, east and north."""
    at = tower.position_m[:2]
    return np.maximum(np.maximum(box_m[0, :2] - at, at - box_m[1, :2]), 0.0)


# Names of tile files of this and of other runs, which a finished run removes.
_TILE_FILE = re.compile(r"tile-[0-9a-f]{16}-\d+|\.tile-[0-9a-f]{16}-\d+\.\w+\.part")


class TileStore:
    """A folder with a file for each finished tile of one job.

    Parameters
    ----------
    folder : Path
        Folder, which is created with the first tile. Files that are not tiles are neither read nor removed.
    tiling : Tiling
    job : mapping
        All inputs of the values, as JSON values. Tiles of a different job are not used.
    empty : mapping of str to MapResult
        Maps by foliage mode, from which the shapes of all tiles are taken.

    Attributes
    ----------
    damaged : int
        Number of tile files that :meth:`missing` found to be damaged.

    Raises
    ------
    UsageError
        If zarr is not installed.
    """

    def __init__(self, folder: Path, tiling: Tiling, job: Mapping[str, Any], empty: Mapping[str, MapResult]) -> None:
        try:
            import zarr  # noqa: F401
        except ImportError:
            raise UsageError(
                "zarr is not installed, and a map in tiles is a Zarr store",
                expected="pip install 'aerpaw-cmp[geo]' with Python 3.11 or newer, or a larger --spacing",
            ) from None
        self.folder, self.tiling, self._empty, self.damaged = folder, tiling, empty, 0
        self._job = hashlib.sha256(json.dumps([job, tiling.cells], sort_keys=True).encode()).hexdigest()[:16]

    def missing(self) -> list[int]:
        """Return the numbers of the tiles that must be computed."""
        with explained_os_errors(self.folder):
            missing = [number for number in range(len(self.tiling)) if self._content(number) is None]
            self.damaged = sum(self._file(number).exists() for number in missing)
        return missing

    def write(self, number: int, maps: Mapping[str, MapResult], paths: int) -> None:
        """Write the file of one tile atomically.

        Parameters
        ----------
        number : int
        maps : mapping of str to MapResult
            Maps by foliage mode.
        paths : int
            Number of paths to all positions of the tile.

        Raises
        ------
        OutputError
            If the file cannot be written.
        """
        planes = (getattr(maps[mode], name).astype("<f4").tobytes() for mode in self._empty for name in PLANES)
        content = paths.to_bytes(8, "little") + b"".join(planes)
        with explained_os_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            write_whole(self._file(number), hashlib.sha256(content).digest() + content)

    def read(self, number: int) -> tuple[dict[str, MapResult], int]:
        """Return the maps of one tile by foliage mode, and its number of paths.

        Raises
        ------
        InputError
            If the file of the tile is missing or damaged.
        """
        with explained_os_errors(self.folder):
            content = self._content(number)
        if content is None:
            raise InputError(
                "a finished tile is missing or damaged",
                expected="the file as it was written: run the same command again",
                cause="another program changed or removed the file during this run",
                path=self._file(number),
            )
        values, start, maps = np.frombuffer(content, dtype="<f4", offset=8), 0, {}
        grid = self.tiling.grid_of(number)
        for mode, like in self._empty.items():
            planes = {}
            for name in PLANES:
                form = getattr(like, name)
                shape = (*form.shape[:-1], len(grid))
                stop = start + math.prod(shape)
                planes[name] = values[start:stop].reshape(shape).astype(form.dtype)
                start = stop
            maps[mode] = over_grid(like, grid, planes)
        return maps, int.from_bytes(content[:8], "little")

    def write_zarr(self, path: Path, frame: SiteFrame, about: Mapping[str, str]) -> Path:
        """Write all tiles as a new Zarr store with the variables of ``maps.nc``, one chunk per tile.

        Parameters
        ----------
        path : Path
            New file, which must not exist.
        frame : SiteFrame
        about : mapping of str to str
            Attributes of the store.

        Returns
        -------
        Path
        """
        grid = self.tiling.grid
        like = maps_dataset(self._empty, frame, about).to_xarray()
        planes = [name for name, variable in like.variables.items() if {"y", "x"} <= {*variable.dims}]
        store = like.drop_vars(planes).assign_coords(
            x=("x", grid.east_m, like.x.attrs), y=("y", grid.north_m, like.y.attrs)
        )
        chunks, tile = {}, np.minimum(self.tiling.cells, grid.shape).tolist()
        for name in planes:
            (*leading, _, _), kind = like[name].shape, like[name].dtype
            # a broadcast number, which needs no memory. Chunks of such an array are not written.
            fill = np.array(np.nan if kind.kind == "f" else 0, dtype=kind)
            store[name] = like[name].dims, np.broadcast_to(fill, (*leading, *grid.shape)), like[name].attrs
            chunks[name] = {"chunks": (*leading, *tile), "fill_value": fill.item(), "_FillValue": None}
        store.to_zarr(path, mode="w-", consolidated=False, zarr_format=3, encoding=chunks, write_empty_chunks=False)
        for number in range(len(self.tiling)):
            rows, columns = self.tiling.part(number)
            computed = maps_dataset(self.read(number)[0], frame, about).to_xarray()
            computed[planes].drop_vars(computed.coords).to_zarr(
                path, mode="r+", consolidated=False, region={"y": rows, "x": columns}
            )
        return path

    def remove(self) -> None:
        """Remove all tile files, including those of killed runs with other settings, and the empty folder."""
        with suppress(OSError):  # the results are complete, and the next run removes the files
            for place in self.folder.iterdir():
                if _TILE_FILE.fullmatch(place.name):
                    place.unlink()
            self.folder.rmdir()

    def _file(self, number: int) -> Path:
        return self.folder / f"tile-{self._job}-{number}"

    def _content(self, number: int) -> bytes | None:
        """Return paths and planes of one tile as bytes. None if there is no intact file."""
        values = sum(getattr(like, name)[..., 0].size for like in self._empty.values() for name in PLANES)
        size = 40 + 4 * values * len(self.tiling.grid_of(number))
        with suppress(FileNotFoundError, NotADirectoryError, InputError):
            content = read_bounded(self._file(number), size)
            if len(content) == size and hashlib.sha256(content[32:]).digest() == content[:32]:
                return content[32:]
        return None

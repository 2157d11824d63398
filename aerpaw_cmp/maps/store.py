"""Tiles of a map in a Zarr store. They are written as they are computed, and a partial store is continued.

The store has the variables of ``maps.nc`` (:mod:`aerpaw_cmp.maps.export`), with one chunk per tile. ``tile_sha256``
contains the SHA-256 of the chunk files of each tile and is written with them. A killed run loses only the tiles in
work, and a tile whose files are missing or changed is computed again.

An existing store is untrusted until its metadata match, as text, those that this job would write, because Zarr runs the
codecs that a store names.

The module also determines what can reach each tile, and joins the values of tiles.

A tile is evaluated with the towers and buildings that can reach it. No relevant building is omitted if at most one
reflection is followed over level ground: seen from above, a path then lies on the line between its ends, or on the two
lines from a tower to a wall and on to the tile. A building therefore counts if it comes near

- the convex hull of tower and tile (which also contains the reflections off ground and roofs), or
- the hull of tower and wall, or of wall and the part of the tile in its beam. This holds for each wall whose beam from
  the mirrored tower may meet the tile.

With more reflections, terrain or a scene of triangles every building is included.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from ..common.errors import InputError, UsageError, one_line, parsing
from ..common.files import read_input, write_whole
from ..common.geodesy import SiteFrame
from ..common.outputs import explained_os_errors, foreign_entries
from ..common.units import AnyArray, BoolArray, FloatArray, IntArray, wavelength_m
from ..propagation.geometry import corners, site_faces
from ..propagation.scene import REACH_M
from ..propagation.search.mirror import Mirrors
from ..site.site import Site, Tower
from .export import maps_dataset
from .grid import Grid, MapResult, serving_tower, voronoi_borders

# A building this close to a hull counts [m]: far above the rounding of any plane.
NEAR_M = 0.01

# How far several paths may lift a level over that of free space [dB]: ten as strong as the direct one, in phase.
_IN_PHASE_DB = 20.0

# Fields of a :class:`~aerpaw_cmp.maps.grid.MapResult` with a value per position.
PLANES = ("rss_siso_dbm", "rss_mimo_dbm", "level_sd_db", "rank", "spread_db", "condition_db")


@dataclass(frozen=True, slots=True)
class Tiling:
    """A grid in square tiles with ``cells`` positions per side, numbered like positions. The last may be smaller."""

    grid: Grid
    cells: int

    @property
    def shape(self) -> tuple[int, int]:
        """The rows and columns of tiles."""
        rows, columns = self.grid.shape
        return -(-rows // self.cells), -(-columns // self.cells)

    def __len__(self) -> int:
        return self.shape[0] * self.shape[1]

    def part(self, number: int) -> tuple[slice, slice]:
        """Rows and columns of the grid that are one tile."""
        row, column = divmod(number, self.shape[1])
        return slice(row * self.cells, (row + 1) * self.cells), slice(column * self.cells, (column + 1) * self.cells)

    def grid_of(self, number: int) -> Grid:
        """Positions of one tile."""
        rows, columns = self.part(number)
        return Grid(self.grid.east_m[columns], self.grid.north_m[rows], self.grid.spacing_m)

    def joined(self, parts: Mapping[int, MapResult]) -> MapResult:
        """The map of the whole grid from those of all tiles."""
        first = next(iter(parts.values()))
        values = {}
        for name in PLANES:
            like = getattr(first, name)
            plane = np.empty((*like.shape[:-1], *self.grid.shape), dtype=like.dtype)
            for number, tile in parts.items():
                rows, columns = self.part(number)
                plane[..., rows, columns] = getattr(tile, name).reshape(*like.shape[:-1], *tile.grid.shape)
            values[name] = plane.reshape(*like.shape[:-1], -1)
        return over_grid(first, self.grid, values)


def over_grid(like: MapResult, grid: Grid, values: Mapping[str, Any]) -> MapResult:
    """A map over another grid, with its values of :data:`PLANES`, serving towers and their borders."""
    return replace(
        like,
        grid=grid,
        serving=serving_tower(grid.points_m, like.towers_m),
        borders=voronoi_borders(like.towers_m, grid.area_m),
        **values,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Limits of what a tower reaches.

    Parameters
    ----------
    carrier_hz, transmit_power_dbm : float
    gain_db : float
        Gain of the arrays when all elements add in phase.
    floor_dbm : float
        Levels below it are out of coverage.
    """

    carrier_hz: float
    transmit_power_dbm: float
    gain_db: float
    floor_dbm: float

    @property
    def range_m(self) -> float:
        """Distance beyond which no sum of paths reaches the floor: free space and :data:`_IN_PHASE_DB`."""
        spare_db = self.transmit_power_dbm + self.gain_db + _IN_PHASE_DB - self.floor_dbm
        return float(wavelength_m(self.carrier_hz) / (4 * np.pi) * 10 ** (spare_db / 20))


class Reach:
    """Index over the towers and buildings of a site: those that can reach a tile.

    Parameters
    ----------
    site : Site
    budget : Budget
    max_depth : int
        Reflections that are followed.
    """

    def __init__(self, site: Site, budget: Budget, *, max_depth: int) -> None:
        self.site, self._range_m, self._depth = site, budget.range_m, max_depth
        self._every = max_depth > 1 or site.dem is not None or site.scene is not None or not site.buildings
        footprints = shapely.envelope([building.footprint for building in site.buildings])
        places = [tower.position_m[:2] for tower in site.towers.values()]
        spans = (site.area_m, np.ravel(places), shapely.bounds(footprints).ravel())
        farthest = np.nanmax(np.abs(np.concatenate(spans)))
        # corners (2, 3) of a box round everything, however the site is turned: it sets the tolerances of all tiles
        self.extent_m = np.sqrt(2.0) * farthest * np.array([[-1.0] * 3, [1.0] * 3])
        if self._every:
            return
        faces = self._faces = site_faces(site)
        bounds = shapely.bounds(footprints) + NEAR_M * np.array([-1.0, -1.0, 1.0, 1.0])
        self._near = shapely.STRtree(shapely.box(*bounds.T))
        self._ends = corners(faces, 1e9)[:, :2, :2]  # along the foot of a wall
        self._is_wall = (faces.solid >= 0) & (faces.normal[:, 2] == 0.0)
        self._mirrors = Mirrors(faces, self.extent_m)

    def of(self, box_m: FloatArray) -> Site:
        """The site as it reaches a box (lowest and highest corner, 3)."""
        every, reach = self.site.towers.items(), self._range_m
        towers = {name: tower for name, tower in every if np.linalg.norm(_apart(tower, box_m)) <= reach}
        if not any(_apart(tower, box_m).max() <= REACH_M for tower in towers.values()):
            towers = {}
        if self._every:
            return replace(self.site, towers=towers)
        near = np.zeros(len(self.site.buildings), dtype=np.bool_)
        for tower in towers.values():
            near |= self._buildings_in_reach(tower, box_m)
        buildings = tuple(self.site.buildings[number] for number in np.flatnonzero(near))
        return replace(self.site, towers=towers, buildings=buildings)

    def _buildings_in_reach(self, tower: Tower, box_m: FloatArray) -> BoolArray:
        """Buildings (buildings,) that can mirror or shade what one tower sends into a box."""
        at, (west, south), (east, north) = tower.position_m[:2], *box_m[:, :2]
        tile = np.array([[west, south], [east, south], [east, north], [west, north]])
        lines = [shapely.linestrings(np.vstack([at, tile])[None])]
        if self._depth:
            # walls alone: seen from above, a path over ground or roof lies on the line between its ends
            lit = self._mirrors.toward(tower.position_m, box_m)
            lit = lit[self._is_wall[lit]]
            lines += [self._way_in(at, lit), self._way_out(at, lit, tile)]
        near = np.zeros(len(self.site.buildings), dtype=np.bool_)
        for shapes in map(shapely.convex_hull, lines):
            near[self._near.query(shapes, predicate="intersects")[1]] = True
        return near

    def _way_in(self, at: FloatArray, walls: IntArray) -> AnyArray:
        """Shapes that hold all ways from a tower to each wall."""
        ends = self._ends[walls]
        return np.asarray(shapely.linestrings(np.insert(ends, 2, at, axis=1)))

    def _way_out(self, at: FloatArray, walls: IntArray, tile: FloatArray) -> AnyArray:
        """Shapes that hold all ways from each wall, as a mirror of a tower, to the corners (4, 2) of a tile."""
        ends, normal = self._ends[walls], self._faces.normal[walls, :2]
        along = ends[:, 1] - ends[:, 0]
        length = np.linalg.norm(along, axis=1)
        height = normal @ at - self._faces.offset_m[walls]
        image = at - 2.0 * height[:, None] * normal
        slack = along * (NEAR_M / length)[:, None]
        ray = np.stack([ends[:, 0] - slack, ends[:, 1] + slack], axis=1) - image[:, None]
        # far behind the tile's farthest corner: the beam's far end must not cut into it
        far = 100.0 * np.abs(image[:, None] - tile).sum(axis=2).max(initial=0.0)
        reach = far / np.maximum(np.linalg.norm(ray, axis=2, keepdims=True), NEAR_M)
        beam = shapely.polygons(np.concatenate([image[:, None] + ray, (image[:, None] + ray * reach)[:, ::-1]], axis=1))
        area = shapely.polygons(tile)
        wide = height < 0.05 * length  # a far end of the beam would come near the wall
        lit = np.where(wide, area, shapely.intersection(beam, area))
        return np.asarray(shapely.union(lit, shapely.linestrings(ends)))


def _apart(tower: Tower, box_m: FloatArray) -> FloatArray:
    """Distances (2,) from a tower to the nearest point of a box, east and north."""
    at = tower.position_m[:2]
    return np.maximum(np.maximum(box_m[0, :2] - at, at - box_m[1, :2]), 0.0)


LEDGER = "tile_sha256"
_PATHS = "tile_paths"
_JOB = "aerpaw_cmp_job"
_ROOT = "zarr.json"
_LARGEST_METADATA = 1 << 20
# Parts of an array's metadata that say how its chunks are decoded, and those that follow from the job.
_DECODING = ("zarr_format", "node_type", "codecs", "chunk_key_encoding", "storage_transformers")
_OF_THE_JOB = ("shape", "data_type", "chunk_grid", "fill_value")
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

    Attributes
    ----------
    damaged : int
        Tiles that :meth:`begin` found entered, with chunks that are missing or differ.

    Raises
    ------
    UsageError
        If zarr is not installed.
    """

    def __init__(self, path: Path, tiling: Tiling, job: Mapping[str, Any], *, force: bool = False) -> None:
        try:
            import zarr
        except ImportError:
            raise UsageError(
                "zarr is not installed, and a map in tiles is a Zarr store",
                expected="pip install 'aerpaw-cmp[geo]' with Python 3.11 or newer, or a larger --spacing",
            ) from None
        # through JSON and back: as it will be read again, where tuples are lists
        self.path, self.tiling, self._zarr, self._job = path, tiling, zarr, json.loads(json.dumps(job))
        self._force, self.damaged = force, 0

    def begin(self, empty: Mapping[str, MapResult], frame: SiteFrame, about: Mapping[str, str]) -> list[int]:
        """Create the store unless it exists, and return the tiles that are missing.

        Parameters
        ----------
        empty : mapping of str to MapResult
            Maps of any tile, by foliage mode. They define the variables.
        frame : SiteFrame
        about : mapping of str to str
            Attributes of the store.

        Returns
        -------
        list of int
            Numbers of the tiles.

        Raises
        ------
        UsageError
            If the store belongs to another job, or contains other files.
        InputError
            If the folder is not a store written by this tool, or is damaged.
        """
        self._frame, self._about = frame, about
        skeleton = self._skeleton(maps_dataset(empty, frame, about).to_xarray())
        with explained_os_errors(self.path):
            there = os.path.lexists(self.path) and not (self.path.is_dir() and not any(self.path.iterdir()))
            if there and self._is_other_job(skeleton):
                shutil.rmtree(self.path)
                there = False
            try:
                for name, content in skeleton.items():
                    self._repair(self.path / name, content)
            except BaseException:
                if not there:
                    shutil.rmtree(self.path, ignore_errors=True)
                raise
            missing = [number for number in range(len(self.tiling)) if not self._is_kept(number)]
            # r+ makes nothing and removes nothing
            self._group = self._zarr.open_group(self.path, mode="r+", zarr_format=3)
        return missing

    def _skeleton(self, like: Any) -> dict[str, bytes]:
        """Return the files of a store without tiles, by their names below its folder, its metadata first."""
        grid, tiles = self.tiling.grid, self.tiling.shape
        # created in memory first, so that Zarr does not open a folder with untrusted contents
        files: dict[str, Any] = {}
        memory = self._zarr.storage.MemoryStore(files)
        self._planes = [name for name, variable in like.variables.items() if {"y", "x"} <= {*variable.dims}]
        axes = like.drop_vars(self._planes).assign_coords(
            x=("x", grid.east_m, like.x.attrs), y=("y", grid.north_m, like.y.attrs)
        )
        axes.to_zarr(memory, mode="w", consolidated=False, zarr_format=3)
        group = self._zarr.open_group(memory, mode="r+")
        self._chunk_names = []
        for name in self._planes:
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
            self._chunk_names.append("/".join([name, "c", *"0" * len(leading), "{}", "{}"]))
        group.create_array(
            _PATHS, shape=tiles, chunks=(1, 1), dtype=np.int64, fill_value=0, dimension_names=("tile_y", "tile_x"),
            attributes={"long_name": "paths of each tile"},
        )  # fmt: skip
        self._chunk_names.append(f"{_PATHS}/c/{{}}/{{}}")
        group.create_array(
            LEDGER, shape=(*tiles, 32), chunks=(1, 1, 32), dtype=np.uint8, fill_value=0,
            compressors=None,  # a chunk file is the digest itself: reading it decodes nothing
            dimension_names=("tile_y", "tile_x", "byte"),
            attributes={"long_name": "SHA-256 of the chunks of each tile", "comment": "0: not computed yet"},
        )  # fmt: skip
        group.attrs[_JOB] = json.dumps(self._job)
        content = {name: buffer.to_bytes() for name, buffer in files.items()}
        return {_ROOT: content.pop(_ROOT), **content}

    def _is_other_job(self, skeleton: Mapping[str, bytes]) -> bool:
        """Check whether an existing store belongs to another job and may be replaced. Raises like :meth:`begin`."""
        if not self.path.is_dir():
            raise self._not_ours("a file")
        self._refuse_foreign({name.partition("/")[0] for name in skeleton if "/" in name})
        attributes = self._metadata(_ROOT).get("attributes")
        with parsing(self.path):
            job = json.loads(attributes[_JOB]) if isinstance(attributes, dict) and _JOB in attributes else None
        if not isinstance(job, dict):
            raise self._not_ours(f"{_ROOT} names no job of this tool")
        differs = sorted(key for key in {*job, *self._job} if job.get(key) != self._job.get(key))
        parts = _DECODING if differs else (*_DECODING, *_OF_THE_JOB)
        for name, content in skeleton.items():
            if name.endswith(_ROOT) and os.path.lexists(self.path / name):
                ours, theirs = json.loads(content), self._metadata(name)
                if wrong := next((part for part in parts if ours.get(part) != theirs.get(part)), None):
                    raise self._not_ours(f"{wrong} in {name} is {one_line(json.dumps(theirs.get(wrong)))[:80]}")
        if differs and not self._force:
            key = differs[0]
            more = f" and {len(differs) - 1} more" if len(differs) > 1 else ""
            raise UsageError(
                f"the store holds tiles of another job: {key}{more} differs ({job.get(key)}, now {self._job.get(key)})",
                expected="another name after -o, or --force to replace the store",
                path=self.path,
            )
        return bool(differs)

    def _refuse_foreign(self, arrays: set[str]) -> None:
        """UsageError where a store holds what this tool did not write."""
        ours = re.compile(rf"zarr\.json|({'|'.join(map(re.escape, arrays))})/(zarr\.json|c(/\d+)*)")
        names = (entry.relative_to(self.path).as_posix() for entry in self.path.rglob("*"))
        # a disk that was full may have left a folder without its chunk
        below = (name + more for name in names for more in ("", "/c", "/0"))
        if foreign := next(foreign_entries(self.path, filter(ours.fullmatch, below)), None):
            raise UsageError(
                f"the store holds what this tool did not write: {one_line(foreign)}",
                expected="another name after -o: a store is replaced as a whole",
                path=self.path,
            )

    def _metadata(self, name: str) -> dict[str, Any]:
        """Metadata of the store that is there, as JSON and no more."""
        with parsing(self.path / name):
            content = json.loads(read_input(self.path / name, _LARGEST_METADATA, "metadata of a map store"))
        if not isinstance(content, dict):
            raise self._not_ours(f"{name} is no metadata of Zarr 3")
        return content

    def _not_ours(self, reason: str) -> InputError:
        return InputError(
            f"no map store of this tool: {reason}",
            expected="another name after -o, or this store moved away",
            cause="data of another program, another version of zarr, or a damaged file",
            path=self.path,
        )

    def _repair(self, place: Path, content: bytes) -> None:
        """Write a file of the skeleton unless it exists. The store's creation time is ignored in the comparison."""
        with suppress(OSError):
            before = place.read_bytes()
            if before == content or (place == self.path / _ROOT and _undated(before) == _undated(content)):
                return
        place.parent.mkdir(parents=True, exist_ok=True)
        write_whole(place, content)

    def _chunks(self, number: int) -> Iterator[tuple[str, Path]]:
        """Yield names and paths of the chunk files of one tile. A chunk of only missing values has no file."""
        for form in self._chunk_names:
            name = form.format(*divmod(number, self.tiling.shape[1]))
            yield name, self.path / name

    def _digest(self, number: int) -> bytes:
        digest = hashlib.sha256()
        for name, place in self._chunks(number):
            content = place.read_bytes() if place.exists() else b""
            # with its length, so that bytes cannot move between chunks undetected
            digest.update(f"{name} {len(content)} ".encode() + content)
        return digest.digest()

    def _entry(self, number: int) -> Path:
        row, column = divmod(number, self.tiling.shape[1])
        return self.path / LEDGER / "c" / str(row) / str(column) / "0"

    def _is_kept(self, number: int) -> bool:
        """Check whether a tile exists unchanged. Remove all other files of it before Zarr decodes them."""
        entry = self._entry(number)
        entered = entry.exists()
        if entered and entry.read_bytes() == self._digest(number):
            return True
        self.damaged += entered
        for place in (entry, *(place for _, place in self._chunks(number))):
            place.unlink(missing_ok=True)
        return False

    def paths(self) -> Any:
        """Paths of each tile (tile rows, tile columns)."""
        return np.asarray(self._group[_PATHS][:])

    def write(self, number: int, maps: Mapping[str, MapResult], paths: int) -> None:
        """Write one tile. Raise :class:`~aerpaw_cmp.common.errors.OutputError` if the disk cannot be written.

        Parameters
        ----------
        number : int
        maps : mapping of str to MapResult
            The tile's maps, by foliage mode.
        paths : int
            Number of paths in the tile.
        """
        rows, columns = self.tiling.part(number)
        with explained_os_errors(self.path):
            for name, variable in maps_dataset(maps, self._frame, self._about).variables.items():
                if {"y", "x"} <= {*variable.dims}:
                    self._group[name][..., rows, columns] = variable.values
            self._group[_PATHS][divmod(number, self.tiling.shape[1])] = paths
            entry = self._entry(number)
            entry.parent.mkdir(parents=True, exist_ok=True)
            # last: a tile is there when its entry is, and a run killed before computes it again
            write_whole(entry, self._digest(number))

    def read(self, empty: Mapping[str, MapResult], step: int) -> dict[str, MapResult]:
        """Return maps of every ``step``-th position in both directions, by foliage mode.

        ``empty`` is as for :meth:`begin`.
        """
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


def _undated(metadata: bytes) -> Any:
    """Return the metadata of a store without its creation time. None if they are not valid metadata."""
    try:
        content = json.loads(metadata)
        content["attributes"].pop("history", None)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None
    return content

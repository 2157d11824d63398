"""Tiles of a map: what can reach each, and their values joined again.

A tile is evaluated with the towers and buildings that can reach it. None that matters is left out where at most one
reflection is followed over level ground: seen from above a path then lies on the line between its ends, or on the two
lines from a tower to a wall and on to the tile. So a building counts if it comes near

- the convex hull of tower and tile (which also holds the reflections off ground and roofs), or
- the hull of tower and wall, or of wall and the part of the tile in its beam, for each wall whose beam from the
  mirrored tower may meet the tile.

With more reflections, terrain or a scene of triangles every building is kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely

from ..common.units import AnyArray, BoolArray, FloatArray, IntArray, wavelength_m
from ..propagation.geometry.faces import corners, site_faces
from ..propagation.scene import REACH_M
from ..propagation.search.mirror import Mirrors
from ..site.site import Site, Tower
from .grid import Grid, serving_tower, voronoi_borders
from .job import MapResult

# A building this close to a hull counts [m]: far above the rounding of any plane.
NEAR_M = 0.01

# How far several paths may lift a level over that of free space [dB]: ten as strong as the direct one, in phase.
_IN_PHASE_DB = 20.0

# Fields of a :class:`~aerpaw_cmp.maps.job.MapResult` with a value per position.
PLANES = ("rss_siso_dbm", "rss_mimo_dbm", "level_sd_db", "rank", "spread_db", "condition_db")


@dataclass(frozen=True, slots=True)
class Tiling:
    """A grid in square tiles of ``cells`` positions a side, numbered as positions are; the last may be smaller."""

    grid: Grid
    cells: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
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
        Of the arrays, when all elements add in phase.
    floor_dbm : float
        A level below it is out of coverage.
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

"""The site model: frozen records in the site frame (east, north, up in metres).

``up`` is height above the ground at the site origin. The traced ground is the plane ``up = 0``, or one reflecting
plane per tower if towers have their own ground heights.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np
from shapely.geometry import Point, Polygon

from ..common.geodesy import SiteFrame
from ..common.text import counted
from ..common.units import FloatArray
from .mitsuba import TriangleScene
from .relief import Dem

# Name for the nearest tower in layers of maps, such as rank_k10_h030m_joint_opaque. No tower may have this name.
NEAREST = "joint"


@dataclass(frozen=True, slots=True)
class Tower:
    """A tower of the testbed, which is a fixed node.

    Parameters
    ----------
    name : str
        A name such as ``"LW1"``.
    latitude_deg, longitude_deg : float
        Position in WGS84.
    east_m, north_m : float
        Position in the site frame.
    antenna_height_m : float
        Height of the array centre above the ground at the tower.
    ground_m : float
        Height of the ground at the tower above the ground at the origin.
    source : str
        Source of the coordinates.
    """

    name: str
    latitude_deg: float
    longitude_deg: float
    east_m: float
    north_m: float
    antenna_height_m: float = 10.0
    ground_m: float = 0.0
    source: str = ""

    @property
    def position_m(self) -> FloatArray:
        """Array centre in the site frame, shape (3,) [m]."""
        return np.array([self.east_m, self.north_m, self.ground_m + self.antenna_height_m])


@dataclass(frozen=True, slots=True)
class Building:
    """A prism: footprint (east, north) [m] with a flat roof at ``base_m + height_m``."""

    name: str
    footprint: Polygon
    height_m: float
    base_m: float = 0.0
    material: str = "concrete"
    source: str = ""


@dataclass(frozen=True, slots=True)
class Forest:
    """A wooded area (east, north) [m].

    A forest without a height contains single trees at random positions. A forest with a height is a medium (forest
    stand).

    Parameters
    ----------
    name : str
    area : Polygon
    trees_per_hectare, minimum_spacing_m : float
        Density and minimum distance of the single trees.
    source : str
    height_m : float, optional
        Height of the canopy above the ground.
    trees : bool
        True if a forest with a height also has single trees, which only opaque foliage uses.
    evergreen_share : float
        Share of the trees that keep their leaves, 0 to 1.
    crown_base_fraction : float
        Height of the base of the crowns divided by the height of the canopy.
    base_m : float
        Height of the ground below the forest, if the site has no elevation model.
    filled : float
        Share of the prism of the canopy that is filled with leaves.
    """

    name: str
    area: Polygon
    trees_per_hectare: float = 100.0
    minimum_spacing_m: float = 4.0
    source: str = ""
    height_m: float | None = None
    trees: bool = False
    evergreen_share: float = 0.0
    crown_base_fraction: float = 0.25
    base_m: float = 0.0
    filled: float = 1.0


# eq=False: equal only to itself, so that what is computed from it can be cached
@dataclass(frozen=True, slots=True, eq=False)
class Trees:
    """All single trees as columns, each of shape (trees,) [m].

    A tree is a trunk (cylinder from the ground to ``crown_base_m``) and a crown (cone from ``crown_base_m`` up
    to ``height_m``, widest at its base). Heights are above ``ground_m``.
    """

    east_m: FloatArray
    north_m: FloatArray
    ground_m: FloatArray
    height_m: FloatArray
    crown_diameter_m: FloatArray
    crown_base_m: FloatArray
    trunk_diameter_m: FloatArray

    def __len__(self) -> int:
        return len(self.east_m)

    @classmethod
    def none(cls) -> Trees:
        """Return an empty set of trees."""
        return cls(**{column.name: np.zeros(0) for column in fields(cls)})


@dataclass(frozen=True, slots=True)
class Geofence:
    """An area to draw (east, north) [m], which the replay ignores."""

    name: str
    area: Polygon


@dataclass(frozen=True, slots=True)
class Site:
    """The site of a flight, for the replay and for maps.

    Parameters
    ----------
    name : str
        Title of the site.
    frame : SiteFrame
        Frame with the position of the origin.
    towers : mapping of str to Tower
        Towers in the order in which they are drawn.
    buildings, forests, geofences : tuples
        Objects of the site, which may be empty.
    trees : Trees
        Placed trees (from forests without a height and single points).
    opaque_trees : Trees
        Trees for opaque foliage: the placed trees, and those that replace a forest stand with ``trees: true``.
    ground_material : str
        Name of a material in ``site.materials``.
    area_m : (east_min, east_max, north_min, north_max)
        Extent for maps.
    credit : str
        Source of the map. The credit is shown wherever buildings and forests are drawn.
    assumed : str
        Sentence about sizes that the map does not state and that are assumed.
    notes : tuple of str
        Remarks for the report.
    disagreements : tuple of str
        Warnings about ground heights of the site file that its elevation model contradicts.
    takeoff_ground_m : float
        Height of the take-off point, which is the zero of ``altitude_m`` in logs.
    ground_above_sea_m : float or None
        Height of the ground at the origin above the geoid or the ellipsoid; None if the site file has none.
    dem : Dem or None
        Ground heights, which block lines of sight.
    scene : TriangleScene or None
        Open surfaces in the site frame that replace the ground plane. Buildings are added to them.
    """

    name: str
    frame: SiteFrame
    towers: Mapping[str, Tower]
    buildings: tuple[Building, ...] = ()
    forests: tuple[Forest, ...] = ()
    trees: Trees = field(default_factory=Trees.none)
    opaque_trees: Trees = field(default_factory=Trees.none)
    geofences: tuple[Geofence, ...] = ()
    ground_material: str = "medium_dry_ground"
    area_m: tuple[float, float, float, float] = (-540.0, 540.0, -1065.0, 1065.0)
    credit: str = ""
    assumed: str = ""
    notes: tuple[str, ...] = ()
    disagreements: tuple[str, ...] = ()
    takeoff_ground_m: float = 0.0
    ground_above_sea_m: float | None = None
    dem: Dem | None = None
    scene: TriangleScene | None = None

    @property
    def wooded(self) -> bool:
        """True if trees or forest stands can shade a path."""
        return len(self.trees) > 0 or any(forest.height_m is not None for forest in self.forests)

    @property
    def mapped(self) -> bool:
        """True if the site comes from a map, which shows that an area without objects is empty."""
        return bool(self.forests or self.buildings or len(self.trees) or self.scene is not None)

    def ground_under_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Return the height of the ground, shape (n,) [m].

        If the terrain is known, the height of the terrain is used. Otherwise it is the ground height of the nearest
        tower or, in a scene of triangles, of the take-off point.

        A ground height of a tower above 0 is taken as 0, because the ground between towers is lower and a UAV may be
        there.
        """
        ground = np.full(len(east_m), self.takeoff_ground_m if self.scene is not None else 0.0)
        if self.scene is None and self.towers:
            towers = list(self.towers.values())
            apart = [np.hypot(east_m - tower.east_m, north_m - tower.north_m) for tower in towers]
            ground = np.minimum(0.0, np.array([tower.ground_m for tower in towers])[np.argmin(apart, axis=0)])
        if self.dem is None:
            return ground
        terrain = self.dem.ground_m(east_m, north_m)
        return np.where(np.isnan(terrain), ground, terrain)

    def cautions(self, towers: Iterable[str] | None = None) -> list[str]:
        """Return clauses about errors of the site that affect all numbers at some towers (default: all towers)."""
        names = self.towers if towers is None else towers
        chosen = [self.towers[name] for name in dict.fromkeys(names) if name in self.towers]
        clauses = list(self.disagreements)
        for tower in chosen:
            up = float(tower.position_m[2])
            clauses += [
                f"the antenna of tower {tower.name} ({up:.1f} m up) is inside building '{building.name}' (roof at "
                f"{building.base_m + building.height_m:.1f} m), so no path reaches it: correct the tower's position, "
                "set antenna_height_m above the roof if it is on the roof, or delete the building from the site file"
                for building in self.buildings
                if building.base_m < up < building.base_m + building.height_m
                and building.footprint.contains(Point(tower.east_m, tower.north_m))
            ]
            clauses += [
                f"the antenna of tower {tower.name} is inside wood '{forest.name}' (canopy at {forest.height_m:g} m), "
                "so opaque foliage blocks each path: correct the position, or cut a clearing out of the wood"
                for forest in self.forests
                if up - tower.ground_m < (forest.height_m or 0.0)
                and forest.area.contains(Point(tower.east_m, tower.north_m))
            ]
        if self.dem is not None:
            places = {f"tower {tower.name}": (tower.east_m, tower.north_m) for tower in chosen}
            for name, (east, north) in {"the site's origin": (0.0, 0.0), **places}.items():
                if (patch := self.dem.filled_patch(east, north)) is not None:
                    clauses.append(
                        f"the elevation model is {patch.height_m:g} m at {name}, in {counted(patch.cells, 'cell')} of "
                        f"one height at whose edge the ground jumps by {patch.jump_m:.0f} m, probably a gap filled "
                        "with a number: fill it from its neighbours (gdal_fillnodata.py) or use another elevation model"
                    )
        return clauses

    def under(self, foliage: str) -> Site:
        """Return the site for a kind of foliage: for ``opaque``, a forest stand with trees is replaced by its trees."""
        if foliage != "opaque" or not any(forest.height_m is not None and forest.trees for forest in self.forests):
            return self
        woods = tuple(replace(forest, height_m=None) if forest.trees else forest for forest in self.forests)
        return replace(self, trees=self.opaque_trees, forests=woods)

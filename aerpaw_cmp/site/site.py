"""The site model: plain, frozen records in the site frame (east, north, up; metres).

``up`` is height above the ground at the site origin. The traced ground is the plane ``up = 0`` unless a
tower's own ground height says otherwise (one reflecting plane per tower).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np
from shapely.geometry import Point, Polygon

from ..common.geodesy import SiteFrame
from ..common.text import counted, html_table
from ..common.units import FloatArray
from .mitsuba import TriangleScene
from .relief import Dem


@dataclass(frozen=True, slots=True)
class Tower:
    """A fixed node.

    Parameters
    ----------
    name : str
        Such as ``"LW1"``.
    latitude_deg, longitude_deg : float
        WGS84.
    east_m, north_m : float
        The same in the site frame.
    antenna_height_m : float
        Height of the array centre above the ground at the tower.
    ground_m : float
        Height of the ground at the tower above the ground at the origin.
    source : str
        Where the coordinates come from.
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
        """Array centre (3,) in the site frame [m]."""
        return np.array([self.east_m, self.north_m, self.ground_m + self.antenna_height_m])


@dataclass(frozen=True, slots=True)
class Building:
    """A prism: footprint (east, north) [m], flat roof at ``base_m + height_m``."""

    name: str
    footprint: Polygon
    height_m: float
    base_m: float = 0.0
    material: str = "concrete"
    source: str = ""


@dataclass(frozen=True, slots=True)
class Forest:
    """A wooded area (east, north) [m]: single trees placed at random, or with a height a medium (a stand).

    Parameters
    ----------
    name : str
    area : Polygon
    trees_per_hectare, minimum_spacing_m : float
        Of the placement.
    source : str
    height_m : float, optional
        Of the canopy above the ground.
    trees : bool
        With a height: trees are placed too, for opaque foliage alone. Without one they always are.
    evergreen_share : float
        Of the trees, those that keep their leaves: 0 to 1.
    crown_base_fraction : float
        Height of the crowns' base as a share of the canopy's.
    base_m : float
        Up of the ground below it, where the site has no elevation model.
    filled : float
        Share of the canopy's prism that is canopy.
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


@dataclass(frozen=True, slots=True)
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
        """No tree."""
        return cls(**{column.name: np.zeros(0) for column in fields(cls)})


@dataclass(frozen=True, slots=True)
class Geofence:
    """An area to draw (east, north) [m]; it does not take part in the replay."""

    name: str
    area: Polygon


@dataclass(frozen=True, slots=True)
class Site:
    """Everything the replay and the maps know about a place.

    Parameters
    ----------
    name : str
        Title of the site.
    frame : SiteFrame
        Where the origin lies.
    towers : mapping of str to Tower
        In drawing order.
    buildings, forests, geofences : tuples
        May be empty.
    trees : Trees
        Placed trees (from forests without a height and single points).
    opaque_trees : Trees
        The same, and those of stands that carry trees.
    ground_material : str
        Name in ``site.materials``.
    area_m : (east_min, east_max, north_min, north_max)
        Extent for maps.
    credit : str
        Whose map it is: shown wherever buildings and forests are drawn.
    assumed : str
        Sizes on the map that nobody measured.
    notes : tuple of str
        For the report.
    disagreements : tuple of str
        Clauses on ground heights that the site file states and its elevation model contradicts.
    takeoff_ground_m : float
        Up of the take-off point, from which ``altitude_m`` of logs counts.
    ground_above_sea_m : float or None
        Height of the ground at the origin above the geoid or the ellipsoid; None if the site file has none.
    dem : Dem or None
        Ground heights; blocks lines of sight.
    scene : TriangleScene or None
        Open surfaces in the site frame, which stand in for the ground plane. Buildings stand beside them.
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
        """True if trees or stands can shade a path."""
        return len(self.trees) > 0 or any(forest.height_m is not None for forest in self.forests)

    @property
    def mapped(self) -> bool:
        """True if a map says what stands there: nothing drawn is nothing known otherwise."""
        return bool(self.forests or self.buildings or len(self.trees) or self.scene is not None)

    def ground_under_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Up of the ground (n,) [m]: the terrain's, else of the nearest tower's plane; in a scene that of take-off.

        A plane above up = 0 ends at its tower: who flies lower beside it flies over lower ground between them.
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
        """Return clauses on errors of the site that spoil every number at some towers; all towers by default."""
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
        """The site as a kind of foliage sees it: to ``opaque`` a stand that carries trees is those trees."""
        if foliage != "opaque" or not any(forest.height_m is not None and forest.trees for forest in self.forests):
            return self
        woods = tuple(replace(forest, height_m=None) if forest.trees else forest for forest in self.forests)
        return replace(self, trees=self.opaque_trees, forests=woods)

    def _repr_html_(self) -> str:
        """Towers and their places, for notebooks."""
        rows = [(name, *(f"{metres:.1f}" for metres in tower.position_m)) for name, tower in self.towers.items()]
        caption = f"{self.name}: {counted(len(self.buildings), 'building')}, {counted(len(self.trees), 'tree')}"
        return html_table(("tower", "east [m]", "north [m]", "up [m]"), rows, caption)

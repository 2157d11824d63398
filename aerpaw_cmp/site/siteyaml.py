"""Reader of site.yaml, the packaged sites, and the list of files of a site.

docs/site.md describes every key. Polygons are ``polygon_m`` (east, north) or ``polygon_deg`` (latitude, longitude).

The files of a site are site.yaml and the files that it names. Outputs never replace these files, and reports list them.

Trees are modelled as in the paper (arXiv 2502.10324, section V): a trunk cylinder below a cone of vegetation, 20 m high
and 10 m wide, at random positions in forests. The paper does not print the height of the base of the crown, which is
assumed to be a quarter of the height.
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import numpy as np
import shapely
from pydantic import AfterValidator, Field, model_validator
from scipy.spatial import cKDTree
from shapely.geometry import Point, Polygon
from shapely.geometry.base import BaseGeometry

from ..common.errors import AerpawCmpError, UsageError
from ..common.geodesy import SiteFrame
from ..common.text import counted
from ..common.units import BoolArray, FloatArray
from ..common.yamlfile import LineOf, Location, StrictModel, load_yaml_and_lines, named_files, nearest
from .materials import material
from .mitsuba import TriangleScene
from .relief import Dem, Surface, read_dem, surface_through
from .scenes import placed_scene, usable_scene
from .site import NEAREST, Building, Forest, Geofence, Site, Tower, Trees

# Packaged sites by name.
PACKAGED = ("lake_wheeler",)

# A tower is refused if it is farther than this from both the origin and the area.
_FAR_TOWER_M = 10_000.0

# An outline is refused if it extends farther than this from the origin.
_FAR_POLYGON_M = 100_000.0

# Overlaps of buildings up to this width cause no warning.
OVERLAP_M = 0.5

# A tower is outside the map if no object of the map is within this distance.
_MAPPED_M = 500.0

# Smallest distance of random trees from a tower, because there are no trees around masts.
MAST_CLEARANCE_M = 8.0

# Largest height of a building or mast. No structure on Earth is higher, so a larger value is in feet or centimetres.
TALLEST_M = 1000.0

Latitude = Annotated[float, Field(ge=-90, le=90)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Positive = Annotated[float, Field(gt=0)]
_NotNegative = Annotated[float, Field(ge=0)]
Ground = Literal["flat", "offsets", "surface", "dem"]
GroundPoint = tuple[float, float, float, Annotated[float, Field(gt=0)]]
Area = tuple[float, float, float, float]
Ring = Annotated[list[tuple[float, float]], Field(min_length=3)]


def _not_too_high(height_m: float) -> float:
    if height_m > TALLEST_M:
        raise ValueError(f"{height_m:g} m is higher than any structure on Earth; is it in feet or centimetres?")
    return height_m


_Structure = Annotated[Positive, AfterValidator(_not_too_high)]


def _known_material(name: str) -> str:
    try:
        material(name)
    except UsageError as error:
        raise ValueError(str(error)) from None  # pydantic adds the location
    return name


_MaterialName = Annotated[str, AfterValidator(_known_material)]


def _problem(shape: Polygon) -> str | None:
    """Return the error of an outline, or None if it is valid."""
    if len(set(shape.exterior.coords)) < 3:
        return "has fewer than 3 distinct points"
    if not shape.is_valid or shape.area < 1e-3:
        reason = shapely.is_valid_reason(shape) if not shape.is_valid else "no area"
        return f"is not a simple outline ({reason}); 'aerpaw-cmp site import' repairs outlines"
    return None


# Largest number of trees of a forest.
_MAXIMUM_TREES = 2_000_000

# A forest is full after this number of consecutive batches that each add less than a thousandth of the trees.
_STALLED_ROUNDS = 12


# Larger than the tallest, widest and thickest trees on Earth [m]. Larger values are in feet or centimetres.
TALLEST_TREE_M = 120.0
WIDEST_CROWN_M = 90.0
THICKEST_TRUNK_M = 15.0

TreeHeight = Annotated[float, Field(gt=0, le=TALLEST_TREE_M)]
CrownDiameter = Annotated[float, Field(gt=0, le=WIDEST_CROWN_M)]
TrunkDiameter = Annotated[float, Field(gt=0, le=THICKEST_TRUNK_M)]


class TreeSizes(StrictModel):
    """The sizes of trees. The base of the crown is at a given share of the height of the tree."""

    height_m: TreeHeight = 20.0
    crown_diameter_m: CrownDiameter = 10.0
    trunk_diameter_m: TrunkDiameter = 0.4
    crown_base_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.25


PAPER_SIZES = TreeSizes()


_Datum = Literal["orthometric", "ellipsoidal"]


class HeightModel(StrictModel):
    """A height above the geoid or the ellipsoid."""

    height_m: float
    reference: _Datum


class OriginModel(StrictModel):
    """Point where east = north = up = 0."""

    latitude_deg: Latitude
    longitude_deg: Longitude
    ground: HeightModel | None = None
    takeoff_ground_m: float = 0.0


class PositionModel(StrictModel):
    """A published position of a tower."""

    latitude_deg: Latitude
    longitude_deg: Longitude
    antenna_height_m: _Structure | None = None
    source: str = ""


class TowerModel(StrictModel):
    """A tower with one position, or with several published positions."""

    latitude_deg: Latitude | None = None
    longitude_deg: Longitude | None = None
    source: str = ""
    positions: dict[str, PositionModel] = Field(default_factory=dict)
    antenna_height_m: _Structure | None = None
    ground_offset_m: float | None = None

    @model_validator(mode="after")
    def _one_way(self) -> TowerModel:
        ways = (self.latitude_deg is not None) + (self.longitude_deg is not None)
        if ways == 1 or (ways == 2) == bool(self.positions):
            raise ValueError("give latitude_deg and longitude_deg, or positions, not both")
        return self


class PolygonModel(StrictModel):
    """A named outline."""

    name: str
    polygon_m: Ring | None = None
    polygon_deg: Ring | None = None
    holes_m: list[Ring] = Field(default_factory=list)

    @model_validator(mode="after")
    def _one_way(self) -> PolygonModel:
        if (self.polygon_m is None) == (self.polygon_deg is None):
            raise ValueError("give polygon_m (east, north) or polygon_deg (latitude, longitude)")
        if self.holes_m and self.polygon_m is None:
            raise ValueError("holes are in metres: give polygon_m, too")
        if self.polygon_m is not None and (problem := _problem(Polygon(self.polygon_m, self.holes_m))):
            raise ValueError(f"the polygon of '{self.name}' {problem}")
        return self

    def polygon(self, frame: SiteFrame) -> Polygon:
        """Return the polygon in the site frame [m]. Raise UsageError unless it is a simple polygon near the site."""
        if self.polygon_m is not None:
            _check_near(self.polygon_m, self.name)
            shape = Polygon(self.polygon_m, self.holes_m)
        else:
            shape = Polygon(_ring_from_degrees(self.polygon_deg or [], frame, self.name))
        if problem := _problem(shape):
            raise UsageError(f"the polygon of '{self.name}' {problem}")
        # sort the corners, so that walls have the same names if outlines are equal
        return shapely.normalize(shape)


class BuildingModel(PolygonModel):
    """A building with a flat roof."""

    height_m: _Structure
    base_m: float = 0.0
    material: _MaterialName = "concrete"
    source: str = ""


class ForestModel(PolygonModel):
    """A wooded area. If it has a height, it is a medium, which also has single trees if ``trees`` is true."""

    trees_per_hectare: _NotNegative = 100.0
    minimum_spacing_m: _NotNegative = 4.0
    source: str = ""
    height_m: TreeHeight | None = None
    trees: bool = False
    evergreen_share: Annotated[float, Field(ge=0, le=1)] = 0.0


OutlineT = TypeVar("OutlineT", bound=PolygonModel)


class SingleTreeModel(StrictModel):
    """A tree with its own sizes. For missing sizes, the sizes of all trees are used."""

    at_m: tuple[float, float]
    height_m: TreeHeight | None = None
    crown_diameter_m: CrownDiameter | None = None
    trunk_diameter_m: TrunkDiameter | None = None


class TreesModel(TreeSizes):
    """Sizes of all trees, the seed of the placement, and single trees."""

    seed: Annotated[int, Field(ge=0)] = 0
    single: list[SingleTreeModel] = Field(default_factory=list)


class DemModel(StrictModel):
    """An elevation model. Relative paths start at the folder of site.yaml."""

    path: str
    crs: str | None = None
    reference: _Datum = "orthometric"


class SceneModel(StrictModel):
    """A scene of triangles. A relative path starts at the folder of site.yaml."""

    path: str
    sha256: str | None = None
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0
    materials: dict[str, _MaterialName] = Field(default_factory=dict)
    ground_plane: bool = False


class CoverageModel(StrictModel):
    """Carrier and link budget of maps, and of predictions before any flight. Options of the commands override them."""

    carrier_ghz: Annotated[float, Field(ge=0.1, le=100)] | None = None
    tx_power_dbm: float | None = None
    bandwidth_mhz: Positive | None = None
    noise_figure_db: _NotNegative | None = None
    threshold_dbm: float | None = None
    threshold_snr_db: float | None = None


class SiteModel(StrictModel):
    """The content of site.yaml."""

    name: str
    origin: OriginModel
    towers: Annotated[dict[str, TowerModel], Field(min_length=1)]
    coordinates: str | None = None
    tower_ground: Ground | None = None
    dem: DemModel | None = None
    ground_points: list[GroundPoint] = Field(default_factory=list)
    scene: SceneModel | None = None
    ground_material: _MaterialName = "medium_dry_ground"
    area_m: tuple[float, float, float, float] | None = None
    buildings: list[BuildingModel] = Field(default_factory=list)
    forests: list[ForestModel] = Field(default_factory=list)
    trees: TreesModel = Field(default_factory=TreesModel)
    geofences: list[PolygonModel] = Field(default_factory=list)
    coverage: CoverageModel = Field(default_factory=CoverageModel)
    credit: str = ""
    assumed: str = ""
    notes: list[str] = Field(default_factory=list)


def load_site(name_or_path: str | Path, *, coordinates: str | None = None, tower_ground: Ground | None = None) -> Site:
    """Return a packaged site by its name, or a site from a site.yaml.

    Parameters
    ----------
    name_or_path : str or Path
        ``"lake_wheeler"`` or the path of a file.
    coordinates : str, optional
        Published positions to use if a tower has several. This argument overrides the file.
    tower_ground : {"flat", "offsets", "surface", "dem"}, optional
        ``flat`` sets the ground to up = 0 everywhere (the paper). ``offsets`` uses the stated height of each tower.
        ``surface`` puts towers, buildings and trees on a smooth surface through ``ground_points``, and ``dem`` on the
        elevation model. This argument overrides the file. Its default is ``dem`` if it names an elevation model, and
        ``flat`` otherwise.

    Returns
    -------
    Site

    Raises
    ------
    UsageError
        If there is no such site, or its file has an error (the message has path and line).
    """
    path, model, line_of = _find(name_or_path)
    changes: dict[str, Any] = {"coordinates": coordinates, "tower_ground": tower_ground}
    model = model.model_copy(update={key: value for key, value in changes.items() if value is not None})
    key = model.model_dump_json()
    if key in _BUILT:
        return _BUILT[key]
    try:
        site = build_site(model, Path(path).parent)
    except UsageError as error:
        if error.path is not None:
            raise
        line = line_of(error.location) if isinstance(error, _PlacedError) else None
        raise UsageError(error.found, expected=error.expected, cause=error.cause, path=path, line=line) from None
    if model.dem is None and model.scene is None:  # other files can change
        _BUILT[key] = site
        for old in list(_BUILT)[:-_MOST_BUILT]:
            del _BUILT[old]
    return site


# Cache of the last sites, by their settings. A report, and each task of a campaign, requests its site several times.
_BUILT: dict[str, Site] = {}
_MOST_BUILT = 4


class _PlacedError(UsageError):
    """An error about one key of a site.yaml."""

    def __init__(self, error: UsageError, location: Location) -> None:
        super().__init__(error.found, expected=error.expected, cause=error.cause)
        self.location = location


@contextmanager
def _at(*location: Any) -> Iterator[None]:
    """Attach this key to errors raised in the block, unless they already name a file or a key."""
    try:
        yield
    except UsageError as error:
        if error.path is not None or isinstance(error, _PlacedError):
            raise
        raise _PlacedError(error, location) from None


def known_grounds(name_or_path: str | Path) -> tuple[Ground, ...]:
    """Return the values of ``tower_ground`` for which the site has data."""
    model = site_model(name_or_path)
    offsets = any(tower.ground_offset_m for tower in model.towers.values())
    has_data = {"flat": True, "offsets": offsets, "surface": bool(model.ground_points), "dem": model.dem is not None}
    return tuple(kind for kind in get_args(Ground) if has_data[kind])


def site_model(name_or_path: str | Path) -> SiteModel:
    """Return the checked settings of a packaged site or a site.yaml, before trees are placed."""
    return _find(name_or_path)[1]


def coverage_of(name_or_path: str | Path) -> tuple[CoverageModel, str, int | None]:
    """Return the settings under ``coverage`` of a site, and the file and the line of this key."""
    path, model, line_of = _find(name_or_path)
    return model.coverage, path, line_of(("coverage",))


def _find(name_or_path: str | Path) -> tuple[str, SiteModel, LineOf]:
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml") or path.is_file():
        return str(path), *load_yaml_and_lines(path, SiteModel)
    name = packaged_name(str(name_or_path))
    if name not in PACKAGED:
        near = nearest(name, PACKAGED)
        raise UsageError(
            f"no site '{name_or_path}'",
            expected=f"a site.yaml or one of {', '.join(PACKAGED)}",
            cause=f"did you mean '{near}'?" if near else None,
        )
    with resources.as_file(resources.files("aerpaw_cmp.site") / "data" / f"{name}.yaml") as file:
        return name, *load_yaml_and_lines(file, SiteModel)


def packaged_name(name: str) -> str:
    """Return the file name of a packaged site for names such as lake-wheeler or Lake Wheeler."""
    return name.lower().replace("-", "_").replace(" ", "_")


def build_site(model: SiteModel, folder: Path | None = None) -> Site:
    """Return the site of a checked model with placed trees. Relative paths start at ``folder``."""
    frame = SiteFrame(model.origin.latitude_deg, model.origin.longitude_deg)
    with _at("dem"):
        dem = _dem(model, frame, folder or Path())
    notes = list(model.notes)
    if model.tower_ground == "surface":
        notes.append(_about_surface(ground_surface(model, frame)))
    if model.credit or model.assumed:
        notes.insert(0, f"Map: {'; '.join(text for text in (model.credit, model.assumed) if text)}.")
    with _at("scene"):
        scene, scene_notes = _scene(model, folder or Path())
        notes += scene_notes
    towers: dict[str, Tower] = {}
    for name, tower in model.towers.items():
        with _at("towers", name):
            _check_name(name, towers)
            towers[name] = _tower(name=name, model=tower, site=model, frame=frame, dem=dem, notes=notes)
            _check_tower(towers[name], model.area_m, frame)
    with _at("area_m"):
        places = towers.values()
        area = _checked_area(model.area_m, [t.east_m for t in places], [t.north_m for t in places])
    woods: tuple[Forest, ...] = ()
    if scene is not None:
        scene, woods, scene_notes = usable_scene(scene, {name: tower.position_m for name, tower in towers.items()})
        notes += scene_notes
    buildings = tuple(_building(item, outline, dem) for item, outline in _outlines(model.buildings, "buildings", frame))
    notes += _overlaps(buildings)
    forests = tuple(
        Forest(
            name=item.name, trees_per_hectare=item.trees_per_hectare, minimum_spacing_m=item.minimum_spacing_m,
            source=item.source, height_m=item.height_m, trees=item.trees, evergreen_share=item.evergreen_share,
            area=outline,
            crown_base_fraction=model.trees.crown_base_fraction,
        )
        for item, outline in _outlines(model.forests, "forests", frame)
    )  # fmt: skip
    forests += woods
    notes += _unmapped(towers, [item.footprint for item in buildings] + [item.area for item in forests])
    with _at("trees"):
        trees, of_stands = _trees(model.trees, forests, buildings, towers, notes)
    return Site(
        name=model.name,
        ground_material=model.ground_material,
        credit=model.credit,
        assumed=model.assumed,
        frame=frame,
        towers=towers,
        buildings=buildings,
        forests=forests,
        trees=_on_ground(trees, dem),
        opaque_trees=_on_ground(join_trees([trees, of_stands]), dem),
        geofences=tuple(Geofence(item.name, area) for item, area in _outlines(model.geofences, "geofences", frame)),
        area_m=area,
        notes=tuple(notes),
        disagreements=_disagreements(model, towers, dem),
        takeoff_ground_m=model.origin.takeoff_ground_m,
        ground_above_sea_m=_ground_above_sea_m(model, dem),
        dem=dem,
        scene=scene,
    )


def _ground_above_sea_m(model: SiteModel, dem: Dem | None) -> float | None:
    if model.origin.ground is not None:
        return model.origin.ground.height_m
    return None if dem is None else float(dem.absolute_m(0.0, 0.0))


# Largest difference between elevation models and surveys [m]. The difference between geoid and ellipsoid is larger.
_HEIGHTS_AGREE_M = 5.0


def _disagreements(model: SiteModel, towers: Mapping[str, Tower], dem: Dem | None) -> tuple[str, ...]:
    """Return clauses about ground heights of the file that its elevation model contradicts."""
    # a surface through points agrees with its own points
    if dem is None or model.dem is None:
        return ()
    pairs = []
    if (ground := model.origin.ground) is not None and ground.reference == model.dem.reference:
        pairs.append(("origin.ground", ground.height_m, float(dem.absolute_m(0.0, 0.0))))
    for name, tower in model.towers.items():
        if tower.ground_offset_m is not None:
            pairs.append((f"the ground of tower {name}", tower.ground_offset_m, float(towers[name].ground_m)))
    return tuple(
        f"{what} is stated as {stated:.1f} m, the elevation model has {modelled:.1f} m: probably their vertical "
        "datums differ"
        for what, stated, modelled in pairs
        if abs(stated - modelled) > _HEIGHTS_AGREE_M
    )


def _scene(model: SiteModel, folder: Path) -> tuple[TriangleScene | None, list[str]]:
    """Return the scene of triangles, if the site has one, and a list of repairs."""
    if model.scene is None:
        return None, []
    if model.dem is not None:
        raise UsageError("a scene and an elevation model", expected="one of them", cause="the scene has its own ground")
    what = model.scene
    scene = placed_scene(
        folder / what.path,
        materials=what.materials,
        sha256=what.sha256,
        offset_m=what.offset_m,
        turn_deg=what.turn_deg,
        ground_plane=model.ground_material if what.ground_plane else None,
    )
    return scene, list(scene.notes)


def extent_m(model: SiteModel, frame: SiteFrame) -> Area:
    """Return the area for maps of the site: ``area_m``, or 500 m around the towers."""
    return _checked_area(model.area_m, *_tower_places(model, frame).tolist())


def _tower_places(model: SiteModel, frame: SiteFrame) -> FloatArray:
    """Return east and north of the towers, shape (2, towers) [m]."""
    # the notes are not used here, because build_site collects them
    places = [_chosen_position(name, tower, model.coordinates, frame, []) for name, tower in model.towers.items()]
    return np.transpose([frame.to_local(place.latitude_deg, place.longitude_deg) for place in places])


def _outlines(models: list[OutlineT], key: str, frame: SiteFrame) -> Iterator[tuple[OutlineT, Polygon]]:
    for index, item in enumerate(models):
        with _at(key, index, "polygon_m" if item.polygon_deg is None else "polygon_deg"):
            yield item, item.polygon(frame)


def _dem(model: SiteModel, frame: SiteFrame, folder: Path) -> Dem | None:
    # name this key, because the file has no line with the key dem
    if model.tower_ground == "dem" and model.dem is None:
        with _at("tower_ground"):
            raise UsageError("tower_ground is 'dem', but there is no elevation model", expected="the key 'dem'")
    if model.tower_ground == "surface":
        with _at("ground_points"):
            return ground_surface(model, frame).dem()
    if model.dem is None or model.tower_ground not in (None, "dem"):
        return None
    return read_dem(folder / model.dem.path, frame, crs=model.dem.crs)


# Margin of the surface around the area of the site.
_SURFACE_MARGIN_M = 250.0


def ground_surface(model: SiteModel, frame: SiteFrame) -> Surface:
    """Return the surface through the ``ground_points`` of a site, which covers its area and its towers.

    Raises
    ------
    UsageError
        If there are too few points, two contradict each other, or they are far from the site.
    """
    points = np.array(model.ground_points, dtype=np.float64).reshape(-1, 4)
    if len(points):
        _check_near([(float(east), float(north)) for east, north in points[:, :2]], "ground_points")
    east, north = _tower_places(model, frame)
    area = extent_m(model, frame)
    reach = (
        min(area[0], east.min()) - _SURFACE_MARGIN_M,
        max(area[1], east.max()) + _SURFACE_MARGIN_M,
        min(area[2], north.min()) - _SURFACE_MARGIN_M,
        max(area[3], north.max()) + _SURFACE_MARGIN_M,
    )
    return surface_through(points, frame, reach)


def _about_surface(surface: Surface) -> str:
    west, east, south, north = surface.reach_m
    at = np.stack(np.meshgrid(np.linspace(west, east, 30), np.linspace(south, north, 30)), axis=-1).reshape(-1, 2)
    low, middle, high = np.percentile(surface.sd_m(*at.T), (10, 50, 90))
    return (
        f"Ground: a smooth surface through {len(surface.height_m)} points of known height; standard deviation "
        f"{low:.1f} / {middle:.1f} / {high:.1f} m at 10 / 50 / 90 % of the area."
    )


def _on_ground(trees: Trees, dem: Dem | None) -> Trees:
    if dem is None or not len(trees):
        return trees
    return replace(trees, ground_m=np.nan_to_num(dem.ground_m(trees.east_m, trees.north_m)))


def _check_tower(tower: Tower, area: Area | None, frame: SiteFrame) -> None:
    """Refuse a tower kilometres from the site, which is a typing error."""
    away = math.hypot(tower.east_m, tower.north_m)
    if area is not None:
        # the origin of a large map may be in a corner
        away = min(away, math.hypot(_outside(tower.east_m, *area[:2]), _outside(tower.north_m, *area[2:])))
    if not away <= _FAR_TOWER_M:
        raise UsageError(
            f"tower '{tower.name}' ({tower.latitude_deg:.5f}, {tower.longitude_deg:.5f}) lies {away / 1000:.1f} km "
            f"from its site",
            expected=f"at most {_FAR_TOWER_M / 1000:g} km",
            cause=why_far(tower.latitude_deg, tower.longitude_deg, frame),
        )


def misread(latitude: Any, longitude: Any) -> dict[str, tuple[Any, Any]]:
    """Return corrected positions by the likely error of a wrong position, beginning with the most frequent error."""
    return {
        "latitude and longitude are swapped": (longitude, latitude),
        "the sign of the longitude is wrong: west is negative": (latitude, -longitude),
        "the sign of the latitude is wrong: south is negative": (-latitude, longitude),
        "latitude and longitude are swapped and a sign is wrong": (longitude, -latitude),
    }


def why_far(latitude: float, longitude: float, frame: SiteFrame) -> str:
    """Return the likely error of a position that is far from the site."""
    for cause, position in misread(latitude, longitude).items():
        # after a swap, the latitude can be invalid
        if abs(position[0]) <= 90 and float(np.hypot(*frame.to_local(*position))) <= _FAR_TOWER_M:
            return cause
    return "a digit is wrong, or it belongs to another site"


def _overlaps(buildings: tuple[Building, ...]) -> list[str]:
    """Return warnings about overlapping buildings, whose inner walls cause wrong reflections."""
    if len(buildings) < 2:
        return []
    shapes = [building.footprint for building in buildings]
    former, latter = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    pairs = [(int(i), int(j)) for i, j in zip(former, latter, strict=True) if i < j]
    # outlines that site import simplified may overlap by some decimetres
    overlapping = [(i, j) for i, j in pairs if not shapes[i].intersection(shapes[j]).buffer(-OVERLAP_M / 2).is_empty]
    if not overlapping:
        return []
    first = " and ".join(f"'{buildings[i].name}'" for i in overlapping[0])
    more = "" if len(overlapping) == 1 else f" and {counted(len(overlapping) - 1, 'more pair')}"
    return [f"warning: the buildings {first}{more} overlap; 'aerpaw-cmp site import' makes outlines disjoint"]


def _check_name(name: str, others: Iterable[str]) -> None:
    """Refuse a name that maps reserve, or that is equal to the name of another tower in file names."""
    in_files = re.sub(r"\W", "_", name)
    if name == NEAREST:
        raise UsageError(f"a tower named '{name}'", expected="another name", cause="maps reserve this name")
    if twin := next((other for other in others if re.sub(r"\W", "_", other) == in_files), None):
        raise UsageError(
            f"towers '{twin}' and '{name}'",
            expected="names that differ in letters or digits",
            cause=f"both are '{in_files}' in the names of layers and files",
        )


def _unmapped(towers: Mapping[str, Tower], shapes: list[Polygon]) -> list[str]:
    """Return warnings about towers without any object of the map nearby, where the ground is unknown."""
    # use distances to all shapes, because a union of all shapes of a town takes seconds
    away = {t.name: shapely.distance(shapes, Point(t.east_m, t.north_m)) for t in towers.values()}
    bare = [name for name, distances in away.items() if shapes and distances.min() > _MAPPED_M]
    if not bare:
        return []
    return [f"no map here: the site has no building and no wood within {_MAPPED_M:g} m of {', '.join(bare)}"]


def _outside(value: float, low: float, high: float) -> float:
    return max(low - value, value - high, 0.0)


def _tower(name: str, model: TowerModel, site: SiteModel, frame: SiteFrame, dem: Dem | None, notes: list[str]) -> Tower:
    chosen = _chosen_position(name, model, site.coordinates, frame, notes)
    east, north = frame.to_local(chosen.latitude_deg, chosen.longitude_deg)
    ground = 0.0
    if dem is not None:
        ground = float(dem.ground_m(east, north))
        if math.isnan(ground):
            raise UsageError(f"tower '{name}' is not on the elevation model", cause="a grid too small for the site")
    if site.tower_ground == "offsets":
        ground = model.ground_offset_m or 0.0
    return Tower(
        name=name,
        latitude_deg=chosen.latitude_deg,
        longitude_deg=chosen.longitude_deg,
        source=chosen.source,
        east_m=float(east),
        north_m=float(north),
        antenna_height_m=model.antenna_height_m or chosen.antenna_height_m or 10.0,
        ground_m=ground,
    )


def _chosen_position(
    name: str, model: TowerModel, source_name: str | None, frame: SiteFrame, notes: list[str]
) -> PositionModel:
    if model.latitude_deg is not None and model.longitude_deg is not None:
        return PositionModel(latitude_deg=model.latitude_deg, longitude_deg=model.longitude_deg, source=model.source)
    # use the first position in the file, which should be the most accurate
    key = next(iter(model.positions)) if source_name is None else source_name
    if key not in model.positions:
        raise UsageError(f"tower '{name}' has no position '{key}'", expected="one of " + ", ".join(model.positions))
    chosen = model.positions[key]
    place = frame.to_local(chosen.latitude_deg, chosen.longitude_deg)
    for source, position in model.positions.items():
        if source != key:
            place_of_source = frame.to_local(position.latitude_deg, position.longitude_deg)
            apart = math.hypot(float(place[0] - place_of_source[0]), float(place[1] - place_of_source[1]))
            notes.append(f"{name}: the positions in sources {key} (used) and {source} differ by {apart:.1f} m")
    return chosen


def _building(model: BuildingModel, footprint: Polygon, dem: Dem | None) -> Building:
    base = model.base_m
    if dem is not None:  # a floor is level, so use the ground height at the middle of the building
        base += float(np.nan_to_num(dem.ground_m(footprint.centroid.x, footprint.centroid.y)))
    return Building(
        name=model.name, height_m=model.height_m, material=model.material, source=model.source,
        footprint=footprint, base_m=base,
    )  # fmt: skip


def _trees(
    model: TreesModel,
    forests: tuple[Forest, ...],
    buildings: tuple[Building, ...],
    towers: Mapping[str, Tower],
    notes: list[str],
) -> tuple[Trees, Trees]:
    """Return the trees of the site, and separately the trees of forest stands, which only opaque foliage uses."""
    single = [(at, forest) for at, forest in enumerate(forests) if forest.height_m is None or forest.trees]
    # do not place trees inside houses or on masts; a union of all houses of a town takes seconds
    clear = shapely.union_all(
        [building.footprint for building in buildings if single]
        + [Point(tower.east_m, tower.north_m).buffer(MAST_CLEARANCE_M) for tower in towers.values()]
    )
    parts: list[Trees] = []
    of_stands: list[Trees] = []
    for index, forest in single:
        with _at("forests", index):
            placed = place_trees(forest, model, seed=model.seed, keep_clear=clear)
        wanted = wanted_trees(forest, clear)
        if len(placed) < wanted:
            room = f"room for {len(placed)} of {counted(wanted, 'tree')}"
            notes.append(f"{forest.name}: {room} at {forest.minimum_spacing_m:g} m spacing")
        (parts if forest.height_m is None else of_stands).append(placed)
    if model.single:
        parts.append(_single(model.single, model))
    return join_trees(parts), join_trees(of_stands)


def _single(models: list[SingleTreeModel], sizes: TreeSizes) -> Trees:
    """Return trees with their own sizes. Crowns begin at the same share of the height as for all trees."""
    for index, model in enumerate(models):
        with _at("trees", "single", index):
            _check_near([model.at_m], "trees.single")
    east, north = np.array([model.at_m for model in models], dtype=np.float64).T
    drawn = trees_at(east, north, sizes)

    def own(name: str) -> FloatArray:
        # NaN means the size of all trees
        stated = np.array([np.nan if (size := getattr(m, name)) is None else size for m in models], dtype=np.float64)
        return np.where(np.isnan(stated), getattr(drawn, name), stated)

    height = own("height_m")
    return replace(
        drawn,
        height_m=height,
        crown_base_m=height * sizes.crown_base_fraction,
        crown_diameter_m=own("crown_diameter_m"),
        trunk_diameter_m=own("trunk_diameter_m"),
    )


def trees_at(east_m: FloatArray, north_m: FloatArray, sizes: TreeSizes) -> Trees:
    """Return trees of one size at given points (n,) [m].

    Parameters
    ----------
    east_m, north_m : (n,)
        Positions of the trunks [m].
    sizes : TreeSizes

    Returns
    -------
    Trees
        The n trees.
    """
    count = len(east_m)
    return Trees(
        east_m=east_m,
        north_m=north_m,
        ground_m=np.zeros(count),
        height_m=np.full(count, sizes.height_m),
        crown_diameter_m=np.full(count, sizes.crown_diameter_m),
        crown_base_m=np.full(count, sizes.height_m * sizes.crown_base_fraction),
        trunk_diameter_m=np.full(count, sizes.trunk_diameter_m),
    )


def join_trees(parts: Sequence[Trees]) -> Trees:
    """Return all trees of several sets, in order."""
    if not parts:
        return Trees.none()
    return Trees(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Trees)})


def place_trees(
    forest: Forest, sizes: TreeSizes = PAPER_SIZES, *, seed: int = 0, keep_clear: BaseGeometry | None = None
) -> Trees:
    """Return trees at random positions in a forest, with at least its minimum spacing.

    Parameters
    ----------
    forest : Forest
        The number of trees is ``trees_per_hectare`` times the free area.
    sizes : TreeSizes, optional
        Sizes of the trees, by default as in the paper.
    seed : int
        The same seed and forest result in the same trees. Forests do not affect each other.
    keep_clear : shapely geometry, optional
        Area without trunks (buildings, masts).

    Returns
    -------
    Trees
        The trees. If the area is too small for all of them, there are fewer than :func:`wanted_trees`.

    Notes
    -----
    Random positions are drawn in batches. If two positions are too close, only the earlier position is used, as in
    random sequential addition. Complete batches are decided at once.
    """
    area = forest.area if keep_clear is None else shapely.difference(forest.area, keep_clear)
    # the seed uses the name, not the order, so that an added forest does not move the trees of others
    random = np.random.default_rng([seed, zlib.crc32(forest.name.encode())])
    points = _scatter(area, wanted_trees(forest, keep_clear), forest.minimum_spacing_m, random)
    return trees_at(points[:, 0], points[:, 1], sizes)


def wanted_trees(forest: Forest, keep_clear: BaseGeometry | None = None) -> int:
    """Return the number of trees for the density of a forest."""
    area = forest.area if keep_clear is None else shapely.difference(forest.area, keep_clear)
    return round(forest.trees_per_hectare * float(area.area) / 10_000.0)


def _scatter(area: BaseGeometry, count: int, spacing_m: float, random: np.random.Generator) -> FloatArray:
    """Return at most ``count`` random points in an area, at least ``spacing_m`` apart, shape (n, 2)."""
    placed = np.zeros((0, 2))
    if count <= 0 or area.is_empty:
        return placed
    if count > _MAXIMUM_TREES:
        raise UsageError(
            f"a forest of {area.area / 1e4:.0f} ha requires {count} trees",
            expected=f"at most {_MAXIMUM_TREES}",
            cause="trees_per_hectare is too high, or the outline reaches far outside the site",
        )
    shapely.prepare(area)
    east_min, north_min, east_max, north_max = area.bounds
    low, span = np.array([east_min, north_min]), np.array([east_max - east_min, north_max - north_min])
    # draw enough positions in the bounding box that about the required number is in the area
    share = area.area / max(float(span.prod()), 1e-300)
    stalled = 0
    while len(placed) < count and stalled < _STALLED_ROUNDS:
        missing = count - len(placed)
        darts = low + span * random.random((min(int(1.5 * missing / share) + 16, 2_000_000), 2))
        darts = darts[shapely.contains_xy(area, darts[:, 0], darts[:, 1])]
        if spacing_m > 0:
            if len(placed):
                darts = darts[cKDTree(placed).query(darts, distance_upper_bound=spacing_m)[0] >= spacing_m]
            darts = darts[_first_come(darts, spacing_m)]
        added = darts[:missing]
        # random placement slows down when about half of the area is occupied, so the last trees would take very long
        stalled = stalled + 1 if len(added) < 1e-3 * count else 0
        placed = np.concatenate([placed, added])
    return placed


def _first_come(points: FloatArray, spacing_m: float) -> BoolArray:
    """Return a mask of points (n, 2). A point is selected if no earlier selected point is within ``spacing_m``."""
    keep = np.zeros(len(points), dtype=bool)
    open_ = np.ones(len(points), dtype=bool)
    # find pairs that are closer than the spacing; two trees at exactly the spacing are allowed
    pairs = cKDTree(points).query_pairs(np.nextafter(spacing_m, 0), output_type="ndarray") if len(points) else None
    if pairs is None or not len(pairs):
        return open_
    early, late = pairs.min(axis=1), pairs.max(axis=1)
    while open_.any():
        waiting = np.zeros(len(points), dtype=bool)
        live = open_[early] & open_[late]
        early, late = early[live], late[live]
        waiting[late] = True
        chosen = open_ & ~waiting  # select points near which no earlier point is undecided
        keep |= chosen
        open_ &= ~chosen
        open_[late[chosen[early]]] = False
    return keep


def _checked_area(area: Area | None, east: Sequence[float], north: Sequence[float]) -> Area:
    if area is None:
        return (min(east) - 500.0, max(east) + 500.0, min(north) - 500.0, max(north) + 500.0)
    if not (area[0] < area[1] and area[2] < area[3]):
        raise UsageError(f"area_m is {list(area)}", expected="[east_min, east_max, north_min, north_max]")
    return area


def _check_near(points_m: list[tuple[float, float]], name: str) -> None:
    # check the coordinates first, because coordinates of a map grid would be valid outlines far from the site
    away = max(math.hypot(*point) for point in points_m)
    if away > _FAR_POLYGON_M:
        raise UsageError(
            f"'{name}' reaches {away / 1000:.0f} km from the site's origin",
            expected="metres east and north of the origin",
            cause="map coordinates (UTM or State Plane, metres or feet) in place of metres from the origin",
        )


def _ring_from_degrees(ring: list[tuple[float, float]], frame: SiteFrame, name: str) -> list[tuple[float, float]]:
    for latitude, longitude in ring:
        if not (-90 <= latitude <= 90 and -180 <= longitude <= 180):
            raise UsageError(
                f"'{name}': latitude {latitude:g}, longitude {longitude:g}",
                expected="latitude, longitude in degrees",
                cause="latitude and longitude are swapped" if abs(latitude) <= 180 and abs(longitude) <= 90 else None,
            )
    latitude, longitude = np.array(ring).T
    east, north = frame.to_local(latitude, longitude)
    away = float(np.hypot(east, north).max())
    if away > _FAR_POLYGON_M:
        wraps = float(np.abs(np.diff(longitude)).max()) > 180
        cause = "it crosses the antimeridian (180 deg)" if wraps else why_far(*ring[0], frame)
        raise UsageError(f"'{name}' reaches {away / 1000:.0f} km from the site's origin", cause=cause)
    return list(zip(east.tolist(), north.tolist(), strict=True))


def inputs_of_site(site: str | Path, folder: Path = Path()) -> list[Path]:
    """Return the site file and the files that it names. The list is empty if the site file has an error."""
    with suppress(AerpawCmpError, OSError):
        return [place for _, _, place in site_files(str(site), folder)]
    return []


def site_files(name: str, folder: Path) -> Iterator[tuple[str, str, Path]]:
    """Yield name, role and path of the site file and of the files that it names."""
    path = folder / name
    if not path.is_file():
        site_model(name)
        packaged = f"{packaged_name(name)}.yaml"
        with resources.as_file(resources.files(__package__) / "data" / packaged) as file:
            yield f"aerpaw_cmp/site/data/{packaged}", "site file (packaged)", file
        return
    yield name, "site file", path
    for key, text, place in named_files(site_model(path).model_dump(), [path.parent]):
        yield text, f"site: {key}", place

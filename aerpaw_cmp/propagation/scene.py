"""The scene of a replay: faces and towers in the form that the path search needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ..common.errors import UsageError
from ..common.units import BoolArray, FloatArray
from ..site.materials import material
from ..site.mitsuba import TriangleScene
from ..site.scenes import added, building_mesh
from ..site.site import Site
from .compiled import why_missing
from .geometry import Faces, Link, Links, Poses, Surfaces, inside_solids, site_faces


@dataclass(frozen=True, slots=True)
class Scene:
    """The geometry of a replay: faces, towers, and links without a path.

    Parameters
    ----------
    faces : Faces
    sources_m : (towers, 3)
    usable : (towers, faces) bool
        Faces that reflect for each tower.
    excluded : (towers, poses) bool
        Links without a path: an end inside a building or under the ground.
    surfaces : Surfaces or None
        Materials and triangles of the faces, for a site with a scene of triangles. The triangles replace ground planes.
    """

    faces: Faces
    sources_m: FloatArray
    usable: BoolArray
    excluded: BoolArray
    surfaces: Surfaces | None = None

    @classmethod
    def of(cls, site: Site, link: Link, poses: Poses) -> Scene:
        """Return the scene of a site for the towers of a link."""
        names = tuple(link.tower_arrays)
        unknown = [name for name in names if name not in site.towers]
        if unknown:
            raise UsageError(
                f"the site has no tower {unknown[0]!r}",
                expected="one of " + ", ".join(site.towers),
                cause="a typing error",
            )
        surfaces, towers = surfaces_of(site), [site.towers[name] for name in names]
        sources = np.array([tower.position_m for tower in towers]).reshape(-1, 3)
        # exclude links with an end inside a building before the search, which would otherwise try every face for them
        excluded = inside_solids(site, poses.position_m)[None, :] | inside_solids(site, sources)[:, None]
        if surfaces is not None:
            usable = np.ones((len(names), len(surfaces)), dtype=np.bool_)
            return cls(surfaces.faces, sources, usable, excluded, surfaces)
        faces = site_faces(site, names)
        ground = np.array([tower.ground_m for tower in towers])
        is_ground = faces.solid < 0
        # each tower uses only the ground plane at its foot, but all walls and roofs
        usable = ~is_ground[None, :] | (faces.offset_m[None, :] == ground[:, None])
        # a pose below the plane of a tower, but above the lowest ground or the terrain, is not buried
        lowest = np.minimum(ground, 0.0)[:, None]
        if site.dem is not None:
            # use fmin: outside the elevation model (NaN), the plane of the tower is the limit
            lowest = np.fmin(lowest, site.dem.ground_m(*poses.position_m[:, :2].T))
        return cls(faces, sources, usable, excluded | (poses.position_m[:, 2] < lowest))

    def links_to(self, poses: Poses) -> Links:
        """Return ends of the links from the towers to the poses."""
        return Links(self.sources_m, poses.position_m, self.usable, self.excluded)


def surfaces_of(site: Site) -> Surfaces | None:
    """Return the faces of the site's scene of triangles and its buildings. None without a scene of triangles."""
    if site.scene is None:
        return None
    scene = site.scene
    for building in site.buildings:
        # convert prisms to triangles, because the search in a scene of triangles needs triangles
        scene = added(scene, *building_mesh(building), building.name, material(building.material).name)
    return _merged(scene)


@lru_cache(maxsize=2)
def _merged(scene: TriangleScene) -> Surfaces:
    """Return the merged faces of a scene. The same scene is merged only once."""
    if reason := why_missing():
        raise UsageError(
            f"the site is a scene of triangles, but {reason}",
            expected="numba that works: pip install 'aerpaw-cmp[fast]'",
            cause="only compiled code can search its thousands of faces",
        )
    from .search.merging import merged  # compiled, so loaded only for a scene of triangles

    return merged(scene)


# Reject poses farther than this from every tower [m]: they do not belong to the site. The distance is the radio horizon
# of a UAV at 600 m. A row at 0, 0 degrees is thousands of kilometres away.
REACH_M = 100_000.0


@dataclass(frozen=True, slots=True)
class Omission:
    """A part that a replay does not model. ``counts`` is empty, (number,) or (number, total)."""

    what: str
    counts: tuple[int, ...] = ()
    tower: str = ""

    def __str__(self) -> str:
        tower = f"{self.tower}: " if self.tower else ""
        return tower + " ".join([*([" of ".join(map(str, self.counts))] if self.counts else []), self.what])


def within_reach(site: Site, poses: Poses) -> tuple[Poses, list[Omission]]:
    """Return the poses, with NaN for poses that cannot be replayed, and the omissions.

    Tolerances grow with the size of the scene, so one pose at 1e12 m would change the paths of all poses. A pose
    without a rotation has no field.
    """
    towers = np.array([tower.position_m for tower in site.towers.values()]).reshape(-1, 3)
    known = np.isfinite(poses.position_m).all(axis=1)
    turned = np.isfinite(poses.rotation).all(axis=(1, 2))
    with np.errstate(over="ignore", invalid="ignore"):
        # loop over towers, because an array of all pairs would grow with poses and towers
        far = np.ones(len(poses), dtype=np.bool_)
        for place in towers:
            # hypot does not overflow, unlike squares of 1e200
            far &= ~(np.hypot.reduce(poses.position_m - place, axis=1) <= REACH_M)
    far &= known
    bad = far | ~turned
    if not bad.any():
        return poses, []
    reasons = [
        (far, f"poses further than {REACH_M / 1000:g} km from every tower"),
        (known & ~far & ~turned, "poses without a rotation"),
    ]
    counted = [(int(mask.sum()), f"{what}: no path was searched for them") for mask, what in reasons]
    position = np.where(bad[:, None], np.nan, poses.position_m)
    # any rotation is valid, because it is not used; NaN would cause warnings in every product
    rotation = np.where(bad[:, None, None], np.eye(3), poses.rotation)
    return Poses(position, rotation), [Omission(what, (count,)) for count, what in counted]


def buried_towers(site: Site, link: Link) -> list[Omission]:
    """Report towers whose antenna is inside a building, because a wrong footprint would look like a missing signal."""
    lines = []
    names = list(link.tower_arrays)
    places = np.array([site.towers[name].position_m for name in names]).reshape(-1, 3)
    # test building by building to find its name, for buried towers only
    for number in np.flatnonzero(inside_solids(site, places)):
        name = names[number]
        for building in site.buildings:
            if inside_solids(replace(site, buildings=(building,)), places[number : number + 1]).any():
                lines.append(Omission(f"its antenna is inside {building.name}, so it has no path at all", tower=name))
    return lines

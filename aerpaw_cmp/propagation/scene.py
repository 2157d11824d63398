"""Geometry of a replay, and what decides its paths besides."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ..common.errors import UsageError
from ..common.units import BoolArray, FloatArray
from ..site.materials import material
from ..site.meshes import building_mesh
from ..site.mitsuba import TriangleScene
from ..site.scenes import added
from ..site.site import Site
from . import compiled
from .arrays import Link, Poses
from .crowns import Crowns
from .faces import inside_solids, site_faces
from .paths import Faces, PathSet
from .surfaces import Surfaces


@dataclass(frozen=True, slots=True)
class Settings:
    """What decides the paths besides the scene."""

    engine: str
    max_depth: int = 2
    samples: int = 1_000_000
    batch: int = 50
    variant: str | None = None
    threads: int | None = None
    power_cut_db: float | None = None


@dataclass(frozen=True, slots=True)
class Scene:
    """Geometry of a replay.

    Parameters
    ----------
    faces : Faces
    sources_m : (towers, 3)
    usable : (towers, faces) bool
        Faces that reflect for each tower.
    excluded : (towers, poses) bool
        Links without a path: an end inside a building or under the ground.
    extent_m : (points, 3), optional
        Points that set the tolerance of the path search in place of the poses.
    pairs : int
        Element pairs of all links of the replay that this scene is a part of; 0 where it is the whole.
    surfaces : Surfaces or None
        Of a site with a scene of triangles: what its faces are made of. They stand in for ground planes.
    """

    faces: Faces
    sources_m: FloatArray
    usable: BoolArray
    excluded: BoolArray
    surfaces: Surfaces | None = None
    extent_m: FloatArray | None = None
    pairs: int = 0

    @classmethod
    def of(cls, site: Site, link: Link, poses: Poses) -> Scene:
        """Scene of a site as the towers of a link see it."""
        names = tuple(link.tower_arrays)
        unknown = [name for name in names if name not in site.towers]
        if unknown:
            raise UsageError(
                f"the site has no tower {unknown[0]!r}",
                expected="one of " + ", ".join(site.towers),
                cause="a typing error",
            )
        surfaces = surfaces_of(site)
        if surfaces is not None:
            sources = np.array([site.towers[name].position_m for name in names]).reshape(-1, 3)
            excluded = inside_solids(site, poses.position_m)[None, :] | inside_solids(site, sources)[:, None]
            usable = np.ones((len(names), len(surfaces)), dtype=np.bool_)
            return cls(surfaces.faces, sources, usable, excluded, surfaces)
        faces = site_faces(site, names)
        towers = [site.towers[name] for name in names]
        sources = np.array([tower.position_m for tower in towers]).reshape(-1, 3)
        ground = np.array([tower.ground_m for tower in towers])
        is_ground = faces.solid < 0
        usable = ~is_ground[None, :] | (faces.offset_m[None, :] == ground[:, None])
        up = poses.position_m[:, 2]
        # terrain is not traced: a pose below a tower's own plane but above the lowest ground is no buried pose
        buried = up[None, :] < np.minimum(ground, 0.0)[:, None]
        excluded = buried | inside_solids(site, poses.position_m)[None, :] | inside_solids(site, sources)[:, None]
        return cls(faces, sources, usable, excluded)

    def with_bounces(self, site: Site, poses: Poses, crowns: Crowns, max_depth: int) -> tuple[Scene, PathSet]:
        """Scene with the facets of crowns that reflect, as hidden by nothing else than before, and their paths.

        Parameters
        ----------
        site : Site
        poses : Poses
        crowns : Crowns
            Those that reflect.
        max_depth : int
            Most reflections of a path, the bounce among them.

        Returns
        -------
        scene : Scene
            Its further faces are the facets that a path meets.
        paths : PathSet
            Those that bounce off a crown.
        """
        paths, faces = crowns.bounces(
            self.faces,
            self.sources_m,
            poses.position_m,
            max_depth=max_depth,
            usable=self.usable,
            excluded=self.excluded,
            dem=site.dem,
        )
        more = np.zeros((len(self.usable), len(faces) - len(self.faces)), dtype=np.bool_)
        return replace(self, faces=faces, usable=np.concatenate([self.usable, more], axis=1)), paths


def surfaces_of(site: Site) -> Surfaces | None:
    """Faces of the site's scene of triangles and of the buildings beside it; None where it has no scene."""
    if site.scene is None:
        return None
    scene = site.scene
    for building in site.buildings:
        scene = added(scene, *building_mesh(building), building.name, material(building.material).name)
    return _merged(scene if site.buildings else site.scene, site.merge_m)


@lru_cache(maxsize=2)
def _merged(scene: TriangleScene, merge_m: float) -> Surfaces:
    """Faces of a scene; the same scene is merged once."""
    if compiled.beams().kernels is None:
        raise UsageError(
            f"the site is a scene of triangles, but {compiled.beams().reason}",
            expected="numba that works: pip install 'aerpaw-cmp[fast]'",
            cause="its thousands of faces are searched by compiled code alone",
        )
    from .merging import merged  # compiled: loaded where there is a scene

    return merged(scene, merge_m)

"""Losses of a path of a flight besides its own field: foliage, reflections, rough ground."""

from __future__ import annotations

import numpy as np

from ...common.errors import UsageError
from ...common.units import FloatArray, wavelength_m
from ...propagation.field.foliage import crown_index, foliage_depth_m, foliage_loss_db, foliage_model
from ...propagation.field.stands import stand_depth_m, stand_loss_db
from ...propagation.geometry.arrays import Link, Poses, single_element
from ...propagation.geometry.paths import PathSet
from ...propagation.options import Loss, Run, Search
from ...propagation.replay import replay
from ...site.site import Site
from ..settings import RtSettings


def path_loss(site: Site, rt: RtSettings, carrier_hz: float) -> Loss | None:
    """Loss per path besides the field's own: foliage and reflections, a function of paths and their ends.

    Parameters
    ----------
    site : Site
        Its trees and stands, and how high its ground lies.
    rt : RtSettings
        ``foliage``, ``foliage_model``, ``gamma_db_per_m``, ``maximum_loss_db``, ``leaves``, ``reflection_loss_db``,
        ``ground_roughness_m``.
    carrier_hz : float

    Returns
    -------
    callable or None
        ``loss(paths, sources_m (towers, 3), targets_m (poses, 3)) -> (paths,)`` [dB], infinite where nothing gets
        through; None where no path loses anything.

    Raises
    ------
    UsageError
        ``rt.ground_roughness_m`` with a scene of triangles.
    """
    through = _foliage_loss(site, rt, carrier_hz)
    per_reflection, rough = rt.reflection_loss_db, roughness_loss(site, rt, carrier_hz)
    if per_reflection == 0.0 and rough is None:
        return through

    def loss(paths: PathSet, sources_m: FloatArray, targets_m: FloatArray) -> FloatArray:
        trees_db = 0.0 if through is None else through(paths, sources_m, targets_m)
        ground_db = 0.0 if rough is None else rough(paths, sources_m, targets_m)
        return np.asarray(trees_db + ground_db + per_reflection * paths.depth, dtype=np.float64)

    return loss


# Lines of sight are the same at any carrier.
_ANY_HZ = 3.4e9

# A reflection this near to a ground plane of the site is one off the ground.
_ON_GROUND_M = 1e-6


# The same over an elevation model, whose specular points are found by iteration.
_NEAR_TERRAIN_M = 0.01


def roughness_loss(site: Site, rt: RtSettings, carrier_hz: float) -> Loss | None:
    """Loss [dB] of ground reflections by ``rt.ground_roughness_m``; None where the ground is smooth.

    Parameters
    ----------
    site : Site
        Its ground: planes of the origin and of its towers, and its elevation model.
    rt : RtSettings
    carrier_hz : float

    Returns
    -------
    callable or None
        As :func:`path_loss` gives it.

    Raises
    ------
    UsageError
        A site that is a scene of triangles.

    Notes
    -----
    Each reflection off the ground falls by ``exp(-2 (k sigma sin(grazing))^2)``, the grazing angle that of the array
    centres (:func:`aerpaw_cmp.propagation.field.baselines.specular_factor`, here as a loss, which does not underflow);
    what leaves the specular direction is not followed.
    """
    sigma = rt.ground_roughness_m
    if sigma == 0.0:
        return None
    if site.scene is not None:
        raise UsageError(
            "rt.ground_roughness_m on a site that is a scene of triangles",
            expected="a site with a ground plane, or reflection_loss_db",
            cause="no face of the scene is known to be its ground",
        )
    # the planes of tower_ground: offsets stand beside the origin's
    heights = np.array(sorted({0.0, *(tower.ground_m for tower in site.towers.values())}))
    wavelength = wavelength_m(carrier_hz)

    def loss(paths: PathSet, sources_m: FloatArray, _targets_m: FloatArray) -> FloatArray:
        total, ray_start = np.zeros(len(paths)), sources_m[paths.tower]
        for step in range(paths.vertices_m.shape[1]):
            corner = paths.vertices_m[:, step]
            on = np.abs(corner[:, 2:] - heights).min(axis=1) < _ON_GROUND_M  # NaN where the path has no such corner
            if site.dem is not None:
                on |= np.abs(corner[:, 2] - site.dem.ground_m(corner[:, 0], corner[:, 1])) < _NEAR_TERRAIN_M
            ray = corner[on] - ray_start[on]
            sine = np.abs(ray[:, 2]) / np.maximum(np.linalg.norm(ray, axis=1), _ON_GROUND_M)
            total[on] += 40.0 * np.log10(np.e) * (2.0 * np.pi / wavelength * sigma * sine) ** 2
            ray_start = np.where(np.isfinite(corner), corner, ray_start)
        return total

    return loss


def _foliage_loss(site: Site, rt: RtSettings, carrier_hz: float) -> Loss | None:
    if not site.wooded or rt.foliage == "none":
        return None
    site = site.under(rt.foliage)
    model, evergreen = (
        foliage_model(
            rt.foliage_model if rt.foliage == "attenuating" else rt.foliage,
            carrier_hz,
            in_leaf=in_leaf,
            gamma_db_per_m=rt.advanced.gamma_db_per_m,
            maximum_db=rt.advanced.maximum_loss_db,
        )
        for in_leaf in (rt.leaves == "in", True)
    )
    index, wavelength = crown_index(site.trees), wavelength_m(carrier_hz)

    def loss(paths: PathSet, sources_m: FloatArray, targets_m: FloatArray) -> FloatArray:
        source, target = sources_m[paths.tower], targets_m[paths.pose]
        # single trees and woods as media shade one behind the other: their losses add
        trees_db = foliage_loss_db(source, paths.vertices_m, target, index, model)
        return trees_db + stand_loss_db(site, source, paths.vertices_m, target, model, wavelength, evergreen)

    return loss


def sight_shares(site: Site, tower: str, poses_m: FloatArray) -> tuple[float, float]:
    """Shares of the direct lines from a tower to poses (n, 3) [m] that woods shade, and that buildings hide."""
    source = site.towers[tower].position_m
    array = single_element()
    poses = Poses(poses_m, np.broadcast_to(np.eye(3), (len(poses_m), 3, 3)))
    # without a cache: a draft asks once
    seen = replay(site, Link(_ANY_HZ, {tower: array}, array), poses, Search(max_depth=0), run=Run(cache_dir=""))
    return float((direct_foliage_m(source, poses_m, site) > 0.0).mean()), float(1.0 - len(seen.paths) / len(poses_m))


def direct_foliage_m(tower_m: FloatArray, poses_m: FloatArray, site: Site) -> FloatArray:
    """Length (n,) [m] in crowns and stands of the direct lines from a tower (3,), or (n, 3), to poses (n, 3) [m]."""
    source = np.broadcast_to(tower_m, poses_m.shape)
    in_crowns = foliage_depth_m(source, np.zeros((len(poses_m), 0, 3)), poses_m, site.trees)
    return in_crowns + stand_depth_m(site, source, poses_m)

"""Element pairs with paths of their own, for the audit: every tower element is a source, every UAV element a pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...common.errors import UsageError
from ...common.units import ComplexArray, FloatArray
from ...site.site import Site
from ..engine.engines import search_paths
from ..field.sum import channel_matrices, mean_pair_power, rss_dbm
from ..geometry.arrays import Array, Link, Poses
from ..options import Field, Run, Search
from ..replay import further_paths, passed
from ..scene import Scene, within_reach


@dataclass(frozen=True, slots=True)
class PairChannels:
    """Channels of links with each element pair's own paths.

    Parameters
    ----------
    h : (poses, towers, n_rx, n_tx) complex128
        Zero without a path.
    rss_dbm, rss_power_dbm : (poses, towers)
        From ``|H|^2``, and from the sum of the paths' powers; NaN without a path.
    """

    h: ComplexArray
    rss_dbm: FloatArray
    rss_power_dbm: FloatArray


def replay_pairs(
    site: Site, link: Link, poses: Poses, search: Search = Search(), field: Field = Field(), run: Run = Run()
) -> PairChannels:
    """Replay with paths of each element pair; as many searches as the UAV has elements.

    Paths of further kinds are those of the array centres, as in a replay.

    Parameters
    ----------
    site, link, poses, search, field, run
        As for :func:`aerpaw_cmp.propagation.replay.replay`, engine ``image``.

    Returns
    -------
    PairChannels

    Raises
    ------
    UsageError
        Another engine than ``image``; what :func:`~aerpaw_cmp.propagation.replay.replay` raises.
    """
    if search.engine != "image":
        raise UsageError(
            "element pairs with engine 'sionna'",
            expected="engine 'image'",
            cause="each element pair is searched for its own paths",
        )
    poses, _ = within_reach(site, poses)
    arrays, uav = list(link.tower_arrays.values()), link.uav_array
    ports, towers = len(arrays[0]), len(arrays)
    singles = {f"{n} {p}": _single(array, p) for n, array in link.tower_arrays.items() for p in range(ports)}
    scene = Scene.of(site, link, poses)
    if search.links is not None:
        scene = replace(scene, excluded=scene.excluded | ~search.links)
    offsets = np.concatenate([array.positions_m @ array.mount.T for array in arrays])
    several = replace(
        scene,
        sources_m=np.repeat(scene.sources_m, ports, axis=0) + offsets,
        usable=np.repeat(scene.usable, ports, axis=0),
        excluded=np.repeat(scene.excluded, ports, axis=0),
    )
    h = np.zeros((len(poses), towers, len(uav), ports), dtype=np.complex128)
    power = np.zeros((len(poses), towers))
    turn, quiet = poses.rotation @ uav.mount, replace(run, progress=None, on_estimate=None)
    for element in range(len(uav)):
        spots = Poses(poses.position_m + turn @ uav.positions_m[element], poses.rotation)
        single = replace(link, tower_arrays=singles, uav_array=_single(uav, element), uav_transmits=False)
        paths = search_paths(several, single, spots, search, quiet)
        geometry, paths, _ = passed(site, several, single, spots, paths, search)
        loss_db = field.loss_db(paths, geometry.sources_m, spots.position_m)
        fields = channel_matrices(paths, geometry.faces, geometry.sources_m, spots, single, loss_db)
        h[:, :, element] = fields.h[..., 0, 0].reshape(len(poses), towers, ports)
        power += fields.power.reshape(len(poses), towers, ports).sum(axis=2) / (ports * len(uav))
    h = np.ascontiguousarray(h.swapaxes(2, 3)) if link.uav_transmits else h
    for _, added in further_paths(site, scene, link, poses, search, field):
        h, power = h + added.h, power + added.power
    level = rss_dbm(mean_pair_power(h), link.transmit_power_dbm, link.noise_floor_dbm)
    h = np.where(np.isfinite(level)[:, :, None, None], h, 0.0)
    return PairChannels(h, level, rss_dbm(power, link.transmit_power_dbm, link.noise_floor_dbm))


def _single(array: Array, element: int) -> Array:
    """One element of an array, in the centre of its own."""
    pattern = array.patterns[element if len(array.patterns) > 1 else 0]
    return Array(np.zeros((1, 3)), array.slant_rad[element : element + 1], (pattern,), array.mount)

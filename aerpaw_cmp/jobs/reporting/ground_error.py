"""Error bar of rank agreement by the ground's shape: the same flight over grounds that the known heights allow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...common.units import FloatArray, IntArray, spread_out
from ...compare.rank import channel_rank
from ...flight.data import FlightData
from ...flight.replay import Replayed, replay_poses
from ...site.relief.dem import Dem
from ...site.site import Site
from ...site.siteyaml import ground_surface, site_model

# Grounds that are drawn, and poses that are replayed over each.
_DRAWS, _POSES = 6, 300


def agreement_by_ground(
    data: FlightData, replayed: Replayed, measured: FloatArray, poses: IntArray, ks: Sequence[float]
) -> dict[str, float]:
    """Standard deviation of a tower's rank agreement, by K, over grounds drawn within the errors of known heights.

    Parameters
    ----------
    data : FlightData
    replayed : Replayed
        Of the rank of one tower.
    measured : (n,)
        Reported rank, NaN where the modem gave none.
    poses : (n,)
        The replayed pose of each report.
    ks : sequence of float

    Returns
    -------
    dict of str to float
        Empty for sites without ``ground_points``, scenes of triangles and towers that move.
    """
    model = site_model(data.site_place)
    known = np.flatnonzero(np.isfinite(measured))
    if not model.ground_points or data.site.scene is not None or replayed.tower_m is not None or not len(known):
        return {}
    known = known[spread_out(len(known), _POSES)]
    some = replayed.poses[poses[known]]
    agreed = []
    # seeds 0, 1, ...: two reports of a flight draw the same grounds, and so state the same number
    for ground in ground_surface(model, data.site.frame).dems(map(np.random.default_rng, range(_DRAWS))):
        h = replay_poses(_on(data.site, ground), data.settings.rt, replayed.link, some).h[:, 0]
        agreed.append([float((channel_rank(h, k) == measured[known]).mean()) for k in ks])
    return {f"{k:g}": float(sd) for k, sd in zip(ks, np.std(agreed, axis=0, ddof=1), strict=True)}


def _on(site: Site, ground: Dem) -> Site:
    """The site with towers, buildings and trees on another ground."""
    towers = {
        name: replace(tower, ground_m=float(np.nan_to_num(ground.ground_m(tower.east_m, tower.north_m))))
        for name, tower in site.towers.items()
    }
    return replace(site, dem=ground, towers=towers)

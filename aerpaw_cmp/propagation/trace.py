"""Ray tracing for notebooks: ``trace(site, link, poses)`` takes what is at hand and gives a :class:`Replay`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import UsageError
from ..common.units import unmasked
from ..site.site import Site
from ..site.siteyaml import load_site
from .edges import diffracted
from .geometry.arrays import Link, Poses
from .options import Diffraction, Engine, Field, Loss, Samples, Search
from .replay import Replay, replay


def trace(
    site: Site | str | Path,
    link: Link,
    poses: Poses | ArrayLike,
    engine: Engine = "image",
    max_depth: int = 2,
    *,
    loss: Loss | None = None,
    samples: Samples = "auto",
    diffraction: Diffraction = "none",
) -> Replay:
    """Paths, channel matrices and received power of poses at a site.

    Parameters
    ----------
    site : Site, str or path
        A loaded site, the name of a packaged one (``"lake_wheeler"``), or a site.yaml.
    link : Link
        Carrier, arrays and power. ``link.tower_arrays`` names towers of the site.
    poses : Poses or array_like, (poses, 3)
        Where the UAV is, metres east, north and up of the site's origin; plain positions stand level, nose to the
        east.
    engine : {"image", "sionna"}
        The exact image method, or Sionna RT's PathSolver as path finder; fields are float64 either way.
    max_depth : int
        Largest number of reflections, 0 to 3.
    loss : callable, optional
        Further loss per path [dB], such as foliage.
    samples : int or "auto"
        ``sionna`` only: rays per tower; "auto" raises the number until two pilots agree.
    diffraction : {"none", "edges"}
        Paths over one edge of a building, with the ground on either side (:mod:`aerpaw_cmp.propagation.edges`).

    Returns
    -------
    Replay
        ``rss_dbm (poses, towers)``, ``h (poses, towers, n_rx, n_tx)`` complex128, ``paths``; ``to_xarray()``.

    Raises
    ------
    UsageError
        An unknown site, tower or engine, poses of another shape, a scene too large for ``image``.

    Notes
    -----
    ``H[m, n] = sum_p a_p(m, n)`` over the paths p, each with its own length per pair of elements (spherical waves);
    ``a_p`` by free space, Fresnel coefficients and the elements' patterns (ITU-R P.2040).

    Examples
    --------
    >>> from aerpaw_cmp.propagation.geometry.arrays import Link, single_element
    >>> link = Link(3.4e9, {"LW1": single_element()}, single_element())
    >>> trace("lake_wheeler", link, [[100.0, 50.0, 40.0]]).rss_dbm.shape
    (1, 1)
    """
    place = site if isinstance(site, Site) else load_site(site)
    search = Search(engine, max_depth=max_depth, samples=samples, further=diffracted(diffraction))
    if isinstance(poses, Poses):
        # a masked value is a missing one: NaN, not the number under the mask
        poses = Poses(unmasked(poses.position_m), unmasked(poses.rotation))
    else:
        poses = _level(poses)
    return replay(place, link, poses, search, Field(loss))


def _level(position_m: ArrayLike) -> Poses:
    """Poses of a level aircraft, nose to the east, at positions (poses, 3)."""
    position = np.atleast_2d(unmasked(position_m))
    if position.ndim != 2 or position.shape[1] != 3:
        raise UsageError(
            f"poses of shape {np.shape(position_m)}",
            expected="Poses, or positions (poses, 3): metres east, north and up",
            cause="latitude and longitude, or heights left out",
        )
    return Poses(position, np.broadcast_to(np.eye(3), (len(position), 3, 3)).copy())

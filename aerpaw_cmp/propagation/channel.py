"""From paths to channel matrices, in float64, for every pair of elements.

For a pair (tower element ``t``, UAV element ``u``) and a path over the faces ``f1 .. fd`` the image ``I`` of ``t``
gives the length ``L = |u - I|`` and all directions; the entry of the channel matrix is::

    g_u . M_d ... M_1 . g_t   *   min(1, lambda / (4 pi L))   *   exp(-j 2 pi L / lambda)   *   10^(-loss / 20)

with ``g`` the complex field of the element as a vector in site axes and ``M_k`` the dyad of reflection ``k`` with
the Fresnel coefficients of ITU-R P.2040 at this pair's own angle. Time factor ``e^{+j omega t}``. The pattern of
the receiving element enters without conjugation (reciprocity), so turning a link round transposes H.

The smaller of 1 and ``lambda / (4 pi L)`` keeps an element pair closer than ``lambda / 4 pi`` from receiving more
than was sent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..common.errors import UsageError
from ..common.units import AnyArray, ComplexArray, FloatArray, IntArray, amplitude_from_db, db_from_power, wavelength_m
from ..site.materials import face_material
from . import compiled
from .arrays import Array, Link, Poses
from .paths import Faces, PathSet

PAIRS_PER_CHUNK = 8_000
"""Element pairs evaluated at once: a complex vector field of them (0.4 MB) stays in the cache of a core."""


@dataclass(frozen=True, slots=True)
class Fields:
    """What the paths of a replay add up to.

    Parameters
    ----------
    h : (poses, towers, n_rx, n_tx) complex
        Coherent sum over paths; zero without a path.
    path_power : (paths,)
        Mean over element pairs of ``|h|^2`` of each path alone.
    power : (poses, towers)
        Sum of ``path_power``: what a receiver sees on average when the phases of the paths are random.
    """

    h: ComplexArray
    path_power: FloatArray
    power: FloatArray


def channel_matrices(
    paths: PathSet,
    faces: Faces,
    sources_m: FloatArray,
    poses: Poses,
    link: Link,
    loss_db: FloatArray | None = None,
    *,
    threads: int | None = None,
    work: int | None = None,
) -> Fields:
    """Channel matrices of a path set.

    Source: arXiv 2502.10324 eq. 1; arXiv 2502.10324 eq. 6.

    Parameters
    ----------
    paths : PathSet
    faces : Faces
        That the paths refer to.
    sources_m : (towers, 3)
        Array centres, in the order of ``link.tower_arrays``.
    poses : Poses
    link : Link
    loss_db : (paths,), optional
        Further loss of each path, such as foliage.
    threads : int, optional
        Of compiled code (default: the cores this process may use); results do not depend on it.
    work : int, optional
        Element pairs of all links of the replay that this call is a part of; decides whether compiled code is worth
        loading (:mod:`aerpaw_cmp.propagation.compiled`).

    Returns
    -------
    Fields

    Raises
    ------
    UsageError
        If the towers' arrays have different numbers of elements, or an array has patterns for some elements only.

    Notes
    -----
    Compiled code differs from NumPy's by rounding: by some 1e-16 of the length in wavelengths, as angles [rad]
    (``tests/propagation/test_compiled.py``).
    """
    arrays = list(link.tower_arrays.values())
    ports = _ports(arrays)
    _check_patterns([*arrays, link.uav_array])
    pairs = ports * len(link.uav_array)
    size = len(poses) * len(arrays) * pairs if work is None else work
    kernels = compiled.kernels_for(size)
    if kernels is not None:
        from .compiled_field import evaluate

        tables = FaceMaterials.of(faces, link.carrier_hz)
        electric = (tables.permittivity, tables.thickness_m)
        h, path_power = evaluate(kernels, paths, faces, electric, sources_m, poses, link, loss_db, threads)
    else:
        h, path_power = _in_numpy(paths, faces, sources_m, poses, link, loss_db)
    links = paths.pose * len(arrays) + paths.tower
    power = np.bincount(links, weights=path_power, minlength=len(poses) * len(arrays)).astype(np.float64)
    return Fields(h, path_power, power.reshape(len(poses), len(arrays)))


def _in_numpy(
    paths: PathSet, faces: Faces, sources_m: FloatArray, poses: Poses, link: Link, loss_db: FloatArray | None
) -> tuple[ComplexArray, FloatArray]:
    """H (poses, towers, n_rx, n_tx) and the power (paths,) of each path alone."""
    arrays = list(link.tower_arrays.values())
    ports, uav = len(arrays[0]), len(link.uav_array)
    h = np.zeros((len(poses) * len(arrays), uav, ports), dtype=np.complex128)
    path_power = np.zeros(len(paths))
    tables = FaceMaterials.of(faces, link.carrier_hz)
    # a stable order by tower gives each chunk one tower array; additions go to rows, whose order does not matter
    for rows, tower in _chunks(paths, len(arrays), uav * ports):
        one = chunk_field(paths, rows, faces, tables, sources_m[tower], arrays[tower], poses, link)
        if loss_db is not None:
            one *= amplitude_from_db(-loss_db[rows])[:, None, None]
        path_power[rows] = (one.real**2 + one.imag**2).mean(axis=(1, 2))
        key = paths.pose[rows] * len(arrays) + tower
        first = np.flatnonzero(np.diff(key, prepend=-1))
        h[key[first]] += np.add.reduceat(one, first, axis=0)
    if link.uav_transmits:
        h = h.swapaxes(1, 2)
    return np.ascontiguousarray(h).reshape(len(poses), len(arrays), *h.shape[1:]), path_power


def _check_patterns(arrays: Sequence[Array]) -> None:
    for array in arrays:
        if len(array.patterns) not in (1, len(array)):
            raise UsageError(
                f"{len(array.patterns)} patterns for {len(array)} elements",
                expected="one shared pattern or one per element",
            )


def _ports(arrays: Sequence[Array]) -> int:
    counts = {len(array) for array in arrays}
    if len(counts) != 1:
        raise UsageError(
            f"tower arrays of {sorted(counts)} elements",
            expected="the same number of elements at every tower of a link",
        )
    return counts.pop()


def _chunks(paths: PathSet, towers: int, pairs: int) -> Iterator[tuple[IntArray, int]]:
    step = max(1, PAIRS_PER_CHUNK // pairs)
    for tower in range(towers):
        rows = np.flatnonzero(paths.tower == tower)
        rows = rows[np.argsort(paths.pose[rows], kind="stable")]  # links are summed as runs of equal poses
        for start in range(0, len(rows), step):
            yield rows[start : start + step], tower


def chunk_field(
    paths: PathSet,
    rows: IntArray,
    faces: Faces,
    tables: FaceMaterials,
    source_m: FloatArray,
    array: Array,
    poses: Poses,
    link: Link,
    record: Callable[[str, AnyArray], None] | None = None,
) -> ComplexArray:
    """Complex amplitudes of some paths of one tower.

    Parameters
    ----------
    paths : PathSet
    rows : (rows,) int
        Which of them.
    faces : Faces
    tables : FaceMaterials
        Of the faces, at the carrier of the link.
    source_m : (3,)
        Centre of the tower's array [m].
    array : Array
        Of the tower.
    poses : Poses
    link : Link
    record : callable, optional
        Gets what it is made of: "wave" (3, rows, uav elements, tower elements) after the tower and after each
        reflection, "spreading", and "uav", the field vectors of the UAV's elements.

    Returns
    -------
    (rows, uav elements, tower elements) complex
        Spreading, patterns, reflections and carrier phase: what a path adds to H.
    """
    depth = int(paths.depth[rows].max(initial=0))
    wavelength = wavelength_m(link.carrier_hz)
    sequence = paths.faces[rows, :depth]
    turn = poses.rotation[paths.pose[rows]] @ link.uav_array.mount
    image = np.repeat((source_m + array.positions_m @ array.mount.T).T[:, None, :], len(rows), axis=1)
    normals = [_normals(faces, sequence[:, step]) for step in range(depth)]
    for step, normal in enumerate(normals):
        offset = np.where(sequence[:, step] >= 0, faces.offset_m[sequence[:, step]], 0.0)
        image -= 2.0 * ((normal[:, :, None] * image).sum(axis=0) - offset[:, None]) * normal[:, :, None]
    uav = poses.position_m[paths.pose[rows]][:, None, :] + link.uav_array.positions_m @ turn.transpose(0, 2, 1)
    reach = np.moveaxis(uav, 2, 0)[:, :, :, None] - image[:, :, None, :]
    length = np.sqrt((reach**2).sum(axis=0))
    with np.errstate(invalid="ignore", divide="ignore"):
        toward = np.where(length > 0.0, reach / length, 0.0)
    directions = [toward]
    for normal in reversed(normals):
        directions.insert(0, _mirror(normal[:, :, None, None], directions[0]))
    wave = _radiate(array, np.broadcast_to(array.mount, (len(rows), 3, 3)), directions[0], 3)
    for step, normal in enumerate(normals):
        if record is not None:
            record("wave", wave)
        wave = _reflect(wave, directions[step], normal[:, :, None, None], sequence[:, step], tables, wavelength)
    uav_field = _radiate(link.uav_array, turn, -toward, 2)
    received = (uav_field * wave).sum(axis=0)
    cycles = length / wavelength
    with np.errstate(divide="ignore"):
        amplitude = np.minimum(1.0, 1.0 / (4.0 * np.pi * cycles))
    if record is not None:
        for name, value in (("wave", wave), ("spreading", amplitude), ("uav", uav_field)):
            record(name, value)
    return np.asarray(received * amplitude * np.exp(-2j * np.pi * (cycles - np.round(cycles))))


def _normals(faces: Faces, index: IntArray) -> FloatArray:
    """Normals (3, paths) of the faces; zero where there is none, so that mirroring does nothing."""
    return np.asarray(np.where(index >= 0, faces.normal[index].T, 0.0))


def _mirror(normal: FloatArray, vector: AnyArray) -> AnyArray:
    return np.asarray(vector - 2.0 * (normal * vector).sum(axis=0) * normal)


def radiated(array: Array, turn: FloatArray, direction: FloatArray) -> ComplexArray:
    """Field vectors (3, paths, elements) in site axes of an array's elements in one direction (3, paths) per path.

    ``turn`` (paths, 3, 3) turns the device into the site; directions point away from the device.
    """
    everywhere = np.broadcast_to(direction[:, :, None, None], (*direction.shape, 1, len(array)))
    return _radiate(array, turn, everywhere, 3)[:, :, 0]


def _radiate(array: Array, turn: FloatArray, direction: FloatArray, axis: int) -> ComplexArray:
    """Field vectors in site axes.

    Source: 3GPP TR 38.901 section 7.3.2.

    Parameters
    ----------
    array : Array
    turn : (paths, 3, 3)
        Device to site.
    direction : (3, paths, uav elements, tower elements)
        Away from the device.
    axis : {2, 3}
        The axis of ``direction`` that runs over the elements of ``array``.

    Returns
    -------
    (3, paths, uav elements, tower elements) complex
    """
    local = np.einsum("pji,jpab->ipab", turn, direction)
    across = np.hypot(local[0], local[1])
    theta = np.arctan2(across, local[2])  # arccos would lose half of the digits near the poles
    phi = np.arctan2(local[1], local[0])
    e_theta, e_phi = _element_fields(array, theta, phi, axis - 1)
    shape = [1, 1, 1]
    shape[axis - 1] = len(array)
    slant = array.slant_rad.reshape(shape)
    # TR 38.901 section 7.3.2, model 2: the pattern stays, its polarisation turns in the (theta, phi) basis
    turned_theta = e_theta * np.cos(slant) - e_phi * np.sin(slant)
    turned_phi = e_theta * np.sin(slant) + e_phi * np.cos(slant)
    # sines and cosines of theta and phi are ratios of the components; at a pole phi is 0
    pole = across == 0.0
    below = np.where(pole, 1.0, across)
    cos_phi, sin_phi = np.where(pole, 1.0, local[0] / below), local[1] / below
    vector = np.stack(
        [
            turned_theta * (local[2] * cos_phi) - turned_phi * sin_phi,
            turned_theta * (local[2] * sin_phi) + turned_phi * cos_phi,
            -turned_theta * across,
        ]
    )
    return np.asarray(np.einsum("pij,jpab->ipab", turn, vector))


def _element_fields(array: Array, theta: FloatArray, phi: FloatArray, axis: int) -> tuple[ComplexArray, ComplexArray]:
    """Pattern of each element in its own directions."""
    if len(array.patterns) == 1:
        return array.patterns[0].field(theta, phi)
    e_theta = np.empty(theta.shape, dtype=np.complex128)
    e_phi = np.empty_like(e_theta)
    for element, pattern in enumerate(array.patterns):
        pick = (slice(None),) * axis + (element,)
        e_theta[pick], e_phi[pick] = pattern.field(theta[pick], phi[pick])
    return e_theta, e_phi


def _reflect(
    wave: ComplexArray,
    direction: FloatArray,
    normal: FloatArray,
    index: IntArray,
    tables: FaceMaterials,
    wavelength: float,
) -> ComplexArray:
    """The wave after one reflection; paths whose ``index`` is -1 keep theirs.

    With ``R`` the mirror, ``s`` the unit normal of the plane of incidence and e = e_s + e_p, the reflected wave
    ``r_te e_s + r_tm e_p'`` equals ``-r_tm R e + (r_te + r_tm) s (s . e)``. At normal incidence ``s`` is not defined,
    but there ``r_te + r_tm`` is zero.
    """
    cos_theta = np.abs((normal * direction).sum(axis=0))
    s = np.cross(direction, normal, axis=0)
    sine2 = (s**2).sum(axis=0)
    eta, thickness = tables.permittivity[index], tables.thickness_m[index]
    r_te, r_tm = reflection_coefficients(cos_theta, eta[:, None, None], thickness[:, None, None], wavelength)
    across = (s * wave).sum(axis=0) * ((r_te + r_tm) / np.maximum(sine2, 1e-300))
    result = -r_tm * _mirror(normal, wave) + across * s
    return np.asarray(np.where((index >= 0)[:, None, None], result, wave))


def reflection_coefficients(
    cos_theta: FloatArray, permittivity: ComplexArray, thickness_m: FloatArray, wavelength: float
) -> tuple[ComplexArray, ComplexArray]:
    """Reflection coefficients (TE, TM) of a half-space or a slab in air.

    Source: ITU-R P.2040-3 eq. 37; ITU-R P.2040-3 eq. 43.

    Parameters
    ----------
    cos_theta : (...)
        Cosine of the angle of incidence, from the normal.
    permittivity : (...) complex
        Relative, negative imaginary part.
    thickness_m : (...)
        Infinite for a half-space.
    wavelength : float
        In air [m].

    Returns
    -------
    te, tm : (...) complex
        Of the electric field across and in the plane of incidence.

    Notes
    -----
    ITU-R P.2040-3 eq. (37) for the half-space and (43)-(44) for the slab.

    Examples
    --------
    >>> te, tm = reflection_coefficients(np.array(1.0), np.array(4 + 0j), np.array(np.inf), 0.1)
    >>> complex(te.round(6)), complex(tm.round(6))
    ((-0.333333+0j), (0.333333+0j))
    """
    root = np.sqrt(permittivity - (1.0 - cos_theta**2))
    te = (cos_theta - root) / (cos_theta + root)
    tm = (permittivity * cos_theta - root) / (permittivity * cos_theta + root)
    slab = np.isfinite(thickness_m)
    if slab.any():
        # a half-space returns no second echo
        depth = np.where(slab, thickness_m, 0.0)
        echo = np.where(slab, np.exp(-4j * np.pi / wavelength * depth * root), 0.0)
        te = te * (1.0 - echo) / (1.0 - te**2 * echo)
        tm = tm * (1.0 - echo) / (1.0 - tm**2 * echo)
    return np.asarray(te, dtype=np.complex128), np.asarray(tm, dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class FaceMaterials:
    """Permittivity and thickness per face; the entry at -1 is a harmless one for paths without a face."""

    permittivity: ComplexArray
    thickness_m: FloatArray

    @classmethod
    def of(cls, faces: Faces, carrier_hz: float) -> FaceMaterials:
        """Those of all faces at a carrier."""
        known = {name: face_material(name) for name in set(faces.material)}
        eta = [known[name].relative_permittivity(carrier_hz) for name in faces.material]
        thick = [known[name].thickness_m for name in faces.material]
        return cls(
            np.array([*eta, 2.0 + 0j], dtype=np.complex128),
            np.array([*(np.inf if t is None else t for t in thick), np.inf], dtype=np.float64),
        )


def rss_dbm(power: FloatArray, transmit_power_dbm: float, noise_floor_dbm: float = -np.inf) -> FloatArray:
    """Received power [dBm]; NaN where ``power`` is zero (no path) or the level is below the noise floor [dBm].

    ``power`` is the mean over element pairs of ``|h|^2``: the transmit power is shared equally by the transmitting
    ports, which send independent signals, and the received power is the mean over the receiving ports. With one
    element at both ends it is ``|h|^2``.
    """
    level = transmit_power_dbm + db_from_power(power)
    return np.asarray(np.where((power > 0.0) & (level >= noise_floor_dbm), level, np.nan))


def mean_pair_power(h: ComplexArray) -> FloatArray:
    """Mean over the last two axes of ``|h|^2``; tiny and huge channels neither vanish nor overflow."""
    parts = np.ascontiguousarray(h).view(np.float64).reshape(*h.shape[:-2], 2 * h.shape[-2] * h.shape[-1])
    pairs = max(parts.shape[-1] // 2, 1)
    with np.errstate(over="ignore", under="ignore"):
        power = np.asarray(np.einsum("...i,...i->...", parts, parts) / pairs)
    odd = ~((power > 1e-280) & (power < 1e280))  # squares may have lost digits: scaled by the largest entry
    if odd.any():
        some = h[odd]
        scale = np.abs(some).max(axis=(-2, -1), keepdims=True, initial=0.0)
        safe = np.where(scale > 0.0, scale, 1.0)
        power[odd] = (np.abs(some / safe) ** 2).mean(axis=(-2, -1)) * scale[..., 0, 0] ** 2
    return power

"""The float64 field on a CUDA device: a thread per path and element pair, then one per link and pair that adds.

The scalar functions are those of :mod:`aerpaw_cmp.propagation.kernels`, compiled for the device. Patterns that are real
formulas (isotropic, dipole, TR 38.901) are evaluated there; links with measured or other patterns stay on the CPU.
Paths are added in their order, so results do not depend on how many run at once. It was run in numba's simulator only
(``NUMBA_ENABLE_CUDASIM=1``): no GPU was at hand.
"""

from __future__ import annotations

import inspect
import math
from typing import Any

import numpy as np
from numba import cuda

from ..common.units import AnyArray
from . import kernels
from .kernels import TR38901

_ROUND = 6755399441055744.0
THREADS = 128
BYTES_PER_PAIR = 16
SHARE_OF_FREE_MEMORY = 0.25
"""Of the device's free memory, taken by the amplitudes of a batch of paths."""

_unfold, _fresnel, _slab, _turn, _amplitude = (
    cuda.jit(device=True)(function.py_func)
    for function in (
        kernels.unfold,
        kernels.fresnel,
        kernels.slab,
        kernels.turn_sine_cosine,
        kernels.element_amplitude,
    )
)


@cuda.jit(device=True)
def _radiate(x, y, z, kind, c, s, m, out):  # type: ignore[no-untyped-def]
    """Field vector of one element in the last space; ``m`` has the device axes as rows."""
    across = math.sqrt(x * x + y * y)
    cosine, sine = 1.0, 0.0
    if across > 0.0:
        cosine, sine = x / across, y / across
    theta = 1.0 if kind == 0 else _amplitude(kind, x, y, z)
    e_theta, e_phi = theta * c, theta * s
    a = e_theta * (z * cosine) - e_phi * sine
    b = e_theta * (z * sine) + e_phi * cosine
    d = -e_theta * across
    for i in range(3):
        out[i] = m[0, i] * a + m[1, i] * b + m[2, i] * d


@cuda.jit
def _paths(  # type: ignore[no-untyped-def]
    first, pose, tower, depth, sequence, loss_db, normal, offset_m, eta, wavelength, sources_m, mounts, tower_m,
    tower_slants, tower_kinds, positions_m, rotations, uav_mount, uav_m, uav_slants, uav_kinds, amplitude,
):  # type: ignore[no-untyped-def]  # fmt: skip
    """Complex amplitude (paths, pairs, 2) of each path and pair from number ``first`` on."""
    number = cuda.grid(1)
    pairs = tower_m.shape[2]
    if number >= amplitude.shape[0] * pairs:
        return
    p, path = number % pairs, first + number // pairs
    image, frame, normals = cuda.local.array(3, "f8"), cuda.local.array((3, 3), "f8"), cuda.local.array((3, 3), "f8")
    axes, w, v, g = (
        cuda.local.array((3, 3), "f8"),
        cuda.local.array(3, "f8"),
        cuda.local.array(3, "f8"),
        cuda.local.array(3, "f8"),
    )
    place, source = pose[path], tower[path]
    _unfold(normal, offset_m, sequence[path], depth[path], sources_m[source], mounts[source], image, frame, normals)
    reach = cuda.local.array(3, "f8")
    for j in range(3):
        for i in range(3):
            axes[j, i] = (
                rotations[place, i, 0] * uav_mount[0, j]
                + rotations[place, i, 1] * uav_mount[1, j]
                + rotations[place, i, 2] * uav_mount[2, j]
            )
    size = 0.0
    for i in range(3):
        uav = positions_m[place, i] + (axes[0, i] * uav_m[0, p] + axes[1, i] * uav_m[1, p] + axes[2, i] * uav_m[2, p])
        reach[i] = uav - (
            image[i]
            + frame[0, i] * tower_m[source, 0, p]
            + frame[1, i] * tower_m[source, 1, p]
            + frame[2, i] * tower_m[source, 2, p]
        )
        size += reach[i] * reach[i]
    length = math.sqrt(size)
    if length == 0.0:
        amplitude[number // pairs, p, 0] = 0.0
        amplitude[number // pairs, p, 1] = 0.0
        return
    x, y, z = reach[0] / length, reach[1] / length, reach[2] / length
    _radiate(
        frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z,
        frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z,
        frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z,
        tower_kinds[source, p], tower_slants[source, 0, p], tower_slants[source, 1, p], frame, w,
    )  # fmt: skip
    _radiate(
        -(axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z),
        -(axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z),
        -(axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z),
        uav_kinds[p], uav_slants[0, p], uav_slants[1, p], axes, g,
    )  # fmt: skip
    for i in range(3):
        v[i] = 0.0
    for step in range(depth[path]):
        face = sequence[path, step]
        n0, n1, n2 = normals[step, 0], normals[step, 1], normals[step, 2]
        te_re, te_im, tm_re, tm_im, root_re, root_im = _fresnel(
            abs(n0 * x + n1 * y + n2 * z), eta[face, 0], eta[face, 1]
        )
        if eta[face, 2] < math.inf:
            fade = math.exp(4.0 * math.pi * eta[face, 2] * root_im)
            turns = -2.0 * eta[face, 2] * root_re
            sine, cosine = _turn(turns - ((turns + _ROUND) - _ROUND))
            te_re, te_im = _slab(te_re, te_im, fade * cosine, fade * sine)
            tm_re, tm_im = _slab(tm_re, tm_im, fade * cosine, fade * sine)
        s0, s1, s2 = y * n2 - z * n1, z * n0 - x * n2, x * n1 - y * n0
        scale = 1.0 / max(s0 * s0 + s1 * s1 + s2 * s2, 1e-300)
        q_re, q_im = (te_re + tm_re) * scale, (te_im + tm_im) * scale
        a, b = s0 * w[0] + s1 * w[1] + s2 * w[2], s0 * v[0] + s1 * v[1] + s2 * v[2]
        c_re, c_im = a * q_re - b * q_im, a * q_im + b * q_re
        s = (s0, s1, s2)
        for i in range(3):
            re, im = w[i], v[i]
            w[i] = c_re * s[i] - (tm_re * re - tm_im * im)
            v[i] = c_im * s[i] - (tm_re * im + tm_im * re)
    re = g[0] * w[0] + g[1] * w[1] + g[2] * w[2]
    im = g[0] * v[0] + g[1] * v[1] + g[2] * v[2]
    cycles = length / wavelength
    spread = min(1.0, 1.0 / (4.0 * math.pi * cycles))
    spread *= 10.0 ** (-loss_db[path] / 20.0)
    sine, cosine = _turn(cycles - ((cycles + _ROUND) - _ROUND))
    amplitude[number // pairs, p, 0] = spread * (re * cosine + im * sine)
    amplitude[number // pairs, p, 1] = spread * (im * cosine - re * sine)


COLUMNS = tuple(inspect.signature(_paths.py_func).parameters)[1:-1]
"""What of the CPU kernel's columns the device takes, in order."""


def _filled(values: AnyArray) -> AnyArray:
    """An array without an empty axis: a device has no memory of no bytes."""
    return values if values.size else np.zeros([max(n, 1) for n in values.shape], values.dtype)


def available() -> str:
    """Empty where a CUDA device can be used, else why not."""
    try:
        return "" if cuda.is_available() else "numba finds no CUDA device"
    except Exception as error:  # drivers fail in their own ways
        return f"CUDA cannot be used ({type(error).__name__}: {error})"


def can_evaluate(known: dict[str, Any]) -> bool:
    """Whether every pattern of the link is a formula that the device knows."""
    return bool(known["tower_kinds"].max(initial=0) <= TR38901 and known["uav_kinds"].max(initial=0) <= TR38901)


def _batch(paths: int, pairs: int) -> int:
    """Paths at once: what a share of the device's free memory holds."""
    try:
        free = int(cuda.current_context().get_memory_info()[0])
    except Exception:  # the simulator has no memory of its own
        free = 1 << 30
    return max(1, min(paths, int(SHARE_OF_FREE_MEMORY * free) // (BYTES_PER_PAIR * pairs)))


def evaluate(known: dict[str, Any], h: Any, path_power: Any) -> None:
    """Fill H (links, pairs, 2) and path powers from the columns that the CPU's kernel takes."""
    pairs, towers = known["tower_m"].shape[2], len(known["sources_m"])
    arrays = {name: _filled(value) for name, value in known.items() if isinstance(value, np.ndarray)}
    if not len(known["loss_db"]):
        arrays["loss_db"] = np.zeros(len(path_power))
    values = [arrays.get(name, known.get(name)) for name in COLUMNS]
    values = [cuda.to_device(v) if isinstance(v, np.ndarray) else v for v in values]
    link = known["pose"] * towers + known["tower"]
    step = _batch(len(link), pairs)
    for first in range(0, len(link), step):
        count = min(step, len(link) - first)
        amplitude = cuda.device_array((count, pairs, 2))
        _paths[(count * pairs + THREADS - 1) // THREADS, THREADS](first, *values, amplitude)
        one = amplitude.copy_to_host()
        path_power[first : first + count] = (one**2).sum(axis=(1, 2)) / pairs
        # in the order of the paths, as on the CPU
        np.add.at(h, (link[first : first + count, None], known["out"][None, :]), one)

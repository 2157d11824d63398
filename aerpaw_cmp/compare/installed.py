"""The gain that mast and airframe add to mounted antennas, learned from the residual of a flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..common.units import FloatArray
from ..site.installed import harmonics

ORDERS = (0, 1, 2, 3, 4)
"""Harmonics to choose from; 4 resolves 45 degrees."""

SHRINK = 0.02
"""Ridge: a coefficient that the flight does not see (an azimuth never flown) goes to zero."""

BLOCKS = 8
"""Contiguous parts of the flight, left out in turn when the order is chosen."""


@dataclass(frozen=True, slots=True)
class LinkAngles:
    """Direction of the other end in the device frame of both antennas: azimuth and zenith angle [rad], each (n,)."""

    uav_azimuth: FloatArray
    uav_zenith: FloatArray
    tower_azimuth: FloatArray
    tower_zenith: FloatArray


@dataclass(frozen=True, slots=True)
class InstalledFit:
    """Added gain of both ends.

    Parameters
    ----------
    order : int
        Harmonics of azimuth.
    uav_db : (2 order,)
        Of the UAV antenna, which all channels share.
    tower_db : mapping of str to (2 order,)
        Of each channel's antenna at the tower.
    block_rmse_db : mapping of int to float
        Per order tried: RMSE on parts of the same flight that were left out [dB].
    """

    order: int
    uav_db: tuple[float, ...]
    tower_db: Mapping[str, tuple[float, ...]]
    block_rmse_db: Mapping[int, float]


def fit_installed(
    residual_db: Mapping[str, FloatArray], angles: Mapping[str, LinkAngles], orders: Sequence[int] = ORDERS
) -> InstalledFit:
    """Added gain per azimuth that explains the residual of one flight.

    Parameters
    ----------
    residual_db : mapping of str to (n,)
        Measured minus simulated per channel, in time order; NaN does not count.
    angles : mapping of str to LinkAngles
        Per channel.
    orders : sequence of int
        Numbers of harmonics to choose from, by the error on left-out contiguous parts of this same flight: no
        other flight takes part in any choice.

    Raises
    ------
    ValueError
        If a channel has fewer than twice as many samples as there are parts to leave out.
    """
    channels = list(residual_db)
    if min(int(np.isfinite(residual_db[c]).sum()) for c in channels) < 2 * BLOCKS:
        raise ValueError(f"a channel has fewer than {2 * BLOCKS} samples")
    errors = {order: _left_out_rmse(residual_db, angles, order) for order in orders}
    order = min(errors, key=lambda o: errors[o])
    design, target, _ = _system(residual_db, angles, order)
    coefficients = _ridge(design, target, len(channels))[len(channels) :]
    pieces = coefficients.reshape(len(channels) + 1, 2 * order)
    tower = {c: tuple(map(float, piece)) for c, piece in zip(channels, pieces[1:], strict=True)}
    return InstalledFit(order, tuple(map(float, pieces[0])), tower, errors)


def _system(
    residual_db: Mapping[str, FloatArray], angles: Mapping[str, LinkAngles], order: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rows of all channels: an own constant, the shared UAV terms, own tower terms; target; part of the flight."""
    channels, width = list(residual_db), 2 * order
    rows, targets, parts = [], [], []
    for i, channel in enumerate(channels):
        at, values = angles[channel], np.asarray(residual_db[channel], dtype=np.float64)
        row = np.zeros((len(values), len(channels) + width * (1 + len(channels))))
        row[:, i] = 1.0
        start = len(channels)
        row[:, start : start + width] = harmonics(at.uav_azimuth, order) * np.sin(at.uav_zenith)[:, None]
        own = start + width * (1 + i)
        row[:, own : own + width] = harmonics(at.tower_azimuth, order) * np.sin(at.tower_zenith)[:, None]
        good = np.isfinite(values)
        rows.append(row[good])
        targets.append(values[good])
        parts.append(np.arange(len(values))[good] * BLOCKS // len(values))
    return np.concatenate(rows), np.concatenate(targets), np.concatenate(parts)


def _ridge(design: FloatArray, target: FloatArray, free: int) -> FloatArray:
    """Least squares with shrinkage of all columns but the first ``free`` ones (the constants)."""
    penalty = np.full(design.shape[1], SHRINK * len(design))
    penalty[:free] = 0.0
    return np.asarray(np.linalg.solve(design.T @ design + np.diag(penalty), design.T @ target))


def _left_out_rmse(residual_db: Mapping[str, FloatArray], angles: Mapping[str, LinkAngles], order: int) -> float:
    design, target, part = _system(residual_db, angles, order)
    square = 0.0
    for block in range(BLOCKS):
        out = part == block
        coefficients = _ridge(design[~out], target[~out], len(residual_db))
        square += float(((target[out] - design[out] @ coefficients) ** 2).sum())
    return float(np.sqrt(square / len(target)))

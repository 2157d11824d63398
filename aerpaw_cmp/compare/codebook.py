"""Rank by the rate of a codebook: 3GPP TS 38.214 clause 5.2.2.2.1, Type I single panel, four ports.

A modem's rank is the number of layers of the precoder, out of a finite codebook, that promises the highest rate at its
SINR. Four ports are ``(N1, N2) = (2, 1)``: two places times two polarisations, oversampled by ``O1 = 4``.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike

from ..common.units import ComplexArray, FloatArray, IntArray, power_from_db

PORTS = 4
OVERSAMPLING = 4
CROSS_POLAR_ORDER = (0, 2, 1, 3)
"""From ports that alternate in polarisation to one polarisation after the other, as the codebook has them."""


@functools.cache
def precoders(layers: int) -> ComplexArray:
    """All precoders (count, 4 ports, layers) of a rank, codebook mode 1.

    Parameters
    ----------
    layers : int
        1 to 4.

    Notes
    -----
    Tables 5.2.2.2.1-5 to -8: ``v_l = (1, exp(2 pi j l / 8))``, co-phasing ``phi_n = exp(j pi n / 2)``; ranks 2 to 4
    pair ``v_l`` with itself (rank 2 only) or with the orthogonal ``v_(l + 4)``. Each precoder has unit power.
    """
    if not 1 <= layers <= PORTS:
        raise ValueError(f"a rank of 1 to {PORTS}, found {layers}")
    beams = 2 * OVERSAMPLING
    matrices = []
    for beam in range(beams):
        v = np.array([1.0, np.exp(2j * np.pi * beam / beams)])
        for shift in {1: (0,), 2: (0, OVERSAMPLING)}.get(layers, (OVERSAMPLING,)):
            w = np.array([1.0, np.exp(2j * np.pi * (beam + shift) / beams)])
            for n in range(4 if layers == 1 else 2):
                phi = np.exp(0.5j * np.pi * n)
                plus_v, plus_w, minus_v, minus_w = (np.concatenate([u, c * u]) for c in (phi, -phi) for u in (v, w))
                columns = {
                    1: [plus_v],
                    2: [plus_v, minus_w],
                    3: [plus_v, plus_w, minus_v],
                    4: [plus_v, plus_w, minus_v, minus_w],
                }[layers]
                matrices.append(np.stack(columns, axis=1) / np.sqrt(layers * PORTS))
    return np.asarray(matrices, dtype=np.complex128)


def codebook_rates(h: ArrayLike, sinr_db: ArrayLike, *, order: tuple[int, ...] = CROSS_POLAR_ORDER) -> FloatArray:
    """Highest rate [bit/s/Hz] (n, 4) that a precoder of each rank reaches behind a linear MMSE receiver.

    Parameters
    ----------
    h : array_like, complex, (n, n_rx, 4)
        Channel matrices, any scale.
    sinr_db : array_like, (n,)
        Mean SINR per receive port with the transmit power spread over all ports [dB]; NaN gives NaN.
    order : tuple of int
        Columns of ``h`` in the order of the codebook.

    Notes
    -----
    Per layer ``1 / [(I + snr W^H H^H H W)^-1]_ll - 1`` with ``|H|^2`` scaled to ``n_rx n_tx``.
    """
    matrix = np.asarray(h, dtype=np.complex128)[..., list(order)]
    power = (np.abs(matrix) ** 2).sum(axis=(1, 2))
    alive = np.isfinite(power) & (power > 0)
    scaled = np.where(alive[:, None, None], matrix, 1.0)
    snr = power_from_db(sinr_db) * matrix.shape[1] * PORTS / np.where(alive, power, 1.0)
    gram = np.conj(np.swapaxes(scaled, 1, 2)) @ scaled * np.nan_to_num(snr)[:, None, None]
    rates = np.empty((len(matrix), PORTS))
    for layers in range(1, PORTS + 1):
        w = precoders(layers)
        seen = np.conj(np.swapaxes(w, 1, 2))[None] @ (gram[:, None] @ w[None])
        inverse = np.linalg.inv(np.eye(layers) + seen)
        sinr = 1.0 / np.real(np.diagonal(inverse, axis1=-2, axis2=-1)) - 1.0
        rates[:, layers - 1] = np.log2(1.0 + np.maximum(sinr, 0.0)).sum(axis=-1).max(axis=1)
    return np.asarray(np.where((alive & np.isfinite(snr))[:, None], rates, np.nan))


def codebook_rank(rates: FloatArray, *, penalty_bits: float = 0.0, cap_bits: float = np.inf) -> IntArray:
    """Rank (n,) of the highest rate; 0 where there is none. Ties go to fewer layers.

    Parameters
    ----------
    rates : (n, 4)
        Of :func:`codebook_rates`.
    penalty_bits : float
        What each further layer must bring.
    cap_bits : float
        Highest rate of a layer that the modulation allows, on the mean over layers.
    """
    layers = np.arange(1, PORTS + 1)
    worth = np.minimum(rates, cap_bits * layers) - penalty_bits * (layers - 1)
    alive = np.isfinite(rates).all(axis=1)
    return np.where(alive, np.argmax(np.where(np.asarray(alive)[:, None], worth, 0.0), axis=1) + 1, 0).astype(np.int64)

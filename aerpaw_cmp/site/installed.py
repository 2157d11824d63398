"""Effect of mast and airframe on the pattern of an antenna once it is mounted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..common.units import ComplexArray, FloatArray, amplitude_from_db


def harmonics(azimuth_rad: ArrayLike, order: int) -> FloatArray:
    """``cos a, sin a, cos 2a, sin 2a, ...`` up to ``order``: (..., 2 order).

    Examples
    --------
    >>> harmonics([0.0], 2).tolist()
    [[1.0, 0.0, 1.0, 0.0]]
    """
    angle = np.asarray(azimuth_rad, dtype=np.float64)[..., None] * np.arange(1, order + 1)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).reshape(*angle.shape[:-1], 2 * order)


class _Pattern(Protocol):
    """Any pattern of this package."""

    @property
    def name(self) -> str: ...

    def field(self, theta_rad: FloatArray, phi_rad: FloatArray) -> tuple[ComplexArray, ComplexArray]: ...


@dataclass(frozen=True, slots=True)
class InstalledPattern:
    """A pattern with a gain that varies with azimuth, as scatter from mast or airframe makes it.

    Parameters
    ----------
    base : Pattern
        Of the antenna alone.
    harmonics_db : tuple of float
        Added gain [dB] per term of :func:`harmonics` of the azimuth in the device frame; an even number.
    """

    base: _Pattern
    harmonics_db: tuple[float, ...]

    @property
    def name(self) -> str:
        """The base pattern's, with a mark."""
        return f"{self.base.name}, installed"

    def field(self, theta_rad: FloatArray, phi_rad: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """The base field, scaled; the added gain fades towards the poles, where azimuth means nothing."""
        e_theta, e_phi = self.base.field(theta_rad, phi_rad)
        terms = harmonics(phi_rad, len(self.harmonics_db) // 2)
        gain_db = np.sin(np.asarray(theta_rad, dtype=np.float64)) * (terms @ np.asarray(self.harmonics_db))
        factor = amplitude_from_db(gain_db)
        return e_theta * factor, e_phi * factor

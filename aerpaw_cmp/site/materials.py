"""Electrical properties of building materials and ground, ITU-R P.2040-3 table 3 (minimal)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import UsageError
from ..units import VACUUM_PERMITTIVITY_F_PER_M


@dataclass(frozen=True, slots=True)
class Material:
    """``eps' = a f^b``, ``sigma = c f^d`` with f in GHz; ``thickness_m`` None is a half-space."""

    name: str
    a: float
    b: float
    c: float
    d: float
    thickness_m: float | None

    def relative_permittivity(self, frequency_hz: float) -> complex:
        """Complex relative permittivity, negative imaginary part (time factor e^{+j omega t})."""
        f = frequency_hz / 1e9
        sigma = self.c * f**self.d
        return complex(self.a * f**self.b, -sigma / (2 * np.pi * frequency_hz * VACUUM_PERMITTIVITY_F_PER_M))


_TABLE = {
    "concrete": Material("concrete", 5.24, 0.0, 0.0462, 0.7822, 0.3),
    "wood": Material("wood", 1.99, 0.0, 0.0047, 1.0718, 0.3),
    "medium_dry_ground": Material("medium_dry_ground", 15.0, -0.1, 0.035, 1.63, None),
    "metal": Material("metal", 1.0, 0.0, 1e7, 0.0, None),
}


def material(name: str) -> Material:
    """The material of that name (an ``itu_`` prefix is allowed)."""
    try:
        return _TABLE[name.removeprefix("itu_")]
    except KeyError:
        raise UsageError(f"unknown material {name!r}", expected=", ".join(_TABLE)) from None

"""An antenna pattern for other programs: Sionna RT's custom pattern, MSI Planet's cuts, a table over the sphere."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...common.errors import UsageError
from .antennas import MeasuredPattern, check_power
from .sphere_pattern import SpherePattern, planning_cuts, sphere_csv, sphere_grid

_STEP_DEG = 3.0

_SIONNA = '''"""Antenna pattern {name!r} for Sionna RT, written by aerpaw-cmp.

import {module}, then PlanarArray(..., pattern={name!r}, polarization="V").
{notes}
"""

import base64

import drjit as dr
import mitsuba as mi
import numpy as np
from sionna.rt import AntennaPattern, register_antenna_pattern
from sionna.rt.antenna_pattern import polarization_registry

# E_theta and E_phi, real and imaginary parts, over zenith angle (0 to 180 deg) and azimuth (0 to 360 deg)
TABLE = np.frombuffer(base64.b64decode("{table}"), "<f4").reshape({shape})


def _at(theta, phi):
    """Fields between the directions of the table, linear."""
    rows, columns = TABLE.shape[:2]
    row = dr.clip(theta / dr.pi, 0.0, 1.0) * (rows - 1)
    turns = phi / (2.0 * dr.pi)
    column = (turns - dr.floor(turns)) * (columns - 1)
    i, j = dr.minimum(mi.UInt(row), rows - 2), dr.minimum(mi.UInt(column), columns - 2)
    u, v = row - mi.Float(i), column - mi.Float(j)
    flat, parts = [mi.Float(np.ascontiguousarray(TABLE[..., k]).ravel()) for k in range(4)], []
    for values in flat:
        corner = [dr.gather(mi.Float, values, (i + a) * columns + j + b) for a in (0, 1) for b in (0, 1)]
        low, high = (corner[k] * (1.0 - v) + corner[k + 1] * v for k in (0, 2))
        parts.append(low * (1.0 - u) + high * u)
    return mi.Complex2f(parts[0], parts[1]), mi.Complex2f(parts[2], parts[3])


class Measured(AntennaPattern):
    def __init__(self, slants):
        def turned(slant):
            def pattern(theta, phi):
                e_theta, e_phi = _at(theta, phi)
                c, s = float(np.cos(slant)), float(np.sin(slant))
                return c * e_theta - s * e_phi, s * e_theta + c * e_phi

            return pattern

        self.patterns = [turned(slant) for slant in slants]


def _factory(*, polarization="V", polarization_model=None):
    return Measured(polarization_registry.get(polarization))


register_antenna_pattern("{name}", _factory)
'''


def exported(pattern: MeasuredPattern, name: str, target: Path, carrier_hz: float | None = None) -> str:
    """Text of a pattern in the format that the ending of a file says: ``.py`` (Sionna RT), ``.msi``, ``.csv``.

    What the pattern was learned from goes along as comments.

    Parameters
    ----------
    pattern : MeasuredPattern
    name : str
    target : Path
    carrier_hz : float, optional
        For ``.msi``, where the pattern has no frequency of its own.

    Returns
    -------
    str

    Raises
    ------
    UsageError
        Another ending; ``.msi`` without a frequency.
    """
    notes = getattr(pattern, "notes", "") or f"trained_on: {' '.join(pattern.trained_on)}" * bool(pattern.trained_on)
    lines = tuple(line.lstrip("# ") for line in notes.splitlines())
    if target.suffix == ".msi":
        frequency = carrier_hz or pattern.frequency_hz
        if not frequency:
            raise UsageError("the pattern has no frequency", expected="--carrier HZ", path=target)
        return planning_cuts(pattern, name, frequency, lines)
    theta, phi, _ = sphere_grid(_STEP_DEG)
    if target.suffix == ".csv":
        check_power(pattern, target)  # what the reader of spheres asks: two cuts may make more power than goes in
        at = np.meshgrid(np.radians(theta), np.radians(phi), indexing="ij")
        sd = pattern.gain_sd_db(*at) if isinstance(pattern, SpherePattern) else np.zeros(at[0].shape)
        return sphere_csv(pattern.gain_dbi(*at), sd, lines)
    if target.suffix == ".py":
        return _sionna_module(pattern, name, target, lines)
    raise UsageError(f"the ending {target.suffix!r}", expected=".py (Sionna RT), .msi or .csv", path=target)


def _sionna_module(pattern: MeasuredPattern, name: str, target: Path, notes: tuple[str, ...]) -> str:
    import base64

    theta, phi, _ = sphere_grid(_STEP_DEG)
    at = np.meshgrid(np.radians(theta), np.radians(np.append(phi, 360.0)), indexing="ij")
    table = np.stack([part for field in pattern.field(*at) for part in (field.real, field.imag)], axis=-1)
    return _SIONNA.format(
        name=re.sub(r"\W", "_", name),
        module=re.sub(r"\W", "_", target.stem),
        notes="\n".join(re.sub(r'["\\]', "'", note) for note in notes),
        table=base64.b64encode(table.astype("<f4").tobytes()).decode("ascii"),
        shape=table.shape,
    )

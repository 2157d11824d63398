"""Electrical properties of building materials and ground.

Model and constants are from Recommendation ITU-R P.2040 (P.2040-4, table 3). With f in GHz, ``eps' = a f^b`` and the
conductivity is ``sigma = c f^d`` [S/m]. The complex relative permittivity is ``eps' - j sigma / (2 pi f eps0)`` for the
time factor ``exp(+j omega t)``.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass

from ..common.errors import UsageError
from ..common.units import VACUUM_PERMITTIVITY_F_PER_M

# Lowest and highest frequency [GHz], a, b, c, d.
Band = tuple[float, float, float, float, float, float]

# Usual thickness of a wall or roof [m], None for a half-space (without an echo of a second face). P.2040-4 table 3,
# without its bands above 100 GHz.
_TABLE: dict[str, tuple[float | None, Band]] = {
    "vacuum": (None, (0.001, 100.0, 1.0, 0.0, 0.0, 0.0)),
    "concrete": (0.3, (1.0, 100.0, 5.24, 0.0, 0.0462, 0.7822)),
    "brick": (0.2, (1.0, 40.0, 3.91, 0.0, 0.0238, 0.16)),
    "plasterboard": (0.025, (1.0, 100.0, 2.73, 0.0, 0.0085, 0.9395)),
    "wood": (0.15, (0.001, 100.0, 1.99, 0.0, 0.0047, 1.0718)),
    "glass": (0.006, (0.1, 100.0, 6.31, 0.0, 0.0036, 1.3394)),
    "ceiling_board": (0.02, (1.0, 100.0, 1.48, 0.0, 0.0011, 1.075)),
    "chipboard": (0.02, (1.0, 100.0, 2.58, 0.0, 0.0217, 0.78)),
    "plywood": (0.02, (1.0, 40.0, 2.71, 0.0, 0.33, 0.0)),
    "marble": (0.03, (1.0, 60.0, 7.074, 0.0, 0.0055, 0.9262)),
    "floorboard": (0.02, (50.0, 100.0, 3.66, 0.0, 0.0044, 1.3515)),
    "asphalt_concrete": (None, (1.0, 40.0, 4.83, 0.0, 0.0108, 1.3969)),
    "metal": (0.005, (1.0, 100.0, 1.0, 0.0, 1e7, 0.0)),
    "very_dry_ground": (None, (1.0, 10.0, 3.0, 0.0, 0.00015, 2.52)),
    "medium_dry_ground": (None, (1.0, 10.0, 15.0, -0.1, 0.035, 1.63)),
    "wet_ground": (None, (1.0, 10.0, 30.0, -0.4, 0.15, 1.3)),
}


@dataclass(frozen=True, slots=True)
class Material:
    """A homogeneous material.

    Parameters
    ----------
    name : str
        Name without the prefix ``itu_``.
    band : Band
        Constants, and the frequencies for which they are valid.
    thickness_m : float or None
        Thickness of a wall of this material; None is a half-space.
    """

    name: str
    band: Band
    thickness_m: float | None = None

    def _band(self, frequency_hz: float) -> Band:
        frequency_ghz = frequency_hz / 1e9
        low, high, *_ = self.band
        if low <= frequency_ghz <= high:
            return self.band
        # suggest the properties at the nearest frequency of the table, as text that a user can paste
        edge = low if frequency_ghz < low else high
        near = stated_name(self.relative_permittivity(edge * 1e9).real, self.conductivity_s_per_m(edge * 1e9), None)
        key = "ground_material" if self.name.endswith("ground") else "material of a building"
        raise UsageError(
            f"ITU-R P.2040 gives no values for '{self.name}' ({key}) at {frequency_ghz:g} GHz",
            expected=f"{low:g}-{high:g} GHz, or in site.yaml '{key.split()[0]}: {near}' (the values of {edge:g} GHz)",
            cause="the carrier was given in MHz or GHz where hertz are expected" if frequency_hz < 1e6 else None,
        )

    def conductivity_s_per_m(self, frequency_hz: float) -> float:
        """Return the conductivity at a frequency [S/m].

        Source: ITU-R P.2040 table 3.
        """
        *_, c, d = self._band(frequency_hz)
        return float(c * (frequency_hz / 1e9) ** d)

    def relative_permittivity(self, frequency_hz: float) -> complex:
        """Return the complex relative permittivity at a frequency. The imaginary part is negative (loss).

        Source: arXiv 2502.10324 eq. 5; ITU-R P.2040 table 3.

        Raises
        ------
        UsageError
            If the frequency is outside the table.
        """
        _, _, a, b, _, _ = self._band(frequency_hz)
        loss = self.conductivity_s_per_m(frequency_hz) / (2 * math.pi * frequency_hz * VACUUM_PERMITTIVITY_F_PER_M)
        return complex(a * (frequency_hz / 1e9) ** b, -loss)


# Names for :func:`material`.
MATERIALS: tuple[str, ...] = tuple(_TABLE)

# Name of vegetation in a scene of triangles, which becomes a medium without reflections.
CROWN = "vegetation"


def material(name: str) -> Material:
    """Return a material of ITU-R P.2040 by name, or a material whose name contains its properties.

    Parameters
    ----------
    name : str
        A name such as ``"concrete"``, ``"itu_concrete"`` or ``"itu-concrete"``. A thickness [m] can be stated in
        ``"concrete with thickness=0.1"``, and a constant permittivity and conductivity [S/m] in
        ``"constant with permittivity=3.5 conductivity=0.02 thickness=0.1"``.

    Returns
    -------
    Material

    Raises
    ------
    UsageError
        For an unknown name. The message contains the most similar name.

    Examples
    --------
    >>> material("itu_concrete").relative_permittivity(3.4e9)
    (5.24-0.636...j)
    >>> material("medium_dry_ground").thickness_m is None
    True
    >>> material("concrete with thickness=0.1").thickness_m
    0.1
    >>> material("constant with permittivity=3.5 conductivity=0").relative_permittivity(28e9)
    (3.5-0j)
    """
    plain, _, numbers = name.partition(" with ")
    if numbers:
        return _stated(plain, numbers, name)
    # Sionna, Blender and users write the same name in three ways
    key = name.strip().lower().replace("-", "_").replace(" ", "_").removeprefix("itu_")
    if key not in _TABLE:
        near = difflib.get_close_matches(key, _TABLE, n=1, cutoff=0.4)
        raise UsageError(
            f"unknown material '{name}'",
            expected=f"one of {', '.join(MATERIALS)}, or '{stated_name(3.5, 0.02, None)}'",
            cause=f"did you mean '{near[0]}'?" if near else None,
        )
    thickness, band = _TABLE[key]
    return Material(key, band, thickness)


def _stated(plain: str, numbers: str, name: str) -> Material:
    """Return a material whose name contains its numbers."""
    # for a material of the table, permittivity and conductivity follow from the carrier
    allowed = {"thickness"} if plain != CONSTANT else {"thickness", "permittivity", "conductivity"}
    try:
        values = {key: float(value) for key, value in (word.split("=") for word in numbers.split())}
    except ValueError:
        values = {"?": math.nan}
    valid = set(values) <= allowed and all(math.isfinite(value) and value >= 0.0 for value in values.values())
    if not valid or (plain == CONSTANT and not values.get("permittivity", 0.0) >= 1.0):
        raise UsageError(
            f"unknown material '{name}'",
            expected="'concrete with thickness=0.1' or 'constant with permittivity=3.5 conductivity=0.02'",
        )
    thickness = values.get("thickness")
    if plain != CONSTANT:
        base = material(plain)
        return Material(f"{base.name} with thickness={thickness:.9g}", base.band, thickness or 1e-9)
    band = (0.0, math.inf, values["permittivity"], 0.0, values.get("conductivity", 0.0), 0.0)
    return Material(stated_name(band[2], band[4], thickness), band, None if thickness is None else thickness or 1e-9)


# Start of the name of a material that is not in ITU-R P.2040. Its properties follow.
CONSTANT = "constant"


def stated_name(permittivity: float, conductivity_s_per_m: float, thickness_m: float | None) -> str:
    """Return the name of a material of constant permittivity and conductivity."""
    end = "" if thickness_m is None else f" thickness={thickness_m:.9g}"
    return f"{CONSTANT} with permittivity={permittivity:.9g} conductivity={conductivity_s_per_m:.9g}{end}"

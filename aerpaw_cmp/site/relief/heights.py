"""Heights of different kinds are different things, and are never added up by accident.

==================  ============================================================
reference           measured from
==================  ============================================================
``above_takeoff``   where the aircraft armed (what ``vehicleOut`` logs)
``above_ground``    the ground right below
``orthometric``     the geoid, "mean sea level" (NAVD 88, EGM96)
``ellipsoidal``     the WGS84 ellipsoid (raw GNSS, "HAE")
==================  ============================================================

At Lake Wheeler orthometric and ellipsoidal heights differ by about 33 m: larger than any tower.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from ...common.errors import UsageError


class HeightReference(str, Enum):
    """Reference that a height is measured from."""

    ABOVE_TAKEOFF = "above_takeoff"
    ABOVE_GROUND = "above_ground"
    ORTHOMETRIC = "orthometric"
    ELLIPSOIDAL = "ellipsoidal"


@dataclass(frozen=True, slots=True)
class Height:
    """A height with its reference.

    Parameters
    ----------
    value_m : float
        Metres.
    reference : HeightReference
        What it is measured from.

    Examples
    --------
    >>> Height(112.0, HeightReference.ELLIPSOIDAL).minus(Height(100.0, HeightReference.ELLIPSOIDAL), "tower LW1")
    12.0
    """

    value_m: float
    reference: HeightReference

    def minus(self, other: Height, what: str) -> float:
        """Difference [m] of two heights of one reference; ``what`` names the place in the message.

        Raises
        ------
        UsageError
            The references differ.
        """
        if self.reference is not other.reference:
            pair = {self.reference, other.reference}
            both_datums = pair == {HeightReference.ORTHOMETRIC, HeightReference.ELLIPSOIDAL}
            raise UsageError(
                f"{what}: {self.reference.value} height {self.value_m:g} m cannot be compared with "
                f"{other.reference.value} height {other.value_m:g} m",
                expected="heights of one reference",
                cause="the geoid lies tens of metres from the ellipsoid; convert one of them first"
                if both_datums
                else None,
            )
        return self.value_m - other.value_m


@dataclass(frozen=True, slots=True)
class VerticalDatum:
    """Vertical datum of the site: the level where up is 0.

    Parameters
    ----------
    origin_ground : Height or None
        Orthometric or ellipsoidal height of the ground at the origin, where up is 0; None when it is not known.
    takeoff_ground_m : float
        Up of the take-off point [m].
    """

    origin_ground: Height | None = None
    takeoff_ground_m: float = 0.0

    def up_m(self, height: Height, what: str, *, ground_m: float = 0.0) -> float:
        """Up [m] of a height of any reference; ``ground_m`` is the up of the ground below it.

        Raises
        ------
        UsageError
            Orthometric or ellipsoidal height, but the origin's ground is not given in the same reference.
        """
        if height.reference is HeightReference.ABOVE_GROUND:
            return ground_m + height.value_m
        if height.reference is HeightReference.ABOVE_TAKEOFF:
            return self.takeoff_ground_m + height.value_m
        if self.origin_ground is None:
            raise UsageError(
                f"{what}: {height.reference.value} height {height.value_m:g} m, but the site does not say how high its "
                "origin is",
                expected=f"origin: ground: {{height_m: ..., reference: {height.reference.value}}}",
            )
        return height.minus(self.origin_ground, what)

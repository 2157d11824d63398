"""Content of the page of a calibration: numbers in, nothing computed here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ...common.units import FloatArray
from .made import Made


@dataclass(frozen=True, slots=True, kw_only=True)
class AntennaMap:
    """One antenna over the sphere.

    Parameters
    ----------
    name : str
        Such as ``LW1.USRP1 tower``.
    theta_deg, azimuth_deg : (t,), (p,)
    gain_dbi, sd_db : (t, p)
    level_db : float
        What was taken from the learned gain for a mean of 0 dBi.
    flown : (m, 3)
        Unit vectors of the directions that flights looked in.
    """

    name: str
    theta_deg: FloatArray
    azimuth_deg: FloatArray
    gain_dbi: FloatArray
    sd_db: FloatArray
    level_db: float
    flown: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationData(Made):
    """The record of a calibration; ``scores`` and ``controls`` hold rows with flight, tower, channel, RMSE."""

    name: str
    flights: Sequence[str]
    trained_on: Sequence[str]
    marks: Sequence[str]
    words: Sequence[str]
    warnings: Sequence[str]
    scores: Mapping[str, Sequence[Mapping[str, Any]]]
    controls: Mapping[str, Sequence[Mapping[str, Any]]]
    mounts: Mapping[str, Mapping[str, Any]]
    strengths: Mapping[str, Any]
    ground: Mapping[str, Any] | None
    curve: Sequence[Mapping[str, Any]]
    """Error by number of flights that were learned from, fewest first; none with fewer than three flights."""
    one_more_rmse_db: float
    """To expect with one flight more, extrapolated [dB]; NaN without a curve."""
    antennas: Sequence[AntennaMap]
    rank: Mapping[str, Any] | None = None
    settings_text: str = ""

"""The link budget of a map: transmit power, noise floor, and the level from which a position counts as covered."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..common.errors import UsageError
from ..common.units import THERMAL_NOISE_DBM_HZ, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkBudget:
    """The receiver and the threshold of a coverage map.

    Without a threshold a position is covered if any path arrives, which is the paper's definition.

    Parameters
    ----------
    tx_power_dbm : float
        Power of a tower; 40 dBm are the paper's 10 W.
    bandwidth_mhz : float, optional
        Receiver bandwidth B. Without it no SNR is known.
    noise_figure_db : float
        Noise figure F of the receiver.
    threshold_dbm, threshold_snr_db : float, optional
        Lowest level, or lowest SNR, at which a position is covered; one of the two.

    Raises
    ------
    UsageError
        If two thresholds are given, an SNR has no bandwidth, or the threshold is below the noise floor.

    Notes
    -----
    Noise floor [dBm] = -174 + 10 log10(B / Hz) + F, at a temperature of 290 K.

    Examples
    --------
    >>> budget = LinkBudget(bandwidth_mhz=20, noise_figure_db=7, threshold_snr_db=0)
    >>> round(budget.level_dbm, 1)
    -94.0
    """

    tx_power_dbm: float = 40.0
    bandwidth_mhz: float | None = None
    noise_figure_db: float = 0.0
    threshold_dbm: float | None = None
    threshold_snr_db: float | None = None

    def __post_init__(self) -> None:
        self._check_range("transmit power", self.tx_power_dbm, -60.0, 100.0, "dBm", "watts instead of dBm")
        self._check_range("noise figure", self.noise_figure_db, 0.0, 60.0, "dB", "a noise factor instead of dB")
        if self.bandwidth_mhz is not None:
            self._check_range("bandwidth", self.bandwidth_mhz, 1e-6, 1e5, "MHz", "Hz instead of MHz")
        elif self.noise_figure_db:
            raise UsageError("a noise figure without a bandwidth", expected="bandwidth_mhz (--bandwidth-mhz), too")
        if self.threshold_dbm is not None and self.threshold_snr_db is not None:
            raise UsageError("threshold_dbm and threshold_snr_db", expected="one of the two")
        if self.threshold_snr_db is not None:
            self._check_range("SNR threshold", self.threshold_snr_db, -60.0, 100.0, "dB", "a level instead of an SNR")
            if self.bandwidth_mhz is None:
                raise UsageError(
                    "threshold_snr_db without a bandwidth",
                    expected="bandwidth_mhz (--bandwidth-mhz), from which the noise floor follows",
                )
        if self.threshold_dbm is not None:
            self._check_range("threshold", self.threshold_dbm, -200.0, 60.0, "dBm", "another unit than dBm")
            if self.noise_dbm is not None and self.threshold_dbm < self.noise_dbm:
                raise UsageError(
                    f"a threshold of {self.threshold_dbm:g} dBm below the noise floor of {self.noise_dbm:.1f} dBm",
                    expected="a level above the noise, or threshold_snr_db (--threshold-snr-db) with a negative SNR",
                    cause="a threshold that holds for a narrower band",
                )

    @staticmethod
    def _check_range(what: str, value: float, low: float, high: float, unit: str, cause: str) -> None:
        if not low <= value <= high:
            raise UsageError(f"a {what} of {value:g} {unit}", expected=f"{low:g} to {high:g} {unit}", cause=cause)

    @property
    def noise_dbm(self) -> float | None:
        """Noise floor of the receiver [dBm]; None without a bandwidth."""
        if self.bandwidth_mhz is None:
            return None
        return THERMAL_NOISE_DBM_HZ + 10.0 * math.log10(self.bandwidth_mhz * 1e6) + self.noise_figure_db

    @property
    def level_dbm(self) -> float | None:
        """Lowest covered level [dBm]; None if every path counts."""
        if self.threshold_snr_db is not None and self.noise_dbm is not None:
            return self.noise_dbm + self.threshold_snr_db
        return self.threshold_dbm

    def covered(self, level_dbm: FloatArray) -> FloatArray:
        """Return 1 for covered positions and 0 for others, in the shape of the levels [dBm]; NaN is not covered."""
        lowest = -math.inf if self.level_dbm is None else self.level_dbm
        return (level_dbm >= lowest).astype(float)

    def sentence(self) -> str:
        """Return power, noise floor and threshold in one sentence."""
        noise = "noise floor not known (no bandwidth)"
        if self.noise_dbm is not None:
            noise = (
                f"noise floor {self.noise_dbm:.1f} dBm ({self.bandwidth_mhz:g} MHz, "
                f"noise figure {self.noise_figure_db:g} dB)"
            )
        threshold = "covered where any path arrives"
        if self.level_dbm is not None:
            threshold = f"covered from {self.level_dbm:.1f} dBm"
            if self.threshold_snr_db is not None:
                threshold += f" (SNR {self.threshold_snr_db:g} dB)"
        return f"Transmit power {self.tx_power_dbm:g} dBm; {noise}; {threshold}."


# 10 W, and every path counts.
PAPER_BUDGET = LinkBudget()

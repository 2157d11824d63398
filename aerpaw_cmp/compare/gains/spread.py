"""Spread of a level about its prediction by learned antennas: gain, the flight's own nuisance, noise, fading."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...common.units import FloatArray
from ..judge.entries import crps_normal
from .direction_gain import LinkSamples

# Nominal shares of samples within an interval.
SHARES = (0.5, 0.9, 0.95)

# Of the band that a report draws.
BAND = 0.9


def student_factor(flights: int) -> float:
    """Standard deviation of the normal distribution with the :data:`BAND` of Student's t with n + 1 degrees of freedom.

    Notes
    -----
    So a new flight's offset lies about the mean of n: the spread between flights is itself known from n - 1 differences
    and a guess that counts as two (Gelman et al., Bayesian Data Analysis, 3.3); two degrees have no variance.
    """
    from scipy.special import ndtri, stdtrit

    return float(stdtrit(flights + 1.0, 0.5 + 0.5 * BAND) / ndtri(0.5 + 0.5 * BAND))


# Beyond it the expansion of :meth:`Spread.half_width_db` is no longer one of a bell.
_MOST_KURTOSIS = 2.0


# Squared skewness of fading in dB for each unit of excess kurtosis: 1.30 / 2.40 of Rayleigh's.
_FADE_SKEWNESS2 = 0.54


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """Spread of a predicted level besides the gain's own standard deviation.

    Parameters
    ----------
    own_sd_db : float
        Of the nuisance of a flight and channel (shadowing that no antenna explains).
    noise_sd_db : float
        Of means over ``bin_s``.
    fading_sd_db, fading_kurtosis : float
        Standard deviation and excess kurtosis of samples about their mean over ``bin_s``.
    bin_s : float
        Time over which the antennas were learned from means [s].
    """

    own_sd_db: float
    noise_sd_db: float
    fading_sd_db: float
    fading_kurtosis: float
    bin_s: float

    def total_db(self, gain_sd_db: FloatArray) -> FloatArray:
        """Standard deviation (n,) of a sample about its prediction, from that of the gain (n,) [dB]."""
        variance = self.own_sd_db**2 + self.noise_sd_db**2 + self.fading_sd_db**2
        return np.asarray(np.sqrt(gain_sd_db**2 + variance))

    def half_width_db(self, gain_sd_db: FloatArray, share: float) -> FloatArray:
        """Half of the interval (n,) that holds a share of the samples [dB].

        Notes
        -----
        The quantile of ``|x|`` for a sum of a normal part and of fading, by the even terms of Edgeworth's series in the
        excess kurtosis k and the skewness s of the sum: q = z + He3(z) k / 24 + He5(z) s^2 / 72 (Cornish and Fisher,
        Rev. Inst. Int. Stat. 5, 1938). Without the second term half of the samples are said to lie where 40 % do.
        """
        from scipy.special import ndtri

        total = self.total_db(gain_sd_db)
        z = float(ndtri(0.5 + 0.5 * share))
        with np.errstate(invalid="ignore", divide="ignore"):
            k = np.clip(self.fading_kurtosis * (self.fading_sd_db / total) ** 4, -_MOST_KURTOSIS, _MOST_KURTOSIS)
            skew2 = _FADE_SKEWNESS2 * np.maximum(k, 0.0) * (self.fading_sd_db / total) ** 2
        third, fifth = z**3 - 3.0 * z, z**5 - 10.0 * z**3 + 15.0 * z
        return np.asarray(total * (z + third * k / 24.0 + fifth * skew2 / 72.0))


# Of learned files that state the standard deviation of the gain alone.
NO_SPREAD = Spread(own_sd_db=0.0, noise_sd_db=0.0, fading_sd_db=0.0, fading_kurtosis=0.0, bin_s=4.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LostLock:
    """Error of a prediction whose receiver may have lost its lock: normal in lock, and about another level without.

    Parameters
    ----------
    probability : (n,)
        Of lock.
    locked_db : (n,)
        Mean error in lock.
    lost_db : (n,)
        Mean error without.
    locked_sd_db, lost_sd_db : float
    """

    probability: FloatArray
    locked_db: FloatArray
    lost_db: FloatArray
    locked_sd_db: float
    lost_sd_db: float

    @property
    def parts(self) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        """Share, mean error and standard deviation (each (n,)) in lock, then without."""
        one, share = np.ones(len(self.probability)), self.probability
        lost = 1.0 - share, self.lost_db, self.lost_sd_db * one
        return [(share, self.locked_db, self.locked_sd_db * one), lost]

    def sd_db(self, about_db: FloatArray) -> FloatArray:
        """Root mean square (n,) of the error about a prediction that is this much higher (n,) [dB]."""
        return np.asarray(np.sqrt(sum(share * ((mean - about_db) ** 2 + sd**2) for share, mean, sd in self.parts)))

    def quantile_db(self, share: float) -> FloatArray:
        """Error (n,) below which a share of the samples lies, to a hundredth of a dB."""
        from scipy.special import ndtr

        reach = 6.0 * max(self.locked_sd_db, self.lost_sd_db)
        low = np.minimum(self.locked_db, self.lost_db) - reach
        high = np.maximum(self.locked_db, self.lost_db) + reach
        # from some hundred decibels to two thousandths
        for _ in range(16):  # no closed form: each step halves what is left of some 130 dB
            middle = 0.5 * (low + high)
            below = sum(p * ndtr((middle - mean) / sd) for p, mean, sd in self.parts)
            low, high = np.where(below < share, middle, low), np.where(below < share, high, middle)
        return np.asarray(0.5 * (low + high))

    def log_score(self, error_db: FloatArray) -> float:
        """Mean of minus the logarithm of the density at errors (n,) [nat]."""
        density = sum(p / sd * np.exp(-0.5 * ((error_db - mean) / sd) ** 2) for p, mean, sd in self.parts)
        return float(-np.log(density / np.sqrt(2.0 * np.pi)).mean())


@dataclass(frozen=True, slots=True, kw_only=True)
class StatedSpread:
    """Error bars of one series: standard deviation of the gain (n,) [dB], NaN without a pose, and what is beside it.

    ``lock``: in place of the spread, of a receiver that loses its lock.
    """

    gain_sd_db: FloatArray
    spread: Spread
    lock: LostLock | None = None

    @property
    def total_db(self) -> FloatArray:
        """Standard deviation (n,) of a sample about its prediction [dB]."""
        return self.spread.total_db(self.gain_sd_db)

    def band_db(self, share: float) -> tuple[FloatArray, FloatArray]:
        """Ends (n,) of the interval about the prediction that holds a share of the samples [dB]."""
        if self.lock is None:
            half = self.spread.half_width_db(self.gain_sd_db, share)
            return -half, half
        return self.lock.quantile_db(0.5 - 0.5 * share), self.lock.quantile_db(0.5 + 0.5 * share)

    def crps_db(self, error_db: FloatArray) -> float:
        """Mean continuous ranked probability score of errors (n,) [dB]; NaN does not count.

        Notes
        -----
        Of a mixture of normal distributions in closed form (Grimit, Gneiting, Berrocal and Johnson 2006,
        doi:10.1256/qj.05.235).
        """
        one = np.ones(len(error_db))
        parts = [(one, 0.0 * one, self.total_db)] if self.lock is None else self.lock.parts

        def distance(mean: FloatArray, sd: FloatArray) -> FloatArray:
            return np.asarray(crps_normal(mean, sd) + sd / np.sqrt(np.pi))

        to_error = np.sum([p * distance(error_db - mean, sd) for p, mean, sd in parts], axis=0)
        apart = np.sum([
            p * q * distance(mean - other, np.hypot(sd, other_sd))
            for p, mean, sd in parts
            for q, other, other_sd in parts
        ], axis=0)  # fmt: skip
        score = to_error - 0.5 * apart
        return float(np.nanmean(score)) if np.isfinite(score).any() else math.nan

    def columns(self, level_dbm: FloatArray) -> dict[str, FloatArray]:
        """Parts and 90 % interval about a level (n,), by the names of rss.csv."""
        known = np.where(np.isfinite(self.gain_sd_db), 1.0, np.nan)
        low, high = self.band_db(BAND)
        return {
            "simulated_sd_db": self.total_db,
            "gain_sd_db": self.gain_sd_db,
            "own_sd_db": known * self.spread.own_sd_db,
            "noise_sd_db": known * self.spread.noise_sd_db,
            "fading_sd_db": known * self.spread.fading_sd_db,
            "simulated_low_dbm": level_dbm + low,
            "simulated_high_dbm": level_dbm + high,
        }


def inside_shares(error_db: FloatArray, stated: StatedSpread) -> dict[str, float]:
    """Share of errors (n,) inside the interval of each nominal share: ``inside_50`` and so on; NaN does not count."""
    good = np.isfinite(error_db) & np.isfinite(stated.gain_sd_db)
    out = {}
    for share in SHARES:
        low, high = stated.band_db(share)
        inside = (low < error_db) & (error_db < high)
        out[f"inside_{100 * share:.0f}"] = float(inside[good].mean()) if good.any() else math.nan
    return out


def fading_of(series: Sequence[LinkSamples], bin_s: float) -> tuple[float, float]:
    """Standard deviation [dB] and excess kurtosis of samples about their means over bins; zeros where no bin has two.

    Examples
    --------
    >>> fading_of([], 4.0)
    (0.0, 0.0)
    """
    squares, fourth, count = 0.0, 0.0, 0
    for samples in series:
        finite = np.isfinite(samples.residual_db)
        if not finite.any():
            continue
        level, time = samples.residual_db[finite], samples.time_s[finite]
        _, member = np.unique(np.floor((time - time[0]) / bin_s).astype(np.int64), return_inverse=True)
        size = np.bincount(member)
        deviation = level - (np.bincount(member, weights=level) / size)[member]
        several = size[member] > 1
        # a deviation from the mean of n samples is too small by (n - 1) / n
        deviation = deviation[several] * np.sqrt(size[member] / np.maximum(size[member] - 1.0, 1.0))[several]
        squares, fourth = squares + float((deviation**2).sum()), fourth + float((deviation**4).sum())
        count += len(deviation)
    if not count or not squares:
        return 0.0, 0.0
    variance = squares / count
    return math.sqrt(variance), fourth / count / variance**2 - 3.0

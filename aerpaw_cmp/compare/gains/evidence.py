"""Evidence, from the levels of a flight, that antennas learned on other flights are its own.

The log likelihood of the levels with the learned gain is compared with that of a gain of the flight's own under the
prior of a calibration, and with that of the learned gain of the UAV rotated by 90, 180 and 270 deg. Offset, nuisance,
noise and all gains that are not compared are the same in each. No name takes part: neither reader, file nor channel.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from ...common.gaussian import Factor
from ...common.units import FloatArray
from .direction_gain import (
    ANTENNA_TERMS,
    GainModel,
    LinkSamples,
    Term,
    gain_covariance,
    own_covariance,
    term_kernel,
)

BODY, MAST, PAIR = ANTENNA_TERMS

# Log odds that a learned gain must have over an own gain, and an airframe alone over each rotated copy of it. Field
# flights: 3 accepts the airframe of dataset 12 on LTE and AADM (6.8 to 8.3) and refuses NR everywhere (-11.5 to -1.2).
LEAST_ODDS = 3.0

_TURNS_DEG = (90.0, 180.0, 270.0)

# Means that a flight is judged by: of more, over longer times.
_MOST_ROWS, _BIN_S = 700, 4.0

# Standard deviations of nuisance and noise that are tried [dB]; the likeliest of each series is taken.
_SCALES_DB = (0.7, 1.2, 2.0, 3.5, 6.0)

# Part of the variance of the gain towards both ends at once that its table leaves.
_PAIR_LEFT = 0.5

# Mean (n,) [dB] and covariance (n, n) [dB^2] of a learned gain along samples.
Moments = Callable[[LinkSamples], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """Log odds [nat] of a learned gain against an own gain of the flight, and against its likeliest rotated copy."""

    over_own: float
    over_turned: float

    @property
    def fits(self) -> bool:
        """True if both log odds suffice for an airframe without its tower's antenna."""
        return min(self.over_own, self.over_turned) >= LEAST_ODDS

    def with_prior(self, odds: float) -> Evidence:
        """Return the evidence with log odds [nat] that were there before the levels."""
        return Evidence(over_own=self.over_own + odds, over_turned=self.over_turned + odds)


@dataclass(frozen=True, kw_only=True)
class KnownProcess:
    """A learned gain over direction: its table, and the covariance at directions that determine it.

    Parameters
    ----------
    gain_db, sd_db : callable
        Mean and standard deviation (n,) [dB] towards unit vectors (n, 3).
    directions : (m, 3)
    covariance_db2 : (m, m)
    """

    gain_db: Callable[[FloatArray], FloatArray]
    sd_db: Callable[[FloatArray], FloatArray]
    directions: FloatArray
    covariance_db2: FloatArray

    @cached_property
    def _factor(self) -> Factor:
        prior = term_kernel(BODY, self.directions, self.directions)
        # the directions have a tenth of a degree: two may be the same
        prior[np.diag_indices(len(prior))] += 1e-3 * BODY.sd_db**2
        return Factor.of(prior)

    def moments(self, at: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean (n,) [dB] and covariance (n, n) [dB^2] towards unit vectors (n, 3).

        Notes
        -----
        With ``A = K(at, G) K(G, G)^-1`` over the directions G of covariance S, the process is ``A g`` and an
        independent rest: ``A S A'`` and ``K - A K(G, at)`` of the prior, scaled so that the diagonal is the variance of
        the table.
        """
        across = term_kernel(BODY, at, self.directions)
        weights = self._factor.solve(across.T).T
        known = weights @ self.covariance_db2 @ weights.T
        rest = term_kernel(BODY, at, at) - weights @ across.T
        left = (self.sd_db(at) ** 2 - np.diag(known)) / np.maximum(np.diag(rest), 1e-6)
        scale = np.sqrt(np.clip(left, 0.0, 1.0))
        return self.gain_db(at), known + scale[:, None] * rest * scale


def table_moments(term: Term, sd_db: FloatArray, at: FloatArray) -> FloatArray:
    """Return the covariance (n, n) of a gain of which only the table is known: the prior's correlation with its SD."""
    scale = np.minimum(sd_db / term.sd_db, 1.0)
    return np.asarray(scale[:, None] * term_kernel(term, at, at) * scale)


class FlightEvidence:
    """Levels of one flight, by which learned gains are judged.

    Parameters
    ----------
    series : sequence of LinkSamples
        Of all channels.
    """

    def __init__(self, series: Sequence[LinkSamples]) -> None:
        width = _BIN_S
        self.rows = [s.binned(width) for s in series]
        if (count := sum(map(len, self.rows))) > _MOST_ROWS:
            width *= math.ceil(count / _MOST_ROWS)
            self.rows = [s.binned(width) for s in series]
        self._noise = [_noise_covariance(rows) for rows in self.rows]

    def of_link(self, number: int, known: Moments) -> Evidence:
        """Return the evidence for the learned antennas of both ends of one series, by its number.

        ``known`` returns the moments of the gain of both ends without what its table of pairs leaves.
        """
        rows, noise = self.rows[number], self._noise[number]
        if not len(rows):
            return Evidence(over_own=-math.inf, over_turned=-math.inf)
        left = noise + _PAIR_LEFT * gain_covariance([PAIR], [rows], [rows])
        own = _log_likelihood(noise + gain_covariance(ANTENNA_TERMS, [rows], [rows]), _centred(rows))

        def of(turn_deg: float) -> float:
            mean, covariance = known(_rotated(rows, turn_deg))
            return _log_likelihood(left + covariance, _centred(rows) - mean)

        return _judged(own, of)

    def of_airframe(self, known: KnownProcess) -> Evidence:
        """Return the evidence for a learned airframe in all series together, each tower with a gain of its own."""
        rows = [some for some in self.rows if len(some)]
        if not rows:
            return Evidence(over_own=-math.inf, over_turned=-math.inf)
        levels = np.concatenate([_centred(some) for some in rows])

        def of(turn_deg: float) -> float:
            at = np.concatenate([_rotated(some, turn_deg).at_uav for some in rows])
            mean, covariance = known.moments(at)
            return _log_likelihood(self._without_airframe + covariance, levels - mean)

        own = self._without_airframe + gain_covariance([BODY], rows, rows)
        return _judged(_log_likelihood(own, levels), of)

    @cached_property
    def _without_airframe(self) -> FloatArray:
        """Covariance of all but the gain of the UAV."""
        rows = [some for some in self.rows if len(some)]
        covariance, start = gain_covariance([MAST, PAIR], rows, rows), 0
        for some, noise in zip(self.rows, self._noise, strict=True):
            part = slice(start, start + len(some))
            covariance[part, part] += noise
            start = part.stop
        return covariance


def _judged(own: float, of: Callable[[float], float]) -> Evidence:
    learned = of(0.0)
    # copies cost three times as much: a gain that loses clearly is not compared with them
    turned = max(map(of, _TURNS_DEG)) if learned > own - LEAST_ODDS else math.inf
    return Evidence(over_own=learned - own, over_turned=learned - turned)


def _noise_covariance(rows: LinkSamples) -> FloatArray:
    """Return the covariance (n, n) of offset, nuisance and noise of one series, by the likeliest scales."""
    if not len(rows):
        return np.zeros((0, 0))
    # some hundred rows decide as well as all
    some = rows.part(np.arange(0, len(rows), max(1, len(rows) // 200)))
    gains, levels = gain_covariance(ANTENNA_TERMS, [some], [some]), _centred(some)

    def model(scales: tuple[float, float]) -> GainModel:
        return GainModel(own_sd_db=scales[0], noise_sd_db=scales[1])

    def likelihood(scales: tuple[float, float]) -> float:
        return _log_likelihood(gains + own_covariance(model(scales), some), levels)

    return own_covariance(model(max(product(_SCALES_DB, _SCALES_DB), key=likelihood)), rows)


def _centred(rows: LinkSamples) -> FloatArray:
    return rows.residual_db - rows.residual_db.mean()


def _log_likelihood(covariance: FloatArray, values: FloatArray) -> float:
    return Factor.of(covariance).log_likelihood(values)


def _rotated(rows: LinkSamples, turn_deg: float) -> LinkSamples:
    """Return samples whose directions at the UAV are rotated anticlockwise."""
    if not turn_deg:
        return rows
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return dataclasses.replace(rows, at_uav=rows.at_uav @ turn)

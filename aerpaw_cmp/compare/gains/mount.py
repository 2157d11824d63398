"""Mounts of antennas of known pattern: azimuths of all ends of several flights at once.

Pitch and roll are 0: on dataset 12 tilts fitted on one flight (up to 20 degrees) raised the error of the other from
3.53 to 4.00 dB.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...common.units import FloatArray, wrap_degrees
from .direction_gain import LinkSamples

# Between the azimuths that are tried.
STEP_DEG = 10.0

# Standard deviation of a bin about the patterns: 4 dB of residual that stays alike over some six bins.
#
# Least squares: a covariance with learned gains, or with shadowing correlated over place, takes for itself the broad
# shape over azimuth that tells a mount. On dataset 12 the azimuth at the UAV then jumps between flights (320 and 120
# deg, in place of 270 and 270).
_MOUNT_NOISE_DB = 10.0

# Samples are averaged over this time [s].
BIN_S = 4.0


@dataclass(frozen=True, slots=True)
class MountFit:
    """Fitted mount of an antenna of known pattern.

    Parameters
    ----------
    azimuth_deg : float
        Of the most probable mount, as ``yaw_deg`` of flight.yaml.
    azimuth_sd_deg : float
        Circular standard deviation.
    probability : (azimuths,)
        Posterior over ``grid_deg``.
    identified : bool
        False where the data leave an azimuth further than 45 degrees away with more than 5 % of the probability.
    """

    azimuth_deg: float
    azimuth_sd_deg: float
    grid_deg: FloatArray
    probability: FloatArray
    identified: bool


# ``gain_db(direction (n, 3) in the device frame) -> (n,)``.
GainOf = Callable[[FloatArray], FloatArray]


def turned(azimuth_deg: float) -> FloatArray:
    """Mount (3, 3) of an antenna whose front looks that way, counter-clockwise from above."""
    c, s = np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def fit_mounts(series: Sequence[LinkSamples], patterns: Mapping[str, GainOf]) -> dict[str, MountFit]:
    """Mounts of antennas with a pattern, all at once.

    Parameters
    ----------
    series : sequence of LinkSamples
        Residuals against free space.
    patterns : mapping of str to callable
        Key ``uav`` and the antennas at towers that have a pattern; others count as isotropic.

    Returns
    -------
    dict of str to MountFit

    Notes
    -----
    ``log p = -|y - u - t|^2 / (2 s^2)`` is a quadratic form of columns computed once. Azimuths of
    tower antennas are optimised for each azimuth of the UAV.
    """
    grid = np.arange(0.0, 360.0, STEP_DEG)
    chosen, probability = _best_together(_quadratic_forms(series, patterns, grid))
    return {name: _mount(grid, probability[name], float(grid[chosen[name]])) for name in patterns}


def _mount(grid: FloatArray, probability: FloatArray, best_deg: float) -> MountFit:
    phasor = complex((probability * np.exp(1j * np.radians(grid))).sum())
    # circular standard deviation, as of a wrapped normal distribution
    spread = np.degrees(np.sqrt(-2.0 * np.log(min(max(abs(phasor), 1e-9), 1.0))))
    apart = np.abs(wrap_degrees(grid - best_deg))
    return MountFit(
        azimuth_deg=best_deg,
        # no finer than the grid: the standard deviation of a uniform step
        azimuth_sd_deg=float(max(spread, (grid[1] - grid[0]) / np.sqrt(12.0))),
        grid_deg=grid,
        probability=probability,
        identified=bool(probability[apart > 45.0].sum() < 0.05),
    )


@dataclass(frozen=True, slots=True)
class _Forms:
    """Quadratic form (q, q) of all columns: the target first, then the candidates of each name."""

    form: FloatArray
    columns: Mapping[str, slice]


def _quadratic_forms(series: Sequence[LinkSamples], patterns: Mapping[str, GainOf], grid: FloatArray) -> _Forms:
    columns = {name: slice(1 + i * len(grid), 1 + (i + 1) * len(grid)) for i, name in enumerate(patterns)}
    mounts = [turned(azimuth) for azimuth in grid]

    def candidates(samples: LinkSamples) -> FloatArray:
        """Target and candidates (bins, q) of a series."""
        good = samples.part(np.isfinite(samples.residual_db) & np.isfinite(samples.at_uav).all(axis=1))
        bins = good.binned(BIN_S)
        out = np.zeros((len(bins), 1 + len(patterns) * len(grid)))
        out[:, 0] = bins.residual_db
        for name, pattern in patterns.items():
            if name not in ("uav", samples.antenna):
                continue
            direction = bins.at_uav if name == "uav" else bins.at_tower
            out[:, columns[name]] = np.stack([pattern(direction @ mount) for mount in mounts], axis=1)
        # the offset of each flight and channel is free
        return np.asarray(out - out.mean(axis=0), dtype=np.float64)

    rows = np.concatenate([candidates(s) for s in series])
    return _Forms(rows.T @ rows / _MOUNT_NOISE_DB**2, columns)


def _best_together(forms: _Forms) -> tuple[dict[str, int], dict[str, FloatArray]]:
    """Most probable candidate of each name, and its marginal probabilities."""
    names = list(forms.columns)
    first, further = names[0], names[1:]
    size = forms.columns[first].stop - forms.columns[first].start
    value, choices, conditional = np.empty(size), [], []
    for candidate in range(size):
        chosen = {first: candidate, **dict.fromkeys(further, 0)}
        conditionals: dict[str, FloatArray] = {}
        for _ in range(4):
            for name in further:
                conditionals[name] = _given_others(forms, chosen, name)
                chosen[name] = int(conditionals[name].argmax())
        value[candidate] = _given_others(forms, chosen, first)[candidate]
        choices.append(chosen)
        conditional.append(conditionals)
    weight = np.exp(value - value.max())
    weight /= weight.sum()
    marginal = {first: weight}
    for name in further:
        parts = []
        for conditionals in conditional:
            share = np.exp(conditionals[name] - conditionals[name].max())
            parts.append(share / share.sum())
        marginal[name] = weight @ np.array(parts)
    return choices[int(value.argmax())], marginal


def _given_others(forms: _Forms, chosen: Mapping[str, int], name: str) -> FloatArray:
    """Log likelihood of all candidates of one name, those of the others given."""
    form, candidates = forms.form, forms.columns[name]
    chosen_columns = [forms.columns[end].start + at for end, at in chosen.items() if end != name]
    sign = np.zeros(len(form))
    sign[0] = 1.0
    sign[chosen_columns] = -1.0
    product = form @ sign
    return np.asarray(-0.5 * (sign @ product - 2.0 * product[candidates] + np.diag(form)[candidates]))

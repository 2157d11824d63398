"""Relative strengths of ends, nuisance and noise: chosen on the training flights alone.

Everything here works on the covariance of averaged bins, some thousand rows at most, in place of the normal equations
of harmonics: folds and strengths are parts and multiples of one matrix.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..common.gaussian import gaussian_kernel
from ..common.units import BoolArray, FloatArray, IntArray
from .direction_gain import (
    GainFit,
    GainModel,
    LinkSamples,
    Pairs,
    Term,
    argument_of,
    binned_series,
    factor_of,
    fit_gain,
    whitener,
)

SPREADS = (0.5, 1.0, 2.0, 4.0)
"""Factors of nuisance and noise against the gains to choose from. Lengths of directions stay as they are: a free
marginal likelihood takes fading for direction and shrinks the length at the UAV to 0.04 (2 degrees); free standard
deviations, too, fit the training flights at the cost of the next one (dataset 12: 3.83 dB in place of 3.65)."""

TOWER_FACTORS = (1.0, 0.5)
"""Of the tower's gains against the UAV's."""

OWN_LENGTH_FACTORS = (1.0, 2.0)
"""Of the length of a flight's own nuisance."""

MOST_ROWS = 1200
"""Bins that the choice looks at; longer series are averaged over longer times for it."""

FOLDS = 4


@dataclass(frozen=True, slots=True)
class Choice:
    """A model and how it was chosen.

    ``left_out_rmse_db``: error on left-out flights of the training [dB] per factor of spread. ``log_evidence``: per
    factor of the tower's gains and of the nuisance's length, at the best common scale.
    """

    model: GainModel
    spread: float
    left_out_rmse_db: Mapping[float, float]
    scale: float
    log_evidence: Mapping[tuple[float, float], float] = field(default_factory=dict)


def choose_and_fit(
    series: Sequence[LinkSamples],
    model: GainModel | None = None,
    spreads: Sequence[float] = SPREADS,
    pairs: Pairs | None = None,
) -> tuple[Choice, GainFit]:
    """Balance of the ends, length of the nuisance, strength of nuisance and noise, and the common scale of all.

    The balance and the length are those of largest marginal likelihood, of a few. The strength of nuisance and noise
    against the gains is that of least error on flights left out in turn; of one flight nothing can be left out that
    tells antenna from place (quarters of it were tried: 3.81 dB in place of 3.65 on dataset 12), so it stays 1. The
    scale, which changes no mean, makes the standard deviations fit the data: ``s^2 = y' C^-1 y / rows``.

    Parameters
    ----------
    series : sequence of LinkSamples
        Of the flights to learn from, and no other.
    model : GainModel, optional
        Where to start; the lengths of its gains are kept.
    spreads : sequence of float
        Factors to choose from.
    pairs : mapping of str to (k, 6), optional
        Knots of :func:`.direction_gain.shared_knots`.

    Returns
    -------
    Choice, GainFit
        And the fit with the model chosen.

    Raises
    ------
    InputError
        If no sample counts, or the equations cannot be solved.
    """
    model = model or GainModel()
    total = sum(map(len, binned_series(series, model.bin_s)))
    coarse = dataclasses.replace(model, bin_s=model.bin_s * max(1, math.ceil(total / MOST_ROWS)))
    rows = binned_series(series, coarse.bin_s)
    evidence: dict[tuple[float, float], float] = {}
    best: _Whitened | None = None
    chosen = 1.0, 1.0
    frames = {t.frame for t in model.terms}
    towers = TOWER_FACTORS if "mast" in frames and len(frames) > 1 else (1.0,)
    parts = _kernels(coarse, rows)
    for longer in OWN_LENGTH_FACTORS:
        whole = _whitened(dataclasses.replace(coarse, own_length_m=coarse.own_length_m * longer), rows, parts)
        for tower in towers:
            tried = whole.at(tower)
            evidence[tower, longer] = tried.log_evidence(coarse.noise_sd_db)
            if best is None or evidence[tower, longer] > evidence[chosen]:
                best, chosen = tried, (tower, longer)
    assert best is not None
    balanced = _balanced(model, *chosen)
    errors = best.left_out(rows, coarse.noise_sd_db, spreads)
    spread = min(errors, key=lambda f: errors[f]) if errors else 1.0
    fit = fit_gain(series, _with_spread(balanced, spread), pairs)
    scaled = fit.scaled()
    return Choice(scaled.model, spread, errors, fit.common_scale, evidence), scaled


def _balanced(model: GainModel, tower: float, longer: float) -> GainModel:
    terms = tuple(dataclasses.replace(t, sd_db=t.sd_db * tower) if t.frame == "mast" else t for t in model.terms)
    return dataclasses.replace(model, terms=terms, own_length_m=model.own_length_m * longer)


def _with_spread(model: GainModel, factor: float) -> GainModel:
    return dataclasses.replace(model, own_sd_db=model.own_sd_db * factor, noise_sd_db=model.noise_sd_db * factor)


def _kernels(model: GainModel, rows: Sequence[LinkSamples]) -> tuple[FloatArray, FloatArray]:
    """Covariance (n, n) of the gains between all bins: of the terms at the mast, and of all others [dB^2]."""
    names = [s.antenna for s in rows for _ in range(len(s))]
    antenna = np.unique(names, return_inverse=True)[1]
    same = np.asarray(antenna[:, None] == antenna)
    mast = tuple(t for t in model.terms if t.frame == "mast")
    other = tuple(t for t in model.terms if t.frame != "mast")
    return _covariance(mast, rows, same), _covariance(other, rows, same)


def _covariance(terms: Sequence[Term], rows: Sequence[LinkSamples], same: BoolArray) -> FloatArray:
    out = np.zeros(same.shape)
    for frame, length in dict.fromkeys((t.frame, t.length) for t in terms):
        at = np.concatenate([argument_of(s, frame) for s in rows])
        weight = np.zeros(2)  # between any two bins, and between those of one antenna
        for term in terms:
            if (term.frame, term.length) == (frame, length):
                weight[int(term.per == "antenna")] += term.sd_db**2
        out += np.where(same, weight.sum(), weight[0]) * gaussian_kernel(at, at, length)
    return out


@dataclass(frozen=True, slots=True)
class _Whitened:
    """Bins whose own covariance, with the noise as the unit, is the unit matrix.

    ``inner`` (2, n, n) is the gains' covariance between whitened bins, ``cross`` (2, n, n) that of plain with whitened
    ones, each at the mast and elsewhere; ``target`` (n,) the whitened residual; ``log_det`` that of the whitening.
    """

    inner: FloatArray
    cross: FloatArray
    target: FloatArray
    log_det: float
    series: int

    def at(self, tower: float) -> _Whitened:
        """With the tower's gains times a factor, both kinds of term in one matrix: (1, n, n)."""
        weight = np.array([tower**2, 1.0])[:, None, None]
        inner, cross = ((weight * m).sum(axis=0, keepdims=True) for m in (self.inner, self.cross))
        return dataclasses.replace(self, inner=inner, cross=cross)

    def log_evidence(self, noise_sd_db: float) -> float:
        """At the best common scale, but for a constant of the rows."""
        from scipy.linalg import solve_triangular

        lower = _factor(self.inner[0], noise_sd_db)
        spread = solve_triangular(lower, self.target, lower=True)
        free = max(len(self.target) - self.series, 1)
        square = max(float(spread @ spread) / free, 1e-12)
        return -0.5 * free * math.log(square) - float(np.log(np.diag(lower)).sum()) - self.log_det

    def left_out(self, rows: Sequence[LinkSamples], noise_sd_db: float, spreads: Sequence[float]) -> dict[float, float]:
        """Error [dB] on flights left out in turn, about an offset per series, per factor of nuisance and noise."""
        from scipy.linalg import cho_solve

        starts = np.cumsum([0, *map(len, rows)])
        at = [np.arange(a, b) for a, b in itertools.pairwise(starts)]
        squares, count = dict.fromkeys(spreads, 0.0), 0
        for train, test in _folds(rows):
            if not train or not test:
                continue
            seen: IntArray = np.concatenate([at[i] for i in train])
            inner, target = self.inner[0][np.ix_(seen, seen)], self.target[seen]
            count += sum(len(at[i]) for i in test)
            for factor in spreads:
                weights = cho_solve((_factor(inner, noise_sd_db * factor), True), target)
                for i in test:
                    left = rows[i].residual_db - self.cross[0][np.ix_(at[i], seen)] @ weights
                    squares[factor] += float(((left - left.mean()) ** 2).sum())
        return {factor: math.sqrt(square / count) for factor, square in squares.items()} if count else {}


def _factor(inner: FloatArray, noise_sd_db: float) -> FloatArray:
    """Cholesky factor of the gains' covariance and the noise."""
    matrix = inner.copy()
    matrix[np.diag_indices(len(matrix))] += noise_sd_db**2
    return factor_of(matrix)


def _whitened(model: GainModel, rows: Sequence[LinkSamples], parts: tuple[FloatArray, FloatArray]) -> _Whitened:
    from scipy.linalg import solve_triangular

    ratio = model.own_sd_db / model.noise_sd_db
    unit = dataclasses.replace(model, own_sd_db=ratio, noise_sd_db=1.0)
    cross, target, log_det, start = np.stack(parts), [], 0.0, 0
    inner = np.empty_like(cross)
    lowers = [whitener(unit, s) for s in rows]
    for samples, lower in zip(rows, lowers, strict=True):
        stop = start + len(samples)
        for one in cross:
            one[:, start:stop] = solve_triangular(lower, one[:, start:stop].T, lower=True).T
        target.append(solve_triangular(lower, samples.residual_db - samples.residual_db.mean(), lower=True))
        log_det += float(np.log(np.diag(lower)).sum())
        start = stop
    start = 0
    for lower in lowers:
        stop = start + len(lower)
        for into, one in zip(inner, cross, strict=True):
            into[start:stop] = solve_triangular(lower, one[start:stop], lower=True)
        start = stop
    return _Whitened(inner, cross, np.concatenate(target), log_det, len(rows))


def _folds(rows: Sequence[LinkSamples]) -> list[tuple[list[int], list[int]]]:
    """Training and left-out series, by number, of antennas that are trained; none of a single flight."""
    flights = list(dict.fromkeys(s.flight for s in rows))
    if len(flights) < 2:
        return []
    out = []
    for k in range(min(FOLDS, len(flights))):
        group = set(flights[k::FOLDS])
        train = [i for i, s in enumerate(rows) if s.flight not in group]
        known = {rows[i].antenna for i in train}
        test = [i for i, s in enumerate(rows) if s.flight in group and s.antenna in known and len(s) > 1]
        out.append((train, test))
    return out

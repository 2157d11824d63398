"""Cross-validated comparison of models of rising complexity, to find what a scene needs.

All models predict the same samples. The flight is divided into areas. In turn, each area is held out: the offset of a
model is fitted to the other areas, and the model is scored on the held-out area. Models are compared by paired
differences. The simplest model within one standard error of the best is recommended, because an effect that the flight
does not show should not be modelled (Breiman, Friedman, Olshen, Stone 1984, section 3.4.3: the 1 SE rule).
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass

import numpy as np

from ..common.units import BoolArray, FloatArray, IntArray
from .statistics import FEWEST, Interval, PairedDifference, paired_difference, pooled_difference

# Number of areas of a flight. The number is a power of two, because areas are halved.
_BLOCKS = 8

# A model is compared only if it has a level for at least this share of the samples.
_LEAST_COVERED = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateModel:
    """One model of the comparison.

    Parameters
    ----------
    model : str
    level_db : tuple of (n,)
        Level at the samples of each series [dBm].
    seconds : float
        Time to compute the levels of the flight [s].
    regressor_db : tuple of (n,), optional
        For models without ray tracing: abscissa of a straight line, per series. The slope of the line is fitted
        together with the offset, without the held-out area. If all values are 0, the model is a constant.
    """

    model: str
    level_db: tuple[FloatArray, ...]
    seconds: float
    regressor_db: tuple[FloatArray, ...] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelRow:
    """The score of a model on one tower and channel, or over all channels of a flight.

    Parameters
    ----------
    model : str
    tower, channel : str, optional
        None over all channels.
    rmse_heldout_db : float
        RMSE over all held-out areas [dB]; NaN if the model has too few levels.
    difference_to_best_db, difference_to_best_ci95_db : float, (low, high)
        RMSE minus the RMSE of the best model of the flight on the same samples [dB].
    n : int
        Number of samples for which all compared models have a level.
    seconds : float
        Time to compute the levels of the flight [s].
    recommended : bool
        True for the simplest model within one standard error of the best, over all series of the flight. If the errors
        on other flights are known from a calibration, the model with the lowest error there is recommended instead.
    fastest_sufficient : bool
        True for the first model, in the order of rising cost, whose difference from the best is not significant.
    distinct : bool
        False if an earlier model has the same error within 0.01 dB on every channel. The recommended model and the
        model of the flight file are always distinct.
    elsewhere_db : (float, float), optional
        RMSE of the recommended model and of free space on other flights [dB], if other flights selected the model.
    """

    model: str
    tower: str | None = None
    channel: str | None = None
    rmse_heldout_db: float
    difference_to_best_db: float
    difference_to_best_ci95_db: Interval
    n: int
    seconds: float
    recommended: bool
    fastest_sufficient: bool
    distinct: bool
    elsewhere_db: tuple[float, float] | None = None


# Models that differ by less than this on every channel [dB] are shown as one row, because tables show hundredths.
_SAME_DB = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelComparison:
    """The scored models.

    Parameters
    ----------
    candidates : tuple of CandidateModel
        Simplest first.
    error_db : tuple of tuple of (n,)
        ``error_db[model][series]``: held-out errors [dB]; NaN for samples that the models do not share.
    time_s, position_m : tuple of (n,), tuple of (n, 3)
        Time [s] and position [m] of the samples of each series.
    rmse_db : tuple of float
        RMSE of each model over all series [dB].
    best, best_replay, recommended : int, optional
        Index of the best model, of the best model with ray tracing, and of the recommended model. None if no models
        were compared.
    elsewhere_db : (float, float), optional
        RMSE of the recommended model and of free space on other flights [dB], if other flights selected the model.
    """

    candidates: tuple[CandidateModel, ...]
    error_db: tuple[tuple[FloatArray, ...], ...]
    time_s: tuple[FloatArray, ...]
    position_m: tuple[FloatArray, ...]
    rmse_db: tuple[float, ...]
    best: int | None
    best_replay: int | None
    recommended: int | None
    elsewhere_db: tuple[float, float] | None = None


def places_of(position_m: FloatArray, blocks: int = _BLOCKS) -> IntArray:
    """Return the area of each sample, shape (n,).

    The positions are halved repeatedly along the longer horizontal side, so that areas have equal numbers of samples.
    All visits to an area are held out together. If segments in time were held out, other visits to the area would
    remain in the fit.

    Parameters
    ----------
    position_m : (n, 2) or (n, 3)
        East, north [m]. Equal positions are ordered by time.
    blocks : int
        A power of two.

    Returns
    -------
    (n,) int
        0 to ``blocks - 1``.

    Examples
    --------
    >>> places_of(np.array([[0.0, 0.0], [9.0, 1.0], [1.0, 0.0], [8.0, 1.0]]), blocks=2).tolist()
    [0, 1, 0, 1]
    """
    place = np.zeros(len(position_m), dtype=np.int64)
    cells = [np.arange(len(position_m))]
    while len(cells) < blocks:
        cells = [part for cell in cells for part in _halves(cell, position_m)]
    for number, cell in enumerate(cells):
        place[cell] = number
    return place


def _halves(cell: IntArray, position_m: FloatArray) -> list[IntArray]:
    if not len(cell):
        return [cell, cell]
    side = int(np.ptp(position_m[cell, :2], axis=0).argmax())
    return np.split(cell[np.argsort(position_m[cell, side], kind="stable")], [len(cell) // 2])


def compare_models(
    measured_db: Sequence[FloatArray],
    time_s: Sequence[FloatArray],
    candidates: Sequence[CandidateModel],
    position_m: Sequence[FloatArray],
) -> ModelComparison:
    """Score models on held-out areas. No model is scored or recommended if the models share fewer than 20 samples.

    Parameters
    ----------
    measured_db : sequence of (n,)
        Level of each series in time order [dB]; NaN is not scored.
    time_s : sequence of (n,)
        Times [s]. The errors of all series are ordered by time, so that correlated errors of several channels are
        adjacent.
    candidates : sequence of CandidateModel
        Models, simplest first: lines, then more and more paths and losses, which is also the order of their cost. Of
        two equal models, the earlier model is used.
    position_m : sequence of (n, 3)
        Position of each sample [m]; areas are held out (:func:`places_of`).

    Returns
    -------
    ModelComparison
    """
    enough = [_covers(measured_db, candidate) for candidate in candidates]
    counted = [candidate for candidate, ok in zip(candidates, enough, strict=True) if ok]
    shared = [
        np.asarray(np.isfinite([m, *(candidate.level_db[i] for candidate in counted)]).all(axis=0))
        for i, m in enumerate(measured_db)
    ]
    if sum(int(keep.sum()) for keep in shared) < FEWEST:
        shared = [np.zeros_like(keep) for keep in shared]
    places = [places_of(p[keep]) for p, keep in zip(position_m, shared, strict=True)]
    errors = tuple(
        tuple(
            held_out_error_db(m, level, keep, block, x) if ok else np.full(len(m), np.nan)
            for m, level, keep, block, x in zip(
                measured_db,
                candidate.level_db,
                shared,
                places,
                candidate.regressor_db or [None] * len(shared),
                strict=True,
            )
        )
        for candidate, ok in zip(candidates, enough, strict=True)
    )
    in_time = np.argsort(np.concatenate([*time_s, np.zeros(0)]), kind="stable")
    joined = [np.concatenate([*e, np.zeros(0)])[in_time] for e in errors]
    place = np.concatenate([*position_m, np.zeros((0, 3))])[in_time]
    rmse = tuple(_rmse(e) for e in joined)
    replays = [i for i, candidate in enumerate(candidates) if candidate.regressor_db is None and np.isfinite(rmse[i])]
    # a straight line is never recommended, because it is not valid elsewhere
    chosen = recommended = min(replays, key=lambda i: rmse[i], default=None)
    if chosen is not None:
        recommended = next(i for i in replays if i == chosen or _as_good(compared(joined[i], joined[chosen], place)))
    return ModelComparison(
        candidates=tuple(candidates), error_db=errors, time_s=tuple(time_s), position_m=tuple(position_m), rmse_db=rmse,
        best=int(np.nanargmin(rmse)) if any(np.isfinite(rmse)) else None, best_replay=chosen, recommended=recommended,
    )  # fmt: skip


def model_rows(
    ladder: ModelComparison, names: Sequence[tuple[str, str]] = ()
) -> tuple[tuple[ModelRow, ...], tuple[ModelRow, ...]]:
    """Return the scores of the models, simplest first. Empty if no models were compared.

    Parameters
    ----------
    ladder : ModelComparison
    names : sequence of (str, str)
        Tower and channel of each series.

    Returns
    -------
    tuple of ModelRow, tuple of ModelRow
        The scores over all series, and on each named series.
    """
    distinct = _distinct(ladder)
    each = [row for i, name in enumerate(names) for row in _rows(ladder, [i], distinct, *name)]
    return tuple(_rows(ladder, range(len(ladder.time_s)), distinct)), tuple(each)


def _rows(
    ladder: ModelComparison,
    of: Sequence[int],
    distinct: Container[int],
    tower: str | None = None,
    channel: str | None = None,
) -> list[ModelRow]:
    """Return the score of each model over some series. Empty if no models were compared."""
    if ladder.best is None:
        return []
    place = [ladder.position_m[i] for i in of]
    pairs = [
        pooled_difference([(ladder.time_s[i], errors[i], ladder.error_db[ladder.best][i]) for i in of],
                          free_offset=False, place_m=place)
        for errors in ladder.error_db
    ]  # fmt: skip
    # a model is sufficient if it is the best model, or if the interval of its difference from the best model contains 0
    sufficient = [i for i, pair in enumerate(pairs) if i == ladder.best or pair.difference_ci95_db[0] <= 0.0]
    fastest = min(sufficient)  # by the order of candidates, because measured seconds vary between runs
    return [
        ModelRow(
            model=candidate.model,
            tower=tower,
            channel=channel,
            rmse_heldout_db=_rmse(np.concatenate([ladder.error_db[index][i] for i in of])),
            difference_to_best_db=pair.difference_db,
            difference_to_best_ci95_db=pair.difference_ci95_db,
            n=pair.n,
            seconds=candidate.seconds,
            recommended=index == ladder.recommended,
            fastest_sufficient=index == fastest,
            distinct=index in distinct,
            elsewhere_db=ladder.elsewhere_db if index == ladder.recommended else None,
        )
        for index, (candidate, pair) in enumerate(zip(ladder.candidates, pairs, strict=True))
    ]


def _distinct(ladder: ModelComparison) -> set[int]:
    """Return the last and the recommended model, and all models whose errors differ from those of earlier models."""
    rmse = np.array([[_rmse(error) for error in errors] for errors in ladder.error_db])
    rmse = np.nan_to_num(rmse, nan=-1.0)  # models without an error on a channel are equal there
    known: list[int] = []
    for index, own in enumerate(rmse):
        alike = (np.abs(rmse[known] - own) <= _SAME_DB).all(axis=1).any()
        if not alike or (own < 0.0).all() or index in (ladder.recommended, len(rmse) - 1):
            known.append(index)
    return set(known)


def held_out_error_db(
    measured_db: FloatArray,
    level_db: FloatArray,
    keep: BoolArray,
    place: IntArray,
    regressor_db: FloatArray | None = None,
) -> FloatArray:
    """Return measured minus predicted level (n,), with the offset of each area fitted to all other areas [dB].

    Parameters
    ----------
    measured_db, level_db : (n,)
        Levels in time order [dB].
    keep : (n,) bool
        True for samples that are fitted and scored.
    place : (kept samples,) int
        Area of each of these samples, below :data:`_BLOCKS`.
    regressor_db : (n,), optional
        Abscissa of a line whose slope is fitted together with the offset.

    Returns
    -------
    (n,)
        Errors [dB]; NaN where ``keep`` is False.

    Examples
    --------
    >>> place = np.array([0, 0, 1, 1])
    >>> held_out_error_db(np.array([1.0, 1.0, 3.0, 3.0]), np.zeros(4), np.ones(4, bool), place).tolist()
    [-2.0, -2.0, 2.0, 2.0]
    """
    rows = np.flatnonzero(keep)
    difference = measured_db[rows] - level_db[rows]
    x = np.zeros(len(rows)) if regressor_db is None else regressor_db[rows]
    offset, slope = held_out_lines(difference, x, place, _BLOCKS)
    error = np.full(len(measured_db), np.nan)
    error[rows] = difference - offset[place] - slope[place] * x
    return error


def held_out_lines(values: FloatArray, x: FloatArray, block: IntArray, blocks: int) -> tuple[FloatArray, FloatArray]:
    """Return least-squares lines, each fitted to all blocks except one.

    Parameters
    ----------
    values, x : (n,)
        Ordinate and abscissa. If ``x`` does not vary, the slope is 0.
    block : (n,) int
        Block of each sample, 0 to ``blocks - 1``.
    blocks : int

    Returns
    -------
    (offset, slope) : each (blocks,)
        Line of each held-out block; the offset is NaN if no other block has samples.
    """
    centre = float(x.mean()) if len(x) else 0.0
    centred = x - centre
    sums = np.array(
        [np.bincount(block, weights=w, minlength=blocks)
         for w in (np.ones(len(x)), centred, values, centred * centred, centred * values)]
    )  # fmt: skip
    count, sx, sy, sxx, sxy = sums.sum(axis=1, keepdims=True) - sums
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = sxx - sx * sx / count
        slope = np.where(spread > 1e-9 * np.maximum(sxx, 1e-12), (sxy - sx * sy / count) / spread, 0.0)
        return (sy - slope * sx) / count - slope * centre, slope


def log_distance_level_db(measured_db: FloatArray, distance_m: FloatArray, position_m: FloatArray) -> FloatArray:
    """Return the log-distance level (n,) about its mean, with the slope of each area fitted to the other areas [dB].

    The offset is fitted by the comparison, as for every other model.

    Parameters
    ----------
    measured_db, distance_m : (n,)
        Level [dB] and distance between transmitter and receiver [m]; NaN is not fitted.
    position_m : (n, 3)
        East, north, up [m]; see :func:`places_of`.

    Returns
    -------
    (n,)
        Level [dB]; NaN if the distance is not known.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        x = 10.0 * np.log10(distance_m)
    finite = np.isfinite(measured_db) & np.isfinite(x)
    level = np.full(len(x), np.nan)
    if not finite.any():
        return level
    centred = x - x[finite].mean()
    place = places_of(position_m[finite])
    slope = held_out_lines(measured_db[finite], centred[finite], place, _BLOCKS)[1]
    overall = held_out_lines(measured_db[finite], centred[finite], np.zeros(int(finite.sum()), np.int64), 2)[1][1]
    level[np.isfinite(centred)] = overall * centred[np.isfinite(centred)]
    level[finite] = slope[place] * centred[finite]
    return level


def compared(error_db: FloatArray, best_db: FloatArray, position_m: FloatArray) -> PairedDifference:
    """Return the difference in RMSE from the best model, without fitting another offset."""
    return paired_difference(error_db, best_db, free_offset=False, place_m=position_m)


def _as_good(against_best: PairedDifference) -> bool:
    return bool(against_best.difference_db <= against_best.standard_error_db)


def _covers(measured: Sequence[FloatArray], candidate: CandidateModel) -> bool:
    known = [np.isfinite(m) for m in measured]
    pairs = sum(int((k & np.isfinite(x)).sum()) for k, x in zip(known, candidate.level_db, strict=True))
    return pairs >= _LEAST_COVERED * max(sum(int(k.sum()) for k in known), 1)


def _rmse(error: FloatArray) -> float:
    good = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(good**2))) if len(good) else float("nan")

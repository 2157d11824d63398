"""Ladder of models, to find what a scene needs: scored on stretches of the flight that had no part in their offset.

Each rung is a prediction of the same samples by a model with one thing more than another. A flight is cut into
places; the offset of a model is fitted without one and scored on it, in turn. Models are
compared on the same samples by paired differences, and the simplest one within one standard error of the best is
recommended: what a flight cannot show to help is not worth having (Breiman, Friedman, Olshen, Stone 1984, section
3.4.3: the 1 SE rule).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..common.units import BoolArray, FloatArray, IntArray
from .statistics import NO_INTERVAL, Interval, PairedDifference, paired_difference

# Places that a flight is cut into: a power of two, made by halving.
_BLOCKS = 8

# A model that has no level at more than a fifth of the samples cannot be compared with the others.
_LEAST_COVERED = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class Rung:
    """One model: its name, its level (n,) [dBm] at the samples of each series, and what it cost [s].

    ``regressor_db`` (n,) per series marks a line that replays nothing: its slope is fitted beside the offset, without
    the places that it is scored on. A regressor of zeros leaves the constant alone.
    """

    model: str
    level_db: tuple[FloatArray, ...]
    seconds: float
    regressor_db: tuple[FloatArray, ...] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LadderRow:
    """A model on one tower and channel.

    Parameters
    ----------
    model, tower, channel : str
    rmse_heldout_db : float
        Over all stretches left out [dB]; NaN where the model has too few levels.
    difference_to_best_db, difference_to_best_ci95_db : float, (low, high)
        RMSE minus that of the best model on the same samples [dB].
    n : int
        Samples that all compared models share.
    seconds : float
        For the whole flight, the same in each of its rows.
    recommended : bool
        The simplest model within one standard error of the best, over all series of the flight; the best on other
        flights, where its calibration knows that.
    elsewhere_db : (float, float), optional
        RMSE of the recommended model and of free space on flights left out [dB], where these chose it.
    """

    model: str
    tower: str
    channel: str
    rmse_heldout_db: float
    difference_to_best_db: float
    difference_to_best_ci95_db: Interval
    n: int
    seconds: float
    recommended: bool
    elsewhere_db: tuple[float, float] | None = None


# Models that differ by less than this on every channel [dB] are one row: the tables show hundredths.
_SAME_DB = 0.01


def distinct(rows: Sequence[LadderRow], keep: str) -> tuple[list[LadderRow], list[str]]:
    """Return the rows of models that differ from every model before them, and the names of the others.

    Parameters
    ----------
    rows : sequence of LadderRow
        In the order of the models, with the same channels for each.
    keep : str
        Model that stays; so does the recommended one.

    Returns
    -------
    rows : list of LadderRow
    same : list of str
        Models whose error is that of a model before them within 0.01 dB on every channel.
    """
    models: dict[str, list[LadderRow]] = {}
    for row in rows:
        models.setdefault(row.model, []).append(row)
    known: dict[str, FloatArray] = {}
    same = []
    for name, own in models.items():
        error = np.array([row.rmse_heldout_db for row in own])
        alike = any(np.nanmax(np.abs(error - other), initial=0.0) < _SAME_DB for other in known.values()
                    if np.array_equal(np.isnan(error), np.isnan(other)))  # fmt: skip
        if alike and np.isfinite(error).any() and name != keep and not any(row.recommended for row in own):
            same.append(name)
        else:
            known[name] = error
    return [row for name in known for row in models[name]], same


@dataclass(frozen=True, slots=True, kw_only=True)
class Ladder:
    """All rungs, scored: ``error_db[rung][series]`` (n,), NaN outside the shared samples.

    ``position_m`` is by series (n, 3). ``rmse_db`` is over all series. ``best`` (of all rungs), ``best_replay`` and
    ``recommended`` (without the lines that replay nothing) are indices of rungs, None where nothing was compared.
    """

    rungs: tuple[Rung, ...]
    error_db: tuple[tuple[FloatArray, ...], ...]
    position_m: tuple[FloatArray, ...]
    rmse_db: tuple[float, ...]
    best: int | None
    best_replay: int | None
    recommended: int | None
    elsewhere_db: tuple[float, float] | None = None
    """RMSE of the recommended model and of free space on other flights, where these chose it [dB]."""


def places_of(position_m: FloatArray, blocks: int = _BLOCKS) -> IntArray:
    """Place of each sample (n,): cells of equally many samples, made by halving along the longer side of the plan.

    A place that a flight comes back to is one place, and is left out as a whole; stretches of time would leave its
    other visits in.

    Parameters
    ----------
    position_m : (n, 2) or (n, 3)
        East, north [m]; of equal ones the earlier come first.
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


def _halves(cell: IntArray, position_m: FloatArray) -> tuple[IntArray, IntArray]:
    if not len(cell):
        return cell, cell
    side = int(np.ptp(position_m[cell, :2], axis=0).argmax())
    order = cell[np.argsort(position_m[cell, side], kind="stable")]
    return order[: len(order) // 2], order[len(order) // 2 :]


def climb(
    measured_db: Sequence[FloatArray],
    time_s: Sequence[FloatArray],
    rungs: Sequence[Rung],
    position_m: Sequence[FloatArray],
) -> Ladder:
    """Score the rungs of a ladder, given from the simplest to the most complex model.

    Parameters
    ----------
    measured_db : sequence of (n,)
        By series, in time order; NaN does not count [dB].
    time_s : sequence of (n,)
        Orders the errors of all series, so that channels that share their instants share their blocks [s].
    rungs : sequence of Rung
        Simplest first: ties go to the earlier one.
    position_m : sequence of (n, 3)
        Where each sample was taken: places are left out (:func:`places_of`).

    Returns
    -------
    Ladder
    """
    enough = [_covers(measured_db, rung) for rung in rungs]
    shared = [_shared(m, [r.level_db[i] for r, ok in zip(rungs, enough, strict=True) if ok])
              for i, m in enumerate(measured_db)]  # fmt: skip
    places = [places_of(p[keep]) for p, keep in zip(position_m, shared, strict=True)]
    errors = tuple(
        tuple(
            held_out_error_db(m, level, keep, block, x) if ok else np.full(len(m), np.nan)
            for m, level, keep, block, x in zip(
                measured_db, rung.level_db, shared, places, rung.regressor_db or [None] * len(shared), strict=True
            )
        )
        for rung, ok in zip(rungs, enough, strict=True)
    )
    in_time = np.argsort(np.concatenate([*time_s, np.zeros(0)]), kind="stable")
    joined = [np.concatenate([*e, np.zeros(0)])[in_time] for e in errors]
    place = np.concatenate([*position_m, np.zeros((0, 3))])[in_time]
    rmse = tuple(_rmse(e) for e in joined)
    if not any(np.isfinite(rmse)):
        return Ladder(
            rungs=tuple(rungs), error_db=errors, position_m=tuple(position_m), rmse_db=rmse, best=None,
            best_replay=None, recommended=None,
        )  # fmt: skip
    replays = [i for i, rung in enumerate(rungs) if rung.regressor_db is None and np.isfinite(rmse[i])]
    # lines replay nothing: they are shown, and never recommended
    chosen = recommended = min(replays, key=lambda i: rmse[i], default=None)
    if chosen is not None:
        recommended = next(i for i in replays if i == chosen or _as_good(joined[i], joined[chosen], place))
    return Ladder(
        rungs=tuple(rungs), error_db=errors, position_m=tuple(position_m), rmse_db=rmse,
        best=int(np.nanargmin(rmse)), best_replay=chosen, recommended=recommended,
    )  # fmt: skip


def series_rows(ladder: Ladder, series: int, name: tuple[str, str]) -> list[LadderRow]:
    """The rows of one series.

    Parameters
    ----------
    ladder : Ladder
    series : int
        Which of the series of its rungs.
    name : (tower, channel)

    Returns
    -------
    list of LadderRow
        One per rung.
    """
    rows = []
    for index, rung in enumerate(ladder.rungs):
        error = ladder.error_db[index][series]
        against_best = None
        if ladder.best is not None:
            against_best = compared(error, ladder.error_db[ladder.best][series], ladder.position_m[series])
        rows.append(
            LadderRow(
                model=rung.model,
                tower=name[0],
                channel=name[1],
                rmse_heldout_db=_rmse(error),
                difference_to_best_db=float("nan") if against_best is None else against_best.difference_db,
                difference_to_best_ci95_db=NO_INTERVAL if against_best is None else against_best.difference_ci95_db,
                n=int(np.isfinite(error).sum()),
                seconds=rung.seconds,
                recommended=index == ladder.recommended,
                elsewhere_db=ladder.elsewhere_db if index == ladder.recommended else None,
            )
        )
    return rows


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelCost:
    """A scored model over all series: its seconds, its RMSE on held-out segments [dB], and whether it is the knee.

    The knee is the fastest model that no series tells from the best one.
    """

    model: str
    seconds: float
    rmse_heldout_db: float
    knee: bool


def costs(rows: Sequence[LadderRow]) -> list[ModelCost]:
    """Time against error of the models that are scored on every series on which any is."""
    scored: dict[str, list[LadderRow]] = {}
    for row in rows:
        if np.isfinite(row.rmse_heldout_db):
            scored.setdefault(row.model, []).append(row)
    most = max(map(len, scored.values()), default=0)
    scored = {model: of for model, of in scored.items() if len(of) == most}
    as_good = [
        model for model, of in scored.items()
        if all(row.difference_to_best_db <= 0.0 or row.difference_to_best_ci95_db[0] <= 0.0 for row in of)
    ]  # fmt: skip
    knee = min(as_good, key=lambda model: scored[model][0].seconds, default=None)
    return [
        ModelCost(
            model=model,
            seconds=of[0].seconds,
            rmse_heldout_db=float(
                np.sqrt(np.average([row.rmse_heldout_db**2 for row in of], weights=[row.n for row in of]))
            ),
            knee=model == knee,
        )
        for model, of in scored.items()
    ]


def held_out_error_db(
    measured_db: FloatArray,
    level_db: FloatArray,
    keep: BoolArray,
    place: IntArray,
    regressor_db: FloatArray | None = None,
) -> FloatArray:
    """Measured minus predicted (n,), each place with the offset of all the others [dB]; NaN where not ``keep``.

    Parameters
    ----------
    measured_db, level_db : (n,)
        Levels in time order [dB].
    keep : (n,) bool
        Samples that count.
    place : (kept samples,) int
        Of each sample that counts, below :data:`_BLOCKS`.
    regressor_db : (n,), optional
        Has a slope that is fitted together with the offset, on the same samples.

    Returns
    -------
    (n,)
        Errors [dB].

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
    """Least-squares lines through all blocks but one: offset and slope (blocks,) for each block left out.

    Parameters
    ----------
    values, x : (n,)
        Ordinate and abscissa. Where ``x`` does not vary, the slope is 0.
    block : (n,) int
        Of each sample, 0 to ``blocks - 1``.
    blocks : int

    Returns
    -------
    (offset, slope) : each (blocks,)
        NaN offset where no sample is left.
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
    """Log-distance level (n,) about its mean [dB], each place by the slope of the other places.

    The offset is left to the comparison, as for every other model. NaN where no distance is known.

    Parameters
    ----------
    measured_db, distance_m : (n,)
        Level [dB] and distance of the ends [m]; NaN is left out of the fit.
    position_m : (n, 3)
        See :func:`places_of`.

    Returns
    -------
    (n,)
        [dB].
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
    """A model against the best one; errors of stretches left out count as they are."""
    return paired_difference(error_db, best_db, free_offset=False, place_m=position_m)


def _as_good(error: FloatArray, best: FloatArray, position_m: FloatArray) -> bool:
    against_best = compared(error, best, position_m)
    return bool(against_best.difference_db <= against_best.standard_error_db)


def _covers(measured: Sequence[FloatArray], rung: Rung) -> bool:
    measurements = sum(int(np.isfinite(m).sum()) for m in measured)
    pairs = (int((np.isfinite(m) & np.isfinite(x)).sum()) for m, x in zip(measured, rung.level_db, strict=True))
    return sum(pairs) >= _LEAST_COVERED * max(measurements, 1)


def _shared(measured: FloatArray, levels: Sequence[FloatArray]) -> BoolArray:
    return np.asarray(np.isfinite([measured, *levels]).all(axis=0))


def _rmse(error: FloatArray) -> float:
    good = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(good**2))) if len(good) else float("nan")

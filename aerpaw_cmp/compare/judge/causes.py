"""Likely cause of a level error: the one trouble of a log, its settings or its site that explains it, by likelihood.

Each trouble changes the predicted level in its own way: by decibels that are known, by columns with free coefficients,
or by samples that the receiver clipped, whose level is their own mean. The offset is fitted beside it, and the residual
counts as first-order autoregressive noise, so that slow fading is no trouble. Explanations are single troubles and two
at a time; each has the log likelihood that it gains over all channels beyond the cost of its numbers (Schwarz). The
best explanation names its trouble where all that explain the flight without it are less likely by :data:`_MARGIN`
(chance: fewer than one in a hundred), and where it takes a tenth off the RMSE. The paired test of two models would ask
for a flight much longer than a trouble lasts: a trouble of a minute has one sign in each of few stretches.

A new trouble is a function that yields its :class:`Trial`, and an entry of :data:`CANDIDATES`.

Reference: Schwarz, Annals of Statistics 6 (1978) 461, doi 10.1214/aos/1176344136.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from itertools import combinations
from typing import Protocol

import numpy as np

from ...common.units import BoolArray, FloatArray, Printed
from ..statistics.intervals import Interval

# Samples are averaged over so long [s], over longer where a flight has more than so many seconds.
BIN_S, _MOST_BINS = 1.0, 2000
_FEWEST_BINS = 60
# Log likelihood that a trouble must gain beyond its cost.
_MARGIN = 4.0
# Of sentence and next step of a cause: a page begins with sixty in all.
MOST_CAUSE_WORDS = 28
# A trouble that takes less than this share off the RMSE is not the cause of the error.
_LEAST_SHARE = 0.1
# Half of the 95 % point of chi-squared with one degree of freedom.
_NEAR = 1.92
_EPOCH = np.datetime64(0, "s")
_Estimate = tuple[float, float, float]
_NOTHING: _Estimate = (math.nan, math.nan, math.nan)
_PHI = np.array([0.0, 0.3, 0.5, 0.7, 0.8, 0.87, 0.92, 0.95, 0.97, 0.985, 0.995])


class JudgedClock(Protocol):
    """The radio clock as :class:`~..result.ClockResult` has it."""

    @property
    def radio_minus_telemetry_s(self) -> float:
        """Lag [s]; positive: the radio shows later times."""

    @property
    def ci95_s(self) -> Interval:
        """Interval of the lag [s]."""

    @property
    def shifted(self) -> bool:
        """True of a clock that is wrong and was not corrected."""

    @property
    def in_words(self) -> str:
        """The lag with its interval."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelEvidence:
    """Evidence from which a cause is told: one channel of a flight.

    Parameters
    ----------
    time_s : (n,)
        In order.
    measured_db, predicted_db : (n,)
        Before any offset; NaN where there is none.
    uav_azimuth_deg, uav_elevation_deg : (n,)
        Direction of the tower in the frame of the UAV's antenna.
    tower_azimuth_deg : (n,)
        Direction of the UAV seen from the tower, clockwise from north.
    name, unit : str
        Of the channel, and of its measured level.
    start : datetime64
        Instant at which ``time_s`` is 0.
    antenna : {"isotropic", "measured", "learned"}
        Of the UAV.
    turned_db, raised_db : mapping of float to (n,)
        Change of the predicted level where the heading is greater by so many degrees, and where the UAV flies higher by
        so many metres; ``turned_db`` is empty for antennas without a pattern.
    attitude_db : mapping of str to (n,)
        Change of the predicted level with other values of ``rt.attitude``.
    other_towers_db : mapping of str to (n,)
        Predicted level of each other tower of the site.
    locked, serving : (n,), optional
        1 in lock or served by this cell, 0 not, NaN unknown, where the log says so.
    clock : JudgedClock, optional
        The radio clock as it was judged.
    """

    time_s: FloatArray
    measured_db: FloatArray
    predicted_db: FloatArray
    uav_azimuth_deg: FloatArray
    uav_elevation_deg: FloatArray
    tower_azimuth_deg: FloatArray
    name: str = ""
    unit: str = "dB"
    start: np.datetime64 = _EPOCH
    antenna: str = "measured"
    turned_db: Mapping[float, FloatArray] = field(default_factory=dict)
    raised_db: Mapping[float, FloatArray] = field(default_factory=dict)
    attitude_db: Mapping[str, FloatArray] = field(default_factory=dict)
    other_towers_db: Mapping[str, FloatArray] = field(default_factory=dict)
    locked: FloatArray | None = None
    serving: FloatArray | None = None
    clock: JudgedClock | None = None
    least: BoolArray | None = None
    greatest: BoolArray | None = None
    """Samples at the least and at the greatest level of the log, where it has that again and again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """A named cause.

    Parameters
    ----------
    name : str
    sentence : str
        Where it is, with its numbers, and the error with and without it.
    next_step : str
        A clause.
    estimate, ci95 : float, (low, high)
        Its number (lag [s], angle [deg], height [m], loss, floor or step [dB]; NaN else) and the interval of that.
    channels : sequence of str
        That show it.
    rmse_db, rmse_with_db : float
        Of these channels without and with it, as means over a second [dB].
    gain : float
        Log likelihood that it gains beyond its cost.
    """

    name: str
    sentence: str
    next_step: str
    estimate: float = math.nan
    ci95: Interval = (math.nan, math.nan)
    channels: tuple[str, ...] = ()
    rmse_db: float = math.nan
    rmse_with_db: float = math.nan
    gain: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A trouble with its numbers: what it changes, how many free numbers that takes, and what is said of it.

    ``change_db`` (n,) is added to the predicted level, ``columns`` (n, k) have free coefficients, ``clipped`` (n,) are
    samples whose level is not that of the link.
    """

    name: str
    cost: float
    sentence: str
    next_step: str
    change_db: FloatArray | None = None
    columns: FloatArray | None = None
    clipped: BoolArray | None = None
    estimate: _Estimate = _NOTHING


@dataclass(frozen=True, slots=True)
class _Fit:
    """Log likelihood and residual of a prediction with its best offset."""

    log_likelihood: float
    residual_db: FloatArray


@dataclass(frozen=True, slots=True)
class _Model:
    """Some troubles on one channel: the log likelihood that they gain together beyond their cost."""

    evidence: LevelEvidence
    trials: tuple[Trial, ...]
    residual_db: FloatArray
    gain: float


_Models = Mapping[frozenset[str], _Model]
_SOUND: frozenset[str] = frozenset()


def flight_cause(channels: Sequence[LevelEvidence]) -> Cause | None:
    """The trouble that explains the error of a flight; None where none is identified.

    Parameters
    ----------
    channels : sequence of LevelEvidence

    Returns
    -------
    Cause or None
    """
    tables = [_models(binned) for evidence in channels if (binned := _binned(evidence)) is not None]
    names = sorted({name for table in tables for names in table for name in names})
    sets = [_SOUND, *({name} for name in names), *map(set, combinations(names, 2))]
    gains = {frozenset(some): sum(_best(table, some).gain for table in tables) for some in sets}
    best = max(gains, key=lambda some: gains[some])
    without = {name: max(gain for some, gain in gains.items() if name not in some) for name in best}
    name = min(without, key=lambda trouble: without[trouble], default=None)
    if name is None or gains[best] - without[name] < _MARGIN + math.log(len(channels)):
        return None
    shown = [table for table in tables if name in _names(_best(table, best))]
    shown.sort(key=lambda table: -table[frozenset([name])].gain)
    # also alone it must bring levels and prediction together, not only their changes from second to second
    alone = _share_of_error(shown, _SOUND, {name})
    if alone > 1.0 or min(alone, _share_of_error(shown, best - {name}, best)) > 1.0 - _LEAST_SHARE:
        return None
    return _named(name, shown, gains[best] - without[name])


def _names(model: _Model) -> set[str]:
    return {trial.name for trial in model.trials}


def _best(table: _Models, troubles: Set[str]) -> _Model:
    """The best model of a channel by some troubles or fewer."""
    return max((model for names, model in table.items() if names <= troubles), key=lambda model: model.gain)


# Troubles of a channel that are tried two at a time.
_MOST_TRIED = 6


def _models(e: LevelEvidence) -> _Models:
    """The likeliest numbers of each trouble, and each two of the best of them."""
    sound = _fitted(e)

    def model(*trials: Trial) -> _Model:
        fit = _fitted(e, *trials)
        cost = 0.5 * sum(trial.cost for trial in trials) * math.log(len(e.time_s))
        return _Model(e, trials, fit.residual_db, fit.log_likelihood - sound.log_likelihood - cost)

    best: dict[str, _Model] = {}
    for trial in (trial for candidate in CANDIDATES for trial in candidate(e)):
        alone = model(trial)
        if trial.name not in best or alone.gain > best[trial.name].gain:
            best[trial.name] = alone
    likely = sorted(best, key=lambda name: -best[name].gain)[:_MOST_TRIED]
    pairs = {frozenset(two): model(*(best[name].trials[0] for name in two)) for two in combinations(likely, 2)}
    return {_SOUND: model(), **{frozenset([name]): best[name] for name in likely}, **pairs}


def _share_of_error(shown: Sequence[_Models], before: Set[str], after: Set[str]) -> float:
    """RMSE with further troubles over that before."""
    return _rmse_db([_best(table, after) for table in shown]) / _rmse_db([_best(table, before) for table in shown])


def _rmse_db(models: Sequence[_Model]) -> float:
    return float(np.sqrt(np.mean(np.concatenate([model.residual_db for model in models]) ** 2)))


def _named(name: str, shown: Sequence[_Models], gain: float) -> Cause:
    """The trouble in words, those of the channel that shows it best."""
    alone = [table[frozenset([name])] for table in shown]
    rmse, rmse_with = _rmse_db([table[_SOUND] for table in shown]), _rmse_db(alone)
    trial, channels = alone[0].trials[0], tuple(model.evidence.name for model in alone)
    where = channels[0] if len(channels) == 1 else f"{len(channels)} channels"
    value, low, high = trial.estimate
    return Cause(
        name=name,
        sentence=f"Likely cause at {where}: {trial.sentence}; RMSE {rmse:.1f} \N{RIGHTWARDS ARROW} {rmse_with:.1f} dB.",
        next_step=trial.next_step,
        estimate=value,
        ci95=(low, high),
        channels=channels,
        rmse_db=rmse,
        rmse_with_db=rmse_with,
        gain=gain,
    )


_ANGLES = ("uav_azimuth_deg", "tower_azimuth_deg")


def _binned(evidence: LevelEvidence) -> LevelEvidence | None:
    """Means over :data:`BIN_S` of the samples with both levels; None where they are too few."""
    finite = np.isfinite(evidence.measured_db) & np.isfinite(evidence.predicted_db)
    if not finite.any():
        return None
    time, level = evidence.time_s[finite], evidence.measured_db[finite]
    width = max(BIN_S, float(np.ptp(time)) / _MOST_BINS)
    _, place = np.unique(np.floor(time / width), return_inverse=True)
    count = np.bincount(place).astype(np.float64)
    if len(count) < _FEWEST_BINS:
        return None

    def mean(values: FloatArray) -> FloatArray:
        values = values[finite]
        return np.asarray(np.bincount(place, values) / count)

    def binned(name: str, value: object) -> object:
        if isinstance(value, Mapping):
            return {key: mean(column) for key, column in value.items()}
        if not isinstance(value, np.ndarray):
            return value
        if name not in _ANGLES:
            return mean(np.nan_to_num(value, nan=1.0) if name in ("locked", "serving") else value)
        turn = np.exp(1j * np.radians(value))
        return np.degrees(np.angle(mean(turn.real) + 1j * mean(turn.imag)))

    changed = {f.name: binned(f.name, getattr(evidence, f.name)) for f in dataclasses.fields(evidence)}
    for name, end in (("least", level.min()), ("greatest", level.max())):
        at = level == end
        often = at.sum() >= max(_AT_END, _SHARE_AT_END * len(level))
        changed[name] = np.bincount(place, at) > 0.5 * count if often else None
    return LevelEvidence(**changed)  # type: ignore[arg-type]


# A receiver that clips writes one level in so many samples, and in so large a share of them.
_AT_END, _SHARE_AT_END = 10, 0.01


def _fitted(e: LevelEvidence, *trials: Trial) -> _Fit:
    """Best offset and coefficients with some troubles, under first-order autoregressive noise, its memory searched."""
    target = e.measured_db - e.predicted_db
    clipped = np.zeros(len(target), dtype=np.bool_)
    columns = []
    for trial in trials:
        target = target if trial.change_db is None else target - trial.change_db
        clipped = clipped if trial.clipped is None else clipped | trial.clipped
        columns += [] if trial.columns is None else [trial.columns]
    design = np.column_stack([np.ones(len(target)), *columns])
    if not clipped.any():
        return _autoregressive(target, design)
    inside = np.where(clipped, e.measured_db, target)
    design = np.column_stack([np.where(clipped[:, None], 0.0, design), clipped])
    rough = inside - design @ np.linalg.lstsq(design, inside, rcond=None)[0]
    spread = np.where(clipped, rough[clipped].std(), rough[~clipped].std() if (~clipped).any() else 1.0)
    spread = spread.clip(_LEAST_SPREAD_DB)
    fit = _autoregressive(inside / spread, design / spread[:, None])
    return _Fit(fit.log_likelihood - float(np.log(spread).sum()), fit.residual_db * spread)


_LEAST_SPREAD_DB = 0.2


def _autoregressive(residual: FloatArray, design: FloatArray) -> _Fit:
    n, best = len(residual), _Fit(-math.inf, residual)
    for phi in _PHI.tolist():
        root = math.sqrt(1.0 - phi**2)
        white_y = np.concatenate(([root * residual[0]], residual[1:] - phi * residual[:-1]))
        white_x = np.concatenate((root * design[:1], design[1:] - phi * design[:-1]))
        coefficients = np.linalg.lstsq(white_x, white_y, rcond=None)[0]
        variance = float(np.mean((white_y - white_x @ coefficients) ** 2))
        likelihood = -0.5 * n * math.log(max(variance, 1e-12)) + math.log(root)
        if likelihood > best.log_likelihood:
            best = _Fit(likelihood, residual - design @ coefficients)
    return _Fit(best.log_likelihood, best.residual_db - best.residual_db.mean())


# --- the troubles --------------------------------------------------------------------------------------------------


def _clock(e: LevelEvidence) -> Iterator[Trial]:
    """The lag that the judgement of the radio clock has, and no other."""
    if e.clock is not None and e.clock.shifted:
        lag = e.clock.radio_minus_telemetry_s
        late = np.interp(e.time_s - lag, e.time_s, e.predicted_db)
        yield Trial(
            name="clock", cost=1.0, sentence=f"the radio clock is {e.clock.in_words}", next_step="`rss: {lag: apply}`",
            change_db=late - e.predicted_db, estimate=(lag, *e.clock.ci95_s),
        )  # fmt: skip


def _profiled(e: LevelEvidence, trials: Mapping[float, Trial]) -> Trial:
    """The best of some values, and the range of those that are nearly as likely, half way to the next that are not."""
    likelihood = {value: _fitted(e, trial).log_likelihood for value, trial in trials.items()}
    best, tried = max(likelihood, key=lambda value: likelihood[value]), sorted(trials)
    near = [i for i, value in enumerate(tried) if likelihood[value] >= likelihood[best] - _NEAR]
    low, high = max(near[0] - 1, 0), min(near[-1] + 1, len(tried) - 1)
    ends = 0.5 * (tried[near[0]] + tried[low]), 0.5 * (tried[near[-1]] + tried[high])
    return dataclasses.replace(trials[best], estimate=(best, *ends))


# An angle, and that it is looked for all around.
_HEADING_COST = 2.0


def _heading(e: LevelEvidence) -> Iterator[Trial]:
    """An antenna turned about the vertical."""
    if not e.turned_db:
        return
    turns = {
        angle: Trial(
            name="heading", cost=_HEADING_COST, change_db=change,
            next_step="check the antenna's mount and the logged yaw",
            sentence=f"the UAV antenna is turned clockwise by {angle:.0f} degrees",
        )
        for angle, change in e.turned_db.items()
    }  # fmt: skip
    best = _profiled(e, turns)
    yield best
    # a turned antenna leaves nothing that depends on the direction: what does is another antenna
    yield dataclasses.replace(_pattern_trial(e), cost=_HEADING_COST + _PATTERN_COST, change_db=best.change_db)


def _attitude(e: LevelEvidence) -> Iterator[Trial]:
    """An attitude that the settings do not use, or should not."""
    for mode, change in e.attitude_db.items():
        idle = mode != "ignored"  # a log that is not used has no free number
        yield Trial(
            name="attitude",
            cost=float(not idle),
            sentence="the UAV's attitude is not used" if idle else "the logged attitude does not fit the level",
            next_step=f"`rt: {{attitude: {mode}}}`",
            change_db=change,
        )


def _height(e: LevelEvidence) -> Iterator[Trial]:
    """Heights of another datum."""
    if e.raised_db:
        trials = {
            rise: Trial(
                name="height", cost=1.0, change_db=change,
                sentence=f"the UAV flew about {abs(rise):.0f} m {'higher' if rise > 0 else 'lower'} than the log says",
                next_step="check the telemetry's height datum",
            )
            for rise, change in e.raised_db.items()
        }  # fmt: skip
        yield _profiled(e, trials)


def _tower(e: LevelEvidence) -> Iterator[Trial]:
    """The log of another tower."""
    for name, level in e.other_towers_db.items():
        yield Trial(
            name="tower", cost=1.0, sentence=f"the log is that of {name}", next_step=f"`node: {name}` for this log",
            change_db=level - e.predicted_db,
        )  # fmt: skip


_PATTERN_COST = 6.0

_PATTERN = {
    "isotropic": (
        "the antenna pattern of the UAV",
        "`aerpaw-cmp calibrate`",
    ),
    "measured": (
        "the antenna file does not fit the UAV",
        "check `antenna:` of this link, else `aerpaw-cmp calibrate`",
    ),
    "learned": (
        "the learned antennas do not fit this UAV",
        "check which aircraft flew, else `aerpaw-cmp calibrate` with it",
    ),
}


def _pattern_trial(e: LevelEvidence) -> Trial:
    sentence, step = _PATTERN[e.antenna]
    return Trial(name="pattern", cost=_PATTERN_COST, sentence=sentence, next_step=step, columns=_harmonics(e))


def _pattern(e: LevelEvidence) -> Iterator[Trial]:
    """A smooth gain over the directions of the UAV's antenna."""
    yield _pattern_trial(e)


def _harmonics(e: LevelEvidence) -> FloatArray:
    azimuth, elevation = np.radians(e.uav_azimuth_deg), np.radians(e.uav_elevation_deg)
    columns = [wave(k * azimuth) for k in (1, 2) for wave in (np.cos, np.sin)]
    columns += [np.sin(elevation), np.sin(elevation) ** 2]
    return np.column_stack([column - column.mean() for column in columns])


def _cell(e: LevelEvidence) -> Iterator[Trial]:
    """A level that changes where another cell serves."""
    if e.serving is not None and np.ptp(e.serving) > 0.5:
        yield Trial(
            name="cell", cost=1.0, sentence="the level steps where the phone changes its cell",
            next_step="compare the cells apart", columns=e.serving[:, None],
        )  # fmt: skip


# --- troubles of the receiver ----------------------------------------------------------------------------------------


def _lock(e: LevelEvidence) -> Iterator[Trial]:
    """Noise that the receiver writes without its lock, by the quality in the log."""
    if e.locked is not None and (lost := e.locked < 0.5).any():
        yield Trial(
            name="lock", cost=2.0, clipped=lost,
            sentence=f"the receiver had lost its lock in {100 * lost.mean():.0f} % of the seconds",
            next_step="trust the error with the floor",
        )  # fmt: skip


def _no_detection(e: LevelEvidence) -> Iterator[Trial]:
    """The least level, written again and again: nothing was detected there."""
    if e.least is not None and e.least.any() and not e.least.all():
        level, share = float(e.measured_db[e.least].min()), 100 * e.least.mean()
        yield Trial(
            name="no detection", cost=2.0, clipped=e.least, estimate=(level, level, level),
            sentence=f"{share:.0f} % of the samples are at {Printed(level):.0f} {e.unit}: nothing was detected",
            next_step=f"`floor_db: {math.ceil(level * 100.0 + 1.0) / 100.0:.2f}` for this log",
        )  # fmt: skip


def _floor(e: LevelEvidence) -> Iterator[Trial]:
    """A receiver that shows no level below its floor; what it shows there spreads less."""
    if e.least is None:  # else the log itself says where nothing was detected
        yield from _clipping(e, 1.0)


def _saturation(e: LevelEvidence) -> Iterator[Trial]:
    """A receiver that shows no level above its ceiling."""
    yield from _clipping(e, -1.0)


# Of clipped samples: so many lie further beyond the limit [dB], and they spread by at most so much of the others.
_BEYOND_DB, _MOST_BEYOND, _MOST_SPREAD = 2.0, 0.02, 0.6
_FAR_DB, _LEAST_FAR = 3.0, 0.1
_LEAST_BINS = 5


def _clipping(e: LevelEvidence, side: float) -> Iterator[Trial]:
    """Limits below (``side`` 1) or above (-1) which a receiver shows no level: hard ones, and soft ones."""
    limits = np.quantile(e.measured_db, np.linspace(0.02, 0.7, 18) if side > 0 else np.linspace(0.98, 0.3, 18))
    for limit_of in (_clipped, _bent):
        trials = {limit: trial for limit in limits.tolist() if (trial := limit_of(e, limit, side)) is not None}
        if trials:
            yield _profiled(e, trials)


def _limited(e: LevelEvidence, limit: float, side: float) -> Trial | None:
    """A limit with its words; None where what is measured beyond it shows that nothing is clipped."""
    if (side * (e.measured_db - limit) < -_BEYOND_DB).mean() > _MOST_BEYOND:
        return None
    name, words, step = _LIMITS[side]
    sentence, next_step = words.format(level=f"{Printed(limit):.0f} {e.unit}"), step.format(typed=f"{limit:.0f}")
    return Trial(name=name, cost=2.0, sentence=sentence, next_step=next_step)


def _clipped(e: LevelEvidence, limit: float, side: float) -> Trial | None:
    """Samples beyond a limit, which spread less there."""
    gap = e.measured_db - e.predicted_db
    offset = float(np.median(gap))
    for _ in range(4):
        free = side * (e.predicted_db + offset - limit) > 0.0
        if min(free.sum(), (~free).sum()) < _LEAST_BINS:
            return None
        offset = float(np.mean(gap[free]))
    if float(e.measured_db[~free].std()) > _MOST_SPREAD * gap[free].std():
        return None
    trial = _limited(e, limit, side)
    return None if trial is None else dataclasses.replace(trial, clipped=~free)


def _bent(e: LevelEvidence, limit: float, side: float) -> Trial | None:
    """Levels to which the power of a limit adds, or which come no nearer than that to a ceiling."""
    offset = float(np.median(e.measured_db - e.predicted_db))
    for _ in range(8):
        level = e.predicted_db + offset
        shown = limit + side * 10.0 * np.log10(1.0 + 10.0 ** (side * (level - limit) / 10.0))
        offset += float(np.mean(e.measured_db - shown))
    trial = _limited(e, limit, side)
    # a prediction that fades too deep here and there meets no limit of the receiver
    if trial is None or (side * (limit - level) > _FAR_DB).mean() < _LEAST_FAR:
        return None
    return dataclasses.replace(trial, change_db=shown - level)


_LIMITS = {
    1.0: ("floor", "the receiver shows no level below {level}", "`floor_db: {typed}` for this log"),
    -1.0: ("saturation", "the receiver shows no level above {level}", "lower the gain; trust lower levels alone"),
}


# --- troubles of a part of the flight --------------------------------------------------------------------------------


def _shift(residual: FloatArray, masks: BoolArray, phi: float) -> tuple[FloatArray, FloatArray]:
    """Shift inside each mask (m, n), and the squares that it takes off the whitened residual, offset fitted."""
    y = residual[1:] - phi * residual[:-1]
    x = masks[:, 1:].astype(np.float64) - phi * masks[:, :-1]
    y, x = y - y.mean(), x - x.mean(axis=1, keepdims=True)
    power = np.einsum("ij,ij->i", x, x)
    shift = np.divide(x @ y, power, out=np.zeros(len(x)), where=power > 1e-9)
    return shift, shift**2 * power


def _bounded(residual: FloatArray, mask: BoolArray, shift: float, phi: float) -> _Estimate:
    """A shift inside a mask with its 95 % interval."""
    y, x = residual[1:] - phi * residual[:-1], mask[1:].astype(np.float64) - phi * mask[:-1]
    y, x = y - y.mean(), x - x.mean()
    half = 1.96 * math.sqrt(float(np.mean((y - shift * x) ** 2)) / float(x @ x))
    return shift, shift - half, shift + half


_SEARCHED_PHI = (0.5, 0.8, 0.95)
_WIDTHS_DEG = (10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 90.0)
_MOST_STARTS = 600


def _blocked(e: LevelEvidence) -> Iterator[Trial]:
    """A loss in a sector of directions from the tower: searched by 5 degrees, then by one."""
    residual = e.measured_db - e.predicted_db
    coarse = [(first, width) for width in _WIDTHS_DEG for first in np.arange(0.0, 360.0, 5.0).tolist()]
    for phi in _SEARCHED_PHI:
        sector = _best_sector(e, residual, coarse, phi)
        if sector is None:
            continue
        around = [(sector[0] + i, max(sector[1] + j, 2.0)) for i in range(-6, 7) for j in range(-8, 9)]
        first, width = _best_sector(e, residual, around, phi) or sector
        mask = (e.tower_azimuth_deg - first) % 360.0 < width
        shift = float(_shift(residual, mask[None, :], phi)[0][0])
        value, low, high = _bounded(residual, mask, shift, phi)
        yield Trial(
            name="blocked", cost=3.0, columns=mask[:, None].astype(np.float64), estimate=(-value, -high, -low),
            sentence=f"a loss of {-value:.0f} dB towards {first % 360:.0f} to {(first + width) % 360:.0f} degrees",
            next_step="add to the site what stands there",
        )  # fmt: skip


def _best_sector(
    e: LevelEvidence, residual: FloatArray, sectors: Sequence[tuple[float, float]], phi: float
) -> tuple[float, float] | None:
    """Start and width [deg] of the sector whose loss takes off most; None where no sector has a loss."""
    turned = {first: (e.tower_azimuth_deg - first) % 360.0 for first in {first for first, _ in sectors}}
    masks = np.array([turned[first] < width for first, width in sectors])
    shift, gain = _shift(residual, masks, phi)
    inside = masks.sum(axis=1)
    possible = (inside >= _LEAST_BINS) & (masks.shape[1] - inside >= _LEAST_BINS) & (shift < 0.0)
    return sectors[int(np.argmax(np.where(possible, gain, -1.0)))] if possible.any() else None


def _gain_step(e: LevelEvidence) -> Iterator[Trial]:
    """A shift that lasts from an instant to the end."""
    residual, n = e.measured_db - e.predicted_db, len(e.time_s)
    starts = np.arange(_LEAST_BINS * 2, n - _LEAST_BINS * 2)
    if not len(starts):
        return
    starts = starts[:: 1 + len(starts) // _MOST_STARTS]
    masks = np.arange(n)[None, :] >= starts[:, None]
    for phi in _SEARCHED_PHI:
        shift, gain = _shift(residual, masks, phi)
        at = int(np.argmax(gain))
        instant = (e.start + np.timedelta64(round(float(e.time_s[starts[at]])), "s")).astype("datetime64[s]")
        step = _bounded(residual, masks[at], float(shift[at]), phi)
        yield Trial(
            name="gain step", cost=2.0, columns=masks[at][:, None].astype(np.float64), estimate=step,
            sentence=f"the level steps by {Printed(step[0]):+.1f} dB at {str(instant)[-8:]} UTC",
            next_step="check the receiver's gain; compare both parts apart",
        )  # fmt: skip


CANDIDATES: tuple[Callable[[LevelEvidence], Iterator[Trial]], ...] = (
    _clock, _heading, _attitude, _height, _tower, _pattern, _cell,
    _lock, _no_detection, _floor, _saturation, _blocked, _gain_step,
)  # fmt: skip

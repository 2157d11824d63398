"""Likely cause of a level error: the most likely fault of the log, its settings or the site.

Each fault changes the predicted level in one of three ways: by known decibels, by columns with free coefficients, or at
samples that the receiver clipped. The level of clipped samples is predicted by their own mean, and they fade less than
other samples. The offset is fitted as well. The residual is modelled as noise with a long and a short correlation time,
so that slow fading is not mistaken for a fault.

An explanation is a single fault or a pair, and the second fault of a pair is searched for in the residual after the
first. Explanations are compared by their marginal likelihood over all channels. Coefficients, angles, heights,
positions and times are averaged over their possible values, which penalises explanations with many free numbers. A
fault is named if the explanations that contain it are likelier than all others by a margin, and if it reduces the RMSE
enough. A paired test of two models is not used, because it would need flights much longer than the duration of a fault.

A new fault is a function that yields its :class:`Trial`, and an entry of :data:`CANDIDATES`.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations, combinations_with_replacement

import numpy as np

from ..common.units import AnyArray, BoolArray, FloatArray, Printed, wrap_degrees
from .evidence import EPOCH, LEAST_BINS, MOST_FADING, PILE_DB, LevelEvidence, in_bins
from .health import Judged, Step, level_of, step_of
from .noise import (
    LEAST_VARIANCE,
    START,
    Columns,
    NoiseFit,
    NoiseParameters,
    fit_under_noise,
    log_likelihoods,
    shifts_in_masks,
    squares_of_halves,
)
from .result import Cause
from .statistics import is_flat

# Prior and limit of the log odds: a fault occurs in one of ten flights, and is named if its odds are at least five to
# one.
_SELDOM, _MARGIN = math.log(10.0), math.log(5.0)
# Largest number of words in the sentence and the next step of a cause, because the first paragraph of a page has at
# most sixty words.
MOST_CAUSE_WORDS = 28
# A cause must reduce the RMSE by this share. Half of the share suffices if the log odds per channel reach the second
# number: correcting a floor, for example, does not change the error of the levels above the floor. An unnamed cause
# with such odds shows that none of the explanations is right.
_LEAST_SHARE, _CERTAIN = 0.1, 30.0
# The sentence states the RMSE without and with the cause. As printed, the two numbers must differ by this [dB].
SHOWN_DB = 0.1
# Half of the 95 % point of chi-squared with one degree of freedom.
_NEAR = 1.92
_UNNAMED = ""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A possible fault with given numbers, its effect on the predicted level, and its sentence in the report.

    ``change_db`` (n,) is added to the predicted level. ``columns`` (n, k) have free coefficients with a unit normal
    prior. ``clipped`` (n,) marks samples whose level does not depend on the link. ``fading`` (n,) is the share of the
    link's fading that the log shows. ``cost`` is the log likelihood lost by averaging over all possible numbers. A
    trial without a name is an alternative that is not named as a cause.

    Parameters
    ----------
    channels : int
        Number of channels of the tower that have the same fault with the same numbers, and share the cost of its
        search.
    """

    name: str = _UNNAMED
    cost: float = 0.0
    sentence: str = ""
    next_step: str = ""
    change_db: FloatArray | None = None
    columns: FloatArray | None = None
    clipped: BoolArray | None = None
    fading: FloatArray | None = None
    estimate: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    channels: int = 1

    @cached_property
    def designs(self) -> tuple[Columns, ...]:
        """The columns as one object for many fits, which whiten them only once. Empty if the trial has no columns."""
        return () if self.columns is None else (Columns(self.columns),)


@dataclass(frozen=True, slots=True)
class _Model:
    """One explanation of a channel's error: its faults, and their gain in log likelihood minus their cost."""

    evidence: LevelEvidence
    trials: tuple[Trial, ...]
    residual_db: FloatArray
    gain: float
    parameters: NoiseParameters


_Models = Mapping[frozenset[str], _Model]
_SOUND: frozenset[str] = frozenset()


def flight_cause(channels: Sequence[LevelEvidence]) -> Cause | None:
    """Return the fault that explains the error of a flight.

    Parameters
    ----------
    channels : sequence of LevelEvidence

    Returns
    -------
    Cause or None
        None if no cause is identified.
    """
    known = [each for evidence in channels if (each := in_bins(evidence)) is not None]
    others = [tuple(other for other in known if other is not e and other.tower == e.tower) for e in known]
    tables = [_models(dataclasses.replace(e, others=of)) for e, of in zip(known, others, strict=True)]
    names = sorted({name for table in tables for names in table for name in names})
    odds: dict[frozenset[str], float] = {}
    for some in (_SOUND, *({name} for name in names), *map(set, combinations(names, 2))):
        models = [_best(table, some) for table in tables]
        used = frozenset().union(*map(_names, models))
        odds[used] = sum(model.gain for model in models) - _SELDOM * len(used) - _unpaid(models)
    best = max(odds, key=lambda some: odds[some])
    alternatives = _alternatives(best, odds, _MARGIN + math.log(max(len(channels), 1)))
    shown = {either: _channels_showing(either, best, tables) for either in alternatives}
    beside = certain = frozenset().union(*(either for either in alternatives if len(either) == 1))
    named = dict[frozenset[str], list[_Models]]()
    for _ in range(2):
        for either, showing in shown.items():
            if any(either <= pair for pair in named):
                continue
            lead = _lead(either, odds) / len(showing)
            # an almost certain cause may leave an error that only an uncertain second cause explains, so also judge
            # this cause together with the likeliest explanation
            apart = (beside, best) if lead >= _CERTAIN else (beside,)
            if any(all(_explains(other, showing, lead, rest - either) for other in either) for rest in apart):
                named[either] = showing
        rejected = certain - frozenset().union(*named)
        if not rejected:
            break
        # in the second pass, do not let a rejected cause explain a part of the error
        beside = certain - rejected
    # if an almost certain cause was rejected, no explanation fits, so do not name a gain over directions
    if any(_lead({other}, odds) >= _CERTAIN for other in rejected):
        named = {either: shown for either, shown in named.items() if CATCH_ALL not in either}
    if not named:
        return _by_health(None, tables)
    # a gain over directions comes last, because it can look like many faults
    either = min(named, key=lambda e: (CATCH_ALL in e, -sum(_best(table, e & best).gain for table in tables)))
    # if one of two causes is a fault of the UAV, this fault must be likely on all channels, including channels without
    # the other cause
    names = [
        name
        for name in _likeliest_first(either, best, odds)
        if not _conditions(name).of_uav or all(name in _names(_best(table, {name})) for table in tables)
    ]
    cause = _named(names, named[either], _lead(either, odds))
    return _by_health(cause, tables) if _OF_HEALTH & either else cause


def _likeliest_first(either: Set[str], best: Set[str], odds: Mapping[frozenset[str], float]) -> list[str]:
    """Return the names of causes, the likeliest first. The order of a set would change from run to run."""
    return sorted(either, key=lambda name: (name not in best, -_lead({name}, odds)))


def _channels_showing(either: Set[str], best: Set[str], tables: Sequence[_Models]) -> list[_Models]:
    """Return the channels that must show a cause (or one of two causes), the clearest first."""
    name = max(either & best)
    # an error of the UAV's height or attitude must appear on all channels, and an error of a tower's position on all
    # channels of this tower
    of_all = all(_conditions(each).of_uav for each in either)
    shown = [table for table in tables if of_all or name in _names(_best(table, best))]
    if any(_conditions(each).of_tower for each in either):
        towers = {table[_SOUND].evidence.tower for table in shown}
        shown = [table for table in tables if table[_SOUND].evidence.tower in towers]
    # the sentence quotes the channel that shows the cause most clearly
    return sorted(shown, key=lambda table: -_best(table, {name}).gain)


def _unpaid(models: Sequence[_Model]) -> float:
    """Return the part of the search cost that is charged to channels without the fault.

    All channels of a tower share the cost of a search for numbers that they have in common.
    """
    trials = [((model.evidence.tower, trial.name), trial) for model in models for trial in model.trials]
    users = Counter(cause for cause, _ in trials)
    return sum(max(trial.channels / users[cause] - 1.0, 0.0) * trial.cost for cause, trial in trials)


def _by_health(cause: Cause | None, tables: Sequence[_Models]) -> Cause | None:
    """Return the cause after a comparison of steps and offsets of the level with those of held-out flights.

    A fit within a flight cannot distinguish a step from slow fading. If the usual errors of all channels are known from
    held-out flights, they decide whether a step is named.
    """
    known = [(judged, table) for table in tables if (judged := _judged(table[_SOUND])) is not None]
    if not known:
        return cause
    channels = [judged for judged, _ in known]
    if (step := step_of(channels)) is not None and not _rivalled(step, known):
        instant = (EPOCH + np.timedelta64(round(step.at_s), "s")).astype("datetime64[s]")
        sizes = ", ".join(f"{Printed(size):+.1f} dB at {name}" for name, size in step.sizes_db.items())
        return Cause(
            name="gain step",
            channels=tuple(step.sizes_db),
            estimate=max(step.sizes_db.values(), key=abs),
            sentence=f"Likely cause: the level steps at {str(instant)[-8:]} UTC ({sizes}), unlike held-out flights.",
            next_step=_CHECK_GAIN,
        )
    if cause is not None:
        return None if cause.name == "gain step" and len(known) == len(tables) else cause
    # a changed cable or gain changes only the offset
    healthy = all(_rmse_db([table[_SOUND]]) <= judged.health.most_rmse_db for judged, table in known)
    if healthy and len(known) == len(tables) and (off := level_of(channels)) is not None:
        side = "higher" if off.difference_db > 0 else "lower"
        return Cause(
            name="level",
            channels=(off.name,),
            estimate=off.difference_db,
            next_step="check its receiver, cable, attenuator and gain",
            sentence=f"The level at {off.where} is {abs(off.difference_db):.0f} dB {side} than on held-out flights.",
        )
    return None


def _judged(sound: _Model) -> Judged | None:
    e = sound.evidence
    if e.learned is None or e.learned.health is None:
        return None
    return Judged(
        name=e.name, time_s=e.time_s, error_db=e.measured_db - e.predicted_db, learned=e.learned, unit=e.unit,
        transmit_power_dbm=e.transmit_power_dbm, start_s=float((e.start - EPOCH) / np.timedelta64(1, "s")),
    )  # fmt: skip


def _rivalled(step: Step, known: Sequence[tuple[Judged, _Models]]) -> bool:
    """Check whether another cause explains the error as well as a step, given the noise of held-out flights."""
    squares: dict[str, float] = {}
    for channel, table in known:
        before = channel.square(channel.error_db)
        for names, model in table.items():
            if len(names) == 1 and "gain step" not in names:
                columns = sum(0 if trial.columns is None else trial.columns.shape[1] for trial in model.trials)
                # even a free coefficient without a real effect reduces the sum of squares by 1 on average
                fall = before - channel.square(model.residual_db) - columns
                squares[max(names)] = squares.get(max(names), 0.0) + max(fall, 0.0)
    return max(squares.values(), default=0.0) > step.chi2 - _RARE


def _lead(names: Set[str], odds: Mapping[frozenset[str], float]) -> float:
    """Return the log odds of explanations with at least one of some causes against explanations without them."""
    with_it, without = ([odds[some] for some in odds if bool(some & names) == side] for side in (True, False))
    return float(np.logaddexp.reduce(with_it) - np.logaddexp.reduce(without)) if with_it else -math.inf


def _alternatives(best: Set[str], odds: Mapping[frozenset[str], float], least: float) -> list[frozenset[str]]:
    """Return causes that are likelier than all others by a margin. Pairs that cannot be distinguished come first."""
    out = []
    leads = {name: _lead({name}, odds) for name in sorted(best - {_UNNAMED})}
    certain = {name for name, lead in leads.items() if lead >= least + 2.0 * _DISTINCT}
    for name, lead in leads.items():
        if lead >= least:
            out.append(frozenset({name}))
        others = {other for some in odds for other in some} - {name, _UNNAMED, *certain}
        rival = max(others, key=lambda other: _lead({name, other}, odds), default="")
        if rival and lead < least + _DISTINCT and _lead({name, rival}, odds) >= least:
            out.append(frozenset({name, rival}))
    return sorted(out, key=lambda either: -len(either))


# If the log odds of a cause exceed the margin by less than this, the next cause is also named, if it explains the
# error.
_DISTINCT = 1.7


@dataclass(frozen=True, slots=True, kw_only=True)
class _Conditions:
    """The conditions that a cause must meet before it is named.

    Parameters
    ----------
    lead : float
        Smallest log odds per channel against all explanations without the cause.
    share : float
        Smallest reduction of the RMSE, as a share.
    learned_share : float
        The same for flights with learned antennas, which all have an error of a few decibels.
    part : float
        Smallest reduction of the error that remains after the other causes, as a share of the reduction by all
        candidates. This condition applies only to flights without learned antennas.
    of_uav : bool
        True if the cause changes the levels of all channels.
    of_tower : bool
        True if the cause changes the levels of all channels of a tower.
    follows : float, optional
        Largest remaining error as a share of the error of a constant level, which fits a log of noise best.
    most_left : float
        Largest remaining error, as a multiple of the largest error of a held-out flight.
    """

    lead: float = -math.inf
    share: float = 0.1
    learned_share: float = 0.0
    part: float = 0.0
    of_uav: bool = False
    of_tower: bool = False
    follows: float | None = None
    most_left: float = 2.0


_CONDITIONS = {
    "attitude": _Conditions(of_uav=True),
    # a high limit, because slow fading looks like a weak shadow; an obstacle shadows all channels of the tower
    "blocked": _Conditions(share=0.2, of_tower=True),
    "channels": _Conditions(part=0.5, most_left=1.0),
    "clock": _Conditions(part=0.5, most_left=1.0),
    "decibels": _Conditions(most_left=math.inf),
    "exponent or decibels": _Conditions(part=0.5, of_uav=True, follows=0.9, most_left=math.inf),
    "gain step": _Conditions(lead=2.5, part=0.7),
    "heading": _Conditions(learned_share=0.25, part=0.5, of_uav=True, most_left=1.0, follows=0.9),
    "height": _Conditions(part=0.5, of_uav=True, most_left=1.0, follows=0.9),
    "pattern": _Conditions(lead=3.0, learned_share=0.25, part=0.5, most_left=1.0, follows=1.0),
    # high limits, because the best of many positions explains a part of many errors
    "place": _Conditions(lead=4.5, share=0.3, part=0.75, of_tower=True, most_left=1.0, follows=0.9),
    "saturation": _Conditions(part=0.5, most_left=1.0),
    # a high limit, because an antenna pattern that is not modelled can also reverse the slope
    "sign": _Conditions(share=0.5, follows=0.9),
    "telemetry": _Conditions(part=0.5, of_uav=True, most_left=1.0, follows=0.9),
    "tower": _Conditions(part=0.65, follows=1.0, most_left=math.inf),
}


def _conditions(name: str) -> _Conditions:
    return _CONDITIONS.get(name, _Conditions())


def _explains(name: str, shown: Sequence[_Models], lead: float, beside: Set[str]) -> bool:
    """Check whether a cause lowers the RMSE by the required amount on the channels that show it.

    ``beside`` are the other causes of the likeliest explanation.
    """
    need, sound = _conditions(name), [table[_SOUND] for table in shown]
    if not all(frozenset([name]) in table for table in shown):
        return False
    alone = [table[frozenset([name])] for table in shown]
    # the cause alone must reduce the RMSE, not only the differences between neighbouring samples
    if (need.of_uav or need.of_tower) and any(model.gain <= 0.0 for model in alone):
        return False
    known_db, alone_db = _rmse_db(sound), _rmse_db(alone)
    before_db, after_db = (_rmse_db([_best(table, of) for table in shown]) for of in (beside, {*beside, name}))
    if lead < need.lead or known_db - alone_db < SHOWN_DB or not before_db:
        return False
    # another cause may hide how much an almost certain cause reduces the total error
    hidden = bool(beside) and lead >= _CERTAIN
    share = after_db / before_db if hidden else max(alone_db / known_db, after_db / before_db)
    least_share = max(need.share, need.learned_share * (sound[0].evidence.antenna == "learned"))
    certain = lead >= _CERTAIN and least_share <= _LEAST_SHARE and share <= 1.0 - 0.5 * _LEAST_SHARE
    if need.follows and any(m.residual_db.std() >= need.follows * m.evidence.measured_db.std() for m in alone):
        return False
    usual = _usual_db(shown)
    most = _MOST_IN_HALVES[usual is not None or alone_db <= _MOST_OF_ERROR * known_db]
    if name == CATCH_ALL and (known_db < _LEAST_DB or (lead < _SURE_GAIN and not _holds_in_halves(alone, most))):
        return False
    # the settings already remove samples at this floor. Weak links that remain look too strong, because only their
    # upward fading is above the floor.
    if name == "floor" and sound[0].evidence.floored:
        return False
    if usual is None:
        # if a cause is almost certain, attribute to fading what all candidates together remove beyond the likeliest
        # explanation
        likeliest = [max(table.values(), key=lambda model: model.gain) for table in shown]
        left_db = _together_db(shown) if lead < _CERTAIN else _rmse_db(likeliest)
        enough = not need.part or after_db <= before_db - need.part * (before_db - left_db)
    else:
        # do not name such a cause for an error that held-out flights also have
        least_db = usual[1] if name in OF_DIRECTION else usual[0] if name == "saturation" and not certain else 0.0
        enough = known_db > least_db and alone_db <= need.most_left * usual[1]
    return enough and (share <= 1.0 - least_share or certain)


def _holds_in_halves(models: Sequence[_Model], most: float) -> bool:
    """Check whether a gain over directions, fitted to one half of the flight, reduces the error of the other half."""
    pairs = ((m.evidence.measured_db - m.evidence.predicted_db, m.trials[0].columns) for m in models)
    squares = [squares_of_halves(error, columns, _CORRELATED_BINS) for error, columns in pairs if columns is not None]
    before, after = np.sum(squares, axis=0)
    return bool(after <= most**2 * before)


# A gain is fitted to one half of the flight and tested on the other half, where the RMSE with the gain must be at most
# the first share of the RMSE without it. The second share is used instead with learned antennas, or if the RMSE of the
# complete flight with the gain is at most the third share of the RMSE without it. A gain is then plausible although it
# fits the other half less well, because each half of a short flight contains few directions.
_MOST_IN_HALVES, _MOST_OF_ERROR = (0.75, 0.85), 0.5
# Number of consecutive means that count as one independent sample of the error. The two halves may contain different
# directions, so the test of halves is skipped if the log odds per channel reach the second number. Even learned
# antennas have an error of 3 dB and more, so a pattern is not the cause of an error below the last number [dB].
_CORRELATED_BINS, _SURE_GAIN, _LEAST_DB = 10.0, 20.0, 2.5


def _usual_db(shown: Sequence[_Models]) -> tuple[float, float] | None:
    """Return the usual and the largest usual RMSE of held-out flights [dB]. None without learned antennas."""
    learned = [table[_SOUND].evidence.learned for table in shown]
    usual = [(of.health.rmse_db, of.health.most_rmse_db) for of in learned if of is not None and of.health is not None]
    if len(usual) < len(shown):
        return None
    mean_db, most_db = np.sqrt(np.mean(np.square(usual), axis=0)).tolist()
    return mean_db, most_db


def _together_db(shown: Sequence[_Models]) -> float:
    """Return the RMSE of some channels with all candidates at once, each with a free coefficient [dB]."""
    squares = []
    for table in shown:
        e = table[_SOUND].evidence
        columns = [np.ones(len(e.time_s))]
        for trial in (model.trials[0] for names, model in table.items() if len(names) == 1):
            columns += [] if trial.change_db is None else [trial.change_db]
            columns += [] if trial.columns is None else list(trial.columns.T)
        design, target = np.column_stack(columns), e.measured_db - e.predicted_db
        # omit infinite levels, because a candidate position of the tower may coincide with the UAV
        design = design[:, np.isfinite(design).all(axis=0)]
        residual = target - design @ np.linalg.lstsq(design, target, rcond=1e-9)[0]
        squares.append((residual**2).sum() / max(len(target) - design.shape[1], 1))
    return math.sqrt(float(np.mean(squares)))


def gains_by_direction(channels: Iterable[LevelEvidence]) -> bool:
    """Check whether a calibration could reduce the printed error of a channel, by a gain over directions."""
    for evidence in filter(None, map(in_bins, channels)):
        sound, (antenna,) = _fitted(evidence), _pattern(evidence)
        learned = _fitted(evidence, antenna, at=sound.parameters)
        fall_db = float(min(sound.residual_db.std(), evidence.measured_db.std()) - learned.residual_db.std())
        if learned.log_likelihood > sound.log_likelihood + _SELDOM and fall_db >= SHOWN_DB:
            return True
    return False


def _names(model: _Model) -> frozenset[str]:
    return frozenset(trial.name for trial in model.trials)


def _best(table: _Models, faults: Set[str]) -> _Model:
    """Return the best model of a channel that contains no other faults than ``faults``."""
    return max((model for names, model in table.items() if names <= faults), key=lambda model: model.gain)


# Number of faults per channel that are combined in pairs, and number of faults whose residual is searched for a second
# fault.
_MOST_TRIED, _MOST_FIRST = 6, 2


def _models(e: LevelEvidence) -> _Models:
    """Return the likeliest model of each fault, and of pairs of the likeliest faults."""
    sound = _fitted(e)

    def model(*trials: Trial, at: NoiseParameters = sound.parameters, search: bool = True) -> _Model:
        fit = _fitted(e, *trials, at=at, search=search)
        cost = sum(trial.cost for trial in trials)
        gain = fit.log_likelihood - sound.log_likelihood - cost
        return _Model(e, trials, fit.residual_db, gain, fit.parameters)

    def best_of(sets: Iterable[tuple[Trial, ...]], at: NoiseParameters) -> list[_Model]:
        """Return the likeliest model of each set of names, best first, with its own noise.

        Trials without a name that change levels are kept apart from trials without a name that add columns, because the
        parameters of the noise can decide which of these two kinds is likelier.
        """
        best: dict[tuple[frozenset[str], bool], _Model] = {}
        for trials in sets:
            tried = model(*trials, at=at, search=False)
            names, last = _names(tried), trials[-1]
            kind = names, not last.name and last.columns is not None
            if len(names) == len(trials) and (kind not in best or tried.gain > best[kind].gain):
                best[kind] = tried
        likely = sorted(best.values(), key=lambda m: -m.gain)[:_MOST_TRIED]
        return sorted((model(*m.trials, at=at) for m in likely), key=lambda m: -m.gain)

    alone = best_of(((trial,) for trial in _candidates(e)), sound.parameters)
    models, likely = [model(search=False), *alone], [m for m in alone[:_MOST_FIRST] if m.gain > 0.0]
    pairs = [pair for pair in combinations(alone, 2) if pair[0].gain > 0.0]
    models += [model(first.trials[0], second.trials[0], at=first.parameters) for first, second in pairs]
    # if half or twice the decibels is a candidate, skip slopes without a name, which would explain the same error
    named = any(m.gain > 0.0 and _names(m) & {"decibels", "exponent or decibels", "sign"} for m in alone)
    for first in likely:
        rest = [trial for trial in _candidates(_without(e, first)) if trial.name or not named]
        further = best_of(((first.trials[0], second) for second in rest), first.parameters)
        models += [*further, *(model(m.trials[1], search=False) for m in further)]
    return {_names(m): m for m in sorted(models, key=lambda m: m.gain)}


def _candidates(e: LevelEvidence) -> Iterator[Trial]:
    return (trial for candidate in CANDIDATES for trial in candidate(e))


def _without(e: LevelEvidence, first: _Model) -> LevelEvidence:
    """Return the evidence with a fault corrected in its prediction."""
    predicted = e.measured_db - first.residual_db
    moved = predicted - e.predicted_db
    others = {name: level + moved for name, level in e.other_towers_db.items()}
    return dataclasses.replace(e, predicted_db=predicted, other_towers_db=others, others=())


def _rmse_db(models: Sequence[_Model]) -> float:
    return float(np.concatenate([model.residual_db - model.residual_db.mean() for model in models]).std())


def _named(names: Sequence[str], shown: Sequence[_Models], gain: float) -> Cause:
    """Return the cause with the sentence of the channel that shows it best.

    The data cannot distinguish the causes in ``names``.
    """
    name = names[0]
    trial = shown[0][frozenset([name])].trials[0]
    # omit channels with other numbers, for example from another clock, because the sentence would be wrong for them
    shown = [table for table in shown if table[frozenset([name])].trials[0].sentence == trial.sentence]
    alone = [table[frozenset([name])] for table in shown]
    rmse, rmse_with = _rmse_db([table[_SOUND] for table in shown]), _rmse_db(alone)
    channels = tuple(model.evidence.name for model in alone)
    where = channels[0] if len(channels) == 1 else f"{len(channels)} channels"
    others = [shown[0][frozenset([other])].trials[0].sentence for other in names[1:]]
    those = {1: channels[0], 2: "both"}.get(len(channels), "these channels")
    return Cause(
        name=" or ".join(names), channels=channels, estimate=trial.estimate[0], ci95=trial.estimate[1:],
        sentence=f"Likely cause at {where}: {', or '.join([trial.sentence, *others])}; "
        f"1-s RMSE {rmse:.1f} \N{RIGHTWARDS ARROW} {rmse_with:.1f} dB.",
        next_step=trial.next_step.replace(_CHANNELS, those), rmse_db=rmse, rmse_with_db=rmse_with, gain=gain,
    )  # fmt: skip


# The place in flight.yaml that a next step changes. The last word is replaced by the channels of the named cause.
_CHANNELS = "CHANNELS"
_IN_LOGS = f"in `logs:` for {_CHANNELS}"


def _fitted(e: LevelEvidence, *trials: Trial, at: NoiseParameters = START, search: bool = True) -> NoiseFit:
    """Fit offset and coefficients of some faults, with the given or with the likeliest noise."""
    target = e.measured_db - e.predicted_db
    clipped = np.zeros(len(target), dtype=np.bool_)
    shown = np.ones(len(target))
    for trial in trials:
        target = target if trial.change_db is None else target - trial.change_db
        clipped = clipped if trial.clipped is None else clipped | trial.clipped
        shown = shown if trial.fading is None else shown * trial.fading
    if clipped.all():
        return NoiseFit(-math.inf, target - target.mean(), START)
    link = ~clipped
    scale = shown[link]
    designs = [_offset(len(target)), *(of for trial in trials for of in trial.designs)]
    if not (link.all() and (scale == 1.0).all()):
        designs = [Columns(of.values[link] / scale[:, None]) for of in designs]
    fit = fit_under_noise(target[link] / scale, designs, at, search)
    likelihood, residual = fit.log_likelihood - float(np.log(scale).sum()), np.zeros(len(target))
    residual[link] = fit.residual_db * scale
    if clipped.any():  # clipped levels do not depend on the link
        residual[clipped] = e.measured_db[clipped] - e.measured_db[clipped].mean()
        # Schwarz's penalty for two fitted numbers, mean and standard deviation
        spread = max(float(residual[clipped].std()), _LEAST_SPREAD_DB)
        likelihood -= float(clipped.sum()) * (math.log(spread) + 0.5) + math.log(float(clipped.sum()))
    return NoiseFit(likelihood, residual, fit.parameters)


@lru_cache(maxsize=4)
def _offset(n: int) -> Columns:
    return Columns(np.full((n, 1), _OFFSET_DB))


_LEAST_SPREAD_DB = 0.2
# Standard deviation of an unknown offset [dB].
_OFFSET_DB = 100.0


# --- the faults --------------------------------------------------------------------------------------------------


def _clock(e: LevelEvidence) -> Iterator[Trial]:
    """Yield the lag that the clock test found, or the likeliest lag as an alternative without a name."""
    if e.clock is not None and e.clock.shifted:
        lag = e.clock.radio_minus_telemetry_s
        change_db = np.interp(e.time_s - lag, e.time_s, e.predicted_db) - e.predicted_db
        sentence, step = f"the radio clock is {e.clock.in_words}", "`rss: {lag: apply}`"
        estimate = lag, *e.clock.ci95_s
        yield Trial(name="clock", sentence=sentence, next_step=step, change_db=change_db, estimate=estimate)
    yield from _drifting(e)
    # also try the predicted levels of other times and in reverse order: a log with such an error would otherwise be
    # attributed to another cause
    since, length = e.time_s - e.time_s[0], max(float(np.ptp(e.time_s)), 1e-9)
    backwards = np.interp(length - since, since, e.predicted_db)
    channels = 1 + len(e.others)  # all channels share the telemetry, so they share the cost
    if _nearer(e, backwards):
        yield Trial(cost=_RARE / channels, channels=channels, change_db=backwards - e.predicted_db)
    if e.clock is not None and e.clock.shifted:
        return
    lags = np.append(_LAGS_S, np.arange(_LAGS_S[-1], length + _LAGS_S[0], 2.0 * _LAG_STEP_S))
    shifted = since - lags[:, None]
    shifted -= length * np.floor(shifted / length)
    levels = np.interp(shifted, since, e.predicted_db)
    if (nearer := _nearer(e, levels)).any():
        best, cost = _likeliest(e, levels, possible=nearer)
        yield Trial(cost=cost, change_db=levels[best] - e.predicted_db)


def _drifting(e: LevelEvidence) -> Iterator[Trial]:
    """Yield the likeliest constant drift of a radio clock that is right at one time of the flight."""
    if e.clock is None:
        return
    middle, length = 0.5 * (e.time_s[0] + e.time_s[-1]), float(np.ptp(e.time_s))
    rates = [r for r in _RATES if _LEAST_DRIFT_S <= abs(r) * length <= _MOST_DRIFT_S]
    pairs = [(rate, begin) for rate in rates for begin in _RIGHT_AT]
    if not pairs:
        return
    lags = [rate * (e.time_s - middle + (0.5 - begin) * length) for rate, begin in pairs]
    levels = np.interp(e.time_s - np.array(lags), e.time_s, e.predicted_db)
    if not (nearer := _nearer(e, levels)).any():
        return
    best, cost = _likeliest(e, levels, possible=nearer)
    rate = pairs[best][0]
    # do not name a rate at the end of the search range: the true rate may be larger, and no clock is that wrong
    yield Trial(
        name="clock" if abs(rate) < max(_RATES) else _UNNAMED,
        cost=_RARE + cost, change_db=levels[best] - e.predicted_db,
        sentence=f"the radio clock {'gains' if rate > 0 else 'loses'} {Printed(100.0 * abs(rate)):.1f} % "
        f"({abs(rate) * length:.0f} s in {length:.0f} s)",
        next_step="synchronise both clocks by GPS or NTP", estimate=(rate * length, math.nan, math.nan),
    )  # fmt: skip


# Relative rates of a clock, smallest and largest resulting error [s], and where in the flight the clock is right.
_RATES = np.outer([0.0025, 0.004, 0.006, 0.008, 0.01, 0.015, 0.02, 0.025, 0.03, 0.04, 0.05], [-1, 1]).ravel().tolist()
_LEAST_DRIFT_S, _MOST_DRIFT_S, _RIGHT_AT = 3.0, 60.0, (0.0, 0.25, 0.5)


def _likeliest(
    e: LevelEvidence, levels_db: FloatArray, *, weight: AnyArray | float = 1.0, possible: BoolArray | bool = True
) -> tuple[int, float]:
    """Return the index of the likeliest row of levels (m, n) under typically correlated noise, and the search cost.

    The prior probability of each level is proportional to ``weight``. Rows that are not ``possible`` are not chosen.
    """
    error = e.measured_db - levels_db
    left = error[:, 1:] - _SEARCHED_PHI[1] * error[:, :-1]
    gain = np.where(possible, -0.5 * left.shape[1] * np.log(left.var(axis=1) + LEAST_VARIANCE), -np.inf)
    return int(gain.argmax()), _concentration(gain, weight * np.ones(len(gain)))


def _nearer(e: LevelEvidence, level_db: FloatArray) -> BoolArray:
    """Check which levels (..., n) reduce the error, not only its changes from sample to sample."""
    error_db = (e.measured_db - e.predicted_db).std()
    return np.asarray((e.measured_db - level_db).std(axis=-1) <= (1.0 - _LEAST_SHARE) * error_db)


# Lags that are tried if the clock test did not find a lag [s]. Larger lags are tried with twice the step.
_LAG_STEP_S = 2.0
_LAGS_S = np.arange(-60.0, 61.0, _LAG_STEP_S)


def _profiled(e: LevelEvidence, trials: Mapping[float, Trial], at: NoiseParameters = START) -> Trial:
    """Return the trial with the likeliest value, and the range of values that are nearly as likely."""
    tried = sorted(trials)
    likelihood = _log_likelihoods(e, [trials[value] for value in tried], at)
    width = np.gradient(tried) if len(tried) > 1 else np.ones(1)
    best, cost = tried[int(likelihood.argmax())], _concentration(likelihood, width)
    near = np.flatnonzero(likelihood >= likelihood.max() - _NEAR)
    low, high = max(near[0] - 1, 0), min(near[-1] + 1, len(tried) - 1)
    ends = 0.5 * (tried[near[0]] + tried[low]), 0.5 * (tried[near[-1]] + tried[high])
    return dataclasses.replace(trials[best], estimate=(best, *ends), cost=trials[best].cost + cost)


def _log_likelihoods(e: LevelEvidence, trials: Sequence[Trial], at: NoiseParameters) -> FloatArray:
    """Return the log likelihood (m,) of each of some trials under given noise."""
    changes_db = [trial.change_db for trial in trials if trial.change_db is not None and trial.fading is None]
    if len(changes_db) < len(trials):
        return np.array([_fitted(e, trial, at=at, search=False).log_likelihood for trial in trials])
    residuals = np.column_stack([e.measured_db - e.predicted_db - change_db for change_db in changes_db])
    return log_likelihoods(residuals, [_offset(len(residuals))], at)


def _concentration(log_likelihood: FloatArray, width: FloatArray) -> float:
    """Return the log of the largest likelihood divided by the mean likelihood. The mean is weighted by ``width``."""
    top = log_likelihood.max()
    return -math.log(float(np.exp(log_likelihood - top) @ width / width.sum()))


# Positions of interpolated values around a given value, as a share of the distance to the neighbouring given value.
_BETWEEN = np.linspace(-0.8, 0.8, 9)


def _tuned(
    e: LevelEvidence, changes_db: Mapping[float, FloatArray], trial: Trial, words: Callable[[float], str]
) -> Trial:
    """Return the trial with the likeliest value. Changes at values between the given values are interpolated."""
    # the value 0 means no change, which is an exact point of the interpolation
    values = sorted({0.0, *changes_db})
    likely = _profiled(e, {value: dataclasses.replace(trial, change_db=change) for value, change in changes_db.items()})
    table = np.stack([changes_db.get(value, np.zeros(len(e.time_s))) for value in values])
    between = np.interp(values.index(likely.estimate[0]) + _BETWEEN, np.arange(len(values)), values)
    tried = np.append(between, [*changes_db])
    curve = _spline(np.array(values), tried) @ table
    finer = {value: dataclasses.replace(trial, change_db=at) for value, at in zip(tried.tolist(), curve, strict=True)}
    finer.pop(0.0, None)
    found = _profiled(e, finer, _fitted(e, likely).parameters)
    return dataclasses.replace(found, sentence=words(found.estimate[0]))


def _spline(knots: FloatArray, at: FloatArray) -> FloatArray:
    """Return the weights (m, n) of n knots for a cubic spline at m positions.

    Loading scipy.interpolate would take 0.1 s.
    """
    n, share = len(knots), (np.append(knots, at)[:, None] - knots[0]) / np.ptp(knots)
    # omit terms at the second and second-last knot, so that no slopes at the ends are needed
    terms = np.hstack([share ** np.arange(min(n, 4)), np.maximum(share - share[2 : n - 2, 0], 0.0) ** 3])
    return np.asarray(np.linalg.solve(terms[:n].T, terms[n:].T).T)


def _heading(e: LevelEvidence) -> Iterator[Trial]:
    """Yield the trial that the UAV antenna is rotated about the vertical axis."""
    if e.turned_db:
        # the heading is less likely to be wrong if the logged attitude is not used
        cost, step = _RARE if "logged" in e.attitude_db else 0.0, "check the antenna's mount and the logged yaw"
        words = "the UAV antenna is turned clockwise by {:.0f} degrees".format
        yield _tuned(e, e.turned_db, Trial(name="heading", cost=cost, next_step=step), words)


def _attitude(e: LevelEvidence) -> Iterator[Trial]:
    """Yield trials in which an attitude that the settings ignore is used, or an attitude that they use is ignored."""
    for mode, change in e.attitude_db.items():
        cost, sentence = 0.0, "the UAV's attitude is not used"
        if mode == "ignored":  # ignoring a logged attitude is the less likely remedy
            cost, sentence = _RARE, "the logged attitude does not fit the level"
        step = f"`rt: {{attitude: {mode}}}`"
        yield Trial(name="attitude", cost=cost, change_db=change, sentence=sentence, next_step=step)


def _height(e: LevelEvidence) -> Iterator[Trial]:
    """Yield trials of two errors of the logged height: constant, and growing with time."""

    def words(rise: float) -> str:
        return f"the UAV flew about {abs(rise):.0f} m {'higher' if rise > 0 else 'lower'} than the log says"

    if not e.raised_db:
        return
    yield _tuned(e, e.raised_db, Trial(name="height", next_step="check the telemetry's height datum"), words)
    changes = _growing(e)
    best, cost = _likeliest(e, e.predicted_db + changes)
    sentence = f"the logged height drifts by about {-_DRIFTS_M[best]:+.0f} m until the end of the flight"
    estimate, step = (_DRIFTS_M[best], math.nan, math.nan), "check the barometer, or log the height of the GNSS"
    cost, change_db = _RARE + cost, changes[best]
    yield Trial(name="height", cost=cost, change_db=change_db, estimate=estimate, sentence=sentence, next_step=step)


# True minus logged height at the end of a flight [m].
_DRIFTS_M = tuple(float(sign * rise) for rise in (15, 20, 25, 30, 40, 50, 60, 80, 100) for sign in (-1, 1))


def _growing(e: LevelEvidence) -> FloatArray:
    """Return the changes of the level (m, n) by height errors that grow from 0 to each value of :data:`_DRIFTS_M`."""
    from scipy.ndimage import map_coordinates

    rises = np.array(sorted({0.0, *e.raised_db}))
    table = np.stack([e.raised_db.get(rise, np.zeros(len(e.time_s))) for rise in rises.tolist()])
    share = (e.time_s - e.time_s[0]) / max(float(np.ptp(e.time_s)), 1e-9)
    at = np.interp(np.outer(_DRIFTS_M, share), rises, np.arange(len(rises)))
    return np.asarray(map_coordinates(table, np.broadcast_arrays(at, np.arange(at.shape[1])), order=1, mode="nearest"))


def _misread(e: LevelEvidence) -> Iterator[Trial]:
    """Yield trials in which the telemetry has other units, signs or columns than its reader assumed."""
    step, cost = "check the telemetry's columns and units", math.log(max(len(e.misread_db), 1))
    for meaning, change in e.misread_db.items():
        yield Trial(name="telemetry", cost=cost, sentence=meaning, next_step=step, change_db=change)


def _tower(e: LevelEvidence) -> Iterator[Trial]:
    """Yield the trials that the log belongs to another tower."""
    for name, level in e.other_towers_db.items():
        sentence, step = f"the log comes from {name}", f"`node: {name}` {_IN_LOGS}"
        if name in e.towers:  # a tower cannot have two logs of one channel, so the logs are swapped
            step = f"swap {name} and {e.tower} {_IN_LOGS}"
        change_db, cost = level - e.predicted_db, math.log(len(e.other_towers_db))
        yield Trial(name="tower", cost=cost, sentence=sentence, next_step=step, change_db=change_db)


def _place(e: LevelEvidence) -> Iterator[Trial]:
    """Yield the trial that the tower is elsewhere near its position in the site file, or the track is shifted."""
    if not e.displaced_db:
        return
    radii = np.array(sorted({radius for radius, _ in e.displaced_db}))
    azimuths = np.array(sorted({azimuth for _, azimuth in e.displaced_db}))
    table = np.array([[e.displaced_db[radius, azimuth] for azimuth in azimuths] for radius in radii])
    # weight each radius by the area that it represents (radii grow by a factor) and by its probability
    weight = np.repeat(radii**2 * (1.0 + (radii / _NEAR_PLACE_M) ** 2) ** -1.5, len(azimuths))
    coarse, cost = _likeliest(e, e.predicted_db + table.reshape(len(weight), -1), weight=weight)
    i, j = np.unravel_index(coarse, table.shape[:2])
    rows = np.array([i + r for r in _FINER if 0 <= i + r <= len(radii) - 1])
    fine = [(row, j + a) for row in rows for a in _FINER]
    # splines over the radii, and over the azimuths around the likeliest one (the first azimuth follows the last)
    over = _spline(np.arange(len(radii), dtype=np.float64), rows), _spline(_AROUND.astype(np.float64), np.array(_FINER))
    near = table[:, (j + _AROUND) % len(azimuths)]
    changes = np.einsum("ri,aj,ijt->rat", *over, near, optimize=True).reshape(len(fine), -1)
    best, _ = _likeliest(e, e.predicted_db + changes)
    at, around = fine[best]
    radius = float(np.exp(np.interp(at, np.arange(len(radii)), np.log(radii))))
    azimuth = (around * 360.0 / len(azimuths)) % 360.0
    side = _SIDES[round(azimuth / 45.0) % 8]
    sentence = f"the tower is about {radius:.0f} m {side} of its stated place, or the track has the opposite error"
    estimate, step = (radius, math.nan, math.nan), "check the coordinates of both"
    yield Trial(name="place", cost=cost, change_db=changes[best], estimate=estimate, sentence=sentence, next_step=step)


# Distance [m] beyond which positions become unlikely, steps between the computed positions, and steps of azimuth over
# which a spline is fitted.
_NEAR_PLACE_M, _FINER, _AROUND = 50.0, (-0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75), np.arange(-4, 5)
_SIDES = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


def _channels(e: LevelEvidence) -> Iterator[Trial]:
    """Yield the trial that the logs of the two channels of the tower are swapped."""
    if len(e.others) != 1 or e.others[0].unit != e.unit:
        return
    change_db = np.interp(e.time_s, _seconds(e.others[0], e), e.others[0].predicted_db) - e.predicted_db
    if change_db.std() > SHOWN_DB:
        step = "check the cables, or swap the channels in the flight file"
        sentence = "the channels of the tower are swapped"
        yield Trial(name="channels", sentence=sentence, next_step=step, change_db=change_db)


def _seconds(other: LevelEvidence, e: LevelEvidence) -> FloatArray:
    """Return the times (n,) of another channel, counted from the start of ``e``."""
    return np.asarray(other.time_s + (other.start - e.start) / np.timedelta64(1, "s"))


CATCH_ALL = "pattern"

# Causes that depend on the direction alone, and therefore imitate errors of the propagation model.
OF_DIRECTION = frozenset({"blocked", CATCH_ALL})
# Causes that are replaced by a gain step if held-out flights do not have such a step.
_OF_HEALTH = OF_DIRECTION | {"gain step"}

_CALIBRATE = "`aerpaw-cmp calibrate FLIGHT FLIGHT`"
_PATTERN = {
    "isotropic": ("the antenna pattern of the UAV", _CALIBRATE),
    "measured": ("the antenna file does not fit the UAV", f"check `antenna:`, else {_CALIBRATE}"),
    "learned": ("the learned antennas do not fit this UAV", "check which aircraft and antennas flew"),
}


def _pattern(e: LevelEvidence) -> Iterator[Trial]:
    """Yield the trial of a smooth gain over the directions of the UAV's antenna instead of the known gain."""
    azimuth, elevation = np.radians(e.uav_azimuth_deg), np.radians(e.uav_elevation_deg)
    axes = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    terms = [term for degree in (1, 2, 3) for term in combinations_with_replacement(axes, degree)]
    columns = [_GAIN_DB * np.prod(term, axis=0) for term in terms]
    if e.turned_db:  # this column adds the mean of the level over all headings, so it can cancel the known pattern
        columns.append(np.sum(list(e.turned_db.values()), axis=0) / (len(e.turned_db) + 1))
    sentence, step = _PATTERN[e.antenna]
    yield Trial(name=CATCH_ALL, sentence=sentence, next_step=step, columns=np.column_stack(columns))


# Prior standard deviations of the terms of an antenna's gain, of steps and of losses [dB].
_GAIN_DB, _STEP_DB, _LOSS_DB = 3.0, 8.0, 15.0
# Log odds against rare faults.
_RARE = 3.0


def _cell(e: LevelEvidence) -> Iterator[Trial]:
    """Yield the trial of a level that changes with the serving cell."""
    if e.serving is not None and np.ptp(e.serving) > 0.5:
        sentence, step = "the level steps when the phone changes its serving cell", "compare the cells separately"
        yield Trial(name="cell", sentence=sentence, next_step=step, columns=_STEP_DB * e.serving[:, None])


def _decibels(e: LevelEvidence) -> Iterator[Trial]:
    """Yield trials in which all levels in dB are halved, doubled (amplitude read as power, or vice versa) or negated.

    The interval of the slope must support the factor, and a path-loss exponent and a gain over elevation, which change
    levels in a similar way, must be much less likely than the factor.
    """
    up = np.sin(np.radians(e.uav_elevation_deg))
    elevation = _GAIN_DB * np.column_stack([up, up**2, up**3])
    rivals = [elevation] if e.distance_db is None else [elevation, _SLOPE * e.distance_db[:, None]]
    # an amplifier compresses the levels above a knee; expanded levels have another reason
    above = [np.maximum(e.predicted_db - knee_db, 0.0)[:, None] for knee_db in np.quantile(e.predicted_db, _KNEES)]
    bent = [of for of in above if (e.measured_db - e.predicted_db) @ (of - of.mean()) < 0.0]
    slopes = [Trial(columns=_SLOPE * of) for of in (e.predicted_db[:, None], *bent)]
    others = [Trial(columns=columns) for columns in rivals]
    # a prediction without antennas is free space: doubled decibels then equal a path-loss exponent of 4
    alike = e.distance_db is not None and bool((e.predicted_db - e.distance_db).std() < SHOWN_DB)
    if alike:
        # fit a parabola, because the log likelihood is nearly a parabola around its maximum
        best, sd = _slope(e, np.polyfit(e.predicted_db, e.measured_db, 1)[0], 0.1, _fitted(e, slopes[0]).parameters)
        if best >= _STEEP:
            # obstacles near the ground cause such an exponent, which is unlikely in the air
            doubled = abs(best - 2.0) <= 1.96 * sd and np.nanmedian(e.place_m[:, 2]) > _NEAR_GROUND_M
            yield Trial(
                name="exponent or decibels", cost=math.log(2.0), columns=slopes[0].columns,
                sentence=f"the path-loss exponent is {2.0 * best:.1f}{', or decibels are doubled' if doubled else ''}",
                next_step="check the unit of the levels" if doubled else "add missing obstacles to the site",
                estimate=(2.0 * best, 2.0 * best - 3.92 * sd, 2.0 * best + 3.92 * sd),
            )  # fmt: skip
            return
    for factor, (name, sentence, step) in _FACTORS.items():
        change_db, cost = (factor - 1.0) * e.predicted_db, 2.0 * _RARE + math.log(2.0)
        trial = Trial(name=name, cost=cost, change_db=change_db, sentence=sentence, next_step=step)
        if not _nearer(e, factor * e.predicted_db) or (alike and factor == 2.0):
            continue
        fit = _fitted(e, trial)
        fits = ((_fitted(e, other, at=fit.parameters) for other in of) for of in (slopes, others))
        slope, apart = (max(other.log_likelihood for other in of) for of in fits)
        # skip this comparison if there is a floor, above which logged levels change by fewer decibels than the link
        least = -math.inf if e.floored else apart + _RARE
        if _is_slope(e, factor, fit.parameters) and fit.log_likelihood > max(least, slope):
            yield trial
            return
    # alternatives without a name: a cause must be likelier than another slope or exponent
    yield from (*slopes, *others[1:])


# Shares of the levels below the knee of an amplifier.
_KNEES = (0.3, 0.5, 0.7)


# Cause, sentence and next step for each slope of measured over predicted levels. Prior standard deviation of a slope.
_POWERS = "check: 10 log10 of power, 20 log10 of amplitude"
_FACTORS = {
    -1.0: ("sign", "the values rise where the predicted level falls, as path losses do", "negate them in the log"),
    0.5: ("decibels", "the levels change by half the predicted decibels", _POWERS),
    2.0: ("decibels", "the levels change by twice the predicted decibels", _POWERS),
}
_SLOPE = 0.5
# Smallest slope that is attributed to a path-loss exponent: heights and antennas change the slope by less. Largest
# height of a receiver among obstacles [m].
_STEEP, _NEAR_GROUND_M = 1.25, 10.0
# Largest relative difference of a slope from these factors, for other antennas and for learned antennas. The slope of
# learned antennas is 0.95 to 1.09 on held-out flights of dataset 12, and 0.9 on the LTE flight at 50 m.
_SLOPE_SHARE, _LEARNED_SLOPE_SHARE = {-1.0: 0.25, 0.5: 0.1, 2.0: 0.05}, {-1.0: 0.25, 0.5: 0.12, 2.0: 0.1}


def _is_slope(e: LevelEvidence, factor: float, at: NoiseParameters) -> bool:
    """Check whether the 95 % interval of the slope is near a factor."""
    step = abs(factor) * (_LEARNED_SLOPE_SHARE if e.antenna == "learned" else _SLOPE_SHARE)[factor]
    best, sd = _slope(e, factor, step, at)
    return abs(best - factor) <= step and abs(best - factor) + 1.96 * sd < 2.0 * step


def _slope(e: LevelEvidence, factor: float, step: float, at: NoiseParameters) -> tuple[float, float]:
    """Return the slope of measured over predicted levels, and its SD.

    Both are NaN if the levels do not determine a slope.
    """
    changes = (Trial(change_db=(factor + i * step - 1.0) * e.predicted_db) for i in (-1, 0, 1))
    below, middle, above = (_fitted(e, change, at=at, search=False).log_likelihood for change in changes)
    bend = below - 2.0 * middle + above
    if bend >= 0.0:
        return math.nan, math.nan
    return factor + 0.5 * step * (below - above) / bend, step / math.sqrt(-bend)


# --- faults of the receiver ----------------------------------------------------------------------------------------


def _controlled(e: LevelEvidence) -> Iterator[Trial]:
    """Yield trials of a gain control, which follows the mean level over some time. A report never names this cause."""
    for slow in slow_levels(e.time_s, e.predicted_db):
        # a gain control can only weaken changes of the level; stronger changes are explained by another slope
        if (e.measured_db - e.predicted_db) @ (slow - slow.mean()) < 0.0:
            yield Trial(cost=math.log(len(_CONTROLS_S)), columns=_SLOPE * (slow - slow.mean())[:, None])


def slow_levels(time_s: FloatArray, level_db: FloatArray) -> Iterator[FloatArray]:
    """Yield means (n,) of the level up to each time (n,), with weights that decay over the times of gain controls."""
    for memory_s in _CONTROLS_S:
        keep, slow = np.exp(-np.diff(time_s, prepend=time_s[:1]) / memory_s).tolist(), level_db.tolist()
        for i in range(1, len(slow)):
            slow[i] += keep[i] * (slow[i - 1] - slow[i])
        yield np.array(slow)


_CONTROLS_S = (10.0, 20.0, 40.0)


def _lock(e: LevelEvidence) -> Iterator[Trial]:
    """Yield the trial of a lost receiver lock, if the log has samples without lock. Their levels are noise."""
    if not e.limits_known and e.locked is not None and (lost := e.locked < 0.5).any():
        # the report has a caution with the number of these samples, and its first sentence already states the error
        # with the floor. The log itself shows this fault, so cancel the prior odds against a fault.
        sentence = "the receiver had no lock in parts of the flight"
        yield Trial(name="lock", cost=-_SELDOM, clipped=lost, sentence=sentence)


def _no_detection(e: LevelEvidence) -> Iterator[Trial]:
    """Yield the trial that the receiver did not detect the signal at samples with the lowest level, if many have it."""
    if not e.limits_known and e.least is not None and e.least.any() and not e.least.all():
        level, share = float(np.median(e.measured_db[e.least])), 100 * e.least.mean()
        # levels that vary are noise. Means over seconds vary less, so a margin above the median is enough.
        top = level + (0.0 if np.ptp(e.measured_db[e.least]) < 1e-9 else _OVER_FLOOR_DB)
        sentence = f"{share:.0f} % of samples are at {Printed(level):.0f} {e.unit}: not detected"
        step = f"`floor_db: {math.ceil(top * 100.0 + 1.0) / 100.0:.2f}` {_IN_LOGS}"
        estimate = level, level, level
        yield Trial(name="no detection", clipped=e.least, estimate=estimate, sentence=sentence, next_step=step)


def _limits(e: LevelEvidence) -> Iterator[Trial]:
    """Yield trials of a floor and a ceiling of the level.

    For a level that is constant throughout, yield only an input without signal.
    """
    if is_flat(e.measured_db, [e.predicted_db]):
        sentence = f"the level stays at {Printed(float(np.median(e.measured_db))):.0f} {e.unit} throughout"
        step = "check the receiver's input and gain"
        yield Trial(name="flat", cost=_RARE, sentence=sentence, next_step=step, change_db=-e.predicted_db)
        return
    # if the lowest level is frequent, this level marks samples without a detected signal, and is not a limit
    if e.least is None and not e.limits_known:
        yield from _clipping(e, 1.0)
    # signals below the noise do not overload a receiver
    if e.unit != "dB" or np.median(e.measured_db) >= 0.0:
        yield from _clipping(e, -1.0)


# At a limit, at most the second number (a share) of the measured levels are beyond it by more than the first number
# [dB].
_BEYOND_DB, _MOST_BEYOND = 2.0, 0.02
_FAR_DB, _LEAST_FAR = 3.0, 0.1


def _clipping(e: LevelEvidence, side: float) -> Iterator[Trial]:
    """Yield hard and soft limits of the level: a floor (``side`` 1) or a ceiling (``side`` -1)."""
    pile = _pile(e, side)
    if pile is not None:
        limit = float(e.measured_db[pile].mean())
        if (trial := _limited(e, limit, side)) is not None:
            yield dataclasses.replace(trial, clipped=pile, estimate=(limit, limit, limit))
    limits = np.quantile(e.measured_db, np.linspace(0.02, 0.7, 18) if side > 0 else np.linspace(0.98, 0.3, 18))
    trials = {limit: trial for limit in limits.tolist() if (trial := _bent(e, limit, side)) is not None}
    if trials:
        yield _profiled(e, trials)


# Smallest share of the samples at a limit.
_LEAST_CLIPPED = 0.06


def _pile(e: LevelEvidence, side: float) -> BoolArray | None:
    """Return the samples at the receiver's limit, or None if the samples with extreme levels fade like all others."""
    if e.step_db > PILE_DB:  # coarse rounding collects many samples at each level, not only at a limit
        return None
    end = float(np.quantile(e.measured_db, 0.01 if side > 0 else 0.99))
    pile = side * (e.measured_db - end) < PILE_DB
    step = np.abs(np.diff(e.measured_db))
    inside, outside = pile[1:] & pile[:-1], ~(pile[1:] | pile[:-1])
    if inside.sum() < max(LEAST_BINS, _LEAST_CLIPPED * len(pile)) or outside.sum() < LEAST_BINS:
        return None
    # at a limit of the receiver, the predicted levels are beyond the limit. With constant interference, they are not
    # beyond it.
    error = e.measured_db - e.predicted_db
    missing = side * float(np.median(error[pile]) - np.median(error[~pile]))
    limited = np.median(step[inside]) < MOST_FADING * np.median(step[outside]) and missing > -_BEYOND_DB
    return pile if limited else None


def _limited(e: LevelEvidence, limit: float, side: float) -> Trial | None:
    """Return the cause for a limit of the levels, or None if measured levels beyond it show that there is no limit."""
    if (side * (e.measured_db - limit) < -_BEYOND_DB).mean() > _MOST_BEYOND:
        return None
    name, words, step = _LIMITS[side]
    sentence = words.format(level=f"{Printed(limit):.0f} {e.unit}")
    next_step = step.format(typed=f"{limit + _OVER_FLOOR_DB:.0f}")
    return Trial(name=name, sentence=sentence, next_step=next_step)


def _bent(e: LevelEvidence, limit: float, side: float) -> Trial | None:
    """Return a soft limit: the power of a noise floor is added to the level, or the level approaches a ceiling."""
    if (trial := _limited(e, limit, side)) is None:
        return None
    # start from the median, which the samples at the limit hardly affect
    offset = float(np.median(e.measured_db - e.predicted_db))
    for _ in range(5):
        level = e.predicted_db + offset
        shown = limit + side * 10.0 * np.log10(1.0 + 10.0 ** (side * (level - limit) / 10.0))
        offset += float(np.mean(e.measured_db - shown))
    # require enough samples: a prediction that fades too deeply at a few samples is not evidence of a limit
    if (side * (limit - level) > _FAR_DB).mean() < _LEAST_FAR:
        return None
    fading = 1.0 / (1.0 + 10.0 ** (side * (limit - level) / 10.0))
    return dataclasses.replace(trial, change_db=shown - level, fading=fading.clip(_LEAST_FADING))


_LEAST_FADING = 0.1
# At this distance above the floor [dB], half of the power comes from the floor.
_OVER_FLOOR_DB = 3.0


_LIMITS = {
    1.0: ("floor", "the log has no level below {level}", "`floor_db: {typed}` " + _IN_LOGS),
    -1.0: ("saturation", "the log has no level above {level}", "lower the gain; use only lower levels"),
}


# --- faults of a part of the flight --------------------------------------------------------------------------------


_SEARCHED_PHI = (0.6, 0.93)
_WIDTHS_DEG = (10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 90.0)
# Angle over which the edge of a shadow fades [deg]: the angle of a Fresnel zone some hundred metres away.
_EDGE_DEG = 4.0
# Smallest loss behind an obstacle [dB]. A smaller loss in a sector is usually caused by an antenna.
_LEAST_LOSS_DB = 6.0
_MOST_STARTS = 600


def _blocked(e: LevelEvidence) -> Iterator[Trial]:
    """Yield trials of a loss in a sector of directions from the tower, searched in steps of 5, then of 1 degree."""
    residual = e.measured_db - e.predicted_db
    coarse = [(middle, width) for width in _WIDTHS_DEG for middle in np.arange(0.0, 360.0, 5.0).tolist()]
    shadows = _shadows(e, coarse)
    inside = shadows.sum(axis=1)
    seen = (inside >= LEAST_BINS) & (shadows.shape[1] - inside >= LEAST_BINS)
    shadows, coarse = shadows[seen], [sector for sector, possible in zip(coarse, seen, strict=True) if possible]
    for phi, (shift, _, gain) in zip(_SEARCHED_PHI, shifts_in_masks(residual, shadows, _SEARCHED_PHI), strict=True):
        possible = shift < -_LEAST_LOSS_DB
        if not possible.any():
            continue
        gain = np.where(possible, gain, -np.inf)
        # count sectors without samples like sectors without a loss
        cost = _concentration(gain, np.ones(len(gain))) + math.log(len(seen) / len(gain))
        middle, width = coarse[int(np.argmax(gain))]
        around = [(middle + i, max(width + j, 2.0)) for i in range(-6, 7) for j in range(-8, 9)]
        finer = _shadows(e, around)
        ((shift, error, gain),) = shifts_in_masks(residual, finer, (phi,))
        at = int(np.argmax(np.where(shift < -_LEAST_LOSS_DB, gain, -np.inf)))
        (middle, width), loss, reach = around[at], -float(shift[at]), 1.96 * float(error[at])
        first = (middle - 0.5 * width) % 360.0
        sentence = f"a loss of {loss:.0f} dB towards {first:.0f} to {(first + width) % 360:.0f} degrees"
        columns, step = _LOSS_DB * finer[at][:, None], "add the obstacle to the site"
        estimate = loss, loss - reach, loss + reach
        yield Trial(name="blocked", cost=cost, columns=columns, estimate=estimate, sentence=sentence, next_step=step)


def _shadows(e: LevelEvidence, sectors: Sequence[tuple[float, float]]) -> FloatArray:
    """Return the share (m, n) of the loss in each sector (middle and width [deg]) that applies to each sample."""
    middle, width = (np.array(column)[:, None] for column in zip(*sectors, strict=True))
    middles, of = np.unique(middle, return_inverse=True)  # sectors of several widths have the same middle
    off = np.abs(wrap_degrees(e.tower_azimuth_deg - middles[:, None]))[of.ravel()]
    return np.asarray(np.clip(0.5 + (0.5 * width - off) / _EDGE_DEG, 0.0, 1.0))


_CHECK_GAIN = "check the receiver's gain; compare both parts separately"


def _gain_step(e: LevelEvidence) -> Iterator[Trial]:
    """Yield trials of a shift of the level from some time until the end of the flight, and of a gain that drifts."""
    n = len(e.time_s)
    starts = np.arange(LEAST_BINS * 2, n - LEAST_BINS * 2)
    if not len(starts):
        return
    # limit the number of tried starts, because neighbouring bins have nearly the same step
    starts = starts[:: 1 + len(starts) // _MOST_STARTS]
    # a gain that drifts is an alternative to a step
    yield Trial(columns=_STEP_DB * (np.arange(n) / n)[:, None])
    # a gain step is assumed to occur at the same time on all channels of a tower
    channels = (e, *e.others)
    masks = [(_seconds(c, e)[None, :] >= e.time_s[starts][:, None]).astype(np.float64) for c in channels]
    errors = [c.measured_db - c.predicted_db for c in channels]
    shifts = [shifts_in_masks(error, m, _SEARCHED_PHI) for error, m in zip(errors, masks, strict=True)]
    for steps in zip(*shifts, strict=True):
        (shift, error, _), gain = steps[0], np.sum([of for _, _, of in steps], axis=0)
        at = int(np.argmax(gain))
        instant = (e.start + np.timedelta64(round(float(e.time_s[starts[at]])), "s")).astype("datetime64[s]")
        step, reach = float(shift[at]), 1.96 * float(error[at])
        yield Trial(
            name="gain step", cost=_concentration(gain, np.ones(len(gain))) / len(channels), channels=len(channels),
            columns=_STEP_DB * masks[0][at][:, None], estimate=(step, step - reach, step + reach),
            sentence=f"the level steps by {Printed(step):+.1f} dB at {str(instant)[-8:]} UTC",
            next_step=_CHECK_GAIN,
        )  # fmt: skip


CANDIDATES: tuple[Callable[[LevelEvidence], Iterator[Trial]], ...] = (
    _clock, _heading, _attitude, _misread, _height, _tower, _place, _channels, _pattern, _cell, _decibels,
    _controlled, _lock, _no_detection, _limits, _blocked, _gain_step,
)  # fmt: skip

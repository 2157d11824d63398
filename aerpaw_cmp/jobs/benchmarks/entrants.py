"""Our own entrants of the benchmark: baselines, standards, ray tracing, learned antennas, a black box."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from ...common.units import BoolArray, FloatArray
from ...compare.direction_gain import LinkSamples
from ...compare.forecast import constant_forecast
from ...compare.learning import calibration
from ...compare.learning.calibration import Observed
from ...compare.learning.correction import BIN_S, Base, choose, fixed_base
from ...compare.spread import fading_of
from ...flight.data import FlightData, RssSeries
from ...flight.replay import attitude_rotation
from ...propagation.arrays import Poses
from ...propagation.field.baselines import p1411_loss_db, tr36777_loss_db, two_ray_dbm
from ...propagation.options import Engine
from ...propagation.trace import trace
from ..learning.calibrate import learned_antennas
from ..learning.calibrate_rank import RankFitSettings, Tried
from .benchmark import KEY, RANKS, Bench, Question, keys, questions, utc_texts

# Level above free space (n,) of samples [dB], up to a constant.
GainOf = Callable[[Observed], FloatArray]

# Level and standard deviation (n,) [dB].
Answer = tuple[FloatArray, FloatArray]

_Entrant = Callable[[Question, Bench], list[Answer]]


def anchored(question: Question, gain: GainOf) -> list[Answer]:
    """A model of the gain with offsets of its training: of the series' own flight where known, else of its antenna.

    The standard deviation is that of the training residuals about these offsets.
    """
    errors = [o.samples.residual_db - gain(o) for o in question.train]
    out = []
    for item in question.targets:
        mine = [r for o, r in zip(question.train, errors, strict=True) if _same(o, item)]
        if not mine:
            mine = [r for o, r in zip(question.train, errors, strict=True) if o.samples.antenna == item.samples.antenna]
        mine = mine or errors
        offset = float(np.concatenate(mine).mean()) if mine else 0.0
        spread = float(np.sqrt(np.mean(np.concatenate([r - r.mean() for r in mine]) ** 2))) if mine else 10.0
        out.append((item.free_space_db + gain(item) + offset, np.full(len(item.samples), max(spread, 0.1))))
    return out


def _same(first: Observed, second: Observed) -> bool:
    return (first.samples.flight, first.samples.antenna) == (second.samples.flight, second.samples.antenna)


def _log_distance(question: Question, _: Bench) -> list[Answer]:
    """A slope per antenna, fitted on what is known; offsets of each series are free."""
    slopes: dict[str, float] = {}
    for antenna in {o.samples.antenna for o in (*question.train, *question.targets)}:
        known = [o for o in question.train if o.samples.antenna == antenna] or question.train
        x = np.concatenate([o.free_space_db - o.free_space_db.mean() for o in known])
        y = np.concatenate([o.samples.residual_db - o.samples.residual_db.mean() for o in known])
        slopes[antenna] = float(x @ y / (x @ x))
    return anchored(question, lambda o: slopes[o.samples.antenna] * o.free_space_db)


def _by_gain(gain: Callable[[Observed, FlightData, RssSeries], FloatArray]) -> _Entrant:
    """Entrant of a gain that needs the flight and the series of the samples."""

    def answer(question: Question, bench: Bench) -> list[Answer]:
        def of(o: Observed) -> FloatArray:
            data, end = bench.data(o.samples.flight), (o.samples.tower, o.samples.channel)
            return gain(o, data, next(s for s in data.rss if (s.tower, s.channel) == end))

        return anchored(question, of)

    return answer


def _two_ray(o: Observed, data: FlightData, series: RssSeries) -> FloatArray:
    tower, link = data.site.towers[o.samples.tower], series.link
    level = two_ray_dbm(
        tower.position_m[None, :], o.samples.position_m, link.carrier_hz, link.transmit_power_dbm,
        ground_material=data.site.ground_material, ground_m=tower.ground_m,
    )[:, 0]  # fmt: skip
    return np.asarray(level - o.free_space_db)


# Loss (n,) [dB] at distances and heights (n,) [m] and a carrier [Hz].
Loss = Callable[[FloatArray, FloatArray, float], FloatArray]


def _standard(loss_db: Loss, o: Observed, data: FlightData, series: RssSeries) -> FloatArray:
    """Gain of a standard that gives a loss by distance and height."""
    distance = np.linalg.norm(o.samples.position_m - data.site.towers[o.samples.tower].position_m, axis=1)
    loss = loss_db(distance, o.samples.position_m[:, 2], series.link.carrier_hz)
    return np.asarray(series.link.transmit_power_dbm - loss - o.free_space_db)


def _replay(
    level: str, engine: Engine, options: Mapping[str, Any], o: Observed, data: FlightData, series: RssSeries
) -> FloatArray:
    """Gain by ray tracing from the poses of the samples; where no path arrives, the mean of the others."""
    time = np.array([t.removesuffix("Z") for t in utc_texts(o.start, o.samples.time_s)], "datetime64[ns]")
    pose = data.poses_at(time)
    poses = Poses(pose.position_m, attitude_rotation(pose, data.settings.rt.attitude))
    replayed = trace(data.site, data.link_of(series), poses, engine, **options)
    gain_db = getattr(replayed, level)[:, 0] - o.free_space_db
    return np.asarray(np.where(np.isfinite(gain_db), gain_db, np.nanmean(gain_db)))


_FITS: dict[tuple[int, ...], calibration.Learned] = {}


def _fit(train: Sequence[LinkSamples]) -> calibration.Learned:
    """Learned antennas of some samples, kept: entrants of one question share them."""
    key = tuple(hash(s.residual_db.tobytes()) for s in train)
    if key not in _FITS:
        _FITS[key] = learned_antennas(train)
    return _FITS[key]


def _learned(question: Question, _: Bench) -> list[Answer]:
    fit = _fit([o.samples for o in question.train])
    answers = anchored(question, lambda o: fit.mean(o.samples))
    return [
        (level, fit.spread(target.samples.antenna).total_db(fit.predict(target.samples)[1]))
        for target, (level, _) in zip(question.targets, answers, strict=True)
    ]


def _learned_residual(question: Question, _: Bench) -> list[Answer]:
    """Learned antennas, and the residual field on what they leave where it helps inside the training flights."""
    samples = [o.samples for o in question.train]
    return _corrected(question, samples, lambda train: _fit(train).predict, [o.free_space_db for o in question.targets])


def _kriging(question: Question, _: Bench) -> list[Answer]:
    """The level itself over place, without any model of propagation."""
    levels = [
        dataclasses.replace(o.samples, residual_db=o.samples.residual_db + o.free_space_db) for o in question.train
    ]
    constant = fixed_base(lambda s: np.zeros(len(s)))
    return _corrected(question, levels, constant, [np.zeros(len(o.samples)) for o in question.targets])


def _corrected(
    question: Question, train: Sequence[LinkSamples], base: Base, above: Sequence[FloatArray]
) -> list[Answer]:
    """A base and its residual field; ``above`` (n,) is what both count from, of each target series [dB]."""
    correction = choose(train, {"base": base})
    out = []
    for target, level in zip(question.targets, above, strict=True):
        known = any(_same(o, target) for o in question.train)
        fading, _ = fading_of([s for s in train if s.antenna == target.samples.antenna], BIN_S)
        mean, sd = correction.predict(target.samples, target.samples.flight if known else None, own_mean=not known)
        out.append((level + mean, np.hypot(sd, fading)))
    return out


def _trees(question: Question, _: Bench) -> list[Answer]:
    """Gradient-boosted trees on the geometry: the strong black box."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    names = sorted({o.samples.antenna for o in question.train})

    def features(o: Observed) -> FloatArray:
        s = o.samples
        code = np.full(len(s), names.index(s.antenna) if s.antenna in names else -1.0)
        return np.column_stack([o.free_space_db, s.position_m, s.at_tower, s.at_uav, code])

    x = np.concatenate([features(o) for o in question.train])
    y = np.concatenate([o.samples.residual_db - o.samples.residual_db.mean() for o in question.train])
    half = np.concatenate([o.samples.time_s > np.median(o.samples.time_s) for o in question.train])

    def fitted(rows: BoolArray) -> Any:
        model = HistGradientBoostingRegressor(max_iter=100, learning_rate=0.1, max_depth=5, random_state=0)
        return model.fit(x[rows], y[rows])

    model = fitted(np.ones(len(y), dtype=np.bool_))
    # the spread is that of one half of each flight predicted from the other: trees know their own samples by heart
    error_db = np.where(half, fitted(~half).predict(x), fitted(half).predict(x)) - y
    answers = anchored(question, lambda o: np.asarray(model.predict(features(o))) if len(o.samples) else np.zeros(0))
    return [(level, np.full(len(level), error_db.std())) for level, _ in answers]


LEVEL: dict[str, _Entrant] = {
    "free_space": lambda question, _: anchored(question, lambda o: np.zeros(len(o.samples))),
    "constant": lambda question, _: anchored(question, lambda o: -o.free_space_db),
    "log_distance": _log_distance,
    "two_ray": _by_gain(_two_ray),
    "tr36777_rma_av": _by_gain(partial(_standard, partial(tr36777_loss_db, "RMa-AV"))),
    "tr36777_uma_av": _by_gain(partial(_standard, partial(tr36777_loss_db, "UMa-AV"))),
    "p1411": _by_gain(partial(_standard, lambda distance_m, _, carrier_hz: p1411_loss_db(distance_m, carrier_hz))),
    "kriging": _kriging,
    "replay_paper": _by_gain(partial(_replay, "rss_dbm", "image", {"max_depth": 2})),
    "replay_drafted": _by_gain(partial(_replay, "rss_power_dbm", "image", {"max_depth": 1})),
    "replay_sionna": _by_gain(partial(_replay, "rss_power_dbm", "sionna", {"max_depth": 1, "samples": 10_000})),
    "learned": _learned,
    "learned_residual": _learned_residual,
    "boosted_trees": _trees,
}

# Minutes per flight, and the paths of ``replay_drafted``.
ONLY_ON_DEMAND = ("replay_sionna",)


def _rank_constant(bench: Bench, train: Sequence[str], flight: str) -> list[FloatArray]:
    share = constant_forecast(np.concatenate([samples.rank for name in train for samples in bench.ranks(name)]))
    return [np.tile(share, (len(item.rank), 1)) for item in bench.ranks(flight)]


def _rank_receiver(bench: Bench, train: Sequence[str], flight: str) -> list[FloatArray]:
    """The receiver that ``calibrate`` learns."""
    out = []
    for item in bench.ranks(flight):
        samples = [s for name in train for s in bench.ranks(name) if s.tower == item.tower]
        fitted = Tried.of(samples, RankFitSettings()).fit(range(len(samples)))
        out.append(fitted.forecast(item)[0])
    return out


RANK: dict[str, Callable[[Bench, Sequence[str], str], list[FloatArray]]] = {
    "constant": _rank_constant,
    "learned": _rank_receiver,
}


def predict(bench: Bench, task: str, entrant: str) -> pd.DataFrame | None:
    """Predictions of one of ours for a task, as a predictions.csv has them; None where it has no answer.

    Parameters
    ----------
    bench : Bench
    task : str
    entrant : str
        A key of :data:`LEVEL` or :data:`RANK`.
    """
    ranked = bench.manifest.tasks[task].kind == "rank"
    if entrant not in (RANK if ranked else LEVEL):
        return None
    of = _rank_answers if ranked else _level_answers
    parts = (frame for flight in bench.tests(task) for frame in of(bench, task, flight, entrant))
    table: pd.DataFrame = pd.concat(parts).drop_duplicates(KEY)
    return table


def _rank_answers(bench: Bench, task: str, flight: str, entrant: str) -> Iterator[pd.DataFrame]:
    answers = RANK[entrant](bench, bench.manifest.tasks[task].train, flight)
    for samples, p in zip(bench.ranks(flight), answers, strict=True):
        frame = keys(task, flight, samples.tower, "rank", np.datetime64(0, "ns"), samples.time_s)
        yield frame.assign(**dict(zip(RANKS, p.T, strict=True)))


def _level_answers(bench: Bench, task: str, flight: str, entrant: str) -> Iterator[pd.DataFrame]:
    series = bench.observed(flight)
    levels = [np.full((2, len(o.samples)), np.nan) for o in series]
    for question in questions(bench, task, flight):
        for level, rows, (mean, sd) in zip(levels, question.rows, LEVEL[entrant](question, bench), strict=True):
            level[:, rows] = mean, sd
    for o, (mean, sd) in zip(series, levels, strict=True):
        frame = keys(task, flight, o.samples.tower, o.samples.channel, o.start, o.samples.time_s)
        yield frame.assign(level_db=mean, sd_db=sd)

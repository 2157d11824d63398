"""Offsets of nodes night by night, and the nights at which they step."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ...common.units import FloatArray, unmasked
from ..statistics.intervals import Interval

# Nights over which a step is looked for, and its chance on a night without one, at all nodes of a season together: the
# last night, and the last seven, whose mean shows what one night cannot. Nominal: the tails of a robust fit with links
# missing are longer than Student's, and the interval of a mean knows roughly how alike nights in a row are
# (``python -m tests.compare.test_steps 500``: one false step in a hundred nights; as many where nights in a row
# correlate by .7, half at .5).
_CHANCES = {1: 0.0025, 7: 0.0005}

# Fewer nights than this tell no standard deviation that a step could be judged by.
_FEWEST_NIGHTS = 10

# Residuals beyond so many robust standard deviations count less (Huber): a link with a car in front of it.
_HUBER = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A change of an offset: first night with it, night at whose end it showed, size with 95 % interval.

    ``back`` is the night with the old level again, of a step of a night or two; else empty.
    """

    night: str
    shown: str
    step_db: float
    step_ci95_db: Interval
    back: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeOffset:
    """Offset of one end of links over the nights of a season [dB], against its own median.

    ``sd_db`` is its standard deviation between steps, ``smallest_db`` the step that shows the same night with a chance
    of 90 %; NaN where there are too few nights.
    """

    node: str
    night: tuple[str, ...]
    offset_db: tuple[float, ...]
    sd_db: float
    smallest_db: float
    steps: tuple[Step, ...] = ()


@dataclass(frozen=True, slots=True)
class NightOffsets:
    """Offsets (nights,) of one end of links [dB], NaN if unknown, and the number of links (nights,) of each night.

    The variance of an offset is inversely proportional to its number of links.
    """

    offset_db: FloatArray
    links: FloatArray


def node_offsets(offset_db: ArrayLike, links: Sequence[tuple[str, str]]) -> dict[str, NightOffsets]:
    """Offset of every transmitter and receiver, from those of the links between them.

    Parameters
    ----------
    offset_db : (nights, links)
        NaN where a link was not measured.
    links : sequence of (transmitter, receiver)

    Returns
    -------
    dict of str to NightOffsets
        NaN where no link of a node was measured. Of one transmitter only the receivers have an offset.

    Notes
    -----
    ``offset(night, link) = link + transmitter(night) + receiver(night)`` by least squares with Huber's weights. The
    part of a link is the median of its residuals, fitted in turns: its plain median would depend on the nights that
    the link misses on either side of a step. What transmitters or receivers share (weather) is the median of the
    others, and is subtracted if there are four or more.

    Examples
    --------
    >>> offsets = node_offsets([[1.0, 5.0], [1.0, 5.0], [1.0, 7.0]], [("UAV", "LW1"), ("UAV", "LW2")])
    >>> offsets["LW2 receives"].offset_db.round(6).tolist()
    [0.0, 0.0, 2.0]
    """
    change = unmasked(offset_db)
    known = np.isfinite(change)
    raw, base = change, _median(change, 0)
    ends = [sorted({link[end] for link in links}) for end in (0, 1)]
    ends[0] = ends[0] if len(ends[0]) > 1 else []
    columns = [(end, name) for end in (0, 1) for name in ends[end]]
    design = np.array([[float(link[end] == name) for end, name in columns] for link in links])
    weight = known.astype(float)
    for _ in range(8):
        change = np.where(known, raw - base, 0.0)
        # a node without a link in a night has an empty row, and no offset below
        normal = np.einsum("tl,li,lj->tij", weight, design, design) + 1e-9 * np.eye(len(columns))
        fitted = np.linalg.solve(normal, ((weight * change) @ design)[..., None])[..., 0]
        residual = np.abs(change - fitted @ design.T)
        scale = 1.4826 * _median(np.where(known, residual, np.nan), 1)
        # a scale of 0 (all links agree) lets every link count in full
        weight = known * np.minimum(1.0, _HUBER * scale / np.maximum(residual, 1e-12) + (scale <= 0.0))
        base = _median(raw - fitted @ design.T, 0)
    number = known.astype(float) @ design
    fitted = np.where(number > 0.0, fitted, np.nan)
    alone = fitted.copy()
    for i, (end, _) in enumerate(columns):
        others = [j for j, of in enumerate(columns) if of[0] == end and j != i]
        if len(others) > 2:  # of fewer one that steps would be seen in the others
            fitted[:, i] -= _median(alone[:, others], 1)[:, 0]
    return {
        f"{name} {('transmits', 'receives')[end]}": NightOffsets(fitted[:, i], number[:, i])
        for i, (end, name) in enumerate(columns)
    }


def _median(values: FloatArray, axis: int) -> FloatArray:
    """Median of what is known along an axis, which stays; NaN where nothing is."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a link without a night, a night without a link
        return np.asarray(np.nanmedian(values, axis=axis, keepdims=True))


@dataclass(slots=True)
class _Stretch:
    """Nights in a row without a step; ``square`` and ``freedom`` are of the stretches before it.

    ``values`` has a row per night: offset [dB] and weight, the number of links.
    """

    values: list[tuple[float, float]]
    square: float = 0.0
    freedom: int = 0

    def level(self) -> tuple[float, float]:
        """Return the mean offset [dB] and its weight."""
        return _mean(self.values)

    def pooled(self) -> tuple[float, int]:
        """Return the weighted sum of squares about the levels of all stretches, and its degrees of freedom."""
        mean, _ = self.level()
        own = sum(weight * (value - mean) ** 2 for value, weight in self.values)
        return self.square + own, self.freedom + len(self.values) - 1

    def alike(self) -> float:
        """Return the variance of a mean of nights in a row over that of independent nights.

        The correlation is one standard error higher: independent nights must not look better than they are.
        """
        mean, _ = self.level()
        about = np.array([(value - mean) * weight**0.5 for value, weight in self.values])
        known = float(about[1:] @ about[:-1] / max(about @ about, 1e-12)) + len(about) ** -0.5
        correlation = float(min(max(known, 0.0), 0.9))
        return (1.0 + correlation) / (1.0 - correlation)

    def step_to(self, nights: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
        """Return the step to the mean of some nights, half its 95 % interval, and the chance of one as large."""
        from scipy.special import stdtr, stdtrit  # scipy.stats would load for 0.2 s what two functions need

        square, freedom = self.pooled()
        if freedom < _FEWEST_NIGHTS - 1:
            return 0.0, np.inf, 1.0
        alike = self.alike()
        (before, weight), (after, weight_after) = self.level(), _mean(nights)
        # the level before is a mean of nights in a row, too; one or two do not show a correlation, and rain must be
        # able to end
        level = (alike if len(self.values) > 2 else 1.0) / weight
        share = (alike if len(nights) > 1 else 1.0) / weight_after + level
        error = float(np.sqrt(max(square, 1e-12) / freedom * share))
        step = after - before
        return step, float(stdtrit(freedom, 0.975)) * error, 2.0 * float(stdtr(freedom, -abs(step) / error))

    def smallest_db(self, chance: float, weight: float) -> float:
        """Return the step of one night of a weight that is shown with a chance of 90 %."""
        from scipy.special import stdtrit

        square, freedom = self.pooled()
        if freedom < _FEWEST_NIGHTS - 1:
            return float("nan")
        reach = -float(stdtrit(freedom, chance / 2.0)) - float(stdtrit(freedom, 0.1))
        return reach * float(np.sqrt(square / freedom * (1.0 / weight + self.alike() / self.level()[1])))


def _split(stretch: _Stretch, window: int) -> tuple[_Stretch, list[tuple[float, float]]]:
    """Return the nights before the last ``window`` ones as a stretch, and those."""
    return replace(stretch, values=stretch.values[:-window]), stretch.values[-window:]


def _between(stretch: _Stretch, window: int) -> float:
    """Return the sum of squares that a step before the last ``window`` nights explains."""
    earlier, nights = _split(stretch, window)
    (before, weight), (after, weight_after) = earlier.level(), _mean(nights)
    return (after - before) ** 2 * weight * weight_after / (weight + weight_after)


def _mean(nights: Sequence[tuple[float, float]]) -> tuple[float, float]:
    total = sum(weight for _, weight in nights)
    return sum(value * weight for value, weight in nights) / total, total


def stepped(node: str, night: Sequence[str], offsets: NightOffsets, nodes: int) -> NodeOffset:
    """Steps of one node's offset, night after night, each judged by the nights before it alone.

    Parameters
    ----------
    node : str
    night : sequence of str
    offsets : NightOffsets
    nodes : int
        How many are looked at together: their false steps are one in a hundred nights.

    Returns
    -------
    NodeOffset
    """
    known = np.flatnonzero(np.isfinite(offsets.offset_db)).tolist()
    values = list(zip(offsets.offset_db[known].tolist(), offsets.links[known].tolist(), strict=True))
    steps: list[Step] = []
    here, before = _Stretch([]), None
    for last, value in enumerate(values):
        here.values.append(value)
        for window, chance in _CHANCES.items():
            if len(here.values) <= window:
                continue
            if _split(here, window)[0].step_to(here.values[-window:])[2] >= chance / nodes:
                continue
            # the window shows that there is a step, least squares when: old nights in its mean would make it too small
            window = max(range(1, min(max(_CHANCES), len(here.values) - 1) + 1), key=lambda n: _between(here, n))
            earlier, nights = _split(here, window)
            step, reach, _ = earlier.step_to(nights)
            # back at the old level after a night or two: one event, not two steps
            if before is not None and len(earlier.values) < 3 and before.step_to([value])[2] >= chance / nodes:
                steps[-1] = replace(steps[-1], back=night[known[last]])
                here, before = replace(before, values=[*before.values, value]), None
            else:
                at = (night[known[last + 1 - window]], night[known[last]])
                steps.append(Step(night=at[0], shown=at[1], step_db=step, step_ci95_db=(step - reach, step + reach)))
                here, before = _Stretch(nights, *earlier.pooled()), earlier
            break
    square, freedom = here.pooled() if values else (0.0, 0)
    # of a night with the usual number of links
    usual = float(np.median([weight for _, weight in values])) if values else 1.0
    return NodeOffset(
        node=node, night=tuple(night[i] for i in known), offset_db=tuple(value for value, _ in values),
        steps=tuple(steps), sd_db=float(np.sqrt(square / freedom / usual)) if freedom else float("nan"),
        smallest_db=here.smallest_db(_CHANCES[1] / nodes, usual) if values else float("nan"),
    )  # fmt: skip

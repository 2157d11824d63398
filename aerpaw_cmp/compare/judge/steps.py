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


def node_offsets(offset_db: ArrayLike, links: Sequence[tuple[str, str]]) -> dict[str, FloatArray]:
    """Offset of every transmitter and receiver, from those of the links between them.

    Parameters
    ----------
    offset_db : (nights, links)
        NaN where a link was not measured.
    links : sequence of (transmitter, receiver)

    Returns
    -------
    dict of str to (nights,)
        NaN where no link of a node was measured. Of one transmitter only the receivers have an offset.

    Notes
    -----
    ``change(night, link) = transmitter(night) + receiver(night)``, change against the link's median, by least squares
    with Huber's weights. What transmitters or receivers share (weather) is the median of the others, and is taken off
    where there are four or more.

    Examples
    --------
    >>> offsets = node_offsets([[1.0, 5.0], [1.0, 5.0], [1.0, 7.0]], [("UAV", "LW1"), ("UAV", "LW2")])
    >>> offsets["LW2 receives"].round(6).tolist()
    [0.0, 0.0, 2.0]
    """
    change = unmasked(offset_db)
    known = np.isfinite(change)
    change = np.where(known, change - _median(change, 0), 0.0)
    ends = [sorted({link[end] for link in links}) for end in (0, 1)]
    ends[0] = ends[0] if len(ends[0]) > 1 else []
    columns = [(end, name) for end in (0, 1) for name in ends[end]]
    design = np.array([[float(link[end] == name) for end, name in columns] for link in links])
    weight = known.astype(float)
    for _ in range(5):
        # a node without a link in a night has an empty row, and no offset below
        normal = np.einsum("tl,li,lj->tij", weight, design, design) + 1e-9 * np.eye(len(columns))
        fitted = np.linalg.solve(normal, ((weight * change) @ design)[..., None])[..., 0]
        residual = np.abs(change - fitted @ design.T)
        scale = 1.4826 * _median(np.where(known, residual, np.nan), 1)
        # a scale of 0 (all links agree) lets every link count in full
        weight = known * np.minimum(1.0, _HUBER * scale / np.maximum(residual, 1e-12) + (scale <= 0.0))
    fitted = np.where(known.astype(float) @ design > 0.0, fitted, np.nan)
    alone = fitted.copy()
    for i, (end, _) in enumerate(columns):
        others = [j for j, of in enumerate(columns) if of[0] == end and j != i]
        if len(others) > 2:  # of fewer one that steps would be seen in the others
            fitted[:, i] -= _median(alone[:, others], 1)[:, 0]
    return {f"{name} {('transmits', 'receives')[end]}": fitted[:, i] for i, (end, name) in enumerate(columns)}


def _median(values: FloatArray, axis: int) -> FloatArray:
    """Median of what is known along an axis, which stays; NaN where nothing is."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a link without a night, a night without a link
        return np.asarray(np.nanmedian(values, axis=axis, keepdims=True))


@dataclass(slots=True)
class _Stretch:
    """Nights in a row without a step; ``square`` and ``freedom`` are of the stretches before it."""

    values: list[float]
    square: float = 0.0
    freedom: int = 0

    def pooled(self) -> tuple[float, int]:
        """Sum of squares about the levels of all stretches, and its degrees of freedom."""
        own = np.array(self.values)
        return self.square + float(((own - own.mean()) ** 2).sum()), self.freedom + len(own) - 1

    def alike(self) -> float:
        """Variance of a mean of nights in a row, over that of independent nights; correlation one error higher."""
        about = np.array(self.values) - np.mean(self.values)
        # one standard error higher: independent nights must not look better than they are
        known = float(about[1:] @ about[:-1] / max(about @ about, 1e-12)) + len(about) ** -0.5
        correlation = float(min(max(known, 0.0), 0.9))
        return (1.0 + correlation) / (1.0 - correlation)

    def step_to(self, nights: Sequence[float]) -> tuple[float, float, float]:
        """Step from here to the mean of some nights, half its 95 % interval, and the chance of one as large."""
        from scipy.special import stdtr, stdtrit  # scipy.stats would load for 0.2 s what two functions need

        square, freedom = self.pooled()
        if freedom < _FEWEST_NIGHTS - 1:
            return 0.0, np.inf, 1.0
        alike = self.alike()
        # the level before is a mean of nights in a row, too; one or two tell no memory, and rain must be able to end
        level = (alike if len(self.values) > 2 else 1.0) / len(self.values)
        share = (alike if len(nights) > 1 else 1.0) / len(nights) + level
        error = float(np.sqrt(max(square, 1e-12) / freedom * share))
        step = float(np.mean(nights) - np.mean(self.values))
        return step, float(stdtrit(freedom, 0.975)) * error, 2.0 * float(stdtr(freedom, -abs(step) / error))

    def smallest_db(self, chance: float) -> float:
        """The step of one night that is shown with a chance of 90 %."""
        from scipy.special import stdtrit

        square, freedom = self.pooled()
        if freedom < _FEWEST_NIGHTS - 1:
            return float("nan")
        reach = -float(stdtrit(freedom, chance / 2.0)) - float(stdtrit(freedom, 0.1))
        return reach * float(np.sqrt(square / freedom * (1.0 + self.alike() / len(self.values))))


def stepped(node: str, night: Sequence[str], offset_db: FloatArray, nodes: int) -> NodeOffset:
    """Steps of one node's offset, night after night, each judged by the nights before it alone.

    Parameters
    ----------
    node : str
    night : sequence of str
    offset_db : (nights,)
        NaN where the node was not measured.
    nodes : int
        How many are looked at together: their false steps are one in a hundred nights.

    Returns
    -------
    NodeOffset
    """
    known = np.flatnonzero(np.isfinite(offset_db)).tolist()
    values = offset_db[known].tolist()
    steps: list[Step] = []
    here, before = _Stretch([]), None
    for last, value in enumerate(values):
        here.values.append(value)
        for window, chance in _CHANCES.items():
            if len(here.values) <= window:
                continue
            earlier, nights = replace(here, values=here.values[:-window]), here.values[-window:]
            step, reach, alone = earlier.step_to(nights)
            if alone >= chance / nodes:
                continue
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
    return NodeOffset(
        node=node, night=tuple(night[i] for i in known), offset_db=tuple(values), steps=tuple(steps),
        sd_db=float(np.sqrt(square / freedom)) if freedom else float("nan"),
        smallest_db=here.smallest_db(_CHANCES[1] / nodes) if values else float("nan"),
    )  # fmt: skip

"""Two reports of one flight on the samples that both have: what moved, and how well a change of error is known.

Everywhere the first report is subtracted from the second: a negative difference of an error says that the second is
better. Errors of both share the measurement and most of the model, so they are compared in pairs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ...common.units import FloatArray, IntArray
from ..rank import MAX_RANK, agreement, cohen_kappa, kappa_of_means, kappa_parts
from ..statistics import intervals as statistics


@dataclass(frozen=True, slots=True, kw_only=True)
class Changed:
    """A number before and after: ``difference`` is second minus first; its 95 % interval is NaN where none is given."""

    first: float
    second: float
    difference: float
    ci95: statistics.Interval = statistics.NO_INTERVAL


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlap:
    """Samples of the first report, of the second, in both, and in one only."""

    first: int
    second: int
    common: int

    def __str__(self) -> str:
        return f"{self.common} of {self.first}, {self.second}"

    @property
    def only_first(self) -> int:
        """Samples that the second report has not."""
        return self.first - self.common

    @property
    def only_second(self) -> int:
        """Samples that the first report has not."""
        return self.second - self.common


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelDifference:
    """RSS of one tower and channel.

    Parameters
    ----------
    tower, channel : str
    samples : Overlap
    scored : Overlap
        Of them those with a residual.
    measured_max_db, simulated_max_db, simulated_rms_db : float
        Largest and root mean square difference of the levels on common samples [dB]; NaN without one.
    offset_db : Changed
        Fitted offset as reported.
    rmse : PairedDifference
        On common scored samples, each report with its own best offset on them; first minus second of that record is
        second minus first report.
    """

    tower: str
    channel: str
    samples: Overlap
    scored: Overlap
    measured_max_db: float
    simulated_max_db: float
    simulated_rms_db: float
    offset_db: Changed
    rmse: statistics.PairedDifference


@dataclass(frozen=True, slots=True, kw_only=True)
class RankDifference:
    """Rank of one tower and K: ``n_changed`` simulated and ``n_reported_changed`` reported ranks on common samples."""

    tower: str
    k: str
    samples: Overlap
    n_changed: int
    n_reported_changed: int
    agreement: Changed
    kappa: Changed


def level_difference(
    tower: str,
    channel: str,
    samples: Overlap,
    first: tuple[FloatArray, FloatArray, FloatArray],
    second: tuple[FloatArray, FloatArray, FloatArray],
    *,
    scored: tuple[int, int],
    offsets_db: tuple[float, float],
) -> LevelDifference:
    """Compare one link.

    Parameters
    ----------
    tower, channel : str
    samples : Overlap
    first, second : tuple of three (n,)
        Level measured (without offset), replayed, and residual of each report on the common samples in time order [dB].
    scored : (int, int)
        Samples with a residual in each whole report.
    offsets_db : (float, float)
        Fitted offset of each [dB].

    Returns
    -------
    LevelDifference
        How far levels, offset and RMSE moved, with an interval.
    """
    moved = _apart(first[1], second[1])
    scored_in_both = np.isfinite(first[2]) & np.isfinite(second[2])
    first_error, second_error = first[2][scored_in_both], second[2][scored_in_both]
    return LevelDifference(
        tower=tower,
        channel=channel,
        samples=samples,
        scored=Overlap(first=scored[0], second=scored[1], common=int(scored_in_both.sum())),
        measured_max_db=_largest(_apart(first[0], second[0])),
        simulated_max_db=_largest(moved),
        simulated_rms_db=float(np.sqrt(np.mean(moved**2))) if len(moved) else float("nan"),
        offset_db=_changed(*offsets_db),
        rmse=statistics.paired_difference(second_error, first_error),
    )


def _apart(first: FloatArray, second: FloatArray) -> FloatArray:
    """Differences where both sides have a value."""
    finite = np.isfinite(first) & np.isfinite(second)
    return np.asarray(second[finite] - first[finite], dtype=np.float64)


def _largest(values: FloatArray) -> float:
    return float(np.abs(values).max()) if len(values) else float("nan")


def _changed(first: float, second: float) -> Changed:
    return Changed(first=first, second=second, difference=second - first)


def rank_difference(
    tower: str,
    k: str,
    samples: Overlap,
    first: tuple[FloatArray, FloatArray],
    second: tuple[FloatArray, FloatArray],
) -> RankDifference:
    """Compare the rank of one tower at one K.

    Parameters
    ----------
    tower, k : str
    samples : Overlap
    first, second : tuple of two (n,)
        Reported and simulated rank of each report on the common samples in time order; NaN: none, 0: no path.

    Returns
    -------
    RankDifference
        Samples whose rank changed, and the change of agreement and kappa with intervals.
    """
    # no report and no path are both 0 here, and a change to or from it counts
    pairs = [np.nan_to_num(np.column_stack(pair)) for pair in (first, second)]
    usable = np.column_stack([*pairs])
    ranked = (usable >= 1).all(axis=1) & (usable <= MAX_RANK).all(axis=1)
    first_rank, second_rank = (pair[ranked].astype(np.int64) for pair in pairs)
    agree, kappa = _agreement_change(first_rank, second_rank)
    return RankDifference(
        tower=tower,
        k=k,
        samples=samples,
        n_changed=int((pairs[0][:, 1] != pairs[1][:, 1]).sum()),
        n_reported_changed=int((pairs[0][:, 0] != pairs[1][:, 0]).sum()),
        agreement=agree,
        kappa=kappa,
    )


def _agreement_change(first: IntArray, second: IntArray) -> tuple[Changed, Changed]:
    """Agreement and kappa of two reports on the same poses, each (n, 2): measured and simulated rank."""
    agree = [agreement(*pairs.T) for pairs in (first, second)]
    kappa = [cohen_kappa(*pairs.T) for pairs in (first, second)]
    if len(first) < 2:
        return _changed(*agree), _changed(*kappa)
    (columns, influence), (other_columns, other_influence) = (kappa_parts(*pairs.T) for pairs in (first, second))
    # both reports in one table: a resample then draws the same poses of both
    joined, width = np.column_stack([columns, other_columns]), columns.shape[1]

    # one resample for both reports: what they share cancels in the difference
    def change(of: list[float], influence: FloatArray, statistic: Callable[[FloatArray], FloatArray]) -> Changed:
        known = statistics.autocorrelation(influence)
        drawn = statistics.bootstrap_means(joined, known.block_length)
        shift = statistic(drawn[:, width:]) - statistic(drawn[:, :width])
        return replace(_changed(*of), ci95=statistics.interval(of[1] - of[0], shift, known))

    return (
        change(agree, other_columns[:, 0] - columns[:, 0], lambda means: means[:, 0]),
        change(kappa, other_influence - influence, kappa_of_means),
    )

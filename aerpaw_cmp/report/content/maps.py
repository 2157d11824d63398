"""Content of the page of the `map` job: finished maps and tables, nothing to be computed.

All maps of a page lie on one grid. Row 0 is the south, column 0 the west. A position without any path ("Z") is NaN
in a map of levels and 0 in a map of ranks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ...common.units import FloatArray, IntArray
from ...compare.statistics.intervals import Interval
from ...site.site import Site
from ..names import k_key
from .flight import ReportData
from .made import Made

# Name of the map in which the nearest tower serves.
JOINT = "joint"


@dataclass(frozen=True, slots=True, kw_only=True)
class RssMap:
    """RSS [dBm] of one tower, or of the nearest tower (``tower="joint"``), at one height.

    ``rss_dbm`` (rows, columns) with NaN for Z; ``coverage`` is the share of positions with a path.
    """

    tower: str
    antennas: str
    altitude_m: float
    rss_dbm: FloatArray
    coverage: float
    foliage: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class RankMap:
    """Rank (rows, columns) for one K at one height, 0 for Z; ``share`` (5,) of Z and rank 1 to 4.

    Without K the rank is the most probable one of a learned receiver, and ``share`` its mean probabilities.
    """

    k: float | None
    altitude_m: float
    rank: IntArray
    share: FloatArray
    foliage: str = ""
    tower: str = JOINT

    @property
    def source(self) -> str:
        """K, or the learned receiver."""
        return "learned receiver" if self.k is None else f"K = {k_key(self.k)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class MapLayer:
    """One layer that the page can show.

    Parameters
    ----------
    quantity, unit : str
        Layers of one quantity share a colour scale and can be subtracted.
    axes : mapping of str to str
        What tells it from the others of its quantity: "Tower", "Antennas", "Foliage", "K", "Height", with their value.
    values : (rows, columns)
        From the south-west; NaN out of coverage.
    classes : tuple of str
        Names of the values 0, 1, ... where the layer holds classes.
    difference : bool
        Its zero means something: a scale around it.
    """

    quantity: str
    unit: str
    axes: Mapping[str, str]
    values: FloatArray = field(repr=False, compare=False)
    classes: tuple[str, ...] = ()
    difference: bool = False


def at_height(altitude_m: float) -> dict[str, str]:
    """The axis of a height, for :class:`MapLayer`."""
    return {"Height": f"{altitude_m:g} m"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Correlation:
    """Correlation against distance, each (bins,), and a fitted model on its own distances."""

    title: str
    distance_m: FloatArray
    correlation: FloatArray
    fit_distance_m: FloatArray | None = None
    fit: FloatArray | None = None
    fit_label: str = ""
    excluded: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class MapError:
    """Mean absolute error of one method for one K and height, under one way of evaluation.

    ``evaluation`` is e.g. ``"leave one out"``, ``"blocks"``, ``"altitude held out"``, ``"along a flight"``.
    """

    evaluation: str
    method: str
    k: float
    altitude_m: float
    mae: float
    n: int
    mae_ci95: Interval | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperRow:
    """A number that the paper states, beside ours, and where to see it."""

    where: str
    what: str
    paper: str
    ours: str
    figure: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapsData(Made):
    """Everything the page of a `map` job shows.

    Parameters
    ----------
    title, name : str
        Headline and short name.
    site : Site
    east_m, north_m : (columns,), (rows,)
        Centres of the cells [m].
    borders_m : tuple of (2, 2) arrays
        Lines between the areas of two towers (Voronoi), east and north [m].
    rank : tuple of RankMap
        The nearest tower serving; ``rank_by_tower`` each alone, for the linked map.
    corrected : tuple of RssMap
        Of each link, raw and corrected by flights (``antennas``): for figures; the linked map has them in ``layers``.
    corrected_rank : tuple of RankMap
        Of each tower with a learned receiver: the traced ranks of every K and those of the receiver.
    flown_m : tuple of (n, 2)
        Tracks of those flights, east and north [m].
    outside_flown : float
        Share of positions further from those flights than a correction reaches.
    corrected_words : str
        First words of the prediction that corrected the levels.
    budget : str
        Power, noise floor and threshold in one sentence, if they are not the paper's.
    flights : tuple of ReportData
        Those that ``--with`` names, replayed and compared.
    layers : tuple of MapLayer
        Besides RSS and rank.
    metrics : mapping
        Written to ``metrics.json`` after the tables of this page.
    """

    title: str
    name: str
    site: Site
    east_m: FloatArray
    north_m: FloatArray
    borders_m: tuple[FloatArray, ...] = ()
    rss: tuple[RssMap, ...] = ()
    corrected: tuple[RssMap, ...] = ()
    corrected_rank: tuple[RankMap, ...] = ()
    flown_m: tuple[FloatArray, ...] = ()
    outside_flown: float = 0.0
    corrected_words: str = ""
    budget: str = ""
    flights: tuple[ReportData, ...] = ()
    rank: tuple[RankMap, ...] = ()
    rank_by_tower: tuple[RankMap, ...] = ()
    layers: tuple[MapLayer, ...] = ()
    correlation: tuple[Correlation, ...] = ()
    errors: tuple[MapError, ...] = ()
    paper: tuple[PaperRow, ...] = ()
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)

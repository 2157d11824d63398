"""The ``map`` job: coverage and rank maps in several foliage modes, their study, and the record of the page.

Paths do not depend on arrays or foliage, so each chunk of positions is searched once. Single elements, arrays and all
foliage modes are evaluated on these paths. The foliage modes differ only in links through foliage, so only these links
are evaluated once per mode.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, fields, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from ..common import units
from ..common.cf import file_attributes, netcdf_bytes
from ..common.errors import InputError, UsageError, about_file, noting_interrupts
from ..common.outputs import file_digest
from ..common.stages import PlannedStage, Progress, Stages
from ..common.text import counted
from ..common.versions import code_digest
from ..compare.rank import singular_values
from ..flight.gains import p833_note
from ..maps import evaluate as interpolation
from ..maps import export
from ..maps import grid as grids
from ..maps.export import maps_dataset
from ..maps.grid import PAPER_BUDGET, Grid, Layer, LinkBudget, MapResult
from ..maps.kriging import OrdinaryKriging, Sampling
from ..maps.store import Reach, TileStore, Tiling, range_m
from ..maps.variogram import BiExponential, BinnedCorrelation, field_correlation
from ..propagation.field.foliage import crown_index, foliage_loss_db, foliage_model, stand_loss_db
from ..propagation.field.sum import channel_matrices, rss_dbm
from ..propagation.geometry import Link, PathSet, Poses, linear_array, single_element
from ..propagation.options import Run, Search
from ..propagation.replay import Replay, replay
from ..report import maps as page
from ..report.prediction import outside_share
from ..site.materials import material
from ..site.site import Site
from ..site.siteyaml import coverage_of, inputs_of_site, load_site
from .options import HIGHEST_M
from .predict import CorrectedMaps
from .workers import InProcess, Lost, Workers

# Foliage modes, from no loss to total loss. The paper uses the last mode.
FOLIAGE = ("none", "attenuating", "opaque")

# Short names of layers.
RATIOS = ("spread", "condition")
BUDGET = ("margin_mimo", "snr_mimo")

# Interpolators of the paper.
INTERPOLATORS = ("Kriging", "makima", "spline")

# Name of the store with all positions of a map in tiles, in the output folder.
ZARR = "maps.zarr"

# A map with more than _TILED_ABOVE receivers (positions times heights) is written in tiles with _TILE_CELLS positions
# per side (about 0.7 MB per tower, height and foliage mode). Only SHOWN_POSITIONS of its positions are drawn and
# exported.
_TILED_ABOVE, _TILE_CELLS, SHOWN_POSITIONS = 1_000_000, 128, 20_000

# The faces of this number of buildings take seconds, during which the map has no share to report.
_MANY_BUILDINGS = 5000


@dataclass(frozen=True, slots=True)
class MapSettings:
    """Settings of a map. The defaults are the paper's (arXiv 2502.10324, table II and section VII).

    Parameters
    ----------
    foliage : tuple of str
        Modes to map, of :data:`FOLIAGE`.
    spacing_m : float
        Distance between neighbouring positions.
    rss_altitudes_m, rank_altitudes_m : tuple of float
        Heights above ground.
    ks : tuple of float
        Singular-value ratios K of the channel rank.
    carrier_hz : float
        Carrier frequency.
    budget : LinkBudget
        Transmit power, receiver noise and the threshold of coverage.
    elements, element_spacing : int, float
        Number of elements of the linear arrays at both ends, which are along north, and their spacing in wavelengths.
    max_depth : int
        Largest number of reflections.
    neighbours, radius_m : int, float
        Number of neighbours M and radius r0 of the interpolators. If the spacing is larger than the paper's, the radius
        is increased until it contains M positions.
    block_m : float
        Side of the held-out blocks.
    study : bool
        True to compute correlation, interpolation and their errors, too.
    seed : int
        Seed of random samples.
    tile_m : float, optional
        Side of the tiles of a map that is written tile by tile. Default: :data:`_TILE_CELLS` positions for more than
        :data:`_TILED_ABOVE` receivers. A smaller map is computed in one piece.
    """

    foliage: tuple[str, ...] = FOLIAGE
    spacing_m: float = grids.PAPER_SPACING_M
    rss_altitudes_m: tuple[float, ...] = grids.PAPER_RSS_ALTITUDES_M
    rank_altitudes_m: tuple[float, ...] = grids.PAPER_RANK_ALTITUDES_M
    ks: tuple[float, ...] = grids.PAPER_KS
    carrier_hz: float = 3.4e9
    budget: LinkBudget = PAPER_BUDGET
    elements: int = 4
    element_spacing: float = 0.5
    max_depth: int = 2
    neighbours: int = 20
    radius_m: float = 150.0
    block_m: float = 300.0
    study: bool = True
    seed: int = 0
    tile_m: float | None = None

    def __post_init__(self) -> None:
        unknown = [name for name in self.foliage if name not in FOLIAGE]
        if unknown or not self.foliage:
            raise UsageError(f"foliage {', '.join(unknown) or '(none given)'!r}", expected=", ".join(FOLIAGE))
        heights = (*self.rss_altitudes_m, *self.rank_altitudes_m)
        if not heights or any(not 0 < h <= HIGHEST_M for h in heights):
            raise UsageError(f"heights {heights}", expected=f"heights above ground [m], above 0, up to {HIGHEST_M:g}")
        if not self.ks or any(not k > 1 for k in self.ks):
            raise UsageError(f"K {self.ks}", expected="ratios of singular values, above 1")
        if fault := units.carrier_fault(self.carrier_hz):
            raise UsageError(fault, cause="--carrier-ghz in megahertz or hertz")
        if self.tile_m is not None and not self.tile_m >= self.spacing_m > 0:
            raise UsageError(f"tiles of {self.tile_m:g} m", expected=f"at least the spacing, {self.spacing_m:g} m")

    def tile_cells(self, grid: Grid) -> int | None:
        """Return the number of positions along a side of a tile, or None for a map in one piece."""
        if self.tile_m is not None:
            return max(1, round(self.tile_m / self.spacing_m))
        receivers = len(grid) * len({*self.rss_altitudes_m, *self.rank_altitudes_m})
        return _TILE_CELLS if receivers > _TILED_ABOVE else None

    @property
    def shown(self) -> str:
        """The foliage mode of the study and of the paper's table: the paper's mode, if it is mapped."""
        return max(self.foliage, key=FOLIAGE.index)

    @property
    def reach_m(self) -> float:
        """Radius of the interpolators."""
        return self.radius_m * max(1.0, self.spacing_m / grids.PAPER_SPACING_M)


# Settings of ``--quick``, a coarse map in seconds.
QUICK: dict[str, Any] = {"spacing_m": 120.0, "rss_altitudes_m": (30.0, 110.0), "rank_altitudes_m": (3.0, 30.0, 110.0)}


def map_settings(site: str, chosen: Mapping[str, Any], *, quick: bool = False) -> MapSettings:
    """Return the settings of a map.

    Parameters
    ----------
    site : str
        Site whose key ``coverage`` specifies a carrier and a link budget.
    chosen : mapping
        Fields of :class:`MapSettings` and of its link budget, which replace those of the site. None means not chosen. A
        threshold replaces the thresholds of the site for both level and SNR.
    quick : bool
        Use :data:`QUICK` instead of the paper's defaults.

    Returns
    -------
    MapSettings
    """
    given = {name: value for name, value in chosen.items() if value is not None}
    coverage, file, line = coverage_of(site)
    stated = coverage.model_dump(exclude_none=True)
    carrier = {"carrier_hz": 1e9 * stated.pop("carrier_ghz")} if "carrier_ghz" in stated else {}
    options = {item.name: given.pop(item.name) for item in fields(LinkBudget) if item.name in given}
    if {"threshold_dbm", "threshold_snr_db"} & set(options):
        stated = {name: value for name, value in stated.items() if not name.startswith("threshold")}
    with nullcontext() if options else about_file(file, line):
        budget = LinkBudget(**stated | options)
    study = {"study": budget == PAPER_BUDGET}  # it takes longer than the map, and a planner asks for coverage
    return MapSettings(budget=budget, **study | (QUICK if quick else {}) | carrier | given)


# A tile that a worker returns: maps by foliage mode, and the number of paths.
TileDone = tuple[dict[str, MapResult], int]


# --- the engine ----------------------------------------------------------------------------------------------------


class SiteChannels:
    """The replay of all links of a map in several foliage modes, on common paths.

    The first request for a chunk evaluates all modes. The results of a chunk are stored until each mode requests them.
    """

    def __init__(self, site: Site, settings: MapSettings) -> None:
        self.settings, self.names = settings, tuple(site.towers)
        self.crowns = {mode: crown_index(site.under(mode).trees) for mode in settings.foliage}
        power_dbm = settings.budget.tx_power_dbm + float(units.db_from_power(settings.elements))
        reach_m = range_m(settings.carrier_hz, power_dbm, units.THERMAL_NOISE_DBM_HZ)
        self.reach = Reach(site, reach_m, max_depth=settings.max_depth)
        self.paths = self._done = self._all = 0
        self._progress: Callable[[float], object] | None = None
        self._ready: dict[tuple[str, bytes], grids.Evaluation] = {}
        self._take_site(site)

    def _take_site(self, site: Site) -> None:
        """Use the part of the site that reaches a tile."""
        self.site = site
        apart_m = self.settings.element_spacing * units.wavelength_m(self.settings.carrier_hz)
        self.siso = self._link(single_element())
        self.mimo = self._link(linear_array(self.settings.elements, apart_m, 0.0))
        self.sources_m = np.array([tower.position_m for tower in site.towers.values()]).reshape(-1, 3)

    def _link(self, array: Any) -> Link:
        towers = dict.fromkeys(self.site.towers, array)
        return Link(self.settings.carrier_hz, towers, array, self.settings.budget.tx_power_dbm, uav_transmits=False)

    def of(self, mode: str) -> grids.Evaluate:
        """Return the evaluation of one foliage mode."""

        def evaluate(position_m: units.FloatArray) -> grids.Evaluation:
            chunk = position_m.tobytes()
            if (mode, chunk) not in self._ready:
                self._ready |= {(name, chunk): evaluated for name, evaluated in self._all_modes(position_m).items()}
            return self._ready.pop((mode, chunk))

        return evaluate

    def tile(self, order: TileOrder, progress: Callable[[float], object] | None = None) -> TileDone:
        """Map one tile with the towers and buildings that can reach it."""
        s = self.settings
        grid = Tiling(Grid.over_area(self.reach.site.area_m, s.spacing_m), order.cells).grid_of(order.number)
        west, east, south, north = grid.area_m
        heights = (*s.rss_altitudes_m, *s.rank_altitudes_m)
        self._take_site(self.reach.of(np.array([[west, south, min(heights)], [east, north, max(heights)]])))
        self.paths = 0
        maps = self._maps(grid, progress)
        return maps, self.paths

    def _maps(self, grid: Grid, progress: Callable[[float], object] | None = None) -> dict[str, MapResult]:
        s = self.settings
        towers = {name: tower.position_m for name, tower in self.reach.site.towers.items()}
        self._progress, self._done, self._all = progress, 0, len(grid) * len({*s.rss_altitudes_m, *s.rank_altitudes_m})
        return {
            mode: grids.map_job(
                grid, towers, self.of(mode), rss_altitudes_m=s.rss_altitudes_m, rank_altitudes_m=s.rank_altitudes_m,
                ks=s.ks,
            )
            for mode in s.foliage
        }  # fmt: skip

    def empty(self, grid: Grid) -> dict[str, MapResult]:
        """Return empty maps, without coverage, by foliage mode."""
        self._take_site(replace(self.reach.site, towers={}))
        return self._maps(grid)

    def _all_modes(self, position_m: units.FloatArray) -> dict[str, grids.Evaluation]:
        s, n = self.settings, len(position_m)
        if not self.site.towers:
            none = np.empty((n, 0))
            nothing = grids.Evaluation(none, none, none, np.empty((n, 0, s.elements)))
            return dict.fromkeys(s.foliage, self._for_all_towers(nothing))
        poses = Poses(self._above_ground(position_m), np.broadcast_to(np.eye(3), (n, 3, 3)))
        search, run = Search(max_depth=s.max_depth), Run(extent_m=self.reach.extent_m, progress=self._progress_of(n))
        replayed = replay(self.site, self.siso, poses, search, run=run)
        self.paths += len(replayed.paths)
        siso, mimo = replayed.h, channel_matrices(replayed.paths, replayed.faces, self.sources_m, poses, self.mimo).h
        result = {}
        for mode in s.foliage:
            loss = self._loss_db(mode, replayed.paths, poses)
            shaded_siso = self._shaded(siso, replayed, poses, self.siso, loss)
            shaded_mimo = self._shaded(mimo, replayed, poses, self.mimo, loss)
            level = self._rss_dbm(shaded_mimo)
            covered = np.isfinite(level)
            spread = np.where(covered, level_sd_db(shaded_mimo), np.nan)
            sigma = np.where(covered[..., None], singular_values(shaded_mimo), 0.0)
            result[mode] = self._for_all_towers(grids.Evaluation(self._rss_dbm(shaded_siso), level, spread, sigma))
        return result

    def _progress_of(self, count: int) -> Callable[[float], object] | None:
        """Return the progress of a path search for the next ``count`` positions, as a part of the map's progress."""
        before, self._done = self._done, self._done + count
        progress, every = self._progress, self._all
        return None if progress is None else lambda share: progress((before + share * count) / every)

    def _for_all_towers(self, some: grids.Evaluation) -> grids.Evaluation:
        """Return the evaluation of all towers. Towers that do not reach a tile are out of coverage."""
        if len(self.site.towers) == len(self.names):
            return some
        at = [self.names.index(name) for name in self.site.towers]

        def placed(values: units.FloatArray) -> units.FloatArray:
            every = np.full((len(values), len(self.names), *values.shape[2:]), np.nan)
            every[:, at] = values
            return every

        siso, mimo, spread = (placed(level) for level in some.levels)
        return grids.Evaluation(siso, mimo, spread, placed(some.singular_values))

    def _rss_dbm(self, h: units.ComplexArray) -> units.FloatArray:
        """Return the level of channels (..., n_rx, n_tx) with equal feeds in phase, averaged over UAV elements."""
        amplitude = h.sum(axis=-1) / np.sqrt(h.shape[-1])
        return rss_dbm((amplitude.real**2 + amplitude.imag**2).mean(axis=-1), self.settings.budget.tx_power_dbm)

    def _above_ground(self, position_m: units.FloatArray) -> units.FloatArray:
        if self.site.dem is None:
            return position_m
        ground = self.site.dem.ground_m(position_m[:, 0], position_m[:, 1])
        return np.column_stack([position_m[:, :2], position_m[:, 2] + ground])

    def _loss_db(self, mode: str, paths: PathSet, poses: Poses) -> units.FloatArray | None:
        if mode == "none" or not self.site.wooded:
            return None
        model = foliage_model(mode, self.settings.carrier_hz)
        source, target = self.sources_m[paths.tower], poses.position_m[paths.pose]
        trees_db = foliage_loss_db(source, paths.vertices_m, target, self.crowns[mode], model)
        wavelength = units.wavelength_m(self.settings.carrier_hz)
        return trees_db + stand_loss_db(self.site.under(mode), source, paths.vertices_m, target, model, wavelength)

    def _shaded(
        self, clear: units.ComplexArray, replayed: Replay, poses: Poses, link: Link, loss_db: units.FloatArray | None
    ) -> units.ComplexArray:
        """Return channel matrices with foliage. Links without loss are not evaluated again."""
        if loss_db is None:
            return clear
        paths, h = replayed.paths, clear.copy()
        touched = np.zeros(h.shape[:2], dtype=np.bool_)
        touched[paths.pose[loss_db > 0], paths.tower[loss_db > 0]] = True
        # infinite loss means an obstacle, not a weak path
        again = touched[paths.pose, paths.tower] & np.isfinite(loss_db)
        some = channel_matrices(paths.select(again), replayed.faces, self.sources_m, poses, link, loss_db[again])
        h[touched] = some.h[touched]
        return np.asarray(h)


@dataclass(frozen=True, slots=True, kw_only=True)
class TileOrder:
    """A request to compute one map tile: its ``number``, with ``cells`` positions per side of a tile."""

    site: str
    settings: MapSettings
    cells: int
    number: int


def map_tile(order: TileOrder) -> TileDone:
    """Evaluate a tile of a map."""
    return _channels_of(order.site, order.settings).tile(order)


@lru_cache(maxsize=1)
def _channels_of(site: str, settings: MapSettings) -> SiteChannels:
    """Return the channels of a site, which a worker reuses for its tiles."""
    return SiteChannels(load_site(site), settings)


def level_sd_db(h: units.ComplexArray) -> units.FloatArray:
    """Return the standard deviation of the level over the element pairs of channels (..., n_rx, n_tx) [dB]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(units.db_from_power(h.real**2 + h.imag**2).std(axis=(-2, -1)))


# --- the job -------------------------------------------------------------------------------------------------------

# Number of draws of M random samples. Several are needed, because the best interpolator differs between draws.
DRAWS = 10


@dataclass(slots=True)
class MapOutcome:
    """All results of one run.

    ``maps`` contains the maps by foliage mode. For a map in tiles, they are at the positions in ``tiles``. ``studies``
    contains one study per treatment of positions out of coverage: these are missing ("missing"), have rank 0 ("zero"),
    or have rank 0 with M random samples instead of the M nearest samples ("random"). ``draws`` contains the scores of
    "random" for :data:`DRAWS` draws. ``blocks`` contains the errors of each interpolator on held-out square blocks.
    """

    site: Site
    settings: MapSettings
    maps: dict[str, MapResult] = field(default_factory=dict)
    studies: dict[str, interpolation.Study] = field(default_factory=dict)
    draws: list[Mapping[str, interpolation.Score]] = field(default_factory=list)
    blocks: dict[str, interpolation.Score] = field(default_factory=dict)
    correlations: dict[str, BinnedCorrelation] = field(default_factory=dict)
    paths: int = 0
    tiles: dict[str, Any] = field(default_factory=dict)
    store: TileStore | None = None
    corrected: CorrectedMaps | None = None

    @property
    def shown(self) -> MapResult:
        """The maps of the foliage mode that is shown."""
        return self.maps[self.settings.shown]

    def ordered(self) -> list[tuple[str, MapResult]]:
        """Return foliage modes and maps, the mode with the largest loss first."""
        return sorted(self.maps.items(), key=lambda item: -FOLIAGE.index(item[0]))


def make_maps(
    site: Site,
    settings: MapSettings,
    stages: Stages,
    *,
    workers: Workers | None = None,
    name: str = "",
    out: Path | None = None,
) -> MapOutcome:
    """Evaluate the grid of a site in every foliage mode.

    Parameters
    ----------
    site : Site
    settings : MapSettings
    stages : Stages
    workers : Workers, optional
        Workers for the pieces of the grid.
    name : str
        Name of the site for workers.
    out : Path, optional
        Output folder. Finished tiles are files in ``NAME.tiles`` next to it. None means a map in one piece.

    Returns
    -------
    MapOutcome
        Maps by foliage mode, without a study.

    Raises
    ------
    UsageError, InputError, OutputError
        If zarr is not installed, tiles were lost, or the disk cannot be written.
    """
    outcome = MapOutcome(site, settings)
    grid = Grid.over_area(site.area_m, settings.spacing_m)
    crew = workers or InProcess()
    share = partial(stages.progress, "maps")
    tile_cells = None if out is None else settings.tile_cells(grid)
    # make four tiles per worker: with one tile per worker, all workers would wait for the slowest one
    shared = math.ceil(math.sqrt(len(grid) / (4 * crew.count)))
    tiling = Tiling(grid, tile_cells or (shared if crew.count > 1 else max(grid.shape)))
    with stages("maps"):
        if len(site.buildings) > _MANY_BUILDINGS:
            stages.progress(f"walls and roofs of {counted(len(site.buildings), 'building')}")
        channels = SiteChannels(site, settings)
        evaluate = partial(channels.tile, progress=share if len(tiling) < 2 else None) if crew.count < 2 else map_tile
        order = partial(TileOrder, site=name, settings=settings, cells=tiling.cells)
        if out is not None and tile_cells:
            folder, empty = out.with_name(f"{out.name}.tiles"), channels.empty(tiling.grid_of(0))
            outcome.store = TileStore(folder, tiling, _job_of(name, settings), empty)
            _write_tiles(outcome, outcome.store, partial(crew.run, evaluate), order, stages.progress)
            outcome.tiles["store"] = str(out / ZARR)
            return outcome
        parts: dict[int, TileDone] = {}

        def done(number: int, result: TileDone | Lost) -> None:
            if isinstance(result, Lost):
                raise InputError(f"a tile of the map: {result.message}")
            parts[number] = result
            share(len(parts) / len(tiling))

        crew.run(evaluate, [order(number=number) for number in range(len(tiling))], done)
        outcome.maps, outcome.paths = tiling.joined(parts[number] for number in range(len(tiling)))
    return outcome


def _write_tiles(
    outcome: MapOutcome, store: TileStore, run: Callable[..., None], order: Callable[..., TileOrder], progress: Progress
) -> None:
    """Compute the missing tiles, write a file for each, and read some positions of all tiles for the page."""
    tiling, missing = store.tiling, store.missing()
    if store.damaged:
        progress(f"{counted(store.damaged, 'finished tile')} damaged: computed again")
    if len(missing) < len(tiling):
        progress(f"{len(tiling) - len(missing)} of {counted(len(tiling), 'tile')} computed before")
    lost: list[str] = []
    written = itertools.count(len(tiling) - len(missing) + 1)

    def done(number: int, result: TileDone | Lost) -> None:
        if isinstance(result, Lost):
            lost.append(result.message)
            return
        store.write(missing[number], *result)
        progress("maps", next(written) / len(tiling))

    with noting_interrupts(f"{store.folder} contains the finished tiles: the same command computes the others"):
        run([order(number=number) for number in missing], done)
    if lost:
        raise InputError(
            f"{len(lost)} of {counted(len(tiling), 'tile')} lost: {lost[0]}",
            cause="too little memory; the finished tiles are kept, and the same command computes the others",
        )
    step = math.ceil(math.sqrt(len(tiling.grid) / SHOWN_POSITIONS))
    outcome.maps, outcome.paths = tiling.joined(map(store.read, range(len(tiling))), step)
    # the study needs close neighbours, which a selection of every n-th position does not contain
    outcome.settings = replace(outcome.settings, study=False)
    outcome.tiles = {"tiles": len(tiling), "positions": len(tiling.grid), "shown_every": step}


def _job_of(site: str, settings: MapSettings) -> dict[str, Any]:
    """Return everything on which the values of a map depend: settings, content of the site's files, program."""
    without = ("study", "neighbours", "radius_m", "block_m", "seed")
    chosen = {key: str(value) for key, value in asdict(settings).items() if key not in without}
    files = [file_digest(file)[:12] for file in inputs_of_site(site)]
    return {"site": files, **chosen, "program": code_digest()[:12]}


def map_stages(place: Site, settings: MapSettings, flights: Sized = ()) -> list[PlannedStage]:
    """Return the stages of a map for its dry run. One position is mapped, so that errors are found in the dry run."""
    grid = Grid.over_area(place.area_m, settings.spacing_m)
    first_m = np.append(grid.points_m[0, :2], min(settings.rss_altitudes_m, default=30.0))
    SiteChannels(place, settings).of(settings.shown)(first_m[None])
    heights, tile = {*settings.rss_altitudes_m, *settings.rank_altitudes_m}, settings.tile_cells(grid)
    sides = {"position": len(grid), "height": len(heights), "tower": len(place.towers)}
    work = f"{counted(math.prod(sides.values()), 'link')}: {', '.join(counted(n, name) for name, n in sides.items())}"
    stages = {
        "maps": work + (f", in tiles of {tile} x {tile} positions" if tile else ""),
        "correct": counted(len(flights), "flight") if flights else "",
        "study": "correlation and interpolation" if settings.study and not tile else "",
        "export, page": f"layers of {counted(len(settings.foliage), 'foliage mode')}",
    }
    return [PlannedStage(name, what) for name, what in stages.items() if what]


def check_study(place: Site, settings: MapSettings) -> None:
    """Refuse a study of fewer than two rank heights, or unknown materials, before any map is computed."""
    solids = {place.ground_material, *(building.material for building in place.buildings)}
    for name in sorted(solids) if settings.max_depth else ():
        material(name).relative_permittivity(settings.carrier_hz)
    studied = settings.study and not settings.tile_cells(Grid.over_area(place.area_m, settings.spacing_m))
    heights = [height for height in settings.rank_altitudes_m if height >= interpolation.LOWEST_M]
    if studied and len(heights) < 2:
        raise UsageError(
            f"{counted(len(heights), 'rank height')} at or above {interpolation.LOWEST_M:g} m",
            expected="two or more for the study, or --no-study",
        )


def study_maps(outcome: MapOutcome, stages: Stages) -> None:
    """Compute the correlation, the interpolation and its errors, on maps with the foliage mode of the paper."""
    s, result = outcome.settings, outcome.shown
    rank = interpolation.rank_fields(result)[1]
    local = Sampling(neighbours=s.neighbours, radius_m=s.reach_m, seed=s.seed)
    with stages("leave one out"):
        zeros, towers = interpolation.rank_fields(result, "zero")[1], result.towers_m
        outcome.studies["missing"] = interpolation.interpolation_study(result.grid, rank, towers, local)
        outcome.studies["zero"] = interpolation.interpolation_study(result.grid, zeros, towers, local)
        draws = [replace(local, selection="random", seed=s.seed + draw) for draw in range(DRAWS)]
        random = outcome.studies["random"] = interpolation.interpolation_study(result.grid, zeros, towers, draws[0])
        outcome.draws = [
            random.scores,
            *(interpolation.paper_scores(result.grid, zeros, random.fit, draw) for draw in draws[1:]),
        ]
    with stages("correlation"):
        points, width = result.grid.points_m, s.spacing_m
        outcome.correlations = {
            "horizontal": field_correlation(points, rank, width_m=width),
            "RSS": field_correlation(points, result.rss().T, width_m=width),
        }
    with stages("held-out tests"):
        for name, model in _far_reaching(outcome).items():
            outcome.blocks[name] = interpolation.blocked(model, result.grid.points_m, rank, s.block_m)


def _far_reaching(outcome: MapOutcome) -> dict[str, interpolation.Predictor]:
    """Return interpolators without a distance limit, for held-out blocks."""
    neighbours = outcome.settings.neighbours
    return {
        "Kriging": OrdinaryKriging(outcome.studies["missing"].fit, neighbours, outside="nearest"),
        "nearest": interpolation.InverseDistance(neighbours=1, radius_m=np.inf),
        "inverse distance": interpolation.InverseDistance(neighbours=neighbours, radius_m=np.inf),
        "serving-tower mean": interpolation.ServingTowerMean(outcome.shown.towers_m),
    }


# --- the page ------------------------------------------------------------------------------------------------------


def maps_record(
    outcome: MapOutcome, *, name: str, stages_s: Mapping[str, float], paper: Iterable[page.PaperRow] = ()
) -> page.MapsData:
    """Return the record for :func:`aerpaw_cmp.report.maps.write_maps`.

    Parameters
    ----------
    outcome : MapOutcome
    name : str
        Name of the maps.
    stages_s : mapping of str to float
        Seconds per stage.
    paper : iterable of PaperRow
        Rows of the paper's table.

    Returns
    -------
    MapsData
    """
    s, result, flown = outcome.settings, outcome.shown, outcome.corrected
    rss = tuple(item for mode, maps in outcome.ordered() for item in _rss_maps(maps, mode, s.budget))
    rank = tuple(item for mode, maps in outcome.ordered() for item in _rank_maps(maps, mode))
    towers = result.tower_names if len(result.tower_names) > 1 else ()
    by_tower = (item for mode, maps in outcome.ordered() for tower in towers for item in _rank_maps(maps, mode, tower))
    return page.MapsData(
        title=f"Coverage and rank maps, {outcome.site.name}",
        name=name,
        site=outcome.site,
        east_m=result.grid.east_m,
        north_m=result.grid.north_m,
        borders_m=tuple(border.line_m for border in result.borders),
        rss=rss,
        corrected=() if flown is None else tuple(flown.rss_maps(result.grid)),
        corrected_rank=tuple(_rank_versions(outcome)),
        flown_m=() if flown is None else tuple(line.T for line in flown.prediction.flown.values()),
        outside_flown=0.0 if flown is None else outside_share(flown.prediction.table),
        budget="" if s.budget == PAPER_BUDGET else f"{s.budget.sentence()} ",
        corrected_words="" if flown is None else flown.prediction.verdict,
        rank=rank,
        rank_by_tower=tuple(by_tower),
        layers=(
            *(layer for layer in _further_layers(outcome) if layer.name in BUDGET or layer.foliage == s.shown),
            *(() if flown is None else flown.layers(result.grid)),
            *_linked_layers(outcome),
        ),
        correlation=_correlations(outcome),
        errors=tuple(_errors(outcome)),
        paper=tuple(paper),
        warnings=() if flown is None else tuple(flown.prediction.warnings),
        notes=(*_notes(outcome), *(() if flown is None else flown.prediction.notes)),
        settings=asdict(s),
        stages_s=dict(stages_s),
        metrics=_metrics(outcome),
    )


def _rss_maps(result: MapResult, mode: str, budget: LinkBudget) -> Iterator[page.RssMap]:
    for antennas in grids.ANTENNAS:
        for row, height in enumerate(result.rss_altitudes_m):
            for tower in (*result.tower_names, None):
                values = result.rss(antennas, tower)[row]
                yield page.RssMap(
                    name=f"rss_{antennas}",
                    tower=tower or grids.JOINT,
                    antennas=antennas.upper(),
                    height_m=height,
                    values=result.grid.raster(values),
                    coverage=float(budget.covered(values).mean()),
                    foliage=mode,
                )


def _rank_maps(result: MapResult, mode: str, tower: str | None = None) -> Iterator[page.RankMap]:
    """Yield rank maps of the serving tower, or of one tower."""
    ranks, shares = result.ranks(tower), result.rank_shares(tower)
    for (column, k), (row, height) in itertools.product(enumerate(result.ks), enumerate(result.rank_altitudes_m)):
        yield page.RankMap(
            name=f"rank_k{grids.in_name(k)}",
            k=k,
            height_m=height,
            values=result.grid.raster(np.where(ranks[row, column] > 0, ranks[row, column], np.nan)),
            share=shares[row, column],
            foliage=mode,
            tower=tower or grids.JOINT,
        )


def _rank_versions(outcome: MapOutcome) -> Iterator[page.RankMap]:
    """Yield traced and learned ranks of every tower with a learned receiver."""
    if outcome.corrected is not None:
        for tower in dict.fromkeys(tower for tower, _ in outcome.corrected.ranks):
            yield from _rank_maps(outcome.shown, outcome.settings.shown, tower)
        yield from outcome.corrected.rank_maps(outcome.shown.grid)


def _linked_layers(outcome: MapOutcome) -> Iterator[Layer]:
    """Yield layers for the page only: towers in coverage, and the serving tower if there are several."""
    budget = outcome.settings.budget
    for mode, result in outcome.ordered():
        for antennas in grids.ANTENNAS:
            layer = partial(Layer, antennas=antennas.upper(), foliage=mode)
            each = budget.covered(result.rss_mimo_dbm if antennas == "mimo" else result.rss_siso_dbm)
            for row, height in enumerate(result.rss_altitudes_m):
                covering = result.grid.raster(each[row].sum(axis=0))
                yield layer(quantity="Towers in coverage", unit="towers", height_m=height, values=covering)
    if len(outcome.shown.tower_names) > 1:
        yield _serving(outcome)


def _serving(outcome: MapOutcome) -> Layer:
    """Return the layer of the nearest tower."""
    shown = outcome.shown
    serving = shown.grid.raster(shown.serving.astype(np.float64))
    return Layer(name="serving_tower", quantity="Serving tower", unit="", values=serving, classes=shown.tower_names)


def _further_layers(outcome: MapOutcome) -> Iterator[Layer]:
    """Yield margin above the threshold, SNR, singular-value spread and condition number of the nearest tower."""
    budget, ratios = outcome.settings.budget, {"spread": "Singular-value spread", "condition": "Condition number"}
    for mode, result in outcome.ordered():
        layer, raster = partial(Layer, unit="dB", tower=grids.JOINT, foliage=mode), result.grid.raster
        for height, level in zip(result.rss_altitudes_m, result.rss(), strict=True):
            if budget.level_dbm is not None:
                above, quantity = raster(level - budget.level_dbm), f"Margin above {budget.level_dbm:.1f} dBm"
                yield layer(name="margin_mimo", quantity=quantity, height_m=height, values=above)
            if budget.noise_dbm is not None:
                above = raster(level - budget.noise_dbm)
                yield layer(name="snr_mimo", quantity="SNR", height_m=height, values=above)
        for name, quantity in ratios.items():
            joint = np.minimum(result.of_tower(getattr(result, f"{name}_db")), grids.RATIO_LIMIT_DB)
            for height, values in zip(result.rank_altitudes_m, joint, strict=True):
                yield layer(name=name, quantity=quantity, height_m=height, values=raster(values))


def _correlations(outcome: MapOutcome) -> dict[str, tuple[BinnedCorrelation, BiExponential | None]]:
    """Return each correlation against distance, with its fitted curve if there is one, by title."""
    titles = {"horizontal": "Rank, one height", "RSS": "RSS, one height"}
    studies = {key: outcome.studies[key] for key in interpolation.TREATMENTS if key in outcome.studies}
    fitted = {
        f"Rank vectors, {interpolation.TREATMENTS[key]}": (study.correlation, study.fit)
        for key, study in studies.items()
    }
    return fitted | {titles[key]: (binned, None) for key, binned in outcome.correlations.items()}


def _errors(outcome: MapOutcome) -> Iterator[page.MapError]:
    if not outcome.studies:
        return
    heights, _ = interpolation.rank_fields(outcome.shown)
    chosen, zero = outcome.studies["random"].scores, interpolation.TREATMENTS["zero"]
    tables: dict[str, dict[str, interpolation.Score]] = {
        "leave one out": dict(outcome.studies["missing"].scores),
        f"leave one out, {zero}": dict(outcome.studies["zero"].scores),
        f"leave one out, {zero}, random samples": {name: chosen[name] for name in INTERPOLATORS if name in chosen},
        f"blocks of {outcome.settings.block_m:g} m held out": outcome.blocks,
    }
    fields = list(itertools.product(enumerate(heights), enumerate(outcome.shown.ks)))
    for evaluation, scores in tables.items():
        for method, score in scores.items():
            for (row, height), (column, k) in fields:
                yield page.MapError(
                    evaluation=evaluation, method=method, k=k, altitude_m=height,
                    mae=float(score.mae[row, column]), n=int(score.n[row, column]),
                )  # fmt: skip


def _notes(outcome: MapOutcome) -> tuple[str, ...]:
    """Return notes about the link budget, foliage loss beyond its table, and tiles."""
    note = p833_note(outcome.settings.carrier_hz) if "attenuating" in outcome.settings.foliage else None
    notes = [outcome.settings.budget.sentence(), *([] if note is None else [note])]
    if outcome.tiles:
        each, all_ = outcome.tiles["shown_every"], outcome.tiles["positions"]
        notes.append(
            f"The map of {counted(all_, 'position')} is in {Path(outcome.tiles['store']).name}. "
            f"This page and its files have one in {each} positions along each axis."
        )
    return tuple(notes)


def _metrics(outcome: MapOutcome) -> dict[str, Any]:
    """Return the content of metrics.json that is not in the tables of the page."""
    result: dict[str, Any] = {"paths": outcome.paths, "tiles": outcome.tiles, "settings": asdict(outcome.settings)}
    for key in ("zero", "missing"):
        if key not in outcome.studies:
            continue
        study = outcome.studies[key]
        result.setdefault("correlation", {})[f"z_{key}"] = {
            **asdict(study.fit),
            "positions": study.correlation.positions,
            "excluded_constant": study.correlation.excluded_constant,
        }
    return result


# --- files -------------------------------------------------------------------------------------------------------


def export_maps(outcome: MapOutcome, folder: Path, progress: Progress) -> list[Path]:
    """Write layers.csv, maps.kmz, maps.zarr (for a map in tiles), and maps.nc if its libraries are installed.

    ``progress`` receives the reason if maps.nc is omitted.
    """
    site, grid, flown = outcome.site, outcome.shown.grid, outcome.corrected
    layers: list[Layer] = [_serving(outcome)]
    for mode, result in outcome.ordered():
        layers += _rss_maps(result, mode, outcome.settings.budget)
        for tower in (None, *result.tower_names):
            layers += _rank_maps(result, mode, tower)
    layers += _further_layers(outcome)
    corrected = [] if flown is None else [*flown.layers(grid), *flown.rank_maps(grid)]
    joint = [layer for layer in layers if layer.tower in ("", grids.JOINT) and layer.name not in RATIOS]
    further = [layer for layer in joint if layer.name in BUDGET]
    named = {name: tower.position_m.tolist() for name, tower in site.towers.items()}
    table = export.MapLayers(
        grid=grid,
        frame=site.frame,
        layers=layers + corrected,
        towers_m=named,
        borders=outcome.shown.borders,
        credit=site.credit,
    )
    written = [
        export.write_csv(folder / "layers.csv", table),
        export.write_kmz(folder / "maps.kmz", replace(table, layers=joint + corrected), title=site.name),
    ]
    if outcome.store is not None:
        written.append(outcome.store.write_zarr(folder / ZARR, site.frame, _about_maps(site)))
    try:
        maps = maps_dataset(dict(outcome.ordered()), site.frame, _about_maps(site), further + corrected)
        (folder / "maps.nc").write_bytes(netcdf_bytes(maps))
        written.append(folder / "maps.nc")
    except UsageError as missing:
        progress(str(missing))
    return written


def _about_maps(site: Site) -> dict[str, str]:
    """Return the attributes of maps.nc and maps.zarr."""
    about = file_attributes(
        title=site.name, source="ray tracing", comment="A missing level or a rank of 0 means that there is no path."
    )
    return about | ({"acknowledgement": site.credit} if site.credit else {})

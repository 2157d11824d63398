"""The replay of a flight, stage by stage: scene, paths, what lets them pass, field, levels."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.cf import Dataset
from ..common.counting import counted
from ..common.errors import UsageError
from ..common.units import BoolArray, ComplexArray, FloatArray, db_from_power, wavelength_m
from ..site.site import Site
from .engine.engines import chosen_samples, path_cache, search_or_read
from .field.sum import Fields, Further, channel_matrices, mean_pair_power, rss_dbm
from .geometry.arrays import Link, Poses
from .geometry.paths import Faces, PathSet, Surfaces, legs
from .options import Field, Run, Search
from .path_table import Ends, PathTable, frequency_responses, impulse_responses, path_table
from .scene import Omission, Scene, buried_towers, within_reach
from .search import mirror
from .search.terrain import on_terrain

# Poses of which levels are made at once.
# H of so many poses stays in a processor's cache between its two sums.
LEVELS_AT_ONCE = 1024

# Arrays (poses, towers, ...) of a replay.
PER_LINK = ("rss_dbm", "rss_power_dbm", "h", "has_path")


@dataclass(frozen=True, slots=True, repr=False)
class Replay:
    """Result of a replay.

    Parameters
    ----------
    rss_dbm : (poses, towers)
        Coherent: from ``|H|^2``, see :func:`aerpaw_cmp.propagation.field.sum.rss_dbm`. NaN without a path.
    rss_power_dbm : (poses, towers)
        From the sum of the paths' powers.
    h : (poses, towers, n_rx, n_tx) complex128
        Zero without a path.
    has_path : (poses, towers) bool
    contributions : tuple
        All that H and both levels are made of: the reflections and lines of sight, then the paths of each further kind
        (:class:`~aerpaw_cmp.propagation.field.sum.Further`) that was asked for.
    faces : Faces
    ends : Ends
        Link, poses, places of the towers and further losses.
    seconds : float
        Of this call: path search (or reading the cache) and fields.
    search_seconds : float
        Of the path search alone, when it was made: an entry of the cache remembers it.
    engine : str
    omitted : list of Omission
        What was not modelled; ``left_out`` says it for the report.
    towers : tuple of str
        Order of the tower axis.
    from_cache : bool
        Nothing was searched.
    samples : int
        Rays per tower; 0 for an engine without rays.
    samples_reason : str
        Why so many, where the number was found by pilots.
    surfaces : Surfaces, optional
        What the faces are made of, where the site is a scene of triangles.
    """

    rss_dbm: FloatArray
    rss_power_dbm: FloatArray
    h: ComplexArray
    has_path: BoolArray
    contributions: tuple[Any, ...]
    faces: Faces
    ends: Ends
    seconds: float
    search_seconds: float
    engine: str
    towers: tuple[str, ...]
    omitted: list[Omission] = field(default_factory=list)
    from_cache: bool = False
    samples: int = 0
    samples_reason: str = ""
    surfaces: Surfaces | None = None

    @property
    def paths(self) -> PathSet:
        """Reflections and lines of sight."""
        return self.contributions[0]  # type: ignore[no-any-return]

    @property
    def further(self) -> tuple[Further, ...]:
        """Paths of further kinds."""
        return self.contributions[1:]

    def level_dbm(self, summed: Literal["coherent", "power"]) -> FloatArray:
        """Level (poses, towers) of the paths, added up as fields or as powers [dBm]; NaN without a path."""
        return self.rss_power_dbm if summed == "power" else self.rss_dbm

    @property
    def left_out(self) -> list[str]:
        """Sentences on what was not modelled."""
        # what was counted and never met needs no sentence
        return [str(item) for item in self.omitted if 0 not in item.counts[:1]]

    def __repr__(self) -> str:
        """One line: the arrays are too large to be shown."""
        return (
            f"Replay({counted(len(self.has_path), 'pose')}, towers {', '.join(self.towers)}, engine {self.engine!r}, "
            f"{counted(len(self.paths), 'path')}, coverage {100 * self.has_path.mean():.0f} %, {self.seconds:.2f} s)"
        )

    def path_table(self, names: dict[str, int] | None = None) -> PathTable:
        """Every path with delay, gain per element pair and directions; ``names`` of earlier poses' faces."""
        return path_table(self.contributions, self.faces, self.ends, self.has_path, {"": 0} if names is None else names)

    def paths_frame(self) -> Any:
        """A row per path: ``pose tower kind faces delay_s power_db`` and the angles [deg] of departure and arrival.

        ``power_db`` is the mean over the element pairs.
        """
        import pandas as pd

        table = self.path_table()
        power = (np.abs(table.gain) ** 2).mean(axis=(1, 2))
        return pd.DataFrame(
            {
                "pose": table.pose,
                "tower": np.array(self.towers)[table.tower],
                "kind": np.array(table.kinds)[table.kind],
                "faces": np.array([*table.names, ""])[table.via],
                "delay_s": table.delay_s,
                "power_db": db_from_power(power),
                **table.angles_deg(self.ends),
            }
        )

    def cir(
        self, velocity_mps: FloatArray | None = None, times_s: ArrayLike = (0.0,)
    ) -> tuple[ComplexArray, FloatArray]:
        """Gains and delays in Sionna's axis order: :func:`aerpaw_cmp.propagation.path_table.impulse_responses`."""
        return impulse_responses(self.path_table(), self.ends, velocity_mps, times_s)

    def cfr(self, offsets_hz: ArrayLike) -> ComplexArray:
        """H about the carrier: :func:`aerpaw_cmp.propagation.path_table.frequency_responses`."""
        return frequency_responses(self.path_table(), self.ends, offsets_hz)

    def to_xarray(self) -> Any:
        """The replay as an ``xarray.Dataset`` with dimensions pose, tower, n_rx, n_tx.

        Returns
        -------
        xarray.Dataset
            ``rss_dbm``, ``rss_power_dbm``, ``has_path``, ``h_real`` and ``h_imag`` with units as attributes.

        Raises
        ------
        UsageError
            If xarray is not installed.
        """
        level = {"units": "dBm", "long_name": "received power, coherent sum of the paths"}
        power = {"units": "dBm", "long_name": "received power, sum of the paths' powers"}
        ports = ("pose", "tower", "n_rx", "n_tx")
        return Dataset(
            {
                "rss_dbm": (("pose", "tower"), self.rss_dbm, level),
                "rss_power_dbm": (("pose", "tower"), self.rss_power_dbm, power),
                "has_path": (("pose", "tower"), self.has_path),
                "h_real": (ports, self.h.real, {"units": "1"}),
                "h_imag": (ports, self.h.imag, {"units": "1"}),
                "tower": ("tower", list(self.towers)),
            },
            {"engine": self.engine, "seconds": self.seconds},
        ).to_xarray()


def replay(
    site: Site, link: Link, poses: Poses, search: Search = Search(), field: Field = Field(), run: Run = Run()
) -> Replay:
    """Replay a flight.

    Parameters
    ----------
    site : Site
    link : Link
        Its ``tower_arrays`` name towers of the site.
    poses : Poses
    search : Search
        Engine, depth and what else decides the paths.
    field : Field
        Further losses of the paths.
    run : Run
        Cache, progress.

    Returns
    -------
    Replay

    Raises
    ------
    UsageError
        Unknown tower or engine, a scene too large for ``image``.
    """
    started = time.perf_counter()
    if search.engine not in ("image", "sionna"):
        raise UsageError(f"unknown engine {search.engine!r}", expected="'image' or 'sionna'")
    poses, notes = within_reach(site, poses)
    scene = Scene.of(site, link, poses)
    # links of a moving tower with its other places: excluded as if an end were buried
    if search.links is not None:
        scene = replace(scene, excluded=scene.excluded | ~search.links)
    notes += buried_towers(site, link)
    cache = path_cache(search, run)
    choice = chosen_samples(scene, link, poses, search, cache)
    search = search if choice is None else replace(search, samples=choice.samples)
    paths, search_seconds, from_cache = search_or_read(scene, link, poses, search, run, cache)
    # a damaged entry is said in the report: the numbers are right, the time is not
    notes += map(Omission, cache.warnings) if cache else []
    # on the scene before terrain changed it: these paths reflect off level ground
    further = further_paths(site, scene, link, poses, search, field)
    scene, paths, stopped = passed(site, scene, link, poses, paths, search)
    fields, has_path = _channels(scene, link, poses, paths, [added for _, added in further], field, run)
    level_dbm, power_dbm = _levels(fields, has_path, link)
    notes += [*stopped, *(Omission(some.missing) for some, _ in further)]
    return Replay(
        rss_dbm=level_dbm,
        rss_power_dbm=power_dbm,
        h=fields.h,
        has_path=has_path,
        contributions=(paths, *(some for some, _ in further)),
        faces=scene.faces,
        ends=Ends(link, poses, scene.sources_m, field),
        seconds=time.perf_counter() - started,
        search_seconds=search_seconds,
        engine=search.engine,
        towers=tuple(link.tower_arrays),
        omitted=notes,
        from_cache=from_cache,
        samples=int(search.samples) if search.engine == "sionna" else 0,
        samples_reason=choice.reason if choice else "",
        surfaces=scene.surfaces,
    )


def passed(
    site: Site, scene: Scene, link: Link, poses: Poses, paths: PathSet, search: Search
) -> tuple[Scene, PathSet, list[Omission]]:
    """Paths over terrain that it lets through.

    Parameters
    ----------
    site, scene, link, poses, search
        As for :func:`replay`.
    paths : PathSet
        Of the engine.

    Returns
    -------
    scene : Scene
        With the planes of terrain that a path meets.
    paths : PathSet
    notes : list of Omission
        What was stopped or left out.
    """
    scene, level, shaped, notes = _shaped_ground(site, scene, link, poses, paths)
    clear = _clear_of_terrain(site, scene, poses, level)
    # asked of level paths alone: those over shaped ground were asked when they were made
    lost = int((~clear).sum())
    notes += [Omission("paths end at the terrain of the elevation model", (lost, len(level)))]
    paths = level.select(clear) if lost else level
    if len(shaped):
        # None: planes of terrain that touch are no repeated faces
        paths = mirror.merge([paths, shaped], search.max_depth, None)
    return scene, paths, notes


def further_paths(
    site: Site, scene: Scene, link: Link, poses: Poses, search: Search, field: Field
) -> list[tuple[Further, Fields]]:
    """Paths of the further kinds that are asked for, and what they add to H and to the powers.

    Parameters
    ----------
    site, scene, link, poses, search, field
        As for :func:`replay`.

    Returns
    -------
    list of (Further, Fields)
        Without paths that the terrain stops or that lose all.
    """
    pieces = []
    for find in search.further:
        paths, loss_db = find(scene, poses, link), None
        if site.dem is not None or field.loss is not None:
            lines = paths.lines()
            clear = _clear_of_terrain(site, scene, poses, lines)
            loss_db = field.loss_db(lines, scene.sources_m, poses.position_m)
            clear &= True if loss_db is None else np.isfinite(loss_db)
            paths, loss_db = paths.select(clear), None if loss_db is None else loss_db[clear]
        pieces.append((paths, paths.fields(scene.faces, scene.sources_m, poses, link, loss_db)))
    return pieces


def _shaped_ground(
    site: Site, scene: Scene, link: Link, poses: Poses, paths: PathSet
) -> tuple[Scene, PathSet, PathSet, list[Omission]]:
    """Scene with tangent planes of the terrain, paths that stay on level ground, paths over the planes, notes."""
    if site.dem is None or scene.surfaces is not None or not paths.faces.shape[1]:
        return scene, paths, paths.select(slice(0, 0)), []
    terrain = on_terrain(site.dem, scene.faces, scene.links_to(poses), paths, wavelength_m(link.carrier_hz))
    words = "links over ground that the elevation model does not know: level ground reflects there"
    # tangent planes serve the one path that they were made for
    more = np.zeros((len(scene.usable), len(terrain.faces) - len(scene.faces)), dtype=np.bool_)
    scene = replace(scene, faces=terrain.faces, usable=np.concatenate([scene.usable, more], axis=1))
    return scene, terrain.level, terrain.shaped, [Omission(words, (terrain.unknown,))]


def _clear_of_terrain(site: Site, scene: Scene, poses: Poses, paths: PathSet) -> BoolArray:
    """Paths (paths,) that the elevation model lets through.

    It is asked on the direct line between the ends, whose shadow a reflection off level ground shares; a path over
    walls alone is asked on each of its segments.
    """
    if site.dem is None or len(paths) == 0:
        return np.ones(len(paths), dtype=np.bool_)
    source, target = scene.sources_m[paths.tower], poses.position_m[paths.pose]
    ground = np.append(scene.faces.solid < 0, False)  # the last entry stands for "no face"
    over_ground = ground[paths.faces].any(axis=1)
    straight = (paths.depth == 0) | over_ground
    clear = np.ones(len(paths), dtype=np.bool_)
    clear[straight] = site.dem.clear(source[straight], target[straight])
    rows = np.flatnonzero(~straight)
    for start, end in legs(source[rows], paths.vertices_m[rows], target[rows]):
        clear[rows] &= site.dem.clear(start, end)
    return clear


def _channels(
    scene: Scene, link: Link, poses: Poses, paths: PathSet, further: Sequence[Fields], field: Field, run: Run
) -> tuple[Fields, BoolArray]:
    """H and powers of the paths with what further kinds of them add, and which links (poses, towers) have a path."""
    loss_db = field.loss_db(paths, scene.sources_m, poses.position_m)
    work = 0 if run.job is None else run.job.pairs
    fields = channel_matrices(paths, scene.faces, scene.sources_m, poses, link, loss_db, work=work)
    has_path = np.zeros((len(poses), len(scene.sources_m)), dtype=np.bool_)
    # a blocked path adds zero to H; only the flag tells it from one that fades
    open_ = slice(None) if loss_db is None else np.isfinite(loss_db)  # an infinite loss is an obstacle
    has_path[paths.pose[open_], paths.tower[open_]] = True
    for item in further:
        # path_power stays that of the reflections: each kind keeps its own
        fields = Fields(fields.h + item.h, fields.path_power, fields.power + item.power)
        has_path |= item.power > 0.0
    return fields, has_path


def _levels(fields: Fields, has_path: BoolArray, link: Link) -> tuple[FloatArray, FloatArray]:
    """Levels (poses, towers) of H and of the summed powers; below the noise floor H and ``has_path`` become nothing."""
    h, sent, floor = fields.h, link.transmit_power_dbm, link.noise_floor_dbm
    level_dbm, power_dbm = np.empty(has_path.shape), np.empty(has_path.shape)
    for first in range(0, len(h), LEVELS_AT_ONCE):  # in the cache; a second thread would gain nothing
        part = slice(first, first + LEVELS_AT_ONCE)
        level_dbm[part] = rss_dbm(mean_pair_power(h[part]), sent, floor)
        power_dbm[part] = rss_dbm(fields.power[part], sent, floor)
        above_floor = np.isfinite(level_dbm[part])
        if not above_floor.all():
            # below the floor a receiver knows no channel, so no rank may be taken of it
            h[part][~above_floor] = 0.0
        has_path[part] &= above_floor
    return level_dbm, power_dbm

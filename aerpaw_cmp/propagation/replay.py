"""The replay of a flight, stage by stage: scene, paths, obstacles, field, levels.

The path table of a replay contains the delay, the gain per element pair, the directions and the Doppler shift of each
path.

H is the sum of the gains. The field of a single path is computed as the sum over a set that contains only this path, so
there is only one formula.

Directions are unit vectors away from the ends. In the site frame, azimuth is counter-clockwise from east and elevation
is above the horizon. In the array frame (:mod:`aerpaw_cmp.propagation.geometry`), both are measured from the boresight.

For notebooks, ``trace(site, link, poses)`` returns a :class:`Replay`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.cf import Dataset
from ..common.errors import UsageError
from ..common.geodesy import azimuth_rad, elevation_rad, unit_vectors
from ..common.text import counted
from ..common.units import (
    SPEED_OF_LIGHT_MPS,
    AnyArray,
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    db_from_power,
    unmasked,
    wavelength_m,
)
from ..site.site import Site
from ..site.siteyaml import load_site
from .edges import diffracted
from .engines import chosen_samples, path_cache, search_or_read
from .field.sum import Fields, Further, channel_matrices, fields_of, mean_pair_power, rss_dbm
from .geometry import Faces, Link, PathSet, Poses, Surfaces, legs, sources_of
from .options import Diffraction, Engine, Field, Loss, Run, Samples, Search
from .scene import Omission, Scene, buried_towers, within_reach
from .search import mirror
from .search.terrain import on_terrain

# Names of the codes in ``kind``. The codes are stored in channel files, so append new kinds at the end.
_KINDS = ("line_of_sight", "reflection", "edge")

# Largest bandwidth as a share of the carrier: materials, patterns and foliage are evaluated only at the carrier.
WIDEST_BAND = 0.1


@dataclass(frozen=True, slots=True)
class Ends:
    """The ends of the paths of a replay.

    Parameters
    ----------
    link : Link
    poses : Poses
    sources_m : (towers, 3) or (poses, 1, 3)
        Centres of the tower arrays. The second shape is for a single tower that moves.
    field : Field
        Further losses.
    """

    link: Link
    poses: Poses
    sources_m: FloatArray
    field: Field = Field()

    def part(self, rows: slice) -> Ends:
        """Return the ends of the given poses."""
        return replace(self, poses=self.poses[rows], sources_m=self.sources_m[rows] if self.moving else self.sources_m)

    @property
    def moving(self) -> bool:
        """True if the tower has a separate position at every pose."""
        return self.sources_m.ndim == 3


@dataclass(frozen=True, slots=True, kw_only=True)
class PathTable:
    """The paths of a replay, one path per row, sorted by pose, tower and length.

    Parameters
    ----------
    pose, tower, number : (paths,) int
        Indices of pose and tower, and number of the path within its link.
    kind : (paths,) int
        Index into ``kinds``.
    via : (paths,) int
        Index into ``names``, which contains the faces from tower to UAV.
    gain : (paths, n_rx, n_tx) complex
        Gain of each element pair, with the phase of the carrier.
    length_m : (paths,)
        Length between the centres of the arrays.
    at_tower, at_uav : (paths, 3)
        Unit vectors in the site frame in which the path leaves the ends.
    turns : (paths,) int
        One digit per corner from tower to UAV: 1 is a reflection, 2 a diffraction. 0 is the line of sight.
    vertices_m : (paths, most, 3)
        Corners of the paths [m]; NaN if unused.
    names, kinds : tuple of str
    """

    pose: IntArray
    tower: IntArray
    number: IntArray
    kind: IntArray
    via: IntArray
    gain: ComplexArray
    length_m: FloatArray
    at_tower: FloatArray
    at_uav: FloatArray
    turns: IntArray
    vertices_m: FloatArray
    names: tuple[str, ...]
    kinds: tuple[str, ...]

    @property
    def most(self) -> int:
        """Largest number of paths of a link."""
        return int(self.number.max(initial=-1)) + 1

    @property
    def delay_s(self) -> FloatArray:
        """Delay (paths,) between the centres of the arrays."""
        return np.asarray(self.length_m / SPEED_OF_LIGHT_MPS)

    def by_link(self, values: AnyArray, ends: Ends, fill: Any = np.nan) -> AnyArray:
        """Return values per path (paths, ...) in the shape (largest number of paths, poses, towers, ...)."""
        links = len(ends.poses), len(ends.link.tower_arrays)
        out = np.full((self.most, *links, *values.shape[1:]), fill, values.dtype)
        out[self.number, self.pose, self.tower] = values
        return out

    def doppler_hz(self, carrier_hz: float, velocity_mps: FloatArray, tower_mps: ArrayLike = 0.0) -> FloatArray:
        """Return the Doppler shift (paths,), positive while a path gets shorter.

        ``f = f0 / c (v . k)``, summed over both ends, with k towards the first corner seen from the end.

        Parameters
        ----------
        carrier_hz : float
        velocity_mps : (poses, 3)
            Velocity of the UAV: east, north, up [m/s].
        tower_mps : (poses, 3), optional
            Velocity of a tower that moves [m/s].

        Returns
        -------
        (paths,)
        """
        # the default is the zero velocity of a fixed tower
        tower = np.broadcast_to(unmasked(tower_mps), velocity_mps.shape)
        closing = np.einsum("ni,ni->n", velocity_mps[self.pose], self.at_uav)
        closing += np.einsum("ni,ni->n", tower[self.pose], self.at_tower)
        return np.asarray(carrier_hz / SPEED_OF_LIGHT_MPS * closing)

    def angles_deg(self, ends: Ends) -> dict[str, FloatArray]:
        """Return azimuth and elevation (paths,) of departure and arrival, in the site frame and in the array frame."""
        mounts = np.stack([array.mount for array in ends.link.tower_arrays.values()])[self.tower]
        mounted = ends.poses.rotation[self.pose] @ ends.link.uav_array.mount
        names = ("arrival", "departure") if ends.link.uav_transmits else ("departure", "arrival")
        out = {}
        for name, way, frame in zip(names, (self.at_tower, self.at_uav), (mounts, mounted), strict=True):
            for suffix, seen in (("", way), ("_array", np.einsum("nji,nj->ni", frame, way))):
                out[f"azimuth_{name}{suffix}_deg"] = np.degrees(azimuth_rad(seen))
                out[f"elevation_{name}{suffix}_deg"] = np.degrees(elevation_rad(seen))
        return out


def path_table(
    contributions: tuple[Any, ...], faces: Faces, ends: Ends, counts: AnyArray, names: dict[str, int]
) -> PathTable:
    """Return the table of the paths of a replay, each with its own gain.

    Parameters
    ----------
    contributions : tuple
        Reflections and lines of sight, then the paths of further kinds.
    faces : Faces
    ends : Ends
    counts : (poses, towers) bool
        Links that have a channel. Paths of other links are omitted.
    names : dict of str to int
        Number of each sequence of faces that was found at earlier poses. New sequences are added.

    Returns
    -------
    PathTable
    """
    pieces, labels = [], (*faces.label, "")
    kinds = list(dict.fromkeys([*_KINDS, *(item.name for item in contributions[1:])]))
    most = max(item.lines().vertices_m.shape[1] for item in contributions)
    for item in contributions:
        lines, code = item.lines(), 0 if isinstance(item, PathSet) else kinds.index(item.name)
        loss_db = ends.field.loss_db(lines, ends.sources_m, ends.poses.position_m)
        good = counts[lines.pose, lines.tower]
        # omit paths with infinite loss from the table; the search result still contains them
        good &= True if loss_db is None else np.isfinite(loss_db)
        item, lines, loss_db = item.select(good), lines.select(good), None if loss_db is None else loss_db[good]
        unique, via = np.unique(item.touched, axis=0, return_inverse=True)
        texts = [", ".join(labels[i] for i in row if i >= 0) for row in unique.tolist()]
        codes = np.array([names.setdefault(text, len(names)) for text in texts], dtype=np.int64)
        # use the array centres, because delays and directions are per path, although gains are per element pair
        places = sources_of(lines, ends.sources_m), lines.vertices_m, ends.poses.position_m[lines.pose]
        away = list(legs(*places))
        back = next(legs(places[2], lines.vertices_m[:, ::-1], places[0]))  # the first leg from the UAV
        pieces.append(
            {
                "pose": item.pose,
                "tower": item.tower,
                # one kind for any number of reflections, because ``turns`` contains the number
                "kind": np.full(len(lines), code) if code else np.minimum(lines.depth, 1),
                "via": codes[via.ravel()],
                "gain": _gains(item, faces, ends, loss_db),
                "length_m": sum(np.linalg.norm(end - start, axis=1) for start, end in away),
                "at_tower": unit_vectors(away[0][1] - away[0][0]),
                "at_uav": unit_vectors(back[1] - back[0]),
                "turns": item.turns,
                "vertices_m": np.pad(
                    lines.vertices_m, ((0, 0), (0, most - lines.vertices_m.shape[1]), (0, 0)), constant_values=np.nan
                ),
            }
        )
    columns = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    # lexsort sorts by its last key first
    order = np.lexsort((columns["length_m"], columns["tower"], columns["pose"]))
    columns = {name: value[order] for name, value in columns.items()}
    link = columns["pose"] * counts.shape[1] + columns["tower"]
    number = np.arange(len(link)) - np.searchsorted(link, link)
    return PathTable(**columns, number=number, names=tuple(names), kinds=tuple(kinds))


def _gains(item: Any, faces: Faces, ends: Ends, loss_db: FloatArray | None) -> ComplexArray:
    """Return the gain (paths, n_rx, n_tx) of each path: H of a pose at which this is the only path."""
    pieces, order = [], []
    for tower, (name, array) in enumerate(ends.link.tower_arrays.items()):
        rows = np.flatnonzero(item.tower == tower)
        # give each path a separate pose, so that H of that pose is its gain
        some, own, link = item.select(rows), np.arange(len(rows)), replace(ends.link, tower_arrays={name: array})
        places, lost = sources_of(some, ends.sources_m)[:, None], None if loss_db is None else loss_db[rows]
        alone = replace(some, pose=own, tower=0 * own)
        pieces.append(fields_of(alone, faces, places, ends.poses[some.pose], link, lost).h[:, 0])
        order.append(rows)
    return np.concatenate(pieces)[np.argsort(np.concatenate(order))]


def impulse_responses(
    table: PathTable, ends: Ends, velocity_mps: FloatArray | None = None, times_s: ArrayLike = (0.0,)
) -> tuple[ComplexArray, FloatArray]:
    """Return gains and delays in the axis order of Sionna RT's ``Paths.cir()``. Each pose is a device.

    Parameters
    ----------
    table : PathTable
    ends : Ends
    velocity_mps : (poses, 3), optional
        Velocity of the UAV, which rotates the phases of the paths by their Doppler shift over ``times_s``.
    times_s : (times,)

    Returns
    -------
    a : (rx, rx_ant, tx, tx_ant, paths, times) complex
        Coefficients with the phase of the carrier, like the baseband equivalents of Sionna. Zero if there is no path.
    tau : (rx, tx, paths)
        Delay [s]; zero if there is no path.
    """
    turned = table.gain[..., None]
    if velocity_mps is not None:
        cycles = table.doppler_hz(ends.link.carrier_hz, velocity_mps)[:, None] * unmasked(times_s)
        turned = turned * np.exp(2j * np.pi * cycles)[:, None, None, :]
    # axes: path, pose, tower (, rx_ant, tx_ant, time)
    rx, tx = (2, 1) if ends.link.uav_transmits else (1, 2)
    a, tau = (table.by_link(values, ends, 0.0) for values in (turned, table.delay_s))
    return np.ascontiguousarray(a.transpose(rx, 3, tx, 4, 0, 5)), np.ascontiguousarray(tau.transpose(rx, tx, 0))


def frequency_responses(table: PathTable, ends: Ends, offsets_hz: ArrayLike) -> ComplexArray:
    """Return channel matrices at frequencies about the carrier.

    Parameters
    ----------
    table : PathTable
    ends : Ends
    offsets_hz : (frequencies,)
        Offsets from the carrier, such as those of :func:`subcarriers_hz`.

    Returns
    -------
    (poses, towers, n_rx, n_tx, frequencies) complex

    Raises
    ------
    UsageError
        If the band is wider than a tenth of the carrier.

    Notes
    -----
    ``H(f0 + f) = sum_p a_p exp(-j 2 pi f tau_p)`` with the gains at the carrier, and the delays between array centres.
    """
    offsets = unmasked(offsets_hz)
    check_band(float(np.ptp(offsets)) if len(offsets) else 0.0, ends.link.carrier_hz)
    gains, delays = (table.by_link(values, ends, 0.0) for values in (table.gain, table.delay_s))
    h = np.zeros((*gains.shape[1:], len(offsets)), dtype=np.complex128)
    # add one path per link at a time, because a product over all paths would need memory for each path
    for gain, delay in zip(gains, delays, strict=True):
        h += gain[..., None] * np.exp(-2j * np.pi * delay[..., None] * offsets)[:, :, None, None]
    return h


def check_band(bandwidth_hz: float, carrier_hz: float) -> None:
    """Raise UsageError for a band wider than :data:`WIDEST_BAND` of the carrier."""
    if bandwidth_hz > WIDEST_BAND * carrier_hz:
        raise UsageError(
            f"a band of {bandwidth_hz / 1e6:g} MHz about {carrier_hz / 1e9:g} GHz",
            expected=f"at most {WIDEST_BAND * carrier_hz / 1e6:g} MHz, a tenth of the carrier",
            cause="materials, antennas and foliage are those of the carrier",
        )


def subcarriers_hz(bandwidth_hz: float, count: int) -> FloatArray:
    """Return offsets (count,) of subcarriers from the carrier, in the order of an FFT centred on the carrier.

    Examples
    --------
    >>> subcarriers_hz(4.0, 4).tolist()
    [-2.0, -1.0, 0.0, 1.0]
    """
    # as with np.fft.fftshift, for an even count the lowest frequency has no positive counterpart
    return np.asarray((np.arange(count) - count // 2) * (bandwidth_hz / count))


# Arrays (poses, towers, ...) of a replay.
PER_LINK = ("rss_dbm", "rss_power_dbm", "h", "has_path")


@dataclass(frozen=True, slots=True, repr=False)
class Replay:
    """The result of a replay.

    Parameters
    ----------
    rss_dbm : (poses, towers)
        Coherent level, from ``|H|^2`` (:func:`aerpaw_cmp.propagation.field.sum.rss_dbm`). NaN if there is no path.
    rss_power_dbm : (poses, towers)
        Level from the sum of the paths' powers.
    h : (poses, towers, n_rx, n_tx) complex128
        Channel matrices, zero if there is no path.
    has_path : (poses, towers) bool
    contributions : tuple
        Paths that add up to H and both levels: reflections and lines of sight, then the paths of each requested further
        kind (:class:`~aerpaw_cmp.propagation.field.sum.Further`).
    faces : Faces
    ends : Ends
        Link, poses, positions of the towers and further losses.
    seconds : float
        Time of this call [s]: path search (or reading the cache) and fields.
    search_seconds : float
        Time of the path search alone [s]. A cache entry contains the time of its original search.
    engine : str
    omitted : list of Omission
        Parts that were not modelled. ``left_out`` contains them as sentences for the report.
    towers : tuple of str
        Names of the towers, in the order of the tower axis.
    from_cache : bool
        True if the paths came from the cache.
    samples : int
        Rays per tower; 0 for an engine without rays.
    samples_reason : str
        Reason for this number of rays, if trial searches determined it.
    surfaces : Surfaces, optional
        Materials and triangles of the faces, if the site is a scene of triangles.
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
        """The lines of sight and reflected paths."""
        return self.contributions[0]  # type: ignore[no-any-return]

    @property
    def further(self) -> tuple[Further, ...]:
        """The paths of further kinds."""
        return self.contributions[1:]

    def level_dbm(self, summed: Literal["coherent", "power"]) -> FloatArray:
        """Return the level (poses, towers) of the paths, added as fields or as powers [dBm]. NaN without a path."""
        return self.rss_power_dbm if summed == "power" else self.rss_dbm

    @property
    def left_out(self) -> list[str]:
        """Sentences about the parts that were not modelled."""
        # omissions with a count of zero do not need a sentence
        return [str(item) for item in self.omitted if 0 not in item.counts[:1]]

    def __repr__(self) -> str:
        """Return one line, because the arrays are too large to be shown."""
        return (
            f"Replay({counted(len(self.has_path), 'pose')}, towers {', '.join(self.towers)}, engine {self.engine!r}, "
            f"{counted(len(self.paths), 'path')}, coverage {100 * self.has_path.mean():.0f} %, {self.seconds:.2f} s)"
        )

    def path_table(self, names: dict[str, int] | None = None) -> PathTable:
        """Return every path with delay, gain per element pair and directions. ``names``: see :func:`path_table`."""
        return path_table(self.contributions, self.faces, self.ends, self.has_path, {"": 0} if names is None else names)

    def paths_frame(self) -> Any:
        """Return a row for each path: ``pose tower kind faces delay_s power_db`` and the angles [deg] of both ends.

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
        """Return gains and delays in Sionna's axis order (:func:`impulse_responses`)."""
        return impulse_responses(self.path_table(), self.ends, velocity_mps, times_s)

    def cfr(self, offsets_hz: ArrayLike) -> ComplexArray:
        """Return H at frequencies about the carrier (:func:`frequency_responses`)."""
        return frequency_responses(self.path_table(), self.ends, offsets_hz)

    def to_xarray(self) -> Any:
        """Return the replay as an ``xarray.Dataset`` over pose, tower, rx and tx, each with its coordinate.

        Returns
        -------
        xarray.Dataset
            ``rss_dbm``, ``rss_power_dbm``, ``has_path`` and complex ``h``, with units as attributes.

        Raises
        ------
        UsageError
            If xarray is not installed.
        """
        level = {"units": "dBm", "long_name": "received power, coherent sum of the paths"}
        power = {"units": "dBm", "long_name": "received power, sum of the paths' powers"}
        poses, _, *ports = self.h.shape
        numbers = {"pose": poses, "rx": ports[0], "tx": ports[1]}
        return Dataset(
            {
                "rss_dbm": (("pose", "tower"), self.rss_dbm, level),
                "rss_power_dbm": (("pose", "tower"), self.rss_power_dbm, power),
                "has_path": (("pose", "tower"), self.has_path),
                "h": (("pose", "tower", "rx", "tx"), self.h, {"units": "1", "long_name": "channel matrix"}),
                "tower": ("tower", list(self.towers)),
                **{name: (name, np.arange(count)) for name, count in numbers.items()},
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
        The ``tower_arrays`` of the link name towers of the site.
    poses : Poses
    search : Search
        Options that determine the paths, such as engine and depth.
    field : Field
        Further losses of the paths.
    run : Run
        Options that do not change the result, such as cache and progress.

    Returns
    -------
    Replay

    Raises
    ------
    UsageError
        If a tower or the engine is unknown, or the scene is too large for ``image``.
    """
    started = time.perf_counter()
    if search.engine not in ("image", "sionna"):
        raise UsageError(f"unknown engine {search.engine!r}", expected="'image' or 'sionna'")
    poses, notes = within_reach(site, poses)
    scene = Scene.of(site, link, poses)
    # exclude links that are not searched: each position of a moving tower has links only with its own poses
    if search.links is not None:
        scene = replace(scene, excluded=scene.excluded | ~search.links)
    notes += buried_towers(site, link)
    cache = path_cache(search, run)
    choice = chosen_samples(scene, link, poses, search, cache)
    search = search if choice is None else replace(search, samples=choice.samples)
    paths, search_seconds, from_cache = search_or_read(scene, link, poses, search, run, cache)
    # report damaged cache entries, because they explain a long search. The results are correct.
    notes += map(Omission, cache.warnings) if cache else []
    # use the scene without terrain planes, because these paths reflect off level ground
    further = further_paths(site, scene, link, poses, search, field)
    scene, paths, stopped = passed(site, scene, link, poses, paths, search)
    fields, has_path = _channels(scene, link, poses, paths, [added for _, added in further], field)
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
    """Return the paths that the terrain does not block, and the paths that reflect off it.

    Parameters
    ----------
    site, scene, link, poses, search
        The same as in :func:`replay`.
    paths : PathSet
        Paths from the engine.

    Returns
    -------
    scene : Scene
        Scene with the terrain planes at which a path is reflected.
    paths : PathSet
    notes : list of Omission
        Searches that were stopped, and links that were skipped.
    """
    scene, level, shaped, notes = _shaped_ground(site, scene, link, poses, paths)
    clear = _clear_of_terrain(site, scene, poses, level)
    # only level paths are checked here: paths over shaped ground were checked when they were created
    lost = int((~clear).sum())
    notes += [Omission("paths end at the terrain of the elevation model", (lost, len(level)))]
    paths = level.select(clear) if lost else level
    if len(shaped):
        # pass None instead of the faces: paths over adjacent terrain planes are not duplicates
        paths = mirror.merge([paths, shaped], search.max_depth, None)
    return scene, paths, notes


def further_paths(
    site: Site, scene: Scene, link: Link, poses: Poses, search: Search, field: Field
) -> list[tuple[Further, Fields]]:
    """Find the paths of the requested further kinds, and their contributions to H and to the powers.

    Parameters
    ----------
    site, scene, link, poses, search, field
        The same as in :func:`replay`.

    Returns
    -------
    list of (Further, Fields)
        Paths that the terrain blocks or that have infinite loss are excluded.
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
    """Return the scene with tangent planes of the terrain, paths over level ground and over the planes, and notes."""
    if site.dem is None or scene.surfaces is not None or not paths.faces.shape[1]:
        return scene, paths, paths.select(slice(0, 0)), []
    level, shaped, faces, unknown = on_terrain(
        site.dem, scene.faces, scene.links_to(poses), paths, wavelength_m(link.carrier_hz)
    )
    words = "links over ground outside the elevation model: level ground is assumed there"
    # a tangent plane is valid only for the path for which it was computed
    more = np.zeros((len(scene.usable), len(faces) - len(scene.faces)), dtype=np.bool_)
    scene = replace(scene, faces=faces, usable=np.concatenate([scene.usable, more], axis=1))
    return scene, level, shaped, [Omission(words, (unknown,))]


def _clear_of_terrain(site: Site, scene: Scene, poses: Poses, paths: PathSet) -> BoolArray:
    """Return a mask (paths,) of the paths that the elevation model does not block.

    For a line of sight or a reflection off level ground, the direct line between the ends must be free. For a path over
    walls only, each segment must be free.
    """
    if site.dem is None or len(paths) == 0:
        return np.ones(len(paths), dtype=np.bool_)
    source, target = scene.sources_m[paths.tower], poses.position_m[paths.pose]
    ground = np.append(scene.faces.solid < 0, False)  # index -1 selects the last entry, which means "no face"
    over_ground = ground[paths.faces].any(axis=1)
    straight = (paths.depth == 0) | over_ground
    clear = np.ones(len(paths), dtype=np.bool_)
    clear[straight] = site.dem.clear(source[straight], target[straight])
    rows = np.flatnonzero(~straight)
    for start, end in legs(source[rows], paths.vertices_m[rows], target[rows]):
        clear[rows] &= site.dem.clear(start, end)
    return clear


def _channels(
    scene: Scene, link: Link, poses: Poses, paths: PathSet, further: Sequence[Fields], field: Field
) -> tuple[Fields, BoolArray]:
    """Return H and powers, including further kinds of paths, and a mask of the links (poses, towers) with a path."""
    loss_db = field.loss_db(paths, scene.sources_m, poses.position_m)
    fields = channel_matrices(paths, scene.faces, scene.sources_m, poses, link, loss_db)
    has_path = np.zeros((len(poses), len(scene.sources_m)), dtype=np.bool_)
    # a blocked path adds zero to H, so only this mask distinguishes it from a path in a fade
    open_ = slice(None) if loss_db is None else np.isfinite(loss_db)  # an infinite loss means an obstacle
    has_path[paths.pose[open_], paths.tower[open_]] = True
    for item in further:
        # path_power contains only the reflections, because other kinds have separate powers
        fields = Fields(fields.h + item.h, fields.path_power, fields.power + item.power)
        has_path |= item.power > 0.0
    return fields, has_path


def _levels(fields: Fields, has_path: BoolArray, link: Link) -> tuple[FloatArray, FloatArray]:
    """Return levels (poses, towers) of H and of the summed powers. Below the noise floor, clear H and ``has_path``."""
    sent, floor = link.transmit_power_dbm, link.noise_floor_dbm
    level_dbm = rss_dbm(mean_pair_power(fields.h), sent, floor)
    above_floor = np.isfinite(level_dbm)
    # below the noise floor, the channel is unknown, so there is no rank
    fields.h[~above_floor] = 0.0
    has_path &= above_floor
    return level_dbm, rss_dbm(fields.power, sent, floor)


def trace(
    site: Site | str | Path,
    link: Link,
    poses: Poses | ArrayLike,
    engine: Engine = "image",
    max_depth: int = 2,
    *,
    loss: Loss | None = None,
    samples: Samples = "auto",
    diffraction: Diffraction = "none",
) -> Replay:
    """Trace paths, channel matrices and received power of poses at a site.

    Parameters
    ----------
    site : Site, str or path
        A loaded site, the name of a packaged site (``"lake_wheeler"``), or a site.yaml.
    link : Link
        Carrier, arrays and power. ``link.tower_arrays`` names towers of the site.
    poses : Poses or array_like, (poses, 3)
        Poses, or positions east, north and up of the site's origin [m]. For positions, the UAV is level, with its nose
        to the east.
    engine : {"image", "sionna"}
        The exact image method, or Sionna RT's PathSolver as path finder. Fields are computed in float64 with both
        engines.
    max_depth : int
        Largest number of reflections, 0 to 3.
    loss : callable, optional
        Further loss per path [dB], such as foliage.
    samples : int or "auto"
        ``sionna`` only: rays per tower; "auto" raises the number until two trial searches agree.
    diffraction : {"none", "edges"}
        ``edges``: also paths over one edge of a building (:mod:`aerpaw_cmp.propagation.edges`).

    Returns
    -------
    Replay
        ``rss_dbm (poses, towers)``, ``h (poses, towers, n_rx, n_tx)`` complex128, ``paths``; ``to_xarray()``.

    Raises
    ------
    UsageError
        If the site, a tower or the engine is unknown, poses have another shape, or the scene is too large for
        ``image``.

    Notes
    -----
    ``H[m, n] = sum_p a_p(m, n)`` over the paths p, each with its own length per pair of elements (spherical waves);
    ``a_p`` is the product of free-space loss, Fresnel coefficients (ITU-R P.2040) and the elements' patterns.

    Examples
    --------
    >>> from aerpaw_cmp.propagation.geometry import Link, single_element
    >>> link = Link(3.4e9, {"LW1": single_element()}, single_element())
    >>> trace("lake_wheeler", link, [[100.0, 50.0, 40.0]]).rss_dbm.shape
    (1, 1)
    """
    place = site if isinstance(site, Site) else load_site(site)
    search = Search(engine, max_depth=max_depth, samples=samples, further=diffracted(diffraction))
    if isinstance(poses, Poses):
        # use NaN for a masked value, because the number under the mask is not valid
        poses = Poses(unmasked(poses.position_m), unmasked(poses.rotation))
    else:
        poses = _level(poses)
    return replay(place, link, poses, search, Field(loss))


def _level(position_m: ArrayLike) -> Poses:
    """Return poses of a level aircraft, nose to the east, at positions (poses, 3)."""
    position = np.atleast_2d(unmasked(position_m))
    if position.ndim != 2 or position.shape[1] != 3:
        raise UsageError(
            f"poses of shape {np.shape(position_m)}",
            expected="Poses, or positions (poses, 3): metres east, north and up",
            cause="latitude and longitude, or no heights",
        )
    return Poses(position, np.broadcast_to(np.eye(3), (len(position), 3, 3)).copy())

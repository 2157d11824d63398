"""Table of the paths of a replay: delay, gain per element pair, directions and Doppler, each path by itself.

H is the sum of the gains; the field of a path alone is the sum over a path set of one path, so there is no second law.

Directions are unit vectors away from the ends: azimuth counter-clockwise from east and elevation above the horizon in
the site frame, from the boresight and its plane in the array frame (:mod:`aerpaw_cmp.propagation.geometry.arrays`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import UsageError
from ..common.geodesy import azimuth_rad, elevation_rad, unit_vectors
from ..common.units import SPEED_OF_LIGHT_MPS, AnyArray, ComplexArray, FloatArray, IntArray, unmasked
from .field.sum import fields_of
from .geometry.arrays import Link, Poses
from .geometry.paths import Faces, PathSet, legs, sources_of
from .options import Field

# Codes of ``kind``; what else bends a path follows by its name.
# Their numbers stand in files of channels: new kinds go behind them.
_KINDS = ("line_of_sight", "reflection", "edge")

# Gains are those of the carrier: materials, patterns and foliage are not evaluated at other frequencies.
WIDEST_BAND = 0.1


@dataclass(frozen=True, slots=True)
class Ends:
    """Ends of the paths of a replay.

    Parameters
    ----------
    link : Link
    poses : Poses
    sources_m : (towers, 3) or (poses, 1, 3)
        Centres of the tower arrays; the latter of one tower that moves.
    field : Field
        Further losses.
    """

    link: Link
    poses: Poses
    sources_m: FloatArray
    field: Field = Field()

    def part(self, rows: slice) -> Ends:
        """Those of some poses."""
        return replace(self, poses=self.poses[rows], sources_m=self.sources_m[rows] if self.moving else self.sources_m)

    @property
    def moving(self) -> bool:
        """True where the tower has a place of its own at every pose."""
        return self.sources_m.ndim == 3


@dataclass(frozen=True, slots=True, kw_only=True)
class PathTable:
    """Paths of a replay, a row each, by pose and tower, the shortest first.

    Parameters
    ----------
    pose, tower, number : (paths,) int
        ``number`` counts the paths of a link.
    kind : (paths,) int
        Of ``kinds``.
    via : (paths,) int
        Which of ``names``: the faces from tower to UAV.
    gain : (paths, n_rx, n_tx) complex
        With the phase of the carrier.
    length_m : (paths,)
        Between the centres of the arrays.
    at_tower, at_uav : (paths, 3)
        Directions in which the path leaves the ends, site frame.
    turns : (paths,) int
        A digit a corner from tower to UAV, 1 a reflection, 2 an edge; 0 is the line of sight.
    vertices_m : (paths, most, 3)
        Corners; NaN where unused.
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
        """Paths of the link that has most."""
        return int(self.number.max(initial=-1)) + 1

    @property
    def delay_s(self) -> FloatArray:
        """Delay (paths,) between the centres of the arrays."""
        return np.asarray(self.length_m / SPEED_OF_LIGHT_MPS)

    def by_link(self, values: AnyArray, ends: Ends, fill: Any = np.nan) -> AnyArray:
        """Values per path (paths, ...) as (most paths of a link, poses, towers, ...)."""
        links = len(ends.poses), len(ends.link.tower_arrays)
        out = np.full((self.most, *links, *values.shape[1:]), fill, values.dtype)
        out[self.number, self.pose, self.tower] = values
        return out

    def doppler_hz(self, carrier_hz: float, velocity_mps: FloatArray, tower_mps: ArrayLike = 0.0) -> FloatArray:
        """Doppler shift (paths,), positive while a path gets shorter.

        ``f = f0 / c (v . k)``, k towards the first corner seen from each end.

        Parameters
        ----------
        carrier_hz : float
        velocity_mps : (poses, 3)
            Of the UAV: east, north, up.
        tower_mps : (poses, 3), optional
            Of a tower that moves.

        Returns
        -------
        (paths,)
        """
        # zero stands for a tower that stands
        tower = np.broadcast_to(unmasked(tower_mps), velocity_mps.shape)
        closing = np.einsum("ni,ni->n", velocity_mps[self.pose], self.at_uav)
        closing += np.einsum("ni,ni->n", tower[self.pose], self.at_tower)
        return np.asarray(carrier_hz / SPEED_OF_LIGHT_MPS * closing)

    def angles_deg(self, ends: Ends) -> dict[str, FloatArray]:
        """Azimuth and elevation (paths,) of departure and arrival, in the site frame and in the array frame."""
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
    """Paths of a replay, each with its own gain.

    Parameters
    ----------
    contributions : tuple
        Reflections and lines of sight, then the paths of further kinds.
    faces : Faces
    ends : Ends
    counts : (poses, towers) bool
        Links that have a channel; paths of the others are left out.
    names : dict of str to int
        Faces of a path by number, those of earlier poses; new ones are added.

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
        # a path that loses everything is no path of the table, though it stays in the search's list
        good &= True if loss_db is None else np.isfinite(loss_db)
        item, lines, loss_db = item.select(good), lines.select(good), None if loss_db is None else loss_db[good]
        unique, via = np.unique(item.touched, axis=0, return_inverse=True)
        texts = [", ".join(labels[i] for i in row if i >= 0) for row in unique.tolist()]
        codes = np.array([names.setdefault(text, len(names)) for text in texts], dtype=np.int64)
        # centres of the arrays: delays and directions are one a path, gains one a pair
        places = sources_of(lines, ends.sources_m), lines.vertices_m, ends.poses.position_m[lines.pose]
        away = list(legs(*places))
        back = next(legs(places[2], lines.vertices_m[:, ::-1], places[0]))  # from the UAV
        pieces.append(
            {
                "pose": item.pose,
                "tower": item.tower,
                # however many reflections: their number stands in ``turns``
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
    # the last key is the first to count
    order = np.lexsort((columns["length_m"], columns["tower"], columns["pose"]))
    columns = {name: value[order] for name, value in columns.items()}
    link = columns["pose"] * counts.shape[1] + columns["tower"]
    number = np.arange(len(link)) - np.searchsorted(link, link)
    return PathTable(**columns, number=number, names=tuple(names), kinds=tuple(kinds))


def _gains(item: Any, faces: Faces, ends: Ends, loss_db: FloatArray | None) -> ComplexArray:
    """Gain (paths, n_rx, n_tx) of each path: H of a pose of its own, where it is the only path."""
    pieces, order = [], []
    for tower, (name, array) in enumerate(ends.link.tower_arrays.items()):
        rows = np.flatnonzero(item.tower == tower)
        # each path at a pose of its own: H of that pose is then its gain, by the one law there is
        some, own, link = item.select(rows), np.arange(len(rows)), replace(ends.link, tower_arrays={name: array})
        places, lost = sources_of(some, ends.sources_m)[:, None], None if loss_db is None else loss_db[rows]
        alone = replace(some, pose=own, tower=0 * own)
        pieces.append(fields_of(alone, faces, places, ends.poses[some.pose], link, lost).h[:, 0])
        order.append(rows)
    return np.concatenate(pieces)[np.argsort(np.concatenate(order))]


def impulse_responses(
    table: PathTable, ends: Ends, velocity_mps: FloatArray | None = None, times_s: ArrayLike = (0.0,)
) -> tuple[ComplexArray, FloatArray]:
    """Gains and delays in the axis order of Sionna RT's ``Paths.cir()``, poses as devices.

    Parameters
    ----------
    table : PathTable
    ends : Ends
    velocity_mps : (poses, 3), optional
        Turns the paths by their Doppler shift over the times.
    times_s : (times,)

    Returns
    -------
    a : (rx, rx_ant, tx, tx_ant, paths, times) complex
        With the phase of the carrier, as Sionna's baseband equivalents; zero where there is no path.
    tau : (rx, tx, paths)
        Delay [s]; zero where there is no path.
    """
    turned = table.gain[..., None]
    if velocity_mps is not None:
        cycles = table.doppler_hz(ends.link.carrier_hz, velocity_mps)[:, None] * unmasked(times_s)
        turned = turned * np.exp(2j * np.pi * cycles)[:, None, None, :]
    # by path, pose, tower (, rx_ant, tx_ant, time)
    rx, tx = (2, 1) if ends.link.uav_transmits else (1, 2)
    a, tau = (table.by_link(values, ends, 0.0) for values in (turned, table.delay_s))
    return np.ascontiguousarray(a.transpose(rx, 3, tx, 4, 0, 5)), np.ascontiguousarray(tau.transpose(rx, tx, 0))


def frequency_responses(table: PathTable, ends: Ends, offsets_hz: ArrayLike) -> ComplexArray:
    """Channel matrices at frequencies about the carrier.

    Parameters
    ----------
    table : PathTable
    ends : Ends
    offsets_hz : (frequencies,)
        From the carrier, such as those of :func:`subcarriers_hz`.

    Returns
    -------
    (poses, towers, n_rx, n_tx, frequencies) complex

    Raises
    ------
    UsageError
        A band wider than a tenth of the carrier.

    Notes
    -----
    ``H(f0 + f) = sum_p a_p exp(-j 2 pi f tau_p)`` with gains of the carrier and delays of the array centres.
    """
    offsets = unmasked(offsets_hz)
    check_band(float(np.ptp(offsets)) if len(offsets) else 0.0, ends.link.carrier_hz)
    gains, delays = (table.by_link(values, ends, 0.0) for values in (table.gain, table.delay_s))
    h = np.zeros((*gains.shape[1:], len(offsets)), dtype=np.complex128)
    # a path of each link at a time: the product over all paths would take memory for each of them
    for gain, delay in zip(gains, delays, strict=True):
        h += gain[..., None] * np.exp(-2j * np.pi * delay[..., None] * offsets)[:, :, None, None]
    return h


def check_band(bandwidth_hz: float, carrier_hz: float) -> None:
    """UsageError for a band wider than :data:`WIDEST_BAND` of the carrier."""
    if bandwidth_hz > WIDEST_BAND * carrier_hz:
        raise UsageError(
            f"a band of {bandwidth_hz / 1e6:g} MHz about {carrier_hz / 1e9:g} GHz",
            expected=f"at most {WIDEST_BAND * carrier_hz / 1e6:g} MHz, a tenth of the carrier",
            cause="materials, antennas and foliage are those of the carrier",
        )


def subcarriers_hz(bandwidth_hz: float, count: int) -> FloatArray:
    """Offsets (count,) of subcarriers from the carrier, as an FFT centred on it has them.

    Examples
    --------
    >>> subcarriers_hz(4.0, 4).tolist()
    [-2.0, -1.0, 0.0, 1.0]
    """
    # as np.fft.fftshift orders them: with an even count the lowest has no partner
    return np.asarray((np.arange(count) - count // 2) * (bandwidth_hz / count))

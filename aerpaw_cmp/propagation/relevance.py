"""Leave out face sequences that provably cannot change RSS by more than a stated amount.

The field of a path over ``L`` metres is at most ``g_tower g_uav lambda / (4 pi L)``, with ``g`` the largest
amplitude of an element's pattern, since no reflection gains. Which paths a link could have is known from the geometry,
short of what hides them. If those left out could together add at most ``B``, and what was kept gives ``F`` (the root
mean square over element pairs), then the RSS of that link moves by less than ``relevance_db`` whenever
``B <= F (1 - 10^(-relevance_db / 20))``. This is checked link by link after the search; poses with a link that fails
(fades, hidden poses) are searched again with everything. Nothing is guessed.

Only mirrors are left out: every face goes on hiding what lies behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..common.units import BoolArray, FloatArray, IntArray, amplitude_from_db, wavelength_m
from .arrays import Array, Link
from .image import CELLS_PER_CHUNK, Sequences, meets_last_face, scene_tolerance_m, trace_back
from .paths import Faces

FAILING_SHARE = 0.05
"""Share of a tower's links that may fail the bound and be searched again."""

PATTERN_STEP_DEG = 2.0
PATTERN_MARGIN = 1.03
"""On the largest amplitude found on the grid: a pattern is smooth over 2 degrees to within 0.25 dB at its peak."""


@dataclass
class Relevance:
    """Chooses the sequences of each tower; called by :func:`aerpaw_cmp.propagation.image.find_paths`.

    Parameters
    ----------
    faces : Faces
    targets_m : (poses, 3)
        Poses with a position.
    link : Link
    relevance_db : float
    kept_field : (poses, towers)
        Root-mean-square field over element pairs of the paths that are always kept (line of sight and ground);
        zero where there is none.
    """

    faces: Faces
    targets_m: FloatArray
    link: Link
    relevance_db: float
    kept_field: FloatArray
    bound: FloatArray = field(init=False)
    counts: list[tuple[int, int]] = field(init=False)
    used: list[BoolArray] = field(init=False)

    def __post_init__(self) -> None:
        arrays = list(self.link.tower_arrays.values())
        self.bound = np.zeros((len(self.targets_m), len(arrays)))
        self.counts = [(0, 0)] * len(arrays)
        self.used = [np.zeros(len(self.faces), dtype=np.bool_) for _ in arrays]
        self._gain = largest_amplitude(self.link.uav_array) * np.array([largest_amplitude(a) for a in arrays])
        extents = [np.linalg.norm(a.positions_m, axis=1).max() for a in (*arrays, self.link.uav_array)]
        self._extent_m = np.array(extents[:-1]) + extents[-1]

    @property
    def allowed_share(self) -> float:
        """Largest ratio of what is left out to what is kept."""
        return float(1.0 - amplitude_from_db(-self.relevance_db))

    def __call__(self, tower: int, levels: list[Sequences]) -> list[Sequences]:
        """Drop the weakest sequences while all but a few links bear their sum."""
        bearable = self.allowed_share * self.kept_field[:, tower]
        most = FAILING_SHARE * np.count_nonzero(bearable)
        parts = [self._bounds(tower, level) for level in levels]
        start = np.cumsum([0, *(len(level.faces) for level in levels)])
        sequence = np.concatenate([part[0] + first for part, first in zip(parts, start, strict=False)])
        pose, field_ = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
        with np.errstate(divide="ignore"):
            harm = field_ / bearable[pose]
        worst = np.zeros(start[-1])
        np.maximum.at(worst, sequence, np.where(np.isfinite(harm), harm, 0.0))
        always = np.concatenate([(self.faces.solid[level.faces] < 0).all(axis=1) for level in levels])
        dropped = np.zeros(start[-1], dtype=np.bool_)
        order = np.argsort(sequence, kind="stable")
        edges = np.searchsorted(sequence[order], np.arange(start[-1] + 1))
        total = np.zeros(len(self.targets_m))
        for number in np.argsort(worst, kind="stable"):
            if always[number]:
                continue
            mine = order[edges[number] : edges[number + 1]]
            more = total.copy()
            np.add.at(more, pose[mine], field_[mine])
            if np.count_nonzero((more > bearable) & (bearable > 0.0)) > most:
                break
            total, dropped[number] = more, True
        self.bound[:, tower] = total
        self.counts[tower] = (int(dropped.sum()), len(dropped))
        kept = []
        for level, first, last in zip(levels, start[:-1], start[1:], strict=True):
            keep = ~dropped[first:last]
            kept.append(Sequences(level.faces[keep], level.images_m[keep]))
            self.used[tower][np.unique(level.faces[keep])] = True
        return kept

    def _bounds(self, tower: int, level: Sequences) -> tuple[IntArray, IntArray, FloatArray]:
        """(sequence, pose, largest field) of all paths that would be there if nothing hid them."""
        rows: list[IntArray] = []
        columns: list[IntArray] = []
        if level.faces.shape[1]:
            tolerance_m = scene_tolerance_m(self.faces, self.targets_m)
            step = max(1, CELLS_PER_CHUNK // max(1, len(self.targets_m)))
            for first in range(0, len(level.faces), step):
                part = slice(first, first + step)
                row, column = meets_last_face(
                    self.faces, level.faces[part, -1], level.images_m[part, -1], self.targets_m, tolerance_m
                )
                _, good = trace_back(
                    self.faces, level.faces[part][row], level.images_m[part][row], self.targets_m[column], tolerance_m
                )
                rows.append(row[good] + first)
                columns.append(column[good])
        empty = np.zeros(0, dtype=np.int64)
        row, column = (np.concatenate(x) if x else empty for x in (rows, columns))
        if not len(row):
            return empty, empty, np.zeros(0)
        length = np.linalg.norm(self.targets_m[column] - level.images_m[row, -1], axis=1) - self._extent_m[tower]
        with np.errstate(divide="ignore"):
            amplitude = np.minimum(1.0, wavelength_m(self.link.carrier_hz) / (4.0 * np.pi * np.maximum(length, 0.0)))
        return row, column, np.asarray(amplitude * self._gain[tower])

    def failing(self, field_: FloatArray) -> BoolArray:
        """Poses (poses,) with a link whose kept field (poses, towers) does not bear what was left out."""
        return np.asarray((self.bound > self.allowed_share * field_).any(axis=1))

    def report(self, towers: Sequence[str], searched_again: int, poses: int) -> list[str]:
        """What was left out, in words."""
        lines: list[str] = []
        for tower, name in enumerate(towers):
            dropped, total = self.counts[tower]
            lines.append(
                f"{name}: {dropped} of {total} face sequences, which move RSS by less than {self.relevance_db:g} dB"
            )
        idle = ~np.logical_or.reduce(self.used) & (self.faces.solid >= 0)
        for solid in np.unique(self.faces.solid[idle]):
            members = self.faces.solid == solid
            if idle[members].all():
                label = self.faces.label[int(np.flatnonzero(members)[0])].rsplit(" wall", 1)[0]
                lines.append(f"{label}: reflects nothing that matters; it still hides")
        lines.append(f"{searched_again} of {poses} poses were searched again with every sequence")
        return lines


def largest_amplitude(array: Array) -> float:
    """Largest amplitude of any element's pattern, with a margin for what lies between grid directions."""
    theta = np.radians(np.arange(0.0, 180.0 + PATTERN_STEP_DEG, PATTERN_STEP_DEG))[:, None]
    phi = np.radians(np.arange(-180.0, 180.0, PATTERN_STEP_DEG))[None, :]
    theta, phi = np.broadcast_arrays(theta, phi)
    largest = 0.0
    for pattern in array.patterns:
        e_theta, e_phi = pattern.field(theta, phi)
        largest = max(largest, float(np.sqrt(np.abs(e_theta) ** 2 + np.abs(e_phi) ** 2).max()))
    return PATTERN_MARGIN * largest

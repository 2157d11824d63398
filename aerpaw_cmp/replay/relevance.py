"""Leave out face sequences that provably cannot change RSS by more than a stated amount.

The field of a path over ``L`` metres is at most ``g_tower g_uav lambda / (4 pi L)``, with ``g`` the largest
amplitude of an element's pattern, since no reflection gains. If the sequences left out of a link could together add at
most ``B``, and what was kept gives ``F`` (the root mean square over element pairs), then the RSS of that link moves by
less than ``relevance_db`` whenever ``B <= F (1 - 10^(-relevance_db / 20))``. This is checked link by link after the
search; poses with a link that fails (fades, hidden poses) are searched again with everything. Nothing is guessed.

Only mirrors are left out: every face goes on hiding what lies behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from ..units import BoolArray, FloatArray, IntArray, wavelength_m
from .arrays import Array, Link
from .faces import corners
from .image import Sequences
from .paths import Faces

FAILING_SHARE = 0.05
"""Share of a tower's links that may fail the bound and be searched again."""

PATTERN_STEP_DEG = 2.0
PATTERN_MARGIN = 1.03
"""On the largest amplitude found on the grid: a pattern is smooth over 2 degrees to within 0.25 dB at its peak."""


@dataclass
class Relevance:
    """Chooses the sequences of each tower; called by :func:`aerpaw_cmp.replay.image.find_paths`.

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
        self.bound = np.zeros(len(arrays))
        self.counts = [(0, 0)] * len(arrays)
        self.used = [np.zeros(len(self.faces), dtype=np.bool_) for _ in arrays]
        self._gain = largest_amplitude(self.link.uav_array) * np.array([largest_amplitude(a) for a in arrays])
        extents = [np.linalg.norm(a.positions_m, axis=1).max() for a in (*arrays, self.link.uav_array)]
        self._extent_m = np.array(extents[:-1]) + extents[-1]

    @property
    def allowed_share(self) -> float:
        """Largest ratio of what is left out to what is kept."""
        return float(1.0 - 10.0 ** (-self.relevance_db / 20.0))

    def __call__(self, tower: int, levels: list[Sequences]) -> list[Sequences]:
        """Drop the weakest sequences while their sum stays below what all but a few links bear."""
        field_ = self.kept_field[:, tower]
        bearable = self.allowed_share * float(np.quantile(field_, FAILING_SHARE)) if len(field_) else 0.0
        bounds = [self._bounds(tower, level) for level in levels]
        flat = np.concatenate(bounds)
        order = np.argsort(flat)
        dropped = np.zeros(len(flat), dtype=np.bool_)
        sums = np.cumsum(flat[order])
        dropped[order[sums <= bearable]] = True
        self.bound[tower] = float(flat[dropped].sum())
        self.counts[tower] = (int(dropped.sum()), len(flat))
        result: list[Sequences] = []
        start = 0
        for level, bound in zip(levels, bounds, strict=True):
            keep = ~dropped[start : start + len(bound)]
            start += len(bound)
            result.append(Sequences(level.faces[keep], level.images_m[keep]))
            self.used[tower][np.unique(level.faces[keep])] = True
        return result

    def _bounds(self, tower: int, level: Sequences) -> FloatArray:
        """Largest field (sequences,) of each sequence at any pose; infinite for those that are always kept."""
        count, depth = level.faces.shape
        always = (self.faces.solid[level.faces] < 0).all(axis=1)
        if not depth or not len(self.targets_m):
            return np.full(count, np.inf)
        low, high = self.targets_m.min(axis=0), self.targets_m.max(axis=0)
        image, last = level.images_m[:, -1], level.faces[:, -1]
        straight = _box_gap(low, high, image, image)
        box = corners(self.faces, 1e9)
        face_low, face_high = box.min(axis=1), box.max(axis=1)
        onward = _box_gap(low, high, face_low[last], face_high[last])
        # the line from the image to the pose passes through the last face; each leg is as long as its faces are apart
        length = np.maximum(straight, _face_distance(self.faces, last, image) + onward)
        first, source = level.faces[:, 0], _mirrored(self.faces, level.faces[:, 0], level.images_m[:, 0])
        legs = _face_distance(self.faces, first, source) + onward
        for one, two in pairwise(level.faces.T):
            legs += _box_gap(face_low[one], face_high[one], face_low[two], face_high[two])
        length = np.maximum(length, legs)
        length = np.maximum(length - self._extent_m[tower], 0.0)
        with np.errstate(divide="ignore"):
            amplitude = np.minimum(1.0, wavelength_m(self.link.carrier_hz) / (4.0 * np.pi * length))
        return np.asarray(np.where(always, np.inf, amplitude * self._gain[tower]))

    def failing(self, field_: FloatArray) -> BoolArray:
        """Poses (poses,) with a link whose kept field (poses, towers) does not bear what was left out."""
        return np.asarray((self.bound[None, :] > self.allowed_share * field_).any(axis=1))

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


def _mirrored(faces: Faces, index: IntArray, point: FloatArray) -> FloatArray:
    """Points (n, 3) mirrored at their faces."""
    height = np.einsum("ij,ij->i", faces.normal[index], point) - faces.offset_m[index]
    return np.asarray(point - 2.0 * height[:, None] * faces.normal[index])


def _box_gap(low: FloatArray, high: FloatArray, other_low: FloatArray, other_high: FloatArray) -> FloatArray:
    """Distance (n,) of axis-parallel boxes (3,) or (n, 3) from others (n, 3)."""
    return np.asarray(np.linalg.norm(np.maximum(np.maximum(low - other_high, other_low - high), 0.0), axis=1))


def _face_distance(faces: Faces, index: IntArray, point: FloatArray) -> FloatArray:
    """Distance (n,) of points (n, 3) from the bounds of their faces."""
    height = np.einsum("ij,ij->i", faces.normal[index], point) - faces.offset_m[index]
    plane = np.stack([np.einsum("ij,ij->i", axis[index], point) for axis in (faces.along, faces.across)], axis=1)
    beside = np.maximum(np.maximum(faces.lower[index] - plane, plane - faces.upper[index]), 0.0)
    return np.asarray(np.sqrt(height**2 + (beside**2).sum(axis=1)))


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

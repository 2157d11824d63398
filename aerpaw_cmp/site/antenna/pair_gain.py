"""The gain that a channel has towards both ends at once, beside its two antennas: learned, written, interpolated."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...common.gaussian import Factor, gaussian_kernel
from ...common.geodesy import azimuth_rad, elevation_rad
from ...common.units import FloatArray

# Share of the variance by which rounded values may miss the function.
# The file has gains to 0.01 dB and angles to 0.1 deg: neighbours may contradict by as much.
_NUGGET = 1e-3

_HEAD = re.compile(r"^# pair: length (\S+) sd_db (\S+)$", re.MULTILINE)
_ROW = re.compile(r"^# pair: (\S+,\S+,\S+,\S+,\S+,\S+)$", re.MULTILINE)


@dataclass(frozen=True, kw_only=True)
class PairGain:
    """A Gaussian process over the directions at both ends, known at some of them.

    Parameters
    ----------
    directions : (k, 6)
        Unit vectors, from the UAV to the tower in the body and from the tower to the UAV at the mast.
    gain_db : (k,)
        What the antennas of both ends together leave [dB].
    sd_db : (k,)
        Standard deviation of the level that both antennas and this gain predict there [dB].
    length : float
        Of the Gaussian kernel of the chord.
    prior_sd_db : float
        Of the gain where nothing is known [dB].
    """

    directions: FloatArray
    gain_db: FloatArray
    sd_db: FloatArray
    length: float
    prior_sd_db: float

    @cached_property
    def _factor(self) -> Factor:
        matrix = gaussian_kernel(self.directions, self.directions, self.length)
        # directions flown twice would make two equal rows, which have no factor
        matrix[np.diag_indices(len(matrix))] += _NUGGET
        return Factor.of(matrix)

    def at(self, directions: FloatArray, apart_sd_db: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gain and standard deviation of the level (n,) towards directions (n, 6) [dB].

        Parameters
        ----------
        directions : (n, 6)
            As those of the record.
        apart_sd_db : (n,)
            Standard deviation of both antennas as if each were learned alone [dB].

        Returns
        -------
        gain_db, sd_db : (n,)

        Notes
        -----
        The variance is that of the record by the share of the process that its directions determine, and the sum of
        the antennas' and of the prior's by the rest.
        """
        gain, sd = np.empty(len(directions)), np.empty(len(directions))
        white = self._factor.whiten(self.gain_db)
        # bounds the memory of the kernel against all known directions
        for start in range(0, len(directions), 4096):
            part = slice(start, start + 4096)
            across = gaussian_kernel(directions[part], self.directions, self.length)
            gain[part], known = self._factor.condition(across, white)
            # a share: rounding takes it beyond 1 at a known direction
            known = np.minimum(known, 1.0)
            near = across @ self.sd_db**2 / np.maximum(across.sum(axis=1), 1e-12)
            away = apart_sd_db[part] ** 2 + self.prior_sd_db**2
            sd[part] = np.sqrt(known * near + (1.0 - known) * away)
        return gain, sd

    def notes(self) -> Sequence[str]:
        """Lines for the comments of the tower's antenna file."""
        angles = np.concatenate([_angles(self.directions[:, :3]), _angles(self.directions[:, 3:])], axis=1)
        rows = np.column_stack([angles, self.gain_db, self.sd_db])
        return [
            f"pair: length {self.length:g} sd_db {self.prior_sd_db:.3f}",
            *(f"pair: {a:.1f},{b:.1f},{c:.1f},{d:.1f},{g:.2f},{s:.2f}" for a, b, c, d, g, s in rows),
        ]

    @classmethod
    def from_notes(cls, text: str) -> PairGain | None:
        """From :meth:`notes` among the comments of an antenna file; None where there are none, or damaged ones."""
        head, rows = _HEAD.search(text), _ROW.findall(text)
        try:
            table = np.array([[float(cell) for cell in row.split(",")] for row in rows])
            length, prior = (float(head[1]), float(head[2])) if head else (0.0, 0.0)
        except ValueError:
            return None
        if not len(table) or not np.isfinite(table).all() or not length > 0:
            return None
        return cls(
            directions=np.concatenate([_vectors(table[:, :2]), _vectors(table[:, 2:4])], axis=1),
            gain_db=table[:, 4],
            sd_db=table[:, 5],
            length=length,
            prior_sd_db=prior,
        )


def _angles(vectors: FloatArray) -> FloatArray:
    return np.column_stack([np.degrees(azimuth_rad(vectors)) % 360.0, np.degrees(elevation_rad(vectors))])


def _vectors(angles_deg: FloatArray) -> FloatArray:
    azimuth, elevation = np.radians(angles_deg).T
    across = np.cos(elevation)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])

"""The gain that a channel has towards both ends at once, beside its two antennas: learned, written, interpolated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ...common.errors import InputError, parsed
from ...common.gaussian import Factor, gaussian_kernel
from ...common.geodesy import azimuth_rad, elevation_rad
from ...common.units import FloatArray
from .learned import Written, read_table

# Share of the variance by which rounded values may miss the function.
# The table has gains to 0.01 dB and angles to 0.1 deg: neighbours may contradict by as much.
_NUGGET = 1e-3


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

    def table(self, notes: Sequence[str]) -> str:
        """Return the content of a table of the directions, gains and standard deviations, with comments at its head."""
        angles = np.concatenate([angles_of(self.directions[:, :3]), angles_of(self.directions[:, 3:])], axis=1)
        rows = np.column_stack([angles, self.gain_db, self.sd_db])
        lines = [f"# {note}" for note in notes] + [",".join(COLUMNS)]
        lines += [f"{a:.1f},{b:.1f},{c:.1f},{d:.1f},{g:.2f},{s:.2f}" for a, b, c, d, g, s in rows]
        return "\n".join(lines) + "\n"


COLUMNS = ("uav_azimuth_deg", "uav_elevation_deg", "tower_azimuth_deg", "tower_elevation_deg", "gain_db", "sd_db")


@parsed("a table of the gain towards both ends")
def read_pair(path: Path, length: float, prior_sd_db: float, written: Written | None = None) -> PairGain:
    """Read a table of :meth:`PairGain.table`.

    Parameters
    ----------
    path : Path
    length, prior_sd_db : float
        Kernel of the gain, as in :class:`PairGain`.
    written : Written, optional
        The table must be as it was written.

    Raises
    ------
    InputError
        Other columns, no row, values that are not finite; a table that is not as it was written.
    """
    text = read_table(path, "a table of the gain towards both ends", written).decode("utf-8-sig")
    lines = [line for line in text.splitlines() if line.strip() and line[0] != "#"]
    table = np.loadtxt(lines[1:], delimiter=",", ndmin=2) if len(lines) > 1 else np.zeros((0, len(COLUMNS)))
    if lines[:1] != [",".join(COLUMNS)] or not len(table) or table.shape[1] != len(COLUMNS):
        raise InputError("not the columns, or no row", expected=", ".join(COLUMNS), path=path)
    if not np.isfinite(table).all():
        raise InputError("values that are not finite", expected="angles [deg], gains and SDs [dB]", path=path)
    return PairGain(
        directions=np.concatenate([vectors_of(table[:, :2]), vectors_of(table[:, 2:4])], axis=1),
        gain_db=table[:, 4],
        sd_db=table[:, 5],
        length=length,
        prior_sd_db=prior_sd_db,
    )


def angles_of(vectors: FloatArray) -> FloatArray:
    """Return azimuths and elevations (n, 2) [deg] of unit vectors (n, 3)."""
    return np.column_stack([np.degrees(azimuth_rad(vectors)) % 360.0, np.degrees(elevation_rad(vectors))])


def vectors_of(angles_deg: FloatArray) -> FloatArray:
    """Return unit vectors (n, 3) of azimuths and elevations (n, 2) [deg]."""
    azimuth, elevation = np.radians(angles_deg).T
    across = np.cos(elevation)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])

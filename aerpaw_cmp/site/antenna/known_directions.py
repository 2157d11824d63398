"""Directions at which the gain of an airframe is known, and the covariance of the gain there: written and read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...common.errors import InputError, parsed
from ...common.units import FloatArray
from .learned import Written, read_table
from .pair_gain import angles_of, vectors_of

_WHAT = "a table of the directions at which a gain is known"
_COLUMNS = ("azimuth_deg", "elevation_deg", "covariance_db2 (columns up to the row's own)")


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownDirections:
    """Unit vectors (m, 3) in the body frame, and the covariance (m, m) of the gain towards them [dB^2]."""

    directions: FloatArray
    covariance_db2: FloatArray

    def table(self, notes: Sequence[str]) -> str:
        """Return the content of the table, with comments at its head."""
        lines = [f"# {note}" for note in notes] + [",".join(_COLUMNS)]
        for number, (azimuth, elevation) in enumerate(angles_of(self.directions)):
            row = self.covariance_db2[number, : number + 1]
            lines.append(f"{azimuth:.1f},{elevation:.1f}," + ",".join(f"{value:.2f}" for value in row))
        return "\n".join(lines) + "\n"


@parsed(_WHAT)
def read_known(path: Path, written: Written | None = None) -> KnownDirections:
    """Read a table of :meth:`KnownDirections.table`.

    Raises
    ------
    InputError
        Other columns, rows of another length, values that are not finite; a table that is not as it was written.
    """
    text = read_table(path, _WHAT, written).decode("utf-8-sig")
    lines = [line for line in text.splitlines() if line.strip() and line[0] != "#"]
    rows = [[float(cell) for cell in line.split(",")] for line in lines[1:]]
    if lines[:1] != [",".join(_COLUMNS)] or not rows or [len(row) for row in rows] != [*range(3, len(rows) + 3)]:
        raise InputError("not the columns, or rows of another length", expected=", ".join(_COLUMNS), path=path)
    lower = np.zeros((len(rows), len(rows)))
    for number, row in enumerate(rows):
        lower[number, : number + 1] = row[2:]
    if not np.isfinite(lower).all() or not np.isfinite([row[:2] for row in rows]).all():
        raise InputError("values that are not finite", expected="angles [deg] and covariances [dB^2]", path=path)
    return KnownDirections(
        directions=vectors_of(np.array([row[:2] for row in rows])),
        covariance_db2=lower + np.tril(lower, -1).T,
    )

"""Antenna files over the full sphere with a standard deviation: read, written, and as cuts for planning tools."""

from __future__ import annotations

import copy
import csv
import io
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np

from ...common.cells import guarded_comment
from ...common.errors import InputError, parsed
from ...common.provenance import marks, trained_on
from ...common.units import BoolArray, FloatArray, db_from_power, power_from_db
from .antennas import HIGHEST_DBI, MeasuredPattern, check_power
from .learned import LearnedSpread, Written, read_table
from .pair_gain import PairGain

COLUMNS = ("azimuth_deg", "elevation_deg", "gain_dbi", "gain_sd_db")


class SpherePattern(MeasuredPattern):
    """A gain grid with its standard deviation.

    Parameters
    ----------
    name : str
    gain_dbi, sd_db : (thetas, phis)
        Zenith angle 0 to 180 deg and azimuth 0 to below 360 deg, both equally spaced.
    notes : str
        Comments of the file, from which its provenance is read.

    Attributes
    ----------
    pair : PairGain or None
        Gain towards both ends at once, besides that of a tower's antenna.
    spread : LearnedSpread or None
        Error model of a level besides the SD of the gain.
    """

    def __init__(
        self,
        name: str,
        gain_dbi: FloatArray,
        sd_db: FloatArray,
        frequency_hz: float | None = None,
        notes: str = "",
    ) -> None:
        super().__init__(name, np.sqrt(power_from_db(gain_dbi)).astype(np.complex128), None, frequency_hz)
        self.trained_on, self.marks = trained_on(notes), marks(notes)
        self.notes = notes
        self.pair: PairGain | None = None
        self.spread: LearnedSpread | None = None
        self._sd_db = np.asarray(sd_db, dtype=np.float64)

    @property
    def largest_sd_db(self) -> float:
        """Standard deviation of the gain in the direction that is known least [dB]."""
        return float(self._sd_db.max())

    def gain_sd_db(self, theta_rad: FloatArray, phi_rad: FloatArray) -> FloatArray:
        """Standard deviation of the gain towards directions [dB], bilinear."""
        from scipy.ndimage import map_coordinates

        theta, phi = np.broadcast_arrays(np.asarray(theta_rad, dtype=float), np.asarray(phi_rad, dtype=float))
        rows, columns = self._sd_db.shape
        # the first meridian again behind the last, so that interpolation goes round
        wrapped = np.concatenate([self._sd_db, self._sd_db[:, :1]], axis=1)
        at = [theta.ravel() / np.pi * (rows - 1), (phi.ravel() % (2 * np.pi)) / (2 * np.pi) * columns]
        return np.asarray(map_coordinates(wrapped, at, order=1, mode="nearest").reshape(theta.shape))


def sphere_grid(step_deg: float = 5.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Zenith angles (t,) and azimuths (p,) [deg] of a full sphere, and unit vectors (t, p, 3)."""
    # both poles, but 360 deg not again: it is 0
    theta, phi = np.arange(0.0, 180.0 + step_deg / 2, step_deg), np.arange(0.0, 360.0, step_deg)
    t, p = np.radians(theta)[:, None], np.radians(phi)[None, :]
    vectors = np.stack(np.broadcast_arrays(np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)), axis=-1)
    return theta, phi, vectors


def unit_mean_gain(gain_db: FloatArray) -> FloatArray:
    """A grid (thetas, phis) [dB] shifted so that its mean power over the sphere is that of an isotropic antenna.

    The level of a learned gain is not identified: it stands in the offset.
    """
    theta = np.linspace(0.0, np.pi, gain_db.shape[0])
    # area of a ring; a pole has none
    weight = np.sin(theta)[:, None] * np.ones_like(gain_db)
    return np.asarray(gain_db - db_from_power((power_from_db(gain_db) * weight).sum() / weight.sum()))


def sphere_csv(gain_dbi: FloatArray, sd_db: FloatArray, notes: tuple[str, ...] = (), decimals: int = 3) -> str:
    """Text of an antenna file: comment lines, a header, a line per direction.

    Parameters
    ----------
    gain_dbi, sd_db : (thetas, phis)
        Zenith angle 0 to 180 deg and azimuth 0 to below 360 deg, both equally spaced.
    notes : tuple of str
        Comments, a line each.
    decimals : int
        Of the gains.

    Returns
    -------
    str
    """
    rows, columns = gain_dbi.shape
    theta, phi = np.linspace(0.0, 180.0, rows), np.arange(columns) * (360.0 / columns)
    lines = [guarded_comment(f"# {note}") for note in notes] + [",".join(COLUMNS)]
    for i in range(rows):
        lines += [
            f"{phi[j]:g},{90.0 - theta[i]:g},{gain_dbi[i, j]:.{decimals}f},{sd_db[i, j]:.{decimals}f}"
            for j in range(columns)
        ]
    return "\n".join(lines) + "\n"


@parsed("a table of gain over direction")
def read_sphere_csv(path: str | Path, written: Written | None = None) -> SpherePattern:
    """Read an antenna file of :func:`sphere_csv`; azimuth counter-clockwise from the device's x axis, elevation up.

    Parameters
    ----------
    path : str or Path
    written : Written, optional
        The file must be as it was written.

    Raises
    ------
    InputError
        Missing columns or directions, values that are no gains, with the line; a file that is not as it was written.
    """
    path = Path(path)
    # shallow: the pattern of a text is kept, and pair and spread belong to one use of it
    return copy.copy(_pattern_of(read_table(path, "an antenna file", written).decode("utf-8-sig"), path))


@lru_cache(maxsize=64)
def _pattern_of(text: str, path: Path) -> SpherePattern:
    """The antenna of a file's text; kept, for each draft of a folder reads all of a site's memory."""
    numbered = [(n, line) for n, line in enumerate(text.splitlines(), start=1) if line.strip() and line[0] != "#"]
    header = [cell.strip() for cell in numbered[0][1].split(",")] if numbered else []
    if header[:3] != list(COLUMNS[:3]):
        raise InputError(
            f"the columns are {', '.join(header) or 'none'}",
            expected=", ".join(COLUMNS),
            path=path,
            line=numbered[0][0] if numbered else None,
        )
    values = _values(numbered[1:], len(header), path)
    azimuth, elevation = np.unique(np.round(values[:, 0] % 360.0, 6)), np.unique(np.round(values[:, 1], 6))[::-1]
    _check_grid(azimuth, elevation, len(values), path)
    row = np.argmin(np.abs(elevation[None, :] - values[:, 1:2]), axis=1)
    column = np.argmin(np.abs(azimuth[None, :] - values[:, :1] % 360.0), axis=1)
    # the grid is complete by number, so a direction twice means another is missing
    if len(np.unique(row * len(azimuth) + column)) != len(values):
        raise InputError("a direction is given twice", expected="each direction once", path=path)
    gain, sd = np.zeros((2, len(elevation), len(azimuth)))
    gain[row, column] = values[:, 2]
    if len(header) > 3:
        sd[row, column] = values[:, 3]
    notes = "\n".join(line for line in text.splitlines() if line.startswith("#"))
    # the name of the file is that of the antenna in reports
    pattern = SpherePattern(path.stem, gain, sd, notes=notes)
    check_power(pattern, path)
    return pattern


def _values(numbered: Sequence[tuple[int, str]], width: int, path: Path) -> FloatArray:
    """Cells (lines, width) of numbered lines; line by line only where that finds the one that is wrong."""
    with suppress(ValueError):
        if numbered:
            # quick for files that are right, which most are
            values = np.loadtxt([line for _, line in numbered], delimiter=",", comments=None, ndmin=2)
            if values.shape == (len(numbered), width) and not _refused(values).any():
                return values
    return np.array([_row(line, number, width, path) for number, line in numbered]).reshape(-1, width)


def _refused(values: FloatArray) -> BoolArray:
    """Rows (n,) of cells (n, width) that are no gains in a direction."""
    loud, negative = values[:, 2] > HIGHEST_DBI, (values[:, 3:4] < 0).any(axis=1)
    return np.asarray(~np.isfinite(values).all(axis=1) | loud | negative)


def _row(line: str, number: int, width: int, path: Path) -> list[float]:
    cells = next(csv.reader(io.StringIO(line)))
    try:
        row = [float(cell) for cell in cells]
    except ValueError:
        row = []
    if len(row) != width or _refused(np.array([row]))[0]:
        raise InputError(
            f"'{line[:60]}'",
            expected=f"{width} numbers: angles in degrees, gain in dBi (at most {HIGHEST_DBI:g}), standard deviation",
            cause="the line was cut off" if len(cells) < width else None,
            path=path,
            line=number,
        )
    return row


def _check_grid(azimuth: FloatArray, elevation: FloatArray, count: int, path: Path) -> None:
    is_sphere = (
        len(azimuth) >= 4
        and len(azimuth) % 2 == 0
        and len(elevation) >= 3
        and np.allclose(azimuth, np.arange(len(azimuth)) * 360.0 / len(azimuth), atol=1e-3)
        and np.allclose(elevation, np.linspace(90.0, -90.0, len(elevation)), atol=1e-3)
    )
    if not is_sphere or count != len(azimuth) * len(elevation):
        raise InputError(
            f"{count} directions of {len(azimuth)} azimuths and {len(elevation)} elevations",
            expected="a full sphere: azimuth from 0 deg and elevation from 90 to -90 deg in equal steps, each once",
            cause="lines are missing",
            path=path,
        )


def planning_cuts(pattern: MeasuredPattern, name: str, carrier_hz: float, notes: Sequence[str] = ()) -> str:
    """Comments and the two principal cuts in the MSI Planet text format: attenuation below the peak, 360 lines each.

    HORIZONTAL runs clockwise seen from above, as azimuths of planning tools do; VERTICAL starts at the horizon in front
    and goes down first.

    Parameters
    ----------
    pattern : MeasuredPattern
    name : str
        Of the antenna.
    carrier_hz : float
    notes : sequence of str
        A COMMENT line each.

    Returns
    -------
    str
        Text with a line end at its end.
    """
    degrees = np.radians(np.arange(360.0))
    # minus: HORIZONTAL runs clockwise
    level = pattern.gain_dbi(np.full(360, np.pi / 2), -degrees)
    below = np.pi / 2 + degrees  # zenith angle on the great circle through the boresight
    over = pattern.gain_dbi(below, np.zeros(360))
    peak = max(float(level.max()), float(over.max()))
    lines = [f"NAME {name}", f"FREQUENCY {carrier_hz / 1e6:g}", f"GAIN {peak:.2f} dBi"]
    lines += [*(f"COMMENT {note}" for note in notes), "HORIZONTAL 360"]
    lines += [f"{i} {peak - v:.2f}" for i, v in enumerate(level)]
    lines += ["VERTICAL 360", *(f"{i} {peak - v:.2f}" for i, v in enumerate(over))]
    return "\n".join(lines) + "\n"

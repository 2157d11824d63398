"""Far fields of antenna elements: formulas and measured files.

Every pattern has a ``name`` and ``field(theta_rad, phi_rad) -> (E_theta, E_phi)``. The results are complex and have the
broadcast shape of the angles. ``|E_theta|^2 + |E_phi|^2`` is the linear gain over an isotropic antenna. theta is the
zenith angle (0 to pi) and phi the azimuth from x towards y in the device frame: x boresight, y left, z up.

Measured fields are interpolated on a torus: a full circle of theta (through both poles) times a full circle of phi.
Along a great circle through a pole, ``E_theta`` and ``E_phi`` are smooth if the sign of the second half is inverted.
Cubic splines that are periodic in both angles therefore have no seam at the poles or at +/-180 degrees.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import InputError, UsageError, one_line, parsed
from ..common.files import LARGEST_TABLE, read_input
from ..common.text import counted
from ..common.units import (
    AnyArray,
    ComplexArray,
    FloatArray,
    amplitude_from_db,
    db_from_power,
    power_from_db,
    unmasked,
    wrap_degrees,
)
from ..logs.matfile import read_arrays

# Peak directivity of a half-wave dipole (2.15 dBi): 4 / Cin(2 pi).
_HALF_WAVE_DIPOLE_GAIN = 1.640_922_376_984_585

# Smallest plausible mean gain (-20 dB). A lower value means that the file has other units or normalised fields.
# Measured antennas have about 0.5.
_MINIMUM_EFFICIENCY = 0.01

# Likely cause in the message about a mean gain that no antenna can have. If the values look linear, another cause is
# reported.
NOT_GAIN = "the values are not gain over isotropic"

# Largest plausible gain. A file with a higher gain is not in dBi.
HIGHEST_DBI = 60.0


def _zeros(theta_rad: ArrayLike, phi_rad: ArrayLike) -> ComplexArray:
    return np.zeros(np.broadcast_shapes(np.shape(theta_rad), np.shape(phi_rad)), dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class Isotropic:
    """An antenna with unit gain in all directions, polarised along theta."""

    name: str = "iso"

    def field(self, theta_rad: FloatArray, phi_rad: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return (1, 0) for all directions."""
        zeros = _zeros(theta_rad, phi_rad)
        return zeros + 1.0, zeros


@dataclass(frozen=True, slots=True)
class HalfWaveDipole:
    """A half-wave dipole along z with a peak gain of 2.15 dBi (Balanis, Antenna Theory, eq. 4-84).

    Source: Balanis eq. 4-84.
    """

    name: str = "hw_dipole"

    def field(self, theta_rad: FloatArray, phi_rad: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return ``cos(pi/2 cos theta) / sin theta``, which is 0 along the wire."""
        zeros = _zeros(theta_rad, phi_rad)
        theta = np.asarray(theta_rad, dtype=np.float64)
        sine = np.sin(theta)
        # along the wire both the numerator and the sine vanish; the limit of the ratio is 0
        safe = np.where(np.abs(sine) < 1e-9, 1.0, sine)
        shape = np.where(np.abs(sine) < 1e-9, 0.0, np.cos(np.pi / 2 * np.cos(theta)) / safe)
        return zeros + math.sqrt(_HALF_WAVE_DIPOLE_GAIN) * shape, zeros


@dataclass(frozen=True, slots=True)
class TR38901:
    """An element of 3GPP TR 38.901 table 7.3-1: 8 dBi, 65 degrees half-power width, at most 30 dB attenuation."""

    name: str = "tr38901"

    def field(self, theta_rad: FloatArray, phi_rad: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the complete field as E_theta, because the slant is a property of the array."""
        zeros = _zeros(theta_rad, phi_rad)
        theta_deg = np.degrees(np.asarray(theta_rad, dtype=np.float64))
        phi_deg = wrap_degrees(np.degrees(phi_rad))
        vertical = np.minimum(12 * ((theta_deg - 90) / 65) ** 2, 30.0)
        horizontal = np.minimum(12 * (phi_deg / 65) ** 2, 30.0)
        gain_db = 8.0 - np.minimum(vertical + horizontal, 30.0)
        return zeros + np.sqrt(power_from_db(gain_db)), zeros


class MeasuredPattern:
    """A field sampled on a regular grid of the sphere.

    Parameters
    ----------
    name : str
        Name for reports.
    e_theta, e_phi : (thetas, phis) complex
        Samples at equally spaced theta from 0 to pi (both included) and phi from 0 to below 2 pi. The number of phis is
        even. An amplitude is the square root of a gain. If ``e_phi`` is None, the pattern is a gain grid without
        polarisation, whose amplitude is in E_theta.
    frequency_hz : float or None
        Frequency of the measurement.

    Attributes
    ----------
    peak_gain_dbi, least_gain_dbi : float
        Largest and smallest sample.
    efficiency : float
        Mean gain over the sphere (radiation efficiency times mismatch).
    trained_on, marks : tuple of str
        SHA-256 and fingerprints of the training logs, on which the pattern must not be scored.
    """

    trained_on: tuple[str, ...] = ()
    marks: tuple[str, ...] = ()

    def __init__(
        self, name: str, e_theta: ComplexArray, e_phi: ComplexArray | None, frequency_hz: float | None = None
    ) -> None:
        self.name = name
        self.frequency_hz = frequency_hz
        thetas, phis = e_theta.shape
        if thetas < 3 or phis < 4 or phis % 2:
            raise UsageError(f"pattern '{name}' has {thetas} x {phis} samples", expected="3 or more x an even number")
        samples = np.abs(e_theta) ** 2 + (0.0 if e_phi is None else np.abs(e_phi) ** 2)
        self.peak_gain_dbi = float(db_from_power(samples.max()))
        # a null of exactly zero becomes -300 dBi, not minus infinity
        self.least_gain_dbi = float(db_from_power(max(samples.min(), 1e-30)))
        self.efficiency = _sphere_mean(samples)
        if e_phi is None:
            amplitude = np.abs(e_theta)
            for row in (0, -1):  # a pole is a single direction, so all samples of its row get the same value
                amplitude[row] = np.sqrt((amplitude[row] ** 2).mean())
            # an amplitude without polarisation has no direction to rotate
            self._layers = [_spline(_torus(amplitude, +1).real)]
        else:
            theta_part, phi_part = _single_valued_poles(e_theta, e_phi)
            # beyond a pole, both unit vectors have the opposite sign
            torus = [_torus(theta_part, -1), _torus(phi_part, -1)]
            self._layers = [_spline(layer) for part in torus for layer in (part.real, part.imag)]

    def __repr__(self) -> str:
        return f"MeasuredPattern({self.name!r}, peak {self.peak_gain_dbi:.2f} dBi, efficiency {self.efficiency:.2f})"

    def field(self, theta_rad: FloatArray, phi_rad: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the field by cubic splines through the samples."""
        from scipy.ndimage import map_coordinates

        theta, phi = np.broadcast_arrays(np.asarray(theta_rad, dtype=float), np.asarray(phi_rad, dtype=float))
        rows, columns = self._layers[0].shape
        full = 2 * np.pi
        # convert the angles to rows and columns of the torus
        at = np.stack([(theta % full).ravel() * (rows / full), (phi % full).ravel() * (columns / full)])
        parts = [
            map_coordinates(layer, at, order=3, mode="grid-wrap", prefilter=False).reshape(theta.shape)
            for layer in self._layers
        ]
        if len(parts) == 1:
            # next to a deep null a cubic spline can be negative, but an amplitude cannot
            return np.maximum(parts[0], 0.0).astype(np.complex128), _zeros(theta, phi)
        return parts[0] + 1j * parts[1], parts[2] + 1j * parts[3]

    def gain_dbi(self, theta_rad: ArrayLike, phi_rad: ArrayLike) -> FloatArray:
        """Return the gain in a direction [dBi]."""
        e_theta, e_phi = self.field(unmasked(theta_rad), unmasked(phi_rad))
        return db_from_power(np.abs(e_theta) ** 2 + np.abs(e_phi) ** 2)


def _spline(torus: FloatArray) -> FloatArray:
    from scipy.ndimage import spline_filter

    return np.asarray(spline_filter(torus, order=3, mode="grid-wrap"), dtype=np.float64)


def _torus(half: ComplexArray | FloatArray, sign: int) -> AnyArray:
    """Extend the rows from theta = pi to 2 pi: the second half of each great circle is the meridian at phi + pi."""
    opposite = np.roll(half, half.shape[1] // 2, axis=1)
    return np.concatenate([half, sign * opposite[-2:0:-1]], axis=0)


def _sphere_mean(gain: FloatArray) -> float:
    """Return the mean gain over the sphere from rows of theta 0 to pi."""
    theta = np.linspace(0, np.pi, gain.shape[0])
    edges = np.concatenate([[0.0], (theta[1:] + theta[:-1]) / 2, [np.pi]])
    # weight each row by the area of the band around it, which is not zero at a pole
    weight = np.cos(edges[:-1]) - np.cos(edges[1:])
    return float((gain.mean(axis=1) * weight).sum() / 2)


def _pole_vectors(e_theta: ComplexArray, e_phi: ComplexArray, row: int, slope: float) -> tuple[complex, complex, float]:
    """Return the mean field (x, y) of a row at or next to a pole, and its share of the power of the row."""
    phi = np.arange(e_theta.shape[1]) * (2 * np.pi / e_theta.shape[1])
    x = slope * e_theta[row] * np.cos(phi) - e_phi[row] * np.sin(phi)
    y = slope * e_theta[row] * np.sin(phi) + e_phi[row] * np.cos(phi)
    power = float((np.abs(x) ** 2 + np.abs(y) ** 2).mean())
    mean_power = abs(x.mean()) ** 2 + abs(y.mean()) ** 2
    return complex(x.mean()), complex(y.mean()), mean_power / power if power > 0 else 0.0


def _single_valued_poles(e_theta: ComplexArray, e_phi: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Replace the row of each pole by one field vector, because all samples at a pole measure the same field."""
    e_theta, e_phi = e_theta.copy(), e_phi.copy()
    phi = np.arange(e_theta.shape[1]) * (2 * np.pi / e_theta.shape[1])
    for row, next_row, slope in ((0, 1, 1.0), (-1, -2, -1.0)):
        x, y, _ = _pole_vectors(e_theta, e_phi, row, slope)
        near_x, near_y, _ = _pole_vectors(e_theta, e_phi, next_row, slope)
        if (x * np.conj(near_x) + y * np.conj(near_y)).real < 0:  # some files invert the row of a pole
            x, y = -x, -y
        e_theta[row] = slope * (x * np.cos(phi) + y * np.sin(phi))
        e_phi[row] = y * np.cos(phi) - x * np.sin(phi)
    return e_theta, e_phi


# ---------------------------------------------------------------- AERPAW text files

# Start of each column name without spaces and points, which differ even between files of one laboratory.
_COLUMNS = ("phi", "theta", "etotal", "e(phi)amp", "e(theta)amp", "e(phi)phase", "e(theta)phase")


@dataclass(slots=True)
class _Rows:
    """The numbers of a text file (rows, 7) with their line numbers."""

    values: FloatArray
    lines: list[int] = field(default_factory=list)
    frequency_hz: float | None = None


@parsed("an antenna pattern file")
def read_pattern_text(path: str | Path) -> MeasuredPattern:
    """Read an AERPAW antenna text file with complex E_phi and E_theta over phi x theta.

    Parameters
    ----------
    path : str or Path
        Header lines, then tab-separated phi, theta [rad], total, E_phi, E_theta [dBi], and the phases [rad].
        theta from -pi to pi at phi from 0 to below pi, or theta from 0 to pi at phi from 0 to below 2 pi.

    Returns
    -------
    MeasuredPattern
        Pattern with E_phi and E_theta.

    Raises
    ------
    InputError
        If angles are missing, units are wrong, a line is truncated, or more power is radiated than accepted. The
        message contains the line.

    Notes
    -----
    At a pole, E_theta and E_phi must describe the same vector for all phi. The poles therefore show whether E_phi
    points along increasing phi. If E_phi points the other way, as in AERPAW's files, phi is the angle of a turntable
    and azimuth is -phi (``rad_pat.mat`` lists the same measurement with azimuth -phi). If the poles radiate too
    little to decide, the direction of AERPAW's files is used.
    """
    path = Path(path)
    rows = _read_rows(path)
    _check_units(rows)
    folded, table = _as_grid(rows)
    amplitude_db, phase = table[..., [4, 3]], table[..., [6, 5]]
    fields = np.moveaxis(amplitude_from_db(amplitude_db) * np.exp(1j * phase), -1, 0)
    e_theta, e_phi = _unfold(fields) if folded else fields
    along = _points_along_phi(e_theta.T, e_phi.T)
    # if E_phi does not point along phi, phi is the angle of a turntable, which increases opposite to azimuth
    if not along:
        e_theta, e_phi = _mirrored(e_theta), _mirrored(e_phi)
    pattern = MeasuredPattern(path.stem, e_theta.T, e_phi.T, rows.frequency_hz)
    check_power(pattern)
    return pattern


# Formats that the reader of antenna files accepts, for messages.
READABLE = (
    "one of: AERPAW's text ('Phi Theta E Total. dB ...', radians and dBi), MSI Planet (.msi, .pln), a sphere as CSV "
    "(azimuth_deg,elevation_deg,gain_dbi), or an azimuth and an elevation cut as two CSV files "
    "(azimuth_deg,gain_dbi and elevation_deg,gain_dbi)"
)

# Text by which unsupported formats are recognised, each with the program or standard that uses it.
_FOREIGN = (
    (r"\s*(REVNUM|REVDAT)\s*:,", "an NSMA antenna file (.adf, WG16.99.050): save it as MSI Planet"),
    (r"(?s).{0,400}?(//CST Farfield|Theta \[deg\.?\]\s+Phi)", "a far field of CST: save gain in dBi as a sphere CSV"),
    (r"(?s)\s*##File Type: Far Field", "a far field of FEKO (.ffe): save gain in dBi as a sphere CSV"),
    (r"(?s).{0,200}?Freq\w*\s*\d+\s*\n.{0,200}?rETheta", "a far field of HFSS: save gain in dBi as a sphere CSV"),
    (r"(?s)\s*(<\?xml|<antenna)", "an antenna in XML: save it as MSI Planet"),
    (r"\s*(azimuth|elevation|theta)_deg", "one of two cuts: name the other file with 'elevation'"),
    (
        r"[^\n]*(?i:angle|azimuth|elevation|theta|phi)[^\n]*,",
        "one of two cuts (name the other file with 'elevation'), or a table with unknown column names",
    ),
)


_FREQUENCY = re.compile(
    r"\s*frequency\s*=\s*([-+]?\d{1,20}(?:\.\d{0,20})?(?:e[-+]?\d{1,2})?)\s*\(\s*([kMG]?)Hz\s*\)",
    re.IGNORECASE | re.ASCII,
)


def _read_rows(path: Path) -> _Rows:
    # remove the byte-order mark that spreadsheets write, because it would become part of the first header
    text = read_input(path, LARGEST_TABLE, "an antenna pattern file").decode("utf-8-sig")
    rows = _Rows(np.zeros((0, 7)))
    values: list[list[float]] = []
    started = False
    for number, line in enumerate(text.splitlines(), start=1):
        if frequency := _FREQUENCY.match(line):
            scale = {"": 1.0, "K": 1e3, "M": 1e6, "G": 1e9}[frequency.group(2).upper()]
            rows.frequency_hz = float(frequency.group(1)) * scale
            continue
        if line.lower().lstrip().startswith("phi"):
            _check_header(line, number)
            started = True
        elif started and line.strip():
            values.append(_numbers(line, number))
            rows.lines.append(number)
    _check_last_line(text, rows)
    if not values:
        first = next((line.strip() for line in text.splitlines() if line.strip()), "")
        raise InputError(
            f"no antenna pattern of a known format; the file begins with '{one_line(first)[:60]}'",
            expected=READABLE,
            cause=next((cause for sign, cause in _FOREIGN if re.match(sign, text)), None),
        )
    rows.values = np.array(values)
    return rows


def _check_last_line(text: str, rows: _Rows) -> None:
    """Refuse a truncated file: its last line has no line end, and fewer decimals than all other lines."""
    if not rows.lines or text.endswith(("\n", "\r")):
        return
    lines = text.splitlines()
    # number of decimals of the last cell, which is equal in all rows of a file
    places = [len(lines[number - 1].split()[-1].rpartition(".")[2]) for number in rows.lines]
    if len(places) > 1 and len(set(places[:-1])) == 1 and places[-1] < places[0]:
        raise InputError(
            f"the last number, '{lines[rows.lines[-1] - 1].split()[-1]}', has fewer digits than those above it",
            cause="the line was cut off",
            line=rows.lines[-1],
        )


def _check_header(line: str, number: int) -> None:
    # remove spaces and points, in which the headers of files differ
    columns = [re.sub(r"[\s.]", "", cell.lower()) for cell in line.split("\t")]
    if len(columns) != 7 or not all(cell.startswith(column) for cell, column in zip(columns, _COLUMNS, strict=True)):
        cause = "the columns are not separated by tabs" if len(columns) == 1 else None
        raise InputError(
            f"the columns are {', '.join(columns)}", expected=", ".join(_COLUMNS), cause=cause, line=number
        )


def _numbers(line: str, number: int) -> list[float]:
    cells = line.split()
    try:
        row = [float(cell) for cell in cells]
    except ValueError:
        row = []
    if len(row) != 7 or not all(math.isfinite(cell) for cell in row):
        cause = "the line was cut off" if len(cells) < 7 else None
        raise InputError(
            f"{counted(len(cells), 'field')}: '{line.strip()[:60]}'",
            expected="7 numbers",
            cause="decimal commas in place of points" if re.search(r"\d,\d", line) else cause,
            line=number,
        )
    return row


def _check_units(rows: _Rows) -> None:
    values = rows.values
    for columns, what in (((0, 1), "angles"), ((5, 6), "phases")):
        largest = np.abs(values[:, columns]).max(axis=1)
        worst = int(largest.argmax())
        # accept up to 0.1 rad above a full circle as rounding; larger angles are in degrees
        if largest[worst] > 2 * np.pi + 0.1:
            raise InputError(
                f"{what} reach {largest[worst]:g}",
                expected=f"{what} in radians",
                cause="they are in degrees",
                line=rows.lines[worst],
            )
    if values[:, 2:5].max() > HIGHEST_DBI:
        worst = int(values[:, 2:5].max(axis=1).argmax())
        raise InputError(
            f"a gain of {values[worst, 2:5].max():g}", expected=f"dBi, at most {HIGHEST_DBI:g}", line=rows.lines[worst]
        )
    # the file also contains the total gain, so its units can be checked
    total = db_from_power(power_from_db(values[:, 3]) + power_from_db(values[:, 4]))
    wrong = np.flatnonzero(np.abs(total - values[:, 2]) > 0.05)
    if len(wrong):
        row = values[wrong[0]]
        raise InputError(
            f"a total of {row[2]:g} with components {row[3]:g} and {row[4]:g}",
            expected=f"the total of the components, {total[wrong[0]]:.2f} dBi",
            cause="linear amplitudes instead of dBi" if len(wrong) > len(values) / 2 else "the line was cut off",
            line=rows.lines[wrong[0]],
        )


def _as_grid(rows: _Rows) -> tuple[bool, FloatArray]:
    """Return whether theta covers a full circle, and the rows as (phis, thetas, 7). InputError for gaps."""
    # five digits, because float32 angles of one grid line differ in the seventh
    key = np.round(rows.values[:, :2], 5)
    phi, at_phi = np.unique(key[:, 0], return_inverse=True)
    theta, at_theta = np.unique(key[:, 1], return_inverse=True)
    # scattered directions are not a grid, and a table of all their angles could fill the memory
    if len(theta) < 3 or len(phi) * len(theta) > 2 * len(key) + 1000:
        raise InputError(
            f"{len(key)} rows with {len(phi)} values of phi and {len(theta)} of theta",
            expected="a grid over the sphere: every phi with every theta",
            cause="angles with different digits in each row, or a file that was cut off",
        )
    seen = np.zeros((len(phi), len(theta)), dtype=np.int64)
    np.add.at(seen, (at_phi, at_theta), 1)
    if (seen == 0).any() or (seen > 1).any():
        i, j = np.argwhere(seen != 1)[0]
        what = "missing" if seen[i, j] == 0 else "given twice"
        raise InputError(
            f"{counted(int((seen != 1).sum()), 'direction')} missing or given twice, the first at phi "
            f"{math.degrees(phi[i]):.1f} deg, theta {math.degrees(theta[j]):.1f} deg ({what})",
            expected=f"each of {len(phi)} x {len(theta)} directions once",
            cause="the file was cut off, or a line is lost" if what == "missing" else "a line was copied",
            line=None if what == "missing" else rows.lines[np.flatnonzero((at_phi == i) & (at_theta == j))[1]],
        )
    # if theta begins at -pi, phi covers only half a circle
    folded = theta[0] < -0.1
    span = np.pi if folded else 2 * np.pi
    phi_expected = np.arange(len(phi)) * (span / len(phi))
    theta_expected = np.linspace(-np.pi if folded else 0.0, np.pi, len(theta))
    for what, axis, grid in (("phi", phi, phi_expected), ("theta", theta, theta_expected)):
        if np.abs(axis - grid).max() > 1e-3:
            step = math.degrees(grid[1] - grid[0]) if len(grid) > 1 else 0.0
            raise InputError(
                f"{what} runs from {math.degrees(axis[0]):.1f} to {math.degrees(axis[-1]):.1f} deg in {len(axis)} "
                "values",
                expected=f"{math.degrees(grid[0]):.0f} to {math.degrees(grid[-1]):.1f} deg in steps of {step:.2f}",
                cause="angles are missing",
            )
    # rows may have any order
    order = np.empty((len(phi), len(theta)), dtype=np.int64)
    order[at_phi, at_theta] = np.arange(len(key))
    return bool(folded), rows.values[order]


def _unfold(folded: ComplexArray) -> ComplexArray:
    """Convert (2, phis to pi, thetas -pi..pi) to (2, phis to 2 pi, thetas 0..pi).

    A negative theta is a point on the meridian at phi + pi.

    At points with negative theta, some files contain spherical components. Other files contain the components along the
    cut, which have the opposite sign. The two kinds of files are distinguished by continuity: the field must be smooth
    where phi wraps around, and along each meridian next to the poles.
    """
    # column with theta = 0
    middle = folded.shape[2] // 2
    near, far = folded[:, :, middle:].copy(), folded[:, :, middle::-1].copy()
    inner = slice(1, -1)
    if _misfit(far[:, 0, inner], near[:, -1, inner]) > _misfit(-far[:, 0, inner], near[:, -1, inner]):
        far = -far
    for pole, next_row in ((0, 1), (-1, -2)):  # the row of a pole may have the sign of either half circle
        if _misfit(near[:, :, pole], near[:, :, next_row]) > _misfit(-near[:, :, pole], near[:, :, next_row]):
            near[:, :, pole] *= -1
        far[:, :, pole] = -near[:, :, pole]
    return np.concatenate([near, far], axis=1)


def _misfit(first: ComplexArray, second: ComplexArray) -> float:
    return float((np.abs(first - second) ** 2).sum())


def _mirrored(half: ComplexArray) -> ComplexArray:
    """Return (phis, thetas) with phi replaced by -phi."""
    # keep phi = 0 in the first row
    return np.roll(half[::-1], 1, axis=0)


def _points_along_phi(e_theta: ComplexArray, e_phi: ComplexArray) -> bool:
    """Check whether E_phi points along increasing phi, in which case the field near the poles is one vector."""
    scores = []
    # with the right sign, all samples of a row at a pole describe the same vector
    for sign in (1.0, -1.0):
        score = 0.0
        for row, slope in ((0, 1.0), (1, 1.0), (-2, -1.0), (-1, -1.0)):
            power = float((np.abs(e_theta[row]) ** 2 + np.abs(e_phi[row]) ** 2).mean())
            score += power * _pole_vectors(e_theta, sign * e_phi, row, slope)[2]
        scores.append(score)
    # without a clear difference, use the direction of AERPAW's files
    return scores[0] > 1.05 * scores[1] + 1e-6


def check_power(pattern: MeasuredPattern, *, most_db: float = 0.5, cause: str = NOT_GAIN) -> None:
    """Refuse a pattern if it radiates more power than it accepts or almost none, or if its gains are linear.

    Parameters
    ----------
    pattern : MeasuredPattern
    most_db : float
        Largest accepted mean gain over the sphere. A lossless antenna has 0 dB; the difference allows for measurement
        errors.
    cause : str
        Likely cause of a mean gain out of range, if the values are not linear.
    """
    # in dBi some directions must be below 0, because the mean gain is at most 1; linear gains are never negative
    linear = pattern.least_gain_dbi >= 0.0 and pattern.peak_gain_dbi - pattern.least_gain_dbi > most_db
    if linear or not _MINIMUM_EFFICIENCY <= pattern.efficiency <= power_from_db(most_db):
        raise InputError(
            f"the mean gain over the sphere is {float(db_from_power(pattern.efficiency)):.1f} dB "
            f"(peak {pattern.peak_gain_dbi:.1f} dBi)",
            expected=f"a mean of {float(db_from_power(_MINIMUM_EFFICIENCY)):g} to 0 dB",
            cause="linear values in place of dBi" if linear else cause,
        )


# ---------------------------------------------------------------- gain grids


@parsed("a file of gain grids (rad_pat.mat)")
def read_gain_grid(path: str | Path, variable: str) -> MeasuredPattern:
    """Read a gain grid of ``rad_pat.mat``: dBi over elevation x azimuth, without polarisation.

    Parameters
    ----------
    path : str or Path
        MATLAB file with ``theta2`` (elevation, 90 to -90 deg), ``phi2`` (azimuth, a full circle, deg) and grids.
    variable : str
        Name of the grid.

    Returns
    -------
    MeasuredPattern
        Pattern with a real E_theta and no E_phi.

    Raises
    ------
    InputError
        If the file is of another kind, angles are missing, angles are not all in degrees or all in radians, or more
        power is radiated than accepted.
    UsageError
        If there is no such grid.
    """
    path = Path(path)
    content = read_arrays(read_input(path, LARGEST_TABLE, "a file of gain grids"), None)
    if not {"theta2", "phi2"} <= set(content):
        raise InputError("no variables 'theta2' and 'phi2'", expected="a file of gain grids (rad_pat.mat)")
    elevation, azimuth = np.ravel(content["theta2"]).astype(float), np.ravel(content["phi2"]).astype(float)
    gain = _grid_of(content, variable, (len(elevation), len(azimuth)))
    _check_angles(elevation, azimuth)
    if not np.isfinite(gain).all():
        row, column = np.argwhere(~np.isfinite(gain))[0]
        raise InputError(
            f"'{variable}': {counted(int((~np.isfinite(gain)).sum()), 'value')} without a number, first at elevation "
            f"{elevation[row]:g} deg, azimuth {azimuth[column]:g} deg",
            expected="dBi in every direction",
        )
    if gain.max() > HIGHEST_DBI:
        raise InputError(f"'{variable}' reaches {gain.max():g}", expected=f"dBi, at most {HIGHEST_DBI:g}")
    # the second modulo is needed because 359.9999999 rounds to 360, which is 0
    by_azimuth = np.argsort(np.round(azimuth % 360.0, 6) % 360.0)
    gain = gain[np.argsort(-elevation)][:, by_azimuth]
    pattern = MeasuredPattern(variable, np.sqrt(power_from_db(gain)).astype(np.complex128), None)
    check_power(pattern)
    return pattern


def _grid_of(content: Mapping[str, Any], variable: str, shape: tuple[int, int]) -> FloatArray:
    """Return the named grid if it has a row per elevation and a column per azimuth."""
    sizes = {key: value.shape for key, value in content.items() if isinstance(value, np.ndarray)}
    grids = sorted(key for key, size in sizes.items() if size == shape)
    if variable in grids:
        return np.asarray(content[variable], dtype=float)
    rows = f"{shape[0]} elevations x {shape[1]} azimuths"
    if variable not in sizes:
        raise UsageError(f"no gain grid '{variable}'", expected=f"one of {', '.join(grids) or 'none'} ({rows})")
    size = sizes[variable]
    raise UsageError(
        f"'{variable}' has {' x '.join(map(str, size))} values",
        expected=rows,
        cause="rows and columns are swapped" if size == shape[::-1] else "rows or columns are missing",
    )


def _check_angles(elevation: FloatArray, azimuth: FloatArray) -> None:
    wanted_elevation = np.linspace(-90, 90, len(elevation))
    wanted_azimuth = np.arange(len(azimuth)) * (360.0 / len(azimuth))
    for what, axis, grid in (
        ("elevation (theta2)", np.sort(elevation), wanted_elevation),
        ("azimuth (phi2)", np.sort(np.round(azimuth % 360.0, 6) % 360.0), wanted_azimuth),
    ):
        if len(axis) >= 3 and np.abs(axis - grid).max() <= 0.05:  # this test is also false for NaN
            continue
        causes = (
            (len(axis) >= 3 and 0 < np.abs(axis).max() < 7, "radians instead of degrees"),
            (len(set(axis.tolist())) < len(axis), "a direction occurs twice, such as 0 and 360 deg"),
            (len(axis) >= 3 and np.abs(axis - 90 - grid).max() <= 0.05, "zenith angles in place of elevation"),
            (True, "angles are missing"),
        )
        ends = f"{axis.min(initial=np.inf):g} to {axis.max(initial=-np.inf):g}"
        raise InputError(
            f"{what} runs from {ends} in {counted(len(axis), 'value')}",
            expected=f"{grid[0]:g} to {grid[-1]:g} deg, equally spaced" if len(axis) >= 3 else "a whole sphere",
            cause=next(cause for holds, cause in causes if holds),
        )

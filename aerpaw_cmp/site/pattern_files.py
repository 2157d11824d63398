"""Antenna files, recognised by content: measured spheres, a single great circle, cuts of planning tools.

The formats for writing are the custom pattern of Sionna RT, cuts of MSI Planet, and a table over the sphere.

Two cuts do not contain the directions between them. A sphere is therefore computed from a horizontal and a vertical cut
by horizontal projection interpolation (F. Gil et al., IEEE Trans. Antennas Propag. 47, 1999, doi:10.1109/8.774131),
which retains both cuts.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..common.content import marks, trained_on
from ..common.errors import InputError, UsageError, parsed
from ..common.files import LARGEST_TABLE, read_input
from ..common.text import counted
from ..common.units import FloatArray, power_from_db
from .antennas import HIGHEST_DBI, NOT_GAIN, MeasuredPattern, check_power, read_pattern_text
from .learned import BAND, SPHERE_COLUMNS, planning_cuts, read_sphere_csv, sphere_grid

# Gain of a half-wave dipole over an isotropic antenna.
_DBI_OF_DBD = 2.15
STEP_DEG = 3.0

# Largest accepted excess of a cut above the stated peak, and of a stated peak above both cuts [dB].
_RIPPLE_DB = 1.0

# Largest mean gain over the sphere of a pattern from two cuts [dB]: 0.5 dB for the measurement, 0.5 dB for the
# interpolation, which changed the mean of ten sector antennas and arrays by -0.3 to +0.2 dB.
_MOST_OF_CUTS_DB = 1.0
# Largest mean gain over the sphere of a pattern from cuts of a learned antenna, whose absolute gain is not known [dB].
# For two cuts through the only lobe of such an antenna, the interpolation increased the mean gain by 3.7 dB.
_MOST_OF_LEARNED_CUTS_DB = 5.0
_PLANET = re.compile(r"(?im)^\s*(HORIZONTAL|VERTICAL)\s+(\d{1,4})\s*$")
_GAIN = re.compile(r"(?im)^\s*GAIN\s+([-+]?\d{1,3}(?:\.\d{1,6})?)\s*(dBd|dBi)?\s*$")
_FREQUENCY = re.compile(r"(?im)^\s*FREQUENCY\s+(\d{1,6}(?:\.\d{1,6})?)\s*(?:MHz)?\s*$")
_PHI_CUT = re.compile(r"(?im)^\s*Phi\s*=\s*(-?\d{1,3}(?:\.\d{1,6})?)\s*\(deg\)")
_GAIN_TABLE = re.compile(r"(?im)^\s*Frequency\s+E ?Total\. ?dB\s*$")


@parsed("an antenna pattern file")
def read_pattern_file(path: str | Path, *, carrier_hz: float | None = None) -> MeasuredPattern:
    """Read an antenna pattern: text of AERPAW over the sphere or along one great circle, or MSI Planet (.msi, .pln).

    Parameters
    ----------
    path : str or Path
    carrier_hz : float, optional
        Frequency, for a file with several frequencies.

    Returns
    -------
    MeasuredPattern

    Raises
    ------
    InputError
        If the file is of another kind, or angles or units are missing. The message contains the line if possible.
    """
    path = Path(path)
    text = read_input(path, LARGEST_TABLE, "an antenna pattern file").decode("utf-8-sig", errors="replace")
    if any(line.replace(" ", "").startswith(",".join(SPHERE_COLUMNS[:3])) for line in text.splitlines()[:100]):
        return read_sphere_csv(path)
    if _PLANET.search(text):
        pattern = _planet(text, path.stem)
    elif _PHI_CUT.search(text):
        pattern = _great_circle(text, path.stem, carrier_hz)
    elif _GAIN_TABLE.search(text):
        raise InputError(
            "peak gain over frequency, without directions",
            expected="a pattern of the same antenna, such as SA-1400-5900_F3300.txt",
        )
    else:
        pattern = read_pattern_text(path)
    pattern.trained_on, pattern.marks = trained_on(text), marks(text)
    return pattern


def _planet(text: str, name: str) -> MeasuredPattern:
    """Return the pattern of an MSI Planet file.

    Angles of the horizontal cut are clockwise from the front. Angles of the vertical cut are downwards from the front.

    Raises
    ------
    InputError
        If there is no gain, a cut is not a full circle, or the cuts do not have the stated gain.
    """
    gain = _GAIN.search(text)
    if gain is None:
        raise InputError("no line 'GAIN value dBi'", expected="GAIN in dBi or dBd")
    # MSI Planet uses dBd if no unit is stated
    peak_dbi = float(gain[1]) + (0.0 if (gain[2] or "dBd").lower() == "dbi" else _DBI_OF_DBD)
    cuts: dict[str, FloatArray] = {}
    for cut in _PLANET.finditer(text):
        # the header states the number of lines; later lines belong to the next cut
        rows = _pairs(text[cut.end() :].split("\n"), int(cut[2]))
        cuts[cut[1].upper()] = _each_degree(rows, cut[1])
    carrier, learned = _FREQUENCY.search(text), bool(trained_on(text))
    cause = "the gain is too high for beams as wide as these cuts"
    if gain[2] is None:
        cause = f"'GAIN {gain[1]}' has no unit and is read as dBd; if it is a gain over isotropic: 'GAIN {gain[1]} dBi'"
    return _from_cuts(
        _about_peak(cuts, peak_dbi),
        name,
        float(carrier[1]) * 1e6 if carrier else None,
        stated_dbi=None if learned else peak_dbi,
        most_db=_MOST_OF_LEARNED_CUTS_DB if learned else _MOST_OF_CUTS_DB,
        cause=cause,
    )


def _about_peak(cuts: dict[str, FloatArray], peak_dbi: float) -> dict[str, FloatArray]:
    """Return the gain of cuts that contain attenuations below the peak, all positive or all negative [dBi]."""
    values = np.concatenate(list(cuts.values()))
    # attenuations all have the same sign; values with both signs are gains relative to a level
    if min(-values.min(), values.max()) > _RIPPLE_DB:
        raise InputError(
            f"values from {values.min():g} to {values.max():g} dB below the peak",
            expected="attenuations of one sign",
            cause="gains instead of attenuations",
        )
    if (least := np.abs(values).min()) > _RIPPLE_DB:
        raise InputError(
            f"no direction of the cuts is less than {least:.1f} dB below the gain of {peak_dbi:g} dBi",
            expected="cuts through the peak",
            cause="another gain, or gains instead of attenuations",
        )
    return {name: peak_dbi - np.abs(cut) for name, cut in cuts.items()}


def _pairs(lines: list[str], count: int) -> FloatArray:
    """Return angle and value of the first lines with numbers."""
    rows = []
    for line in [line for line in lines if line.strip()][:count]:
        cells = line.split()
        try:
            rows.append((float(cells[0]), float(cells[1])))
        except (ValueError, IndexError):
            raise InputError(f"'{line.strip()[:60]}'", expected="an angle and a value") from None
    if len(rows) < count or count < 4:
        raise InputError(f"a cut of {counted(len(rows), 'line')}", expected=f"{max(count, 4)}", cause="a cut file")
    return np.array(rows, dtype=np.float64)


def _each_degree(rows: FloatArray, cut: str) -> FloatArray:
    """Return values at 0 to 359 degrees of a cut over a full circle.

    Half of a vertical circle is used for both halves.
    """
    angle, value = rows[:, 0] % 360.0, rows[:, 1]
    if not np.isfinite(rows).all() or np.abs(value).max() > 10 * HIGHEST_DBI:
        raise InputError(f"cut {cut} reaches {np.abs(value).max():g} dB", expected="attenuation in dB")
    if np.ptp(rows[:, 0]) <= 180.0 and np.abs(rows[:, 0]).max() <= 90.0:  # use a front half for the back, too
        angle, value = np.concatenate((angle, (180.0 - rows[:, 0]) % 360.0)), np.concatenate((value, value))
    order = np.argsort(angle, kind="stable")
    # include the gap between the last and the first angle
    if np.diff(np.append(angle[order], angle[order][0] + 360.0)).max() > 15.0:
        raise InputError(f"cut {cut} has gaps above 15 deg", expected="a full circle")
    return np.asarray(np.interp(np.arange(360.0), angle[order], value[order], period=360.0))


def _from_cuts(
    cuts: dict[str, FloatArray],
    name: str,
    frequency_hz: float | None,
    *,
    stated_dbi: float | None = None,
    most_db: float = _MOST_OF_CUTS_DB,
    cause: str = NOT_GAIN,
) -> MeasuredPattern:
    """Return the sphere of two cuts [dBi at each degree]. The module describes the method."""
    for cut in ("HORIZONTAL", "VERTICAL"):
        if cut not in cuts:
            raise InputError(f"no cut {cut}", expected="a horizontal and a vertical cut")
    horizontal, vertical = cuts["HORIZONTAL"], cuts["VERTICAL"]
    theta, around, _ = sphere_grid(STEP_DEG)
    below = theta - 90.0
    # the weight of the back of the vertical cut increases with the azimuth from the front
    share = np.minimum(around, 360.0 - around) / 180.0  # 0 in front, 1 behind
    # angles of planning tools are clockwise, but azimuth is counter-clockwise
    level = _at(horizontal, -around)[None, :] + (1.0 - share)[None, :] * (_at(vertical, below) - horizontal[0])[:, None]
    # if front and back of the vertical cut are equal, only its front was measured, so the back is relative to the front
    same = np.allclose(vertical, vertical[(180 - np.arange(360)) % 360], atol=1e-6)
    behind = horizontal[0 if same else 180]
    level = level + share[None, :] * (_at(vertical, 180.0 - below) - behind)[:, None]
    if stated_dbi is not None and (above_db := level.max() - stated_dbi) > _RIPPLE_DB:
        down = " and ".join(f"{stated_dbi - cut[0]:.1f} dB ({cut_name})" for cut_name, cut in cuts.items())
        raise InputError(
            f"the cuts have a peak of {level.max():.1f} dBi, {above_db:.1f} dB above the stated gain; at 0 deg they "
            f"are {down} below it",
            expected="two cuts with the same value at 0 deg",
            cause="a beam turned to the side, and each cut relative to its own peak",
        )
    return _pattern(level, name, frequency_hz, most_db, cause)


def _at(cut: FloatArray, degrees: FloatArray) -> FloatArray:
    return np.asarray(np.interp(degrees, np.arange(360.0), cut, period=360.0))


def _pattern(
    level_dbi: FloatArray, name: str, frequency_hz: float | None, most_db: float, cause: str = NOT_GAIN
) -> MeasuredPattern:
    if level_dbi.max() > HIGHEST_DBI:
        raise InputError(f"a gain of {level_dbi.max():g}", expected=f"dBi, at most {HIGHEST_DBI:g}")
    pattern = MeasuredPattern(name, np.sqrt(power_from_db(level_dbi)).astype(np.complex128), None, frequency_hz)
    check_power(pattern, most_db=most_db, cause=cause)
    return pattern


def _great_circle(text: str, name: str, carrier_hz: float | None) -> MeasuredPattern:
    """Return the pattern of an AERPAW file of total gain along one great circle. Other directions are interpolated."""
    rows = [line.split() for line in text.splitlines() if re.match(r"\s*\d{6,}(?:\.\d+)?\s", line)]
    table = np.array([[float(cell) for cell in row[:3]] for row in rows if len(row) >= 3])
    if not len(table):
        raise InputError("no rows", expected="frequency [Hz], theta [rad], total gain [dBi], ...")
    frequencies = np.unique(table[:, 0])
    frequency = float(frequencies[0])
    if len(frequencies) > 1:
        if carrier_hz is None:
            raise InputError(f"{len(frequencies)} frequencies", expected="the carrier frequency, to choose one of them")
        frequency = float(frequencies[np.argmin(np.abs(frequencies - carrier_hz))])
    cut = table[table[:, 0] == frequency]
    # drop repeated angles, such as -pi and pi, because interpolation needs ascending angles
    _, once = np.unique(np.round(cut[:, 1], 6), return_index=True)
    angle, gain = cut[once, 1], cut[once, 2]
    if len(angle) < 8 or angle[0] > -3.1 or angle[-1] < 3.1 or np.diff(angle).max() > 0.3:
        raise InputError(f"{len(angle)} angles at {frequency / 1e6:g} MHz", expected="theta from -pi to pi")
    theta, phi, _ = sphere_grid(STEP_DEG)
    share = np.minimum(phi, 360.0 - phi) / 180.0
    # blend the two halves of the circle around the axis, because there are no values between them
    front, back = (np.interp(side * np.radians(theta), angle, gain) for side in (1.0, -1.0))
    level = (1.0 - share) * front[:, None] + share * back[:, None]
    # from one circle, more of the sphere is interpolated than from two cuts
    return _pattern(level, name, frequency, _MOST_OF_LEARNED_CUTS_DB)


# Sign that converts an angle, by the first letters of its name, to degrees clockwise from the front or below the
# horizon.
_CUT_ANGLES = {"az": -1.0, "phi": -1.0, "el": -1.0, "th": 1.0, "zen": 1.0}


@parsed("a cut of an antenna pattern")
def read_cut_files(azimuth: Path, elevation: Path) -> MeasuredPattern:
    """Read a pattern from two CSV files with an angle [deg] and a gain [dBi].

    Parameters
    ----------
    azimuth : Path
        Angles counter-clockwise from the front over a full circle: ``azimuth_deg,gain_dbi`` (or ``phi_deg``).
    elevation : Path
        Cut through the front: ``elevation_deg`` up from the horizon or ``theta_deg`` down from the zenith. A half
        circle is used for both halves.

    Returns
    -------
    MeasuredPattern

    Raises
    ------
    InputError
        If columns are wrong, a cut has gaps, or the cuts differ in front.
    """
    cuts = {"HORIZONTAL": _cut_file(azimuth, ("az", "phi")), "VERTICAL": _cut_file(elevation, ("el", "th", "zen"))}
    apart = abs(float(cuts["HORIZONTAL"][0] - cuts["VERTICAL"][0]))
    if apart > _RIPPLE_DB:
        raise InputError(
            f"in front the cuts of {azimuth.name} and {elevation.name} differ by {apart:.1f} dB",
            expected="two cuts of one antenna through its front, gains in dBi",
            cause="one of them is relative to its own peak, or the files are swapped",
            path=elevation,
        )
    return _from_cuts(cuts, azimuth.stem, None)


@parsed("a cut of an antenna pattern")
def _cut_file(path: Path, angles: tuple[str, ...]) -> FloatArray:
    """Return the gain at each degree of a CSV file with a header, as :func:`_planet` does [dBi]."""
    text = read_input(path, LARGEST_TABLE, "a cut of an antenna pattern").decode("utf-8-sig", errors="replace")
    header, *lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")] or [""]
    names = [name.strip().lower() for name in header.split(",")]
    begin = next((word for word in angles if names[0].startswith(word)), None)
    if len(names) < 2 or begin is None or "gain" not in names[1] or "rad" in names[0]:
        raise InputError(
            f"the columns are {', '.join(names)}",
            expected=f"an angle ({' or '.join(angles)}..., degrees) and a gain [dBi], named in the first line",
        )
    rows = _pairs([line.replace(",", " ") for line in lines], len(lines))
    rows[:, 0] = _CUT_ANGLES[begin] * rows[:, 0] - (90.0 if begin in ("th", "zen") else 0.0)
    return _each_degree(rows, path.name)


def exported(pattern: MeasuredPattern, name: str, target: Path, carrier_hz: float | None = None) -> str:
    """Return the text of a pattern in the format of a file ending: ``.py`` (Sionna RT) or ``.msi``.

    Comments contain the logs from which the pattern was learned.

    Parameters
    ----------
    pattern : MeasuredPattern
    name : str
    target : Path
    carrier_hz : float, optional
        Frequency for ``.msi``, if the pattern has none.

    Returns
    -------
    str

    Raises
    ------
    UsageError
        If the ending is not supported, or ``.msi`` has no frequency.
    """
    notes = getattr(pattern, "notes", "") or f"trained_on: {' '.join(pattern.trained_on)}" * bool(pattern.trained_on)
    lines = tuple(line.lstrip("# ") for line in notes.splitlines())
    if target.suffix == ".msi":
        frequency = pattern.frequency_hz or carrier_hz
        if not frequency or abs((carrier_hz or frequency) / frequency - 1.0) > BAND:
            found = f"the pattern has {f'{frequency / 1e9:g} GHz' if frequency else 'no frequency'}"
            raise UsageError(found, expected="--carrier HZ, within 2 % of the pattern's own", path=target)
        return planning_cuts(pattern, name, frequency, lines)
    if target.suffix == ".py":
        return _sionna_module(pattern, name, target, lines)
    raise UsageError(f"the ending {target.suffix!r}", expected=".py (Sionna RT) or .msi", path=target)


def _sionna_module(pattern: MeasuredPattern, name: str, target: Path, notes: tuple[str, ...]) -> str:
    import base64

    theta, phi, _ = sphere_grid(STEP_DEG)
    # repeat the values at 360 deg, because the written module interpolates only within its table
    at = np.meshgrid(np.radians(theta), np.radians(np.append(phi, 360.0)), indexing="ij")
    table = np.stack([part for field in pattern.field(*at) for part in (field.real, field.imag)], axis=-1)
    template = Path(__file__).with_name("sionna_pattern.txt").read_text(encoding="utf-8")
    return template.format(
        name=re.sub(r"\W", "_", name),
        module=re.sub(r"\W", "_", target.stem),
        # a quote or a backslash of a file name would end the docstring
        notes="\n".join(re.sub(r'["\\]', "'", note) for note in notes),
        table=base64.b64encode(table.astype("<f4").tobytes()).decode("ascii"),
        shape=table.shape,
    )

"""Antenna files over the full sphere: round trip, cuts, refusals."""

import numpy as np
import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.site.antennas import HalfWaveDipole
from aerpaw_cmp.site.learned import (
    SpherePattern,
    planning_cuts,
    read_sphere_csv,
    sphere_csv,
    sphere_grid,
    unit_mean_gain,
)
from aerpaw_cmp.site.pattern_files import read_pattern_file


def smooth():
    _, _, v = sphere_grid()
    return unit_mean_gain(3.0 * v[..., 0] + 2.0 * v[..., 1] * v[..., 2]), 1.0 + v[..., 2] ** 2


def test_file_gives_back_gain_and_standard_deviation(tmp_path):
    gain, sd = smooth()
    file = tmp_path / "a.csv"
    file.write_text(sphere_csv(gain, sd, ("a note",)))
    pattern = read_sphere_csv(file)
    rng = np.random.default_rng(0)
    d = rng.normal(size=(200, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    shift = gain[18, 0] - 3.0  # at the horizon in front
    assert np.allclose(pattern.gain_dbi(theta, phi), 3 * d[:, 0] + 2 * d[:, 1] * d[:, 2] + shift, atol=0.02)
    assert np.allclose(pattern.gain_sd_db(theta, phi), 1 + d[:, 2] ** 2, atol=0.02)


def test_level_is_that_of_an_isotropic_antenna():
    gain, sd = smooth()
    assert SpherePattern("a", gain + 0.0, sd).efficiency == pytest.approx(1.0, abs=0.01)
    assert np.allclose(unit_mean_gain(gain + 17.0), gain)


def test_cuts_of_a_pattern_that_is_known():
    """In the vertical cut, index 0 is in front, 90 straight down, 180 behind and 270 straight up.

    The horizontal cut is clockwise.
    """
    gain, sd = smooth()
    text = planning_cuts(SpherePattern("a", gain, sd), "a", 3.3e9).splitlines()
    start = text.index("VERTICAL 360")
    horizontal = [float(line.split()[1]) for line in text[4:start]]
    vertical = [float(line.split()[1]) for line in text[start + 1 :]]
    assert len(horizontal) == len(vertical) == 360
    assert horizontal[0] == pytest.approx(0.0, abs=0.02)
    assert horizontal[180] == pytest.approx(6.0, abs=0.02)
    assert vertical[90] == pytest.approx(3.0, abs=0.02)
    assert vertical[270] == pytest.approx(3.0, abs=0.02)
    # east of the boresight is to the right, i.e. clockwise
    _, _, v = sphere_grid()
    right = SpherePattern("r", unit_mean_gain(-3.0 * v[..., 1]), sd)
    lines = planning_cuts(right, "r", 3.3e9).splitlines()
    assert float(lines[4 + 90].split()[1]) < float(lines[4 + 270].split()[1])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t.replace("gain_dbi", "gain"), "columns"),
        (lambda t: "\n".join(t.splitlines()[:-1]), "directions of"),
        (lambda t: t.replace("\n0,90,", "\n0,90,x", 1), "'0,90,x"),
        (lambda t: t[:0], "none"),
    ],
)
def test_broken_files_are_told(tmp_path, spoil, message):
    file = tmp_path / "a.csv"
    file.write_text(spoil(sphere_csv(*smooth())))
    with pytest.raises(InputError, match=message):
        read_sphere_csv(file)


def test_spreadsheets_may_quote_and_space_the_cells(tmp_path):
    """Quoted cells are read line by line, because the fast reader of complete tables fails.

    Both readers return the same numbers.
    """
    plain, quoted = tmp_path / "a.csv", tmp_path / "b.csv"
    text = sphere_csv(*smooth())
    plain.write_text(text)
    head, *rows = text.splitlines()
    quoted.write_text("\n".join([head, *(",".join(f'" {cell}"' for cell in row.split(",")) for row in rows)]))
    first, second = (read_sphere_csv(file) for file in (plain, quoted))
    theta, phi = np.meshgrid(np.linspace(0.1, 3.0, 20), np.linspace(-3.0, 3.0, 31))
    np.testing.assert_array_equal(first.gain_dbi(theta, phi), second.gain_dbi(theta, phi))


def test_other_patterns_have_no_standard_deviation():
    assert not hasattr(HalfWaveDipole(), "gain_sd_db")


def lobed():
    _, _, v = sphere_grid()
    return SpherePattern("a", unit_mean_gain(6.0 * v[..., 0] - 2.0 * v[..., 1] + 3.0 * v[..., 2]), 0.0 * v[..., 0])


@pytest.mark.parametrize("form", ["msi", "msi in dBd"])
def test_cuts_of_planning_tools_read_back(tmp_path, form):
    """Both principal cuts are reproduced. The gain between them is unknown."""
    pattern, file = lobed(), tmp_path / "a.msi"
    text = planning_cuts(pattern, "a", 3.3e9)
    if form == "msi in dBd":
        gain = float(text.split("GAIN ")[1].split()[0])
        text = text.replace(f"GAIN {gain:.2f} dBi", f"GAIN {gain - 2.15:.2f}").replace("\n", "\r\n")
    file.write_text(text)
    again = read_pattern_file(file)
    around = np.radians(np.arange(0.0, 360.0, 5.0))
    level = np.full(len(around), np.pi / 2)
    assert np.allclose(again.gain_dbi(level, around), pattern.gain_dbi(level, around), atol=0.06)
    down = np.radians(np.arange(10.0, 171.0, 5.0))
    for half in (0.0, np.pi):
        side = np.full(len(down), half)
        assert np.allclose(again.gain_dbi(down, side), pattern.gain_dbi(down, side), atol=0.06)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t.replace("GAIN", "GAUN"), "no line 'GAIN"),
        (lambda t: t[: t.index("VERTICAL")], "no cut VERTICAL"),
        (lambda t: "\n".join(t.splitlines()[:-100]), "a cut of 260 lines"),
        (lambda t: t.replace("\n12 ", "\nx "), "an angle and a value"),
        (lambda _: "1\r\nFrequency\tE Total. dB\r\n3300000000\t-1.2\r\n", "without directions"),
    ],
)
def test_broken_cuts_are_told(tmp_path, spoil, message):
    file = tmp_path / "a.msi"
    file.write_text(spoil(planning_cuts(lobed(), "a", 3.3e9)))
    with pytest.raises(InputError, match=message):
        read_pattern_file(file)


def msi(gain_dbi, horizontal, vertical):
    lines = ["NAME a", "FREQUENCY 3300", f"GAIN {gain_dbi:.2f} dBi"]
    for name, cut in (("HORIZONTAL", horizontal), ("VERTICAL", vertical)):
        lines += [f"{name} 360", *(f"{angle} {value:.2f}" for angle, value in enumerate(cut))]
    return "\n".join(lines) + "\n"


def sector(width_deg, floor_db=30.0):
    """Attenuation of a sector antenna's cut at each degree [dB]."""
    off = np.minimum(np.arange(360.0), 360.0 - np.arange(360.0))
    return np.minimum(12.0 * (off / width_deg) ** 2, floor_db)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_attenuations_with_minus_signs_are_attenuations(tmp_path, sign):
    file = tmp_path / "a.msi"
    file.write_text(msi(14.0, sign * sector(65), sign * sector(15)))
    pattern = read_pattern_file(file)
    level = np.full(2, np.pi / 2)
    assert np.allclose(pattern.gain_dbi(level, np.array([0.0, np.pi])), [14.0, -16.0], atol=0.1)
    assert pattern.efficiency < 1.0


@pytest.mark.parametrize(
    ("gain_dbi", "cut", "message"),
    [
        (22.0, sector, "mean gain over the sphere is 6.6 dB"),  # a wrong peak
        (15.0, lambda w: 10 ** (-sector(w) / 10), "mean gain over the sphere"),  # linear power
        (15.0, lambda w: 10 ** (-sector(w) / 20), "mean gain over the sphere"),  # linear field
        (15.0, lambda w: 15.0 - sector(w), "attenuations of one sign"),  # gains
        (15.0, lambda w: sector(w) + 6.0, "less than 6.0 dB below the gain of 15 dBi"),
    ],
)
def test_a_pattern_that_no_antenna_can_have_is_refused(tmp_path, gain_dbi, cut, message):
    file = tmp_path / "a.msi"
    file.write_text(msi(gain_dbi, cut(65), cut(15)))
    with pytest.raises(InputError, match=message):
        read_pattern_file(file)


def test_a_gain_without_unit_that_cannot_be_dbd_is_refused_with_the_line_that_fixes_it(tmp_path):
    """MSI Planet's default unit is dBd.

    With beams of 65 and 15 degrees, 17.15 dBi would radiate more power than it receives.
    """
    file, text = tmp_path / "a.msi", msi(15.0, sector(65, 25.0), sector(15, 25.0))
    file.write_text(text.replace("15.00 dBi", "15.0"))
    with pytest.raises(InputError, match=r"mean gain over the sphere is 1\.9 dB.*'GAIN 15\.0 dBi'"):
        read_pattern_file(file)
    file.write_text(text)
    assert read_pattern_file(file).peak_gain_dbi == pytest.approx(15.0, abs=0.1)


@pytest.mark.parametrize("gain_dbi", [15.0, 12.0])
def test_cuts_that_do_not_meet_in_front_are_refused(tmp_path, gain_dbi):
    """A beam 30 deg to the side, each cut relative to its own peak: their sum lies above the stated gain."""
    file = tmp_path / "a.msi"
    file.write_text(msi(gain_dbi, np.roll(sector(65, 25.0), 30), sector(15, 25.0)))
    with pytest.raises(InputError, match=r"2\.1 dB above the stated gain; .*2\.6 dB \(HORIZONTAL\)"):
        read_pattern_file(file)


@pytest.mark.parametrize("values", ["power", "normalised", "dBd", "peak 10 dB too high"])
def test_a_table_of_impossible_gains_is_refused(tmp_path, values):
    _, _, v = sphere_grid()
    gain_dbi = unit_mean_gain(6.0 * v[..., 0] + 3.0 * v[..., 2])
    power = 10 ** (gain_dbi / 10)
    table = {
        "power": power,
        "normalised": power / power.max(),
        "dBd": gain_dbi + 2.15,
        "peak 10 dB too high": gain_dbi + 10.0,
    }[values]
    file = tmp_path / "a.csv"
    file.write_text(sphere_csv(table, 0.0 * table))
    with pytest.raises(InputError, match="mean gain over the sphere"):
        read_sphere_csv(file)


def test_a_great_circle_at_several_frequencies(tmp_path):
    """The carrier selects the frequency. Both halves of the circle are reproduced and blended around."""
    theta = np.linspace(-np.pi, np.pi, 121)
    rows = [
        f"{f}\t{t:.10f}\t{g}\t0\t0\t0\t0" for f, shift in ((902000000, 0), (3300000000, 2))
        for t, g in zip(theta, 3 * np.cos(theta) + shift + 2 * (theta > 0) - 4, strict=True)
    ]  # fmt: skip
    head = "2\r\nPhi=0(deg)\r\n\r\nFrequency\tTheta\tE Total. dB\tE(Phi) . Amp dB\tE(Theta) . Amp dB\tp\tq"
    file = tmp_path / "phi_0.txt"
    file.write_text("\n".join([head, *rows]) + "\n")
    pattern = read_pattern_file(file, carrier_hz=3.4e9)
    assert pattern.frequency_hz == 3.3e9
    down = np.radians([30.0, 60.0, 120.0])
    assert np.allclose(pattern.gain_dbi(down, np.zeros(3)), 3 * np.cos(down), atol=0.05)
    assert np.allclose(pattern.gain_dbi(down, np.full(3, np.pi)), 3 * np.cos(down) - 2, atol=0.05)
    with pytest.raises(InputError, match="2 frequencies"):
        read_pattern_file(file)
    # 12 of 121 rows of each frequency: a gap of 39 degrees, over which a gain would be invented
    file.write_text("\n".join([head, *rows[:40], *rows[52:161], *rows[173:]]) + "\n")
    with pytest.raises(InputError, match=r"109 angles at 3300 MHz"):
        read_pattern_file(file, carrier_hz=3.3e9)

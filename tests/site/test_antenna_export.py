"""Patterns of two cuts, and patterns for other programs: a round trip returns the same gains."""

import importlib.util

import numpy as np
import pytest
import scipy.io

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.site.antennas import TR38901
from aerpaw_cmp.site.pattern_files import read_cut_files, read_pattern_file

FULL = np.arange(-180.0, 180.0, 2.0)
HALF = np.arange(-90.0, 91.0, 2.0)


def gain_dbi(theta_deg, phi_deg):
    e_theta, _ = TR38901().field(np.radians(theta_deg), np.radians(phi_deg))
    return 20.0 * np.log10(np.abs(e_theta))


def cut(path, head, angles, values):
    path.write_text(f"{head}\n" + "\n".join(f"{a:g},{v:.3f}" for a, v in zip(angles, values, strict=True)) + "\n")
    return path


@pytest.fixture
def cuts(tmp_path):
    """A skewed antenna: gain falls to the left, counter-clockwise, and upwards only."""
    azimuth = cut(tmp_path / "az.csv", "azimuth_deg,gain_dbi", FULL, 3.0 - 8.0 * np.clip(FULL, 0.0, 90.0) / 90.0)
    elevation = cut(tmp_path / "el.csv", "elevation_deg,gain_dbi", FULL, 3.0 - 12.0 * np.clip(FULL, 0, 60.0) / 60.0)
    return azimuth, elevation


def test_both_cuts_come_back_with_their_signs(cuts):
    pattern = read_cut_files(*cuts)
    level = pattern.gain_dbi(np.radians([90.0, 90.0, 90.0, 60.0, 120.0]), np.radians([0.0, 45.0, -45.0, 0.0, 0.0]))
    assert level == pytest.approx([3.0, -1.0, 3.0, -3.0, 3.0], abs=0.1)


def test_angles_from_the_zenith_are_the_same_antenna(tmp_path):
    azimuth = cut(tmp_path / "az.csv", "phi_deg, gain_dbi", FULL % 360.0, gain_dbi(90.0, FULL))
    up = cut(tmp_path / "el.csv", "elevation_deg,gain_dbi", HALF, gain_dbi(90.0 - HALF, 0.0))
    down = cut(tmp_path / "th.csv", "theta_deg,gain_dbi", 90.0 - HALF[::-1], gain_dbi(90.0 - HALF[::-1], 0.0))
    theta, phi = np.radians(np.linspace(20, 160, 29))[:, None], np.radians(np.linspace(-60, 60, 13))[None, :]
    first, second = (read_cut_files(azimuth, elevation).gain_dbi(theta, phi) for elevation in (up, down))
    assert first == pytest.approx(second)
    middle = np.degrees(theta[:, 0])
    assert first[:, 6] == pytest.approx(gain_dbi(middle, 0.0), abs=0.3)
    # half a vertical circle does not know the back, which the horizontal cut has 30 dB down
    assert read_cut_files(azimuth, up).gain_dbi(np.pi / 2, np.pi) == pytest.approx(-22.0, abs=0.1)


def test_what_is_no_pair_of_cuts_is_refused(cuts, tmp_path):
    azimuth, elevation = cuts
    with pytest.raises(InputError, match="the columns are azimuth_deg, gain_dbi"):
        read_cut_files(azimuth, azimuth)
    low = cut(tmp_path / "low.csv", "elevation_deg,gain_dbi", FULL, 0.0 * FULL)
    with pytest.raises(InputError, match=r"differ by 3\.0 dB"):
        read_cut_files(azimuth, low)
    gappy = cut(tmp_path / "gappy.csv", "azimuth_deg,gain_dbi", FULL[::10], 0.0 * FULL[::10])
    with pytest.raises(InputError, match="gaps above 15 deg"):
        read_cut_files(gappy, elevation)
    (tmp_path / "words.csv").write_text("azimuth_deg,gain_dbi\nfront,loud\n1,2\n3,4\n5,6\n")
    with pytest.raises(InputError, match="front loud"):
        read_cut_files(tmp_path / "words.csv", elevation)


def export(cuts, target, *further):
    words = ["antenna", "export", str(cuts[0]), "--elevation", str(cuts[1]), "-o", str(target)]
    return main([*words, *further])


def test_msi_has_the_gain_around_the_horizon(cuts, tmp_path):
    pattern = read_cut_files(*cuts)
    assert export(cuts, tmp_path / "out.msi", "--carrier", "3.4e9") == 0
    phi = np.radians(np.arange(0.0, 360.0, 3.0))
    around = read_pattern_file(tmp_path / "out.msi").gain_dbi(np.full(120, np.pi / 2), phi)
    assert around == pytest.approx(pattern.gain_dbi(np.full(120, np.pi / 2), phi), abs=0.05)
    assert (tmp_path / "out.msi").read_text().startswith("NAME az\nFREQUENCY 3400\n")


def test_a_sphere_that_was_learned_keeps_its_logs(tmp_path):
    rows = [f"{a},{e},0,1" for a in range(0, 360, 90) for e in (90, 0, -90)]
    digest = "ab" * 32
    (tmp_path / "in.csv").write_text(
        "\n".join([f"# trained_on: {digest}", "azimuth_deg,elevation_deg,gain_dbi,gain_sd_db", *rows]) + "\n"
    )
    for name in ("out.py", "out.msi"):
        words = ["antenna", "export", str(tmp_path / "in.csv"), "-o", str(tmp_path / name), "--carrier", "3e9"]
        assert main(words) == 0
        assert digest in (tmp_path / name).read_text()


def test_what_a_pattern_is_not_is_refused(cuts, tmp_path, capsys):
    grid = tmp_path / "grids.mat"
    axes = {"theta2": np.linspace(90.0, -90.0, 61), "phi2": np.arange(180.0, -180.0, -3.0)}
    scipy.io.savemat(grid, {"SA": np.zeros((61, 120)), **axes})
    assert export(cuts, tmp_path / "out.msi", "--carrier", "3.4e9") == 0
    for words, said in (
        ([str(grid)], "expected one of SA"),
        ([str(grid), "--variable", "SA", "--elevation", str(cuts[1])], "an elevation cut with a gain grid"),
        ([str(tmp_path / "out.msi"), "--carrier", "6e9"], "the pattern has 3.4 GHz"),
    ):
        assert main(["antenna", "export", *words, "-o", str(tmp_path / "new.msi")]) == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("REVNUM:,NSMA WG16.99.050\nREVDAT:,19990520\nPATCUT:,H\n0,0\n", "NSMA"),
        ("Angle(deg),Frequency(GHz),Amplitude(dB)\n0.000,3.300,15.0\n", "'elevation'"),
        ("Theta [deg.]  Phi   [deg.]  Abs(Gain)[dBi   ]\n-----\n0.000 0.000 7.1\n", "CST"),
        ("##File Type: Far Field\n##File Format: 3\n#Frequency: 3.3E9\n", "FEKO"),
    ],
)
def test_a_file_of_another_planning_tool_names_the_formats_that_are_read(text, cause, tmp_path, capsys):
    file = tmp_path / "other.txt"
    file.write_text(text)
    assert main(["antenna", "export", str(file), "-o", str(tmp_path / "o.py")]) == 3
    said = capsys.readouterr().err
    for words in ("MSI Planet", "azimuth_deg,elevation_deg,gain_dbi", "AERPAW", cause):
        assert words in said


def test_no_file_of_others_and_no_input_is_replaced(cuts, tmp_path, capsys):
    (tmp_path / "mine.py").write_text("x = 1\n")
    assert export(cuts, tmp_path / "mine.py") == 2
    assert export(cuts, cuts[0], "--force") == 2
    for ending in ("xlsx", "csv"):  # a sphere as .csv is only read by this tool, which reads the cuts themselves
        assert export(cuts, tmp_path / f"out.{ending}") == 2
        assert "expected .py (Sionna RT) or .msi" in capsys.readouterr().err
    assert export(cuts, tmp_path / "out.msi") == 2
    assert "--carrier" in capsys.readouterr().err
    assert (tmp_path / "mine.py").read_text() == "x = 1\n"


@pytest.mark.sionna
def test_sionna_reads_the_same_gain(sionna, cuts, tmp_path):
    import mitsuba as mi
    from sionna.rt import PlanarArray

    target = tmp_path / "skewed.py"
    assert export(cuts, target) == 0
    spec = importlib.util.spec_from_file_location("skewed", target)
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    array = PlanarArray(num_rows=1, num_cols=1, pattern="az", polarization="V")
    theta, phi = (part.ravel() for part in np.meshgrid(np.radians([45, 90, 120.0]), np.radians([-170.0, -31, 0, 44])))
    e_theta, e_phi = array.antenna_pattern.patterns[0](mi.Float(theta), mi.Float(phi))
    power = sum(np.array(part) ** 2 for field in (e_theta, e_phi) for part in (field.real, field.imag))
    pattern = read_cut_files(*cuts)
    assert 10.0 * np.log10(power) == pytest.approx(pattern.gain_dbi(theta, phi), abs=0.1)

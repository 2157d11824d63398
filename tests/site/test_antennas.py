"""Patterns against fields known in closed form: a crossed, tilted short dipole radiates e . p in every direction."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import AerpawCmpError, InputError, UsageError
from aerpaw_cmp.site.antennas import (
    TR38901,
    HalfWaveDipole,
    Isotropic,
    MeasuredPattern,
    read_gain_grid,
    read_pattern_text,
)
from aerpaw_cmp.site.pattern_files import read_pattern_file
from tests.real_logs import REAL

MOMENT = np.array([0.8 + 0.1j, -0.3 + 0.5j, 0.6 - 0.2j])
MOMENT = MOMENT * math.sqrt(1.5) / np.linalg.norm(MOMENT)  # efficiency 1
HEADER = "2\nFrequency=3300(MHz)\n\nPhi\tTheta\tE Total. dB\tE(Phi) . Amp dB\tE(Theta) . Amp dB\tE(Phi) . Phase\tE(Theta) . Phase\n"


def dipole(theta: np.ndarray, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ct, st_, cp, sp = np.cos(theta), np.sin(theta), np.cos(phi), np.sin(phi)
    return ct * cp * MOMENT[0] + ct * sp * MOMENT[1] - st_ * MOMENT[2], -sp * MOMENT[0] + cp * MOMENT[1]


def rows_of(folded: bool = True, cut: bool = False, clockwise: bool = False, step: float = 3.0) -> np.ndarray:
    """Rows of a file of the tilted dipole in one of the conventions that occur."""
    count = round(180 / step)
    phi = np.arange(count if folded else 2 * count) * math.radians(step)
    theta = np.linspace(-math.pi if folded else 0, math.pi, 2 * count + 1 if folded else count + 1)
    phi, theta = (a.ravel() for a in np.meshgrid(phi, theta, indexing="ij"))
    back = theta < 0
    azimuth = (-phi if clockwise else phi) + np.where(back, math.pi, 0)
    e_theta, e_phi = dipole(np.abs(theta), azimuth)
    if cut:
        e_theta, e_phi = np.where(back, -e_theta, e_theta), np.where(back, -e_phi, e_phi)
    total = 10 * np.log10(abs(e_theta) ** 2 + abs(e_phi) ** 2)
    amplitudes = 20 * np.log10(np.maximum(abs(e_phi), 1e-12)), 20 * np.log10(np.maximum(abs(e_theta), 1e-12))
    return np.column_stack([phi, theta, total, *amplitudes, np.angle(e_phi), np.angle(e_theta)])


def write(path: Path, rows: np.ndarray) -> Path:
    path.write_text(HEADER + "\n".join("\t".join(f"{v:.10g}" for v in row) for row in rows) + "\n")
    return path


def directions(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(1)
    return np.arccos(random.uniform(-1, 1, count)), random.uniform(-math.pi, 3 * math.pi, count)


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize(("folded", "cut"), [(True, False), (True, True), (False, False)])
def test_every_convention_gives_the_same_complex_field(
    tmp_path: Path, folded: bool, cut: bool, clockwise: bool
) -> None:
    pattern = read_pattern_text(write(tmp_path / "a.txt", rows_of(folded, cut, clockwise)))
    theta, phi = directions()
    for got, expected in zip(pattern.field(theta, phi), dipole(theta, phi), strict=True):
        np.testing.assert_allclose(got, expected, atol=2e-5)
    assert pattern.frequency_hz == 3.3e9
    assert pattern.efficiency == pytest.approx(1.0, abs=2e-3)
    assert pattern.peak_gain_dbi == pytest.approx(max(pattern.gain_dbi(theta, phi)), abs=0.02)


def test_principal_cuts_equal_the_file(tmp_path: Path) -> None:
    rows = rows_of()
    pattern = read_pattern_text(write(tmp_path / "a.txt", rows))
    theta, phi = np.abs(rows[:, 1]), rows[:, 0] + np.pi * (rows[:, 1] < 0)
    np.testing.assert_allclose(pattern.gain_dbi(theta, phi), rows[:, 2], atol=0.05)


@settings(max_examples=100, deadline=None)
@given(st.floats(0, 2 * math.pi), st.floats(0, 2 * math.pi), st.sampled_from([0.0, math.pi]))
def test_poles_and_wrap_have_no_seam(azimuth: float, second_azimuth: float, pole: float) -> None:
    theta, phi = (
        a.reshape(61, 120) for a in np.meshgrid(np.linspace(0, np.pi, 61), np.arange(120) * np.pi / 60, indexing="ij")
    )
    # noise at the poles, as measured from many sides, must not make a star there
    noise = 0.02 * np.random.default_rng(5).standard_normal((2, 61, 120))
    e_theta, e_phi = dipole(theta, phi)
    pattern = MeasuredPattern("p", e_theta + noise[0], e_phi + noise[1])

    def vector(theta: float, phi: float) -> np.ndarray:
        a, b = (complex(v) for v in pattern.field(np.array(theta), np.array(phi)))
        ct, st_, cp, sp = math.cos(theta), math.sin(theta), math.cos(phi), math.sin(phi)
        return a * np.array([ct * cp, ct * sp, -st_]) + b * np.array([-sp, cp, 0])

    np.testing.assert_allclose(vector(pole, azimuth), vector(pole, second_azimuth), atol=1e-5)
    near = abs(pole - 1e-6)
    np.testing.assert_allclose(vector(near, azimuth), vector(pole, second_azimuth), atol=1e-4)
    np.testing.assert_allclose(vector(1.3, azimuth), vector(1.3, azimuth + 2 * math.pi), atol=1e-12)
    np.testing.assert_allclose(vector(1.3, math.pi - 1e-9), vector(1.3, -math.pi + 1e-9), atol=1e-6)


def test_upside_down_mount_turns_the_gain_over(tmp_path: Path) -> None:
    # hand-computed: a device rolled by 180 deg has its y and z axes reversed
    pattern = read_pattern_text(write(tmp_path / "a.txt", rows_of()))
    theta, phi = directions(500)
    below = pattern.gain_dbi(np.pi - theta, -phi)
    e_theta, e_phi = dipole(np.pi - theta, -phi)
    np.testing.assert_allclose(below, 10 * np.log10(abs(e_theta) ** 2 + abs(e_phi) ** 2), atol=1e-3)


@pytest.mark.parametrize(("pattern", "peak_dbi"), [(Isotropic(), 0.0), (HalfWaveDipole(), 2.15)])
def test_lossless_patterns_radiate_what_they_get(pattern: Isotropic | HalfWaveDipole, peak_dbi: float) -> None:
    nodes, weights = np.polynomial.legendre.leggauss(60)
    e_theta, e_phi = pattern.field(np.arccos(nodes), np.zeros(60))
    gain = abs(e_theta) ** 2 + abs(e_phi) ** 2
    assert (gain * weights).sum() / 2 == pytest.approx(1.0, rel=1e-5)
    peak = abs(pattern.field(np.array(np.pi / 2), np.array(0.3))[0]) ** 2
    assert 10 * np.log10(peak) == pytest.approx(peak_dbi, abs=0.01)


def test_tr38901_reference_points() -> None:
    def gain(theta: float, phi: float) -> float:
        return float(20 * np.log10(abs(TR38901().field(np.radians(theta), np.radians(phi))[0])))

    assert gain(90, 0) == pytest.approx(8.0)
    assert gain(90, 32.5) == gain(90, -32.5) == gain(57.5, 0) == pytest.approx(5.0)  # half-power width 65 deg
    assert gain(90, 180) == gain(90, -180) == pytest.approx(-22.0)
    assert gain(0, 180) == pytest.approx(-22.0)  # the floor holds for the sum


def _degrees(rows: np.ndarray) -> np.ndarray:
    return rows * [180 / math.pi, 180 / math.pi, 1, 1, 1, 1, 1]


def _phase_degrees(rows: np.ndarray) -> np.ndarray:
    return rows * [1, 1, 1, 1, 1, 180 / math.pi, 180 / math.pi]


def _linear(rows: np.ndarray) -> np.ndarray:
    return np.column_stack([rows[:, :2], 10 ** (rows[:, 2:5] / 20), rows[:, 5:]])


def _too_strong(rows: np.ndarray) -> np.ndarray:
    return rows + np.array([0, 0, 20, 20, 20, 0, 0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_degrees, "line .*: angles reach 180; expected angles in radians.*degrees"),
        (_phase_degrees, "phases reach .* expected phases in radians"),
        (_linear, "linear amplitudes instead of dBi"),
        (_too_strong, "mean gain over the sphere is 20.0 dB"),
    ],
)
def test_bad_files_are_explained(tmp_path: Path, change: object, words: str) -> None:
    path = write(tmp_path / "bad.txt", change(rows_of()))  # type: ignore[operator]
    with pytest.raises(InputError, match=words) as caught:
        read_pattern_text(path)
    assert caught.value.path == str(path)


def test_foreign_files(tmp_path: Path) -> None:
    path = write(tmp_path / "cut.txt", rows_of())
    text = path.read_text()
    path.write_text("hello\n1 2 3\n")
    with pytest.raises(InputError, match="no antenna pattern of a known format"):
        read_pattern_text(path)
    path.write_text("azimuth_deg,gain_dbi\n0,3\n")
    with pytest.raises(InputError, match="one of two cuts"):
        read_pattern_text(path)
    path.write_bytes(b"\x00\xff\x80" * 100)
    with pytest.raises(InputError, match="not UTF-8 text"):
        read_pattern_text(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_pattern_text(tmp_path / "absent.txt")
    path.write_text(text.replace("E Total. dB", "Gain"))
    with pytest.raises(InputError, match="line 4: the columns are"):
        read_pattern_text(path)


def grid_file(path: Path, **changes: object) -> Path:
    from scipy.io import savemat

    elevation, azimuth = np.arange(90, -91, -3.0), np.arange(180, -180, -3.0)
    theta, phi = np.meshgrid(np.radians(90 - elevation), np.radians(azimuth), indexing="ij")
    e_theta, e_phi = dipole(theta, phi)
    content: dict[str, object] = {
        "theta2": elevation[:, None],
        "phi2": azimuth[None, :],
        "tilted": 10 * np.log10(abs(e_theta) ** 2 + abs(e_phi) ** 2),
    }
    savemat(path, {**content, **changes})
    return path


def test_gain_grid(tmp_path: Path) -> None:
    pattern = read_gain_grid(grid_file(tmp_path / "rad_pat.mat"), "tilted")
    theta, phi = directions()
    e_theta, e_phi = dipole(theta, phi)
    np.testing.assert_allclose(
        pattern.gain_dbi(theta, phi), 10 * np.log10(abs(e_theta) ** 2 + abs(e_phi) ** 2), atol=0.05
    )
    assert pattern.efficiency == pytest.approx(1, abs=2e-3)


def test_bad_gain_grids_are_explained(tmp_path: Path) -> None:
    path = grid_file(tmp_path / "rad_pat.mat")
    with pytest.raises(UsageError, match="no gain grid 'tiltd'; expected one of tilted"):
        read_gain_grid(path, "tiltd")
    path.write_bytes(b"MATLAB 5.0 nonsense" * 20)
    with pytest.raises(AerpawCmpError, match="not a MATLAB"):
        read_gain_grid(path, "tilted")


@pytest.mark.field
@pytest.mark.parametrize(
    ("file", "grid", "peak_dbi"),
    [("RM-WB1-DN-BLK_right_side_up_F3300.txt", "RMWB3300_normal", 4.05), ("SA-1400-5900_F3300.txt", "SA3300", -1.22)],
)
def test_measured_patterns_of_the_field(file: str, grid: str, peak_dbi: float) -> None:
    folder = REAL / "antennas"
    pattern = read_pattern_text(folder / file)
    assert pattern.peak_gain_dbi == pytest.approx(peak_dbi, abs=0.01)
    assert 0.1 < pattern.efficiency < 1
    rows = np.loadtxt(folder / file, skiprows=4)
    theta, azimuth = np.abs(rows[:, 1]), -(rows[:, 0] + np.pi * (rows[:, 1] < 0))
    np.testing.assert_allclose(pattern.gain_dbi(theta, azimuth), rows[:, 2], atol=0.05)
    # the same measurement, listed by others over true azimuth
    gain = read_gain_grid(folder / "rad_pat.mat", grid).gain_dbi(theta, azimuth)
    np.testing.assert_allclose(gain, rows[:, 2], atol=0.05)


SMALL = [
    f"{phi:.6f}\t{theta:.6f}\t-3.0103\t-6.0206\t-6.0206\t0.100\t{0.2 * phi:.3f}"
    for phi in np.arange(4) * np.pi / 4
    for theta in np.linspace(-np.pi, np.pi, 9)
]


@pytest.mark.parametrize(
    ("rows", "line", "words"),
    [
        ([*SMALL[:-1], SMALL[-1][:-1]], 40, "'0.47', has fewer digits than those above it. Likely cause: the line was cut off"),
        ([*SMALL[:-1], SMALL[-1][:-20]], 40, "expected 7 numbers. Likely cause: the line was cut off"),
        ([*SMALL, SMALL[0]], 41, "given twice.*a line was copied"),
        ([*SMALL[:10], *SMALL[11:]], None, "1 direction missing.*phi 45.0 deg, theta -135.0 deg.*a line is lost"),
        ([*SMALL[:9], *SMALL[18:]], None, "phi runs from 0.0 to 135.0 deg in 3 values.*angles are missing"),
        ([row.replace(".", ",") for row in SMALL], 5, "decimal commas"),
        ([row.replace("-3.0103\t-6.0206\t-6.0206", "-43.0103\t-46.0206\t-46.0206") for row in SMALL], None,
         "mean gain over the sphere is -43.0 dB"),
    ],
)  # fmt: skip
def test_damaged_patterns_name_the_line(tmp_path: Path, rows: list[str], line: int | None, words: str) -> None:
    path = tmp_path / "p.txt"
    path.write_text(HEADER + "\n".join(SMALL))
    assert read_pattern_text(path).efficiency == pytest.approx(0.5, rel=1e-3)
    path.write_text(HEADER + "\n".join(rows))
    with pytest.raises(InputError, match=words) as error:
        read_pattern_text(path)
    assert error.value.line == line
    path.write_text((HEADER + "\n".join(SMALL)).replace("\t", ";"))
    with pytest.raises(InputError, match=r"not separated by tabs|no antenna pattern of a known format"):
        read_pattern_text(path)


ELEVATION, AZIMUTH = np.linspace(90, -90, 7), np.arange(12) * 30.0


@pytest.mark.parametrize(
    ("elevation", "azimuth", "change", "words"),
    [
        (ELEVATION, AZIMUTH, "nan", r"1 value without a number, first at elevation 30 deg, azimuth 90 deg"),
        (ELEVATION, AZIMUTH, "transpose", "'g' has 12 x 7 values.*rows and columns are swapped"),
        (np.where(ELEVATION == 0, np.nan, ELEVATION), AZIMUTH, "", "elevation .* runs from nan"),
        (90 - ELEVATION, AZIMUTH, "", "zenith angles in place of elevation"),
        (ELEVATION, np.linspace(0, 360, 13), "", "a direction occurs twice, such as 0 and 360"),
        (ELEVATION[:4], AZIMUTH, "", "elevation .*angles are missing"),
        (ELEVATION, AZIMUTH[:8], "", "azimuth .*angles are missing"),
        (np.radians(ELEVATION), AZIMUTH, "", "radians instead of degrees"),
    ],
)
def test_damaged_gain_grids(
    tmp_path: Path, elevation: np.ndarray, azimuth: np.ndarray, change: str, words: str
) -> None:
    from scipy.io import savemat

    grid = np.full((len(elevation), len(azimuth)), -1.0)
    if change == "nan":
        grid[2, 3] = np.nan
    savemat(tmp_path / "g.mat", {"theta2": elevation, "phi2": azimuth, "g": grid.T if change == "transpose" else grid})
    with pytest.raises(AerpawCmpError, match=words):
        read_gain_grid(tmp_path / "g.mat", "g")


@pytest.mark.field
def test_the_headers_of_one_lab_tell_one_antenna() -> None:
    """The file at 3.5 GHz, the cut at phi = 0 and the gain over frequency are three views of the UAV's antenna."""
    folder = REAL / "antennas"
    gain = np.loadtxt(folder / "SA-1400-5900_gain.txt", skiprows=2)
    (at_3500,) = gain[gain[:, 0] == 3.5e9, 1]
    assert read_pattern_file(folder / "SA-1400-5900_F3500.txt").peak_gain_dbi == pytest.approx(at_3500, abs=0.01)
    cut = read_pattern_file(folder / "SA-1400-5900_phi_0.txt", carrier_hz=3.31e9)
    sphere = read_pattern_file(folder / "SA-1400-5900_F3300.txt")
    theta = np.radians(np.arange(20, 161, 10))
    for half in (0.0, np.pi):
        side = np.full(len(theta), half)
        np.testing.assert_allclose(cut.gain_dbi(theta, side), sphere.gain_dbi(theta, side), atol=0.25)
    with pytest.raises(InputError, match="without directions"):
        read_pattern_file(folder / "SA-1400-5900_gain.txt")

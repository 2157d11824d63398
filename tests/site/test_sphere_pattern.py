"""Antenna files over the full sphere: round trip, cuts, refusals."""

import numpy as np
import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.site.antennas import HalfWaveDipole
from aerpaw_cmp.site.sphere_pattern import (
    SpherePattern,
    planning_cuts,
    read_sphere_csv,
    sphere_csv,
    sphere_grid,
    unit_mean_gain,
)


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
    """Vertical cut: index 0 in front, 90 straight down, 180 behind, 270 straight up; horizontal runs clockwise."""
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


def test_other_patterns_have_no_standard_deviation():
    assert not hasattr(HalfWaveDipole(), "gain_sd_db")

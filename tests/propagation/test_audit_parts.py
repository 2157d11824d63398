"""Parts of the audit: what counts as a missing path, and how explanations say lengths and faces."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from aerpaw_cmp.propagation.arrays import Isotropic, Link, Poses, rotation_from_yaw_pitch_roll, single_element
from aerpaw_cmp.propagation.check import explain, reference
from aerpaw_cmp.propagation.check.field_audit import (
    Expected,
    _lacking,
    _link_error,
    _paths_against_sionna,
    _probe,
    impossible,
)
from aerpaw_cmp.propagation.field.sum import channel_matrices
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.paths import path_lengths
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.scene import Scene
from aerpaw_cmp.propagation.search.merging import _labels
from aerpaw_cmp.site.antennas import TR38901, HalfWaveDipole
from aerpaw_cmp.site.siteyaml import load_site

SITE = load_site("lake_wheeler")
LINK = Link(3.3e9, {"LW1": single_element(Isotropic())}, single_element(Isotropic()))
POSES = Poses(np.array([[120.0, 60.0, 40.0]]), np.eye(3)[None])


def test_a_path_that_the_other_engine_alone_has_is_missing_only_where_it_exists() -> None:
    found = replay(SITE, LINK, POSES, Search("image", max_depth=1))
    known = found.paths
    assert len(known) >= 2
    every = np.arange(len(known))
    missing = _lacking(SITE, found, known, found.faces, every, POSES, Expected.of(LINK))
    assert (missing.missing_paths, missing.doubtful) == (len(known), 0)
    assert missing.failures == (f"{len(known)} paths that Sionna has are missing",)
    # the same paths off walls that look away from the tower: none can exist
    source = SITE.towers["LW1"].position_m
    away = np.flatnonzero((found.faces.solid >= 0) & (found.faces.normal @ source < found.faces.offset_m - 1.0))
    bounced = known.select(np.flatnonzero(known.depth == 1)[:1])
    for face in away[:5]:
        phantom = dataclasses.replace(bounced, faces=np.full_like(bounced.faces, face))
        judged = _lacking(SITE, found, phantom, found.faces, np.array([0]), POSES, Expected.of(LINK))
        assert (judged.missing_paths, judged.doubtful, judged.failures) == (0, 1, ())
    assert len(away) > 5


def test_paths_that_the_other_engine_lacks_are_invented_only_where_none_can_be() -> None:
    found = replay(SITE, LINK, POSES, Search("image", max_depth=1))
    every = np.arange(len(found.paths))
    assert impossible(SITE, POSES, found, every, Expected.of(LINK)).failures == ()
    row = int(np.flatnonzero(found.paths.depth == 1)[0])
    source = SITE.towers["LW1"].position_m
    faces = found.paths.faces.copy()
    faces[row, 0] = np.flatnonzero((found.faces.solid >= 0) & (found.faces.normal @ source < found.faces.offset_m - 1))[
        0
    ]
    planted = dataclasses.replace(found, paths=dataclasses.replace(found.paths, faces=faces))
    seen = impossible(SITE, POSES, planted, every, Expected.of(LINK))
    assert (seen.phantom_paths, seen.failures) == (1, ("1 paths that cannot exist",))
    assert impossible(SITE, POSES, planted, np.setdiff1d(every, row), Expected.of(LINK)).phantom_paths == 0


@dataclasses.dataclass
class OwnPaths:
    """As Sionna's own paths, for the comparison of coefficients."""

    gain: np.ndarray
    length_m: np.ndarray


@pytest.mark.parametrize("planted", ["nothing", "level", "phase", "far phase", "weak entry"])
def test_coefficients_of_paths_are_compared_entry_by_entry(planted: str) -> None:
    """Weak entries by their difference as a share of the largest; phases on short paths alone; all else not."""
    generator = np.random.default_rng(3)
    turns = np.array([rotation_from_yaw_pitch_roll(*generator.uniform(-0.4, 0.4, 3)) for _ in range(4)])
    spots = np.array([[120.0, 60.0, 40.0], [40.0, -90.0, 25.0], [-700.0, 300.0, 60.0], [60.0, 10.0, 30.0]])
    few = Poses(spots, turns)
    found = replay(SITE, LINK, few, Search("image", max_depth=1))
    probe, left = _probe(LINK)
    assert left == ()
    scene, paths = Scene.of(SITE, probe, few), found.paths
    alone = dataclasses.replace(paths, pose=np.arange(len(paths)))
    many = Poses(spots[paths.pose], turns[paths.pose])
    own = channel_matrices(alone, found.faces, scene.sources_m, many, probe).h[np.arange(len(paths)), paths.tower]
    length = path_lengths(paths, scene.sources_m, spots)
    gain, k = own.copy(), int(np.argmin(length))
    strong = np.unravel_index(np.abs(own[k]).argmax(), (2, 2))
    weak = np.unravel_index(np.abs(own[k]).argmin(), (2, 2))
    share = abs(own[k][weak] / own[k][strong])
    assert share < 0.1  # 20 dB
    power, phase = 0.0, 0.0
    if planted == "level":
        gain[(k, *strong)] *= 2.0
        power = 20 * np.log10(2.0)
    elif planted == "phase":
        gain[(k, *strong)] *= np.exp(0.3j)
        phase = 0.3
    elif planted == "far phase":
        gain[length > 300.0] *= np.exp(0.3j)
    elif planted == "weak entry":
        gain[(k, *weak)] *= 1.5 * np.exp(2.0j)  # its phase is not asked
        power = 20 * np.log10(1.0 + 0.5 * share)
    other = generator.permutation(len(paths))
    theirs = OwnPaths(np.empty_like(gain), np.empty_like(length))
    theirs.gain[other], theirs.length_m[other] = gain, length
    seen = _paths_against_sionna(paths, found, scene, few, probe, theirs, other)
    assert (seen.paths, seen.phases) == (len(paths), int((length < 300.0).sum()))
    assert 0 < seen.phases < seen.paths
    assert seen.phase_max_rad == pytest.approx(phase, abs=1e-9)
    assert seen.phase_rms_rad == pytest.approx(phase / np.sqrt(seen.phases), abs=1e-9)
    assert seen.power_max_db == pytest.approx(power, abs=1e-9)
    assert seen.power_rms_db == pytest.approx(power / np.sqrt(len(paths)), abs=1e-9)
    words = " ".join(seen.failures)
    assert ("1 paths differ from Sionna's own by up to 6.02 dB" in words) == (planted == "level")
    assert ("1 paths differ from Sionna's own by up to 0.3 rad" in words) == (planted == "phase")
    assert ("RSS of a link" in words) == (planted in ("level", "phase"))


def test_a_link_s_error_is_that_of_its_sum_where_all_paths_are_near_and_none_fades() -> None:
    """Five links of two poses and three towers; the second has a far path, the third fades, the last has no path."""
    found = replay(SITE, LINK, POSES, Search("image", max_depth=1)).paths
    link = np.array([0, 0, 1, 1, 2, 2, 3, 4])
    paths = dataclasses.replace(found.select(np.zeros(8, dtype=np.int64)), pose=link // 3, tower=link % 3)
    generator = np.random.default_rng(2)
    h = generator.normal(size=(8, 2, 2)) + 1j * generator.normal(size=(8, 2, 2))
    h[5] = -h[4] * 0.999
    theirs = h * (1.0 + 0.1 * generator.normal(size=(8, 1, 1)))
    theirs[2:4] *= 9.0  # would be seen, were it judged
    theirs[5] = -theirs[4] * 0.9995
    near = np.array([True, True, True, False, True, True, True, True])
    expected = max(
        abs(10 * np.log10((np.abs(h[k].sum(axis=0)) ** 2).mean() / (np.abs(theirs[k].sum(axis=0)) ** 2).mean()))
        for k in ([0, 1], [6], [7])
    )
    assert _link_error(paths, h, theirs, near, 2, 3) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "pattern"), [("iso", Isotropic()), ("dipole", HalfWaveDipole()), ("tr38901", TR38901())]
)
def test_patterns_a_second_time(name: str, pattern: Isotropic) -> None:
    """Two sources each: Balanis 4-84 and TR 38.901 table 7.3-1, every degree of the sphere and beyond a turn."""
    theta, phi = np.meshgrid(np.radians(np.arange(0, 181, 3)), np.radians(np.arange(-200, 380, 7)))
    ours = pattern.field(theta, phi)
    theirs = np.array(
        [[reference.PATTERNS[name](t, p) for t, p in zip(*row, strict=True)] for row in zip(theta, phi, strict=True)]
    )
    for component in (0, 1):
        np.testing.assert_allclose(np.broadcast_to(ours[component], theta.shape), theirs[..., component], atol=1e-9)


@pytest.mark.parametrize(
    ("length", "text"),
    [(12.345, "12.35 m"), (0.5, "0.50 m"), (0.01, "0.01 m"), (0.0099, "9.9e-03 m"), (0.0, "0.0e+00 m")],
)
def test_lengths_below_a_centimetre_keep_their_digits(length: float, text: str) -> None:
    assert explain._metres(length) == text


def test_faces_are_counted_within_their_shape() -> None:
    labels = _labels(("hall", "shed"), np.array([0, 0, 1, 0, 1]))
    assert labels == ("hall face 1", "hall face 2", "shed face 1", "hall face 3", "shed face 2")

"""The second implementation: against closed forms, against the replay, and faults that it must see."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import shapely

from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.propagation.check import audit as field_audit
from aerpaw_cmp.propagation.check import reference
from aerpaw_cmp.propagation.field import dyads, sum
from aerpaw_cmp.propagation.field.foliage import CrownIndex, foliage_loss_db, foliage_model
from aerpaw_cmp.propagation.geometry import (
    Array,
    linear_array,
    rotation_from_aircraft,
    rotation_from_yaw_pitch_roll,
    tower_comparison_array,
    uav_comparison_array,
)
from aerpaw_cmp.propagation.options import Field
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.search import mirror as solids
from aerpaw_cmp.site.antennas import TR38901, HalfWaveDipole
from aerpaw_cmp.site.materials import MATERIALS, material
from aerpaw_cmp.site.site import Building, Trees

KS = (10.0, 100.0)


def stand(count=60, seed=6):
    rng = np.random.default_rng(seed)
    like = np.ones(count)
    return Trees(*rng.uniform(-90, 90, (2, count)), 0 * like, 18 * like, 9 * like, 5 * like, 0.4 * like)


def loss_of(trees, model):
    index = CrownIndex(trees)
    return lambda p, s, t: foliage_loss_db(s[p.tower], p.vertices_m, t[p.pose], index, model)


@pytest.fixture
def case(scenes):
    rng = np.random.default_rng(41)
    site = scenes.site(scenes.buildings(rng, 4, spread_m=60.0, holes=True), ((0.0, 0.0, 10.0), (3.0, -5.0, 9.0, 1.5)))
    angles = rng.uniform(-15, 15, (3, 6))
    turn = rotation_from_aircraft(angles[0], angles[1], 12 * angles[2])
    poses = scenes.poses(rng.uniform([-80, -80, 12], [80, 80, 40], (6, 3)), turn)
    link = scenes.link(site, tower_comparison_array(), uav_comparison_array(wavelength_m(scenes.carrier_hz)))
    return site, link, poses


def audited(site, link, poses, replayed, loss=None):
    expected = field_audit.Expected.of(link, loss)
    rows = np.arange(len(poses))
    return field_audit.against_reference(site, poses, replayed, rows, expected, ks=KS, max_depth=2)


@pytest.mark.parametrize("pattern", [None, HalfWaveDipole(), TR38901()])
def test_replay_equals_the_second_implementation(scenes, case, pattern):
    site, link, poses = case
    if pattern is not None:
        uav = uav_comparison_array(wavelength_m(scenes.carrier_hz), pattern=pattern)
        link = scenes.link(site, tower_comparison_array(pattern=pattern), uav)
    audit = audited(site, link, poses, replay(site, link, poses))
    assert audit.failures == ()
    assert audit.h_max_error < 1e-11
    assert (audit.missing_paths, audit.phantom_paths, audit.doubtful) == (0, 0, 0)
    assert audit.reference_paths > 20
    assert audit.reference_links == 2 * len(poses)


@pytest.mark.parametrize(("name", "in_leaf"), [("attenuating", True), ("attenuating", False), ("opaque", True)])
def test_foliage_equals_the_second_implementation(scenes, case, name, in_leaf):
    site, link, poses = case
    site = replace(site, trees=stand())
    model = foliage_model(name, scenes.carrier_hz, in_leaf=in_leaf)
    result = replay(site, link, poses, field=Field(loss=loss_of(site.trees, model)))
    audit = audited(site, link, poses, result, reference.ExpectedLoss(name, in_leaf=in_leaf))
    assert audit.failures == ()
    bare = replay(site, link, poses)
    assert not np.allclose(result.rss_dbm, bare.rss_dbm, equal_nan=True)  # trees are in the way
    lighter = audited(site, link, poses, result, reference.ExpectedLoss("attenuating", gamma_db_per_m=0.4))
    assert lighter.failures


@pytest.mark.parametrize("in_leaf", [True, False])
@pytest.mark.parametrize("frequency_hz", [60e6, 300e6, 1e9, 2e9, 3.4e9, 28e9])
def test_foliage_models_a_second_time(frequency_hz, in_leaf):
    depth = np.array([0.5, 5.0, 14.0, 50.0])
    ours = foliage_model("attenuating", frequency_hz, in_leaf=in_leaf).loss_db(depth)
    same = reference.ExpectedLoss("attenuating", in_leaf=in_leaf)
    assert [reference.foliage_db(same, d, frequency_hz) for d in depth] == pytest.approx(ours, rel=1e-12)
    given = reference.ExpectedLoss("attenuating", gamma_db_per_m=0.6, maximum_db=20.0, in_leaf=in_leaf)
    expected = foliage_model("attenuating", frequency_hz, gamma_db_per_m=0.6, maximum_db=20.0).loss_db(depth)
    assert [reference.foliage_db(given, d, frequency_hz) for d in depth] == pytest.approx(expected, rel=1e-12)


def test_materials_a_second_time():
    for name in MATERIALS:
        what = material(name)
        carrier = {"floorboard": 60e9}.get(name, 3.4e9)
        eta, thickness = reference.permittivity(name, carrier)
        assert eta == pytest.approx(what.relative_permittivity(carrier), rel=1e-12)
        assert thickness == what.thickness_m
        for ghz, beyond in ((what.band[0], 0.999), (what.band[1], 1.001)):
            eta = reference.permittivity(name, 1e9 * ghz)[0]
            assert eta == pytest.approx(what.relative_permittivity(1e9 * ghz), rel=1e-12)
            assert reference.permittivity(name, 1e9 * ghz * beyond) is None


def test_rotations_a_second_time():
    for a, b, c in np.random.default_rng(1).uniform(-180, 180, (20, 3)):
        ours = rotation_from_yaw_pitch_roll(*np.radians([a, b, c]))
        assert np.array(reference.turned(a, b, c)) == pytest.approx(ours, abs=1e-14)
        assert np.array(reference.aircraft(a, b, c)) == pytest.approx(rotation_from_aircraft(a, b, c), abs=1e-14)
    # nose up lifts the nose, right wing down lowers the right wing
    assert reference.aircraft(0, 10, 0)[2][0] > 0
    assert reference.aircraft(10, 0, 0)[2][1] > 0


def test_layouts_a_second_time():
    wavelength = 0.09
    for name, array in (
        ("tower_comparison", tower_comparison_array()),
        ("uav_comparison", uav_comparison_array(wavelength)),
        ("linear", linear_array(5, wavelength / 2)),
        ("single", linear_array(1, wavelength / 2)),
    ):
        theirs = np.array(reference.layout_positions(name, wavelength, 5))
        assert theirs == pytest.approx(array.positions_m, abs=1e-15)


def test_arrays_of_the_comparison_look_north_east_and_from_the_uav_south_east_upright():
    """In arXiv 2502.10324 the yaws are 45 and 315 degrees counter-clockwise from east.

    The UAV's 2 x 2 array is rolled by 90 degrees.
    """
    for array, yaw, roll in ((tower_comparison_array(), 45.0, 0.0), (uav_comparison_array(0.09), 315.0, 90.0)):
        assert array.mount == pytest.approx(np.array(reference.turned(yaw, 0.0, roll)), abs=1e-12)
        assert sorted(np.degrees(array.slant_rad)) == pytest.approx([-45.0, -45.0, 45.0, 45.0])


def test_ports_of_the_comparison_are_where_the_paper_has_them():
    """In arXiv 2502.10324 VII-D, ports are along a line, and 2 x 2 at half a wavelength.

    The slants of neighbours differ by a right angle.
    """
    tower, uav = tower_comparison_array(), uav_comparison_array(0.09)
    np.testing.assert_allclose(np.diff(tower.positions_m, axis=0), np.outer([0.06, 1.68, 0.06], [0, -1, 0]), atol=1e-15)
    assert np.degrees(tower.slant_rad) == pytest.approx([45.0, -45.0, 45.0, -45.0])
    assert np.degrees(uav.slant_rad[0]) == pytest.approx(45.0)
    assert uav.positions_m[0] == pytest.approx([0.0, 0.0225, 0.0225])
    apart = np.linalg.norm(uav.positions_m[:, None] - uav.positions_m, axis=2)
    turned = np.degrees(np.abs(uav.slant_rad[:, None] - uav.slant_rad))
    near = np.isclose(apart, 0.045)
    assert near.sum() == 8
    assert turned == pytest.approx(np.where(near, 90.0, 0.0))
    line = linear_array(4, 0.04)  # across its boresight, which looks north
    np.testing.assert_allclose((line.mount @ np.diff(line.positions_m, axis=0).T).T, [[0.04, 0, 0]] * 3, atol=1e-15)


def test_elements_are_where_their_array_has_them_in_the_second_implementation(scenes):
    """Free space between elements away from the middle of both arrays: amplitude and phase of their own distance."""
    site = scenes.site()
    arrays = [Array(np.array([place]), np.zeros(1)) for place in ([0.3, 0.7, 1.1], [-0.2, 0.5, -0.4])]
    link = scenes.link(site, *arrays)
    second_way = reference.Reference(site, "LW1", field_audit.Expected.of(link).link)
    target = np.array([300.0, 40.0, 35.0])
    length = np.linalg.norm(target + arrays[1].positions_m[0] - np.array(second_way.source) - arrays[0].positions_m[0])
    h = second_way.pair((), 0, 0, tuple(target), reference.turned(0, 0, 0))
    turns = length / wavelength_m(link.carrier_hz)
    assert np.angle(h * np.exp(2j * np.pi * turns)) == pytest.approx(0.0, abs=1e-6)
    assert abs(h) == pytest.approx(1 / (4 * np.pi * turns), rel=0.02)


@pytest.mark.parametrize("wall_first", [True, False])
@pytest.mark.parametrize("slope", [0.2, 5.0])
@pytest.mark.parametrize(("clear_m", "expected"), [(1e-3, True), (None, None), (-1e-3, False)])
def test_of_wall_and_ground_a_path_meets_first_what_it_reaches_first(scenes, wall_first, slope, clear_m, expected):
    """After unfolding, the path is a straight line past the foot of the wall.

    Within a micrometre of the foot there is no verdict.
    """
    clear_m = max(slope, 1.0) * 5e-7 if clear_m is None else clear_m
    above_m = clear_m if wall_first else -clear_m
    site = scenes.site((Building("hall", shapely.box(0, -20, 10, 20), 8.0),), ((-10.0, 0.0, 10 * slope + above_m),))
    second_way = reference.Reference(site, "LW1", field_audit.Expected.of(scenes.link(site)).link)
    (wall,) = (m for m in second_way.mirrors if m.normal[0] == -1.0)
    sequence = (wall, second_way.mirrors[0]) if wall_first else (second_way.mirrors[0], wall)
    assert second_way.verdict(sequence, (-6.0, 3.0, 6 * slope - above_m)) is expected


@pytest.mark.parametrize(
    ("source", "target", "walls", "expected"),
    [
        ((-10, 0, 10), (-6, 3, 0), (-1,), True), ((-10, 0, 0), (-6, 3, 7), (-1,), True),  # an end on the ground
        ((-10, 0, 10), (-6, 3, -1e-4), (-1,), False), ((-10, 0, -1e-4), (-6, 3, 7), (-1,), False),
        ((-10, 0, 10), (-6, 3, -1.5e-6), (-1,), None), ((-10, 0, 0), (-6, 3, 0), (-1,), False),
        ((0, 0, 5), (-6, 3, 4), (0,), True), ((-10, 0, 5), (0, 3, 4), (0,), True),  # an end on the wall
        ((-10, 0, 5), (-6, 3, 0), (0, -1), True), ((0, 0, 5), (-6, 3, 3), (0, -1), True),
        ((-10, 0, 5), (1e-4, 3, 4), (0,), False), ((-10, 0, 8), (-10, 6, 8), (0,), None),  # in its upper rim
        ((-10, 0, 8), (-10, 6, 7.9), (0,), True), ((-10, 0, 8), (-10, 6, 8.1), (0,), False),
        ((-10, 0, 5), (20, 0, 5), (), False), ((-10, 0, 8), (20, 0, 8), (), None), ((-10, 0, 8), (20, 0, 8.1), (), True),
        ((-10, 20, 5), (20, 20, 5), (), None), ((-10, 21, 5), (20, 21, 5), (), True),  # along a wall, and next to it
        ((5, 0, 30), (5, 0, 9), (), True), ((5, 0, 30), (5, 0, 7), (), False), ((12, 0, 30), (12, 0, 1), (), True),
    ],
)  # fmt: skip
def test_a_path_exists_up_to_the_surfaces(scenes, source, target, walls, expected):
    """Mirrors have numbers, and -1 is the ground.

    An end may lie on its mirror, and cases that a micrometre decides have no verdict.
    """
    site = scenes.site((Building("hall", shapely.box(0, -20, 10, 20), 8.0),), (source,))
    second_way = reference.Reference(site, "LW1", field_audit.Expected.of(scenes.link(site)).link)
    mirror = {-1: second_way.mirrors[0], 0: next(m for m in second_way.mirrors if m.normal[0] == -1.0)}
    assert second_way.verdict([mirror[k] for k in walls], target) is expected
    if expected is not None:  # and so says the image engine
        replayed = replay(site, scenes.link(site), scenes.poses(target))
        number = {0: -1, int(np.flatnonzero(replayed.faces.normal[:, 0] == -1.0)[0]): 0}
        sequences = [tuple(number.get(f, 9) for f in row if f >= 0) for row in replayed.paths.faces.tolist()]
        assert (walls in sequences) == expected


def test_limits_of_links_are_those_of_the_replay(scenes):
    """Next to the tower, 100 km away and below the ground, which lies above that of the site: no path too many."""
    site = scenes.site(towers=((0.0, 0.0, 9.0, 1.5),))
    spots = [(0.5, 0, 10.5), (0.0101, 0, 10.5), (0.0099, 0, 10.5), (99_999.5, 0, 10.5), (100_000.5, 0, 10.5),
             (40, 0, -0.5), (40, 0, 0.7), (40, 0, 0.0)]  # fmt: skip
    poses, link = scenes.poses(spots), scenes.link(site)
    replayed = replay(site, link, poses)
    assert replayed.has_path[:, 0].tolist() == [True, True, False, True, False, False, True, True]
    audit = audited(site, link, poses, replayed)
    assert (audit.failures, audit.missing_paths, audit.phantom_paths, audit.doubtful) == ((), 0, 0, 0)
    rim = scenes.site((Building("hall", shapely.box(0, -20, 10, 20), 8.0),), ((-10.0, 0.0, 8.0),))
    poses, link = scenes.poses([(-10.0, 6.0, 8.0)]), scenes.link(rim)
    audit = audited(rim, link, poses, replay(rim, link, poses))
    assert (audit.failures, audit.doubtful) == ((), 1)  # over the upper rim of the wall


def test_a_pose_within_reach_of_one_tower_has_paths_to_all(scenes):
    """The limit of 100 km applies to the nearest tower. A longer link to a tower behind it is valid."""
    site = scenes.site(towers=((0.0, 0.0, 10.0), (-2000.0, 0.0, 10.0)))
    link = scenes.link(site)
    for east_m, paths in ((99_000.0, 4), (101_000.0, 0)):
        pose = scenes.poses([[east_m, 0.0, 50.0]])
        replayed = replay(site, link, pose)
        assert len(replayed.paths) == paths
        assert audited(site, link, pose, replayed).failures == ()


def test_each_reflection_loses_the_stated_decibels(scenes):
    site = scenes.site((Building("hall", shapely.box(0, -20, 10, 20), 8.0),), ((-10.0, 0.0, 20.0),))
    link = field_audit.Expected.of(scenes.link(site)).link
    second_way = reference.Reference(site, "LW1", link, reference.ExpectedLoss(reflection_db=2.0))
    ground, roof = second_way.mirrors[0], next(m for m in second_way.mirrors if m.roof is not None)
    wall = next(m for m in second_way.mirrors if m.normal[0] == -1.0)
    for sequence, target, expected in (
        ((), (20.0, 5.0, 20.0), 0.0),
        ((roof,), (20.0, 0.0, 20.0), 2.0),
        ((ground,), (-40.0, 0.0, 12.0), 2.0),
        ((wall, ground), (-8.0, 3.0, 4.0), 4.0),
        ((ground, wall), (-8.0, 3.0, 4.0), 4.0),
    ):
        assert second_way.loss_db(sequence, target) == expected


def test_free_space_and_a_perfect_ground_in_closed_form(scenes):
    site = scenes.site()
    link = field_audit.Expected.of(scenes.link(site)).link
    second_way = reference.Reference(site, "LW1", link)
    turn = reference.turned(0, 0, 0)
    h = second_way.pair((), 0, 0, (300.0, 0.0, 10.0), turn)
    assert abs(h) == pytest.approx(wavelength_m(link.carrier_hz) / (4 * np.pi * 300), rel=1e-12)
    assert reference.fresnel(1.0, 4 + 0j, None, 0.1) == pytest.approx((-1 / 3, 1 / 3))
    te, tm = reference.fresnel(0.3, 1e12 - 1e12j, None, 0.1)
    assert (te, tm) == (pytest.approx(-1, abs=1e-5), pytest.approx(1, abs=1e-4))


def test_chord_through_a_crown_in_closed_form():
    tree = Trees(*(np.array([x]) for x in (10.0, 0.0, 0.0, 20.0, 8.0, 4.0, 0.4)))
    # level, through the axis: the cone is 4 m in radius at 4 m and 0 at 20 m
    assert reference.crown_depth_m(tree, (0, 0, 8), (20, 0, 8)) == pytest.approx(6.0, abs=1e-9)
    assert reference.crown_depth_m(tree, (10, 0, 30), (10, 0, 0)) == pytest.approx(16.0, abs=1e-9)
    assert reference.crown_depth_m(tree, (0, 0, 2), (20, 0, 2), trunks=True) == pytest.approx(0.4, abs=1e-9)
    assert reference.crown_depth_m(tree, (0, 3.9, 8), (20, 3.9, 8)) == 0.0  # below its rim, next to the cone


def _wrap(monkeypatch, where, name, change):
    clean = getattr(where, name)
    monkeypatch.setattr(where, name, lambda *args: change(clean(*args)))


FAULTS = {
    "reflections times -0.1": (dyads, "reflected", lambda wave: tuple(-0.1 * part for part in wave)),
    "TE and TM exchanged": (sum, "coefficients", lambda r: r[::-1]),
    "0.011 rad": (sum, "amplitudes", lambda h: h * np.exp(0.011j)),
    "0.11 dB": (sum, "amplitudes", lambda h: h * 10 ** (0.11 / 20)),
    "nothing hides": (solids.Occlusion, "segments", np.zeros_like),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_fault_is_seen(monkeypatch, case, fault):
    site, link, poses = case
    _wrap(monkeypatch, *FAULTS[fault])
    assert audited(site, link, poses, replay(site, link, poses)).failures


def test_dropped_and_invented_paths_are_seen(case):
    site, link, poses = case
    clean = replay(site, link, poses)
    fewer = replace(clean, contributions=(clean.paths.select(np.arange(len(clean.paths)) % 3 > 0),))
    assert audited(site, link, poses, fewer).missing_paths == len(clean.paths) - len(fewer.paths)
    faces = clean.paths.faces.copy()
    row = int(np.flatnonzero(clean.paths.depth == 1)[0])
    faces[row, 0] = np.flatnonzero(clean.faces.normal[:, 2] == 0)[0]  # over a wall that it does not meet
    moved = replace(clean, contributions=(replace(clean.paths, faces=faces),))
    assert audited(site, link, poses, moved).phantom_paths == 1


def test_boxes_of_faces_lose_no_path_that_a_trial_of_all_sequences_has(case):
    site, link, poses = case
    second_way = reference.Reference(site, "LW1", field_audit.Expected.of(link).link)
    tried = [(), *((m,) for m in second_way.mirrors), *itertools.permutations(second_way.mirrors, 2)]
    for target in map(tuple, poses.position_m[:2].tolist()):
        real = [tuple(map(id, s)) for s in tried if second_way.verdict(s, target) is not False]
        likely = [tuple(map(id, s)) for s in second_way.sequences(target, 2)]
        assert len(real) > 1
        assert set(real) <= set(likely)
        assert len(likely) < len(tried) / 20


def test_audit_of_several_replays_adds_up():
    from aerpaw_cmp.compare.level import FieldAudit

    first = FieldAudit(paths=3, power_rms_db=1.0, power_max_db=2.0, failures=("a",))
    second = FieldAudit(paths=1, power_rms_db=3.0, power_max_db=1.0, failures=("a", "b"))
    both = first + second
    assert (both.paths, both.power_max_db, both.failed) == (4, 2.0, 2)
    assert both.power_rms_db == pytest.approx(np.sqrt((3 * 1 + 9) / 4))

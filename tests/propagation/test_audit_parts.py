"""Parts of the audit: what counts as a missing path, and how explanations say lengths and faces."""

import dataclasses
import re

import numpy as np
import pytest
from shapely import Point

from aerpaw_cmp.compare.level import FieldAudit
from aerpaw_cmp.propagation.check import audit as audit_module
from aerpaw_cmp.propagation.check.audit import (
    Expected,
    Second,
    _another_rank,
    _lacking,
    _level_error,
    _link_error,
    _paths_against_sionna,
    _probe,
    _spread,
    against_sionna,
    impossible,
    spread_over_paths,
)
from aerpaw_cmp.propagation.field.sum import channel_matrices
from aerpaw_cmp.propagation.geometry import (
    Isotropic,
    Link,
    Poses,
    path_lengths,
    rotation_from_yaw_pitch_roll,
    single_element,
)
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.scene import Scene
from aerpaw_cmp.propagation.search.merging import merged
from aerpaw_cmp.propagation.search.sionna import Coefficients
from aerpaw_cmp.site.mitsuba import TriangleScene
from aerpaw_cmp.site.siteyaml import load_site

SITE = load_site("lake_wheeler")
# buildings around LW1 hide its ground reflection from some of these poses
SITE = dataclasses.replace(SITE, buildings=tuple(b for b in SITE.buildings if b.footprint.distance(Point(0, 0)) > 30.0))
LINK = Link(3.3e9, {"LW1": single_element(Isotropic())}, single_element(Isotropic()))
POSES = Poses(np.array([[120.0, 60.0, 40.0]]), np.eye(3)[None])


def test_a_path_that_the_other_engine_alone_has_is_missing_only_where_it_exists() -> None:
    replayed = replay(SITE, LINK, POSES, Search("image", max_depth=1))
    paths = replayed.paths
    assert len(paths) >= 2
    every = np.arange(len(paths))
    missing = _lacking(SITE, replayed, paths, replayed.faces, every, POSES, Expected.of(LINK))
    assert (missing.missing_paths, missing.doubtful) == (len(paths), 0)
    assert missing.failures == (f"{len(paths)} paths of Sionna are missing",)
    # the same paths off walls that look away from the tower: none can exist
    source = SITE.towers["LW1"].position_m
    away = np.flatnonzero(
        (replayed.faces.solid >= 0) & (replayed.faces.normal @ source < replayed.faces.offset_m - 1.0)
    )
    bounced = paths.select(np.flatnonzero(paths.depth == 1)[:1])
    for face in away[:5]:
        phantom = dataclasses.replace(bounced, faces=np.full_like(bounced.faces, face))
        judged = _lacking(SITE, replayed, phantom, replayed.faces, np.array([0]), POSES, Expected.of(LINK))
        assert (judged.missing_paths, judged.doubtful, judged.failures) == (0, 1, ())
    assert len(away) > 5


def test_paths_that_the_other_engine_lacks_are_invented_only_where_none_can_be() -> None:
    replayed = replay(SITE, LINK, POSES, Search("image", max_depth=1))
    every = np.arange(len(replayed.paths))
    assert impossible(SITE, POSES, replayed, every, Expected.of(LINK)).failures == ()
    row = int(np.flatnonzero(replayed.paths.depth == 1)[0])
    source = SITE.towers["LW1"].position_m
    faces = replayed.paths.faces.copy()
    faces[row, 0] = np.flatnonzero(
        (replayed.faces.solid >= 0) & (replayed.faces.normal @ source < replayed.faces.offset_m - 1)
    )[0]
    planted = dataclasses.replace(replayed, contributions=(dataclasses.replace(replayed.paths, faces=faces),))
    audit = impossible(SITE, POSES, planted, every, Expected.of(LINK))
    assert (audit.phantom_paths, audit.failures) == (1, ("1 path that cannot exist",))
    assert impossible(SITE, POSES, planted, np.setdiff1d(every, row), Expected.of(LINK)).phantom_paths == 0


@pytest.mark.parametrize(
    ("planted", "size", "seen"),
    [("nothing", 0.0, ""), ("level", 6.0, "dB"), ("level", 0.05, "dB"), ("level", 0.02, ""), ("phase", 0.3, "rad"),
     ("phase", 0.0101, "rad"), ("phase", 0.0099, ""), ("far phase", 0.3, ""), ("weak entry", 0.0, ""),
     ("one polarisation", 0.02, "dB"), ("ground", 1e-3, "rad"), ("own points", 1e-4, ""), ("own points", 0.01, "dB")],
)  # fmt: skip
def test_coefficients_of_paths_are_compared_as_shares_of_the_strongest(planted: str, size: float, seen: str) -> None:
    """Phases are compared on short paths only.

    The rotation by Sionna's rounded reflection points is allowed, and no more.
    """
    generator = np.random.default_rng(3)
    turns = np.array([rotation_from_yaw_pitch_roll(*generator.uniform(-0.4, 0.4, 3)) for _ in range(4)])
    east, north, _ = SITE.towers["LW1"].position_m
    spots = np.array([[120.0, 60.0, 40.0], [east + 1.5, north - 0.8, 0.6], [-700.0, 300.0, 60.0], [60.0, 10.0, 30.0]])
    few = Poses(spots, turns)
    replayed = replay(dataclasses.replace(SITE, buildings=()), LINK, few, Search("image", max_depth=1))
    probe, left = _probe(LINK)
    assert left == ()
    scene, paths = Scene.of(SITE, probe, few), replayed.paths
    alone = dataclasses.replace(paths, pose=np.arange(len(paths)))
    many = Poses(spots[paths.pose], turns[paths.pose])

    def coefficients(faces):
        return channel_matrices(alone, faces, scene.sources_m, many, probe).h[np.arange(len(paths)), paths.tower]

    own = coefficients(replayed.faces)
    length = path_lengths(paths, scene.sources_m, spots)
    ground = replayed.faces.solid[paths.faces[:, 0]] < 0
    k = int(np.flatnonzero((paths.pose == 1) & (paths.depth == 1) & ground)[0])  # below the tower, near the ground
    gain, points = own.copy(), paths.vertices_m.copy()
    strong = np.unravel_index(np.abs(own[k]).argmax(), (2, 2))
    weak = np.unravel_index(np.abs(own[k]).argmin(), (2, 2))
    power, phase = 0.0, 0.0
    if planted == "level":
        gain[k] *= 10 ** (size / 20)
        power = 20 * np.log10(2.0 - 10 ** (-size / 20))
    elif planted == "phase":
        gain[k] *= np.exp(1j * size)
        phase = size
    elif planted == "far phase":
        gain[length > 300.0] *= np.exp(0.3j)
    elif planted == "weak entry":
        gain[(k, *weak)] *= 1.004
        power = 20 * np.log10(1.0 + 0.004 * abs(own[k][weak] / own[k][strong]))
    elif planted == "one polarisation":
        gain[:, 0] *= 1.0 + size
    elif planted == "ground":
        lower = dataclasses.replace(replayed.faces, offset_m=replayed.faces.offset_m - size)
        gain = coefficients(lower)
    elif planted == "own points":  # beside the way: it turns the plane of incidence by size over some 8 cm
        points[k, 0, :2] += size * np.array([0.8, 1.5]) / 1.7
        turn = size / np.hypot(*(spots[1] - points[k, 0])[:2])
        c, s = np.cos(turn), np.sin(turn)
        gain[k] = np.array([[c, s], [-s, c]]) @ own[k]
    theirs = Coefficients(dataclasses.replace(paths, vertices_m=points), gain, length)
    audit = _paths_against_sionna(paths, replayed, scene, few, probe, theirs, np.array([7, 5, 3, 1]))
    assert (audit.paths, audit.phases) == (len(paths), int((length < 300.0).sum()))
    assert 0 < audit.phases < audit.paths
    if planted not in ("one polarisation", "ground", "own points"):
        assert audit.phase_max_rad == pytest.approx(phase, abs=1e-9)
        assert audit.phase_rms_rad == pytest.approx(phase / np.sqrt(audit.phases), abs=1e-9)
        assert audit.power_max_db == pytest.approx(power, abs=1e-9)
        assert audit.power_rms_db == pytest.approx(power / np.sqrt(len(paths)), abs=1e-9)
    words = " ".join(audit.failures)
    for unit in ("dB", "rad"):
        assert bool(re.search(rf"paths? differing from Sionna by up to \S+ {unit}", words)) == (unit == seen)
    if planted in ("level", "phase") and seen:
        assert f"1 path differing from Sionna by up to {power or phase:.3g} {seen}: worst LW1, pose 5, ground" in words
    if planted in ("nothing", "level"):
        assert ("RSS of a link" in words) == (size == 6.0)


def test_paths_of_the_asked_poses_are_matched_and_those_that_are_lacking_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Sionna is played by the image engine: it has what the replay has, and one path that was taken away there."""
    spots = np.array([[120.0, 60, 40], [40, -90, 25], [60, 10, 30]])
    turn = rotation_from_yaw_pitch_roll(0.3, 0.1, -0.2)
    poses, chosen = Poses(spots, np.tile(turn, (3, 1, 1))), np.array([2, 0])
    link = dataclasses.replace(LINK, tower_arrays={"LW1": dataclasses.replace(LINK.uav_array, mount=turn)})
    search = Search("image", max_depth=1)

    def own(faces, links, probe, turns, rays, *, surfaces) -> Coefficients:
        assert surfaces is None
        assert (rays.max_depth, turns[0].shape) == (1, (1, 3, 3))
        assert np.array_equal(turns[1], poses.rotation[chosen])
        few = Poses(links.targets_m, turns[1])
        paths = replay(SITE, probe, few, search).paths
        every = np.arange(len(paths))
        many = Poses(few.position_m[paths.pose], few.rotation[paths.pose])
        alone = channel_matrices(dataclasses.replace(paths, pose=every), faces, links.sources_m, many, probe)
        length = path_lengths(paths, links.sources_m, links.targets_m)
        return Coefficients(paths, alone.h[every, paths.tower], length)

    monkeypatch.setattr("aerpaw_cmp.propagation.search.sionna.own_coefficients", own)
    clean = replay(SITE, link, poses, search)
    asked = int(np.isin(clean.paths.pose, chosen).sum())
    dropped = int(np.flatnonzero((clean.paths.pose == 2) & (clean.paths.depth == 1))[0])
    fewer = dataclasses.replace(
        clean, contributions=(clean.paths.select(np.setdiff1d(np.arange(len(clean.paths)), dropped)),)
    )
    for replayed, lacking in ((clean, 0), (fewer, 1)):
        audit = against_sionna(SITE, link, poses, replayed, chosen, Expected.of(link), search)
        assert (audit.paths, audit.missing_paths) == (asked - lacking, lacking)
        assert audit.power_max_db < 1e-9
        assert bool(audit.failures) == bool(lacking)
    calls, known, where = [], {}, "aerpaw_cmp.propagation.search.sionna.own_coefficients"
    monkeypatch.setattr(where, lambda *a, **k: calls.append(1) or own(*a, **k))
    for slant in (0.0, 0.35):  # another channel, elsewhere slanted: the answer is the same
        uav = dataclasses.replace(link.uav_array, slant_rad=link.uav_array.slant_rad + slant)
        slanted = dataclasses.replace(link, uav_array=uav)
        replayed, expected = replay(SITE, slanted, poses, search), Expected.of(slanted)
        audit = against_sionna(SITE, slanted, poses, replayed, chosen, expected, search, known=known)
        assert (audit.paths, audit.failures) == (asked, ())
    assert len(calls) == 1


def test_a_link_s_error_is_that_of_its_sum_where_all_paths_are_near_and_none_fades() -> None:
    """Compare five links of two poses and three towers.

    The second has a distant path, the third fades, and the last has no path.
    """
    traced = replay(SITE, LINK, POSES, Search("image", max_depth=1)).paths
    link = np.array([0, 0, 1, 1, 2, 2, 3, 4])
    paths = dataclasses.replace(traced.select(np.zeros(8, dtype=np.int64)), pose=link // 3, tower=link % 3)
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


@pytest.mark.parametrize(("samples", "rays"), [("auto", 100_000), (5_000, 5_000), (300_000, 100_000)])
def test_an_audit_adds_up_its_checks(monkeypatch: pytest.MonkeyPatch, samples: object, rays: int) -> None:
    """The image engine alone, two poses by the second implementation, and the requests to Sionna."""
    spots = np.array([[120.0, 60, 40], [40, -90, 25], [-200, 90, 60], [60, 10, 30], [90, 0, 50]])
    poses, asked = Poses(spots, np.tile(np.eye(3), (5, 1, 1))), []
    search = Search("image", max_depth=1)
    clean = replay(SITE, LINK, poses, search)

    def sionna(*given, **named) -> FieldAudit:
        asked.append((given[4].tolist(), given[6].samples))
        return FieldAudit(paths=7)

    monkeypatch.setattr(audit_module, "against_sionna", sionna)
    second = Second(reference="image", links=3, expected=Expected.of(LINK), reference_links=2)
    wanted = dataclasses.replace(search, samples=samples)
    audit = audit_module.audit(SITE, LINK, poses, clean, wanted, second=second)
    assert (audit.engine, audit.reference, audit.links, audit.missing_paths, audit.extra_paths) == (
        "image",
        "image",
        3,
        0,
        0,
    )
    assert audit.field is not None
    assert (audit.field.paths, audit.field.reference_links, audit.field.failures) == (7, 2, ())
    assert asked == [([0, 2, 4], rays)]
    assert audit.seconds == clean.seconds
    faces, row = clean.paths.faces.copy(), int(np.flatnonzero((clean.paths.depth == 1) & (clean.paths.pose == 2))[0])
    source = SITE.towers["LW1"].position_m
    faces[row, 0] = np.flatnonzero((clean.faces.solid >= 0) & (clean.faces.normal @ source < clean.faces.offset_m - 1))[
        0
    ]
    planted = dataclasses.replace(clean, contributions=(dataclasses.replace(clean.paths, faces=faces),))
    phantom = audit_module.audit(
        SITE, LINK, poses, planted, wanted, second=dataclasses.replace(second, reference_links=0)
    )
    assert phantom.field is not None
    assert (phantom.missing_paths, phantom.extra_paths, phantom.field.phantom_paths) == (1, 1, 1)
    few = replay(SITE, LINK, Poses(spots[::2], np.tile(np.eye(3), (3, 1, 1))), search)
    monkeypatch.setattr(audit_module, "run_replay", lambda *_: few)
    mesh = audit_module.audit(dataclasses.replace(SITE, scene=object()), LINK, poses, planted, wanted, second=second)
    assert mesh.field is not None
    assert (mesh.field.reference_links, mesh.field.phantom_paths, len(mesh.field.not_covered)) == (0, 0, 1)
    bare = audit_module.audit(SITE, LINK, poses, clean, wanted, second=dataclasses.replace(second, expected=None))
    assert bare.field is None


def test_audited_poses_are_spread_or_taken_for_the_kinds_of_their_paths() -> None:
    """By hand: pose 3 has most kinds of paths, pose 1 adds one, pose 0 adds the same one, pose 4 is not used."""
    kinds = {0: [7], 1: [7, 2, 3], 2: [4, 5], 3: [2, 3, 4, 5], 4: [8, 9, 10, 11, 12]}
    some = replay(SITE, LINK, POSES, Search("image", max_depth=1))
    pose, face = np.array([(p, f) for p, several in kinds.items() for f in several]).T
    rows = some.paths.select(np.zeros(len(pose), dtype=np.int64))
    paths = dataclasses.replace(rows, pose=pose, faces=face[:, None])
    many = dataclasses.replace(some, contributions=(paths,))
    for count, expected in ((1, [3]), (2, [1, 3]), (3, [1, 2, 3]), (4, [2, 0, 1, 3]), (9, [2, 0, 1, 3])):
        assert spread_over_paths(many, np.array([2, 0, 1, 3]), count).tolist() == expected
    places = np.full((7, 3), 5.0)
    places[2] = np.nan
    poses = Poses(places, np.tile(np.eye(3), (7, 1, 1)))
    for count, expected in ((None, [0, 1, 3, 4, 5, 6]), (6, [0, 1, 3, 4, 5, 6]), (3, [0, 3, 6]), (1, [0])):
        assert _spread(poses, count).tolist() == expected


@pytest.mark.parametrize(
    ("level", "power", "size", "expected"),
    [
        (np.nan, 0.0, 1e-5, 0.0), (-90.0, 0.0, 1e-5, np.inf), (np.nan, 1e-12, 1e-5, np.inf),  # covered by one alone
        (-80.0, 1e-12, 1e-6, 0.0), (-77.0, 1e-12, 1e-6, 3.0), (-83.5, 1e-12, 1e-6, 3.5),  # 40 dBm sent
        (-80.0, 1e-29, 1e-5, 0.0), (np.nan, 1e-29, 1e-5, 0.0), (-77.0, 1e-12, 1.0, 0.0),  # in a fade rounding is all
        (-77.0, 1e-12, 1e-2, 3.0 - 0.08686),
    ],
)  # fmt: skip
def test_levels_differ_beyond_rounding(level: float, power: float, size: float, expected: float) -> None:
    assert _level_error(level, power, 40.0, size) == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize(
    ("ours", "expected", "differs"),
    [
        ((1.0, 0.5), (1.0, 0.5), False), ((1.0, 0.05), (1.0, 0.5), True), ((1.0, 0.5), (1.0, 0.005), True),
        ((1.0, 0.00999), (1.0, 0.01), False), ((1.0, 0.0098), (1.0, 0.0102), True),  # within 1e-4 of 1 / 100
        ((1.0, 0.0), (0.0, 0.0), True), ((0.0, 0.0), (0.0, 0.0), False),
    ],
)  # fmt: skip
def test_ranks_differ_where_no_singular_value_lies_at_the_limit(ours, expected, differs: bool) -> None:
    assert _another_rank(np.diag(ours).astype(complex), np.diag(expected).astype(complex), (10.0, 100.0)) is differs


def test_faces_are_counted_within_their_shape() -> None:
    shapes = np.array([0, 0, 1, 0, 1])
    apart = np.array([[[0.0, 0, 10 * i], [1, 0, 10 * i], [0, 1, 10 * i]] for i in range(len(shapes))])
    scene = TriangleScene(
        apart.reshape(-1, 3), np.arange(15).reshape(-1, 3), shapes, ("hall", "shed"), ("wood", "metal")
    )
    faces = merged(scene).faces
    expected = {0: ("hall face 1", "wood"), 10: ("hall face 2", "wood"), 20: ("shed face 1", "metal")}
    expected |= {30: ("hall face 3", "wood"), 40: ("shed face 2", "metal")}
    assert dict(zip(faces.offset_m, zip(faces.label, faces.material, strict=True), strict=True)) == expected

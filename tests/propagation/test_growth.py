"""The search among open surfaces: against enumeration of triangles, against the prism engine, in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from shapely.geometry import box

pytest.importorskip("numba", reason="numba is not installed (extra 'fast')")

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.jobs.site_scene import export_scene
from aerpaw_cmp.propagation.check.explain import why_not
from aerpaw_cmp.propagation.geometry import Links
from aerpaw_cmp.propagation.options import Run, Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.scene import Scene
from aerpaw_cmp.propagation.search import beams as prisms
from aerpaw_cmp.propagation.search import mirror as image
from aerpaw_cmp.propagation.search.beams import grow_paths, reflection_points
from aerpaw_cmp.propagation.search.merging import merged
from aerpaw_cmp.site.mitsuba import read_scene
from aerpaw_cmp.site.scenes import placed_scene
from aerpaw_cmp.site.site import Building
from tests.propagation import open_surfaces as enumerate_


def quad(corner, side, height):
    corner, side, height = (np.asarray(v, dtype=float) for v in (corner, side, height))
    return [[corner, corner + side, corner + side + height], [corner, corner + side + height, corner + height]]


@pytest.mark.parametrize("seed", range(4))
def test_tilted_overlapping_open_quads_against_enumeration(seed):
    rng = np.random.default_rng(seed)
    triangles, shapes = quad((-40, -40, -8), (80, 0, 0), (0, 80, 0)), [20, 20]
    for k in range(8):
        corner, side = rng.uniform(-20, 20, 3), 8 * rng.normal(size=3)
        height = np.cross(side, rng.normal(size=3))
        height *= 8 / np.linalg.norm(height)
        triangles += quad(corner, side, height)
        shapes += [k, k]
        if k % 3 == 0:  # another shape that overlaps in the same plane
            triangles += quad(corner + 0.3 * side + 0.2 * height, side, height)
            shapes += [8 + k, 8 + k]
    scene = enumerate_.scene_of(triangles, shapes=shapes)
    sources, targets = rng.uniform(-15, 15, (2, 3)), rng.uniform(-15, 15, (6, 3))
    expected = enumerate_.paths(scene.vertices_m[scene.triangles], sources, targets, 2)
    assert sum(len(v) for v in expected.values()) > 6
    paths = grow_paths(merged(scene), Links(sources, targets), max_depth=2)
    assert enumerate_.compare(paths, expected) == (0, 0)


@pytest.mark.parametrize(("name", "middle", "count"), [("munich", (8, 21), 200), ("florence", (0, 0), 200)])
def test_cropped_scenes_against_enumeration(name, middle, count):
    scene = read_scene(enumerate_.shipped(name))
    corners = scene.vertices_m[scene.triangles]
    near = np.argsort(np.linalg.norm(corners.mean(axis=1)[:, :2] - middle, axis=1))[:count]
    crop = replace(scene, triangles=scene.triangles[near], shape=scene.shape[near])
    rng = np.random.default_rng(1)
    source = np.array([[*middle, 30.0]])
    targets = np.column_stack([rng.uniform(-40, 40, (8, 2)) + middle, rng.uniform(1.5, 40, 8)])
    expected = enumerate_.paths(corners[near], source, targets, 2)
    paths = grow_paths(merged(crop), Links(source, targets), max_depth=2)
    assert enumerate_.compare(paths, expected) == (0, 0)


def cells(*open_cells):
    """The square of the plane east = 5 between -5 and 5, cut at -1 and 1 so that corners meet, without some cells."""
    cuts = (-5, -1, 1, 5)
    some = [(i, j) for i in range(3) for j in range(3) if (i, j) not in open_cells]
    return [
        t
        for i, j in some
        for t in quad((5, cuts[i], cuts[j]), (0, cuts[i + 1] - cuts[i], 0), (0, 0, cuts[j + 1] - cuts[j]))
    ]


OCCLUDERS = {"a square": cells(), "an L": cells((1, 1), (1, 2), (2, 1), (2, 2)), "a frame": cells((1, 1))}


@pytest.mark.parametrize("name", OCCLUDERS)
def test_a_mirror_is_seen_past_a_face_with_hollows(name):
    """A mirror is seen through the notch of an L and the hole of a frame: the outline alone would hide it wholly."""
    mirror = quad((10, -0.6, -0.6), (0, 1.6, 0), (0, 0, 1.6))
    occluder = OCCLUDERS[name]
    scene = enumerate_.scene_of([*occluder, *mirror], shapes=[0] * len(occluder) + [1, 1])
    surfaces, ends = merged(scene), (np.array([[0.0, 0, 0]]), np.array([[0.0, 0.5, 0.5]]))
    assert len(surfaces) == 2
    paths = grow_paths(surfaces, Links(*ends), max_depth=1)
    if name == "a square":  # itself a mirror, at (5, 1/4, 1/4), which hides the one behind it
        assert [p[0].round(9).tolist() for p in paths.vertices_m[1:]] == [[5.0, 0.25, 0.25]]
    else:
        assert [p[0].round(9).tolist() for p in paths.vertices_m[1:]] == [[10.0, 0.25, 0.25]]


def test_a_square_behind_a_mirror_hides_nothing_before_it():
    """Seen from the source's image at (20, 0, 0), the square at 15 hides the mirror at -5, but blocks no path."""
    squares = [
        quad((east, -half, -half), (0, 2 * half, 0), (0, 0, 2 * half)) for east, half in ((10, 3), (-5, 3), (15, 20))
    ]
    surfaces = merged(enumerate_.scene_of([t for square in squares for t in square]))
    ends = Links(np.array([[0.0, 0, 0]]), np.array([[2.0, 1.0, 0.5]]))
    paths = grow_paths(surfaces, ends, max_depth=3)
    assert np.bincount(paths.depth).tolist() == [1, 2, 2, 2]


def test_a_mirror_works_on_both_sides_and_hides_from_both():
    wall = enumerate_.scene_of(quad((0, -50, -50), (0, 100, 0), (0, 0, 100)))
    for side in (1.0, -1.0):
        source, targets = np.array([[3.0 * side, 0, 0]]), np.array([[5.0 * side, 4.0, 2.0], [-5.0 * side, 4.0, 2.0]])
        paths = grow_paths(merged(wall), Links(source, targets), max_depth=1)
        assert paths.pose.tolist() == [0, 0]
        assert paths.depth.tolist() == [0, 1]
        # the image of the source is at -3: the line to (5, 4, 2) crosses the wall at 3/8 of its way
        assert paths.vertices_m[1, 0] == pytest.approx([0.0, 4.0 * 3 / 8, 2.0 * 3 / 8])


def test_coincident_faces_give_one_path():
    sheet = quad((-9, -9, 0), (18, 0, 0), (0, 18, 0))
    again = quad((-5, -5, 0), (12, 0, 0), (0, 12, 0))  # overlaps, in the same plane, of another shape
    close = quad((-9, -9, -0.0004), (18, 0, 0), (0, 18, 0))  # the back of a double face
    scene = enumerate_.scene_of([*sheet, *again, *close], shapes=[0, 0, 1, 1, 2, 2])
    paths = grow_paths(merged(scene), Links(np.array([[0, 0, 3.0]]), np.array([[2.0, 1, 4]])), max_depth=2)
    assert paths.depth.tolist() == [0, 1]


def test_triangles_within_the_tolerance_are_one_face_and_others_are_not():
    for bend_m, faces in ((0.0005, 1), (0.005, 2)):
        flat = np.array([[[0, 0, 0], [9, 0, 0], [9, 9, 0]], [[0, 0, 0], [9, 9, 0], [0, 9, bend_m]]], dtype=float)
        assert len(merged(enumerate_.scene_of(flat))) == faces


def test_flipped_and_degenerate_triangles_change_nothing():
    sheet = np.array(quad((-9, -9, 0), (18, 0, 0), (0, 18, 0)))
    flipped = sheet.copy()
    flipped[1] = flipped[1][::-1]
    needle = np.array([[[0, 0, 1], [1, 0, 1], [2, 0, 1]]], dtype=float)
    ends = np.array([[0, 0, 3.0]]), np.array([[2.0, 1, 4]])
    expected = grow_paths(merged(enumerate_.scene_of(sheet)), Links(*ends), max_depth=2)
    surfaces = merged(enumerate_.scene_of(np.concatenate([flipped, needle])))
    assert surfaces.notes == ("1 triangle was dropped: no area",)
    paths = grow_paths(surfaces, Links(*ends), max_depth=2)
    assert np.allclose(paths.vertices_m, expected.vertices_m, equal_nan=True)


def town(rng, count, half_m):
    spot = rng.uniform(-half_m, half_m, (count, 2))
    return [Building(f"b{k}", box(e, n, e + 14, n + 11), float(rng.uniform(5, 15))) for k, (e, n) in enumerate(spot)]


def test_paths_can_be_recomputed_from_their_faces():
    scene = read_scene(enumerate_.shipped("simple_street_canyon"))
    surfaces = merged(scene)
    rng = np.random.default_rng(6)
    source = np.array([[-20.0, 0.0, 20.0]])
    targets = np.column_stack([rng.uniform(-40, 40, 30), rng.uniform(-8, 8, 30), rng.uniform(1, 30, 30)])
    paths = grow_paths(surfaces, Links(source, targets), max_depth=2)
    rows = np.flatnonzero(paths.depth == 2)
    assert len(rows) > 10
    ends = source[paths.tower[rows]], targets[paths.pose[rows]]
    faces, points, good = reflection_points(surfaces, paths.faces[rows], *ends, edge_m=1e-6)
    assert good.all()
    assert np.array_equal(faces, paths.faces[rows])
    assert np.abs(points - paths.vertices_m[rows]).max() < 1e-9


def test_a_site_of_prisms_as_a_scene_has_the_paths_of_the_prism_engine(scenes, tmp_path):
    """Two engines that share no code: closed prisms of site.yaml, and their triangles out and in again."""
    rng = np.random.default_rng(8)
    buildings = tuple(
        Building(f"b{k}", box(e - 7, n - 5, e + 6, n + 8), float(rng.uniform(6, 20)), material="concrete")
        for k, (e, n) in enumerate([(30, 30), (-35, 20), (20, -40), (-30, -30), (60, 0)])
    )
    site = scenes.site(buildings, ((0.0, 0.0, 10.0),), area_m=(-200.0, 200.0, -200.0, 200.0))
    poses = scenes.poses(rng.uniform([-90, -90, 1], [90, 90, 40], (60, 3)))
    prisms = replay(site, scenes.link(site), poses, Search(max_depth=2))
    export_scene(site, tmp_path)
    open_site = replace(site, buildings=(), scene=placed_scene(tmp_path / "scene.xml"))
    surfaces = replay(open_site, scenes.link(open_site), poses, Search(max_depth=2))
    outside = ~Scene.of(site, scenes.link(site), poses).excluded[0]
    counts = [np.bincount(r.paths.pose, minlength=60)[outside] for r in (prisms, surfaces)]
    assert prisms.paths.depth.max() == 2
    assert np.array_equal(*counts)
    assert np.nanmax(np.abs(prisms.rss_dbm - surfaces.rss_dbm)[outside]) < 1e-3  # float32 vertices


def test_prisms_by_beams_have_the_paths_of_the_image_engine(scenes):
    """Draw random prisms with holes. tests/propagation/test_compiled.py has walls that touch and ends on faces."""
    rng = np.random.default_rng(11)
    spots = rng.uniform([-120, -120, 0], [120, 120, 40], (60, 3))
    site = scenes.site(scenes.buildings(rng, 8, spread_m=90.0, holes=True), ((0.0, -20.0, 10.0), (3.0, -5.0, 25.0)))
    scene, poses = Scene.of(site, scenes.link(site), scenes.poses(spots)), scenes.poses(spots)
    expected = image.find_paths(scene.faces, scene.links_to(poses), max_depth=2)
    paths = prisms.find_paths(scene.faces, scene.links_to(poses), max_depth=2)
    assert len(expected) > 100
    assert np.array_equal(paths.faces, expected.faces)
    assert np.array_equal(paths.pose, expected.pose)


def test_a_thousand_buildings_are_searched_not_refused(scenes):
    rng = np.random.default_rng(12)
    site = scenes.site(town(rng, 1000, 1500), ((0.0, 0.0, 30.0),))
    result = replay(site, scenes.link(site), scenes.poses(rng.uniform([-200, -200, 20], [200, 200, 60], (20, 3))))
    assert (result.paths.depth == 2).sum() > 10


def first_met(surfaces, source, spot):
    """Return the label of the first surface on a straight line, by the planes of all triangles.

    Return None if there is none.
    """
    corner = surfaces.corners_m
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    before, after = (((end - corner[:, 0]) * normal).sum(axis=1) for end in (source, spot))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = before / (before - after)
    rows = np.flatnonzero((share > 0) & (share < 1))
    rows = rows[enumerate_._inside(corner[rows], normal[rows], source + share[rows, None] * (spot - source))]
    return surfaces.faces.label[surfaces.face[rows[share[rows].argmin()]]] if len(rows) else None


def test_what_hides_a_path_is_named(scenes):
    """Lines of sight and paths of the canyon."""
    site = scenes.site((), ((-20.0, 0.0, 20.0),), scene=placed_scene(enumerate_.shipped("simple_street_canyon")))
    rng = np.random.default_rng(14)
    spots = np.column_stack([rng.uniform(-60, 60, 40), rng.uniform(-40, 40, 40), rng.uniform(1, 30, 40)])
    replayed = replay(site, scenes.link(site), scenes.poses(spots))
    source, none = np.array([-20.0, 0.0, 20.0]), np.zeros(0, dtype=np.int64)
    direct = set(replayed.paths.pose[replayed.paths.depth == 0].tolist())
    for pose, spot in enumerate(spots):
        label = first_met(replayed.surfaces, source, spot)
        assert (label is None) == (pose in direct)
        assert why_not(replayed.faces, source, spot, none, replayed.surfaces) == (
            "" if label is None else f"occluded by {label}"
        )
    for row in np.flatnonzero(replayed.paths.depth)[:40]:
        spot, faces = spots[replayed.paths.pose[row]], replayed.paths.faces[row]
        assert why_not(replayed.faces, source, spot, faces, replayed.surfaces) == ""
    other = np.array([int(replayed.paths.faces[replayed.paths.depth == 1][0, 0])])
    reasons = {why_not(replayed.faces, source, spot, other, replayed.surfaces) for spot in spots}
    assert len(reasons) >= 3


def test_what_a_scene_cannot_do_is_said(scenes, tmp_path):
    scene = placed_scene(enumerate_.shipped("simple_street_canyon"))
    site = scenes.site((), ((0.0, 0.0, 20.0),), scene=scene)
    with pytest.raises(UsageError, match="max_depth 4"):
        grow_paths(merged(scene), Links(np.zeros((1, 3)), np.zeros((1, 3))), max_depth=4)
    assert replay(site, scenes.link(site), scenes.poses([[5.0, 2.0, 1.5]])).paths.depth.max() == 2


@pytest.mark.sionna
def test_every_path_of_pathsolver_is_found(scenes, sionna):
    """PathSolver on the same triangles: nothing of it is missing, and nothing is found twice."""
    rng = np.random.default_rng(9)
    site = scenes.site((), ((-20.0, 0.0, 20.0),), scene=placed_scene(enumerate_.shipped("simple_street_canyon")))
    spots = np.column_stack([rng.uniform(-40, 40, 25), rng.uniform(-8, 8, 25), rng.uniform(1, 30, 25)])
    poses, link = scenes.poses(spots), scenes.link(site)
    ours = replay(site, link, poses).paths
    theirs = replay(site, link, poses, Search("sionna", samples=100_000, batch=25), run=Run(cache_dir="")).paths
    keys = [{(p, *f) for p, f in zip(x.pose.tolist(), x.faces.tolist(), strict=True)} for x in (ours, theirs)]
    assert keys[1] <= keys[0]
    assert len(keys[1]) >= 0.97 * len(keys[0])

"""Bounces off opaque crowns: closed forms, one-by-one enumeration by another code, reciprocity, and what stops them."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from shapely.geometry import box

from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.propagation.arrays import Array
from aerpaw_cmp.propagation.check.audit import Second, audit
from aerpaw_cmp.propagation.drivers.parts import replay_in_parts
from aerpaw_cmp.propagation.field.foliage import P833, CrownIndex, NoFoliage, Opaque, foliage_loss_db
from aerpaw_cmp.propagation.field.sum import channel_matrices
from aerpaw_cmp.propagation.options import Field, Run, Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.search.crowns import FACES_PER_CROWN, Crowns
from aerpaw_cmp.site.antennas import Isotropic
from aerpaw_cmp.site.dem import Dem
from aerpaw_cmp.site.materials import VEGETATION
from aerpaw_cmp.site.meshes import CROWN_SIDES, site_meshes
from aerpaw_cmp.site.site import Building, Trees

APOTHEM = np.cos(np.pi / CROWN_SIDES)


def trees(*rows):
    """Trees of east, north, ground, height, crown diameter, crown base; trunks of 0.4 m."""
    table = np.array(rows, dtype=float).reshape(-1, 6)
    return Trees(*table.T, np.full(len(table), 0.4))


def random_trees(rng, count, spread_m=120.0):
    return trees(*np.column_stack([
        rng.uniform(-spread_m, spread_m, (count, 2)), rng.uniform(-1, 1, count), rng.uniform(10, 25, count),
        rng.uniform(5, 12, count), rng.uniform(2, 6, count),
    ]).tolist())  # fmt: skip


def opaque(crowns):
    def loss(paths, sources, targets):
        ends = sources[paths.tower], paths.vertices_m, targets[paths.pose]
        return foliage_loss_db(*ends, crowns.index, Opaque(), paths.tree)

    return loss


def opaque_replay(scenes, site, position, array=None, **settings):
    crowns = Crowns(site.trees)
    poses = scenes.poses(position)
    search = Search(crowns=crowns, **settings)
    return replay(site, scenes.link(site, array, array), poses, search, Field(loss=opaque(crowns)))


def bounces(scenes, site, position, **settings):
    """The paths off crowns of a replay, as (label of the faces in order) per path."""
    replayed = opaque_replay(scenes, site, position, **settings)
    off = replayed.paths.select(replayed.paths.off_crown)
    return [tuple(replayed.faces.label[f] for f in faces if f >= 0) for faces in off.faces], off


# ---------------------------------------------------------------- closed forms


def mirror_geometry(height, diameter, base, east):
    """Facet at azimuth 180 + 22.5 degrees of a crown at (east, 0): a point on it, and its outward normal."""
    azimuth = np.pi + np.pi / CROWN_SIDES
    apothem, rise = diameter / 2 * APOTHEM, height - base
    normal = np.array([rise * np.cos(azimuth), rise * np.sin(azimuth), apothem]) / np.hypot(rise, apothem)
    middle = np.array([
        east + 0.4 * apothem * np.cos(azimuth), 0.4 * apothem * np.sin(azimuth), height - 0.4 * rise
    ])  # fmt: skip
    return middle, normal


@pytest.mark.parametrize("slant_deg", [0.0, 90.0, 30.0])
@pytest.mark.parametrize("turn", [0.2, 0.7, 1.3])
def test_one_bounce_has_the_length_and_the_fresnel_amplitude_of_the_closed_form(scenes, slant_deg, turn):
    point, normal = mirror_geometry(20.0, 10.0, 5.0, 100.0)
    across = np.cross(normal, [0, 0, 1.0])
    across /= np.linalg.norm(across)
    up = np.cross(across, normal)
    # rays at an angle of incidence `turn` in a slanted plane of incidence, 90 m and 70 m long
    tangent = np.cos(0.2) * across + np.sin(0.2) * up
    source = point + 90.0 * (np.cos(turn) * normal + np.sin(turn) * tangent)
    target = point + 70.0 * (np.cos(turn) * normal - np.sin(turn) * tangent)
    site = scenes.site(towers=(tuple(source),), trees=trees((100, 0, 0, 20, 10, 5)))
    element = Array(np.zeros((1, 3)), np.radians([slant_deg]), (Isotropic(),))
    replayed = opaque_replay(scenes, site, target, element, max_depth=1)
    bounce = replayed.paths.select(replayed.paths.off_crown)
    assert replayed.left_out == []
    assert len(bounce) == 1
    np.testing.assert_allclose(bounce.vertices_m[0, 0], point, atol=1e-9)
    assert replayed.faces.label[bounce.faces[0, 0]] == "crown 1 side 5"
    np.testing.assert_allclose(replayed.faces.normal[bounce.faces[0, 0]], normal, atol=1e-12)
    link, pose = scenes.link(site, element, element), scenes.poses(target)
    alone = channel_matrices(bounce, replayed.faces, source[None], pose, link).h[0, 0, 0, 0]
    # field in TE and TM components, by hand
    eta = VEGETATION.relative_permittivity(scenes.carrier_hz)
    cosine, root = np.cos(turn), np.sqrt(eta - np.sin(turn) ** 2)
    te, tm = (cosine - root) / (cosine + root), (eta * cosine - root) / (eta * cosine + root)
    before, after = (point - source) / 90.0, (target - point) / 70.0
    s = np.cross(before, normal)
    s /= np.linalg.norm(s)
    sent, received = polarisation(before, slant_deg), polarisation(-after, slant_deg)
    wave = te * (sent @ s) * s + tm * (sent @ np.cross(before, s)) * np.cross(after, s)
    wavelength = wavelength_m(scenes.carrier_hz)
    expected = received @ wave * wavelength / (4 * np.pi * 160.0) * np.exp(-2j * np.pi * 160.0 / wavelength)
    assert alone == pytest.approx(expected, rel=1e-6, abs=1e-9 * abs(expected) + 1e-15)


def polarisation(direction, slant_deg):
    """Vector field of an isotropic element with a slant, towards a direction: theta turned to phi."""
    theta, phi = np.arccos(direction[2]), np.arctan2(direction[1], direction[0])
    e_theta = np.array([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)])
    e_phi = np.array([-np.sin(phi), np.cos(phi), 0.0])
    slant = np.radians(slant_deg)
    return np.cos(slant) * e_theta + np.sin(slant) * e_phi


# ---------------------------------------------------------------- every path, by another code


def triangles_of(site):
    """Triangles of the exported crowns (trees, triangles, 3, 3): sides and the fan of the bottom."""
    mesh = site_meshes(site)["vegetation"]
    return mesh.vertices_m[mesh.triangles].reshape(len(site.trees), -1, 3, 3)


def woods_of(site):
    """The crowns without each tree in turn, then those of all; and the trunks."""
    rows = np.arange(len(site.trees))
    stands = [Trees(*(getattr(site.trees, name)[rows != tree] for name in Trees.__slots__)) for tree in rows]
    return [CrownIndex(stand) for stand in (*stands, site.trees)], CrownIndex(site.trees).trunks()


def blocked(site, woods, tree, points, crown_step, covered):
    """Whether trees or buildings stop a polyline; the tree at vertex ``crown_step`` is taken out of the wood there."""
    stands, trunks = woods
    for step, (a, b) in enumerate(itertools.pairwise(points)):
        some = stands[tree if step in (crown_step, crown_step + 1) else -1]
        if some.chords_m(a[None], b[None])[0] > 0:
            return True
        if trunks.chords_m(a[None], b[None])[0] > 0 or covered(site, a, b):
            return True
    return False


def one_by_one(site, woods, source, target, max_depth, covered):
    """Crown bounces of one link as {(kind, tree, rounded point)}: every triangle, barycentric coordinates."""
    bounced = set()
    down, solids = np.array([1.0, 1.0, -1.0]), triangles_of(site)
    for before, after in itertools.product((False, True), repeat=2):
        if 1 + before + after > max_depth:
            continue
        start, end = (source * down if before else source), (target * down if after else target)
        # every triangle of every crown at once: its plane's image of the start, and where the line from there cuts it
        a, b, c = np.moveaxis(solids, 2, 0)
        n = np.cross(b - a, c - a)
        fore, aft = (((end_point - a) * n).sum(axis=-1) for end_point in (start, end))
        image = start - 2 * (fore / (n * n).sum(axis=-1))[..., None] * n
        edges = np.stack([b - a, c - a, image - end], axis=-1)
        ahead = (fore > 0) & (aft > 0)
        weights = np.full(n.shape, -1.0)
        weights[ahead] = np.linalg.solve(edges[ahead], (image - a)[ahead][..., None])[..., 0]
        inside = (weights[..., 0] >= 0) & (weights[..., 1] >= 0) & (weights[..., 0] + weights[..., 1] <= 1)
        for tree, side in np.argwhere(inside):
            point = image[tree, side] + weights[tree, side, 2] * (end - image[tree, side])
            if point[2] <= 0 and (before or after):
                continue
            points = [source, point, target]
            if after:
                points.insert(2, point + point[2] / (point[2] - end[2]) * (end - point))
            if before:
                points.insert(1, start + start[2] / (start[2] - point[2]) * (point - start))
            if not blocked(site, woods, tree, points, int(before), covered):
                bounced.add((before, after, int(tree), *np.round(point, 5)))
    return bounced


def aimed_positions(rng, site, source, count):
    """Poses on the way of rays that were reflected somewhere on the crowns, some of them first or last at the ground."""
    solid = triangles_of(site)
    positions = []
    while len(positions) < count:
        a, b, c = solid[rng.integers(len(solid)), rng.integers(solid.shape[1])]
        start = source * [1, 1, rng.choice([1, -1])]
        point = rng.dirichlet([1, 1, 1]) @ np.array([a, b, c])
        n = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
        ray = point - start
        if n @ ray >= 0:
            continue
        place = point + rng.uniform(0.1, 1.5) * (ray - 2 * (n @ ray) * n)
        place[2] = abs(place[2])
        if 1.0 < place[2] < 150:
            positions.append(place)
    return np.array(positions)


@pytest.mark.parametrize(
    ("seed", "height", "kind"), [(1, 10.0, (True, False)), (2, 60.0, (False, True)), (3, 1.5, (True, True))]
)
def test_every_bounce_is_found_and_none_is_invented(scenes, seed, height, kind):
    rng = np.random.default_rng(seed)
    site = scenes.site(
        (Building("barn", box(20, 20, 45, 40), 9.0), Building("shed", box(-60, -20, -50, -5), 6.0)),
        trees=random_trees(rng, 30), towers=((0.0, 0.0, height),),
    )  # fmt: skip
    source = site.towers["LW1"].position_m
    position = np.concatenate([
        np.column_stack([rng.uniform(-150, 150, (15, 2)), rng.uniform(2, 90, 15)]),
        aimed_positions(rng, site, source, 35),
    ])  # fmt: skip
    replayed = opaque_replay(scenes, site, position, max_depth=3)
    assert replayed.left_out == ["paths over a crown and a building, or over two crowns"]
    off = replayed.paths.select(replayed.paths.off_crown)
    ground = replayed.faces.label.index("ground")
    ours = [set() for _ in position]
    for pose, faces, vertices, tree in zip(off.pose, off.faces, off.vertices_m, off.tree, strict=True):
        at = int(np.flatnonzero(tree >= 0)[0])
        ours[pose].add((at == 1, at + 1 < 3 and faces[at + 1] == ground, tree[at], *np.round(vertices[at], 5)))
    woods = woods_of(site)
    theirs = [one_by_one(site, woods, source, target, 3, scenes.covered) for target in position]
    assert ours == theirs
    assert len(off) == sum(map(len, theirs)) > 15
    assert {key[:2] for keys in theirs for key in keys} >= {(False, False), kind}


def test_thinning_out_loses_nothing_in_a_wood(scenes):
    # without blocking, so that all specular points count: all facets against all poses, from the plane equations
    from aerpaw_cmp.propagation.search import crowns as module

    rng = np.random.default_rng(5)
    wood = Crowns(random_trees(rng, 60))
    source = np.array([3.0, -4.0, 10.0])
    position = np.column_stack([rng.uniform(-200, 200, (500, 2)), rng.uniform(1, 120, 500)])
    total = 0
    for facets in wood._families:
        beams = module._Beams.of(facets, source, 1e-9)
        facet, target, point = module._single_bounces(facets, beams, position, 1e-9)
        corners = facets.corners_m[:, None]
        height = (facets.normal @ source - facets.offset_m)[:, None]
        ahead = facets.normal @ position.T - facets.offset_m[:, None]
        image = source - 2 * height * facets.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (height / (height + ahead))[..., None]
        place = image[:, None] + share * (position[None] - image[:, None])
        edge = np.roll(corners, -1, axis=2) - corners
        turn = np.cross(edge, place[:, :, None] - corners) @ facets.normal[:, None, :, None]
        inside = (turn[..., 0] >= 0).all(axis=2) & (height > 0) & (ahead > 0)
        assert set(zip(facet.tolist(), target.tolist(), strict=True)) == set(
            zip(*map(list, np.nonzero(inside)), strict=True)
        )
        np.testing.assert_allclose(point, place[facet, target], atol=1e-9)
        total += len(facet)
    assert total > 100


def test_thinning_out_loses_no_pose_close_to_its_facet(scenes):
    # one pose at a time, between base and tip of the crown: the facet itself bounds what is lit
    from aerpaw_cmp.propagation.search import crowns as module

    rng = np.random.default_rng(6)
    stand = random_trees(rng, 20)
    sides = triangles_of(scenes.site(trees=stand))[:, :CROWN_SIDES].reshape(-1, 3, 3)
    facets, source = Crowns(stand)._families[0], np.array([3.0, -4.0, 10.0])
    beams, tried = module._Beams.of(facets, source, 1e-9), 0
    for number in beams.facet:
        corners, n = sides[number], facets.normal[number]
        share = rng.dirichlet([0.5, 0.5, 0.5])
        if tried % 2:  # a hair inside an edge
            share = rng.permutation([1e-6, share[0], 1 - 1e-6 - share[0]])
        point = share @ corners
        ray = point - source
        pose = point + rng.choice([1e-3, 0.05]) * (ray - 2 * (n @ ray) * n)
        for few in (pose[None], np.stack([pose, pose + 1e-5])):  # looked up in rectangles, and tried one by one
            facet, target, points = module._single_bounces(facets, beams, few, 1e-9)
            mine = (facet == number) & (target == 0)
            np.testing.assert_allclose(points[mine], point[None], atol=1e-6)
        tried += 1
    assert tried > 60


# ---------------------------------------------------------------- physics


def crown_and_ends(scenes, rng):
    """One tree and two ends that see a bounce off a side of it."""
    stand = trees((0, 0, 0, *rng.uniform([15, 5], [25, 12]), rng.uniform(2, 6)))
    a, b, c = triangles_of(scenes.site(trees=stand))[0, rng.integers(CROWN_SIDES)]
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n)
    point = rng.dirichlet([2, 2, 2]) @ np.array([a, b, c])
    ray = rng.normal(size=3)
    ray = ray - min(n @ ray, 0) * 2 * n  # outwards
    ray /= np.linalg.norm(ray)
    reflected = 2 * (n @ ray) * n - ray
    return stand, point, n, point + rng.uniform(20, 300) * ray, point + rng.uniform(20, 300) * reflected


@given(st.integers(0, 10_000))
def test_law_of_reflection_and_reciprocity(scenes, seed):
    stand, point, normal, near, far = crown_and_ends(scenes, np.random.default_rng(seed))
    assume(min(near[2], far[2]) >= 1.0 and abs(normal @ (near - point)) >= 0.1)
    element = Array(np.zeros((1, 3)), np.radians([37.0]), (Isotropic(),))
    amplitude = []
    for source, target in ((near, far), (far, near)):
        site = scenes.site(towers=(tuple(source),), trees=stand)
        replayed = opaque_replay(scenes, site, target, element)
        off = replayed.paths.select(replayed.paths.off_crown)
        direct = off.select(off.depth == 1)
        assert len(direct) == 1
        vertex, n = direct.vertices_m[0, 0], replayed.faces.normal[direct.faces[0, 0]]
        np.testing.assert_allclose(vertex, point, atol=1e-6)
        into, out = vertex - source, target - vertex
        into, out = into / np.linalg.norm(into), out / np.linalg.norm(out)
        np.testing.assert_allclose(into - 2 * (n @ into) * n, out, atol=1e-7)
        link, pose = scenes.link(site, element, element), scenes.poses(target)
        amplitude.append(channel_matrices(off, replayed.faces, source[None], pose, link).h[0, 0, 0, 0])
    assert amplitude[0] == pytest.approx(amplitude[1], rel=1e-6)


BOUNCE, NORMAL = mirror_geometry(20.0, 10.0, 5.0, 100.0)
# Ends that see each other over side 5 of a crown at (100, 0): its normal points west and up.
ENDS = tuple(
    BOUNCE + length * (NORMAL + side * np.array([-NORMAL[1], NORMAL[0], 0.0]))
    for length, side in ((40, 0.5), (50, -0.5))
)


def middle(a, b, share=0.5):
    return a + share * (b - a)


@pytest.mark.parametrize(
    ("stand", "count"),
    [
        ([], 1),  # the crown itself does not hide its own bounce, though the facet lies inside the round cone
        ([(*middle(ENDS[0], BOUNCE)[:2], 0, 60, 8, 2)], 0),  # another crown, before the bounce
        ([(*middle(BOUNCE, ENDS[1])[:2], 0, 60, 8, 2)], 0),  # and after it
        ([(*middle(BOUNCE, ENDS[1])[:2], 0, 61, 8, 60)], 0),  # a trunk
        ([(*middle(BOUNCE, ENDS[1])[:2], 0, 8, 8, 2)], 1),  # a bush below the path
        ([(101.5, 0.3, 0, 26, 14, 5)], 0),  # the facet lies inside a larger crown
    ],
)  # fmt: skip
def test_a_bounce_needs_both_ways_free_of_other_trees(scenes, stand, count):
    site = scenes.site(towers=(tuple(ENDS[0]),), trees=trees((100, 0, 0, 20, 10, 5), *stand))
    labels, _ = bounces(scenes, site, ENDS[1], max_depth=1)
    assert labels.count(("crown 1 side 5",)) == count


def test_a_bounce_needs_both_ways_free_of_buildings_and_terrain(scenes):
    east, north = middle(BOUNCE, ENDS[1])[:2]
    for height, count in ((60.0, 0), (6.0, 1)):
        barn = Building("barn", box(east - 3, north - 3, east + 3, north + 3), height)
        site = scenes.site((barn,), towers=(tuple(ENDS[0]),), trees=trees((100, 0, 0, 20, 10, 5)))
        assert bounces(scenes, site, ENDS[1], max_depth=1)[0].count(("crown 1 side 5",)) == count
    # a ridge across the way from the crown to the pose
    at, across = np.arange(-100.0, 201.0, 1.0), np.arange(-100.0, 101.0, 10.0)
    for top, count in ((60.0, 0), (6.0, 1)):
        height = np.where(np.abs(at - east) < 3, top, 0.0) * np.ones((len(across), 1))
        frame = scenes.site().frame
        dem = Dem(height, west=at[0], south=across[0], step_x=1.0, step_y=10.0, crs="local", frame=frame)
        site = scenes.site(towers=(tuple(ENDS[0]),), trees=trees((100, 0, 0, 20, 10, 5)), dem=dem)
        assert bounces(scenes, site, ENDS[1], max_depth=1)[0].count(("crown 1 side 5",)) == count


def test_a_pose_or_tower_in_its_own_crown_has_no_bounce(scenes):
    # between the facet (apothem) and the round cone: in front of the mirror, yet inside the crown
    at = BOUNCE + 0.05 * NORMAL
    for source, target in ((ENDS[0], at), (at, ENDS[1])):
        site = scenes.site(towers=(tuple(source),), trees=trees((100, 0, 0, 20, 10, 5)))
        assert bounces(scenes, site, target)[0] == []


def test_bottoms_of_two_crowns_in_one_plane_stay_two_faces_in_parts_of_a_flight(scenes):
    """Each half of the flight bounces off one crown; both bottoms are the first facet that its half meets."""
    site = scenes.site(trees=trees((30, 1, 0, 20, 8, 12), (-30, 1, 0, 20, 8, 12)))
    crowns, poses = Crowns(site.trees), scenes.poses([[60.0, 0.0, 10.0], [-60.0, 0.0, 10.0]])
    options = Search(crowns=crowns), Field(loss=opaque(crowns)), Run()
    parts = replay_in_parts(site, scenes.link(site), poses, *options, size=1)
    met = {(int(pose), parts.faces.label[faces[0]]) for pose, faces in zip(*off_crowns(parts), strict=True)}
    assert met == {(0, "crown 1 bottom"), (1, "crown 2 bottom")}


def off_crowns(replayed):
    paths = replayed.paths.select(replayed.paths.off_crown & (replayed.paths.depth == 1))
    return paths.pose, paths.faces


def test_bottoms_of_crowns_in_one_plane_reflect_once_where_they_overlap(scenes):
    # both crowns hold the point (0, 0, 6); ends below, so that no side takes part
    site = scenes.site(towers=((-20.0, 0.0, 2.0),), trees=trees((1.5, 2, 0, 20, 10, 6), (-1.5, -2, 0, 20, 10, 6)))
    labels, off = bounces(scenes, site, [20.0, 0.0, 2.0], max_depth=1)
    assert [label[0].endswith("bottom") for label in labels] == [True]
    np.testing.assert_allclose(off.vertices_m[0, 0], [0, 0, 6], atol=1e-12)


def test_ground_bounce_is_at_the_ground_of_the_tower(scenes):
    # two antennas at one place, one on a hill: what the plain reflects for one is nothing to the other
    rng = np.random.default_rng(9)
    site = scenes.site(towers=((0, 0, 7.0, 3.0), (0, 0, 10.0, 0.0)), trees=random_trees(rng, 30))
    position = aimed_positions(rng, site, np.array([0, 0, 10.0]), 80)
    replayed = opaque_replay(scenes, site, position)
    off = replayed.paths.select(replayed.paths.off_crown & (replayed.paths.depth == 2))
    on_ground = off.vertices_m[off.tree < 0][:, 2]
    np.testing.assert_allclose(on_ground, np.array([3.0, 0.0])[off.tower], atol=1e-9)
    assert (off.tower == 1).sum() > 5


def test_a_crown_below_the_ground_of_the_tower_takes_no_part_in_its_ground_bounces(scenes):
    # mirrored at up = 27 m the tower is where it sees the pose over the crown at 14 m, but the hill lies in between
    plane = 27.0
    assert ENDS[0][2] < plane < ENDS[1][2]
    site = scenes.site(
        towers=((*ENDS[0][:2], plane - ENDS[0][2], plane),), trees=trees((100, 0, 0, 20, 10, 5))
    )  # fmt: skip
    assert [label for label in bounces(scenes, site, ENDS[1])[0] if len(label) > 1] == []


# ---------------------------------------------------------------- beside everything else


def test_without_bounces_everything_stays_as_it_was(scenes):
    rng = np.random.default_rng(3)
    stand = random_trees(rng, 40)
    site = scenes.site((Building("barn", box(20, 20, 45, 40), 9.0),), trees=stand)
    position = np.column_stack([rng.uniform(-150, 150, (200, 2)), rng.uniform(2, 90, 200)])
    link, poses, crowns = scenes.link(site), scenes.poses(position), Crowns(stand)
    blocking, reflecting = (
        replay(site, link, poses, Search(crowns=given_), Field(loss=opaque(crowns))) for given_ in (None, crowns)
    )
    off = reflecting.paths.off_crown
    assert off.sum() > 5
    without_bounces = reflecting.paths.select(~off)
    for name in ("pose", "tower", "depth", "faces", "vertices_m"):
        np.testing.assert_array_equal(getattr(without_bounces, name), getattr(blocking.paths, name))
    elsewhere = np.setdiff1d(np.arange(200), reflecting.paths.pose[off])
    np.testing.assert_array_equal(reflecting.h[elsewhere], blocking.h[elsewhere])
    assert (reflecting.h[reflecting.paths.pose[off]] != blocking.h[reflecting.paths.pose[off]]).all()
    # a stand without a place for a bounce: below and behind everything
    far = Crowns(
        replace(
            stand, east_m=stand.east_m + 1e5, height_m=stand.height_m * 0 + 1, crown_base_m=stand.height_m * 0 + 0.9
        )
    )
    same = replay(site, link, poses, Search(crowns=far), Field(loss=opaque(crowns)))
    np.testing.assert_array_equal(same.h, blocking.h)
    assert same.faces is not None
    assert len(same.faces) == len(blocking.faces)


def test_the_audit_compares_paths_over_crowns(scenes):
    rng = np.random.default_rng(8)
    stand = random_trees(rng, 40)
    site = scenes.site(trees=stand)
    position = np.concatenate(
        [aimed_positions(rng, site, site.towers["LW1"].position_m, 60), rng.uniform(20, 50, (9, 3))]
    )
    replayed = opaque_replay(scenes, site, position)
    crowns, link, poses = Crowns(stand), scenes.link(site), scenes.poses(position)
    settings = {"field": Field(loss=opaque(crowns)), "second": Second(reference="image", links=40)}
    same = audit(site, link, poses, replayed, Search(crowns=crowns), **settings)
    # the reference has other facets than the whole replay, so that their numbers differ
    assert (same.missing_paths, same.extra_paths, same.rss_max_error_db) == (0, 0, 0.0)
    without = audit(site, link, poses, replayed, **settings)
    chosen = np.linspace(0, len(position) - 1, 40).round()
    off = replayed.paths.select(replayed.paths.off_crown)
    assert without.extra_paths == np.isin(off.pose, chosen).sum() > 10
    assert without.missing_paths == 0


def test_only_opaque_crowns_reflect(scenes):
    stand = trees((100, 0, 0, 20, 10, 5))
    ends = ENDS[0][None], BOUNCE[None, None], ENDS[1][None]
    bounced = np.zeros((1, 1), dtype=int)
    assert foliage_loss_db(*ends, stand, Opaque(), bounced).tolist() == [0.0]
    assert foliage_loss_db(*ends, stand, Opaque()).tolist() == [np.inf]  # the facet lies inside the round crown
    assert foliage_loss_db(*ends, stand, P833(), bounced).tolist() == [np.inf]
    assert foliage_loss_db(*ends, stand, NoFoliage(), bounced).tolist() == [np.inf]
    assert foliage_loss_db(*ends, stand, NoFoliage(), bounced - 1).tolist() == [0.0]


def test_no_trees_no_poses_no_depth(scenes):
    site = scenes.site(trees=Trees.none())
    assert bounces(scenes, site, [50.0, 0.0, 10.0])[0] == []
    site = scenes.site(
        towers=(tuple(ENDS[0]),), trees=trees((100, 0, 0, 20, 10, 5), (0, 0, 0, 20, 0, 5), (9, 9, 0, 5, 4, 5))
    )
    assert bounces(scenes, site, ENDS[1], max_depth=0)[0] == []
    assert bounces(scenes, site, np.full((3, 3), np.nan))[0] == []
    with_nan = bounces(scenes, site, np.array([[np.nan] * 3, ENDS[1]]))[1]
    assert set(with_nan.pose) == {1}
    assert with_nan.tree.max() < len(site.trees)
    assert FACES_PER_CROWN == CROWN_SIDES + 1

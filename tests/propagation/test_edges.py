"""Paths over building edges: a second way to paths and fields, continuity, reciprocity, hard cases."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from shapely.geometry import Point, Polygon, box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.jobs.bench import random_scene
from aerpaw_cmp.propagation.check.explain import further_path_lines
from aerpaw_cmp.propagation.edges import EdgePaths, Edges, amplitudes, diffracted, wedge_axes
from aerpaw_cmp.propagation.geometry import Array, Link, Poses, single_element, site_faces
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import Replay, replay, trace
from aerpaw_cmp.propagation.scene import Scene
from aerpaw_cmp.site.mitsuba import TriangleScene
from aerpaw_cmp.site.site import Building, Site, Tower

HZ = 3.4e9
WAVELENGTH = 299_792_458.0 / HZ
K = 2 * math.pi / WAVELENGTH
LINK = Link(HZ, {"T": single_element()}, single_element())


def place(*buildings: Building, tower: tuple[float, float, float] = (0.0, 0.0, 10.0)) -> Site:
    east, north, up = tower
    towers = {"T": Tower("T", 35.7, -78.7, east, north, antenna_height_m=up)}
    return Site("made up", SiteFrame(35.7275, -78.696), towers, buildings)


def poses(*positions: tuple[float, float, float]) -> Poses:
    return Poses(np.array(positions, dtype=np.float64), np.broadcast_to(np.eye(3), (len(positions), 3, 3)).copy())


BARN = Building("barn", box(40, -15, 52, 25), 8.0)


def bent(replayed: Replay) -> EdgePaths:
    (paths,) = replayed.further
    assert isinstance(paths, EdgePaths)
    return paths


# --- a second way: the shortest way over each edge by a search, legs cut by their shadows -----------------------------


class ByForce:
    """Every path over one edge of one link: the shortest way, legs cut by their shadows."""

    def __init__(self, scenes, site: Site, scene: Scene, edges: Edges) -> None:
        self.scenes, self.site, self.faces, self.edges = scenes, site, scene.faces, edges

    def above(self, face: int, point: np.ndarray) -> float:
        return float(self.faces.normal[face] @ point - self.faces.offset_m[face])

    def image(self, face: int, point: np.ndarray) -> np.ndarray:
        return point if face < 0 else point - 2 * self.above(face, point) * self.faces.normal[face]

    def shortest(self, edge: int, a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
        """Return where |a p| + |p b| is shortest along an edge, by golden sections. None beyond its ends."""
        start, way = self.edges.start_m[edge], (self.edges.end_m - self.edges.start_m)[edge]

        def length(share: float) -> float:
            point = start + share * way
            return float(np.linalg.norm(point - a) + np.linalg.norm(point - b))

        share = minimize_scalar(length, bounds=(-0.01, 1.01), method="bounded", options={"xatol": 1e-12}).x
        return start + share * way if 0 < share < 1 else None

    def paths(self, source: np.ndarray, target: np.ndarray) -> dict[tuple[int, ...], np.ndarray]:
        polylines = {}
        grounds = (-1, *np.flatnonzero(self.faces.solid < 0).tolist())
        for f, g, edge in itertools.product(grounds, grounds, range(len(self.edges))):
            corner = self.shortest(edge, self.image(f, source), self.image(g, target))
            line = None if corner is None else self.polyline((f, g), (source, corner, target))
            if line is not None:
                polylines[(*self.edges.face[edge].tolist(), f, g)] = np.array(line)
        return polylines

    def polyline(self, mirrors, points):
        source, corner, target = points
        line = [source, corner, target]
        for face, end, at in ((mirrors[1], target, 2), (mirrors[0], source, 1)):
            if face < 0:
                continue
            if self.above(face, end) <= 0 or self.above(face, corner) <= 0.01:
                return None
            share = self.above(face, end) / (self.above(face, end) + self.above(face, corner))
            spot = end + share * (self.image(face, corner) - end)
            if not self.scenes.on_face(self.faces, face, spot):
                return None
            line.insert(at, spot)
        return None if any(self.scenes.covered(self.site, a, b) for a, b in itertools.pairwise(line)) else line


@pytest.mark.parametrize("seed", [1, 2])
def test_paths_of_every_kind_by_force(scenes, seed: int) -> None:
    """The ground before or after an edge, also of L shapes."""
    rng = np.random.default_rng(seed)
    site = scenes.site(scenes.buildings(rng, 4, spread_m=45.0), towers=((0.0, 0.0, 9.0), (-30.0, 35.0, 14.0)))
    spots = np.column_stack([rng.uniform(-60, 60, (5, 2)), rng.uniform(1.0, 16.0, 5)])
    where, link = scenes.poses(spots), scenes.link(site)
    scene = Scene.of(site, link, where)
    ours = bent(trace(site, link, where, diffraction="edges"))
    force = ByForce(scenes, site, scene, Edges.of(scene.faces))
    count = 0
    for tower, pose in itertools.product(range(2), np.flatnonzero(~scene.excluded.any(axis=0))):
        expected = force.paths(scene.sources_m[tower], spots[pose])
        rows = np.flatnonzero((ours.tower == tower) & (ours.pose == pose))
        keys = np.column_stack([ours.wedge, ours.ground])[rows].tolist()
        assert set(map(tuple, keys)) == set(expected)
        assert len(keys) == len(expected)
        for key, row in zip(keys, rows, strict=True):
            at = ours.vertices_m[row]
            assert np.abs(at[np.isfinite(at[:, 0])] - expected[tuple(key)][1:-1]).max() < 1e-3
        count += len(keys)
    assert count > 100


# --- laws ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("height", [1.5, 3.0, 6.0])
def test_level_is_continuous_where_the_straight_path_ends(height: float) -> None:
    """Behind the barn, up and along: the total changes by less than 0.1 dB where a path appears."""
    site = place(BARN)
    crossings = 0
    for line in (
        [(70.0, 3.0, z) for z in np.linspace(0.5, 14.0, 271)],
        [(75.0, y, height) for y in np.linspace(-60.0, 70.0, 521)],
    ):
        dull = trace(site, LINK, poses(*line), max_depth=1)
        kinds = [frozenset(map(int, dull.paths.depth[dull.paths.pose == i])) for i in range(len(line))]
        for i in np.flatnonzero([a != b for a, b in itertools.pairwise(kinds)]):
            low, high = np.array(line[i]), np.array(line[i + 1])
            for _ in range(20):  # to some 1e-7 m
                middle = (low + high) / 2
                there = trace(site, LINK, poses(tuple(middle)), max_depth=1)
                same = frozenset(map(int, there.paths.depth)) == kinds[i]
                low, high = (middle, high) if same else (low, middle)
            both = trace(site, LINK, poses(tuple(low), tuple(high)), max_depth=1, diffraction="edges")
            assert abs(np.diff(both.rss_dbm[:, 0])[0]) < 0.1
            crossings += 1
    assert crossings >= 4


def test_a_link_turned_round_is_the_same() -> None:
    tower, uav = (0.0, 0.0, 10.0), (70.0, 4.0, 2.0)
    there = trace(place(BARN, tower=tower), LINK, poses(uav), diffraction="edges")
    back = trace(place(BARN, tower=uav), LINK, poses(tower), diffraction="edges")
    assert len(bent(there)) == len(bent(back)) == 2
    assert there.h[0, 0, 0, 0] == pytest.approx(back.h[0, 0, 0, 0], rel=1e-7)


class Cardioid:
    """A pattern along its x axis: 1.6 in front and 0.4 behind."""

    name = "cardioid"

    def field(self, theta_rad: np.ndarray, phi_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        e_theta = 1.0 + 0.6 * np.sin(theta_rad) * np.cos(phi_rad) + 0j
        return e_theta, np.zeros_like(e_theta)


def test_patterns_multiply_paths_over_edges_by_the_gain_toward_the_edge(scenes) -> None:
    """Both patterns have the polarisation of the isotropic element, so only the factor of the direction differs."""
    rng = np.random.default_rng(5)
    site = scenes.site(scenes.buildings(rng, 4, spread_m=45.0), towers=((0.0, 0.0, 9.0), (-30.0, 35.0, 14.0)))
    spots = np.column_stack([rng.uniform(-60, 60, (6, 2)), rng.uniform(1.0, 16.0, 6)])
    flown = scenes.poses(spots, Rotation.random(6, random_state=3).as_matrix())
    mount = Rotation.from_euler("yz", [70.0, 25.0], degrees=True).as_matrix()

    def link(second: object, uav: object) -> Link:
        first_name, second_name = site.towers
        towers = {first_name: single_element(), second_name: single_element(second, mount)}
        return Link(HZ, towers, single_element(uav))

    isotropic, directive = link(None, None), link(Cardioid(), Cardioid())
    ours, scene = bent(trace(site, isotropic, flown, diffraction="edges")), Scene.of(site, isotropic, flown)
    assert (ours.ground >= 0).any(axis=0).all()
    assert {*ours.tower} == {0, 1}
    plain, got = (amplitudes(ours, scene.faces, scene.sources_m, flown, of)[:, 0, 0] for of in (isotropic, directive))
    for row, (tower, pose) in enumerate(zip(ours.tower, ours.pose, strict=True)):
        corners = ours.vertices_m[row][np.isfinite(ours.vertices_m[row][:, 0])]
        ends = [(corners[-1] - spots[pose], flown.rotation[pose][:, 0])]
        if tower == 1:
            ends.append((corners[0] - scene.sources_m[1], mount[:, 0]))
        gain = math.prod(1.0 + 0.6 * (way @ front) / np.linalg.norm(way) for way, front in ends)
        assert got[row] == pytest.approx(gain * plain[row], rel=1e-6)


def test_silent_places_are_reached() -> None:
    site, link, flown = random_scene(400)
    spots = flown.position_m.copy()
    spots[::2, 2], spots[1::2, 2] = 2.0, 8.0
    low = Poses(spots, flown.rotation)
    dark, lit = (replay(site, link, low, Search(further=diffracted(d))) for d in ("none", "edges"))
    outside = np.array([not any(b.footprint.contains(p) for b in site.buildings) for p in _points(spots)])
    outside |= spots[:, 2] > max(b.height_m for b in site.buildings)
    silent = ~dark.has_path[:, 0] & outside
    assert silent.sum() >= 20
    assert lit.has_path[silent, 0].all()
    assert np.isfinite(lit.h).all()


def _points(spots: np.ndarray) -> list:
    return [Point(p[:2]) for p in spots]


# --- hard cases ----------------------------------------------------------------------------------------------------


def test_edges_of_a_box_and_of_a_hole() -> None:
    assert len(Edges.of(site_faces(place(BARN)))) == 8
    ell = Building("ell", box(0, 0, 30, 30).difference(box(10, 10, 30, 30)), 6.0)
    edges = Edges.of(site_faces(place(ell)))
    assert len(edges) == 6 + 5  # six rims, and no edge in the inner corner
    assert np.allclose(wedge_axes(edges.normal, edges.normal_n)[2], 1.5)
    right_handed(edges)


def test_a_face_that_another_building_covers_has_no_edge() -> None:
    halves = [Building("west", box(40, -15, 46, 25), 8.0), Building("east", box(46, -15, 52, 25), 8.0)]
    where = poses((70.0, 3.0, 2.0), (30.0, 60.0, 1.0), (60.0, -40.0, 9.0))
    undivided, divided = (
        trace(place(BARN), LINK, where, diffraction="edges"),
        trace(place(*halves), LINK, where, diffraction="edges"),
    )
    assert undivided.rss_dbm == pytest.approx(divided.rss_dbm, abs=1e-9)


@pytest.mark.parametrize("east_m", [8.0, 12.0])
def test_no_path_bends_where_a_neighbour_touches_a_face(east_m: float) -> None:
    """Only the part of a common wall above the lower roof diffracts, also for rays from above."""
    west, east = Building("west", box(40, -15, 46, 25), 8.0), Building("east", box(46, -15, 52, 25), east_m)
    where = poses((70.0, 3.0, 20.0), (30.0, 6.0, 15.0), (46.0, -40.0, 9.0), (49.0, 60.0, 3.0))
    halves = place(west, east, tower=(0.0, 0.0, 16.0))
    paths = bent(trace(halves, LINK, where, diffraction="edges"))
    corners = paths.vertices_m[np.isfinite(paths.vertices_m[..., 0])]
    between = np.isclose(corners[:, 0], 46.0)
    assert (corners[between, 2] > 8.0 + 1e-6).all()
    assert between.any() == (east_m > 8.0)
    assert {40.0, 52.0} <= set(np.round(corners[:, 0], 6))
    if east_m == 8.0:
        undivided = trace(place(BARN, tower=(0.0, 0.0, 16.0)), LINK, where, diffraction="edges")
        assert trace(halves, LINK, where, diffraction="edges").rss_dbm == pytest.approx(undivided.rss_dbm, abs=1e-9)


def test_ends_on_an_edge_are_no_numbers_that_are_none() -> None:
    corner, rim = (40.0, -15.0, 4.0), (46.0, 25.0, 8.0)
    result = trace(place(BARN, tower=(40.0, 3.0, 8.0)), LINK, poses(corner, rim, (70.0, 0.0, 2.0)), diffraction="edges")
    assert np.isfinite(result.h).all()
    above = trace(place(BARN, tower=(40.0, 3.0, 8.2)), LINK, poses((70.0, 0.0, 2.0)), diffraction="edges")
    assert above.has_path[0, 0]


@pytest.mark.parametrize("apart_m", [0.0, 1e-9, 1e-5])
def test_a_side_without_length_is_no_edge(apart_m: float) -> None:
    """A corner given twice, or two corners closer than a wave can tell."""
    twice = Polygon([(40, -15), (52, -15), (52, -15 + apart_m), (52, 25), (40, 25)])
    where = poses((70.0, 3.0, 2.0), (30.0, 60.0, 1.0), (60.0, -40.0, 9.0), (52.0, -15.0, 4.0))
    clean, degenerate = (
        trace(place(building), LINK, where, diffraction="edges") for building in (BARN, Building("twice", twice, 8.0))
    )
    assert np.isfinite(degenerate.h).all()
    assert degenerate.rss_dbm == pytest.approx(clean.rss_dbm, abs=1e-3, nan_ok=True)


def test_what_is_not_modelled_is_said_or_refused() -> None:
    result = trace(place(BARN), LINK, poses((70.0, 3.0, 2.0)), diffraction="edges")
    assert any("two edges" in text for text in result.left_out)
    with pytest.raises(UsageError, match="unknown diffraction"):
        trace(place(BARN), LINK, poses((70.0, 3.0, 2.0)), diffraction="some")  # type: ignore[arg-type]


def test_without_buildings_nothing_changes() -> None:
    site = replace(place(BARN), buildings=())
    where = poses((70.0, 3.0, 2.0))
    first, second = trace(site, LINK, where), trace(site, LINK, where, diffraction="edges")
    assert np.array_equal(first.h, second.h)


@pytest.mark.parametrize("slant", [0.0, np.pi / 2])
def test_crossed_elements_see_no_step_where_a_rim_met_obliquely_throws_its_shadow(slant: float) -> None:
    """Behind concrete, far along the barn: H of crossed elements moves by what a micrometre does, and no more."""
    site = place(replace(BARN, footprint=box(40, -15, 52, 200)), tower=(0.0, 0.0, 10.0))
    uav = Array(np.zeros((1, 3)), np.array([slant]))
    link = Link(HZ, {"T": Array(np.zeros((1, 3)), np.array([np.pi / 2 - slant]))}, uav)
    low, high = np.array([70.0, 150.0, 0.5]), np.array([70.0, 150.0, 9.0])
    for _ in range(40):
        middle = (low + high) / 2
        seen = (trace(site, link, poses(tuple(middle)), max_depth=0).paths.depth == 0).any()
        low, high = (low, middle) if seen else (middle, high)
    around = poses(*(tuple(low + np.array([0.0, 0.0, off])) for off in (-2e-6, -1e-6, 1e-6, 2e-6)))
    h = trace(site, link, around, max_depth=0, diffraction="edges").h[:, 0, 0, 0]
    free_space = WAVELENGTH / (4 * np.pi * np.linalg.norm(low - [0.0, 0.0, 10.0]))
    assert np.abs(np.diff(h)).max() < 1e-4 * free_space


def test_a_slab_as_thin_as_paper_is_no_obstacle() -> None:
    """Half a wavelength is where a building begins to bend a wave."""
    where = poses((70.0, 3.0, 2.0), (30.0, 60.0, 1.0), (60.0, -40.0, 9.0), (46.0, 5.0, 3.0))
    flat = trace(place(), LINK, where)
    for height, bends in ((1e-4, False), (0.49 * WAVELENGTH, False), (0.51 * WAVELENGTH, True)):
        slab = place(replace(BARN, height_m=height, material=place().ground_material))
        replayed = trace(slab, LINK, where, diffraction="edges")
        assert bool(len(bent(replayed))) == bends
        if height == 1e-4:
            assert replayed.rss_dbm == pytest.approx(flat.rss_dbm, abs=0.01)


def test_a_scene_of_triangles_is_refused() -> None:
    pytest.importorskip("numba")
    sheet = np.array([[30.0, -40, 0], [30, 40, 0], [30, 40, 6], [30, -40, 6]])
    scene = TriangleScene(sheet, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, np.int64), ("sheet",), ("metal",))
    with pytest.raises(UsageError, match="diffraction in a scene of triangles"):
        trace(replace(place(), scene=scene), LINK, poses((60.0, 1.0, 2.0)), diffraction="edges")


def right_handed(edges: Edges) -> None:
    """Face n lies at the exterior angle from face 0, through air, and its normal points back into that air."""
    assert np.allclose(np.cross(edges.face_axis, edges.normal), edges.along)
    assert np.allclose(np.linalg.norm(edges.end_m - edges.start_m, axis=1), edges.length_m)
    assert np.allclose(edges.start_m + edges.length_m[:, None] * edges.along, edges.end_m)
    turn = np.pi * wedge_axes(edges.normal, edges.normal_n)[2][:, None]
    assert np.allclose(edges.normal_n, np.sin(turn) * edges.face_axis - np.cos(turn) * edges.normal)


@pytest.mark.parametrize(("sides", "ground_m", "uprights"), [(3, 0.0, 3), (6, 1.0, 6), (5, 7.9, 5), (4, 8.0, 0)])
def test_edges_of_a_regular_prism(sides: int, ground_m: float, uprights: int) -> None:
    """The turns of upright edges add up to 360 degrees. They begin at the ground, and buried parts are not edges."""
    angle = 2 * np.pi * np.arange(sides) / sides
    tower = Building("tower", Polygon(np.column_stack([50 + 9 * np.cos(angle), 9 * np.sin(angle)])), 8.0)
    site = place(tower)
    site = replace(site, towers={"T": replace(site.towers["T"], ground_m=ground_m)})
    edges = Edges.of(site_faces(site, ("T",)))
    right_handed(edges)
    upright, exterior = np.abs(edges.along[:, 2]) == 1.0, wedge_axes(edges.normal, edges.normal_n)[2]
    assert (upright.sum(), (~upright).sum()) == (uprights, sides if ground_m < 8.0 else 0)
    assert exterior[~upright] == pytest.approx(1.5)
    assert exterior[upright] == pytest.approx(1 + 2 / sides)
    assert edges.start_m[upright, 2] == pytest.approx(ground_m)
    assert (edges.end_m[:, 2] == 8.0).all()
    assert edges.length_m[~upright] == pytest.approx(18 * np.sin(np.pi / sides))


def test_polylines_of_paths_over_edges_leave_out_what_is_not_used() -> None:
    points, none = np.arange(18.0).reshape(2, 3, 3), np.zeros((2, 2), np.int64)
    points[0, [0, 2]], points[1, 2] = np.nan, np.nan
    lines = EdgePaths(np.zeros(2, np.int64), np.zeros(2, np.int64), none, none, points).lines()
    assert lines.depth.tolist() == [1, 2]
    assert (lines.faces == -1).all()
    for row, used in ((0, [1]), (1, [0, 1])):
        assert np.array_equal(lines.vertices_m[row, : len(used)], points[row, used])
        assert np.isnan(lines.vertices_m[row, len(used) :]).all()


def test_paths_over_edges_are_explained_by_their_levels() -> None:
    where = poses((70.0, 3.0, 2.0))
    result = trace(place(BARN), LINK, where, diffraction="edges")
    lines = further_path_lines(result, np.array([0.0, 0.0, 10.0]), where, LINK)
    assert len(lines) == len(bent(result)) == 2
    assert all("edge of barn wall" in line for line in lines)
    levels = [float(line.split()[4]) for line in lines]
    assert levels == sorted(levels, reverse=True)
    heights = sorted(float(line.split(" m")[-2].rsplit(", ", 1)[1]) for line in lines)
    assert heights == pytest.approx(sorted(bent(result).vertices_m[:, 1, 2]), abs=0.051)
    ground = (bent(result).ground >= 0).any(axis=1).sum()
    assert sum(line.endswith(", ground") or "dBm: ground, " in line for line in lines) == ground == 1
    assert 10 * math.log10(sum(10 ** (v / 10) for v in levels)) == pytest.approx(result.rss_power_dbm[0, 0], abs=0.02)

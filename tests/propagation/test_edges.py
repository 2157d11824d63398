"""Paths over building edges: a second way to paths and fields, continuity, reciprocity, hard cases."""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from shapely.geometry import LineString, Point, Polygon, box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.jobs.bench import random_scene
from aerpaw_cmp.propagation.arrays import Array, Isotropic, Link, Poses, single_element
from aerpaw_cmp.propagation.check.bent import _cotangent, _transition
from aerpaw_cmp.propagation.check.explain import further_path_lines
from aerpaw_cmp.propagation.check.field_audit import Expected, against_reference
from aerpaw_cmp.propagation.check.reference import element_wave, fresnel, permittivity, turned
from aerpaw_cmp.propagation.edges import EdgePaths, Edges
from aerpaw_cmp.propagation.faces import site_faces, triangles
from aerpaw_cmp.propagation.field.edges import Tables, amplitudes
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import edges_of, replay
from aerpaw_cmp.propagation.scene import Scene, surfaces_of
from aerpaw_cmp.propagation.search.edges import _below
from aerpaw_cmp.propagation.search.merging import merged
from aerpaw_cmp.propagation.trace import trace
from aerpaw_cmp.site.antenna.antennas import TR38901, HalfWaveDipole
from aerpaw_cmp.site.mesh_scenes.mitsuba import TriangleScene
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


# --- a second way: plain loops, the shortest way over each edge by a search, Kouyoumjian and Pathak's own formula ----


@pytest.mark.parametrize(
    ("seed", "patterns"), [(1, (Isotropic(),) * 3), (2, (TR38901(), Isotropic(), Isotropic())),
                           (3, (HalfWaveDipole(), TR38901(), HalfWaveDipole()))],
)  # fmt: skip
def test_paths_and_field_by_plain_loops(seed: int, patterns: tuple) -> None:
    """Slanted arrays at both ends, H with the reflections: the audit's second implementation."""
    site, link, flown = random_scene(40, buildings=5, seed=seed, towers=1 + (seed == 3))
    flown.position_m[::2, 2], flown.position_m[1::2, 2] = 2.0, 25.0
    arrays = dict(zip(link.tower_arrays, patterns, strict=False))
    arrays = {name: replace(link.tower_arrays[name], patterns=(pattern,)) for name, pattern in arrays.items()}
    link = replace(link, tower_arrays=arrays, uav_array=replace(link.uav_array, patterns=patterns[2:]))
    ours = replay(site, link, flown, Search(diffraction="edges"))
    assert ours.edge_paths is not None
    assert len(ours.edge_paths) > 300
    chosen = np.arange(0, 40, 3 * len(arrays))
    audit = against_reference(site, flown, ours, chosen, Expected.of(link), ks=(10.0, 1000.0), max_depth=2)
    assert audit.failures == ()
    assert audit.doubtful <= 3
    assert audit.not_covered == ()


def test_the_audit_sees_a_path_over_an_edge_that_is_not_there() -> None:
    where = poses((70.0, 3.0, 2.0), (60.0, -40.0, 9.0))
    raised = Tower("T", 35.7, -78.7, 0.0, 0.0, antenna_height_m=8.5, ground_m=1.5)
    barn, array = replace(place(BARN), towers={"T": raised}), Array(np.array([[0.0, 0.3, 0.1]]), np.array([0.4]))
    link = Link(HZ, {"T": array}, array)
    ours = trace(barn, link, where, diffraction="edges")
    assert ours.edge_paths is not None
    few = ours.edge_paths.select(np.arange(1, len(ours.edge_paths)))
    assert {tuple(row) for row in (ours.edge_paths.ground >= 0).tolist()} == {
        (False, False),
        (False, True),
        (True, False),
    }
    for planted in (ours, replace(ours, edge_paths=few), replace(ours, h=0.9999 * ours.h)):
        audit = against_reference(barn, where, planted, np.arange(2), Expected.of(link), ks=(10.0,), max_depth=2)
        assert bool(audit.failures) == (planted is not ours)
        assert audit.doubtful == 0


def test_the_audit_allows_a_ten_thousandth_of_a_percent_unless_its_series_for_edges_is_in_it() -> None:
    # the second transition function is a series cut off at 1e-5; all else of both ways is float64
    barn, where = place(BARN), poses((70.0, 3.0, 2.0), (60.0, -40.0, 9.0))
    for diffraction, allowed in (("none", 1e-6), ("edges", 3e-5)):
        ours = trace(barn, LINK, where, diffraction=diffraction)
        for share in (0.5, 2.0):
            off = replace(ours, h=(1.0 + share * allowed) * ours.h)
            audit = against_reference(barn, where, off, np.arange(1, 2), Expected.of(LINK), ks=(10.0,), max_depth=2)
            assert any("H differs" in failure for failure in audit.failures) == (share > 1.0)


@pytest.mark.parametrize("end", ["towers", "uav"])
def test_a_pattern_at_one_end_alone_is_the_same_compiled(monkeypatch: pytest.MonkeyPatch, end: str) -> None:
    """Both components complex: nothing of one end's pattern may stay where the other end radiates along theta."""
    pattern = SimpleNamespace(
        name="crossed", field=lambda theta, phi: (np.sin(theta) * np.exp(1j * phi), (0.3 - 0.8j) * np.cos(theta + phi))
    )
    plain = Array(np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.2]]), np.radians([0.0, 70.0]))
    turned_wave = replace(plain, patterns=(pattern,))
    ends = (turned_wave, plain) if end == "towers" else (plain, turned_wave)
    link, fields = Link(HZ, {"T": ends[0]}, ends[1]), []
    for mode in ("never", "always"):
        monkeypatch.setenv("AERPAW_CMP_COMPILED", mode)
        fields.append(trace(place(BARN), link, poses((70.0, 3.0, 2.0), (60.0, -40.0, 9.0)), diffraction="edges").h)
    assert fields[0] == pytest.approx(fields[1], abs=1e-9 * np.abs(fields[0]).max())
    both_plain = trace(
        place(BARN), Link(HZ, {"T": plain}, plain), poses((70.0, 3.0, 2.0), (60.0, -40.0, 9.0)), diffraction="edges"
    )
    assert np.abs(fields[0] - both_plain.h).max() > 0.1 * np.abs(fields[0]).max()


# Two edges that meet are crossed so near their corner that the iteration has not ended: nothing is judged there.
NEAR_A_CORNER_M = 1.0


class ByForce:
    """Every path over one edge, or two of one face, of one link: shortest by iteration, legs cut by their shadows."""

    def __init__(self, scenes, site: Site, scene: Scene, edges: Edges) -> None:
        self.scenes, self.site, self.faces, self.edges = scenes, site, scene.faces, edges
        every = range(len(edges))
        routes = [(e, -1, 0, 0) for e in every]
        routes += [
            (e, h, i, j)
            for e, h in itertools.permutations(every, 2)
            for i, j in itertools.product((0, 1), repeat=2)
            if edges.face[e, i] == edges.face[h, j]
        ]
        self.routes = np.array(routes)

    def above(self, face: int, point: np.ndarray) -> float:
        return float(self.faces.normal[face] @ point - self.faces.offset_m[face])

    def image(self, face: int, point: np.ndarray) -> np.ndarray:
        return point if face < 0 else point - 2 * self.above(face, point) * self.faces.normal[face]

    def hero(self, edge: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Where |a p| + |p b| is shortest along edges: as far as if both points were turned into one plane."""
        start, along = self.edges.start_m[edge], self.edges.along[edge]
        at = [((p - start) * along).sum(axis=1) for p in (a, b)]
        off = [np.linalg.norm(p - start - w[:, None] * along, axis=1) for p, w in zip((a, b), at, strict=True)]
        return start + ((at[0] * off[1] + at[1] * off[0]) / (off[0] + off[1]))[:, None] * along

    def shortest(self, routes: np.ndarray, s: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        e, h = routes[:, 0], np.where(routes[:, 1] < 0, routes[:, 0], routes[:, 1])
        p, q = (self.edges.start_m[k] + 0.5 * (self.edges.end_m - self.edges.start_m)[k] for k in (e, h))
        has_second = (routes[:, 1] >= 0)[:, None]
        for _ in range(300 if has_second.any() else 1):
            p = self.hero(e, np.broadcast_to(s, p.shape), np.where(has_second, q, t))
            q = np.where(has_second, self.hero(h, p, np.broadcast_to(t, p.shape)), p)
        return p, q

    def paths(self, source: np.ndarray, target: np.ndarray, every: bool) -> dict[tuple[int, ...], np.ndarray]:
        polylines = {}
        mirrors = range(len(self.faces)) if every else np.flatnonzero(self.faces.solid < 0).tolist()
        for f, g in itertools.product((-1, *mirrors), repeat=2):
            wall = max(self.faces.solid[[k for k in (f, g) if k >= 0]], default=-1) >= 0
            if wall and min(f, g) >= 0:
                continue
            routes = self.routes[self.routes[:, 1] < 0] if wall or not every else self.routes
            corners = self.shortest(routes, self.image(f, source), self.image(g, target))
            on = np.ones(len(routes), dtype=bool)
            for edge, point in zip(routes[:, :2].T, corners, strict=True):
                at = ((point - self.edges.start_m[edge]) * self.edges.along[edge]).sum(axis=1)
                on &= (edge < 0) | ((at > 0) & (at < self.edges.length_m[edge]))
            for route, p, q in zip(routes[on].tolist(), *(corner[on] for corner in corners), strict=True):
                line = self.polyline(route, (f, g), (source, p, q, target))
                if line is not None:
                    polylines[(*route, f, g)] = np.array(line)
        return polylines

    def polyline(self, route, mirrors, points):
        source, p, q, target = points
        e, h, i, _ = route
        line = [source, p, q, target] if h >= 0 else [source, p, target]
        for face, end, corner, at in ((mirrors[1], target, q, len(line) - 1), (mirrors[0], source, p, 1)):
            if face < 0:
                continue
            if self.above(face, end) <= 0 or self.above(face, corner) <= 0.01:
                return None
            share = self.above(face, end) / (self.above(face, end) + self.above(face, corner))
            spot = end + share * (self.image(face, corner) - end)
            if not self.scenes.on_face(self.faces, face, spot):
                return None
            line.insert(at, spot)
        if h >= 0:
            face = self.edges.face[e, i]
            roof = self.faces.normal[face, 2] > 0.5
            shadow = LineString([p[:2], q[:2]])
            solid = self.site.buildings[self.faces.solid[face]].footprint.buffer(1e-6)
            if np.linalg.norm(p - q) < NEAR_A_CORNER_M or (roof and not solid.covers(shadow)):
                return None
        return None if any(self.scenes.covered(self.site, a, b) for a, b in itertools.pairwise(line)) else line


@pytest.mark.parametrize(("seed", "mode"), [(1, "edges"), (2, "all")])
def test_paths_of_every_kind_by_force(scenes, seed: int, mode: str) -> None:
    """Walls, roofs and ground before or after an edge, and two edges of a wall or roof, also of L shapes."""
    pytest.importorskip("numba")
    rng = np.random.default_rng(seed)
    site = scenes.site(scenes.buildings(rng, 4, spread_m=45.0), towers=((0.0, 0.0, 9.0), (-30.0, 35.0, 14.0)))
    spots = np.column_stack([rng.uniform(-60, 60, (5, 2)), rng.uniform(1.0, 16.0, 5)])
    where, link = scenes.poses(spots), scenes.link(site)
    scene = Scene.of(site, link, where)
    edges = Edges.of(scene.faces, 0.0)
    ours = trace(site, link, where, diffraction=mode).edge_paths
    assert ours is not None
    force = ByForce(scenes, site, scene, edges)
    count = 0
    for tower, pose in itertools.product(range(2), np.flatnonzero(~scene.excluded.any(axis=0))):
        expected = force.paths(scene.sources_m[tower], spots[pose], mode == "all")
        gap = np.linalg.norm(ours.vertices_m[:, 2] - ours.vertices_m[:, 1], axis=1)  # NaN over one edge
        rows = np.flatnonzero((ours.tower == tower) & (ours.pose == pose) & ~(gap < NEAR_A_CORNER_M))
        keys = np.column_stack([ours.edge, ours.shared, ours.ground])[rows].tolist()
        assert set(map(tuple, keys)) == set(expected)
        assert len(keys) == len(expected)
        for key, row in zip(keys, rows, strict=True):
            at = ours.vertices_m[row]
            assert np.abs(at[np.isfinite(at[:, 0])] - expected[tuple(key)][1:-1]).max() < 1e-3
        count += len(keys)
    assert count > (100 if mode == "edges" else 300)


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
    there = trace(place(BARN, tower=tower), LINK, poses(uav), diffraction="all")
    back = trace(place(BARN, tower=uav), LINK, poses(tower), diffraction="all")
    assert len(there.edge_paths or ()) == len(back.edge_paths or ()) == 11  # two over one edge, nine over two
    assert there.h[0, 0, 0, 0] == pytest.approx(back.h[0, 0, 0, 0], rel=1e-7)


_TILTED = SimpleNamespace(
    name="tilted", field=lambda theta, phi: (np.sin(theta) * np.cos(8 * theta), 0.5 * np.cos(theta + phi))
)


@pytest.mark.parametrize("patterns", [(Isotropic(),), (_TILTED,)])
@pytest.mark.parametrize("uav", [(70.0, 4.0, 2.0), (66.0, 41.0, 3.0)])
def test_a_link_over_two_edges_turned_round_is_the_same(uav: tuple[float, float, float], patterns: tuple) -> None:
    """Vertical and slanted elements, with a pattern each meets the edge of its own end; edges parallel and not."""
    tower = (0.0, 0.0, 5.0)
    array = Array(np.zeros((2, 3)), np.array([0.0, np.pi / 3]), patterns=patterns)
    link = Link(HZ, {"T": array}, array)
    both = "edges", "all"
    there = [trace(place(BARN, tower=tower), link, poses(uav), diffraction=d).h[0, 0] for d in both]
    back = [trace(place(BARN, tower=uav), link, poses(tower), diffraction=d).h[0, 0].T for d in both]
    over_two, turned = there[1] - there[0], back[1] - back[0]
    assert np.abs(over_two).max() > 1e-11
    assert np.abs(over_two - turned).max() < 1e-4 * np.abs(over_two).max()


@pytest.mark.parametrize("material", ["concrete", "metal"])
@pytest.mark.parametrize("height", [5.0, 7.9, 8.3])
def test_level_over_two_edges_is_continuous(height: float, material: str) -> None:
    """Through the plane of the roof behind the barn, and through the shadow boundary of a tower above it."""
    pytest.importorskip("numba")
    near = 1e-3 if material == "concrete" else 5e-4  # within 7 mm of the plane the reflection off metal turns
    for at in (8.0, *((8.3 - 0.3 * 70.0 / 40.0,) if height == 8.3 else ())):
        heights = at + np.array([-near, -1e-5, 0.0, 1e-5, near])
        site = place(replace(BARN, material=material), tower=(0.0, 0.0, height))
        level = trace(site, LINK, poses(*((70.0, 3.0, z) for z in heights)), diffraction="all").rss_dbm[:, 0]
        assert np.ptp(level) < 0.1


def test_silent_places_are_reached() -> None:
    site, link, flown = random_scene(400)
    spots = flown.position_m.copy()
    spots[::2, 2], spots[1::2, 2] = 2.0, 8.0
    low = Poses(spots, flown.rotation)
    dark, lit = (replay(site, link, low, Search(diffraction=d)) for d in ("none", "edges"))
    outside = np.array([not any(b.footprint.contains(p) for b in site.buildings) for p in _points(spots)])
    outside |= spots[:, 2] > max(b.height_m for b in site.buildings)
    silent = ~dark.has_path[:, 0] & outside
    assert silent.sum() >= 20
    assert lit.has_path[silent, 0].all()
    assert np.isfinite(lit.h).all()


def _points(spots: np.ndarray) -> list:
    return [Point(p[:2]) for p in spots]


def test_one_wall_on_a_side_adds_paths() -> None:
    far_wall = Building("wall", box(90, -40, 92, 40), 12.0)
    site, where = place(BARN, far_wall), poses((70.0, 2.0, 1.5))
    some, every = (trace(site, LINK, where, diffraction=d).edge_paths for d in ("edges", "all"))
    assert some is not None
    assert every is not None
    assert len(every) > len(some)
    walls = every.ground[(every.ground >= 0).any(axis=1)].max()
    assert walls > 0  # a face of a building


# --- hard cases ----------------------------------------------------------------------------------------------------


def test_edges_of_a_box_and_of_a_hole() -> None:
    assert len(Edges.of(site_faces(place(BARN)))) == 8
    ell = Building("ell", box(0, 0, 30, 30).difference(box(10, 10, 30, 30)), 6.0)
    edges = Edges.of(site_faces(place(ell)))
    assert len(edges) == 6 + 5  # six rims, and no edge in the inner corner
    assert np.allclose(edges.exterior, 1.5)
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
@pytest.mark.parametrize("mode", ["edges", "all"])
def test_no_path_bends_where_a_neighbour_touches_a_face(east_m: float, mode: str) -> None:
    """From above, too: of the common wall alone what stands out of the lower roof can bend a wave."""
    west, east = Building("west", box(40, -15, 46, 25), 8.0), Building("east", box(46, -15, 52, 25), east_m)
    where = poses((70.0, 3.0, 20.0), (30.0, 6.0, 15.0), (46.0, -40.0, 9.0), (49.0, 60.0, 3.0))
    halves = place(west, east, tower=(0.0, 0.0, 16.0))
    paths = trace(halves, LINK, where, diffraction=mode).edge_paths
    assert paths is not None
    corners = paths.vertices_m[np.isfinite(paths.vertices_m[..., 0])]
    between = np.isclose(corners[:, 0], 46.0)
    assert (corners[between, 2] > 8.0 + 1e-6).all()
    assert between.any() == (east_m > 8.0)
    assert {40.0, 52.0} <= set(np.round(corners[:, 0], 6))
    if east_m == 8.0 and mode == "edges":  # two edges need a face in common, and the roof has two parts here
        undivided = trace(place(BARN, tower=(0.0, 0.0, 16.0)), LINK, where, diffraction=mode)
        assert trace(halves, LINK, where, diffraction=mode).rss_dbm == pytest.approx(undivided.rss_dbm, abs=1e-9)


def test_ends_on_an_edge_are_no_numbers_that_are_none() -> None:
    corner, rim = (40.0, -15.0, 4.0), (46.0, 25.0, 8.0)
    result = trace(place(BARN, tower=(40.0, 3.0, 8.0)), LINK, poses(corner, rim, (70.0, 0.0, 2.0)), diffraction="all")
    assert np.isfinite(result.h).all()
    above = trace(place(BARN, tower=(40.0, 3.0, 8.2)), LINK, poses((70.0, 0.0, 2.0)), diffraction="all")
    assert above.has_path[0, 0]


@pytest.mark.parametrize("apart_m", [0.0, 1e-9, 1e-5])
@pytest.mark.parametrize("mode", ["edges", "all"])
def test_a_side_without_length_is_no_edge(apart_m: float, mode: str) -> None:
    """A corner given twice, or two corners closer than a wave can tell."""
    twice = Polygon([(40, -15), (52, -15), (52, -15 + apart_m), (52, 25), (40, 25)])
    where = poses((70.0, 3.0, 2.0), (30.0, 60.0, 1.0), (60.0, -40.0, 9.0), (52.0, -15.0, 4.0))
    clean, degenerate = (
        trace(place(building), LINK, where, diffraction=mode) for building in (BARN, Building("twice", twice, 8.0))
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
    first, second = trace(site, LINK, where), trace(site, LINK, where, diffraction="all")
    assert np.array_equal(first.h, second.h)


# --- compiled code and scenes of triangles ---------------------------------------------------------------------------


def test_compiled_search_and_field_are_those_of_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("numba")
    site, link, flown = random_scene(16, buildings=6, towers=2)
    flown.position_m[::2, 2] = 3.0
    replayed = {}
    for mode in ("never", "always"):
        monkeypatch.setenv("AERPAW_CMP_COMPILED", mode)
        replayed[mode] = replay(site, link, flown, Search(diffraction="edges"))
    ours, plain = (_rows(replayed[mode].edge_paths) for mode in ("always", "never"))
    assert len(plain) > 300
    assert ours == plain
    assert np.abs(replayed["always"].h - replayed["never"].h).max() < 1e-11 * np.abs(replayed["never"].h).max()


def _rows(paths) -> set[tuple[int, ...]]:
    columns = np.column_stack([paths.pose, paths.tower, paths.edge, paths.ground])
    return set(map(tuple, columns.tolist()))


def test_a_box_of_triangles_diffracts_as_a_prism() -> None:
    pytest.importorskip("numba")
    prism = place(BARN)
    faces = site_faces(prism)
    vertices, triangle, owner = triangles(faces, 500.0)
    materials = tuple(faces.material[i] for i in range(len(faces)))
    scene = TriangleScene(vertices, triangle, owner, tuple(map(str, range(len(faces)))), materials)
    mesh = replace(place(), scene=scene)
    where = poses((70.0, 3.0, 2.0), (30.0, 60.0, 1.0), (60.0, -40.0, 9.0), (46.0, 40.0, 3.0))
    for mode in ("edges", "all"):
        by_prism, by_mesh = (trace(site, LINK, where, diffraction=mode) for site in (prism, mesh))
        assert len(by_prism.edge_paths or ()) == len(by_mesh.edge_paths or ()) > 8
        assert np.abs(by_prism.h - by_mesh.h).max() < 1e-6 * np.abs(by_prism.h).max()


def test_the_face_below_a_point_is_the_highest_beneath_it() -> None:
    """Tilted, overlapping and upright triangles: heights by shapely's interpolation on their corners."""
    pytest.importorskip("numba")
    generator = np.random.default_rng(4)
    corners = generator.uniform([-9, -9, 0], [9, 9, 6], (25, 3, 3))
    corners[0, :, 0] = 3.0  # upright
    scene = TriangleScene(
        corners.reshape(-1, 3), np.arange(75).reshape(-1, 3), np.arange(25), tuple(map(str, range(25))), ("metal",) * 25
    )
    surfaces = merged(scene)
    points = generator.uniform([-9, -9, 1], [9, 9, 8], (60, 3))
    points[7] = np.nan
    expected = []
    for point in points:
        best = (-np.inf, -1)
        for triangle, face in zip(surfaces.corners_m, surfaces.face.tolist(), strict=True):
            if np.isfinite(point).all() and Polygon(triangle[:, :2]).contains(Point(point[:2])):
                height = triangle[:, 2] @ np.linalg.solve(np.vstack([triangle[:, :2].T, np.ones(3)]), [*point[:2], 1.0])
                best = max(best, (height, face)) if height < point[2] else best
        expected.append(best[1])
    assert _below(surfaces, points).tolist() == expected
    assert min(expected.count(-1), len(set(expected))) > 5


def test_the_border_of_a_sheet_is_a_half_plane() -> None:
    pytest.importorskip("numba")
    sheet = np.array([[30.0, -40, 0], [30, 40, 0], [30, 40, 6], [30, -40, 6]])
    scene = TriangleScene(sheet, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, np.int64), ("sheet",), ("metal",))
    edges = Edges.of_surfaces(merged(scene))
    assert np.allclose(edges.exterior, 2.0)
    assert sorted(edges.length_m.tolist()) == pytest.approx([6.0, 6.0, 80.0, 80.0])
    with_barn = surfaces_of(replace(place(BARN), scene=scene))
    assert with_barn is not None
    assert {label.split()[0] for label in with_barn.faces.label} == {"sheet", "barn"}
    result = trace(replace(place(), scene=scene), LINK, poses((60.0, 1.0, 2.0)), max_depth=0, diffraction="edges")
    assert result.edge_paths is not None
    at = result.edge_paths.vertices_m[:, 1]
    assert ((at[:, 2] == 6.0) & (np.abs(at[:, 1]) < 39.0)).sum() == 1


def half_a_wedge(
    edges: Edges, edge: int, shared: int, end: np.ndarray, legs: tuple[float, float], way: np.ndarray, eta
):
    """Of one of two edges, by Fresnel integrals: sine with the ray, root, near H (TE, TM), near S, far H, far S.

    Near parts, which jump in the plane of the face, lack their transition functions.
    """
    n, e = edges.exterior[edge], edges.along[edge]
    sine = math.sqrt(1 - float(way @ e) ** 2)
    kl = K * legs[0] * legs[1] * sine**2 / (legs[0] + legs[1])
    apart = end - edges.start_m[edge]
    angle = math.atan2(apart @ edges.normal[edge], apart @ edges.face_axis[edge]) % (2 * math.pi)
    angle = n * math.pi - angle if shared else angle
    scale = -np.exp(-0.25j * np.pi) / (2 * n * math.sqrt(2 * math.pi))
    held = fresnel(sine * math.sin(angle) * legs[0] / legs[2], *eta, WAVELENGTH) if angle < math.pi else (1.0, 1.0)
    x = [2 * kl * math.sin(((np.pi + s * angle) % (2 * n * np.pi) + n * np.pi) % (2 * n * np.pi) / 2 - n * np.pi / 2) ** 2
         for s in (-1, 1)]  # fmt: skip
    cosecant = [x[k] / math.sin((np.pi + s * angle) / (2 * n)) ** 2 for k, s in enumerate((-1, 1))]
    near = math.sqrt(x[0]) / math.tan((np.pi - angle) / (2 * n))
    far = _cotangent(angle, 1, n, kl)
    slope = 2j * scale / (n * sine)
    return (
        sine,
        math.sqrt(x[0]),
        [scale * near * factor for factor in held],
        -slope * cosecant[0],
        scale * far,
        (slope * cosecant[1] * (1 - _transition(x[1]))),
    )


def heights(a: float, b: float, coupling: float, power: int) -> complex:
    """``u^power e^{-j (u^2 + v^2 - 2 coupling u v + 2 a u + 2 b v)}`` over positive u and v, counted on a turned grid."""
    most = 7 / math.sqrt(1 - coupling**2)
    (u, du), (v, dv) = (
        (0.5 * (nodes + 1) * long, 0.5 * weights * long)
        for long in (min(most, 30 / max(slope, 1e-3)) for slope in (a, b))
        for nodes, weights in (np.polynomial.legendre.leggauss(160),)
    )
    turn = np.exp(0.25j * np.pi)
    grid = np.exp(-(u[:, None] ** 2) - v**2 + 2 * coupling * u[:, None] * v - 2 * turn * (a * u[:, None] + b * v))
    return complex((u**power * du) @ grid @ dv * (1 / turn) ** (2 + power))


def joined_edges(wedge_1, wedge_2, coupling: float) -> tuple[complex, list[complex], list[complex]]:
    """Soft, mixed and hard products of what :func:`half_a_wedge` gives of two edges."""
    (_, a, near_1, slope_1, far_1, bend_1), (_, b, near_2, slope_2, far_2, bend_2) = wedge_1, wedge_2
    f, g = (_transition(root**2) for root in (a, b))
    plus, minus = heights(a, b, coupling, 0), heights(a, b, -coupling, 0)
    up, down = heights(a, b, -coupling, 1), heights(b, a, -coupling, 1)
    soft = bend_1 * (bend_2 + slope_2 * (1 - g)) + slope_1 * (1 - f) * bend_2
    soft += 1j / coupling * slope_1 * slope_2 * (plus - minus)
    mixed, hard = [], []
    for h, k in zip(near_1, near_2, strict=True):
        hard_1, hard_2 = far_1 + h * f / a, far_2 + k * g / b
        value = bend_1 * hard_2 + bend_2 * hard_1 + slope_1 * (1 - f) * far_2 + slope_2 * (1 - g) * far_1
        mixed.append(value - 4 * (slope_1 * k * up + slope_2 * h * down))
        hard.append(far_1 * hard_2 + h * f / a * far_2 - 2 * h * k * (plus + minus))
    return soft, mixed, hard


@pytest.mark.parametrize("material", ["concrete", "metal", "medium_dry_ground"])
def test_field_over_two_edges_a_second_time(material: str) -> None:
    """The sum in the notes of ``over_two`` from polylines, shortest ways of each pair of elements, impedances at 0 deg."""
    pytest.importorskip("numba")
    barn, where = place(replace(BARN, material=material), tower=(0.0, 0.0, 5.0)), poses(
        (70.0, 4.0, 2.0), (66.0, 41.0, 3.0), (47.0, 60.0, 9.0), (75.0, -20.0, 7.0)
    )  # fmt: skip
    array = Array(
        np.array([[0.0, 0.2, 0.1], [0.0, -0.3, 0.2]]), np.array([0.0, np.pi / 3]), mount=np.array(turned(30, 10, 5))
    )
    link = Link(HZ, {"T": array}, array)
    source, expected = np.array([0.0, 0.0, 5.0]), Expected.of(link).link.uav
    result = trace(barn, link, where, diffraction="all")
    every, edges = result.edge_paths, edges_of(result)
    assert every is not None
    paths = every.select((every.edge[:, 1] >= 0) & (every.ground < 0).all(axis=1))
    ours = amplitudes(paths, Tables.of(edges, result.faces, source[None], where, link), link)
    eta = permittivity(material, HZ)
    impedance = [2e-7 / (1 + r) for r in fresnel(1e-7, *eta, WAVELENGTH)]
    hero = ByForce.hero
    seen = set()
    for row in range(len(paths)):
        e, h = paths.edge[row]
        line = np.array([source, *paths.vertices_m[row, 1:3], where.position_m[paths.pose[row]]])
        legs = np.diff(line, axis=0)
        s = np.linalg.norm(legs, axis=1)
        rays = legs / s[:, None]
        wedge_1 = half_a_wedge(
            edges, e, paths.shared[row, 0], line[0], (s[0], s[1], math.dist(line[0], line[2])), rays[1], eta
        )
        wedge_2 = half_a_wedge(
            edges, h, paths.shared[row, 1], line[3], (s[2], s[1], math.dist(line[3], line[1])), rays[1], eta
        )
        out = edges.normal_n[e] if paths.shared[row, 0] else edges.normal[e]
        joined = []
        soft, mixed, hard = joined_edges(wedge_1, wedge_2, math.sqrt(s[0] * s[2] / ((s[0] + s[1]) * (s[1] + s[2]))))
        for pole, z in enumerate(impedance):
            q = K * s[1] * z**2 / 2
            w = 1 / (1 + np.sqrt(1j * np.pi * q) + 2j * q)
            x = 2 * np.sqrt(1j * K * s[1] * w)
            value = (1 - w) ** 2 * soft + x * (1 - w) * mixed[pole] + x**2 * hard[pole]
            joined.append(value / (2j * K * s[1]))
        # along the face and out of it, carried from the ray between the edges to the rays at both ends
        unit = [np.cross(out, rays[1]), out]
        turns = []
        for ray, edge in ((rays[0], edges.along[e]), (rays[2], edges.along[h])):
            basis = [np.cross(edge, r) / np.linalg.norm(np.cross(edge, r)) for r in (rays[1], ray)]
            flat = [np.cross(r, b) for r, b in zip((rays[1], ray), basis, strict=True)]
            turns.append([(u @ basis[0]) * basis[1] + (u @ flat[0]) * flat[1] for u in unit])
        sent = [np.array(element_wave(expected, k, expected.mount, tuple(rays[0]))) for k in (0, 1)]
        received = [np.array(element_wave(expected, k, expected.mount, tuple(-rays[2]))) for k in (0, 1)]
        for u, t in itertools.product((0, 1), repeat=2):
            a, b = line[0] + array.mount @ array.positions_m[t], line[3] + array.mount @ array.positions_m[u]
            p, g = line[1:2], line[2:3]
            for _ in range(200):
                p = hero(SimpleNamespace(edges=edges), np.array([e]), a[None], g)
                g = hero(SimpleNamespace(edges=edges), np.array([h]), p, b[None])
            total = float(np.linalg.norm(a - p) + np.linalg.norm(p - g) + np.linalg.norm(g - b))
            coupling = sum(d * (received[u] @ v) * (sent[t] @ w) for d, w, v in zip(joined, *turns, strict=True))
            value = (
                coupling / (2 * K**2 * wedge_1[0] * wedge_2[0] * np.sqrt(s.prod() * total)) * np.exp(-1j * K * total)
            )
            assert ours[row, u, t] == pytest.approx(value, abs=2e-5 * np.abs(ours[row]).max())
        seen.add(tuple(paths.shared[row].tolist()))
    assert len(paths) >= 12
    assert seen == {(0, 1), (1, 0), (1, 1)}


def right_handed(edges: Edges) -> None:
    """Face n lies at the exterior angle from face 0, through air, and its normal points back into that air."""
    assert np.allclose(np.cross(edges.face_axis, edges.normal), edges.along)
    assert np.allclose(np.linalg.norm(edges.end_m - edges.start_m, axis=1), edges.length_m)
    assert np.allclose(edges.start_m + edges.length_m[:, None] * edges.along, edges.end_m)
    turn = np.pi * edges.exterior[:, None]
    assert np.allclose(edges.normal_n, np.sin(turn) * edges.face_axis - np.cos(turn) * edges.normal)


def fan(angles_deg: list[float], shift_m: float = 0.0, long_m: float = 5.0) -> SimpleNamespace:
    """Sheets of two triangles that meet in a line along north, 10 m up, each at an angle from east; turned anyhow."""
    rng, corners, normals = np.random.default_rng(int(sum(angles_deg))), [], []
    for number, angle in enumerate(np.radians(angles_deg)):
        out = np.array([np.cos(angle), 0.0, np.sin(angle)])
        foot = np.array([0.0, 0.0, 10.0]) + number * shift_m * np.array([1.0, 0.0, 1.0])
        a, b = foot - np.array([0, long_m, 0]), foot + np.array([0, long_m, 0])
        quad = [a, b, b + 4 * out, a + 4 * out]
        corners += [rng.permutation([quad[k] for k in rows]) for rows in ((0, 1, 2), (0, 2, 3))]
        normals.append(np.cross(out, [0.0, 1.0, 0.0]))
    face = np.repeat(np.arange(len(angles_deg)), 2)
    return SimpleNamespace(corners_m=np.array(corners), face=face, faces=SimpleNamespace(normal=np.array(normals)))


@pytest.mark.parametrize(
    ("angles_deg", "more", "expected"),
    [
        ([30], {}, [2.0]), ([20, 110], {}, [1.5]), ([20, 60, 120], {}, [260 / 180]), ([-60, 60], {}, [240 / 180]),
        ([20, 200], {}, []), ([20, 199], {}, []), ([20, 197], {}, [183 / 180]), ([20, 110, 200], {}, []),
        ([20, 110], {"shift_m": 4e-5}, [1.5]), ([20, 110], {"shift_m": 1e-3}, [2.0, 2.0]), ([30, 31], {}, [359 / 180]),
        ([20, 110], {"long_m": 0.0049}, []), ([20, 110], {"long_m": 0.0052}, [1.5]),
    ],
)  # fmt: skip
def test_sheets_that_meet_bend_round_their_widest_gap(angles_deg, more, expected) -> None:
    edges = Edges.of_surfaces(fan(angles_deg, **more))
    right_handed(edges)
    ends = np.stack([edges.start_m, edges.end_m])
    common = (np.abs(ends[..., [0, 2]] - [0.0, 10.0]) < 0.01).all(axis=(0, 2))
    assert sorted(edges.exterior[common].tolist()) == pytest.approx(expected)
    for face, exterior in zip(edges.face[common], edges.exterior[common], strict=True):
        assert (face[0] == face[1]) == (exterior == 2.0)
    far = edges.exterior[~common]
    assert (far == 2.0).all()
    if not more:
        assert len(far) == 3 * len(angles_deg)


def test_level_ground_has_no_outer_border_but_a_plate_over_it_has() -> None:
    def level(east: float, north: float, half: float, up: float) -> np.ndarray:
        x, y = np.array([-half, half, half, -half]) + east, np.array([-half, -half, half, half]) + north
        quad = np.column_stack([x, y, np.full(4, up)])
        return quad[[[0, 1, 2], [0, 2, 3]]]

    up = SimpleNamespace(normal=np.tile([0.0, 0.0, 1.0], (3, 1)))
    ground, plate = level(0, 0, 50, 0), level(20, 5, 3, 4)
    for parts, count in (([ground], 0), ([ground, plate], 4), ([ground, plate, plate], 0)):
        surfaces = SimpleNamespace(corners_m=np.concatenate(parts), faces=up, face=np.repeat(range(len(parts)), 2))
        if len(parts) == 3:
            surfaces.face = np.array([0, 0, 1, 1, 1, 1])  # each triangle of a face twice: no air between them
        edges = Edges.of_surfaces(surfaces)
        right_handed(edges)
        assert len(edges) == count
    tilted = SimpleNamespace(normal=np.array([[0.0, -np.sin(0.2), np.cos(0.2)]]))
    slope = np.einsum("ij,tkj->tki", [[1, 0, 0], [0, np.cos(0.2), 0], [0, np.sin(0.2), 1]], level(0, 0, 50, 0))
    assert len(Edges.of_surfaces(SimpleNamespace(corners_m=slope, faces=tilted, face=np.zeros(2, int)))) == 4


@pytest.mark.parametrize(("sides", "ground_m", "uprights"), [(3, 0.0, 3), (6, 1.0, 6), (5, 7.9, 5), (4, 8.0, 0)])
def test_edges_of_a_regular_prism(sides: int, ground_m: float, uprights: int) -> None:
    """Uprights turn by a whole turn over the number of sides and begin at the ground; what it buries is no edge."""
    angle = 2 * np.pi * np.arange(sides) / sides
    tower = Building("tower", Polygon(np.column_stack([50 + 9 * np.cos(angle), 9 * np.sin(angle)])), 8.0)
    edges = Edges.of(site_faces(place(tower)), ground_m)
    right_handed(edges)
    upright = np.abs(edges.along[:, 2]) == 1.0
    assert (upright.sum(), (~upright).sum()) == (uprights, sides if ground_m < 8.0 else 0)
    assert edges.exterior[~upright] == pytest.approx(1.5)
    assert edges.exterior[upright] == pytest.approx(1 + 2 / sides)
    assert edges.start_m[upright, 2] == pytest.approx(ground_m)
    assert (edges.end_m[:, 2] == 8.0).all()
    assert edges.length_m[~upright] == pytest.approx(18 * np.sin(np.pi / sides))


def test_polylines_of_paths_over_edges_leave_out_what_is_not_used() -> None:
    points = np.arange(24.0).reshape(2, 4, 3)
    points[0, [0, 2]], points[1, 3] = np.nan, np.nan
    lines = EdgePaths.of(np.zeros((2, 8), np.int64), points).as_path_set()
    assert lines.depth.tolist() == [2, 3]
    assert (lines.faces == -1).all()
    for row, used in ((0, [1, 3]), (1, [0, 1, 2])):
        assert np.array_equal(lines.vertices_m[row, : len(used)], points[row, used])
        assert np.isnan(lines.vertices_m[row, len(used) :]).all()


def test_paths_over_edges_are_explained_by_their_levels() -> None:
    where = poses((70.0, 3.0, 2.0))
    result = trace(place(BARN), LINK, where, diffraction="edges")
    lines = further_path_lines(result, np.array([0.0, 0.0, 10.0]), where, LINK)
    assert result.edge_paths is not None
    assert len(lines) == len(result.edge_paths) == 2
    assert all("edge of barn wall" in line for line in lines)
    levels = [float(line.split()[2]) for line in lines]
    assert levels == sorted(levels, reverse=True)
    heights = sorted(float(line.split(" m")[-2].rsplit(", ", 1)[1]) for line in lines)
    assert heights == pytest.approx(sorted(result.edge_paths.vertices_m[:, 1, 2]), abs=0.051)
    ground = (result.edge_paths.ground >= 0).any(axis=1).sum()
    assert sum(line.endswith(", ground") or "dBm: ground, " in line for line in lines) == ground == 1
    assert 10 * math.log10(sum(10 ** (v / 10) for v in levels)) == pytest.approx(result.rss_power_dbm[0, 0], abs=0.02)

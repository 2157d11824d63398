"""Paths through walls: laws of the slab, closed forms, reciprocity."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from shapely.affinity import rotate
from shapely.geometry import Polygon, box

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.flight.replay import part_of
from aerpaw_cmp.propagation import compiled
from aerpaw_cmp.propagation.arrays import Link, Poses, linear_array, single_element
from aerpaw_cmp.propagation.check.field_audit import Expected, against_reference
from aerpaw_cmp.propagation.drivers.moving import replay_moving
from aerpaw_cmp.propagation.drivers.parts import replay_in_parts
from aerpaw_cmp.propagation.field.fresnel import coefficients, transmission
from aerpaw_cmp.propagation.options import Field, Run, Search
from aerpaw_cmp.propagation.replay import Replay, replay
from aerpaw_cmp.site.materials import material
from aerpaw_cmp.site.site import Building, Site, Tower

CARRIER = 3.4e9
WAVELENGTH = wavelength_m(CARRIER)
RANDOM = np.random.default_rng(11)
COSINE, PERMITTIVITY, LOSS, THICKNESS = (
    RANDOM.uniform(*limits, 400) for limits in ((0.02, 1.0), (1.0, 9.0), (-3.0, 0.0), (0.0, 4.0))
)


def through(cosine: Any, eta: Any, thickness: Any) -> tuple[Any, Any]:
    te_re, te_im, tm_re, tm_im = transmission(cosine, (np.real(eta), np.imag(eta), thickness))
    return te_re + 1j * te_im, -(tm_re + 1j * tm_im)


def back(cosine: Any, eta: Any, thickness: Any) -> tuple[Any, Any]:
    te_re, te_im, tm_re, tm_im = coefficients(cosine, (np.real(eta), np.imag(eta), thickness))
    return te_re + 1j * te_im, tm_re + 1j * tm_im


def test_a_slab_without_loss_keeps_the_energy() -> None:
    for r, t in zip(back(COSINE, PERMITTIVITY, THICKNESS), through(COSINE, PERMITTIVITY, THICKNESS), strict=True):
        assert np.abs(r) ** 2 + np.abs(t) ** 2 == pytest.approx(np.ones(400), abs=1e-12)
    lossy = PERMITTIVITY + 1j * LOSS
    for r, t in zip(back(COSINE, lossy, THICKNESS), through(COSINE, lossy, THICKNESS), strict=True):
        assert (np.abs(r) ** 2 + np.abs(t) ** 2 <= 1.0 + 1e-12).all()


def test_no_thickness_and_air_are_no_wall_and_half_waves_are_windows() -> None:
    for t in through(COSINE, PERMITTIVITY + 1j * LOSS, np.zeros(400)):
        assert t == pytest.approx(np.ones(400), abs=1e-12)
    for t in through(COSINE, np.ones(400), THICKNESS):
        assert t == pytest.approx(np.ones(400), abs=1e-12)
    windows = 0.5 * RANDOM.integers(1, 5, 400) / np.sqrt(PERMITTIVITY - 1 + COSINE**2)
    for t in through(COSINE, PERMITTIVITY, windows):
        assert np.abs(t) == pytest.approx(np.ones(400), abs=1e-9)


def test_transmission_is_that_of_the_transfer_matrix() -> None:
    """Abeles' matrices of both faces and the layer, tangential fields and admittances: no Fresnel coefficient."""
    eta = PERMITTIVITY + 1j * LOSS
    root = np.sqrt(eta - 1 + COSINE**2)
    delta = 2 * np.pi * THICKNESS * root
    free = np.exp(2j * np.pi * THICKNESS * COSINE)
    for t, outside, within in zip(
        through(COSINE, eta, THICKNESS), (COSINE, 1 / COSINE), (root, eta / root), strict=True
    ):
        front = np.cos(delta) + 1j * np.sin(delta) / within * outside
        behind = 1j * np.sin(delta) * within + np.cos(delta) * outside
        # E at the front for E = 1 at the back, as forward wave and echo; TM in E along the layer on both sides
        assert t == pytest.approx(2 * outside / (outside * front + behind) * free, abs=1e-10)


def house(footprint: Polygon, wall: str = "concrete with thickness=0.2", height: float = 30.0) -> Site:
    building = (Building("house", footprint, height, material=wall),)
    return Site("s", SiteFrame(35.7, -78.7), {"T": Tower("T", 35.7, -78.7, 0.0, 0.0)}, buildings=building)


def run(site: Site, places: Any, array: Any = None, **search: Any) -> Replay:
    place = np.atleast_2d(np.asarray(places, dtype=np.float64))
    link = Link(CARRIER, {"T": array or single_element()}, array or single_element())
    poses = Poses(place, np.tile(np.eye(3), (len(place), 1, 1)))
    return replay(site, link, poses, Search(**{"max_depth": 0, "refraction": True, **search}))


@pytest.mark.parametrize("turn_deg", [0.0, 35.0])
def test_behind_a_house_the_line_of_sight_is_that_of_free_space_times_two_walls(turn_deg: float) -> None:
    site = house(rotate(box(40.0, -30.0, 60.0, 30.0), turn_deg))
    dark, lit = run(site, [100.0, 0.0, 10.0], refraction=False), run(site, [100.0, 0.0, 10.0])
    open_ = run(dataclasses.replace(site, buildings=()), [100.0, 0.0, 10.0])
    assert not dark.has_path.any()
    cosine = np.array([np.cos(np.radians(turn_deg))])
    concrete = material("concrete with thickness=0.2")
    te, _ = through(cosine, np.array([concrete.relative_permittivity(CARRIER)]), np.array([0.2 / WAVELENGTH]))
    # upright elements, level ray, upright walls: the field lies across the plane of incidence
    assert (lit.h / open_.h).item() == pytest.approx(te.item() ** 2, rel=1e-9)
    assert lit.rss_dbm[0, 0] == pytest.approx(open_.rss_dbm[0, 0] + 40 * np.log10(abs(te.item())), abs=1e-9)


SCENE = (
    Building("a", box(20.0, -15.0, 35.0, 10.0), 14.0, material="brick"),
    Building("b", Polygon([(50, -5), (75, -5), (75, 30), (62, 30), (62, 12), (50, 12)]), 9.0, material="wood"),
)
PLACES = np.random.default_rng(3).uniform([80, -60, 1.5], [140, 60, 30], (60, 3))


def town() -> Site:
    return dataclasses.replace(house(box(0, 0, 1, 1)), buildings=SCENE)


def test_turned_round_the_channel_is_the_same() -> None:
    for place in PLACES[:12]:
        there = run(town(), place, max_depth=2)
        tower = Tower("T", 35.7, -78.7, float(place[0]), float(place[1]), antenna_height_m=float(place[2]))
        back_ = run(dataclasses.replace(town(), towers={"T": tower}), [0.0, 0.0, 10.0], max_depth=2)
        assert there.h.item() == pytest.approx(back_.h.item(), rel=1e-9)


def test_walls_of_air_and_thin_walls_are_not_there() -> None:
    empty = run(dataclasses.replace(town(), buildings=()), PLACES, max_depth=1)
    air = "constant with permittivity=1 conductivity=0 thickness=0.3"
    without_thickness = "concrete with thickness=0"
    for wall in (air, without_thickness):
        site = dataclasses.replace(town(), buildings=tuple(dataclasses.replace(b, material=wall) for b in SCENE))
        same = run(site, PLACES, max_depth=1)
        assert same.through is not None
        assert len(same.through.paths) > 20
        assert same.h == pytest.approx(empty.h, rel=1e-5)


def test_off_by_default_and_nothing_changes_where_nothing_is_hidden() -> None:
    places = np.concatenate([PLACES, PLACES * [-1.0, 1.0, 1.0]])
    plain, asked = run(town(), places, refraction=False), run(town(), places)
    assert not Search().refraction
    assert asked.through is not None
    lit = np.zeros(len(places), dtype=bool)
    lit[asked.through.paths.pose] = True
    assert 10 < lit.sum() <= len(PLACES)
    assert np.array_equal(asked.h[~lit], plain.h[~lit])
    assert np.array_equal(asked.paths.faces, plain.paths.faces)
    half_space = dataclasses.replace(SCENE[0], material="medium_dry_ground")
    dark = run(dataclasses.replace(town(), buildings=(half_space,)), [100.0, 0.0, 8.0])
    assert not dark.has_path.any()


@pytest.mark.skipif(not compiled.beams().kernels, reason="numba is not here")
def test_compiled_code_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    array = linear_array(3, 0.04)
    fields = []
    for switch in ("never", "always"):
        monkeypatch.setenv(compiled.SWITCH, switch)
        fields.append(run(town(), PLACES, array, max_depth=2).h)
    assert fields[0] == pytest.approx(fields[1], abs=1e-12 * np.abs(fields[0]).max())


def test_a_part_of_a_replay_is_the_replay_of_its_poses() -> None:
    """Channels of one tower are replayed together and cut apart: their paths through walls and over edges as well."""
    link = Link(CARRIER, {"T": single_element()}, single_element())
    search = Search(max_depth=1, diffraction="edges", refraction=True)

    def of(places: Any) -> Replay:
        return replay(town(), link, Poses(places, np.tile(np.eye(3), (len(places), 1, 1))), search, Field(), Run())

    part, alone = part_of(of(PLACES), 4, 9), of(PLACES[4:9])
    assert part.edge_paths is not None
    assert alone.edge_paths is not None
    assert part.through is not None
    assert alone.through is not None
    assert min(len(alone.edge_paths.pose), len(alone.through.paths.pose)) > 2
    assert part.edge_paths.pose.tolist() == alone.edge_paths.pose.tolist()
    assert part.through.paths.pose.tolist() == alone.through.paths.pose.tolist()
    assert part.paths.pose.tolist() == alone.paths.pose.tolist()
    assert np.array_equal(part.h, alone.h)


def test_parts_and_moving_towers_keep_the_paths() -> None:
    at_once = run(town(), PLACES, max_depth=1, diffraction="edges")
    link, shares = Link(CARRIER, {"T": single_element()}, single_element()), ([], [])
    search = Search(max_depth=1, refraction=True, diffraction="edges")
    poses = Poses(PLACES, np.tile(np.eye(3), (len(PLACES), 1, 1)))
    parted = replay_in_parts(town(), link, poses, search, Field(), Run(progress=shares[0].append), size=17)
    places = np.repeat([[0.0, 0.0, 10.0], [0.0, 0.0, 10.0 + 1e-12]], len(PLACES) // 2, axis=0)
    moving = replay_moving(town(), link, poses, places, search, run=Run(progress=shares[1].append))
    assert shares[0] == pytest.approx([0.25, 0.5, 0.75, 1.0])
    assert shares[1] == [1.0]
    assert at_once.through is not None
    assert at_once.edge_paths is not None
    for other in (parted, moving):
        assert other.h == pytest.approx(at_once.h, rel=1e-6)
        assert other.through is not None
        assert np.array_equal(np.bincount(other.through.paths.pose), np.bincount(at_once.through.paths.pose))
        assert other.edge_paths is not None
        assert other.edge_paths.pose.tolist() == at_once.edge_paths.pose.tolist()
        assert other.edge_paths.vertices_m == pytest.approx(at_once.edge_paths.vertices_m, abs=1e-9, nan_ok=True)
    assert replay_in_parts(town(), link, poses, search, Field(), Run(), size=len(PLACES)).seconds > 0.0


@pytest.mark.parametrize(("houses", "seen"), [(4, True), (5, False)])
def test_eight_walls_are_passed_and_ten_are_not(houses: int, seen: bool) -> None:
    """Each house takes the same two walls from the level ray; one more house than four takes the path."""
    row = tuple(Building(f"{k}", box(20.0 + 9 * k, -9, 25.0 + 9 * k, 9), 20.0, material="wood") for k in range(houses))
    lit = run(dataclasses.replace(town(), buildings=row), [100.0, 0.0, 10.0])
    one_house, open_ = (
        run(dataclasses.replace(town(), buildings=row[:k]), [100.0, 0.0, 10.0]).h.item() for k in (1, 0)
    )
    assert lit.has_path.item() == seen
    assert lit.h.item() == pytest.approx((one_house / open_) ** houses * open_ if seen else 0.0, rel=1e-9)


def test_steps_of_a_path_are_its_walls_in_order_and_roofs_count() -> None:
    """Each leg of a bent path cut with the boxes by shares: from the roof of the low one to the wall of the high one."""
    boxes = [((20.0, -30.0), (30.0, 30.0), 9.0), ((60.0, -30.0), (70.0, 30.0), 12.0)]
    row = tuple(Building(f"{k}", box(*low, *high), top, material="wood") for k, (low, high, top) in enumerate(boxes))
    target = np.array([90.0, 8.0, 6.0])
    replayed = run(dataclasses.replace(town(), buildings=row), target, max_depth=1)
    assert replayed.through is not None
    paths, kinds, bent = replayed.through.paths, set(), replayed.through.reflections()
    for k in range(len(paths)):
        depth = int(paths.depth[k])
        faces, points = paths.faces[k, :depth], paths.vertices_m[k, :depth]
        own = faces < len(replayed.through.faces) // 2
        assert (paths.faces[k, depth:] == -1).all()
        corners = np.array([[0.0, 0.0, 10.0], *points[own], target])
        expected = []
        for a, b in itertools.pairwise(corners):
            shares = [0.0, 1.0]
            for low, high, top in boxes:
                with np.errstate(divide="ignore"):
                    at = np.sort((np.array([[*low, -50.0], [*high, top]]) - a) / (b - a), axis=0)
                enter, leave = at[0].max(), at[1].min()
                if max(enter, 0.0) < min(leave, 1.0) - 1e-9:
                    shares += [s for s in (enter, leave) if 0 < s < 1]
            expected += [a + s * (b - a) for s in sorted(shares)[1:-1]] + [b]
        assert np.abs(points - np.array(expected[:-1])).max() < 1e-9
        kinds.add((int(own.sum()), int((~own).sum())))
        assert (bent.depth[k], set(bent.faces[k].tolist())) == (own.sum(), {-1})
    assert {(0, 4), (1, 4)} <= kinds


def test_the_audit_names_links_with_paths_through_walls_and_checks_the_others() -> None:
    link = Link(CARRIER, {"T": single_element()}, single_element())
    places = np.concatenate([PLACES[:4], PLACES[:4] * [-1.0, 1.0, 1.0]])
    poses = Poses(places, np.tile(np.eye(3), (8, 1, 1)))
    replayed = replay(town(), link, poses, Search(max_depth=1, refraction=True))
    audit = against_reference(town(), poses, replayed, np.arange(8), Expected.of(link), ks=(10.0,), max_depth=1)
    assert audit.failures == ()
    assert audit.not_covered == ("paths through walls",)
    assert replayed.through is not None
    open_links = np.setdiff1d(np.arange(8), replayed.through.paths.pose)
    planted = dataclasses.replace(replayed, h=1.01 * replayed.h)
    open_audit = against_reference(town(), poses, planted, open_links, Expected.of(link), ks=(10.0,), max_depth=1)
    assert len(open_links) > 0
    assert open_audit.failures

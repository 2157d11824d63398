"""Why a sequence of faces makes no path."""

import math

import numpy as np
import pytest
from shapely.geometry import Polygon, box

from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.propagation.check import reference
from aerpaw_cmp.propagation.check.audit import Expected
from aerpaw_cmp.propagation.check.explain import explain_paths, further_path_lines, power_sum_dbm, simple_paths, why_not
from aerpaw_cmp.propagation.geometry import Links, single_element, site_faces
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.search.mirror import find_paths
from aerpaw_cmp.site.antennas import HalfWaveDipole
from aerpaw_cmp.site.site import Building


def test_reasons_of_geometry(scenes):
    buildings = (
        Building("barn", box(20, -10, 30, 10), 15.0),
        Building("shed", Polygon([(-30, 20), (-10, 20), (-10, 30), (-20, 30), (-20, 40), (-30, 40)]), 6.0),
    )
    faces = site_faces(scenes.site(buildings))
    source, target = np.array([0.0, 0, 10]), np.array([60.0, 0, 10])
    assert why_not(faces, source, target, np.zeros(0, int)) == "occluded by barn"
    wall = next(i for i, label in enumerate(faces.label) if label == "barn wall 4" or faces.normal[i, 0] < -0.9)
    assert "behind a face" in why_not(faces, source, target, np.array([wall]))
    past_wall = np.array([0.0, 60, 10])
    assert "outside barn" in why_not(faces, source, past_wall, np.array([wall]))
    high = np.array([60.0, 0, 60])
    assert why_not(faces, source, high, np.zeros(0, int)) == ""
    assert why_not(faces, source, high, np.array([0])) == "occluded by barn"
    # every path that is found has no reason not to be there, and every one that is not has one
    rng = np.random.default_rng(3)
    targets = np.column_stack([rng.uniform(-80, 80, (40, 2)), rng.uniform(2, 40, 40)])
    paths = find_paths(faces, Links(source[None], targets), max_depth=1)
    for pose, place in enumerate(targets):
        reflecting = set(paths.faces[(paths.pose == pose) & (paths.depth == 1), 0].tolist())
        for face in range(len(faces)):
            assert (why_not(faces, source, place, np.array([face])) == "") == (face in reflecting)


def test_terms_and_places_of_paths_by_hand(scenes):
    """A tower with an upright dipole, ground, a wall 10 m west of it and a UAV to the north-east, 100 m off."""
    site = scenes.site((Building("hall", box(-20, -50, -10, 200), 60.0),))
    source, target = np.array([0.0, 0, 10]), np.array([60.0, 80, 40])
    link, pose = scenes.link(site, single_element(HalfWaveDipole())), scenes.poses(target)
    result = replay(site, link, pose, Search(max_depth=2))
    further = {"leaves": np.where(result.paths.depth == 0, 1.5, np.where(result.paths.depth == 2, np.inf, 0.0))}
    paths = explain_paths(result.paths, result.faces, source, pose, link, further)
    assert [path.words for path in paths][:1] == ["line of sight"]
    assert [path.depth for path in paths] == [0, 1, 1, 2]  # the ray to the wall's image reaches the wall first
    assert np.diff([path.level_dbm for path in paths[:3]]).max() < 0.0
    by_words = {path.words: path for path in paths}
    wall = next(name for name in result.faces.label if name.startswith("hall") and name in by_words)
    flat, wide = 100.0, math.hypot(80, 80)  # seen from above: direct, and to the image of the UAV, 80 m west
    hand = {  # azimuth and elevation at the tower, and where from at the UAV; length
        "line of sight": (36.8699, math.atan2(30, flat), 216.8699, math.atan2(-30, flat), math.hypot(flat, 30)),
        "ground": (36.8699, math.atan2(-50, flat), 216.8699, math.atan2(-50, flat), math.hypot(flat, 50)),
        wall: (315.0, math.atan2(30, wide), 225.0, math.atan2(-30, wide), math.hypot(wide, 30)),
        f"{wall}, ground": (315.0, math.atan2(-50, wide), 225.0, math.atan2(-50, wide), math.hypot(wide, 50)),
    }
    expected = Expected.of(link).link
    second_way, wavelength = reference.Reference(site, "LW1", expected), wavelength_m(scenes.carrier_hz)
    mirrors = {"ground": second_way.mirrors[0], wall: next(m for m in second_way.mirrors if m.normal[0] == 1.0)}
    for name, (away, rise, back, fall, length) in hand.items():
        path = by_words[name]
        assert (path.departure_azimuth_deg, path.arrival_azimuth_deg) == pytest.approx((away, back), abs=1e-4)
        assert (path.departure_elevation_deg, path.arrival_elevation_deg) == pytest.approx(np.degrees([rise, fall]))
        assert path.length_m == pytest.approx(length) == pytest.approx(sum(path.segments_m))
        assert path.delay_ns == pytest.approx(length / 0.299792458)
        sequence = [mirrors[part] for part in (name.split(", ") if path.depth else [])]
        h = second_way.pair(sequence, 0, 0, tuple(target), reference.turned(0, 0, 0))
        assert np.exp(1j * np.radians(path.phase_deg)) == pytest.approx(h / abs(h), abs=1e-6)
        terms = dict(path.terms_db)
        leaves = terms.pop("leaves")
        assert sum(terms.values()) == pytest.approx(20 * math.log10(abs(h)), abs=1e-9)
        assert path.level_dbm == pytest.approx(40.0 + sum(terms.values()) + leaves)
        assert list(terms) == ["tower antenna", *(f"reflection {k + 1}" for k in range(path.depth)), "spreading",
                               "UAV antenna", "polarisation"]  # fmt: skip
        assert terms["spreading"] == pytest.approx(20 * math.log10(wavelength / (4 * math.pi * length)))
        field = math.cos(math.pi / 2 * math.sin(rise)) / math.cos(rise)  # of an upright half-wave dipole, by hand
        assert terms["tower antenna"] == pytest.approx(20 * math.log10(math.sqrt(1.640922) * field), abs=1e-5)
        assert terms["UAV antenna"] == 0.0
        for number, bounce in enumerate(path.bounces):
            mirror = sequence[number]
            cosine = 50 / length if mirror is second_way.mirrors[0] else 80 / length
            constants = reference.permittivity(bounce.material, scenes.carrier_hz)
            te, tm = reference.fresnel(cosine, *constants, wavelength)
            assert (bounce.te_db, bounce.tm_db) == pytest.approx([20 * math.log10(abs(r)) for r in (te, tm)])
            assert bounce.incidence_deg == pytest.approx(math.degrees(math.acos(cosine)))
            assert bounce.loss_db == -terms[f"reflection {number + 1}"] > 0.0
            assert mirror.height((bounce.east_m, bounce.north_m, bounce.up_m)) == pytest.approx(0.0, abs=1e-9)
        assert path.planes == tuple(result.faces.label.index(part) for part in name.split(", ") if path.depth)
    assert by_words["ground"].bounces[0].loss_db == pytest.approx(-by_words["ground"].bounces[0].tm_db)
    assert [path.terms_db["leaves"] for path in paths] == [-1.5, 0.0, 0.0, -math.inf]
    plain = paths[-1].as_dict()
    assert (plain["level_dbm"], plain["terms_db"]["leaves"], "planes" in plain) == (None, None, False)
    assert plain["bounces"][1]["material"] == "medium_dry_ground"
    alone = [10 ** (path.level_dbm / 10) for path in paths[:3]]
    assert power_sum_dbm(paths[:3]) == pytest.approx(10 * math.log10(sum(alone)))
    assert [(name, planes.tolist()) for name, planes in simple_paths(result)] == [
        ("line of sight", []), ("reflection at the ground", [0]),
    ]  # fmt: skip


def test_a_bounce_straight_down_in_words(scenes):
    site = scenes.site((Building("hall", box(40, -15, 52, 25), 8.0, material="wood"),))
    link, pose = scenes.link(site), scenes.poses([0.0, 0.0, 30.0])
    replayed = replay(site, link, pose, Search(max_depth=1))
    (_, ground) = explain_paths(replayed.paths, replayed.faces, np.array([0.0, 0, 10]), pose, link, {})
    assert (ground.bounces[0].incidence_deg, ground.departure_elevation_deg) == pytest.approx((0.0, -90.0))
    free = 40.0 + 20 * math.log10(wavelength_m(scenes.carrier_hz) / (4 * math.pi * 40.0))
    assert ground.level_dbm == pytest.approx(free + ground.bounces[0].te_db)
    assert ground.bounces[0].te_db == pytest.approx(ground.bounces[0].tm_db)
    assert further_path_lines(replayed, np.array([0.0, 0, 10]), pose, link) == []


def test_what_comes_after_an_antenna_that_sends_nothing_loses_nothing(scenes):
    """A dipole does not radiate along its axis: its term takes all, and no later one is made of nothing over nothing."""
    site = scenes.site()
    source, above = np.array([0.0, 0, 10]), scenes.poses([0.0, 0.0, 60.0])
    link = scenes.link(site, single_element(HalfWaveDipole()))
    replayed = replay(site, link, above, Search(max_depth=1))
    explained = explain_paths(replayed.paths, replayed.faces, source, above, link, {})
    assert [path.depth for path in explained] == [0, 1]
    for path in explained:
        assert path.terms_db.pop("tower antenna") == -math.inf
        assert set(path.terms_db.values()) == {0.0}
        assert path.level_dbm == -math.inf

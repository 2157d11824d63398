"""Guards of the sionna engine that need no Sionna, and bounds on memory."""

import tracemalloc

import numpy as np
import pytest

from aerpaw_cmp.common.errors import CheckError
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.jobs.bench import random_scene, speed_against_error
from aerpaw_cmp.propagation.arrays import (
    rotation_from_aircraft,
    rotation_from_yaw_pitch_roll,
    tower_comparison_array,
    uav_comparison_array,
)
from aerpaw_cmp.propagation.faces import site_faces
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.search import sionna

SOURCES = np.array([[0.0, 0.0, 10.0]])
TARGETS = np.array([[100.0, 0.0, 10.0], [0.0, 50.0, 10.0]])


def raw(gain_of_line_of_sight=1.0, gain_of_reflection=0.1):
    """Two poses, one tower, line of sight and one reflection each, as PathSolver gives them."""
    friis = np.sqrt(2.0) * wavelength_m(3.4e9) / (4 * np.pi * np.array([100.0, 50.0]))
    gain = np.zeros((2, 1, 2))
    gain[:, 0, 0] = gain_of_line_of_sight * friis
    gain[:, 0, 1] = gain_of_reflection
    kind = np.zeros((2, 2, 1, 2), dtype=np.uint32)
    kind[0, :, :, 1] = 1
    shape = np.full(kind.shape, 0xFFFFFFFF, dtype=np.uint32)
    primitive = shape.copy()
    shape[0, :, :, 1] = 7
    primitive[0, :, :, 1] = [[1], [0]]
    return {"valid": np.ones((2, 1, 2), dtype=bool), "kind": kind, "gain": gain, "shape": shape, "primitive": primitive}


def test_sound_gains_pass():
    sionna._check_gain(raw(), SOURCES, TARGETS, 3.4e9)


@pytest.mark.parametrize(
    ("settings", "words"), [({"gain_of_line_of_sight": 1.1}, "Friis"), ({"gain_of_reflection": 3.0}, "gains")]
)
def test_a_line_of_sight_unlike_friis_or_a_gain_stops_the_run(settings, words):
    with pytest.raises(CheckError, match=words):
        sionna._check_gain(raw(**settings), SOURCES, TARGETS, 3.4e9)


def test_primitives_become_faces_and_other_interactions_are_dropped():
    paths = raw()
    paths["kind"][1, 1, 0, 1] = 4  # a refraction
    pose, tower, sequence = sionna._sequences(paths, {7: np.array([3, 5])}, np.array([40, 41]), np.array([2]), 2)
    rows = {tuple(row) for row in np.column_stack([pose, tower, sequence]).tolist()}
    assert rows == {(40, 2, -1, -1), (41, 2, -1, -1), (40, 2, 5, -1)}


def test_refinement_drops_duplicates_and_points_outside_their_face(scenes):
    from shapely.geometry import box

    from aerpaw_cmp.site.site import Building

    faces = site_faces(scenes.site([Building("b", box(40, -20, 45, 20), 30.0)]))
    wall = int(np.flatnonzero(faces.normal[:, 0] == -1.0)[0])
    targets = np.array([[20.0, 10.0, 15.0], [20.0, 70.0, 15.0]])  # the second would reflect beside the wall
    pose, sequence = np.array([0, 0, 1]), np.array([[wall, -1], [wall, -1], [wall, -1]])
    found = sionna._refine(faces, SOURCES, targets, pose, np.zeros(3, dtype=int), sequence, 1e-9)
    assert found.pose.tolist() == [0]
    assert found.vertices_m[0, 0, 0] == pytest.approx(40.0, abs=1e-12)


def test_reflections_named_on_the_wrong_part_of_a_plane_are_moved(scenes):
    from shapely.geometry import box

    from aerpaw_cmp.site.site import Building

    site = scenes.site([Building("left", box(30, -20, 40, -1), 20.0), Building("right", box(30, 1, 40, 20), 20.0)])
    faces = site_faces(site)
    left, right = np.flatnonzero(faces.normal[:, 0] == -1.0)
    sequence = np.array([[left, -1]])
    found = sionna._refine(
        faces, SOURCES, np.array([[10.0, 10.0, 10.0]]), np.zeros(1, int), np.zeros(1, int), sequence, 1e-9
    )
    assert found.faces.tolist() == [[right, -1]]


def test_euler_angles_give_the_rotation_back():
    turns = rotation_from_aircraft(*np.random.default_rng(1).uniform(-80, 80, (3, 50)))
    assert rotation_from_yaw_pitch_roll(*sionna._euler(turns).T) == pytest.approx(turns)


def peak_bytes(poses, link, site):
    tracemalloc.start()
    result = replay(site, link, poses)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    kept = sum(getattr(result.paths, name).nbytes for name in ("pose", "tower", "depth", "faces", "vertices_m"))
    return peak, kept + result.h.nbytes


def test_memory_beyond_the_results_does_not_grow_with_the_poses(scenes, monkeypatch):
    monkeypatch.setattr("aerpaw_cmp.propagation.field.sum.PAIRS_PER_CHUNK", 4_000)
    monkeypatch.setattr("aerpaw_cmp.propagation.search.mirror.CELLS_PER_CHUNK", 20_000)
    site = scenes.site()
    link = scenes.link(site, tower_comparison_array(), uav_comparison_array(0.0882))

    def work(count):
        position = np.random.default_rng(5).uniform([-500, -500, 5], [500, 500, 100], (count, 3))
        peak, kept = peak_bytes(scenes.poses(position), link, site)
        return peak, kept

    small, large = work(1_000), work(4_000)
    # what grows: the results, held a few times over while they are merged
    assert large[0] - small[0] < 6 * (large[1] - small[1])


def test_rows_of_speed_against_error_without_sionna():
    site, link, poses = random_scene(40, buildings=4)
    said = []
    rows = speed_against_error(site, link, poses, samples=(), depths=(0, 2), progress=said.append)
    shallow, full = rows
    assert [row["engine"] for row in rows] == ["image"] * 2
    assert full["missing_paths"] == full["extra_paths"] == 0
    assert full["rss_max_error_db"] == 0.0
    assert set(full["rank_disagreement"].values()) == {0.0}
    assert shallow["missing_paths"] > 0
    assert shallow["rss_max_error_db"] > shallow["rss_rms_error_db"] > 0.1
    assert len(said) == 2
    assert full["rank_disagreement"] == {"10": 0.0, "100": 0.0, "1000": 0.0}
    assert full["seconds"] > 0
    assert full["peak_mib"] > 10

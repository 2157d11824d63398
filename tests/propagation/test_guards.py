"""Guards of the sionna engine that need no Sionna, and bounds on memory."""

import tracemalloc
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from shapely.geometry import box

from aerpaw_cmp.common.errors import CheckError, UsageError
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.jobs.bench import random_scene, speed_against_error
from aerpaw_cmp.propagation.geometry import Links, site_faces, tower_comparison_array, uav_comparison_array
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.search import sionna
from aerpaw_cmp.site.site import Building

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


@pytest.mark.parametrize(
    ("settings", "near_m", "words"),
    [
        ({}, 100.0, None), ({"gain_of_line_of_sight": 1.009}, 100.0, None), ({"gain_of_reflection": 2.0}, 100.0, None),
        ({"gain_of_line_of_sight": 1.011}, 100.0, "Friis"), ({"gain_of_line_of_sight": 0.989}, 100.0, "Friis"),
        ({"gain_of_line_of_sight": np.array([1.0, 1.1])}, 100.0, "Friis"), ({"gain_of_reflection": 2.01}, 100.0, "gains"),
        ({}, 1.02, "Friis"), ({}, 0.99, None),  # the first at another distance than its gain says: judged beyond 1 m
    ],
)  # fmt: skip
def test_a_line_of_sight_unlike_friis_or_a_gain_stops_the_run(settings, near_m, words):
    targets = TARGETS.copy()
    targets[0, 0] = near_m
    with pytest.raises(CheckError, match=words) if words else nullcontext():
        sionna._check_gain(raw(**settings), SOURCES, targets, 3.4e9)
    unused = raw(gain_of_reflection=9.0)
    unused["valid"][:, :, 1] = False
    sionna._check_gain(unused, SOURCES, TARGETS, 3.4e9)


@pytest.mark.parametrize("many", [9, 10])
def test_a_batch_with_nearly_as_many_paths_as_fit_is_refused(many):
    """Gains are the square root of the power over both slants of both ends. Padding is removed."""
    valid = np.zeros((3, 2, 30), dtype=bool)  # receivers, towers, paths
    valid[:, 1, : many // 3] = True
    valid[0, 1, : many - 2 * (many // 3)] = True
    a = np.random.default_rng(2).normal(size=(2, 3, 2, 2, 2, 30))
    as_array = [SimpleNamespace(numpy=lambda part=part: part) for part in a]
    padded = SimpleNamespace(numpy=lambda: np.zeros((1, 3, 2, 30)))
    finder = object.__new__(sionna._Finder)
    finder.limit = 10
    traced = SimpleNamespace(
        a=as_array, valid=SimpleNamespace(numpy=lambda: valid), interactions=padded, objects=padded, primitives=padded
    )
    finder.trace = lambda *_: traced
    if many == 10:
        with pytest.raises(CheckError, match="nearly 10 paths"):
            finder.searched(TARGETS, Search(max_depth=1, samples=9))
        return
    searched = finder.searched(TARGETS, Search(max_depth=1, samples=9))
    assert (searched["valid"].shape, searched["kind"].shape) == ((2, 2, 30), (1, 2, 2, 30))
    assert searched["gain"][1, 0, 4] == pytest.approx(np.linalg.norm(a[:, 1, :, 0, :, 4]))


def test_refinement_drops_duplicates_and_points_outside_their_face(scenes):
    faces = site_faces(scenes.site([Building("b", box(40, -20, 45, 20), 30.0)]))
    wall = int(np.flatnonzero(faces.normal[:, 0] == -1.0)[0])
    # the second would reflect next to the wall, the third is where the tower is
    targets = np.array([[20.0, 10.0, 15.0], [20.0, 70.0, 15.0], SOURCES[0], [0.0, 0.0, -10.0]])
    pose, sequence = np.array([0, 0, 1, 2, 3, 3]), np.full((6, 2), -1)
    sequence[:3, 0] = wall
    paths = sionna._refine(faces, SOURCES, targets, pose, np.zeros(6, dtype=int), sequence, 1e-9)
    assert (paths.pose.tolist(), paths.depth.tolist()) == ([0, 3], [1, 0])
    assert paths.vertices_m[0, 0, 0] == pytest.approx(40.0, abs=1e-12)
    assert np.isnan(paths.vertices_m[1]).all()
    assert not len(sionna._refine(faces, SOURCES, targets, pose[:0], pose[:0], sequence[:0], 1e-9))


def test_reflections_named_on_the_wrong_part_of_a_plane_are_moved(scenes):
    site = scenes.site([Building("left", box(30, -20, 40, -1), 20.0), Building("right", box(30, 1, 40, 20), 20.0)])
    faces = site_faces(site)
    left, right = np.flatnonzero(faces.normal[:, 0] == -1.0)
    sequence = np.array([[left, -1]])
    paths = sionna._refine(
        faces, SOURCES, np.array([[10.0, 10.0, 10.0]]), np.zeros(1, int), np.zeros(1, int), sequence, 1e-9
    )
    assert paths.faces.tolist() == [[right, -1]]


@pytest.mark.parametrize(("batch", "refused"), [(0, True), (1, False), (100, False), (101, True)])
def test_batches_hold_one_to_a_hundred_poses(scenes, monkeypatch, batch, refused):
    class LoadedError(Exception):
        pass

    def load():
        raise LoadedError

    monkeypatch.setattr(sionna, "load_variant", load)
    links = Links(SOURCES, TARGETS)
    with pytest.raises(UsageError if refused else LoadedError, match=f"batch {batch}" if refused else None):
        sionna.find_paths(site_faces(scenes.site()), links, Search("sionna", batch=batch), carrier_hz=3.4e9)


def peak_bytes(poses, link, site):
    tracemalloc.start()
    result = replay(site, link, poses)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    columns = sum(getattr(result.paths, name).nbytes for name in ("pose", "tower", "depth", "faces", "vertices_m"))
    return peak, columns + result.h.nbytes


def test_memory_beyond_the_results_does_not_grow_with_the_poses(scenes, monkeypatch):
    monkeypatch.setattr("aerpaw_cmp.propagation.field.sum.PAIRS_PER_CHUNK", 4_000)
    monkeypatch.setattr("aerpaw_cmp.propagation.search.mirror.CELLS_PER_CHUNK", 20_000)
    site = scenes.site()
    link = scenes.link(site, tower_comparison_array(), uav_comparison_array(0.0882))

    def work(count):
        position = np.random.default_rng(5).uniform([-500, -500, 5], [500, 500, 100], (count, 3))
        peak, results = peak_bytes(scenes.poses(position), link, site)
        return peak, results

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

"""Check that the compiled search finds the same paths as mirror images in NumPy.

Also check replays without compiled code.
"""

import ast
import dataclasses
import importlib.util
import json
import pickle
import subprocess
import sys
import types
import warnings

import numpy as np
import pytest
import shapely
from shapely.geometry import box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.jobs.bench import random_scene
from aerpaw_cmp.propagation import compiled, engines
from aerpaw_cmp.propagation.field import sum as field_sum
from aerpaw_cmp.propagation.geometry import Links, site_faces
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.scene import Scene
from aerpaw_cmp.propagation.search import beams as prisms
from aerpaw_cmp.propagation.search import mirror as image
from aerpaw_cmp.site.mitsuba import TriangleScene
from aerpaw_cmp.site.site import Building

needs_numba = pytest.mark.skipif(
    importlib.util.find_spec("numba") is None, reason="numba is not installed (extra fast)"
)


@pytest.fixture(scope="module")
def case():
    """Return poses, paths and scene of three towers. Most paths have reflections off slabs and the ground."""
    site, link, poses = random_scene(60, towers=3)
    paths = replay(site, link, poses).paths
    assert set(paths.depth) == {0, 1, 2}
    return site, link, poses, paths


@needs_numba
def test_no_file_of_the_working_folder_tells_numba_what_to_write(tmp_path, monkeypatch):
    """``chrome_trace: thesis.tex`` there made numba replace the thesis at the end of the command."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / ".numba_config.yaml").write_text("chrome_trace: thesis.tex\n")
    assert "the working folder contains a .numba_config.yaml" in compiled._failure.__wrapped__()


def test_no_pose_is_shared_by_two_threads(case):
    """Two threads adding to one link would lose what the other adds."""
    pose = case[3].pose
    for chunk in (1, 7, 64, 10_000):
        parts = field_sum.parts_between_poses(pose, chunk)
        assert max(part.stop - part.start for part in parts) <= chunk - 1 + np.bincount(pose).max()
        assert min((part.stop - part.start for part in parts[:-1]), default=chunk) >= chunk
        assert [part.start for part in parts] == [0, *(part.stop for part in parts[:-1])]
        assert parts[-1].stop == len(pose)
        assert all(pose[part.stop - 1] != pose[part.stop] for part in parts[:-1])


# ---------------------------------------------------------------- paths


def same_paths(first, second):
    for column in ("pose", "tower", "depth", "faces"):
        np.testing.assert_array_equal(getattr(first, column), getattr(second, column))
    np.testing.assert_allclose(first.vertices_m, second.vertices_m, rtol=0, atol=1e-9)


def searched(faces, sources, targets, usable=None, excluded=None, **options):
    mirrors = image.find_paths(faces, Links(sources, targets, usable, excluded), **options)
    beams = prisms.find_paths(faces, Links(sources, targets, usable, excluded), **options)
    same_paths(mirrors, beams)
    return beams


def whole_metres(rng, buildings):
    """Boxes, L shapes and towers on a grid of whole metres, so that walls, edges, roofs and ends coincide."""
    shapes = []
    for _ in range(buildings):
        east, north = rng.integers(-6, 6, 2)
        shape = box(east, north, east + rng.integers(1, 4), north + rng.integers(1, 4))
        if rng.uniform() < 0.5:
            shape = shapely.union(shape, box(east, north, east + 1, north + 5))
        if not any(shapely.area(shapely.intersection(shape, other.footprint)) > 0 for other in shapes):
            shapes.append(Building(f"b{len(shapes)}", shape, float(rng.integers(1, 4))))
    return tuple(shapes)


@needs_numba
@pytest.mark.parametrize("seed", range(6))
def test_the_same_paths_among_aligned_and_touching_buildings(scenes, seed):
    rng = np.random.default_rng(seed)
    faces = site_faces(scenes.site(whole_metres(rng, 7)))
    targets = rng.integers(-8, 9, (120, 3)).astype(float)
    targets[:, 2] = np.abs(targets[:, 2]) // 2
    targets[5] = np.nan
    sources = np.array([[0.0, 0.0, 5.0], [-7.0, 3.0, 2.0], [8.0, 8.0, 1.0]])
    paths = searched(faces, sources, targets, max_depth=2)
    assert len(paths) > 100


@needs_numba
@pytest.mark.parametrize("max_depth", [0, 1, 3])
def test_the_same_paths_at_any_depth_and_with_links_left_out(case, max_depth):
    site, link, poses, _ = case
    scene = Scene.of(site, link, poses)
    usable = scene.usable.copy()
    usable[1, ::3] = False
    excluded = scene.excluded.copy()
    excluded[0, ::4] = True
    paths = searched(
        scene.faces, scene.sources_m, poses.position_m[:40],
        max_depth=max_depth, usable=usable, excluded=excluded[:, :40],
    )  # fmt: skip
    assert paths.depth.max() == min(max_depth, 2) or max_depth == 3


@needs_numba
def test_nothing_to_search(scenes):
    faces = site_faces(scenes.site())
    assert not len(searched(faces, np.array([[0.0, 0, 10]]), np.zeros((0, 3))))
    assert not len(searched(faces, np.array([[0.0, 0, 10]]), np.full((3, 3), np.nan)))


def test_a_replay_on_three_threads_is_that_on_one_bit_by_bit(monkeypatch, case):
    """Search, joining of its pieces, field and levels, below the noise floor too."""
    monkeypatch.setenv(compiled.SWITCH, "never")
    monkeypatch.setattr(field_sum, "PATHS_PER_PART", 7)
    site, link, poses, _ = case
    link = dataclasses.replace(link, noise_floor_dbm=-58.0)
    replays = []
    for threads in (1, 3):
        monkeypatch.setattr(compiled, "thread_count", lambda threads=threads: threads)
        replays.append(replay(site, link, poses))
    serial, threaded = replays
    assert 0 < np.isnan(serial.rss_dbm).sum() < serial.rss_dbm.size
    np.testing.assert_array_equal(serial.has_path, np.isfinite(serial.rss_dbm))
    assert not serial.h[~serial.has_path].any()
    for name in ("rss_dbm", "rss_power_dbm", "h", "has_path"):
        np.testing.assert_array_equal(getattr(serial, name), getattr(threaded, name))
    for name in ("pose", "tower", "depth", "faces", "vertices_m"):
        np.testing.assert_array_equal(getattr(serial.paths, name), getattr(threaded.paths, name))


# ---------------------------------------------------------------- choosing and doing without


@pytest.fixture
def fresh():
    """Clear the caches before and after a test."""
    compiled._failure.cache_clear()
    compiled.warn_once.cache_clear()
    yield
    compiled._failure.cache_clear()
    compiled.warn_once.cache_clear()


@needs_numba
def test_every_file_that_kernels_take_in_names_the_folder_of_compiled_code():
    from aerpaw_cmp.propagation.compiled import ROOM, SOURCES

    known = {(ROOM / name).resolve() for name in SOURCES}
    holders = {path for path in ROOM.rglob("*.py") if "\n@kernel\n" in path.read_text(encoding="utf-8")}
    assert len(holders) >= 2
    assert holders <= known
    for path in holders:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        taken = {
            alias.asname or alias.name: path.parents[node.level - 1]
            / f"{(node.module or alias.name).replace('.', '/')}.py"
            for node in tree.body
            if isinstance(node, ast.ImportFrom) and node.level
            for alias in node.names
        }
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef) and "kernel" in {
                getattr(d, "id", "") for d in function.decorator_list
            }:
                names = [n for statement in function.body for n in ast.walk(statement) if isinstance(n, ast.Name)]
                own = {n.id for n in names if isinstance(n.ctx, ast.Store)} | {a.arg for a in function.args.args}
                body = {n.id for n in names} - own
                assert {taken[name].resolve() for name in body & set(taken)} <= known, function.name


NOTHING_CAN_BE_WRITTEN = """
import json, tempfile
def refuse(*args, **kwargs):
    raise OSError(30, "Read-only file system")
tempfile.TemporaryFile = refuse  # how a folder for compiled code is tried
import numpy as np
from aerpaw_cmp.propagation.search import merging as boxtree
from aerpaw_cmp.propagation.search import beams as growth
from aerpaw_cmp.propagation.search import merging
from aerpaw_cmp.propagation.search import beams as prisms
from aerpaw_cmp.propagation.compiled import code_folder
height = growth._height(np.array([[0.0, 0.0, 1.0]]), np.array([2.0]), 0, np.array([5.0, 5.0, 7.0]))
print(json.dumps([code_folder(), height]))
"""


@needs_numba
def test_every_compiled_module_runs_where_nothing_can_be_written():
    said = subprocess.run([sys.executable, "-c", NOTHING_CAN_BE_WRITTEN], capture_output=True, text=True, timeout=300)
    assert said.returncode == 0, said.stderr
    assert json.loads(said.stdout) == [None, 5.0]
    assert said.stderr == ""


@pytest.mark.parametrize("way", ["broken", "never"])
def test_many_faces_without_compiled_code(monkeypatch, fresh, case, way):
    """Prisms fall back to the image engine with one warning if numba is broken. A scene of triangles is one error."""
    site, link, poses, paths = case
    monkeypatch.setattr(engines, "MANY_FACES", 5)

    def broken():
        raise EOFError

    growth = types.ModuleType("growth")
    growth.try_out = broken
    monkeypatch.setitem(sys.modules, "aerpaw_cmp.propagation.search.beams", growth)
    for module in (compiled, engines):
        monkeypatch.setattr(module, "find_spec", lambda _: True)
    monkeypatch.setenv(compiled.SWITCH, "never" if way == "never" else "auto")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            same_paths(replay(site, link, poses).paths, paths)
    assert [str(warning.message)[:24] for warning in caught] == (
        ["compiled code cannot run"] if way == "broken" else []
    )
    corners = np.array([[0.0, 0, 0], [9, 0, 0], [0, 9, 0]])
    mesh = TriangleScene(corners, np.array([[0, 1, 2]]), np.zeros(1, np.int64), ("floor",), ("concrete",))
    with pytest.raises(UsageError, match=r"triangles, but (compiled code cannot run|AERPAW_CMP_COMPILED=never)"):
        Scene.of(dataclasses.replace(site, scene=mesh), link, poses)


def test_a_missing_numba_is_no_error(monkeypatch, fresh, case):
    monkeypatch.setattr(engines, "MANY_FACES", 5)
    for module in (compiled, engines):
        monkeypatch.setattr(module, "find_spec", lambda _: None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same_paths(replay(*case[:3]).paths, case[3])
    assert "aerpaw-cmp[fast]" in compiled.why_missing()


DAMAGED = {
    "cut": lambda place, content: place.write_bytes(content[:-40]),
    "empty": lambda place, _: place.write_bytes(b""),
    "another byte": lambda place, content: place.write_bytes(content[:2000] + b"\xff\x00" + content[2002:]),
    "rubbish": lambda place, _: place.write_bytes(b"\x80\x05rubbish." * 99),
    "a program": lambda place, _: place.write_bytes(pickle.dumps(_Ends())),
    "gone": lambda place, _: place.unlink(),
    "a folder": lambda place, _: (place.unlink(), place.mkdir()),
}


class _Ends:
    def __reduce__(self):
        return sys.exit, (9,)


@needs_numba
@pytest.mark.parametrize("kind", DAMAGED)
def test_a_damaged_entry_of_compiled_code_is_compiled_again(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(compiled, "code_folder", lambda: tmp_path)

    def run():
        def doubled(x):
            return 2.0 * x

        kernel = compiled.kernel(doubled)
        assert kernel(4.0) == 8.0
        return sum(kernel.stats.cache_hits.values())

    assert run() == 0
    assert run() == 1
    (place,) = tmp_path.glob("*.kernel")
    DAMAGED[kind](place, place.read_bytes())
    assert run() == 0
    assert run() == (kind != "a folder")


def test_compiled_code_is_kept_where_nobody_else_can_write(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    compiled.code_folder.cache_clear()
    try:
        folder = compiled.code_folder()
        assert folder is not None
        folder.chmod(0o777)
        compiled.code_folder.cache_clear()
        assert compiled.code_folder() is None
    finally:
        compiled.code_folder.cache_clear()


def test_wrong_settings_are_named(monkeypatch):
    monkeypatch.setenv(compiled.SWITCH, "sometimes")
    with pytest.raises(UsageError, match="AERPAW_CMP_COMPILED=sometimes"):
        compiled.why_missing()

"""A map in tiles: the content of its store, and runs, workers and disks that end early."""

import json
import os
import resource
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import InputError, OutputError, UsageError
from aerpaw_cmp.common.stages import Stages
from aerpaw_cmp.jobs import coverage_map
from aerpaw_cmp.jobs.workers import InProcess, Lost
from aerpaw_cmp.maps.grid import Grid
from aerpaw_cmp.maps.store import PLANES
from aerpaw_cmp.site.siteyaml import load_site

pytest.importorskip("zarr", reason="zarr is not installed (extra 'geo', Python 3.11)")
xarray = pytest.importorskip("xarray")

SITE = "lake_wheeler"
SETTINGS = coverage_map.MapSettings(
    spacing_m=120.0, rss_altitudes_m=(30.0,), rank_altitudes_m=(3.0, 30.0), foliage=("none",), max_depth=1, study=False,
    tile_m=600.0,
)  # fmt: skip
TILES = 8  # 9 x 17 positions in tiles of 5


def make(out, settings=SETTINGS, **more):
    return coverage_map.make_maps(load_site(SITE), settings, Stages(), name=SITE, out=out, **more)


@pytest.fixture(scope="module")
def in_one_piece():
    return coverage_map.make_maps(load_site(SITE), replace(SETTINGS, tile_m=None), Stages(), name=SITE)


def assert_like(outcome, reference):
    assert outcome.paths == reference.paths
    for mode, maps in outcome.maps.items():
        for name in PLANES:
            expected = getattr(reference.maps[mode], name)
            np.testing.assert_allclose(getattr(maps, name), expected, rtol=1e-6, err_msg=f"{mode} {name}")


class Watched(InProcess):
    """A crew that runs tasks in this process and stops after a given number."""

    def __init__(self, ending=None, after=99):
        self.numbers, self.ending, self.after = [], ending, after

    def run(self, function, items, done):
        for place, item in enumerate(items):
            if place == self.after:
                raise self.ending
            self.numbers.append(item.number)
            done(place, function(item))


def test_a_store_holds_the_map_in_one_piece(tmp_path):
    both = replace(SETTINGS, foliage=("none", "opaque"))
    in_one_piece = coverage_map.make_maps(load_site(SITE), replace(both, tile_m=None), Stages(), name=SITE)
    outcome = make(tmp_path / "map", both)
    assert_like(outcome, in_one_piece)
    assert outcome.tiles == {
        "store": str(tmp_path / "map" / "maps.zarr"), "tiles": TILES, "positions": 153, "shown_every": 1,
    }  # fmt: skip
    store = outcome.store.write_zarr(tmp_path / "maps.zarr", outcome.site.frame, coverage_map._about_maps(outcome.site))
    with xarray.open_zarr(store, consolidated=False) as data:
        at = data.isel(foliage=0, y=11, x=7)
        level = in_one_piece.maps["none"].rss("siso", "LW2")[0, 11 * 9 + 7]
        assert float(at["rss_siso"].sel(height=30.0)[1]) == pytest.approx(level, abs=0.006)
        assert data["rank"].dims == ("foliage", "tower", "k", "height_of_rank", "y", "x")
        assert data["rss_siso"].chunks[-1] == (5, 4)
        assert data.attrs["Conventions"] == "CF-1.11"
        serving = in_one_piece.maps["none"].grid.raster(in_one_piece.maps["none"].serving)
        np.testing.assert_array_equal(data["serving_tower"], serving)


def test_every_so_many_positions_of_a_large_map_are_shown(tmp_path, in_one_piece, monkeypatch):
    monkeypatch.setattr(coverage_map, "SHOWN_POSITIONS", 20)
    outcome = make(tmp_path / "map")
    assert outcome.tiles["shown_every"] == 3
    shown = outcome.maps["none"]
    assert shown.grid.shape == (6, 3)
    every = in_one_piece.maps["none"].grid.raster(in_one_piece.maps["none"].rss_siso_dbm[0, 2])
    np.testing.assert_allclose(shown.grid.raster(shown.rss_siso_dbm[0, 2]), every[::3, ::3], atol=0.006)
    assert "one in 3" in " ".join(coverage_map._notes(outcome))


def test_many_receivers_are_tiles_by_themselves_and_few_are_not():
    chosen, grid = replace(SETTINGS, tile_m=None), Grid.over_area((0.0, 800.0, 0.0, 800.0), 1.0)
    assert chosen.tile_cells(grid) == 128  # 640 000 positions at two heights
    assert replace(chosen, rank_altitudes_m=(30.0,)).tile_cells(grid) is None
    assert SETTINGS.tile_cells(grid) == 5


@pytest.mark.parametrize(
    "ending",
    [InputError("the scheduler of the workers cannot be reached"), KeyboardInterrupt()],
    ids=["cluster", "interrupt"],
)
def test_finished_tiles_are_not_computed_again(ending, tmp_path, in_one_piece):
    crew = Watched(ending, after=3)
    with pytest.raises(type(ending)):
        make(tmp_path / "map", workers=crew)
    rest = Watched()
    assert_like(make(tmp_path / "map", workers=rest), in_one_piece)
    assert crew.numbers == [0, 1, 2]
    assert rest.numbers == [3, 4, 5, 6, 7]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "map"
    return make(out).store


# Damage to the file of the third tile of a finished map.
DAMAGED = {
    "gone": lambda tile: tile.unlink(),
    "empty": lambda tile: tile.write_bytes(b""),
    "cut": lambda tile: tile.write_bytes(tile.read_bytes()[:-3]),
    "longer": lambda tile: tile.write_bytes(tile.read_bytes() + b"0000"),
    "a changed byte": lambda tile: tile.write_bytes(tile.read_bytes()[:-1] + b"\x7f"),
    "the file of another tile": lambda tile: shutil.copy(tile.with_name(tile.name[:-1] + "1"), tile),
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_a_damaged_tile_is_computed_again_with_a_message(kind, finished, tmp_path, in_one_piece):
    tiles = shutil.copytree(finished.folder, tmp_path / "map.tiles")
    DAMAGED[kind](next(tiles.glob("tile-*-2")))
    crew, messages = Watched(), []
    outcome = coverage_map.make_maps(
        load_site(SITE), SETTINGS, Stages(lambda text, *_: messages.append(text)), name=SITE, out=tmp_path / "map",
        workers=crew,
    )  # fmt: skip
    assert_like(outcome, in_one_piece)
    assert crew.numbers == [2]
    assert any("1 finished tile damaged: computed again" in text for text in messages) == (kind != "gone")


def test_a_tile_that_is_damaged_during_the_run_is_an_error(finished, tmp_path):
    shutil.copytree(finished.folder, tmp_path / "map.tiles")
    store = make(tmp_path / "map").store
    DAMAGED["cut"](next(store.folder.glob("tile-*-2")))
    with pytest.raises(InputError, match="a finished tile is missing or damaged"):
        store.read(2)


def test_tiles_of_other_settings_are_not_used_and_files_of_others_stay(finished, tmp_path):
    tiles = shutil.copytree(finished.folder, tmp_path / "map.tiles")
    (tiles / "notes.txt").write_text("mine")
    (tiles / ".tile-0123456789abcdef-3.x1y2.part").write_text("left by a killed run")
    crew = Watched()
    outcome = make(tmp_path / "map", replace(SETTINGS, carrier_hz=2e9, max_depth=0), workers=crew)
    assert crew.numbers == list(range(TILES))
    outcome.store.remove()
    assert [path.name for path in tiles.iterdir()] == ["notes.txt"]


def test_a_full_disk_is_one_message_and_the_same_command_goes_on(tmp_path, in_one_piece):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    written, full = [], coverage_map.TileStore.write

    def write(self, number, *more):
        resource.setrlimit(resource.RLIMIT_FSIZE, (60 if len(written) == 2 else soft, hard))
        try:
            full(self, number, *more)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        written.append(number)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(coverage_map.TileStore, "write", write)
        with pytest.raises(OutputError, match="cannot be written") as caught:
            make(tmp_path / "map")
    assert caught.value.exit_code == 3
    crew = Watched()
    assert_like(make(tmp_path / "map", workers=crew), in_one_piece)
    assert crew.numbers == [2, 3, 4, 5, 6, 7]


# AERPAW_CMP_KILL_EVERY=1 kills at each of the changes of a file (some 550; 15 minutes of processor time). By default the
# command is killed while it writes a tile and the Zarr store, before the folder gets its name, and while tiles are removed.
KILL_EVERY = os.environ.get("AERPAW_CMP_KILL_EVERY", "0")

# Runs a map in tiles in forks, each of which ends without cleaning up at its n-th change of a file, then once more.
KILLS = """
import contextlib, os, shutil, sys
from pathlib import Path
# what the command loads on demand, or each fork would load it again
import aerpaw_parsers, jinja2, matplotlib.backends.backend_svg, netCDF4, numpy as np, pandas, scipy.spatial, xarray, zarr
from aerpaw_cmp.__main__ import main
from aerpaw_cmp.cli import app
from aerpaw_cmp.jobs import coverage_map, paper_table, run

words = ["--spacing", "480", "--tile-m", "1200", "--rss-altitude", "30", "--rank-altitude", "30", "--max-depth", "0"]
command = ["map", "lake_wheeler", "-o", "out", "--no-study", "--foliage", "none", "-q", *words]
CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link", "os.chmod", "shutil.rmtree"}

def child(at):
    count = 0
    def hook(event, arguments):
        nonlocal count
        writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if writes or event in CHANGES:
            count += 1
            if at in (count, (event, Path(str(arguments[0])).name.split("-")[0])):
                os._exit(77)
    pid = os.fork()
    if not pid:
        sys.addaudithook(hook)
        with contextlib.suppress(BaseException):
            os._exit(main(command))
        os._exit(99)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])

every, kills = int(sys.argv[1]), 0
phases = [("os.chmod", ".tile"), ("os.mkdir", "rank_joint"), ("os.rename", ".out.aerpaw"), ("os.rmdir", "out.tiles")]
for at in range(1, 9999, every) if every else phases:
    shutil.rmtree("out", ignore_errors=True), shutil.rmtree("out.tiles", ignore_errors=True)
    last = child(at)
    assert last == 77 or every and last == 0, (at, last)
    assert child(-1) == 0, f"not completed after a kill at change {at}"
    assert sorted(os.listdir()) == ["out"], os.listdir()
    kills += last == 77
    if last == 0:
        break
print(kills)
"""


@pytest.mark.skipif(not hasattr(sys, "addaudithook") or not sys.platform.startswith("linux"), reason="forks")
def test_a_map_killed_at_a_file_event_is_completed_by_the_same_command(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", KILLS, KILL_EVERY],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=1500,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(done.stdout.split()[-1]) >= 4


def test_a_tile_whose_worker_is_killed_each_time_is_lost_alone(tmp_path, in_one_piece):
    class Kills(Watched):
        def run(self, function, items, done):
            super().run(
                lambda item: Lost("its worker process ended") if item.number == 4 else function(item), items, done
            )

    with pytest.raises(InputError, match="1 of 8 tiles lost: its worker process ended"):
        make(tmp_path / "map", workers=Kills())
    crew = Watched()
    assert_like(make(tmp_path / "map", workers=crew), in_one_piece)
    assert crew.numbers == [4]


def test_without_zarr_the_message_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(UsageError, match=r"zarr is not installed.*aerpaw-cmp\[geo\]"):
        make(tmp_path / "map")


def test_the_command_in_tiles(tmp_path, monkeypatch, capsys, blank_pictures):
    monkeypatch.chdir(tmp_path)
    words = ["--spacing", "240", "--tile-m", "600", "--foliage", "none"]
    command = ["map", SITE, "-o", "out", *words, "--rss-altitude", "30", "--rank-altitude", "30"]
    assert main([*command, "--json"]) == 0
    tiles = json.loads(capsys.readouterr().out)["tiles"]
    assert (tiles["store"], tiles["tiles"], tiles["shown_every"]) == ("out/maps.zarr", 8, 1)
    assert (tmp_path / "out" / "map.html").is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"], "tiles of a complete map are removed"
    assert main([*command, "-k", "5"]) == 0, "a map of other settings replaces the earlier one"
    with xarray.open_zarr(tmp_path / "out" / "maps.zarr", consolidated=False) as data:
        assert data["k"].values.tolist() == [5.0]


def test_flights_and_tiles_are_refused_before_anything_runs():
    from aerpaw_cmp.jobs import run

    with pytest.raises(UsageError, match="flights and a map in tiles"):
        run.run_map(SITE, SETTINGS, flights=[Path("sample_logs/flight.yaml")])

"""The store of a map in tiles: what it holds, and what becomes of it when a run, a worker or a disk ends early."""

import json
import pickle
import re
import resource
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import InputError, OutputError, UsageError
from aerpaw_cmp.common.stages import Stages
from aerpaw_cmp.jobs import coverage_map
from aerpaw_cmp.jobs.tasks import InProcess, Lost
from aerpaw_cmp.maps.grid import RATIO_LIMIT_DB, Grid
from aerpaw_cmp.maps.store import LEDGER, PLANES
from aerpaw_cmp.site.siteyaml import load_site

zarr = pytest.importorskip("zarr", reason="zarr is not installed (extra 'geo', Python 3.11)")
xarray = pytest.importorskip("xarray")

SITE = "lake_wheeler"
SETTINGS = coverage_map.MapSettings(
    spacing_m=120.0, rss_altitudes_m=(30.0,), rank_altitudes_m=(3.0, 30.0), foliage=("none",), max_depth=1, study=False,
    tile_m=600.0,
)  # fmt: skip
TILES = 8  # 9 x 17 positions in tiles of 5


def make(store, settings=SETTINGS, **more):
    return coverage_map.make_maps(load_site(SITE), settings, Stages(), name=SITE, store=store, **more)


@pytest.fixture(scope="module")
def in_one_piece():
    return coverage_map.make_maps(load_site(SITE), replace(SETTINGS, tile_m=None), Stages(), name=SITE)


def assert_like(outcome, reference):
    assert outcome.paths == reference.paths
    for mode, maps in outcome.maps.items():
        for name in PLANES:
            expected = getattr(reference.maps[mode], name)
            if name in ("spread_db", "condition_db"):
                expected = np.minimum(expected, RATIO_LIMIT_DB)
            np.testing.assert_allclose(getattr(maps, name), expected, atol=0.00501, err_msg=f"{mode} {name}")


class Watched(InProcess):
    """Runs tasks here; ends as told after so many."""

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
    outcome = make(tmp_path / "map.zarr", both)
    assert_like(outcome, in_one_piece)
    assert outcome.tiles == {
        "store": str(tmp_path / "map.zarr"), "tiles": TILES, "positions": 153, "shown_every": 1,
    }  # fmt: skip
    with xarray.open_zarr(tmp_path / "map.zarr", consolidated=False) as data:
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
    outcome = make(tmp_path / "map.zarr")
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
    "ending", [InputError("the scheduler of the workers went away"), KeyboardInterrupt()], ids=["cluster", "interrupt"]
)
def test_a_half_written_store_is_gone_on_with(ending, tmp_path, in_one_piece):
    crew = Watched(ending, after=3)
    with pytest.raises(type(ending)):
        make(tmp_path / "map.zarr", workers=crew)
    rest = Watched()
    assert_like(make(tmp_path / "map.zarr", workers=rest), in_one_piece)
    assert crew.numbers == [0, 1, 2]
    assert rest.numbers == [3, 4, 5, 6, 7]
    done = Watched()
    assert_like(make(tmp_path / "map.zarr", workers=done), in_one_piece)
    assert not done.numbers, "nothing is computed twice"


def test_a_store_killed_as_it_was_made_is_gone_on_with(tmp_path, in_one_piece):
    store = tmp_path / "map.zarr"
    store.mkdir()
    assert_like(make(store), in_one_piece)
    for name in ("rss_siso", "x"):  # as if they had not been written yet
        shutil.rmtree(store / name)
    assert_like(make(store), in_one_piece)


def test_no_folder_of_others_is_adopted_or_removed(tmp_path, in_one_piece):
    waiting = tmp_path / ".map.zarr.aerpaw-part"
    waiting.mkdir()
    (waiting / "zarr.json").write_text("theirs")
    assert_like(make(tmp_path / "map.zarr"), in_one_piece)
    assert (waiting / "zarr.json").read_text() == "theirs"


def change_metadata(name, **more):
    def change(store):
        place = store / name
        content = json.loads(place.read_text())
        for key, value in more.items():
            content[key] = value
        place.write_text(json.dumps(content))

    return change


def rewrite(name, content):
    return lambda store: (store / name).write_bytes(content)


def cut(name):
    return lambda store: (store / name).write_bytes((store / name).read_bytes()[:-3])


LEVEL, JOINT, SECOND = "rss_siso/c/0/0/0/1/0", "rss_siso_joint/c/0/0/1/0", f"{LEDGER}/c/1/0/0"
# Damage to a finished store, and the tile that is computed again.
REPAIRED = {
    "a chunk is gone": (lambda store: (store / LEVEL).unlink(), [2]),
    "a chunk of the joint map is gone": (lambda store: (store / JOINT).unlink(), [2]),
    "a chunk is cut": (cut(LEVEL), [2]),
    "a chunk of another tile": (lambda store: shutil.copy(store / "rss_siso/c/0/0/0/2/0", store / LEVEL), [2]),
    "paths of a tile are cut": (cut("tile_paths/c/1/0"), [2]),
    "an entry is gone": (lambda store: (store / SECOND).unlink(), [2]),
    "an entry is cut": (cut(SECOND), [2]),
    "the entry of another tile": (lambda store: shutil.copy(store / LEDGER / "c/2/0/0", store / SECOND), [2]),
    "a chunk of an axis": (rewrite("x/c/0", b"cut"), []),
    "metadata are gone": (lambda store: (store / "rank/zarr.json").unlink(), []),
    "attributes": (change_metadata("rank/zarr.json", attributes={"units": "furlong"}), []),
}
PICKLE = [{"name": "numcodecs.pickle", "configuration": {"protocol": 5}}]
# Metadata that this job does not write.
REFUSED = {
    "no JSON": (rewrite("zarr.json", b'{"attributes": {'), "cannot be read (JSONDecodeError"),
    "nested without end": (rewrite("rank/zarr.json", b"[" * 100_000), "cannot be read (it is nested too deep"),
    "a list": (rewrite("rank/zarr.json", b"[]"), "no metadata of Zarr 3"),
    "no job": (change_metadata("zarr.json", attributes=7), "names no job"),
    "a job that is a list": (change_metadata("zarr.json", attributes={"aerpaw_cmp_job": "[]"}), "names no job"),
    "another format": (change_metadata("zarr.json", zarr_format=2), "zarr_format in zarr.json is 2"),
    "another codec": (change_metadata("rank/zarr.json", codecs=PICKLE), "codecs in rank/zarr.json is"),
    "another type": (change_metadata("rank/zarr.json", data_type="float64"), "data_type in rank/zarr.json"),
    "another shape": (change_metadata("rank/zarr.json", shape=[1 << 40] * 6), "shape in rank/zarr.json"),
    "other chunks": (change_metadata(f"{LEDGER}/zarr.json", chunk_grid={}), f"chunk_grid in {LEDGER}/zarr.json"),
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    store = tmp_path_factory.mktemp("finished") / "map.zarr"
    make(store)
    return store


@pytest.mark.parametrize("kind", REPAIRED)
def test_a_damaged_tile_is_computed_again_and_said(kind, finished, tmp_path, in_one_piece):
    damage, again = REPAIRED[kind]
    store = tmp_path / "map.zarr"
    shutil.copytree(finished, store)
    damage(store)
    crew, said = Watched(), []
    outcome = coverage_map.make_maps(
        load_site(SITE), SETTINGS, Stages(lambda text, *_: said.append(text)), name=SITE, store=store, workers=crew
    )
    assert_like(outcome, in_one_piece)
    assert crew.numbers == again
    entered = "an entry is gone" not in kind and bool(again)
    assert any("1 finished tile with missing or changed chunks" in text for text in said) == entered
    with (
        xarray.open_zarr(store, consolidated=False, chunks=None) as data,
        xarray.open_zarr(finished, consolidated=False, chunks=None) as before,
    ):
        assert data.identical(before), "attributes and axes too"


@pytest.mark.parametrize("kind", REFUSED)
def test_a_store_with_other_metadata_is_refused_before_it_is_opened(kind, finished, tmp_path, monkeypatch):
    damage, message = REFUSED[kind]
    store = tmp_path / "map.zarr"
    shutil.copytree(finished, store)
    damage(store)
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    monkeypatch.setattr(zarr, "open_group", lambda place, **how: OPEN(place, **only_in_memory(place, how)))
    for force in (False, True):
        with pytest.raises(InputError, match=re.escape(message)):
            make(store, force=force)
    assert {path: path.read_bytes() for path in store.rglob("*") if path.is_file()} == before


OPEN = zarr.open_group


def only_in_memory(place, how):
    assert isinstance(place, zarr.storage.MemoryStore), "a stranger's store was opened"
    return how


def test_a_store_of_zarr_2_runs_no_codec_of_its_own(finished, tmp_path):
    store, ran = tmp_path / "map.zarr", tmp_path / "ran"
    shutil.copytree(finished, store)
    shutil.rmtree(store / "rank")
    (store / "rank").mkdir()
    (store / "rank" / ".zarray").write_text(json.dumps({
        "zarr_format": 2, "shape": [1], "chunks": [1], "dtype": "|O", "compressor": None, "fill_value": 0,
        "order": "C", "filters": [{"id": "pickle", "protocol": 4}],
    }))  # fmt: skip
    (store / "rank" / "0").write_bytes(pickle.dumps(_Runs(ran)))
    for force in (False, True):
        with pytest.raises(UsageError, match=r"what this tool did not write: rank/(\.zarray|0)"):
            make(store, force=force)
    assert not ran.exists()


class _Runs:
    def __init__(self, place):
        self.place = place

    def __reduce__(self):
        return Path.touch, (self.place,)


def test_the_store_of_another_job_is_refused(tmp_path, in_one_piece):
    store = tmp_path / "map.zarr"
    make(store, replace(SETTINGS, carrier_hz=2e9, max_depth=0))
    with pytest.raises(
        UsageError, match=r"another job: carrier_hz and 1 more differs \(2000000000.0, now 3400000000.0\)"
    ):
        make(store)
    assert_like(make(store, force=True), in_one_piece)


@pytest.mark.parametrize("name", ["notes.txt", "rss_siso/c/notes.txt", "rss_siso/c/link"])
@pytest.mark.parametrize("same", [False, True], ids=["other job", "same job"])
def test_a_store_with_files_of_others_is_not_replaced(same, name, finished, tmp_path):
    store = tmp_path / "map.zarr"
    shutil.copytree(finished, store)
    place = store / name
    if name.endswith("link"):
        place.symlink_to(tmp_path)
    else:
        place.write_text("mine")
    before = sorted(path.relative_to(store).as_posix() for path in store.rglob("*"))
    with pytest.raises(UsageError, match=f"the store holds what this tool did not write: {name}"):
        make(store, SETTINGS if same else replace(SETTINGS, carrier_hz=2e9), force=True)
    assert sorted(path.relative_to(store).as_posix() for path in store.rglob("*")) == before


@pytest.mark.parametrize("content", ["notes", "damaged", "file"])
def test_what_is_no_store_stays(content, tmp_path):
    store = tmp_path / "map.zarr"
    if content == "file":
        store.write_text("mine")
    else:
        store.mkdir()
        (store / {"notes": "notes.txt", "damaged": "zarr.json"}[content]).write_text('{"attributes": {')
    before = sorted(path.name for path in tmp_path.rglob("*"))
    for force in (False, True):
        with pytest.raises((InputError, UsageError), match=r"no map store|did not write: notes|JSONDecodeError"):
            make(store, force=force)
    assert sorted(path.name for path in tmp_path.rglob("*")) == before


def test_a_full_disk_leaves_no_store_that_was_not_begun(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (600, hard))
    try:
        with pytest.raises(OutputError, match=r"map.zarr: cannot be written|zarr.json: cannot be written"):
            make(tmp_path / "map.zarr")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_one_message_and_the_run_goes_on_later(tmp_path, in_one_piece):
    store, soft, hard = tmp_path / "map.zarr", *resource.getrlimit(resource.RLIMIT_FSIZE)
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
        with pytest.raises(OutputError, match=r"map.zarr: cannot be written") as caught:
            make(store)
    assert caught.value.exit_code == 3
    crew = Watched()
    assert_like(make(store, workers=crew), in_one_piece)
    assert crew.numbers == [2, 3, 4, 5, 6, 7]


def test_a_tile_whose_worker_is_killed_each_time_is_lost_alone(tmp_path, in_one_piece):
    class Kills(Watched):
        def run(self, function, items, done):
            super().run(
                lambda item: Lost("its worker process ended") if item.number == 4 else function(item), items, done
            )

    with pytest.raises(InputError, match="1 of 8 tiles lost: its worker process ended"):
        make(tmp_path / "map.zarr", workers=Kills())
    crew = Watched()
    assert_like(make(tmp_path / "map.zarr", workers=crew), in_one_piece)
    assert crew.numbers == [4]


def test_without_zarr_the_message_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(UsageError, match=r"zarr is not installed.*aerpaw-cmp\[geo\]"):
        make(tmp_path / "map.zarr")


def test_the_command_in_tiles(tmp_path, monkeypatch, capsys, blank_pictures):
    monkeypatch.chdir(tmp_path)
    words = ["--spacing", "240", "--tile-m", "600", "--foliage", "none"]
    command = ["map", SITE, "-o", "out", *words, "--rss-altitude", "30", "--rank-altitude", "30"]
    assert main([*command, "--json"]) == 0
    tiles = json.loads(capsys.readouterr().out)["tiles"]
    assert (tiles["store"], tiles["tiles"], tiles["shown_every"]) == ("out.zarr", 8, 1)
    assert (tmp_path / "out" / "map.html").is_file()
    assert main([*command, "-k", "5"]) == 2
    assert "another job: ks" in capsys.readouterr().err
    assert (tmp_path / "out" / "map.html").is_file()


def test_flights_and_tiles_are_refused_before_anything_runs():
    from aerpaw_cmp.jobs import run

    with pytest.raises(UsageError, match="flights and a map in tiles"):
        run.run_map(SITE, SETTINGS, flights=[Path("sample_logs/flight.yaml")])

"""The channel along a plan and along the sample flight: one set of numbers in every format."""

import json
import resource
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
import xarray

import aerpaw_cmp
from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.cf import GrowingNetcdf
from aerpaw_cmp.common.units import SPEED_OF_LIGHT_MPS
from aerpaw_cmp.jobs import channel
from aerpaw_cmp.jobs.channel import ChannelOptions, run_channel
from aerpaw_cmp.jobs.options import RunOptions
from tests.json_page import listed

SAMPLE = Path(__file__).parents[2] / "sample_logs" / "flight.yaml"
FORMATS = ("netcdf", "npz", "deepmimo", "csv")
PLAN = """
flight:
  name: To_the_tower
  plan:
    start: 2025-06-01T10:00:00
    speed_mps: 8
    waypoints:
      - {east_m: 10, north_m: 300, height_m: 40}
      - {east_m: 10, north_m: 60, height_m: 40}
timezone: America/New_York
logs: [{path: LW1.txt, reader: sounder_log, node: LW1, channel: A}]
link:
  rank: {carrier_hz: 3.4e9, uav_transmits: false, tower: {layout: tower_comparison}, uav: {layout: uav_comparison}}
"""
OWN_SITE = """
name: field
origin: {latitude_deg: 35.7275, longitude_deg: -78.696}
area_m: [-400, 400, -400, 400]
towers:
  LW1: {latitude_deg: 35.7275, longitude_deg: -78.696, antenna_height_m: 10}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("channel")
    (place / "plan.yaml").write_text(PLAN)
    return place


@pytest.fixture(scope="module")
def written(folder):
    chosen = ChannelOptions(
        link="rank", towers=("LW1", "LW2"), step_s=2.0, formats=FORMATS, bandwidth_hz=20e6, subcarriers=8
    )
    outcome = run_channel(folder / "plan.yaml", chosen, RunOptions(out=folder / "out"))
    with xarray.open_dataset(folder / "out" / "channel.nc") as book:
        return outcome, book.load()


def complex_of(book, name):
    return (book[f"{name}_real"] + 1j * book[f"{name}_imag"]).to_numpy()


def only_unnamed_time(faults):
    """Check that the checker recommends a standard name for ``time`` and nothing else: that name requires a date."""
    return {*faults} <= {"Coordinate variable 'time' should have standard_name='time', found: 'None'"}


def check_labels(book, start):
    """Select by tower, time and port. ``book`` has complex ``h`` and ``gain``."""
    assert {"tower", "time", "rx", "tx", "path"} <= set(book.indexes)
    one = book.sel(tower="LW2")
    np.testing.assert_array_equal(one.h, book.h[:, list(book.tower).index("LW2")])
    some = book.h.sel(time=slice(start + np.timedelta64(3, "s"), start + np.timedelta64(9, "s")))
    np.testing.assert_array_equal(some, book.h[2:5])
    np.testing.assert_array_equal(book.gain.sel(path=0, rx=1, tx=0), book.gain[0, :, :, 1, 0])
    for name in ("kind", "faces"):
        flags = book[name].attrs
        words = dict(zip(flags["flag_values"].tolist(), flags["flag_meanings"].split(), strict=True))
        assert book[name].dtype.kind == "i"
        assert set(np.unique(book[name])) <= set(words)
        assert words[-1] == "no_path"
    assert words[int(book.faces.sel(path=0, tower="LW2")[0])] == "line_of_sight"


def test_the_netcdf_file_has_h_as_the_sum_of_its_paths(written, cf_faults):
    outcome, book = written
    h, gain = complex_of(book, "h"), complex_of(book, "gain")
    assert h.shape == (16, 2, 4, 4)
    assert gain.sum(axis=0) == pytest.approx(h, rel=0, abs=1e-12 * np.abs(h).max())
    assert complex_of(book, "cfr")[..., 4] == pytest.approx(h, rel=1e-12)
    assert book.attrs["transmitter"] == "tower"
    assert list(book.tower.values) == ["LW1", "LW2"]
    sight = book.kind.to_numpy() == 0
    place = book[["east_m", "north_m", "up_m"]].to_array().to_numpy().T
    towers = book[["tower_east_m", "tower_north_m", "tower_up_m"]].to_array().to_numpy().T
    direct = np.linalg.norm(place[:, None] - towers[None], axis=2)
    assert sight[0].all()
    assert book.delay_s.to_numpy()[0] == pytest.approx(direct / SPEED_OF_LIGHT_MPS, rel=1e-12)
    assert (book.doppler_hz.to_numpy()[0, :, 0] > 0.0).all()  # it comes nearer all the way
    assert np.diff(book.time) == pytest.approx(2.0)
    assert "date unknown" in book.time.attrs["long_name"]
    assert only_unnamed_time(cf_faults(outcome.files[0]))


@pytest.fixture
def short_parts(monkeypatch):
    monkeypatch.setattr("aerpaw_cmp.jobs.channel._PART_BYTES", 20_000)


ALONG = "--link rank --step 2 --tower LW1 --tower LW2 --bandwidth 20e6 --subcarriers 8"


def test_a_file_of_many_parts_is_that_of_one(written, folder, short_parts, monkeypatch, cf_faults):
    sizes = []
    replayed = channel.replay_poses
    monkeypatch.setattr(channel, "replay_poses", lambda *a, **k: (sizes.append(len(a[3])), replayed(*a, **k))[1])
    out = folder / "parts"
    formats = ["--format", "netcdf", "--format", "csv"]
    assert main(["channel", str(folder / "plan.yaml"), "-o", str(out), *ALONG.split(), *formats]) == 0
    assert len(sizes) > 3
    assert sum(sizes) == 16
    with xarray.open_dataset(out / "channel.nc") as book:
        xarray.testing.assert_equal(book, written[1])
        assert [str(v.attrs) for v in book.variables.values()] == [str(v.attrs) for v in written[1].variables.values()]
    assert (out / "channel.csv").read_text() == (folder / "out" / "channel.csv").read_text()
    assert only_unnamed_time(cf_faults(out / "channel.nc"))


def test_links_with_fewer_paths_than_a_later_part_have_no_path_there(tmp_path):
    """In a file that grows along both dimensions, values that were not written are a gain of 0 and a delay of NaN."""
    with GrowingNetcdf(tmp_path / "grown.nc", ("pose", "path")) as book:
        for count in (1, 3):
            shape = ("path", "pose"), np.full((count, 2), float(count))
            none = {"_FillValue": np.nan}
            data = {"gain": (*shape, {}, {"_FillValue": 0.0}), "delay": (*shape, {}, none), "t": ("pose", np.ones(2))}
            book.append(xarray.Dataset(data))
    with xarray.open_dataset(tmp_path / "grown.nc") as grown:
        assert grown.gain.values.tolist() == [[1, 1, 3, 3], [0, 0, 3, 3], [0, 0, 3, 3]]
        assert np.isnan(grown.delay).sum() == 4
        assert (grown.t == 1.0).all()


def test_a_disk_that_fills_on_the_way_ends_in_one_line(folder, short_parts, capsys, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (90_000, hard))  # the first parts fit
    try:
        assert main(["channel", str(folder / "plan.yaml"), "-o", str(tmp_path / "out"), *ALONG.split()]) == 3
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "cannot be written (File too large)" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_arrays_for_sionna_and_matlab_hold_the_same(written, folder):
    _, book = written
    h, gain = complex_of(book, "h"), complex_of(book, "gain")
    with np.load(folder / "out" / "channel.npz") as arrays:
        a, tau = arrays["a"], arrays["tau"]
        assert a.shape == (16, 4, 2, 4, len(gain), 1)
        assert tau.shape == (16, 2, len(gain))
        assert a[..., 0].transpose(4, 0, 2, 1, 3) == pytest.approx(gain)
        assert list(arrays["towers"]) == ["LW1", "LW2"]
    # the line that docs/channel.md gives for MATLAB
    scipy.io.savemat(folder / "channel.mat", dict(np.load(folder / "out" / "channel.npz")))
    matlab = scipy.io.loadmat(folder / "channel.mat")
    assert matlab["a"] == pytest.approx(a)
    assert matlab["h"] == pytest.approx(h)
    assert matlab["doppler_hz"] == pytest.approx(book.doppler_hz.to_numpy(), nan_ok=True)


def test_the_table_of_an_emulator_has_a_row_per_instant_and_tower(written, folder):
    _, book = written
    table = pd.read_csv(folder / "out" / "channel.csv")
    assert list(table) == ["time", "tower", "gain_db", "delay_s", "doppler_hz"]
    assert len(table) == 32
    power = 10.0 * np.log10((np.abs(complex_of(book, "gain")) ** 2).mean(axis=(3, 4)).sum(axis=0))
    coherent = 10.0 * np.log10((np.abs(complex_of(book, "h")) ** 2).mean(axis=(2, 3)))
    given = table.gain_db.to_numpy().reshape(16, 2)
    assert min(np.abs(given - power).max(), np.abs(given - coherent).max()) < 1e-3
    assert table.delay_s.to_numpy().reshape(16, 2) == pytest.approx(book.delay_s.to_numpy()[0], rel=1e-8)


def along(folder, name, edits, *formats):
    """Folder and NetCDF content of the same plan after some replacements in its text."""
    text = PLAN
    for old, new in edits.items():
        assert old in text
        text = text.replace(old, new)
    (folder / f"{name}.yaml").write_text(text)
    chosen = ChannelOptions(link="rank", towers=("LW1", "LW2"), step_s=2.0, formats=("netcdf", *formats))
    run_channel(folder / f"{name}.yaml", chosen, RunOptions(out=folder / name))
    with xarray.open_dataset(folder / name / "channel.nc") as book:
        return folder / name, book.load()


def test_the_frequency_response_is_the_channel_at_another_carrier(written, folder):
    """A second route to H(f0 + f): the same route replayed at f0 + f, where the phase of each path turns backwards."""
    _, book = written
    (number,) = np.flatnonzero(book.subcarrier_hz.to_numpy() == 2.5e6)
    _, other = along(folder, "other_carrier", {"3.4e9": "3.4025e9"})
    h, cfr = complex_of(other, "h"), complex_of(book, "cfr")[..., number]
    # 0.09 rad: delays are those of the array centres, and the tower's array is 1.8 m wide
    assert np.linalg.norm(cfr - h) < 0.15 * np.linalg.norm(h)
    assert np.linalg.norm(complex_of(book, "h") - h) > 0.5 * np.linalg.norm(h), "the phase turns between the two"


def test_a_route_out_of_coverage_is_written_in_every_format(folder):
    weak = {"{carrier_hz: 3.4e9": "{carrier_hz: 3.4e9, transmit_power_dbm: -150"}
    out, book = along(folder, "weak", weak, *FORMATS)
    table = pd.read_csv(out / "channel.csv")
    assert len(table) == 32
    assert table[["gain_db", "delay_s"]].isna().all(axis=None)
    assert (book.kind == -1).all()


@pytest.mark.parametrize("uav_transmits", ["false", "true"])
def test_angles_of_a_deepmimo_scenario_leave_the_tower_whoever_transmits(uav_transmits, folder):
    """Its towers are the transmitters: departure looks from the tower to the UAV, arrival back."""
    edits = {"uav_transmits: false": f"uav_transmits: {uav_transmits}"}
    place, book = along(folder, f"mimo_{uav_transmits}", edits, "deepmimo")
    (scenario,) = (place / "deepmimo").iterdir()
    uav = book[["east_m", "north_m", "up_m"]].to_array().to_numpy().T
    for number in (0, 1):
        tower = book[["tower_east_m", "tower_north_m", "tower_up_m"]].to_array().to_numpy().T[number]
        for name, way in (("aod", uav - tower), ("aoa", tower - uav)):
            azimuth, zenith = (
                np.load(scenario / f"{name}_{axis}_t000_tx00{number}_r001.npz")[f"{name}_{axis}"][:, 0]
                for axis in ("az", "el")
            )
            off = azimuth - np.degrees(np.arctan2(way[:, 1], way[:, 0]))
            np.testing.assert_allclose((off + 180.0) % 360.0, 180.0, atol=1e-6)
            down = np.degrees(np.arccos(way[:, 2] / np.linalg.norm(way, axis=1)))
            np.testing.assert_allclose(zenith, down, atol=1e-6)


@pytest.mark.parametrize("field", ["power", "coherent"])
def test_the_gain_of_an_emulator_has_no_transmit_power_and_sums_as_the_flight_says(field, folder):
    edits = {"{carrier_hz: 3.4e9,": "{carrier_hz: 3.4e9, transmit_power_dbm: 30,",
             "\nlink:": f"\nrss: {{field: {field}}}\nlink:"}  # fmt: skip
    place, book = along(folder, f"gain_{field}", edits, "csv")
    gain = complex_of(book, "gain")
    powers = {"power": (np.abs(gain) ** 2).sum(axis=0), "coherent": np.abs(gain.sum(axis=0)) ** 2}
    expected = {name: 10.0 * np.log10(power.mean(axis=(2, 3))) for name, power in powers.items()}
    assert np.abs(expected["power"] - expected["coherent"]).max() > 0.5, "the two are distinguished"
    given = pd.read_csv(place / "channel.csv").gain_db.to_numpy().reshape(16, 2)
    np.testing.assert_allclose(given, expected[field], atol=1e-3)


def test_a_deepmimo_scenario_is_read_as_its_loader_reads_it(written, folder, monkeypatch):
    """Open the files with DeepMIMO's loader if it is installed, else check the documented names and keys."""
    _, book = written
    gain = complex_of(book, "gain")[:, :, 1, 0, 0]
    scenario = folder / "out" / "deepmimo" / "to_the_tower"
    about = json.loads((scenario / "params.json").read_text())
    assert about["rt_params"]["frequency"] == 3.4e9
    sets = about["txrx_sets"]
    assert [(s["is_tx"], s["is_rx"], s["num_points"]) for s in sets.values()] == [(True, False, 2), (False, True, 16)]
    try:
        import deepmimo

        monkeypatch.chdir(folder / "out")
        deepmimo.config.set("scenarios_folder", "deepmimo")
        second = deepmimo.load("to_the_tower")[1]
    except ImportError:
        names = ("power", "phase", "delay", "aoa_az", "aoa_el", "aod_az", "aod_el", "inter", "rx_pos", "tx_pos")
        second = {name: np.load(scenario / f"{name}_t000_tx001_r001.npz")[name] for name in names}
    amplitude = np.nan_to_num(10.0 ** (second["power"] / 20.0) * np.exp(1j * np.radians(second["phase"])))
    read = {"delay": second["delay"], "aod": second["aod_az"], "up": 90.0 - second["aoa_el"]}
    own = {"delay": "delay_s", "aod": "azimuth_departure_deg", "up": "elevation_arrival_deg"}
    np.testing.assert_allclose(amplitude.T, gain, rtol=1e-9)
    for name, values in read.items():
        np.testing.assert_allclose(values.T, book[own[name]][:, :, 1].to_numpy(), rtol=1e-9)
    assert (second["inter"][:, 0] == 0).all()  # line of sight
    assert second["inter"][:, 1].tolist() == [1] * 16  # the ground


def test_a_flown_flight_gives_the_same_in_a_notebook(tmp_path):
    flight = aerpaw_cmp.open_flight(SAMPLE)
    book = flight.channel(towers=("LW2",), step_s=20.0)
    assert book.sizes["time"] == 17
    assert np.isfinite(book.doppler_hz[0]).sum() > 10  # steps of 20 s are not gaps
    assert abs(book.time.values[0] - flight.track.time.dt.tz_localize(None).to_numpy()[0]) < np.timedelta64(1, "us")
    assert np.abs(book.gain.sum("path") - book.h).max() <= 1e-12 * np.abs(book.h).max()
    # paths of a synthetic flight are not learned from logs of real flights; the calibrated levels are
    assert "trained_on" not in book.attrs
    assert {name for name in book.variables if "trained_on" in book[name].attrs} == {"level_db", "level_sd_db"}
    assert all(len(digest) == 64 for digest in book.level_db.attrs["trained_on"].split())


def test_variables_are_selected_by_labels_in_python_and_in_the_file(tmp_path, cf_faults):
    chosen = {"link": "rank", "towers": ("LW1", "LW2"), "step_s": 2.0}
    book = aerpaw_cmp.open_flight(SAMPLE).channel(**chosen)
    check_labels(book, book.time.values[0])
    run_channel(SAMPLE, ChannelOptions(**chosen), RunOptions(out=tmp_path / "out"))
    with xarray.open_dataset(tmp_path / "out" / "channel.nc") as file:
        # the line of docs/channel.md
        opened = file.assign(gain=file.gain_real + 1j * file.gain_imag, h=file.h_real + 1j * file.h_imag)
        check_labels(opened, book.time.values[0])
        for name in ("gain", "h", "time", "tower", "kind", "faces", "delay_s"):
            xarray.testing.assert_equal(opened[name], book[name])
    assert cf_faults(tmp_path / "out" / "channel.nc") == []


def test_points_without_times_have_no_doppler_and_a_site_without_memory_no_level(folder, capsys):
    wall = "buildings: [{name: b, height_m: 5, polygon_m: [[9, 9], [20, 9], [20, 20], [9, 20]]}]\n"
    (folder / "own.yaml").write_text(OWN_SITE + wall)
    (folder / "own_flight.yaml").write_text(PLAN + "site: own.yaml\nrt: {diffraction: edges}\n")
    points = "east_m,north_m,height_m\n50,0,30\n50,40,30\n90,90,30\n"
    (folder / "points.csv").write_text(points)
    line = ["channel", str(folder / "own_flight.yaml"), "--route", str(folder / "points.csv"), "--json"]
    assert main([*line, "-o", str(folder / "own_out"), "--format", "csv"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert list(printed) == ["schema", *listed("channel")]
    assert (printed["has_doppler"], printed["has_level"], printed["poses"]) == (False, False, 3)
    assert any("No Doppler shift" in text for text in printed["warnings"])
    assert any("No calibrated level" in text for text in printed["warnings"])
    assert any(text.startswith("Not modelled: diffraction over two edges") for text in printed["warnings"])
    assert pd.read_csv(folder / "own_out" / "channel.csv").doppler_hz.isna().all()
    assert main([*line[:-1], "-o", str(folder / "own_nc")]) == 0
    assert capsys.readouterr().out.startswith("Link rss (the default), 3.3 GHz: ")
    with xarray.open_dataset(folder / "own_nc" / "channel.nc") as book:
        assert book.time.values.tolist() == [0, 1, 2]
        assert "no times" in book.time.attrs["long_name"]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--format", "hdf"], "netcdf"),
        (["--link", "nope"], "rank"),
        (["--tower", "nope"], "LW1"),
        (["--bandwidth", "5e9"], "tenth of the carrier"),
        (
            ["--step", "0.1", "--bandwidth", "1e6", "--subcarriers", "65536", "--link", "rank", "--format", "npz"],
            "--step",
        ),
        (["--step", "0.001", "--bandwidth", "1e6", "--subcarriers", "65536", "--link", "rank"], "GiB of disk"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(folder, options, expected, capsys, tmp_path):
    assert main(["channel", str(folder / "plan.yaml"), "-o", str(tmp_path / "out"), *options]) == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said
    assert expected in said
    assert not (tmp_path / "out").exists()


def test_times_nodes_and_sizes_that_do_not_fit_are_refused(folder, capsys, tmp_path):
    (folder / "late.csv").write_text("east_m,north_m,height_m,time_s\n50,0,30,0\n50,40,30,1e8\n")
    late, flight = ["--route", str(folder / "late.csv"), "--format"], folder / "plan.yaml"
    wide = ["--step", "400", "--link", "rank", *(word for n in "1234" for word in ("--tower", f"LW{n}"))]
    drawn = folder / "drawn.yaml"
    drawn.write_text(PLAN + "rt: {engine: sionna}\n")
    (folder / "moves.csv").write_text("latitude,longitude,altitude,time\n35.727,-78.696,0,2025-06-01T14:00:00Z\n"
                                      "35.728,-78.696,0,2025-06-01T14:05:00Z\n")  # fmt: skip
    moving = folder / "moving.yaml"
    moving.write_text(PLAN + "towers: {N: {track: {path: moves.csv}, height: ground, antenna_height_m: 2}}\n")
    for path, options, expected in (
        (flight, [*late, "csv"], "at most 10000000"),
        (flight, [*late, "npz", *wide], "only netcdf and csv."),
        (drawn, [*late, "csv", *wide], "only netcdf and csv with rt.engine: image"),
        (moving, ["--tower", "N", "--format", "csv"], "that tower alone, on its track"),
    ):
        assert main(["channel", str(path), "-o", str(tmp_path / "out"), *options]) == 2
        assert expected in capsys.readouterr().err
    assert main(["channel", str(moving), "-o", str(tmp_path / "out"), "--format", "csv"]) == 0  # the others stand


def test_a_route_begins_with_its_first_point_whatever_its_time(folder, capsys, tmp_path):
    (folder / "from_100.csv").write_text("east_m,north_m,height_m,time_s\n50,0,30,100\n50,40,30,102\n")
    (folder / "alone.csv").write_text("east_m,north_m,height_m,time_s\n,,,0\n50,40,30,0.5\n,,,1\n")
    line = ["channel", str(folder / "plan.yaml"), "--tower", "LW1", "--format", "csv", "-o", str(tmp_path / "out")]
    assert main([*line, "--route", str(folder / "from_100.csv")]) == 0
    assert pd.read_csv(tmp_path / "out" / "channel.csv").time.tolist() == [0, 1, 2]
    assert main([*line, "--route", str(folder / "alone.csv")]) == 3
    assert "no step of the route has a position" in capsys.readouterr().err


def test_a_node_of_the_flight_itself_and_a_step_longer_than_it(folder, tmp_path):
    own = folder / "node.yaml"
    place = "latitude_deg: 35.7281, longitude_deg: -78.6961, antenna_height_m: 2"
    own.write_text(PLAN + "towers: {ROVER: {" + place + "}}\n")
    chosen = ChannelOptions(towers=("ROVER",), step_s=1e300, formats=("csv",))
    assert run_channel(own, chosen, RunOptions(out=tmp_path / "out")).metrics["poses"] == 1
    book = aerpaw_cmp.open_flight(SAMPLE).channel(towers=("LW2",), step_s=1e300)
    assert book.sizes["time"] == 1
    assert "no point has a neighbour in time" in book.attrs["comment"]


@pytest.mark.parametrize("name", ["netcdf", "all"])
def test_a_missing_library_is_told_before_the_replay(name, folder, capsys, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "netCDF4", None)
    monkeypatch.setattr(channel, "channel_parts", None)
    assert main(["channel", str(folder / "plan.yaml"), "--format", name, "-o", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "aerpaw-cmp[geo]" in said
    assert "replay" not in said
    assert not (tmp_path / "out").exists()


def test_a_folder_of_others_stays(folder, capsys, tmp_path):
    shutil.copy(folder / "plan.yaml", tmp_path / "notes.txt")
    assert main(["channel", str(folder / "plan.yaml"), "-o", str(tmp_path), "--format", "csv"]) == 2
    assert "notes.txt" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]

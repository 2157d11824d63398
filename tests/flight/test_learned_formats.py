"""A flight gets the same learned antennas and the same error for each format and name of its logs."""

import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy.io import loadmat, savemat
from scipy.signal import lfilter

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.compare.gains import ANTENNA_TERMS, link_directions, term_kernel
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.drafting.proposals import NodeFinder, Nodes, propose, searching_airframe
from aerpaw_cmp.flight.gains import load_with_learned, sphere_angles
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs.flight_run import run_flight
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.writers import format_power_log
from aerpaw_cmp.propagation.geometry import rotation_from_aircraft
from aerpaw_cmp.site.learned import (
    DirectionCovariance,
    LearnedLevel,
    SpherePattern,
    folder_of,
    read_table,
    sphere_csv,
    sphere_grid,
    store_entry,
    unit_mean_gain,
)
from aerpaw_cmp.site.siteyaml import load_site
from tests.learned_entries import learned_entry, learned_series

ZONE = "America/New_York"
SITE = load_site("lake_wheeler")
TIMES = pd.Timestamp("2026-05-06T14:00:00") + pd.to_timedelta(np.arange(3600) * 0.2, unit="s")
RNG = np.random.default_rng(7)


def lobes(*directions: tuple[float, float, float]) -> np.ndarray:
    """A gain of some 5 dB with lobes towards unit vectors."""
    _, _, v = sphere_grid()
    return unit_mean_gain(
        sum(6.0 * np.exp(-((v - d / np.linalg.norm(d)) ** 2).sum(axis=-1)) for d in np.array(directions))
    )


UAV = lobes((1, 0.3, -0.4), (-0.6, -1, -0.6))
TOWERS = {"USRP1": lobes((1, 0.2, 0.3), (-0.2, -1, 0.4)), "USRP2": lobes((-1, 0.7, 0.3), (0.3, 1, 0.4))}


def table(gain: np.ndarray) -> bytes:
    return sphere_csv(gain, np.full(gain.shape, 0.7), (f"trained_on: {'a' * 64}",)).encode()


def known_site(folder: Path, turn_deg: int = 0, *, general: bool = True) -> Path:
    """Write the packaged site with these antennas, and the airframe rotated by complete steps of its table.

    An airframe that is not ``general`` does not predict other flights.
    """
    place = folder / "mine.yaml"
    place.write_bytes(folder_of("lake_wheeler").with_suffix(".yaml").read_bytes())
    _, _, v = sphere_grid(20.0)
    at = v.reshape(-1, 3)[18:-17]
    known, of_towers = (
        DirectionCovariance(directions=at, covariance_db2=0.05 * term_kernel(term, at, at)).table(()).encode()
        for term in ANTENNA_TERMS[:2]
    )
    uav = table(np.roll(UAV, turn_deg // 5, axis=1))
    files, series = {"u.csv.gz": uav, "k.csv.gz": known, "m.csv.gz": of_towers}, []
    for channel, gain in TOWERS.items():
        files[f"{channel}.t.csv.gz"] = table(gain)
        # above free space: 2.8 dB for 40 dBm at 3.3 GHz over 1 m, and what the flight below adds
        offset_db = 11.8 if channel == "USRP1" else 7.8
        level = LearnedLevel(offset_db=offset_db, sd_db=1.7, transmit_power_dbm=40.0, unit="dB re full scale")
        names = {"uav_file": "u.csv.gz", "known_file": "k.csv.gz", "tower_known_file": "m.csv.gz"}
        series.append(learned_series(channel, **names, level=level, shares_airframe=general))
    store_entry(place, "past", learned_entry(*series), files)
    return place


def flown() -> tuple[pd.DataFrame, dict[str, np.ndarray], list[float]]:
    """Telemetry of legs at four headings about LW1, the level of both channels, and the RMSE of its added error."""
    t = np.arange(len(TIMES)) * 0.2
    east = 180.0 * np.sin(2 * np.pi * t / 97.0)
    north = 60.0 + 220.0 * np.sin(2 * np.pi * t / 241.0)
    up = np.minimum(2.0 * t, 45.0)
    yaw = 90.0 * np.floor(t / 60.0) % 360.0 + 20.0
    place = np.stack([east, north, up], axis=1)
    zeros = np.zeros(len(t))
    rotation = rotation_from_aircraft(zeros, zeros, yaw)
    at_uav, at_tower = link_directions(SITE.towers["LW1"].position_m, place, rotation)
    away_db = 20.0 * np.log10(np.linalg.norm(place - SITE.towers["LW1"].position_m, axis=1))
    pattern = SpherePattern("u", UAV, np.zeros(UAV.shape))
    levels, errors = {}, []
    for number, (channel, gain) in enumerate(TOWERS.items()):
        tower = SpherePattern("t", gain, np.zeros(gain.shape))
        slow = lfilter([1.0], [1.0, -0.98], RNG.normal(0.0, 0.25, len(t)))
        gains = pattern.gain_dbi(*sphere_angles(at_uav)) + tower.gain_dbi(*sphere_angles(at_tower))
        error = slow + RNG.normal(0.0, 1.0, len(t))
        levels[channel] = gains - away_db + 9.0 - 4.0 * number + error
        errors.append(float(error[up >= 5.0].std()))
    latitude, longitude = SITE.frame.to_geographic(east, north)
    track = pd.DataFrame({
        "latitude": latitude, "longitude": longitude, "height": up, "roll": zeros, "pitch": zeros, "yaw": yaw
    })  # fmt: skip
    return track, levels, errors


TRACK, LEVELS, ADDED_DB = flown()
UTC = [f"{time.isoformat()}Z" for time in TIMES]


def pose_table(folder: Path, name: str = "track.csv") -> None:
    frame = TRACK.rename(columns={"height": "height_above_takeoff(m)"})
    frame.insert(0, "timestamp", UTC)
    frame.to_csv(folder / name, index=False)


def merged_mat(folder: Path) -> None:
    names = {"mY": "latitude", "mX": "longitude", "mZ": "height", "mRoll": "roll", "mPitch": "pitch", "mYaw": "yaw"}
    columns = {name: TRACK[column].to_numpy() for name, column in names.items()}
    columns |= {f"mpower{i}": level for i, level in enumerate(LEVELS.values(), 1)}
    seconds = (TIMES - pd.Timestamp(0)) / pd.Timedelta(seconds=1)
    savemat(folder / "merged.mat", {**columns, "timestamp_meas": seconds.to_numpy()})


def raw_logs(folder: Path) -> None:
    pose_table(folder)
    for channel, level in LEVELS.items():
        (folder / "LW1" / channel).mkdir(parents=True)
        log = folder / "LW1" / channel / "2026-05-06_10_00_00_power_log.txt"
        log.write_bytes(format_power_log(TIMES.to_numpy(), level, ZONE))


def renamed_log(folder: Path) -> None:
    """One of the logs, in a folder and with a file name that say nothing."""
    pose_table(folder, "gps.csv")
    (folder / "left_power_log.txt").write_bytes(format_power_log(TIMES.to_numpy(), LEVELS["USRP2"], ZONE))


def unnamed_logs(folder: Path) -> None:
    """Both raw logs of the tower in one folder, without the name of a channel, the second port first."""
    pose_table(folder)
    for name, channel in (("a", "USRP2"), ("b", "USRP1")):
        log = folder / "LW1" / f"{name}_power_log.txt"
        log.parent.mkdir(exist_ok=True)
        log.write_bytes(format_power_log(TIMES.to_numpy(), LEVELS[channel], ZONE))


def level_tables(folder: Path, unit: str = "dBm") -> None:
    pose_table(folder)
    for name, level in zip(("b", "a"), LEVELS.values(), strict=True):
        frame = pd.DataFrame({"timestamp": UTC, f"rss_{name} ({unit})": level})
        frame.to_csv(folder / f"meter {name}.csv", index=False)


def sigmf(folder: Path) -> None:
    capture = {
        "core:sample_start": 0,
        "measurement:time_stamp": UTC,
        "measurement:values": {
            **{key: TRACK[name].tolist() for key, name in (("mX", "longitude"), ("mY", "latitude"), ("mZ", "height"))},
            **{f"RSS{i}": level.tolist() for i, level in enumerate(LEVELS.values(), 1)},
        },
        "core:rotation": {name: TRACK[name].tolist() for name in ("roll", "pitch", "yaw")},
    }
    meta = {"global": {"core:datatype": "cf32_le", "core:version": "1.0.0"}, "captures": [capture], "annotations": []}
    (folder / "flight.sigmf-meta").write_text(json.dumps(meta))


FORMS: tuple[Callable[[Path], None], ...] = (merged_mat, raw_logs, renamed_log, unnamed_logs, level_tables, sigmf)


def drafted(write: Callable[[Path], None], folder: Path, site: Path) -> tuple[Path, dict]:
    """The draft of a form of the flight, and its content."""
    logs = folder / "logs"
    logs.mkdir()
    write(logs)
    draft = folder / "flight.yaml"
    assert main(["ingest", str(logs), "--timezone", ZONE, "--site", str(site), "--draft", str(draft)]) == 0
    return draft, yaml.safe_load(draft.read_text())


def errors_of(draft: Path) -> list[float]:
    """Return the RMSE of each channel [dB] with the times as logged: an estimated lag could hide a wrong clock."""
    settings = load_with_learned(draft)
    settings = settings.model_copy(update={"rss": settings.rss.model_copy(update={"lag": "off"})})
    result = run_flight(load_data(settings, draft.parent), audit=False).result
    return sorted(round(series.score.rmse_db, 2) for series in result.rss)


@pytest.mark.parametrize("write", FORMS)
def test_every_form_of_a_flight_gets_the_same_antennas_and_error(write, tmp_path, capsys) -> None:
    site = known_site(tmp_path)
    draft, content = drafted(write, tmp_path, site)
    known = {"mine/past_LW1.USRP1": ADDED_DB[0], "mine/past_LW1.USRP2": ADDED_DB[1]}
    if write is renamed_log:
        del known["mine/past_LW1.USRP1"]
    assert sorted(content["antennas"].values()) == [*known, "mine/past_uav"]
    assert content["rt"]["attitude"] == "logged"
    # the receiver is that of the learned antennas, by its level and its antennas
    radio = [log for log in content["logs"] if "track" not in log["path"] and "gps" not in log["path"]]
    assert {log.get("receiver") for log in radio} == {"past"}
    assert "?" in next(line for line in draft.read_text().splitlines() if "the learned receiver past?" in line)
    assert errors_of(draft) == pytest.approx(sorted(known.values()), abs=0.03)
    capsys.readouterr()


def test_two_logs_without_channels_are_two_channels_whose_ports_the_levels_show(tmp_path, capsys) -> None:
    _, content = drafted(unnamed_logs, tmp_path, known_site(tmp_path))
    ports = {"LW1.power": "mine/past_LW1.USRP2", "LW1.power_2": "mine/past_LW1.USRP1", "uav": "mine/past_uav"}
    assert content["antennas"] == ports
    assert [log.get("channel") for log in content["logs"] if "power" in log["path"]] == [None, "power_2"]
    assert "left out" not in capsys.readouterr().err


def test_antennas_of_two_campaigns_are_compared_with_the_same_alternatives(tmp_path, capsys) -> None:
    """The other campaign has a coarser antenna, and its airframe alone is not an alternative."""
    site = known_site(tmp_path)
    names = {"uav_file": "v.csv.gz", "tower_file": "c.csv.gz", "known_file": "l.csv.gz", "tower_known_file": "n.csv.gz"}
    past = folder_of(site)
    tables = {copy: read_table(past / name, "") for copy, name in (("v.csv.gz", "u.csv.gz"), ("l.csv.gz", "k.csv.gz"),
                                                                  ("n.csv.gz", "m.csv.gz"))}  # fmt: skip
    series = learned_series("third", **names, shares_airframe=False)
    store_entry(site, "other", learned_entry(series), {**tables, "c.csv.gz": table(0.8 * TOWERS["USRP2"])})
    _, content = drafted(renamed_log, tmp_path, site)
    assert sorted(content["antennas"].values()) == ["mine/past_LW1.USRP2", "mine/past_uav"]
    capsys.readouterr()


@pytest.mark.parametrize(("unit", "count"), [("dB", 3), ("dBm", 0)])
def test_levels_in_decibels_without_a_reference_are_not_those_of_another_unit(unit, count, tmp_path, capsys) -> None:
    """Antennas whose airframe does not predict other flights are not tested on levels in another unit."""
    _, content = drafted(partial(level_tables, unit=unit), tmp_path, known_site(tmp_path, general=False))
    assert len(content.get("antennas", ())) == count
    capsys.readouterr()


def test_the_unit_of_levels_does_not_decide_about_antennas(tmp_path, capsys) -> None:
    """Half a minute of levels has little evidence. It must be the same in the learned unit and in another."""

    def short(folder: Path) -> None:
        level_tables(folder, unit)
        for table in folder.glob("meter*.csv"):
            table.write_text("".join(table.read_text().splitlines(keepends=True)[:151]))

    found = []
    for unit in ("dBm", "dB"):
        (tmp_path / unit).mkdir()
        draft, content = drafted(short, tmp_path / unit, known_site(tmp_path / unit))
        names = sorted(content.get("antennas", {}).values())
        found.append((names, re.findall(r"odds \d+:1 against an unknown gain", draft.read_text())))
    assert found[0] == found[1]
    assert len(found[0][0]) == 3
    capsys.readouterr()


@pytest.mark.parametrize("names", [("a/", "b/"), ("left_", "right_"), ("LW1/USRP1/", "LW1/USRP2/")])
def test_each_of_two_receivers_has_the_lock_of_its_own_quality(names, tmp_path, capsys) -> None:
    lost = np.arange(len(TIMES)) % 900 < 300
    known = {"USRP1": np.full(len(TIMES), 72.2) + 0.1 * (np.arange(len(TIMES)) % 3)}
    known["USRP2"] = np.where(lost, 40.0, known["USRP1"])

    def write(folder: Path) -> None:
        pose_table(folder)
        for name, channel in zip(names, LEVELS, strict=True):
            # in lock, levels of this receiver are above -15 dB
            level = np.where(known[channel] > 60.0, LEVELS[channel] + 40.0, RNG.normal(-70.0, 1.0, len(TIMES)))
            for what, values in (("power", level), ("quality", known[channel])):
                log = folder / f"{name}2026-05-06_10_00_00_{what}_log.txt"
                log.parent.mkdir(parents=True, exist_ok=True)
                log.write_bytes(format_power_log(TIMES.to_numpy(), values, ZONE))

    draft, content = drafted(write, tmp_path, known_site(tmp_path))
    data = load_data(load_flight(draft), draft.parent)
    shares = sorted(float(np.nanmean(series.locked)) for series in data.rss)
    assert shares == pytest.approx([2.0 / 3.0, 1.0], abs=0.01)
    assert len([log for log in content["logs"] if log.get("skip")]) == 2
    capsys.readouterr()


def test_another_level_or_a_copy_of_a_log_is_asked_about_or_left_out(tmp_path, capsys) -> None:
    def louder(folder: Path) -> None:
        pose_table(folder)
        for name, levels in (("a", LEVELS["USRP1"] + 20.0), ("copy", np.repeat(LEVELS["USRP1"][::4] + 20.3, 4))):
            log = folder / "LW1" / f"{name}_power_log.txt"
            log.parent.mkdir(exist_ok=True)
            log.write_bytes(format_power_log(TIMES.to_numpy(), levels, ZONE))

    draft, content = drafted(louder, tmp_path, known_site(tmp_path))
    (radio,) = (log for log in content["logs"] if "power" in log["path"])
    assert "receiver" not in radio
    assert re.search(r"level 31\.\d dB above free space .* is it another receiver than past\?", draft.read_text())
    assert "copy_power_log.txt: " in capsys.readouterr().err


def test_a_flight_file_without_antennas_is_offered_the_same(tmp_path, capsys) -> None:
    site = known_site(tmp_path)
    _, content = drafted(merged_mat, tmp_path, site)
    names = content.pop("antennas")
    (tmp_path / "bare.yaml").write_text(yaml.safe_dump(content))
    bare = str(tmp_path / "bare.yaml")
    words = ["report", bare, "-o", str(tmp_path / "bare"), "--audit", "none", "--figures", "none"]
    assert main([*words, "--recommend", str(tmp_path / "best.yaml")]) == 0
    assert yaml.safe_load((tmp_path / "best.yaml").read_text())["antennas"] == names
    capsys.readouterr()


def test_an_airframe_is_compared_only_at_known_positions(tmp_path, capsys) -> None:
    """At a position that was estimated from the levels, an airframe of another aircraft can fit them."""
    draft, content = drafted(merged_mat, tmp_path, known_site(tmp_path))
    del content["antennas"]
    tower = SITE.towers["LW1"]
    place = {"latitude_deg": tower.latitude_deg, "longitude_deg": tower.longitude_deg, "antenna_height_m": 10.0}
    content |= {"towers": {"NODE": place}, "logs": [log | {"node": "NODE"} for log in content["logs"]]}
    draft.write_text(yaml.safe_dump(content))
    data = load_data(load_flight(draft), draft.parent)
    known, unknown = (
        propose(data, data.site_place, "mine", Nodes(placed=n)) for n in (frozenset({"NODE"}), frozenset())
    )
    assert known.antennas["uav"] == "mine/past_uav"
    assert not unknown.antennas
    assert unknown.antennas_about.endswith("NODE has an estimated position")
    capsys.readouterr()


@pytest.mark.parametrize("turn_deg", [90, 180, 270])
def test_a_rotated_airframe_is_refused(turn_deg, tmp_path, capsys) -> None:
    _, content = drafted(raw_logs, tmp_path, known_site(tmp_path, turn_deg))
    assert "antennas" not in content
    capsys.readouterr()


@pytest.mark.parametrize(
    ("turn_deg", "sha256", "carrier_hz", "found"),
    [
        (0, "b" * 64, 3.51e9, True),  # another year's carrier, 6 % away
        (90, "b" * 64, 3.3e9, False),
        (180, "b" * 64, 3.3e9, False),
        (270, "b" * 64, 3.3e9, False),
        (0, "a" * 64, 3.3e9, False),  # learned from this very log
        (0, "b" * 64, 2.4e9, False),
    ],
)
def test_levels_choose_the_airframe_for_a_node_at_an_unknown_place(turn_deg, sha256, carrier_hz, found, tmp_path):
    level_tables(tmp_path)
    options = ReadOptions(timezone=ZONE)
    pose, level = (ingest([tmp_path / name], options=options)[0] for name in ("track.csv", "meter a.csv"))
    (vehicle,), (power,) = pose.result.streams, level.result.streams
    assert power.attributes["unit"] == "dBm"
    track = NodeFinder(SITE, vehicle).levels(power)
    airframe = searching_airframe(known_site(tmp_path, turn_deg), (sha256, ""), track, carrier_hz)
    assert (airframe is not None) is found


@pytest.mark.parametrize("step_db", [0.0, 0.2])
def test_a_stuck_receiver_is_not_evidence_of_a_learned_one(step_db, tmp_path, capsys) -> None:
    """Two channels with one or two levels are not a learned receiver, although they are near its usual level."""

    def stuck(folder: Path) -> None:
        merged_mat(folder)
        columns = {name: values for name, values in loadmat(folder / "merged.mat").items() if name[:2] != "__"}
        for i in (1, 2):
            # 10 dB above free space at the tower that the draft proposes
            columns[f"mpower{i}"] = np.median(LEVELS["USRP1"]) - 22.0 + 0.01 * i + step_db * (np.arange(len(TIMES)) % 2)
        savemat(folder / "merged.mat", columns)

    _, content = drafted(stuck, tmp_path, known_site(tmp_path))
    assert not {"antennas", "receiver"} & {*content, *content["logs"][0]}
    capsys.readouterr()

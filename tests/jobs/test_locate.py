"""An unknown node of a simulated flight, from its logs to the page."""

import hashlib
import json
import re

import numpy as np
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.flight.training import mark_of
from aerpaw_cmp.jobs.options import RunOptions
from aerpaw_cmp.jobs.run import run_simulate
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.site.siteyaml import load_site
from tests.json_page import listed

PLAN = """
flight:
  name: search
  plan:
    start: 2025-06-01T10:00:00
    speed_mps: 8
    fading_db: 2
    waypoints:
      - {east_m: -250, north_m: -150, height_m: 30}
      - {east_m: 250, north_m: -150, height_m: 30}
      - {east_m: 250, north_m: 60, height_m: 30}
      - {east_m: -250, north_m: 60, height_m: 30}
      - {east_m: -250, north_m: 230, height_m: 30}
      - {east_m: 250, north_m: 230, height_m: 30}
timezone: America/New_York
site: {file: lake_wheeler, without_buildings: true}
logs:
  - {path: vehicleOut.txt, reader: vehicle_out}
  - {path: power.txt, reader: sounder_log, node: LW1, channel: A}
rt: {max_depth: 0}
"""


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("search")
    (folder / "plan.yaml").write_text(PLAN)
    run_simulate(folder / "plan.yaml", RunOptions(out=folder / "flown"))
    text = PLAN.partition("  plan:")[0] + "timezone" + PLAN.partition("timezone")[2].replace("node: LW1, ", "")
    (folder / "flown" / "unknown.yaml").write_text(text)
    return folder / "flown" / "unknown.yaml"


def test_the_node_lies_in_its_region_and_the_page_says_what_was_assumed(flight, capsys):
    out = flight.parents[1] / "out"
    assert main(["locate", str(flight), "-o", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert list(printed) == ["schema", *listed("locate")]
    site = load_site("lake_wheeler")
    east, north = site.frame.to_local(
        np.array([printed["position"]["latitude_deg"]]), np.array([printed["position"]["longitude_deg"]])
    )
    tower = site.towers["LW1"].position_m
    away = float(np.hypot(east[0] - tower[0], north[0] - tower[1]))
    assert away <= printed["region90_m"]
    assert away < 60.0
    assert printed["region50_m"] < printed["region90_m"]
    assert sum(mode["share"] for mode in printed["modes"]) == pytest.approx(0.9, abs=0.02)
    region = np.loadtxt(out / "region.csv", delimiter=",", skiprows=1)
    assert region[:, 2].max() < 90.0
    distance = np.hypot(*(np.array(site.frame.to_local(region[:, 0], region[:, 1])).T - tower[:2]).T)
    assert distance.min() < 5.0
    html = (out / "locate.html").read_text()
    assert printed["sentence"] in html
    assert "Path-loss exponent" in html
    assert "Antenna of the UAV: unknown. Antenna of the node: unknown" in html
    assert '"name":"region of the node"' in html


def test_what_cannot_be_located_is_refused(flight, capsys, tmp_path):
    assert main(["locate", str(flight), "--channel", "B", "-o", str(tmp_path / "out")]) == 2
    assert "one of A" in capsys.readouterr().err
    text = flight.read_text().replace("  - {path: vehicleOut.txt, reader: vehicle_out}\n", "")
    (flight.parent / "blind.yaml").write_text(text)
    assert main(["locate", str(flight.parent / "blind.yaml"), "-o", str(tmp_path / "out")]) == 3
    assert "no log has telemetry" in capsys.readouterr().err
    short = flight.parent / "short.txt"
    short.write_text("".join(flight.with_name("power.txt").read_text().splitlines(keepends=True)[:40]))
    (flight.parent / "short.yaml").write_text(flight.read_text().replace("path: power.txt", "path: short.txt"))
    assert main(["locate", str(flight.parent / "short.yaml"), "-o", str(tmp_path / "out")]) == 3
    assert " of 4 s with a level" in capsys.readouterr().err
    track = flight.with_name("vehicleOut.txt").read_text()
    flight.with_name("abroad.txt").write_text(track.replace(",35.7", ",48.1"))
    (flight.parent / "abroad.yaml").write_text(flight.read_text().replace("vehicleOut.txt", "abroad.txt"))
    assert main(["locate", str(flight.parent / "abroad.yaml"), "-o", str(tmp_path / "out")]) == 3
    assert "of a tower" in capsys.readouterr().err
    lines = flight.with_name("power.txt").read_text().splitlines(keepends=True)
    flight.with_name("constant.txt").write_text("".join(re.sub(r"(?<=[ ,])-?\d+\.\d+$", "-60.0", x) for x in lines))
    (flight.parent / "constant.yaml").write_text(flight.read_text().replace("path: power.txt", "path: constant.txt"))
    assert main(["locate", str(flight.parent / "constant.yaml"), "-o", str(tmp_path / "out")]) == 3
    assert "do not determine a place" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_growing_log_is_followed_until_it_is_interrupted(flight, capsys, tmp_path, monkeypatch):
    from aerpaw_cmp.cli.commands import planning

    whole = flight.with_name("power.txt").read_text().splitlines(keepends=True)
    growing = flight.with_name("growing.txt")
    growing.write_text("".join(whole[: len(whole) // 2]) + whole[-1][:9])  # a truncated last line
    (flight.parent / "growing.yaml").write_text(flight.read_text().replace("path: power.txt", "path: growing.txt"))
    waits = []

    def wait(seconds):
        waits.append(seconds)
        growing.write_text("".join(whole))
        if len(waits) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(planning.time, "sleep", wait)
    assert main(["locate", str(flight.parent / "growing.yaml"), "-o", str(tmp_path / "out"), "--follow"]) == 130
    first, second = (
        line for line in capsys.readouterr().out.splitlines() if "node is most likely" in line or "places" in line
    )
    assert first != second
    assert (tmp_path / "out" / "locate.html").exists()


def test_only_a_log_with_a_lock_quality_has_the_floor_of_a_lost_lock(flight, capsys, tmp_path):
    """The channel of a sounder log that names none is called power."""
    (flight.parent / "unnamed.yaml").write_text(flight.read_text().replace(", channel: A", ""))
    assert main(["locate", str(flight.parent / "unnamed.yaml"), "-o", str(tmp_path / "out"), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert "Floor of the receiver: not known." in " ".join(printed["assumed"])
    assert printed["region90_m"] < 200.0


def test_whole_decibels_of_rsrp_are_not_a_floor(flight, capsys, tmp_path):
    (log,) = ingest([flight.with_name("power.txt")], options=ReadOptions(timezone="America/New_York"))
    frame = log.result.streams[0].frame
    level = frame["rss_db"].round().clip(lower=frame["rss_db"].quantile(0.05).round())
    stamps = frame["time"].dt.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    text = "".join(f"{time},{value:g},77\n" for time, value in zip(stamps, level, strict=True))
    flight.with_name("phone.csv").write_text("time,RSRP (dBm),PCI\n" + text)
    line = "{path: power.txt, reader: sounder_log, channel: A}"
    (flight.parent / "phone.yaml").write_text(flight.read_text().replace(line, "{path: phone.csv, reader: drive_test}"))
    assert main(["locate", str(flight.parent / "phone.yaml"), "-o", str(tmp_path / "out"), "--json"]) == 0
    assert "Floor of the receiver: not known." in " ".join(json.loads(capsys.readouterr().out)["assumed"])


@pytest.mark.parametrize("own", ["log", "copy", ""])
def test_antennas_that_this_very_log_taught_are_not_used(flight, own, capsys, tmp_path):
    digest = hashlib.sha256(flight.with_name("power.txt").read_bytes()).hexdigest() if own == "log" else "ab" * 32
    (log,) = ingest([flight.with_name("power.txt")], options=ReadOptions(timezone="America/New_York"))
    frame = log.result.streams[0].frame
    mark = mark_of(frame["time"].to_numpy(), frame["rss_db"].to_numpy())
    rows = [f"{a},{e},0,1" for a in range(0, 360, 90) for e in (90, 0, -90)]
    head = [
        f"# trained_on: {digest}",
        *([f"# marks: {mark}"] if own == "copy" else []),
        "azimuth_deg,elevation_deg,gain_dbi,gain_sd_db",
    ]
    (flight.parent / "frame.csv").write_text("\n".join([*head, *rows]) + "\n")
    link = "link: {rss: {carrier_hz: 3.3e9, uav: {antenna: {model: sphere, file: frame.csv}}}}\n"
    (flight.parent / "taught.yaml").write_text(flight.read_text() + link)
    assert main(["locate", str(flight.parent / "taught.yaml"), "-o", str(tmp_path / "out"), "--json"]) == 0
    assumed = json.loads(capsys.readouterr().out)["assumed"][1]
    assert assumed.startswith("Antenna of the UAV: unknown." if own else "Antenna of the UAV: frame.")

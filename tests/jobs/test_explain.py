"""``aerpaw-cmp explain``: terms add up to what the report writes, and each reason is the true one."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pandas as pd
import pytest
import yaml

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.flight import simulate
from aerpaw_cmp.flight.settings import AdvancedRt
from aerpaw_cmp.jobs import explain
from aerpaw_cmp.jobs.explain import run_explain
from aerpaw_cmp.propagation import replay as replay_module
from aerpaw_cmp.propagation.field.sum import mean_pair_power
from aerpaw_cmp.propagation.options import Search
from tests.json_page import unlisted

ANTENNA = {"layout": "single", "antenna": {"model": "dipole"}}
SETTINGS = {
    "flight": {
        "name": "small", "synthetic": True,
        "plan": {
            "start": "2025-06-01T10:00:00", "seed": 4, "speed_mps": 10.0, "rss_interval_s": 1.0, "fading_db": 0.0,
            "waypoints": [{"east_m": e, "north_m": n, "height_m": h} for e, n, h in ((-40, 10, 30), (-250, 60, 20))],
            "offsets_db": {"LW1": {"USRP1": 12.3}, "LW2": {"USRP1": 3.0}},
        },
    },
    "site": {"file": "lake_wheeler"},
    "timezone": "America/New_York",
    "logs": [
        {"path": "small/vehicle.txt", "reader": "vehicle_out"},
        {"path": "small/USRP1.txt", "reader": "sounder_log", "node": "LW1", "channel": "USRP1"},
        {"path": "small/USRP2.txt", "reader": "sounder_log", "node": "LW2", "channel": "USRP1"},
    ],
    "link": {"rss": {"carrier_hz": 3.3e9, "tower": {**ANTENNA, "slant_deg": [20.0]}, "uav": ANTENNA}},
    "rt": {"audit_links": 0, "attitude": "logged", "foliage": "attenuating", "reflection_loss_db": 1.5},
    "rss": {"lag": "off"},
}  # fmt: skip


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A small flight and its report."""
    folder = tmp_path_factory.mktemp("explain")
    path = folder / "flight.yaml"
    path.write_text(yaml.safe_dump(SETTINGS), encoding="utf-8")
    assert main(["simulate", str(path), "--quiet"]) == 0
    assert main(["report", str(path), "-o", str(folder / "out"), "--figures", "none", "--quiet"]) == 0
    return path, pd.read_csv(folder / "out" / "rss.csv")


@pytest.mark.parametrize("tower", ["LW1", "LW2"])
def test_terms_add_up_to_the_level_of_the_report(flown, tower):
    path, table = flown
    rows = table[table.tower == tower]
    seen = set()
    for row in rows.iloc[:: max(len(rows) // 5, 1)].itertuples():
        found = run_explain(path, time=row.time_utc, tower=tower)
        assert found.time_utc == row.time_utc
        assert (found.position_m[0], found.position_m[2]) == pytest.approx((row.east_m, row.up_m), abs=1e-3)
        assert found.measured_db == pytest.approx(row.measured_db, abs=1e-3)
        assert found.level_dbm == pytest.approx(row.simulated_dbm, abs=1e-3)
        field = 0.0
        for one in found.paths:
            assert one.level_dbm == pytest.approx(found.transmit_power_dbm + sum(one.terms_db.values()), abs=1e-9)
            assert one.length_m == pytest.approx(sum(one.segments_m))
            assert one.delay_ns == pytest.approx(one.length_m / 0.299792458)
            spreading = 20 * np.log10(299792458 / 3.3e9 / (4 * np.pi * one.length_m))
            assert one.terms_db["spreading"] == pytest.approx(spreading, abs=1e-9)
            assert one.terms_db["rough surfaces"] == -1.5 * one.depth
            field += 10 ** (one.level_dbm / 20) * np.exp(1j * np.radians(one.phase_deg))
            seen |= set(one.terms_db)
            for bounce in one.bounces:  # what a reflection takes lies between its two coefficients
                least, most = sorted((-bounce.te_db, -bounce.tm_db))
                assert least - 1e-9 <= bounce.loss_db <= most + 1e-9
        assert 20 * np.log10(abs(field)) == pytest.approx(row.simulated_dbm, abs=1e-3)
    assert {"foliage", "reflection 1", "polarisation", "UAV antenna"} <= seen


def test_command_line_and_json(flown, capsys):
    path, _ = flown
    assert main(["explain", str(path), "--time", "4", "--tower", "LW1", "--json", "--quiet"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert unlisted("explain", found) == []
    assert found["tower"] == "LW1"
    assert found["time_s"] == 4.0
    assert found["paths"][0]["path"] == "line of sight"
    assert main(["explain", str(path), "--time", "2025-06-01T10:00:04", "--tower", "LW1", "--quiet"]) == 0  # local time
    said = capsys.readouterr().out
    assert "line of sight" in said
    assert "coherent sum" in said


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": "9999"}, r"after the last sample.*|0 to"),
        ({"time": "-20"}, "before the first"),
        ({"time": "noon"}, "seconds after"),
        ({"tower": "LW9"}, "LW1, LW2"),
        ({"tower": "LW4"}, "not measured there"),
        ({"channel": "USRP7"}, "USRP1"),
    ],
)
def test_bad_input_is_one_message(flown, change, message):
    with pytest.raises(UsageError, match=message):
        run_explain(flown[0], **{"time": "4", "tower": "LW1", **change})


def test_paths_that_one_engine_lacks_are_named_with_the_reason(flown, monkeypatch):
    """Sionna stands for itself with samples missing and a path through a wall: what it says is made up here."""
    path, _ = flown
    true = explain.replay_poses

    def replay_poses(site, rt, link, pose, *, engine=None, **_):
        found = true(site, rt, link, pose, engine="image")
        if engine != "sionna":
            return found
        few = rt.advanced.samples == "auto"
        paths = found.paths.select(found.paths.depth < (1 if few else 2))
        return dataclasses.replace(found, paths=paths, engine="sionna", samples=1000)

    monkeypatch.setattr(explain, "replay_poses", replay_poses)
    found = run_explain(path, time="4", tower="LW1", engine="both")
    assert {one.found_by for one in found.differences} == {"image"}
    budget = [one for one in found.differences if "sample budget: found with 10000" in one.reason]
    assert "ground" in {one.path for one in budget}

    def no_direct_path(site, rt, link, pose, *, engine=None, **_):
        found = true(site, rt, link, pose, engine="image")
        return (
            found if engine == "sionna" else dataclasses.replace(found, paths=found.paths.select(found.paths.depth > 0))
        )

    monkeypatch.setattr(explain, "replay_poses", no_direct_path)
    found = run_explain(path, time="4", tower="LW1", engine="both")
    (one,) = found.differences
    assert (one.found_by, one.path, one.reason) == ("sionna", "line of sight", "no reason found")
    assert found.absent[0][0] == "line of sight"


def test_other_interactions_are_counted_beside_the_reflections(flown, monkeypatch, capsys):
    """Their power is made up here: half of that of the reflections, so the level rises by 10 log10(1.5)."""
    path, _ = flown
    plain = run_explain(path, time="4", tower="LW1")
    settings = yaml.safe_load(path.read_text())
    settings["rt"] |= {"engine": "sionna", "advanced": {"interactions": ["reflection", "diffraction"]}}
    other = path.with_name("others.yaml")
    other.write_text(yaml.safe_dump(settings), encoding="utf-8")
    true, asked = explain.replay_poses, []

    def replay_poses(site, rt, link, pose, *, engine=None, others=None, **_):
        asked.append((engine, others))
        found = true(site, rt.model_copy(update={"advanced": AdvancedRt()}), link, pose, engine="image")
        power = 0.5 * mean_pair_power(found.h)
        kinds = {"diffraction": 2, "reflection + diffraction": 1}
        added = replay_module._with_others(found, link, ("reflection", "diffraction"), power, np.array([[3]]), kinds)
        return dataclasses.replace(added, engine="sionna")

    monkeypatch.setattr(explain, "replay_poses", replay_poses)
    assert main(["explain", str(other), "--time", "4", "--tower", "LW1", "--json", "--quiet"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert asked == [("sionna", True)]
    assert found["level_dbm"] == pytest.approx(plain.level_dbm, abs=1e-9)  # of the reflections, as their terms add up
    told = found["other_interactions"]
    assert (told["interactions"], told["paths"]) == (["diffraction"], 3)
    assert told["level_dbm"] == pytest.approx(plain.level_dbm + 10 * np.log10(1.5), abs=1e-9)
    assert told["power_dbm"] == pytest.approx(plain.level_dbm + 10 * np.log10(0.5), abs=1e-9)
    assert main(["explain", str(other), "--time", "4", "--tower", "LW1", "--quiet"]) == 0
    assert "diffraction by Sionna: 2 diffraction, 1 reflection + diffraction;" in capsys.readouterr().out
    assert plain.other_interactions is None


def test_interactions_that_the_image_engine_has_not_are_refused_by_explain_and_simulate(flown, capsys):
    path, _ = flown
    settings = yaml.safe_load(path.read_text())
    settings["rt"]["interactions"] = ["reflection", "diffraction"]
    other = path.with_name("refused.yaml")
    other.write_text(yaml.safe_dump(settings), encoding="utf-8")
    for command in (["explain", str(other), "--time", "4", "--tower", "LW1"],
                    ["simulate", str(other), "-o", str(path.parent / "never")]):  # fmt: skip
        assert main([*command, "--quiet"]) == 2
        said = capsys.readouterr().err
        assert "diffraction" in said
        assert "engine 'image'" in said
        assert "Traceback" not in said
    assert not (path.parent / "never").exists()


def test_simulate_logs_the_level_with_other_interactions(flown, monkeypatch):
    path, _ = flown
    true, asked = simulate.replay, []

    def replay(site, link, poses, search, *options, **named):
        asked.append((search.engine, tuple(search.interactions)))
        found = true(site, link, poses, Search(max_depth=search.max_depth))
        more = 5.0 * (len(search.interactions) > 1)
        return dataclasses.replace(found, rss_dbm=found.rss_dbm + more, rss_power_dbm=found.rss_power_dbm + more)

    monkeypatch.setattr(simulate, "replay", replay)
    levels = {}
    for name, names in (("plain", ["reflection"]), ("others", ["reflection", "refraction"])):
        settings = yaml.safe_load(path.read_text())
        settings["rt"] |= {"engine": "sionna", "advanced": {"interactions": names}}
        other = path.with_name(f"{name}.yaml")
        other.write_text(yaml.safe_dump(settings), encoding="utf-8")
        assert main(["simulate", str(other), "-o", str(path.parent / name), "--quiet"]) == 0
        text = (path.parent / name / "small" / "USRP1.txt").read_text().splitlines()
        levels[name] = np.array([float(line.split()[-1]) for line in text if line[:1] == "["])
    assert ("sionna", ("reflection", "refraction")) in asked
    assert levels["others"].size > 5
    np.testing.assert_allclose(levels["others"] - levels["plain"], 5.0, atol=1e-3)

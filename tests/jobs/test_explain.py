"""``aerpaw-cmp explain``: terms add up to what the report writes, and each reason is the true one."""

import json

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.jobs.explain import run_explain
from aerpaw_cmp.site.siteyaml import load_site
from tests.json_page import unlisted
from tests.simulated import planned, simulate, write_yaml

ANTENNA = {"layout": "single", "antenna": {"model": "dipole"}}
SETTINGS = planned(
    "small", [(-40, 10, 30), (-250, 60, 20)], {"LW1": {"USRP1": 12.3}, "LW2": {"USRP1": 3.0}},
    plan={"rss_interval_s": 1.0}, site={"file": "lake_wheeler"},
    link={"rss": {"carrier_hz": 3.3e9, "tower": {**ANTENNA, "slant_deg": [20.0]}, "uav": ANTENNA}},
    rt={"audit_links": 0, "attitude": "logged", "foliage": "attenuating", "reflection_loss_db": 1.5},
)  # fmt: skip


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A small flight and its report."""
    folder = tmp_path_factory.mktemp("explain")
    path = write_yaml(folder / "flight.yaml", SETTINGS)
    simulate(path)
    assert main(["report", str(path), "-o", str(folder / "out"), "--figures", "none", "--quiet"]) == 0
    return path, pd.read_csv(folder / "out" / "rss.csv")


@pytest.mark.parametrize("tower", ["LW1", "LW2"])
def test_terms_add_up_to_the_level_of_the_report(flown, tower):
    path, table = flown
    rows = table[table.tower == tower]
    seen = set()
    for row in rows.iloc[:: max(len(rows) // 5, 1)].itertuples():
        explained = run_explain(path, time=row.time_utc, tower=tower)
        assert explained.time_utc == row.time_utc
        assert (explained.position_m[0], explained.position_m[2]) == pytest.approx((row.east_m, row.up_m), abs=1e-3)
        assert explained.measured_db == pytest.approx(row.measured_db, abs=1e-3)
        assert explained.level_dbm == pytest.approx(row.simulated_dbm, abs=1e-3)
        field = 0.0
        for path_ in explained.paths:
            assert path_.level_dbm == pytest.approx(
                explained.transmit_power_dbm + sum(path_.terms_db.values()), abs=1e-9
            )
            assert path_.length_m == pytest.approx(sum(path_.segments_m))
            assert path_.delay_ns == pytest.approx(path_.length_m / 0.299792458)
            spreading = 20 * np.log10(299792458 / 3.3e9 / (4 * np.pi * path_.length_m))
            assert path_.terms_db["spreading"] == pytest.approx(spreading, abs=1e-9)
            assert path_.terms_db["rough surfaces"] == -1.5 * path_.depth
            field += 10 ** (path_.level_dbm / 20) * np.exp(1j * np.radians(path_.phase_deg))
            seen |= set(path_.terms_db)
            for bounce in path_.bounces:  # what a reflection takes lies between its two coefficients
                least, most = sorted((-bounce.te_db, -bounce.tm_db))
                assert least - 1e-9 <= bounce.loss_db <= most + 1e-9
        assert 20 * np.log10(abs(field)) == pytest.approx(row.simulated_dbm, abs=1e-3)
    assert {"foliage", "reflection 1", "polarisation", "UAV antenna"} <= seen


def test_a_link_below_the_noise_has_a_dash_and_the_reason(flown, capsys, tmp_path):
    path, _ = flown
    weak = tmp_path / "weak.yaml"
    weak.write_text(path.read_text().replace("carrier_hz:", "transmit_power_dbm: -200\n    carrier_hz:", 1))
    command = ["explain", str(weak), "--time", "2", "--tower", "LW1", "--logs-root", str(path.parent)]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "coherent sum - dBm" in printed
    assert "below the noise floor of -174" in printed


def test_command_line_and_json(flown, capsys):
    path, _ = flown
    assert main(["explain", str(path), "--time", "4", "--tower", "LW1", "--json", "--quiet"]) == 0
    explained = json.loads(capsys.readouterr().out)
    assert unlisted("explain", explained) == []
    assert explained["tower"] == "LW1"
    assert explained["time_s"] == 4.0
    assert explained["paths"][0]["path"] == "line of sight"
    assert main(["explain", str(path), "--time", "2025-06-01T10:00:04", "--tower", "LW1", "--quiet"]) == 0  # local time
    text = capsys.readouterr().out
    assert "line of sight" in text
    assert "coherent sum" in text


def test_a_tower_without_a_log_is_explained_at_the_times_of_the_telemetry(flown):
    explained = run_explain(flown[0], time="4", tower="LW4")
    assert explained.measured_db is None
    assert any("the flight has no log of LW4: times are those of the telemetry" in note for note in explained.notes)
    tower = load_site("lake_wheeler").towers["LW4"].position_m
    direct = next(path for path in explained.paths if path.words == "line of sight")
    assert direct.length_m == pytest.approx(np.linalg.norm(np.subtract(explained.position_m, tower)), abs=1e-6)
    spreading = 20 * np.log10(299792458 / 3.3e9 / (4 * np.pi * direct.length_m))
    assert direct.terms_db["spreading"] == pytest.approx(spreading, abs=1e-9)
    # the UAV is where the log of another tower has it at that time
    other = run_explain(flown[0], time=explained.time_utc, tower="LW1")
    assert other.position_m == pytest.approx(explained.position_m, abs=5.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": "9999"}, r"after the last sample.*|0 to"),
        ({"time": "-20"}, "before the first"),
        ({"time": "noon"}, "seconds after"),
        ({"tower": "LW9"}, "LW1, LW2"),
        ({"tower": "LW4", "channel": "USRP7"}, "no link 'USRP7', and no log of LW4; expected one of rss"),
        ({"channel": "USRP7"}, "USRP1"),
    ],
)
def test_bad_input_is_one_message(flown, change, message):
    with pytest.raises(UsageError, match=message):
        run_explain(flown[0], **{"time": "4", "tower": "LW1", **change})

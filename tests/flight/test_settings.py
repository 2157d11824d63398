"""Limits of flight.yaml: the last value that is taken and the first that is not."""

from functools import reduce
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.common.yamlfile import parse_yaml
from aerpaw_cmp.flight.gains import load_with_learned
from aerpaw_cmp.flight.settings import ArraySettings, FlightFile, overridden

POINT = {"east_m": 0, "north_m": 0, "height_m": 5}
PLAN = {"start": "2025-06-01T10:00:00", "waypoints": [POINT, POINT]}
TINY = 1e-9
# Numbers above 0, by their section of a flight file.
POSITIVE = {
    "link.rss": "bandwidth_hz",
    "flight.plan": "speed_mps climb_mps telemetry_interval_s rss_interval_s rank_interval_s fading_correlation_s",
    "towers.N": "antenna_height_m",
    "rt.advanced": "gamma_db_per_m maximum_loss_db maximum_gap_s",
}
LIMITS: dict[str, tuple[list[Any], list[Any]]] = {
    **{f"{part}.{key}": ([TINY], [0.0]) for part, keys in POSITIVE.items() for key in keys.split()},
    **dict.fromkeys(("flight.plan.fading_db", "rt.reflection_loss_db"), ([0.0], [-TINY])),
    "link.rss.uav": (
        [{"layout": "linear", "elements": n} for n in (1, 64)],
        [{"layout": "linear", "elements": n} for n in (0, 65)] + [{"elements": 4}, {"positions_m": [[0, 0, 0]]}],
    ),
    **dict.fromkeys(("logs.frequency_hz", "link.rss.carrier_hz"), ([1e6, 1e12], [3.3, 3300.0, 3.3e12])),
    "logs.height_m": ([-1000, 20_000], [-1000.1, 20_000.1]),
    "flight.plan.waypoints": ([[POINT, POINT]], [[POINT]]),
    "flight.plan.bad_lines": ([0, 5], [-1]),
    "flight.plan.rank_k": ([1.0], [1.0 - TINY]),
    "flight.plan.rank_error_share": ([0, 1], [-TINY, 1 + TINY]),
    "flight.plan.no_csi_share": ([0, 1], [-TINY, 1 + TINY]),
    "flight.name": (["a", "0_.-"], ["", "-a", ".a", "a b"]),
    "towers.N.latitude_deg": ([-90, 90], [-90.1, 90.1]),
    "towers.N.longitude_deg": ([-180, 180], [-180.1, 180.1]),
    "rt.advanced.samples": (["auto", 1, 100_000_000], [0, 100_000_001]),
    "rt.max_depth": ([0, 3], [-1, 4]),
    "rt.audit_links": ([0], [-1]),
    "rss.advanced.lag_window_s": ([0.1, 3600], [0.1 - TINY, 3600.1]),
    "rss.span_db": ([[-1.0, 1.0], [0.0, 100_000.0]], [[1.0, 1.0], [2.0, 1.0], [0.0, 100_000.2]]),
    "rank.k": ([[1.001], [10.0] * 64], [[], [1.0], [10.0, 0.5], [10.0] * 65]),
    "trained_on": ([["a" * 64], []], [["a" * 63], ["g" * 64]]),
    "timezone": (["UTC", None], ["Nowhere/City"]),
}


def flight(key: str, value: Any) -> dict[str, Any]:
    """Return a flight file with one key and the other keys that it requires."""
    content: dict[str, Any] = {
        "flight": {"name": "f", "plan": dict(PLAN)}, "logs": [{"path": "a"}], "link": {"rss": {"carrier_hz": 3e9, "uav": {}}},
        "towers": {"N": {"latitude_deg": 35.0, "longitude_deg": -78.0}},
    }  # fmt: skip
    *way, last = key.split(".")
    here = content["logs"][0] if way == ["logs"] else reduce(lambda part, name: part.setdefault(name, {}), way, content)
    here[last] = value
    return content


@pytest.mark.parametrize("key", LIMITS)
def test_a_key_takes_its_limits_and_nothing_beyond(key: str) -> None:
    taken, refused = LIMITS[key]
    for value in taken:
        FlightFile.model_validate(flight(key, value))
    for value in refused:
        with pytest.raises(ValidationError):
            FlightFile.model_validate(flight(key, value))


def test_what_a_flight_file_does_not_say() -> None:
    """By default, a plan has usual speeds and intervals and no errors.

    Ranks have the paper's arrays, and levels single elements.
    """
    said = FlightFile.model_validate({"flight": {"name": "f", "plan": PLAN}, "logs": [{"path": "a"}]})
    plan = said.flight.plan
    assert plan is not None
    assert (plan.speed_mps, plan.climb_mps, plan.seed) == (8.0, 3.0, 1)
    assert (plan.telemetry_interval_s, plan.rss_interval_s, plan.rank_interval_s) == (1.0, 0.1, 0.5)
    assert (plan.fading_db, plan.fading_correlation_s, plan.bad_lines) == (0.0, 2.0, 0)
    assert (plan.rank_k, plan.rank_error_share, plan.no_csi_share) == (100.0, 0.0, 0.0)
    assert [point.hold_s for point in plan.waypoints] == [0.0, 0.0]
    assert (said.flight.synthetic, said.site.without_buildings) == (False, False)
    assert said.rank.k == [10.0, 100.0, 1000.0]
    rss, rank = said.link.rss, said.link.rank
    assert (rss.carrier_hz, rss.transmit_power_dbm, rss.uav_transmits, rss.uav.layout) == (3.3e9, 40.0, True, "single")
    assert (rank.carrier_hz, rank.uav_transmits, rank.bandwidth_hz) == (3.4e9, False, 20e6)
    assert (rank.tower.slant_deg, rank.tower.yaw_deg) == ([45.0, -45.0, 45.0, -45.0], 45.0)
    assert (rank.uav.slant_deg, rank.uav.yaw_deg, rank.uav.roll_deg) == ([45.0, -45.0, -45.0, 45.0], 315.0, 90.0)
    assert rss.floor_dbm == pytest.approx(-174.0, abs=0.1)
    assert rank.floor_dbm == pytest.approx(-174.0 + 73.01, abs=0.1)
    line = ArraySettings(layout="linear", elements=3).positions(0.1)
    assert sorted(line.ravel().tolist()) == pytest.approx([-0.05, 0, 0, 0, 0, 0, 0, 0, 0.05])
    assert ArraySettings().positions(0.1).tolist() == [[0.0, 0.0, 0.0]]
    with pytest.raises(ValidationError):
        FlightFile.model_validate(flight("link.rss", {"carrier_hz": 3e9, "noise_figure_db": 3.0}))


@pytest.mark.parametrize("name", ["../secret.csv", "/etc/passwd", "link.csv"])
def test_learned_settings_name_no_file_outside_their_folder(tmp_path: Path, name: str) -> None:
    flight, folder = tmp_path / "flight.yaml", tmp_path / "handed_on"
    folder.mkdir()
    (tmp_path / "secret.csv").write_text("mine")
    (folder / "link.csv").symlink_to(tmp_path / "secret.csv")
    flight.write_text("flight: f\nlogs: [{path: x.txt}]\n")
    antenna = f"{{antenna: {{model: sphere, file: {name}}}}}"
    text = f"link: {{channels: {{A: {{carrier_hz: 3.3e9, tower: {antenna}}}}}}}\n"
    (folder / "calibrated.yaml").write_text(text)
    with pytest.raises(InputError, match=r"leaves its folder|no file of its folder"):
        load_with_learned(flight, folder / "calibrated.yaml")


@pytest.mark.parametrize(
    ("line", "home"),
    [
        ("rss: {floor_db: -49.36}", "a line of 'logs:'"),
        ("rt: {samples: 100}", "'rt.advanced:'"),
        ("carrier_hz: 3.3e9", "'link.rss:'"),
        ("rss: {lagg: 3}", "did you mean 'lag'?"),
    ],
)
def test_a_key_in_the_wrong_place_is_refused_with_the_right_one(line: str, home: str) -> None:
    with pytest.raises(UsageError, match="line 3: unknown key") as caught:
        parse_yaml(f"flight: f\nlogs: [{{path: a}}]\n{line}\n", FlightFile)
    assert home in str(caught.value)


def test_an_override_of_the_wrong_kind_states_what_is_expected() -> None:
    file = parse_yaml("flight: f\nlogs: [{path: a}]\n", FlightFile)
    with pytest.raises(UsageError) as caught:
        overridden(file, {"antennas": None})
    assert "found None at antennas" in str(caught.value)
    assert "expected keys with values" in str(caught.value)

"""Simulated logs: routes computed by hand, shares of noise and faults."""

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.common.yamlfile import parse_yaml
from aerpaw_cmp.flight import simulate
from aerpaw_cmp.flight.settings import FlightFile, load_flight
from aerpaw_cmp.flight.simulate import FlightSimulator, correlated_noise, plan_trajectory, telemetry_frame
from aerpaw_cmp.site.siteyaml import load_site

SAMPLE = Path(__file__).parents[2] / "sample_logs"

POINTS = [(0, 0, 2, 3), (30, 40, 2, 0), (30, 40, 22, 0), (30, 40, 22, 4), (33, 44, 42, 0)]  # east, north, height, hold


def planned(points: Sequence[tuple[float, ...]], rss_s: float = 0.2) -> Any:
    named = [dict(zip(("east_m", "north_m", "height_m", "hold_s"), point, strict=True)) for point in points]
    return SimpleNamespace(
        waypoints=[SimpleNamespace(**point) for point in named], speed_mps=5.0, climb_mps=2.0,
        telemetry_interval_s=0.5, rss_interval_s=rss_s, rank_interval_s=1.0,
    )  # fmt: skip


def simulator(**plan: Any) -> FlightSimulator:
    made = FlightSimulator.__new__(FlightSimulator)
    vars(made).update(plan=SimpleNamespace(**plan), generator=np.random.default_rng(1))
    return made


def test_a_leg_takes_the_longer_of_its_way_and_its_climb_and_a_hold_waits() -> None:
    route = plan_trajectory(planned(POINTS))
    assert route.time_s.tolist() == pytest.approx([0, 3, 13, 23, 27, 37])
    assert route.duration_s == 37.0
    np.testing.assert_allclose(route.position_at(np.array([1.0, 8.0, 18.0, 32.0])),
                               np.array([[0, 0, 2], [15, 20, 2], [30, 40, 12], [31.5, 42, 32.0]]))  # fmt: skip
    np.testing.assert_allclose(route.velocity_at(np.array([0.0, 3.0, 12.9, 13.0, 23.0, 27.0, 37.0])),
                               np.array([[0, 0, 0], [3, 4, 0], [3, 4, 0], [0, 0, 2], [0, 0, 0], *[[0.3, 0.4, 2]] * 2]),
                               atol=1e-12)  # fmt: skip
    roll, pitch, yaw = simulate.plan_attitude(route, np.array([1.0, 8.0, 18.0, 32.0]))
    assert not roll.any()
    np.testing.assert_allclose(pitch, [0.0, -3.0, 0.0, -0.3], atol=1e-12)
    np.testing.assert_allclose(yaw, np.degrees(np.arctan2(3, 4)))  # before the first leg and between legs, too
    up = plan_trajectory(planned([(7, 8, 0, 0), (7, 8, 10, 0)]))
    assert simulate.plan_attitude(up, np.array([2.0]))[2] == [0.0]
    frame, begin = SiteFrame(35.7275, -78.696), pd.Timestamp("2025-06-01T14:00:00")
    records = telemetry_frame(route, begin, 0.5, frame)
    assert len(records) == 75  # both ends
    assert (records["fix"].unique().tolist(), records["satellites"].min() > 3) == ([4], True)
    assert (records["time"] - begin).dt.total_seconds().tolist() == (np.arange(75) / 2).tolist()
    east, north = frame.to_local(records["latitude_deg"].to_numpy(), records["longitude_deg"].to_numpy())
    np.testing.assert_allclose(np.column_stack([east, north, records["altitude_m"]]),
                               route.position_at(np.arange(75) / 2), atol=1e-6)  # fmt: skip
    assert records.loc[16, "velocity_east_mps":"velocity_down_mps"].tolist() == pytest.approx([3, 0])
    assert records.loc[30, ["velocity_north_mps", "velocity_down_mps"]].tolist() == pytest.approx([0, -2])


def test_a_plan_moves_or_waits_and_is_no_longer_than_can_be_held() -> None:
    with pytest.raises(UsageError, match="does not move"):
        plan_trajectory(planned([(1, 2, 3, 0), (1, 2, 3, 0)]))
    assert plan_trajectory(planned([(1, 2, 3, 0.5)])).duration_s == 0.5
    assert plan_trajectory(planned([(0, 0, 0, 0), (50, 0, 0, 0)], rss_s=2e-6)).duration_s == 10.0  # 5 million samples
    with pytest.raises(UsageError):
        plan_trajectory(planned([(0, 0, 0, 0), (50, 0, 0, 0)], rss_s=1.99e-6))


def test_a_plan_without_logs_is_one_message(tmp_path: Path) -> None:
    points = "{east_m: 0, north_m: 0, height_m: 9}, {east_m: 9, north_m: 0, height_m: 9}"
    plan = f"flight: {{name: f, plan: {{start: '2025-06-01T10:00:00', waypoints: [{points}]}}}}\n"
    with pytest.raises(
        UsageError, match=r"the key 'logs' is missing\. Likely cause: a plan without logs.*'logs: \[\]'"
    ):
        parse_yaml(plan, FlightFile)
    nothing = FlightSimulator(parse_yaml(plan + "logs: []\n", FlightFile), load_site("lake_wheeler"), tmp_path)
    with pytest.raises(UsageError, match="lists no log to write"):
        nothing.run(tmp_path / "out")


def test_correlated_noise_keeps_what_the_memory_keeps() -> None:
    steps = SimpleNamespace(standard_normal=lambda count: np.arange(1.0, count + 1))
    keep = np.exp(-0.5 / 4.0)
    expected = [3.0]
    for draw in (2.0, 3.0, 4.0):
        expected.append(keep * expected[-1] + 3.0 * draw * np.sqrt(1.0 - keep**2))
    assert correlated_noise(steps, 4, 3.0, 0.5, 4.0) == pytest.approx(expected)  # type: ignore[arg-type]
    assert correlated_noise(steps, 4, 0.0, 0.5, 4.0).tolist() == [0.0] * 4  # type: ignore[arg-type]
    assert len(correlated_noise(steps, 0, 3.0, 0.5, 4.0)) == 0  # type: ignore[arg-type]


def test_a_modem_reports_a_neighbouring_rank_and_sometimes_none() -> None:
    rank = np.tile([1, 2, 3, 4], 5000)
    said = simulator(rank_error_share=0.3, no_csi_share=0.1)._reported(rank, 4)
    assert np.mean(said == 0) == pytest.approx(0.1, abs=0.01)
    for there, shares in {1: (0, 0.85, 0.15, 0, 0), 2: (0, 0.15, 0.7, 0.15, 0), 4: (0, 0, 0, 0.15, 0.85)}.items():
        some = said[(rank == there) & (said > 0)]
        np.testing.assert_allclose(np.bincount(some, minlength=5) / len(some), shares, atol=0.02)
    assert simulator(rank_error_share=0.0, no_csi_share=0.0)._reported(rank, 4).tolist() == rank.tolist()
    assert simulator(rank_error_share=1.0, no_csi_share=0.0)._reported(np.full(50, 2), 2).max() == 2


@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_torn_lines_stand_between_whole_ones_and_never_in_the_head(end: bytes) -> None:
    lines = [f"{k:02d} a line of thirty characters".encode() + end for k in range(20)]
    text, damage = simulator(bad_lines=5)._with_bad_lines(b"".join(lines))
    out = text.splitlines(keepends=True)
    assert [line for line in out if line in lines] == lines
    assert out[:10] == lines[:10]
    bad = [line for line in out if line not in lines]
    assert [line.decode() for line in bad] == [said + end.decode() for said in damage]
    torn = [text for text in damage if not text.startswith("Killed by signal 15 ")]
    assert len(torn) == 3
    assert all(any(line.decode().startswith(text) and len(text) == len(line) // 3 for line in lines) for text in torn)
    assert all(any(line.decode().startswith(text[20:]) and len(text) == 28 for line in lines)
               for text in damage if text not in torn)  # fmt: skip
    assert simulator(bad_lines=6)._with_bad_lines(b"".join(lines[:19])) == (b"".join(lines[:19]), [])
    assert len(simulator(bad_lines=500)._with_bad_lines(b"".join(lines))[1]) == len(lines) - 10
    assert simulator(bad_lines=0)._with_bad_lines(b"".join(lines)) == (b"".join(lines), [])


@pytest.mark.parametrize(
    ("start", "right"),
    [("1979-12-31", 0), ("1980-01-01", 1), ("2200-12-31", 1), ("2201-01-01", 0), ("2025-03-09T02:30:00", 0),
     ("2025-11-02T01:30:00", 0), ("2025-06-01T10:00:00", 1)],
)  # fmt: skip
def test_a_start_is_one_instant_of_a_wall_clock(start: str, right: int) -> None:
    if right:
        local = simulate._local_start(datetime.fromisoformat(start), "America/New_York")
        assert local.tz_localize(None) == pd.Timestamp(start)
    else:
        with pytest.raises(UsageError, match=r"flight\.plan\.start"):
            simulate._local_start(datetime.fromisoformat(start), "America/New_York")


@pytest.mark.parametrize("names", [["/a.txt"], ["../a.txt"], ["a.txt", "b/../a.txt", "a.txt"], ["truth.json"], ["."]])
def test_logs_of_a_plan_have_names_of_their_own_below_its_folder(names: list[str], tmp_path: Path) -> None:
    made = simulator()
    made.settings = SimpleNamespace(logs=[SimpleNamespace(path=name) for name in names])  # type: ignore[assignment]
    with pytest.raises(UsageError, match=r"named|no file of its folder"):
        made._check_names(tmp_path)
    made.settings = SimpleNamespace(logs=[SimpleNamespace(path=n) for n in ("a.txt", "b/a.txt")])  # type: ignore[assignment]
    made._check_names(tmp_path)


FLIGHT = """
flight: {name: made, plan: {start: 2025-06-01T10:00:00, waypoints: [
  {east_m: 0, north_m: 0, height_m: 0.1, hold_s: 2}, {east_m: 40, north_m: 0, height_m: 8.1}], speed_mps: 5, climb_mps: 2,
  rss_interval_s: 0.5, rank_interval_s: 1, offsets_db: {LW1: {A: -40}}, fading_db: 0,
  clock_shift_s: {LW1: 3}, rank_k: 10}}
timezone: America/New_York
rss: {field: FIELD}
rt: {attitude: ATTITUDE}
logs:
  - {path: a.txt, reader: sounder_log, node: LW1, channel: A}
  - {path: b.csv, reader: quectel_ri, node: LW1}
"""


@pytest.mark.parametrize(
    ("key", "value", "name"),
    [("offsets_db", {"LW1": {"USRP9": 3.0}}, "LW1.USRP9"), ("clock_shift_s", {"LW9": 1.0}, "LW9")],
)
def test_a_plan_for_a_log_that_is_not_simulated_is_refused(tmp_path: Path, key: str, value: dict, name: str) -> None:
    settings = load_flight(SAMPLE / "flight.yaml")
    assert settings.flight.plan is not None
    plan = settings.flight.plan.model_copy(update={key: value})
    changed = settings.model_copy(update={"flight": settings.flight.model_copy(update={"plan": plan})})
    with pytest.raises(UsageError, match=rf"flight.plan.{key}: there is no log of '{name}'"):
        FlightSimulator(changed, load_site("lake_wheeler"), SAMPLE).run(tmp_path / "out")

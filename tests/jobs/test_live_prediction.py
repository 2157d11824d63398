"""The rank that the tap predicts at the present pose, from a telemetry log that still grows."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from aerpaw_cmp.compare.rank import channel_rank
from aerpaw_cmp.flight.data import choose_site, gather, read_logs
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.flight.simulate import plan_trajectory, telemetry_frame
from aerpaw_cmp.jobs.live_twin import FlownAgain, LiveTwin
from aerpaw_cmp.logs.writers import format_vehicle_out
from aerpaw_cmp.propagation.geometry import Poses
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from benchmarks.simulated_modem import FaultyModem

ROOT = Path(__file__).parents[2]
FLIGHT = ROOT / "sample_logs" / "flight.yaml"


def test_prediction_follows_a_growing_log(tmp_path: Path) -> None:
    settings = load_flight(FLIGHT)
    site = choose_site(settings.site, FLIGHT.parent)
    trajectory = plan_trajectory(settings.flight.plan)
    start = pd.Timestamp("2025-06-01T14:00:00")
    log = tmp_path / "vehicleOut.txt"
    lines = format_vehicle_out(telemetry_frame(trajectory, start, 1.0, site.frame), "America/New_York").splitlines(True)
    predict = LiveTwin.of(FLIGHT, log).predictor()
    assert predict(start.value) is None, "no log yet"
    link = settings.link.rank.build(["LW1"], FLIGHT.parent)
    for second in (20, 60, 61, 150, 300):
        log.write_bytes(b"".join(lines[: second + 1]) + lines[second + 1][:20])
        position = np.maximum(trajectory.position_at(np.array([float(second)])), [-np.inf, -np.inf, 0.5])
        expected = replay(site, link, Poses(position, np.eye(3)[None]), Search(max_depth=2))
        sigma = np.linalg.svd(expected.h[0, 0], compute_uv=False)
        if np.min(np.abs(sigma / sigma[0] * 100 - 1)) < 0.05:
            continue  # written positions are rounded to a centimetre: a singular value near the threshold may flip
        now = predict(start.value + second * 10**9)
        assert now.rank == channel_rank(expected.h[0, 0], 100)
        assert now.level_dbm == pytest.approx(
            float(expected.rss_dbm[0, 0]), abs=0.1
        )  # positions are rounded to a centimetre
        assert np.hypot(now.east_m - position[0, 0], now.north_m - position[0, 1]) < 0.02
        later = predict(start.value + (second + 30) * 10**9)
        assert (later.rank, later.east_m) == (None, None), "the UAV's position is not known yet"
        assert later.telemetry_age_s == pytest.approx(30.0)


def test_tap_writes_predictions_and_residuals(tmp_path: Path) -> None:
    """The whole command: modem on a pseudo-terminal, telemetry written now, predictions in the log."""
    content = yaml.safe_load(FLIGHT.read_text())
    content["timezone"] = "UTC"
    flight = tmp_path / "flight.yaml"
    flight.write_text(yaml.safe_dump(content))
    settings = load_flight(FLIGHT)
    site = choose_site(settings.site, FLIGHT.parent)
    now = pd.Timestamp(time.time_ns() - 25 * 10**9)
    frame = telemetry_frame(plan_trajectory(settings.flight.plan), now, 1.0, site.frame)
    telemetry = tmp_path / "now_vehicleOut.txt"
    telemetry.write_bytes(format_vehicle_out(frame.iloc[:120], "UTC"))
    with FaultyModem() as modem:
        done = subprocess.run(
            [
                *(sys.executable, "-m", "aerpaw_cmp", "tap", str(modem.port), "-o", str(tmp_path / "log")),
                *("--duration", "4", "--flight", str(flight), "--telemetry", str(telemetry)),
            ],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
            cwd=ROOT,
        )
    assert done.returncode == 0, done.stderr
    records = [
        json.loads(line) for path in (tmp_path / "log").glob("*.jsonl") for line in path.read_text().splitlines()
    ]
    predictions = [record for record in records if record.get("kind") == "prediction"]
    assert any(record.get("predicted") for record in predictions), done.stderr
    for record in predictions:
        if record.get("predicted") is not None and record.get("measured") is not None:
            assert record["residual"] == record["measured"] - record["predicted"]
    assert "predicted" in done.stderr


def test_a_flight_is_flown_again_with_its_own_ranks_and_telemetry(tmp_path: Path) -> None:
    settings = load_flight(FLIGHT)
    files = read_logs(settings, FLIGHT.parent)
    (series, *_) = gather(settings, FLIGHT.parent, files).rank
    start = next(s.frame for file in files for s in file.result.streams if s.kind == "telemetry")["time"].iloc[0]
    flown = FlownAgain(FLIGHT, tmp_path / "again.txt")
    for i in (0, 10, len(series.rank) - 1):
        seconds = (series.time[i] - start.to_datetime64()) / np.timedelta64(1, "s")
        assert flown.rank(seconds + 0.01) == np.nan_to_num(series.rank[i])
    flown()
    assert len((tmp_path / "again.txt").read_text().splitlines()) >= 1
    flown._file.close()

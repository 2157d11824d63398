"""A long flight that is computed in parts has the same numbers as in one part."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.flight import replay as replay_job
from aerpaw_cmp.flight import track as track_room
from aerpaw_cmp.flight.data import FlightData, load_data
from aerpaw_cmp.flight.settings import load_flight

SAMPLE = Path(__file__).parents[2] / "sample_logs" / "flight.yaml"


@pytest.fixture(scope="module")
def one_tower() -> FlightData:
    """Both channels of LW2, whose clock is 0.4 s late, of the sample flight."""
    settings = load_flight(SAMPLE)
    logs = [log for log in settings.logs if log.node in (None, "LW2")]
    settings = settings.model_copy(update={"logs": logs})
    return load_data(settings, SAMPLE.parent)


def test_a_clock_predicted_in_blocks_is_that_of_the_whole_flight(
    one_tower: FlightData, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_once = replay_job.estimate_clocks(one_tower)
    monkeypatch.setattr(replay_job, "BLOCK", 1500)
    monkeypatch.setattr(track_room, "AT_ONCE", 700)
    parts = replay_job.estimate_clocks(one_tower)
    for a, b in zip(at_once, parts, strict=True):
        assert a is not None
        assert b is not None
        np.testing.assert_equal(dataclasses.asdict(b.result), dataclasses.asdict(a.result))  # to the last digit
        assert abs(a.result.radio_minus_telemetry_s - 0.4) < 0.2


def test_a_part_of_the_flight_turns_as_the_whole_does(one_tower: FlightData) -> None:
    """Attitude of a few instants comes from the rows around them, and from no others."""
    track = one_tower.track
    assert track is not None
    instants = np.arange(track.start_ns - 2 * 10**9, track.end_ns + 2 * 10**9, 370_000_000).astype("datetime64[ns]")
    poses = track.pose_at(instants)
    assert poses.valid.sum() > 100
    for few in ([5], [40, 41], [3, 200], [0, 1, 2], list(range(100, 400, 7))):
        part = track.pose_at(instants[few])
        np.testing.assert_allclose(part.rotation, poses.rotation[few], atol=1e-13)
        np.testing.assert_array_equal(part.attitude_known, poses.attitude_known[few])


def test_a_replay_in_blocks_is_the_replay(one_tower: FlightData, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare levels, channel matrices, and paths with their order.

    Flights longer than a block are replayed block by block.
    """
    settings = one_tower.settings
    off = settings.model_copy(update={"rss": settings.rss.model_copy(update={"lag": "off"})})
    data = dataclasses.replace(one_tower, settings=off)
    at_once = replay_job.replay_rss(data)
    monkeypatch.setattr(replay_job, "BLOCK", 77)
    monkeypatch.setattr(track_room, "AT_ONCE", 31)
    asked: list[float] = []
    parts = replay_job.replay_rss(data, lambda _text, share=None, /: asked.append(share))
    assert len([s for s in asked if s is not None]) > 5
    for single, in_blocks in zip(at_once, parts, strict=True):
        np.testing.assert_array_equal(in_blocks.replay.rss_dbm, single.replay.rss_dbm)
        np.testing.assert_array_equal(in_blocks.replay.h, single.replay.h)
        assert len(in_blocks.replay.paths) == len(single.replay.paths)
        for name in ("pose", "tower", "depth", "faces", "vertices_m"):
            np.testing.assert_array_equal(getattr(in_blocks.replay.paths, name), getattr(single.replay.paths, name))
        assert in_blocks.replay.left_out == single.replay.left_out

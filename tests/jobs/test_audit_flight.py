"""The settings that the audit gets from a flight, and its check of the attitude."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.flight import replay as replays
from aerpaw_cmp.flight import track
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.settings import ArraySettings, LinkSettings, LinksSettings, load_flight
from aerpaw_cmp.jobs import audit_flight
from aerpaw_cmp.propagation.geometry import Poses
from aerpaw_cmp.propagation.llvm import INSTALL_AGAIN, SionnaMissingError
from aerpaw_cmp.propagation.search import sionna
from tests.jobs.test_audit_raw import write_flight

FRAME = SiteFrame(35.7275, -78.696)


def flight(attitude="logged", roll=8.0, pitch=-5.0):
    """A flight of 20 s that banks, climbs its nose and turns."""
    seconds = np.arange(20.0)
    frame = pd.DataFrame({
        "time": pd.Timestamp("2025-06-01") + pd.to_timedelta(seconds, unit="s"),
        "latitude_deg": 35.7275 + 1e-5 * seconds, "longitude_deg": -78.696, "altitude_m": 30.0,
        "roll_deg": roll * np.sin(seconds), "pitch_deg": pitch, "yaw_deg": 20.0 * seconds % 360,
        "velocity_north_mps": np.nan, "velocity_east_mps": np.nan, "velocity_down_mps": np.nan,
    })  # fmt: skip
    stream = SimpleNamespace(kind="telemetry", frame=frame)
    files = (SimpleNamespace(result=SimpleNamespace(streams=(stream,))),)
    settings = SimpleNamespace(rss_attitude=attitude)
    return SimpleNamespace(settings=settings, track=track.Track(frame, FRAME), files=files)


@pytest.mark.parametrize("mode", ["logged", "level"])
def test_attitude_turned_a_second_time(mode):
    audit = audit_flight.attitude_checked(flight(mode), [])
    assert audit.failures == ()
    assert audit.attitude_rows == 20
    assert audit.attitude_max_rad < 1e-12


@pytest.mark.parametrize(
    ("mode", "where", "name", "sign"),
    [
        ("logged", track, "rotation_from_aircraft", (-1, 1, 1)),
        ("logged", track, "rotation_from_aircraft", (1, -1, 1)),
        ("logged", track, "rotation_from_aircraft", (1, 1, -1)),
        ("level", replays, "rotation_from_aircraft", (1, 1, -1)),
    ],
)
def test_wrong_sign_of_an_angle_is_seen(monkeypatch, mode, where, name, sign):
    clean = getattr(where, name)
    monkeypatch.setattr(where, name, lambda r, p, y: clean(sign[0] * r, sign[1] * p, sign[2] * y))
    assert audit_flight.attitude_checked(flight(mode), []).failures


def test_array_that_turns_although_the_attitude_is_ignored_is_seen():
    turned = SimpleNamespace(poses=Poses(np.zeros((1, 3)), track.rotation_from_aircraft([1.0], [0.0], [90.0])))
    assert audit_flight.attitude_checked(flight("ignored"), [turned]).failures


def test_flight_is_replayed_where_sionna_rt_cannot_be_loaded(tmp_path, monkeypatch):
    data = load_data(load_flight(write_flight(tmp_path)), tmp_path)
    replayed = replays.replay_flight(data).all
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    engine = audit_flight.audit_replays(data, replayed)
    assert engine.audit is None
    assert engine.not_audited.startswith("Sionna RT is not installed")
    assert engine.not_audited.endswith("Install it with: pip install sionna-rt")
    assert "mitsuba" in engine.not_audited


@pytest.mark.parametrize("program", ["raise ImportError('undefined symbol')", "raise OSError('undefined symbol')"])
def test_an_installed_sionna_rt_that_fails_is_to_be_repaired(tmp_path, monkeypatch, program) -> None:
    (tmp_path / "mitsuba.py").write_text(program)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "mitsuba", raising=False)
    with pytest.raises(SionnaMissingError) as caught:
        sionna.load_variant()
    message = str(caught.value)
    assert message.startswith("Sionna RT cannot be loaded (undefined symbol)")
    assert message.endswith(f"Repair it with: {INSTALL_AGAIN}")


ARRAYS = {
    "rank": LinksSettings().rank,
    "rss": LinksSettings().rss,
    "linear": LinkSettings(
        carrier_hz=2e9, tower=ArraySettings(layout="linear", elements=3, slant_deg=30.0, pitch_deg=9)
    ),
    "custom": LinkSettings(
        carrier_hz=2e9, uav=ArraySettings(layout="custom", positions_m=[(1, 2, 3), (0, 0, 1)], yaw_deg=3)
    ),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_settings_are_laid_out_the_same_a_second_time(name):
    settings = ARRAYS[name]
    built, expected = settings.build(["LW1"], Path()), audit_flight.expected_link(settings, ["LW1"], Path())
    for array, other in ((built.tower_arrays["LW1"], expected.towers["LW1"]), (built.uav_array, expected.uav)):
        assert np.array(other.positions_m) == pytest.approx(array.positions_m, abs=1e-15)
        assert np.radians(other.slants_deg) == pytest.approx(array.slant_rad, abs=1e-15)
        assert np.array(other.mount) == pytest.approx(array.mount, abs=1e-15)
    assert expected.noise_floor_dbm == pytest.approx(built.noise_floor_dbm, abs=1e-6)
    assert wavelength_m(expected.carrier_hz) == wavelength_m(built.carrier_hz)


def test_noise_floor_of_a_receiver_a_second_time():
    settings = LinkSettings(carrier_hz=3.3e9, bandwidth_hz=20e6, noise_figure_db=6.0)
    expected = audit_flight.expected_link(settings, [], Path())
    assert expected.noise_floor_dbm == pytest.approx(settings.floor_dbm, abs=1e-6)

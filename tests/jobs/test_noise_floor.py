"""Below the receiver's noise floor a link is out of coverage."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.units import noise_floor_dbm
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.settings import LinkSettings, load_flight
from aerpaw_cmp.propagation.field.baselines import free_space_dbm
from aerpaw_cmp.propagation.geometry import Isotropic, Link, Poses, single_element
from aerpaw_cmp.propagation.options import Field, Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.siteyaml import load_site
from tests.jobs.test_audit_raw import write_flight

SITE = dataclasses.replace(load_site("lake_wheeler"), buildings=())
EAST_M = np.array([100.0, 1000.0, 10_000.0, 90_000.0])


def flown(floor_dbm: float | None = None, power_dbm: float = 0.0, loss_db: float = 0.0):
    """Four poses ever farther from LW1, line of sight."""
    place = SITE.towers["LW1"].position_m
    position = np.column_stack([place[0] + EAST_M, np.full(4, place[1]), np.full(4, place[2] + 30.0)])
    poses = Poses(position, np.broadcast_to(np.eye(3), (4, 3, 3)))
    element = single_element(Isotropic())
    more = {} if floor_dbm is None else {"noise_floor_dbm": floor_dbm}
    link = Link(3.3e9, {"LW1": element}, element, transmit_power_dbm=power_dbm, **more)
    loss = (lambda paths, *_: np.full(len(paths), loss_db)) if loss_db else None
    expected = free_space_dbm(place[None], position, 3.3e9, power_dbm)[:, 0] - loss_db
    return replay(SITE, link, poses, Search(max_depth=0), Field(loss=loss)), expected


def test_links_below_the_floor_have_no_level_no_channel_and_no_rank():
    expected = flown()[1]
    floor = 0.5 * (expected[1] + expected[2])
    replayed, _ = flown(floor)
    np.testing.assert_allclose(replayed.rss_dbm[:2, 0], expected[:2], atol=1e-6)
    assert np.isnan(replayed.rss_dbm[2:]).all()
    assert np.isnan(replayed.rss_power_dbm[2:]).all()
    assert not replayed.has_path[2:].any()
    assert replayed.has_path[:2].all()
    assert not replayed.h[2:].any()
    assert replayed.h[:2].all()


def test_no_receiver_hears_beneath_the_thermal_noise_of_one_hertz():
    assert np.isnan(flown(loss_db=260.0)[0].rss_dbm).all()  # -370 dBm counted as covered, with rank 1
    assert np.isfinite(flown(loss_db=30.0)[0].rss_dbm).all()


def test_floor_of_a_bandwidth():
    assert noise_floor_dbm(1.0) == pytest.approx(-173.975, abs=1e-3)
    assert noise_floor_dbm(20e6, 7.0) == pytest.approx(-173.975 + 73.0103 + 7.0, abs=1e-3)


def test_settings():
    def built(**keys):
        return LinkSettings(carrier_hz=3.3e9, **keys).build(["LW1"], Path()).noise_floor_dbm

    assert built() == pytest.approx(-173.975, abs=1e-3)
    assert built(bandwidth_hz=1e6, noise_figure_db=5.0) == pytest.approx(-108.975, abs=1e-3)
    with pytest.raises(ValueError, match="needs bandwidth_hz"):
        built(noise_figure_db=5.0)


@pytest.mark.parametrize(("keys", "named"), [("", True), (", bandwidth_hz: 20e6", False)])
def test_a_rank_link_without_a_noise_floor_is_named(tmp_path: Path, keys: str, named: bool) -> None:
    flight = write_flight(tmp_path)
    text = flight.read_text(encoding="utf-8")
    assert not any("link.rank" in line for line in load_data(load_flight(flight), tmp_path).warnings)  # 20 MHz
    flight.write_text(text.replace("rt:", f"  rank: {{carrier_hz: 3.4e9{keys}}}\nrt:", 1), encoding="utf-8")
    warnings = load_data(load_flight(flight), tmp_path).warnings
    assert any("link.rank has no bandwidth_hz" in line and "-174 dBm" in line for line in warnings) == named

"""Dotted keys that change checked settings: copies that are begun from others, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.flight.settings import FlightFile, LinksSettings, load_flight, overridden

SAMPLE = Path(__file__).parents[2] / "sample_logs" / "flight.yaml"


@pytest.fixture(scope="module")
def settings() -> FlightFile:
    return load_flight(SAMPLE)


def test_a_key_changes_itself_alone(settings: FlightFile) -> None:
    changed = overridden(settings, {"rt.max_depth": 1})
    before, after = settings.model_dump(), changed.model_dump()
    assert after["rt"].pop("max_depth") == 1 != before["rt"].pop("max_depth")
    assert before == after
    assert overridden(settings, {}) is settings
    assert overridden(settings, {"rt.advanced.maximum_gap_s": 7.0}).rt.advanced.maximum_gap_s == 7.0


def test_new_channels_and_towers_begin_as_copies_whatever_the_order(settings: FlightFile) -> None:
    keys = {
        "link.channels.NEW.towers.LW1.yaw_deg": 12.0,
        "link.rss.tower.yaw_deg": 33.0,
        "link.rss.towers.LW2.roll_deg": 5.0,
    }
    for order in (list(keys), list(keys)[::-1]):
        changed = overridden(settings, {key: keys[key] for key in order}).link
        assert (changed.rss.tower.yaw_deg, changed.rss.towers["LW2"].yaw_deg) == (33.0, 33.0)
        assert changed.rss.towers["LW2"].roll_deg == 5.0
        new = changed.channels["NEW"]
        assert new.towers["LW1"].yaw_deg == 12.0
        assert (new.tower.yaw_deg, new.carrier_hz) == (33.0, settings.link.rss.carrier_hz)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("rt.max_deph", 1, "no key 'max_deph' below 'rt'.*max_depth"),
        ("rtt", 1, "no key 'rtt'.*'rt'"),
        ("rt.engine.kind", 1, "goes below 'rt.engine', which has no keys"),
        ("rt.max_depth.more.still", 1, "goes below 'rt.max_depth', which has no keys"),
        ("logs.0.node", "LW1", "goes below 'logs', which has no keys"),
        ("rt.max_depth", "deep", "'rt.max_depth': found 'deep'"),
    ],
)
def test_a_mistake_is_named_with_what_was_meant(settings: FlightFile, key: str, value: object, words: str) -> None:
    with pytest.raises(UsageError, match="(?s)" + words):
        overridden(settings, {key: value})


def test_links_are_those_of_the_paper_unless_the_file_says_otherwise() -> None:
    """In arXiv 2502.10324, the UAV transmits at 3.3 GHz for RSS.

    Rank is at 3.4 GHz and 10 W, with arrays at 45 and 315 degrees.
    """
    links = LinksSettings()
    assert (links.rss.carrier_hz, links.rss.uav_transmits, links.rss.tower.layout) == (3.3e9, True, "single")
    rank = links.rank
    assert (rank.carrier_hz, rank.uav_transmits, rank.transmit_power_dbm) == (3.4e9, False, 40.0)
    assert (rank.tower.layout, rank.uav.layout) == ("tower_comparison", "uav_comparison")
    assert (rank.tower.yaw_deg, rank.uav.yaw_deg, rank.uav.roll_deg) == (45.0, 315.0, 90.0)
    for array in (rank.tower, rank.uav):
        assert sorted(array.slant_deg) == [-45.0, -45.0, 45.0, 45.0]
    lobe = rank.tower.build(wavelength_m(3.4e9), Path()).mount @ [1.0, 0.0, 0.0]  # yaw is counter-clockwise from east
    np.testing.assert_allclose(lobe, [np.sqrt(0.5), np.sqrt(0.5), 0.0], atol=1e-12)

"""First words of a map: the gaps of coverage are explained by what was put in."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from aerpaw_cmp.report.content.maps import MapsData, RankMap, RssMap
from aerpaw_cmp.report.words.maps import first_words, notes, warnings


@pytest.fixture
def planted(maps_data: MapsData) -> Any:
    """A map whose joint coverage is as given, by foliage mode; ``reached`` by any path."""

    def make(covered: dict[str, float], reached: float = 1.0, **change: Any) -> MapsData:
        shape = (len(maps_data.north_m), len(maps_data.east_m))
        rss = [
            RssMap(
                tower="joint", antennas="MIMO", altitude_m=30.0, rss_dbm=np.zeros(shape), coverage=share, foliage=mode
            )
            for mode, share in covered.items()
        ]
        shares = np.array([1.0 - reached, reached, 0.0, 0.0, 0.0])
        rank = RankMap(
            k=10.0, altitude_m=30.0, rank=np.zeros(shape, np.int64), share=shares, foliage=next(iter(covered))
        )
        return dataclasses.replace(maps_data, rss=tuple(rss), rank=(rank,), **change)

    return make


@pytest.mark.parametrize(
    ("covered", "reached", "change", "said"),
    [
        (
            {"opaque": 0.99},
            0.99,
            {},
            "Nothing here was measured. Least coverage: 99.0 % of the positions at 30 m. Next: ",
        ),
        (
            {"opaque": 0.6, "none": 0.95},
            0.6,
            {},
            "60.0 % of the positions at 30 m; trees take most of the rest. Next: ",
        ),
        ({"opaque": 0.6, "none": 0.62}, 0.6, {}, "buildings and terrain take most of the rest"),
        ({"none": 0.6}, 0.9, {"settings": {"threshold_dbm": -80.0}}, "levels below -80 dBm take most of the rest"),
        ({"none": 0.0}, 0.9, {"settings": {"threshold_dbm": -20.0}}, "No position reaches -20 dBm at 30 m, though"),
        ({"none": 0.0}, 0.0, {}, "No path arrives at any position at 30 m. Next: check the towers"),
        ({"none": 0.99}, 0.99, {"outside_flown": 0.7}, "70 % of the positions lie outside the flown places"),
    ],
)
def test_the_cause_that_was_put_in_is_said(
    planted: Any, covered: dict[str, float], reached: float, change: dict[str, Any], said: str
) -> None:
    text = first_words(planted(covered, reached, **change)).replace("\N{MINUS SIGN}", "-")
    assert said in text
    assert "Best height" not in text  # one height has no best


def test_several_heights_name_the_best_and_the_worst(maps_data: MapsData) -> None:
    joint = {m.altitude_m: m.coverage for m in maps_data.rss if m.tower == "joint" and m.antennas == "SISO"}
    text = first_words(maps_data)
    assert f"Best height: {max(joint, key=lambda h: joint[h]):g} m, {100 * max(joint.values()):.1f} %." in text
    assert f"Least coverage: {100 * min(joint.values()):.1f} % of the positions at 30 m" in text
    alike = tuple(dataclasses.replace(item, coverage=1.0) for item in maps_data.rss)
    assert "Best height" not in first_words(dataclasses.replace(maps_data, rss=alike))


def test_warnings_and_notes_stand_only_under_their_condition(maps_data: MapsData) -> None:
    fine = {"foliage": ("opaque",), "threshold_dbm": -np.inf, "spacing_m": 30.0}
    data = dataclasses.replace(maps_data, settings=fine, metrics={})
    assert not any("coarser than" in text or "Corrected by" in text for text in warnings(data))
    assert not any("in maps of RSS above" in text for text in notes(data))
    fit = {"degenerate": True, "message": "one length alone"}
    coarse = dataclasses.replace(
        data,
        settings={**fine, "spacing_m": 90.0, "threshold_dbm": -80.0},
        corrected_words="Expect 3 dB.",
        metrics={"correlation": {"z_zero": fit}},
    )
    said = warnings(coarse)
    assert any("spacing of 90 m is coarser" in text for text in said)
    assert "Corrected: Expect 3 dB." in said
    assert "Correlation fit (Z zero): one length alone" in said
    assert any("in maps of RSS above -80 dBm" in text for text in notes(coarse))

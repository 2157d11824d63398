"""Summary of a map: gaps of coverage are explained by the inputs."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from aerpaw_cmp.report.maps import MapsData, RssMap, first_sentences, warnings


@pytest.mark.parametrize(
    ("covered", "change", "said"),
    [
        (
            {"opaque": 0.99},
            {},
            "Lowest coverage: 99.0 % of the positions at 30 m. The map contains no measurement. Next: ",
        ),
        (
            {"opaque": 0.6, "none": 0.95},
            {},
            "trees cause most of the gaps. The map contains no measurement. Next: fly higher, or map with `--foliage",
        ),
        ({"opaque": 0.6, "attenuating": 0.9, "none": 0.95}, {}, "Next: fly higher, or compare the rows with"),
        ({"opaque": 0.6, "none": 0.62}, {}, "buildings and terrain cause most of the gaps"),
        (
            {"none": 0.0},
            {},
            "There is no path to any position at 30 m. The map contains no measurement. Next: check the towers",
        ),
        ({"none": 0.99}, {"outside_flown": 0.7}, "70 % of the positions are outside the flown area"),
    ],
)
def test_the_cause_that_was_put_in_is_said(
    maps_data: MapsData, covered: dict[str, float], change: dict[str, Any], said: str
) -> None:
    level = np.zeros((len(maps_data.north_m), len(maps_data.east_m)))
    joint = {"tower": "joint", "antennas": "MIMO", "height_m": 30.0}
    count = np.arange(level.size).reshape(level.shape)
    rss = tuple(
        RssMap(**joint, coverage=share, foliage=mode, values=np.where(count < share * level.size, level, np.nan))
        for mode, share in covered.items()
    )
    text = first_sentences(dataclasses.replace(maps_data, rss=rss, **change)).replace("\N{MINUS SIGN}", "-")
    assert said in text
    assert "Best height" not in text  # one height has no best


def test_gaps_with_a_path_below_the_threshold_are_not_blamed_on_buildings(maps_data: MapsData) -> None:
    level = np.zeros((len(maps_data.north_m), len(maps_data.east_m)))
    weak = RssMap(tower="joint", antennas="MIMO", height_m=30.0, coverage=0.6, foliage="none", values=level)
    text = first_sentences(dataclasses.replace(maps_data, rss=(weak,)))
    assert "there is a path, but its level is below the threshold" in text
    assert text.endswith("Next: compare with one element (Antennas: SISO), because the beam of the array has nulls.")


def test_several_heights_name_the_best_and_the_worst(maps_data: MapsData) -> None:
    joint = {m.height_m: m.coverage for m in maps_data.rss if m.tower == "joint" and m.antennas == "SISO"}
    text = first_sentences(maps_data)
    assert f"Best height: {max(joint, key=lambda h: joint[h]):g} m, {100 * max(joint.values()):.1f} %." in text
    assert f"Lowest coverage: {100 * min(joint.values()):.1f} % of the positions at 30 m" in text
    alike = tuple(dataclasses.replace(item, coverage=1.0) for item in maps_data.rss)
    assert "Best height" not in first_sentences(dataclasses.replace(maps_data, rss=alike))


def test_warnings_stand_only_under_their_condition(maps_data: MapsData) -> None:
    fine = {"foliage": ("opaque",), "spacing_m": 30.0}
    data = dataclasses.replace(maps_data, settings=fine, metrics={})
    assert not any("coarser than" in text or "Corrected by" in text for text in warnings(data))
    fit = {"degenerate": True, "message": "one length alone"}
    coarse = dataclasses.replace(
        data,
        settings={**fine, "spacing_m": 90.0},
        corrected_words="Expect 3 dB.",
        metrics={"correlation": {"z_zero": fit}},
    )
    said = warnings(coarse)
    assert any("spacing of 90 m is coarser" in text for text in said)
    for nothing_to_compare in ({"paper": ()}, {"correlation": ()}):
        said_here = warnings(dataclasses.replace(coarse, **nothing_to_compare))
        assert not any("coarser than" in text for text in said_here)
    assert "Corrected: Expect 3 dB." in said
    assert (
        "Correlation of ranks over distance, out of coverage as rank 0: the four coefficients of the fitted curve are not "
        "reliable (one length alone). Kriging uses the curve, not its coefficients." in said
    )

"""Sentences of a map's page, each with the condition under which it may stand."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...compare.judge.verdicts import Coverage, coverage_verdict
from ...maps.grid import PAPER_SPACING_M
from ..content.maps import JOINT, MapsData
from .phrases import said_of

LEAST = "Least coverage: {percent:.1f} % of the positions at {where}"

# Sentence and next step by :func:`~aerpaw_cmp.compare.judge.verdicts.coverage_verdict`.
CAUSES: dict[str, tuple[str, str]] = {
    "none": (LEAST + ".", "`aerpaw-cmp plan` for a flight that measures it"),
    "trees": (LEAST + "; trees take most of the rest.", "fly higher, or {thinner}"),
    "blocked": (LEAST + "; buildings and terrain take most of the rest.", "fly higher, or add a tower"),
    "no path": ("No path arrives at any position at {where}.", "check the towers and the area of the site"),
    "extrapolated": (
        LEAST + ". {outside:.0f} % of the positions lie outside the flown places: there the correction is a guess.",
        "`aerpaw-cmp plan` names the flight that helps most",
    ),
}


def first_words(data: MapsData) -> str:
    """Coverage at the best and at the worst height, what takes the rest, and what to do next."""
    heights = coverage(data)
    if not heights:
        return ""
    worst = min(heights, key=lambda height: height.covered)
    sentence = said_of(
        coverage_verdict(heights),
        CAUSES,
        percent=100.0 * worst.covered,
        outside=100.0 * worst.outside,
        thinner="compare the rows of attenuating trees"
        if any(item.foliage == "attenuating" for item in data.rss)
        else "map with `--foliage attenuating`, too",
    )
    best = max(heights, key=lambda height: height.covered)
    more = f"Best height: {best.height_m:g} m, {100 * best.covered:.1f} %. " if best.covered > worst.covered else ""
    measured = "" if data.corrected else "Nothing here was measured. "
    return f"{data.budget}{measured}{more}{sentence}"


def coverage(data: MapsData) -> list[Coverage]:
    """Each height of the map of the nearest tower, with the most trees that were mapped."""
    shown = [item for item in data.rss if item.tower == JOINT] or list(data.rss)
    if not shown:
        return []
    first = shown[0]
    same_link = [item for item in shown if (item.tower, item.antennas) == (first.tower, first.antennas)]
    clear = {item.altitude_m: item.coverage for item in same_link if item.foliage == "none" != first.foliage}
    return [
        Coverage(
            height_m=item.altitude_m,
            covered=item.coverage,
            clear=clear.get(item.altitude_m, np.nan),
            outside=data.outside_flown,
        )
        for item in same_link
        if item.foliage == first.foliage
    ]


def warnings(data: MapsData) -> list[str]:
    """Warnings that must be known before the maps are believed."""
    out = [f"{text}." for text in data.site.cautions()]
    if data.corrected_words:
        out.append(f"Corrected: {data.corrected_words}")
    for key, fit in data.metrics.get("correlation", {}).items():
        if fit["degenerate"]:
            out.append(f"Correlation fit ({key.replace('z_', 'Z ')}): {fit['message']}")
    spacing = data.settings.get("spacing_m", 0.0)
    if spacing > PAPER_SPACING_M:
        out.append(
            f"A spacing of {spacing:g} m is coarser than the paper's {PAPER_SPACING_M:g} m: errors of interpolation "
            "and correlation are not comparable with it."
        )
    return [*out, *data.warnings]


def notes(data: MapsData) -> list[str]:
    """Notes on how the maps were made."""
    how = list(_made(data)) if "foliage" in data.settings else []
    return [*data.site.notes, *how, *data.notes]


def _made(data: MapsData) -> Iterator[str]:
    s = data.settings
    yield (
        f"Foliage {', '.join(s['foliage'])}: opaque stops whatever touches a crown or a trunk (the paper); attenuating "
        "takes ITU-R P.833 over the path's length in crowns; none leaves the trees out."
    )
    yield "Arrays (MIMO): RSS with equal feed in phase at the tower, mean over the UAV's elements; SISO: one element."
    yield f"Spread, condition number, correlation and interpolation are those of foliage {data.rss[0].foliage}."

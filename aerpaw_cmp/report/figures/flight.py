"""The figures of a flight's report, in order, with their captions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from ...compare.level.rss import PART_DB
from ...compare.result import RankResult, RssResult
from ..content.flight import ReportData, Track
from ..kit.canvas import POINTS_PER_CLOUD, FigureSpec
from ..names import safe_name
from ..words.flight import count
from . import flight_rank as rank_figures
from . import flight_rss as rss_figures


def figure_specs(data: ReportData) -> list[FigureSpec]:
    """Every figure that the data allow, in reading order; where two names became one file name, a number is added."""
    used: dict[str, int] = {}
    result = []
    for spec in _figures(data):
        times = used[spec.name] = used.get(spec.name, 0) + 1
        result.append(spec if times == 1 else replace(spec, name=f"{spec.name}_{times}"))
    return result


def _figures(data: ReportData) -> Iterator[FigureSpec]:
    if data.track is not None and len(data.track.time):
        yield from _track_specs(data, data.track)
    for panel in data.rss:
        if len(panel.time):
            yield from _rss_specs(data, panel)
    yield from channel_specs(data)
    for rank in data.rank:
        if len(rank.time):
            yield from _rank_specs(data, rank)


def channel_specs(data: ReportData, section: str | None = None) -> Iterator[FigureSpec]:
    """Both channels of each tower in one panel (the paper's Fig. 15)."""
    panels = {(panel.tower, panel.channel): panel for panel in data.rss if panel.score.n}
    for pair in data.pairs:
        both = [panels[pair.tower, name] for name in (pair.first, pair.second) if (pair.tower, name) in panels]
        if len(both) == 2:
            yield FigureSpec(
                f"rss_channels_{safe_name(pair.tower)}_{safe_name(pair.first)}_{safe_name(pair.second)}",
                section or f"rss/{pair.tower}/{pair.first}", f"{pair.tower}: {pair.first} and {pair.second}",
                f"Both channels, the second moved by its offset less that of the first. Shaded: they part by more than "
                f"{PART_DB:.0f} dB. Ray tracing is that of {pair.first}.",
                partial(rss_figures.channels_over_time, data, pair, both),
            )  # fmt: skip


def _track_specs(data: ReportData, track: Track) -> Iterator[FigureSpec]:
    yield FigureSpec(
        "trajectory", "flight", "Where the UAV flew",
        "Left: the site with its towers. Right: the flight, coloured by height.",
        partial(rss_figures.trajectory, data, track),
    )  # fmt: skip
    dotted = " Dotted lines are waypoints." if data.waypoints else ""
    yield FigureSpec(
        "altitude", "flight", "Height over time",
        f"Height of the UAV above the ground at the site origin.{dotted}",
        partial(rss_figures.altitude, data, track),
    )  # fmt: skip


def _band_words(panel: RssResult) -> str:
    """Sentences on what the band of learned antennas is made of, and whether it holds on this flight."""
    bars = panel.further.error_bars
    if not bars:
        return ""
    parts = ", ".join(f"{what} {bars[name]:.1f} dB" for name, what in SPREAD_PARTS.items())
    inside, two_parts = bars.get("inside_90"), panel.stated is not None and panel.stated.lock is not None
    made = "it joins levels in lock and without, by the probability of lock" if two_parts else (
        f"its standard deviation joins {parts}"
    )  # fmt: skip
    return f" Band: 90 % interval of a sample about the prediction; {made}." + (
        "" if inside is None else f" It holds {100 * inside:.0f} % of the samples of this flight."
    )


SPREAD_PARTS = {
    "gain_sd_db": "the learned gain",
    "own_sd_db": "the flight's own nuisance",
    "noise_sd_db": "noise",
    "fading_sd_db": "fading within the average",
}


_HATCHED = "Hatched spans marked Z have no path in the simulation and are not scored. "


def _rss_specs(data: ReportData, panel: RssResult) -> Iterator[FigureSpec]:
    stem = f"{safe_name(panel.tower)}_{safe_name(panel.channel)}"
    section = f"rss/{panel.tower}/{panel.channel}"
    drawn = f" Of {count(len(panel.time))} samples {count(POINTS_PER_CLOUD)} are drawn, and every extreme."
    yield FigureSpec(
        f"rss_{stem}", section, f"{panel.name}: RSS over time",
        "Top: the measurement as logged, the ray tracing and the baselines, each less its own offset. "
        + _HATCHED * bool(panel.simulated_out_of_coverage.any())
        + "Bottom: residual; dashed lines are plus and minus one RMSE." + _band_words(panel)
        + drawn * (len(panel.time) > POINTS_PER_CLOUD),
        partial(rss_figures.rss_over_time, data, panel),
    )  # fmt: skip


def _rank_specs(data: ReportData, panel: RankResult) -> Iterator[FigureSpec]:
    stem, section = safe_name(panel.tower), f"rank/{panel.tower}"
    yield FigureSpec(
        f"rank_histogram_{stem}", section, f"{panel.tower}: how often each rank",
        "Shares of rank 1 to 4 among samples in coverage, measured beside every K. Whiskers: 95 % intervals.",
        partial(rank_figures.rank_histograms, panel),
    )  # fmt: skip
    yield FigureSpec(
        f"rank_map_{stem}", section, f"{panel.tower}: rank along the flight",
        "Rank at every sample. Colour and marker give the rank; crosses marked Z had no path in the simulation.",
        partial(rank_figures.rank_maps, data, panel),
    )  # fmt: skip
    yield FigureSpec(
        f"rank_time_{stem}", section, f"{panel.tower}: rank over time",
        "Each row is one source. The lowest plot shows the singular values that decide the rank.",
        partial(rank_figures.rank_over_time, data, panel),
    )  # fmt: skip
    if panel.score.simulated:
        yield FigureSpec(
            f"rank_confusion_{stem}", section, f"{panel.tower}: which ranks are mistaken for which",
            "Counts; colour is the share of each measured rank (rows). Frames: equal ranks. Z: no path in the "
            "simulation.",
            partial(rank_figures.confusion, panel),
        )  # fmt: skip
    if np.isfinite(panel.score.curve.agreement).any():
        yield FigureSpec(
            f"rank_k_{stem}", section, f"{panel.tower}: which K explains the modem",
            "Agreement by pose and distance between the histograms as the threshold K varies. The best K is the one of "
            "the highest agreement.",
            partial(rank_figures.agreement_curve, panel),
        )  # fmt: skip

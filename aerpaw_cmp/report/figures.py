"""The figures of a report, in order, with their captions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..compare.result import PairResult, RankResult, RssResult
from .against_figures import against_specs
from .canvas import POINTS_PER_CLOUD, FigureSpec, count
from .data import GEOMETRY, ReportData, Track
from .names import safe_name
from .rank_figures import (
    agreement_curve,
    confusion,
    rank_forecast,
    rank_histograms,
    rank_maps,
    rank_over_time,
)
from .rss_figures import (
    altitude,
    channel_difference,
    detection_reliability,
    ladder,
    overview,
    residual_against_geometry,
    rss_diagnostics,
    rss_over_time,
    seen_from_antennas,
    trajectory,
)
from .serving_figures import serving_spec

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# --- all figures of a report -------------------------------------------------------------------


def figure_specs(data: ReportData) -> list[FigureSpec]:
    """Every figure that the data allow, in reading order."""
    result: list[FigureSpec] = []
    if data.rss or data.rank:
        result += _overview_spec(data)
    if data.track is not None and len(data.track.time):
        result += _track_specs(data, data.track)
    for panel in data.rss:
        if len(panel.time):
            result += _rss_specs(data, panel)
    for pair in data.pairs:
        result.append(_pair_spec(data, pair))
    if any(np.isfinite(row.rmse_heldout_db) for row in data.ladder):
        result.append(
            FigureSpec(
                name="ladder",
                section="ladder",
                title="Models from the simplest to the richest",
                caption="RMSE on held-out segments, a line per tower and channel. Whiskers: 95 % interval of the "
                "difference to the best model on the same samples. Filled: the recommended model.",
                alt=f"RMSE of {len({row.model for row in data.ladder})} models on held-out segments.",
                draw=lambda: ladder(data.ladder),
                page=True,
            )
        )
    if data.serving is not None and data.serving.n:
        result.append(serving_spec(data.serving))
    for rank in data.rank:
        if len(rank.time):
            result += [*_forecast_specs(data, rank), *_rank_specs(data, rank)]
    if data.against is not None:
        result += against_specs(data.against)
    return _with_own_names(result)


def _with_own_names(figures: list[FigureSpec]) -> list[FigureSpec]:
    """The same figures, a number added where two names became one file name."""
    seen: dict[str, int] = {}
    result = []
    for spec in figures:
        count = seen[spec.name] = seen.get(spec.name, 0) + 1
        result.append(spec if count == 1 else replace(spec, name=f"{spec.name}_{count}"))
    return result


def _overview_spec(data: ReportData) -> list[FigureSpec]:
    """The picture of the first screen where no script runs: the first channel, or the first rank."""
    panels = [panel for panel in data.rss if len(panel.time) and panel.score.n]
    if not panels:
        return []
    return [
        FigureSpec(
            name="overview",
            page=True,
            section="overview",
            title="Where and when the prediction fails",
            caption=f"{panels[0].name}. Left: the flight coloured by the residual, measured minus ray tracing "
            "after the offset. Right: level over time.",
            alt=f"Map of the residual of {panels[0].name} beside its level over time.",
            draw=lambda: overview(data, panels[0]),
        )
    ]


def _track_specs(data: ReportData, track: Track) -> list[FigureSpec]:
    there = [word for word, some in (("buildings", data.site.buildings), ("forests", data.site.forests)) if some]
    invented = (
        f" {' and '.join(there).capitalize()} are illustrative: they do not exist and show the method."
        if data.site.illustrative and there
        else ""
    )
    return [
        FigureSpec(
            name="trajectory",
            page=True,
            section="flight",
            title="Where the UAV flew",
            caption=f"Left: the site with its towers. Right: the flight, coloured by height.{invented}",
            alt=f"Plan of {data.site.name} with {len(data.site.towers)} towers and the flown line.",
            draw=lambda: trajectory(data, track),
        ),
        FigureSpec(
            name="altitude",
            page=True,
            section="flight",
            title="Height over time",
            caption="Height of the UAV above the ground at the site origin."
            + (" Dotted lines are waypoints." if data.waypoints else ""),
            alt=f"Line plot of height over time; highest point {np.nanmax(track.up_m, initial=-np.inf):.0f} m.",
            draw=lambda: altitude(data, track),
        ),
    ]


def _band_words(panel: RssResult) -> str:
    """What the band of learned antennas is made of, and whether it holds on this flight."""
    bars = panel.further.error_bars
    if not bars:
        return ""
    parts = ", ".join(f"{what} {bars[name]:.1f} dB" for name, what in SPREAD_PARTS.items())
    held = bars.get("inside_90")
    return f" Band: 90 % interval of a sample about the prediction; its standard deviation joins {parts}." + (
        "" if held is None else f" It holds {100 * held:.0f} % of the samples of this flight."
    )


SPREAD_PARTS = {
    "gain_sd_db": "the learned gain",
    "own_sd_db": "the flight's own nuisance",
    "noise_sd_db": "noise",
    "fading_sd_db": "fading within the average",
}


_HATCHED = "Hatched spans marked Z have no path in the simulation and are not scored. "


def _rss_specs(data: ReportData, panel: RssResult) -> list[FigureSpec]:
    stem = f"{safe_name(panel.tower)}_{safe_name(panel.channel)}"
    section = f"rss/{panel.tower}/{panel.channel}"
    result = [
        FigureSpec(
            name=f"rss_{stem}",
            page=True,
            section=section,
            title=f"{panel.name}: RSS over time",
            caption="Top: the measurement after its offset, the ray tracing, and the baselines, each baseline moved to "
            "its own best fit. "
            + _HATCHED * bool(panel.simulated_out_of_coverage.any())
            + "Bottom: residual; dashed lines are plus and minus one RMSE."
            + _band_words(panel)
            + (
                f" Of {count(len(panel.time))} samples {count(POINTS_PER_CLOUD)} are drawn, and every extreme."
                if len(panel.time) > POINTS_PER_CLOUD
                else ""
            ),
            alt=f"RSS of {panel.name} over time, measured against simulated"
            + (
                f"; RMSE {panel.score.rmse_db:.1f} dB over {panel.score.n} samples."
                if not panel.training
                else "; no error given."
            ),
            draw=lambda: rss_over_time(data, panel),
        ),
        FigureSpec(
            name=f"rss_check_{stem}",
            section=section,
            title=f"{panel.name}: can the number be trusted?",
            caption="Sample against sample; the distribution of the residual; and the RMSE that every candidate offset "
            "would leave: a sharp minimum inside the searched span means that the offset is well defined.",
            alt=f"Scatter plot, residual histogram and offset curve of {panel.name}.",
            draw=lambda: rss_diagnostics(panel),
        ),
    ]
    result += _detection_specs(panel, stem, section)
    if any(name in GEOMETRY for name in panel.geometry):
        result.append(
            FigureSpec(
                name=f"rss_residual_{stem}",
                section=section,
                title=f"{panel.name}: where it fails",
                caption="Residual against the geometry of the link. Lines: running median, and the 10 and 90 % points.",
                alt=f"Residual of {panel.name} against distance, angles and height.",
                draw=lambda: residual_against_geometry(panel),
            )
        )
    if {"azimuth_deg", "elevation_deg"} <= set(panel.geometry):
        result.append(
            FigureSpec(
                name=f"rss_angles_{stem}",
                section=section,
                title=f"{panel.name}: from where the antennas see each other",
                caption="Azimuth (from the boresight towards its left) and elevation of the UAV in the frame of the "
                "tower antenna, and of the tower in the frame of the UAV antenna, which turns with the aircraft where "
                "rt.attitude says so. Patches of one colour point to an antenna pattern or its mounting.",
                alt=f"Azimuth and elevation at which the antennas of {panel.name} see each other, by residual.",
                draw=lambda: seen_from_antennas(panel),
            )
        )
    return result


def _detection_specs(panel: RssResult, stem: str, section: str) -> list[FigureSpec]:
    """The reliability of P(detected), where it was scored."""
    score = panel.further.detection
    if score is None or not score.reliability:
        return []
    return [
        FigureSpec(
            name=f"rss_detection_{stem}",
            page=True,
            section=section,
            title=f"{panel.name}: is the probability of detection calibrated?",
            caption="Fifths of the predicted probability against the share that the receiver detected; on the "
            f"diagonal the forecast is calibrated. Brier score {score.brier:.3f}, constant forecast "
            f"{score.constant_brier:.3f}; log score {score.log_score:.3f}, constant "
            f"{score.constant_log_score:.3f} (held-out segments).",
            alt=f"Reliability of the probability that {panel.name} detects the signal.",
            draw=lambda: detection_reliability(panel),
        )
    ]


def _pair_spec(data: ReportData, pair: PairResult) -> FigureSpec:
    words = f"{pair.first} against {pair.second}"
    return FigureSpec(
        name=f"pair_{safe_name(pair.tower)}_{safe_name(pair.first)}_{safe_name(pair.second)}",
        section=f"pair/{pair.tower}/{pair.first}/{pair.second}",
        title=f"{pair.tower}: {words}",
        caption="Difference of two channels of one tower, recorded at the same instants. What one place and one path "
        "cannot explain, antennas and their mounting must.",
        alt=f"Difference of {words} at {pair.tower} over time.",
        draw=lambda: channel_difference(data, pair),
    )


def _forecast_specs(data: ReportData, panel: RankResult) -> list[FigureSpec]:
    """Probabilities of a fitted receiver along the flight; they stand under the table of the result."""
    if panel.probability is None:
        return []
    return [
        FigureSpec(
            name=f"rank_forecast_{safe_name(panel.tower)}",
            page=True,
            section="forecast",
            title=f"{panel.tower}: rank forecast along the flight",
            caption="Probability of each rank by the fitted receiver (means), above the reported ranks.",
            alt=f"Stacked probabilities of rank 1 to 4 at {panel.tower} over time, and the reported ranks.",
            draw=lambda: rank_forecast(data, panel),
        )
    ]


def _rank_specs(data: ReportData, panel: RankResult) -> list[FigureSpec]:
    stem, section = safe_name(panel.tower), f"rank/{panel.tower}"

    def spec(name: str, title: str, caption: str, alt: str, draw: Callable[[], Figure]) -> FigureSpec:
        return FigureSpec(
            name=f"{name}_{stem}",
            section=section,
            title=f"{panel.tower}: {title}",
            caption=caption,
            alt=alt,
            draw=draw,
            page=name in ("rank_histogram", "rank_time"),
        )

    result = [
        spec(
            "rank_histogram",
            "how often each rank",
            "Shares of rank 1 to 4 among samples in coverage, measured beside every K. Whiskers: 95 % intervals.",
            f"Bar chart of rank shares for {panel.tower}, measured and simulated.",
            lambda: rank_histograms(panel),
        ),
        spec(
            "rank_map",
            "rank along the flight",
            "Rank at every sample. Colour and marker give the rank; crosses marked Z had no path in the simulation.",
            f"Maps of measured and simulated rank around {panel.tower}.",
            lambda: rank_maps(data, panel),
        ),
        spec(
            "rank_time",
            "rank over time",
            "Each row is one source. The lowest plot, where present, shows the singular values that decide the rank.",
            f"Rank of {panel.tower} over time, measured and simulated.",
            lambda: rank_over_time(data, panel),
        ),
    ]
    if panel.score.simulated:
        result.append(
            spec(
                "rank_confusion",
                "which ranks are mistaken for which",
                "Counts; colour is the share of each measured rank (rows). Frames: equal ranks. "
                "Z: no path in the simulation.",
                f"Confusion matrices of {panel.tower} for every K.",
                lambda: confusion(panel),
            )
        )
    if np.isfinite(panel.score.curve.agreement).any():
        result.append(
            spec(
                "rank_k",
                "which K explains the modem",
                "Agreement by pose and distance between the histograms as the threshold K varies. "
                "The best K is the one of the highest agreement.",
                f"Agreement and total variation against K for {panel.tower}.",
                lambda: agreement_curve(panel),
            )
        )
    return result

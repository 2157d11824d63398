"""From the numbers of a flight to the records of its report: panels, the account of the logs, track and waypoints."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from typing import Any

import numpy as np

from ..common.jsonable import fields_of, json_safe
from ..common.units import AnyArray, FloatArray, IntArray, db_from_amplitude
from ..common.versions import versions
from ..compare import rss
from ..compare.rank import RankFit
from ..compare.result import (
    APPLIED,
    GIVEN,
    NOT_APPLIED,
    ClockResult,
    FlightResult,
    ModelLevel,
    PairResult,
    RankResult,
    RssResult,
)
from ..compare.statistics import PairedDifference
from ..flight.data import FlightData, RssSeries
from ..flight.settings import LogSettings
from ..logs.ingest import IngestedFile
from . import data as record
from .export import merge

PANEL_RANK = ("measured", "simulated", "best_k", "best_k_ci95")
"""Numbers of the rank comparison that the panel holds already."""

FOLIAGE_RUNS = ("without trees", "trees in leaf", "trees out of leaf")
"""Variants that are columns of rss.csv, too."""


def report_data(
    data: FlightData,
    result: FlightResult,
    *,
    notes: Sequence[str] = (),
    other_inputs: Sequence[record.InputFile] = (),
    stages_s: Mapping[str, float] | None = None,
    paths: Sequence[record.PosePaths] = (),
) -> record.ReportData:
    """Everything a report shows.

    Parameters
    ----------
    data : FlightData
        Settings, site, logs and track.
    result : FlightResult
        The numbers.
    notes : sequence of str
        Remarks beside those of the flight file.
    other_inputs : sequence of InputFile
        Files besides the logs: settings, site, antennas.
    stages_s : mapping of str to float
        Seconds per stage.
    paths : sequence of PosePaths
        Paths at the samples, for the page that shows them.

    Returns
    -------
    ReportData
    """
    settings = data.settings
    warnings = [
        *clock_warnings(result),
        *data.warnings,
        *(text for one in result.rss for text in rss_warnings(one)),
        *(text for one in result.rank for text in rank_warnings(one)),
    ]
    return record.ReportData(
        title=settings.report.title or settings.flight.title or settings.flight.name,
        flight=settings.flight.name,
        site=data.site,
        generated=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        versions=versions(),
        inputs=(*inputs_of(settings.logs, data.files), *other_inputs),
        track=track_of(data),
        waypoints=waypoints_of(data),
        rss=tuple(
            dataclasses.replace(rss_panel(one), source=source_of(series, settings.logs))
            for one, series in zip(result.rss, data.rss, strict=True)
        ),
        paths=tuple(paths),
        rank=tuple(rank_panel(one) for one in result.rank),
        pairs=tuple(pair_panel(one) for one in result.pairs),
        extra_metrics=metrics_beyond_panels(result),
        engine=result.engine,
        serving=result.serving,
        ladder=result.ladder,
        synthetic=settings.flight.synthetic,
        warnings=tuple(dict.fromkeys(warnings)),
        notes=(*settings.flight.notes, *notes, *_serving_note(result)),  # the page adds those of the site
        settings=settings.model_dump(mode="json"),
        stages_s=dict(stages_s or {}),
    )


def _serving_note(result: FlightResult) -> list[str]:
    """How often the cell predicted strongest is the one that served, and what always naming one would hit."""
    if result.serving is None or not result.serving.n:
        return []
    hits, most = 100 * result.serving.hit_share, 100 * result.serving.majority_share
    return [
        f"Serving cell: the one predicted strongest served in {hits:.0f} % of {result.serving.n} samples; "
        f"always naming the most frequent one hits {most:.0f} %."
    ]


# --- RSS -----------------------------------------------------------------------------------------------------------


def rss_panel(result: RssResult) -> record.RssPanel:
    """One tower and channel."""
    score, clock, position = result.score, result.further.clock, result.position_m
    return record.RssPanel(
        tower=result.tower,
        channel=result.channel,
        unit=result.unit,
        time=result.time,
        measured_db=result.measured_db,
        simulated_dbm=result.simulated_dbm,
        measured_out_of_coverage=result.posed & ~np.isfinite(result.measured_db),
        simulated_out_of_coverage=result.posed & ~np.isfinite(result.simulated_dbm),
        offset_db=score.offset_db,
        rmse_db=score.rmse_db,
        correlation=score.correlation,
        n=score.n,
        n_out_of_coverage=score.n_out_of_coverage,
        at_search_edge=score.at_edge,
        rmse_ci95_db=score.rmse_ci95_db,
        offset_ci95_db=score.intervals.offset_db,
        correlation_ci95=score.intervals.correlation,
        n_effective=score.intervals.autocorrelation.n_effective,
        lag_s=score.lag_s,
        lag_verdict="" if clock is None else clock.verdict,
        fitted=score.fitted_on_scored,
        baselines=tuple(
            _baseline(name, model, result.further.compared_with.get(name)) for name, model in result.baselines.items()
        ),
        offset_curve=record.OffsetCurve(offset_db=result.curve_offset_db, rmse_db=result.curve_rmse_db)
        if len(result.curve_offset_db)
        else None,
        east_m=position[:, 0],
        north_m=position[:, 1],
        up_m=position[:, 2],
        geometry=result.geometry,
        line_of_sight=result.line_of_sight == 1.0,
        worst=_spans(result.time, result.spans),
        variants=tuple(
            _variant(name, model, result.further.compared_with.get(name)) for name, model in result.variants.items()
        ),
        extra=json_safe(fields_of(result.further)),
        per_sample={
            f"simulated_{name.replace(' ', '_')}_dbm": result.variants[name].level_dbm
            for name in FOLIAGE_RUNS
            if name in result.variants
        }
        | ({} if result.stated is None else result.stated.columns(result.simulated_dbm))
        | _tower_columns(result.tower_m),
    )


def _tower_columns(tower_m: FloatArray | None) -> dict[str, FloatArray]:
    """Place of a tower that moves, as columns of rss.csv and rank.csv."""
    if tower_m is None:
        return {}
    return {f"tower_{name}_m": tower_m[:, axis] for axis, name in enumerate(("east", "north", "up"))}


def source_of(series: RssSeries, logs: Sequence[LogSettings]) -> record.Source | None:
    """Where the samples of a series stand in its logs."""
    if len(series.line) != len(series.time):
        return None
    return record.Source(files=tuple(log.path for log in logs), file=series.log, line=series.line)


def _baseline(name: str, model: ModelLevel, paired: PairedDifference | None) -> record.Baseline:
    return record.Baseline(
        name=name, level_dbm=model.level_dbm, offset_db=model.offset_db, rmse_db=model.rmse_db, paired=paired
    )


def _variant(name: str, model: ModelLevel, paired: PairedDifference | None) -> record.Variant:
    return record.Variant(
        name=name, offset_db=model.offset_db, rmse_db=model.rmse_db, rmse_ci95_db=model.rmse_ci95_db, paired=paired
    )


def _spans(time: AnyArray, spans: Sequence[rss.ErrorSpan]) -> tuple[record.ErrorSpan, ...]:
    """Spans with instants instead of seconds since the first sample."""
    start = time.min() if len(time) else np.datetime64(0, "ns")
    return tuple(
        record.ErrorSpan(
            start=start + np.timedelta64(round(span.start_s * 1e9), "ns"),
            end=start + np.timedelta64(round(span.end_s * 1e9), "ns"),
            east_m=span.position_m[0],
            north_m=span.position_m[1],
            up_m=span.position_m[2],
            mean_error_db=span.mean_db,
            cause=span.cause,
        )
        for span in spans
    )


def clocks_of(result: FlightResult) -> dict[str, ClockResult]:
    """One clock per receiver."""
    return {clock.receiver: clock for one in result.rss if (clock := one.further.clock) is not None}


def clock_warnings(result: FlightResult) -> tuple[str, ...]:
    """Clocks that were corrected, should be, or cannot be judged; a correction that was not made comes first."""
    asked, other = [], []
    for receiver, clock in clocks_of(result).items():
        low, high = clock.ci95_s
        side = "ahead of" if clock.radio_minus_telemetry_s > 0 else "behind"
        shown = f"{abs(clock.radio_minus_telemetry_s):.2f} s {side} the telemetry clock [{low:+.2f}, {high:+.2f}]"
        if clock.applied == NOT_APPLIED:
            asked.append(
                f"{receiver}: rss.lag: apply was asked for, but the radio clock was not corrected: {clock.reason}."
            )
        elif clock.applied == APPLIED:
            other.append(f"{receiver}: the radio clock is {shown}; it was corrected.")
        elif clock.verdict == "shifted":
            other.append(f"{receiver}: the radio clock is {shown}; it was not corrected (rss.lag: apply would).")
        elif clock.verdict == "cannot tell":
            other.append(f"{receiver}: the radio clock could not be checked: {clock.reason}.")
    return (*asked, *other)


def rss_warnings(result: RssResult) -> tuple[str, ...]:
    """What the reader must know of one tower and channel before believing its numbers."""
    out = []
    if result.score.n == 0:
        out.append(f"{result.name}: no sample could be compared; its numbers are missing, not zero.")
    elif result.score.at_edge:
        out.append(
            f"{result.name}: the best offset lies at the edge of the searched span; widen rss.span_db before using it."
        )
    return tuple(out)


def pair_panel(result: PairResult) -> record.ChannelPair:
    """Two channels of one tower."""
    return record.ChannelPair(
        tower=result.tower,
        first=result.first,
        second=result.second,
        time=result.time,
        difference_db=result.difference_db,
        simulated_difference_db=result.simulated_difference_db,
        limit_db=rss.PART_DB,
        apart=_spans(result.time, result.score.spans),
    )


def metrics_beyond_panels(result: FlightResult) -> dict[str, Any]:
    """Numbers for metrics.json alone: tables of residuals, pairs of channels."""
    content: dict[str, Any] = {"ladder": [json_safe(fields_of(row)) for row in result.ladder]} if result.ladder else {}
    content |= {"clock": {name: _clock_entry(clock) for name, clock in clocks_of(result).items()}}
    for one in result.rss:
        tables = {name: table.as_dict() for name, table in one.residual_by.items()}
        merge(content, {"rss": {one.tower: {one.channel: {"residual_by": tables}}}})
    if result.serving is not None:
        merge(content, {"serving": result.serving.as_dict()})
    for pair in result.pairs:
        merge(content, {"pairs": {pair.tower: {f"{pair.first} - {pair.second}": pair.score.as_dict()}}})
    return content


def _clock_entry(clock: ClockResult) -> dict[str, Any]:
    """``clock.<receiver>`` of metrics.json: numbers, verdict, whether applied, and the checks it rests on."""
    return {
        **json_safe(clock.checks),
        "radio_minus_telemetry_s": clock.radio_minus_telemetry_s,
        "ci95_s": list(clock.ci95_s),
        "verdict": clock.verdict,
        "reason": clock.reason,
        "applied": clock.applied in (APPLIED, GIVEN),
    }


# --- rank ----------------------------------------------------------------------------------------------------------


def rank_panel(result: RankResult) -> record.RankPanel:
    """The rank of one tower."""
    score, position = result.score, result.position_m
    with np.errstate(invalid="ignore"):  # no channel: 0 / 0
        ratio_db = db_from_amplitude(result.sigma[:, 1:] / result.sigma[:, :1])
    return record.RankPanel(
        tower=result.tower,
        time=result.time,
        east_m=position[:, 0],
        north_m=position[:, 1],
        up_m=position[:, 2],
        measured=result.measured,
        histogram=_histogram(score.histogram, score.histogram_ci95),
        simulated=tuple(_at_k(k, result.rank[k], fit) for k, fit in score.simulated.items()),
        best_k=score.best_k,
        best_k_ci95=score.curve.best_k_interval,
        curve=record.KCurve(
            k=score.curve.k, agreement=score.curve.agreement, total_variation=score.curve.total_variation
        ),
        singular_ratio_db=ratio_db,
        sinr_db=result.sinr_db,
        stale=~score.staleness.fresh,
        extra={
            **{name: value for name, value in score.as_dict().items() if name not in PANEL_RANK},
            **json_safe(fields_of(result.further)),
        },
        values={
            "level_dbm": result.level_dbm,
            **_tower_columns(result.tower_m),
            **{f"sigma{i + 2}_over_sigma1_db": ratio_db[:, i] for i in range(ratio_db.shape[1])},
            **(
                {}
                if result.probability is None
                else {f"probability_rank{r + 1}": result.probability[:, r] for r in range(result.probability.shape[1])}
            ),
        },
        per_sample={
            f"rank_{name.replace(' ', '_')}_k{k:g}": rank.astype(np.float64)
            for name, per_k in result.foliage_rank.items()
            for k, rank in per_k.items()
        },
    )


def _histogram(share: FloatArray, intervals: list[tuple[float, float]]) -> record.Histogram:
    low, high = np.array(intervals, dtype=np.float64).T
    return record.Histogram(share=share, low=low, high=high)


def _at_k(k: float, rank: IntArray, fit: RankFit) -> record.RankAtK:
    return record.RankAtK(
        k=k,
        rank=rank,
        histogram=_histogram(fit.histogram, fit.histogram_ci95),
        n_out_of_coverage=fit.out_of_coverage,
        agreement=fit.agreement,
        total_variation=fit.total_variation,
        wasserstein=fit.wasserstein,
        kappa=fit.kappa,
        agreement_ci95=fit.agreement_ci95,
        total_variation_ci95=fit.total_variation_ci95,
        p_value=fit.p_histogram,
        confusion=fit.confusion[1:],
    )


def rank_warnings(result: RankResult) -> tuple[str, ...]:
    """What the reader must know of the rank of one tower before believing its numbers."""
    out = []
    if left_out := result.n_samples - len(result.time):
        out.append(f"Rank {result.tower}: {left_out} of {result.n_samples} samples are too low or have no pose.")
    if result.score.n == 0:
        out.append(f"Rank {result.tower}: the modem reported no rank at any compared pose.")
    if result.score.staleness.verdict == "held":
        out.append(
            f"Rank {result.tower}: the modem holds each report for about {result.score.staleness.hold_s:.1f} s; "
            f"{result.score.n} samples are {result.score.staleness.n_reports} reports."
        )
    return tuple(out)


# --- the flight ----------------------------------------------------------------------------------------------------


def inputs_of(logs: Sequence[LogSettings], files: Sequence[IngestedFile]) -> tuple[record.InputFile, ...]:
    """The account of every log."""
    return tuple(
        record.InputFile(
            path=log.path,
            sha256=file.sha256,
            reader=file.result.reader,
            lines=file.result.lines,
            accepted=file.result.accepted,
            rejected=file.result.rejected_count,
            blank=file.result.blank,
            role=", ".join(sorted({s.kind for s in file.result.streams})),
            warnings=file.result.warnings,
            rejected_lines=file.result.rejected,
        )
        for log, file in zip(logs, files, strict=True)
    )


def track_of(data: FlightData) -> record.Track | None:
    """The flown line: telemetry's, or the rank log's own positions."""
    if data.track is not None and len(data.track):
        step_ns = max((data.track.end_ns - data.track.start_ns) // 2000, 500_000_000)
        time = np.arange(data.track.start_ns, data.track.end_ns + 1, step_ns).astype("datetime64[ns]")
        position = data.track.pose_at(time).position_m
    else:
        own = next((s for s in data.rank if s.position_m is not None), None)
        if own is None or own.position_m is None:
            return None
        time, position = own.time, own.position_m
    return record.Track(time=time, east_m=position[:, 0], north_m=position[:, 1], up_m=position[:, 2])


def waypoints_of(data: FlightData) -> tuple[record.Waypoint, ...]:
    """Waypoints of the plan or the report settings, each at the moment the track comes nearest."""
    plan = data.settings.flight.plan
    points = data.settings.report.waypoints or (plan.waypoints if plan else [])
    track = track_of(data)
    if track is None:
        return ()
    out, start = [], 0
    for point in points:
        if not point.label:
            continue
        distance = np.sqrt(
            (track.east_m[start:] - point.east_m) ** 2
            + (track.north_m[start:] - point.north_m) ** 2
            + (track.up_m[start:] - point.height_m) ** 2
        )
        # the first moment it comes as near as it ever will (within 2 m): later visits belong to later waypoints
        near = np.flatnonzero(distance <= np.nanmin(distance) + 2.0)
        index = start + int(near[0])
        out.append(
            record.Waypoint(
                label=point.label,
                time=track.time[index],
                east_m=point.east_m,
                north_m=point.north_m,
                up_m=point.height_m,
            )
        )
        start = index
    return tuple(out)

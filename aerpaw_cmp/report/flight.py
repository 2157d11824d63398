"""The page report.html of a flight, its metrics.json, and the folder of its results."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from ..common.content import KEY, union
from ..common.jsonable import fields_of, json_safe
from ..common.stages import Stages
from ..common.text import counted
from ..common.units import AnyArray, FloatArray
from ..compare import result as results
from ..compare.level import PART_DB, ErrorSpan, FieldAudit
from ..compare.referee import AVERAGED, OURS
from ..compare.statistics import Interval
from ..logs.records import has_wall_clock
from . import flight_words as words
from .cards import HEAD, RIGHT, SHARE, TEXT, Card, Page, Positions, Table, bold, estimate, paragraph, settings_card
from .charts import charts_of, shown_confusion
from .columns import RANK, RSS, csv_text, described
from .explorer import payload
from .flight_data import RANKS, InputFile, ReportData, start_of
from .flight_figures import figure_specs
from .page import about, json_text, links_of, merge, rendered, write_figures, write_file
from .texts import clock, cut, duration, interval, k_key, minute, number, percent

# Largest number of rejected lines that are shown per file.
_REJECTED_SHOWN = 20

# --- metrics.json ---------------------------------------------------------------------------------------------------


def metrics(data: ReportData) -> dict[str, Any]:
    """Return the content of metrics.json as plain values. ``data.extra_metrics`` is merged last, key by key."""
    rss: dict[str, dict[str, Any]] = {}
    for item in data.rss:
        rss.setdefault(item.tower, {})[item.channel] = _rss_metrics(item)
    pairs: dict[str, dict[str, Any]] = {}
    for pair in data.pairs:
        pairs.setdefault(pair.tower, {})[f"{pair.first} - {pair.second}"] = pair.score
    result: dict[str, Any] = {
        "flight": data.flight, "title": data.title, "synthetic": data.synthetic, "settings": data.settings,
        "sentence": words.paragraph(data),
        "warnings": words.cautions(data),
        "antennas": data.antennas,
        "site": {"name": data.site.name, "credit": data.site.credit, "assumed": data.site.assumed},
        "inputs": [
            {"path": f.path, "sha256": f.sha256, "reader": f.reader, "lines": f.lines, "accepted": f.accepted,
             "rejected": f.rejected, "blank": f.blank, "role": f.role, "warnings": f.warnings}
            | ({"learned_on": f.learned_on} if f.learned_on else {})
            for f in data.inputs
        ],
        KEY: list(union(*(f.learned_on for f in data.inputs))),
        "rss": rss,
        "verdict": data.verdict,
        "likely_cause": data.likely_cause, "next_step": data.next_step,
        "offsets": words.offset_sentences(data.rss),
        "rank": {item.tower: _rank_metrics(item) for item in data.rank},
        "rt": None if data.engine is None else _engine_metrics(data.engine),
        **about(data),
        **({"models": data.models, "ladder": data.ladder} if data.models else {}),
        "clock": {name: clock_metrics(clock) for name, clock in data.clocks.items()},
        **({} if data.serving is None else {"serving": data.serving.as_dict()}),
        **({"pairs": pairs} if pairs else {}),
    }  # fmt: skip
    safe: dict[str, Any] = json_safe(result)
    merge(safe, json_safe(data.extra_metrics))
    return safe


def _rss_metrics(series: results.RssResult) -> dict[str, Any]:
    score = series.score
    return {
        "offset_db": score.offset_db, "rmse_db": score.rmse_db, "n": score.n,
        "n_out_of_coverage": score.n_out_of_coverage,
        "at_search_edge": score.at_edge,
        "correlation": score.correlation, "rmse_ci95_db": score.rmse_ci95_db,
        "offset_ci95_db": score.intervals.offset_db,
        "correlation_ci95": score.intervals.correlation,
        "n_effective": score.intervals.n_effective,
        "lag_s": score.lag_s,
        "lag_verdict": series.clock_verdict,
        "unit": series.unit,
        "fitted": score.fitted_on_scored,
        "baselines": {
            name: {"offset_db": model.offset_db, "rmse_db": model.rmse_db} for name, model in series.baselines.items()
        },
        **fields_of(series.further),
    }  # fmt: skip


def clock_metrics(clock: results.ClockResult) -> dict[str, Any]:
    """Return the entry ``clock.<receiver>`` of metrics.json: numbers, verdict, whether it was applied, and checks."""
    return {
        **clock.checks,
        "radio_minus_telemetry_s": clock.radio_minus_telemetry_s,
        "ci95_s": clock.ci95_s,
        "verdict": clock.verdict,
        "reason": clock.reason,
        "applied": clock.applied in (results.APPLIED, results.GIVEN),
    }


def _histogram(share: FloatArray, intervals: Sequence[Interval]) -> dict[str, Any]:
    names = [str(rank) for rank in RANKS]
    return {
        "histogram": dict(zip(names, share, strict=True)),
        "histogram_ci95": dict(zip(names, intervals, strict=True)),
    }


def _rank_metrics(series: results.RankResult) -> dict[str, Any]:
    score = series.score
    simulated = {
        k: {
            **_histogram(fit.histogram, fit.histogram_ci95),
            "out_of_coverage": fit.out_of_coverage, "agreement": fit.agreement, "agreement_ci95": fit.agreement_ci95,
            "kappa": fit.kappa, "total_variation": fit.total_variation,
            "total_variation_ci95": fit.total_variation_ci95, "wasserstein": fit.wasserstein,
            "p_value": fit.p_histogram, "confusion": fit.confusion[1:],
        }
        for k, fit in score.simulated.items()
    }  # fmt: skip
    return {
        "measured": {
            **_histogram(score.histogram, score.histogram_ci95),
            "n": int(np.isfinite(series.measured).sum()),
            "n_no_csi": int((~np.isfinite(series.measured)).sum()),
        },
        "simulated": simulated,
        "best_k": score.curve.best_k,
        "best_k_ci95": score.curve.best_k_ci95,
        "n": score.n, "n_effective": score.n_effective, "n_no_csi": score.n_no_csi,
        "stale": {"verdict": score.staleness.verdict, "n_reports": score.staleness.n_reports,
                  "hold_s": score.staleness.hold_s},
        **fields_of(series.further),
    }  # fmt: skip


def _engine_metrics(engine: results.EngineResult) -> dict[str, Any]:
    audit = engine.audit
    return {
        "engine": engine.engine, "links": engine.links, "seconds": engine.seconds, "paths": engine.paths,
        "left_out": engine.left_out, "not_audited": engine.not_audited,
        "audit": audit and {
            "summary": words.audit_summary(audit),
            "reference": audit.reference, "links": audit.links, "missing_paths": audit.missing_paths,
            "extra_paths": audit.extra_paths, "rss_max_error_db": audit.rss_max_error_db,
            "rank_disagreement": audit.rank_disagreement,
            "field": audit.fields and {**fields_of(audit.fields), "failed": audit.fields.failed},
            "seconds": audit.seconds, "reference_seconds": audit.reference_seconds,
        },
    }  # fmt: skip


# --- cards ----------------------------------------------------------------------------------------------------------


def result_card(data: ReportData) -> Card:
    """Return the card of all errors: levels by channel, ranks by tower and K."""
    return Card(title="Result", id="result", link="Result", chart="forecast", tables=[_levels(data), _ranks(data)])


def _levels(data: ReportData) -> Table:
    models = list(dict.fromkeys(name for item in data.rss for name in item.baselines))
    return Table(
        caption="RMSE of the received level in dB, with its 95 % interval in brackets. Every model has its own best "
        "constant offset.",
        columns={"Tower": HEAD, "Channel": TEXT, "Offset [dB]": RIGHT, "RMSE ray tracing": RIGHT,
                 **{f"RMSE {words.pretty(name)}": 1 for name in models},
                 "Correlation": 2, "Samples": 0, "Out of coverage": 0},
        rows=[
            (p.tower, p.channel, number(p.score.offset_db) + (" (edge)" if p.score.at_edge else ""),
             estimate(p.score.rmse_db, p.score.rmse_ci95_db, 1, mark="<b>{}</b>"),
             *(p.baselines[name].rmse_db if name in p.baselines else None for name in models),
             p.score.correlation, p.score.n, p.score.n_out_of_coverage)
            for p in data.rss
        ],
        notes=words.offset_sentences(data.rss),
    )  # fmt: skip


def _ranks(data: ReportData) -> Table:
    rows: list[Sequence[Any]] = []
    best = []
    for p in data.rank:
        rows.append((p.tower, "measured", *p.score.histogram, *[""] * 6))
        for k, at in p.score.simulated.items():
            agreement = estimate(at.agreement, at.agreement_ci95, SHARE)
            if (by_ground := (p.further.agreement_sd_by_ground or {}).get(f"{k:g}")) is not None:
                agreement += Markup(' <span class="small">±{}</span>').format(number(100 * by_ground, 0))
            rows.append((p.tower, f"K = {k_key(k)}", *at.histogram,
                         estimate(at.total_variation, at.total_variation_ci95), at.p_histogram, agreement, at.kappa,
                         at.wasserstein, at.out_of_coverage))  # fmt: skip
        if math.isfinite(p.score.curve.best_k):
            best.append(f"{number(p.score.curve.best_k)} {interval(p.score.curve.best_k_ci95)} at {p.tower}")
    grounds = any(p.further.agreement_sd_by_ground for p in data.rank)
    return Table(
        caption="Shares of channel rank 1 to 4 in coverage, as the modem reported and as simulated, with 95 % "
        "intervals in brackets.",
        columns={"Tower": HEAD, "Source": TEXT, **{f"Rank {rank}": SHARE for rank in RANKS},
                 "Total variation": RIGHT, "p": 3, "Agreement": RIGHT, "Kappa": 2, "Wasserstein": 2,
                 "Out of coverage": 0},
        rows=rows,
        notes=[words.RANK_WORDS + " p is the probability of such a total variation if both had the same distribution."
               + (f" Over all K, the agreement is largest at K = {', '.join(best)}." if best else "")
               + (" The number after ± is the standard deviation that results from the unknown shape of the ground "
                  "between its known heights." if grounds else ""),
               *filter(None, map(words.rank_references, data.rank))],
    )  # fmt: skip


# Names on the page for the entries of ``fitted_on_scored``.
_FITTED = {"offset_db": "offset", "lag_s": "clock lag"}


def channels_card(data: ReportData) -> Card:
    """Return the card of the received levels, with an inner card for each channel and each pair of channels."""
    parts = [_channel(data, panel) for panel in data.rss]
    caption = f"Segments in which the two channels differ by more than {PART_DB:.0f} dB."
    for p in data.pairs:
        table = _spans(data, p.time, p.score.spans, caption)
        parts.append(Card(title=f"{p.tower}: {p.first} against {p.second}", group="rss-channel", tables=[table]))
    return Card(title="Received signal strength", id="rss", link="RSS", fold=True, parts=parts if data.rss else ())


def _channel(data: ReportData, p: results.RssResult) -> Card:
    score, independent = p.score, p.score.intervals.n_effective
    fitted = [f"Fitted on the scored samples: {', '.join(_FITTED.get(name, name) for name in score.fitted_on_scored)}."]
    if math.isfinite(independent):
        count = counted(round(independent), "independent sample")
        fitted.append(f"Offset {number(score.offset_db)} dB {interval(score.intervals.offset_db)}:")
        fitted.append(f"for this interval, the {number(score.n, 0)} samples count as about {count}.")
    lag = f", radio minus telemetry {number(score.lag_s, 2, 's')}" if p.clock_verdict != results.CANNOT_TELL else ""
    return Card(
        title=p.name, group="rss-channel", chart=f"rss/{p.tower}/{p.channel}",
        text=[paragraph(
            words.rss_verdict(p), *(fitted if score.n else ()),
            f"Clock check: {p.clock_verdict}{lag}." if p.clock_verdict else "",
        )],
        parts=[Card(tables=[_spans(data, p.time, p.spans, f"Segments with the largest error, {p.name}.")])],
    )  # fmt: skip


def _spans(data: ReportData, time: AnyArray, spans: Sequence[ErrorSpan], caption: str) -> Table:
    start = start_of(data)
    unit = "UTC" if has_wall_clock(start) else "s"
    rows = [
        (*(clock(at, start) for at in words.instants(time, span)), *span.position_m, span.mean_db)
        for span in spans or ()
    ]
    return Table(
        caption=caption, rows=rows,
        columns={f"From ({unit})": TEXT, "To": TEXT, "East [m]": 0, "North [m]": 0, "Up [m]": 0,
                 "Mean residual [dB]": 1},
    )  # fmt: skip


def referee_card(data: ReportData) -> Card:
    """Return the card that compares predictions of other programs with ray tracing and the baselines."""
    parts = [prediction_card(verdict) for verdict in data.extra_metrics.get("referee", ())]
    text = (
        "Every model is scored on the samples that the prediction covers. Fitted on this flight: one offset per model "
        "and channel."
    )
    return Card(title="Predictions of other programs", id="referee", text=[text] if parts else [], parts=parts)


def prediction_card(verdict: Mapping[str, Any]) -> Card:
    """Return the card of one prediction: means over channels, then each channel."""
    name = verdict["prediction"]
    series = [(" ".join(link).strip(), entry) for link, entry in links_of(verdict["levels"]).items()]
    scores: dict[str, str | int] = {
        "Bias [dB]": 1, "RMSE [dB]": 1, "RMSE after offset": 1, "RMSE over 1 s": 1, "Correlation": 2, "CRPS [dB]": 2,
        "In 90 %": SHARE,
    }  # fmt: skip
    means = Table(
        caption="Mean scores over the channels that all models have. A dash means that the prediction has no common "
        "reference with the log, or no 90 % band.",
        columns={"Model": HEAD, "Channels": 0, **scores},
        rows=[list(row.values()) for row in verdict["means"]],
    )
    channels = Table(
        caption="Scores of each channel. The difference is the RMSE of the prediction minus that of the model, after "
        "offsets, with its 95 % interval [dB]. If it is negative, the prediction is better.",
        columns={"Tower, channel": HEAD, "Model": TEXT, "Samples": 0, **scores, "Difference": 2, "95 %": 2},
        rows=[
            (link, model, card["n"], *(card[key] for key in AVERAGED),
             *((None, None) if pair is None else (pair["difference_db"], tuple(pair["difference_ci95_db"]))))
            for link, entry in series for model, card in entry["cards"].items()
            for pair in [entry["differences"].get(model)]
        ], look="dense",
    )  # fmt: skip
    nodes = Table(
        caption="The prediction at each channel: offset (added to the measurement), slope of measured over predicted "
        "level (1 if both change equally), and detection floor (the lowest predicted level, if it repeats).",
        columns={"Tower, channel": HEAD, "Offset [dB]": 1, "Slope": 2, "Detection floor [dB]": 1},
        rows=[list(node.values()) for node in verdict["nodes"]],
    )
    ranks = Table(
        caption="Ranks on the same samples. A log score [nat] is better if it is lower; the last column is the score "
        "of the mean probabilities.",
        columns={"Tower": HEAD, "Model": TEXT, "Samples": 0, "Kappa": 2, "Total variation": 3, "Agreement": SHARE,
                 "Log score": 3, "Log score of the mean": 3},
        rows=[
            (tower, model, entry["matched"], score["kappa"], score["total_variation"], score["agreement"],
             *(entry[key] if model == name else None for key in ("log_score", "constant_log_score")))
            for tower, entry in verdict["rank"].items() for model, score in entry["scores"].items()
        ],
    )  # fmt: skip
    return Card(
        title=name,
        text=[paragraph(bold(verdict["sentence"])), *verdict["remarks"]],
        tables=[means, nodes, ranks, _exceedance_table(name, series)],
        parts=[Card(title=f"{name}, channel by channel", tables=[channels], fold=True)],
    )


def _exceedance_table(name: str, series: Iterable[tuple[str, Mapping[str, Any]]]) -> Table:
    """Return the shares of samples above thresholds: measured, by a prediction, and by ray tracing."""
    return Table(
        caption="Share of samples at or above a threshold. Levels without a common reference with the log are "
        "compared after the offset.",
        columns={"Tower, channel": HEAD, "Threshold [dB]": 1, "Measured": SHARE, "Prediction": SHARE,
                 "Ray tracing": SHARE},
        rows=[
            (link, x["threshold_db"], x["measured"], x["predicted"], mine and mine["exceedance"][k]["predicted"])
            for link, entry in series for mine in [entry["cards"].get(OURS)]
            for k, x in enumerate(entry["cards"][name]["exceedance"])
        ], look="tall",
    )  # fmt: skip


def models_card(data: ReportData) -> Card:
    """Return the card that compares models by their error on held-out areas, over all channels and per channel."""
    title = "Which model does this flight need?"
    if not data.models:
        few = bool(data.rss) and data.engine is not None and data.engine.engine == "image"
        return Card(title=title, id="ladder", link="Models", text=[words.NO_MODELS] if few else [])
    rows = {(row.model, row.tower, row.channel): row for row in data.ladder}
    channels = dict.fromkeys((row.tower, row.channel) for row in data.ladder)
    shown, same = [row for row in data.models if row.distinct], [row.model for row in data.models if not row.distinct]
    notes = {
        row.model: ", ".join(["recommended"] * row.recommended + ["fastest sufficient"] * row.fastest_sufficient)
        for row in shown
    }
    pooled = Table(
        caption="RMSE on held-out areas over all channels, and its difference from the best model on the same "
        "samples, with its 95 % interval.",
        columns={"No.": RIGHT, "Model": HEAD, "RMSE [dB]": 1, "Difference from the best [dB]": RIGHT, "Time [s]": 2,
                 "Note": TEXT},
        rows=[
            (str(number), bold(row.model) if row.recommended else row.model, row.rmse_heldout_db,
             estimate(row.difference_to_best_db, row.difference_to_best_ci95_db), row.seconds, notes[row.model])
            for number, row in enumerate(shown, 1)
        ],
        notes=["The recommended model is the simplest replay within one standard error of the best replay. Models are "
               "listed by rising cost. The fastest sufficient model is the first whose difference from the best model "
               "is not significant.",
               *([f"Within 0.01 dB of a row above on every channel: {'; '.join(same)}."] if same else [])],
    )  # fmt: skip
    each = Table(
        caption="RMSE in dB on held-out areas. \u0394: 95 % interval of its difference from the best model.",
        columns={"Tower": HEAD, "Channel": HEAD, **{f"Model {number}": RIGHT for number in range(1, len(shown) + 1)}},
        rows=[
            (*of, *(Markup('{} <span class="small">\u0394 {}</span>').format(
                        number(row.rmse_heldout_db), interval(row.difference_to_best_ci95_db, 2))
                    for model in shown for row in [rows[model.model, of[0], of[1]]]))
            for of in channels
        ],
        look="dense",
    )  # fmt: skip
    text = (
        f"{words.models_verdict(data.models)} The flight is divided into eight areas. Each area is scored with the "
        "offset of the other seven areas; nothing else is fitted. Each stage (antennas, trees, ground, buildings) adds "
        "its variants to the best model so far."
    )
    return Card(
        title=title, id="ladder", link="Models", text=[text], tables=[pooled],
        chart="ladder", parts=[Card(title="Models, channel by channel", tables=[each], fold=True)],
    )  # fmt: skip


def serving_card(data: ReportData) -> Card:
    """Return the card that compares serving cells with the cells that are predicted to be the strongest."""
    serving = data.serving
    if serving is None or not serving.n:
        return Card()
    names, counts = shown_confusion(serving)
    table = Table(
        caption="Numbers of samples by serving cell (rows) and predicted strongest cell (columns), for the cells with "
        "the most samples. Simulated levels have no offset.",
        columns={"Served": HEAD, **dict.fromkeys(names, 0), "no path": 0},
        rows=[(name, *row.tolist()) for name, row in zip(names, counts, strict=True)],
    )
    text = paragraph(
        "The predicted strongest cell was the serving cell in",
        bold(percent(serving.hit_share, 1)),
        f"of {number(serving.n, 0)} samples; always predicting the most frequent serving cell is right in "
        f"{percent(serving.majority_share, 1)}.",
        "The prediction is no better than that." if serving.hit_share <= serving.majority_share else "",
        "The complete matrix is in metrics.json, key serving.",
    )
    return Card(title="Serving cells", id="serving", link="Serving cells", fold=True, text=[text], tables=[table])


def engine_card(data: ReportData) -> Card:
    """Return the card of the replay engine and its audit."""
    e = data.engine
    if e is None:
        return Card()
    extent = ", ".join([counted(e.links, "link"), *([] if e.paths is None else [counted(e.paths, "path")])])
    text = [paragraph("Engine", Markup("<b>{}</b>:").format(e.engine), f"{extent} in {duration(e.seconds)}.")]
    audit = e.audit
    return Card(
        title="Replay engine and its audit", id="engine", link="Engine", fold=True,
        text=[*text, "This replay was not audited." if audit is None else words.audit_summary(audit)],
        tables=[] if audit is None else [_audited_paths(audit), *_audited_fields(audit.fields)],
        parts=[Card(title=f"Not modelled in the replay: {len(e.left_out)}", fold=True, text=[e.left_out])],
    )  # fmt: skip


def _audited_paths(a: results.AuditResult) -> Table:
    return Table(
        caption="Paths and levels of the two engines on the same links, which are spread over all channels.",
        columns={"Reference": HEAD, "Links": 0, "Paths missing": 0,
                 "Paths that Sionna RT did not sample": 0, "Largest RSS difference [dB]": 3,
                 **{f"Different rank at K = {k_key(k)}": RIGHT for k in a.rank_disagreement},
                 "Time": RIGHT, "Time of the reference": RIGHT},
        rows=[(a.reference, a.links, a.missing_paths, a.extra_paths, a.rss_max_error_db,
               *(percent(share, 1) for share in a.rank_disagreement.values()),
               duration(a.seconds), duration(a.reference_seconds))],
        notes=[a.note] if a.note else [],
    )  # fmt: skip


def _audited_fields(f: FieldAudit | None) -> list[Table]:
    if f is None:
        return []
    rows = [
        ("Sionna RT, per path, both slants", f"{counted(f.paths, 'path')}, phases of {number(f.phases, 0)}",
         number(f.power_max_db, 3, "dB"), number(f.power_rms_db, 4, "dB"), number(f.phase_max_rad, 5, "rad"),
         number(f.phase_rms_rad, 6, "rad"), f"largest difference of RSS: {number(f.link_rss_max_db, 3)} dB"),
        ("Second implementation, per element pair",
         f"{counted(f.reference_links, 'link')}, {counted(f.reference_paths, 'path')}",
         number(f.rss_max_error_db, 6, "dB"), "", "", "",
         f"largest difference of H: {f.h_max_error:.1e} of its size; links with another rank: "
         f"{number(f.rank_differs, 0)}; paths: {number(f.missing_paths, 0)} missing, "
         f"{number(f.phantom_paths, 0)} impossible"),
        ("Attitude, computed a second time", f"{number(f.attitude_rows, 0)} telemetry rows", "", "",
         f"{f.attitude_max_rad:.1e} rad", "", ""),
    ]  # fmt: skip
    passed = (
        "All within tolerance: 0.05 dB and 0.01 rad (below 300 m) against Sionna's float32, 1e-6 of H against the "
        "second implementation (float64)."
    )
    failed = Markup("<b>{} failed:</b> {}.").format(counted(f.failed, "check"), "; ".join(f.failures))
    doubtful = f"{number(f.doubtful, 0)} paths or links were not checked, because rounding decides them."
    note = paragraph(
        failed if f.failed else passed, doubtful if f.doubtful else "", f"Not covered: {'; '.join(f.not_covered)}.",
        "Only the second implementation checks foliage, array layouts and patterns that Sionna does not have. Both "
        "references use the paths of the array centre.",
    )  # fmt: skip
    return [Table(
        caption="Both engines share the code of the fields. It is checked against the coefficients of Sionna RT and "
        "against a second implementation, written from the recommendations.",
        columns={"Against": HEAD, "Checked": TEXT, "Power, worst": RIGHT, "Power, RMS": RIGHT, "Phase, worst": RIGHT,
                 "Phase, RMS": RIGHT, "Also": TEXT},
        rows=rows if f.attitude_rows else rows[:2], notes=[note],
    )]  # fmt: skip


def inputs_card(data: ReportData) -> Card:
    """Return the card of all input files, with the numbers of accepted and rejected lines."""
    table = Table(
        caption="Every line is accepted, rejected with a reason, or blank. Comments and headers count as blank.",
        columns={"File": HEAD, "Reader": TEXT, "Lines": 0, "Accepted": 0, "Rejected": 0, "Blank": 0, "SHA-256": "hash"},
        rows=[
            (
                Markup('{} <span class="small">{}</span>').format(f.path, f"({f.role})" if f.role else ""),
                *((f.reader, f.lines, f.accepted, f.rejected, f.blank) if f.reader else ("not a log", "", "", "", "")),
                Markup('<span title="{}">{}…</span>').format(f.sha256, f.sha256[:16]),
            )
            for f in data.inputs
        ],
    )
    parts = [
        Card(
            title=f"{f.path}: {counted(f.rejected, 'rejected line')}, {counted(len(f.warnings), 'remark')}",
            fold=not f.warnings,
            text=[f.warnings],
            tables=[_rejected(f)],
        )
        for f in data.inputs
    ]
    text = [] if data.inputs else ["No input file was named."]
    title = "Inputs and their account"
    return Card(title=title, id="inputs", link="Inputs", fold=True, text=text, tables=[table], parts=parts)


def _rejected(f: InputFile) -> Table:
    first = f", the first {_REJECTED_SHOWN} of {number(f.rejected, 0)}" if f.rejected > _REJECTED_SHOWN else ""
    rows = [
        (line.number, line.reason, Markup("<code>{}</code>").format(cut(line.text)))
        for line in f.rejected_lines[:_REJECTED_SHOWN]
    ]
    return Table(caption=f"Rejected lines{first}.", columns={"Line": RIGHT, "Reason": TEXT, "Text": TEXT}, rows=rows)


def method_card(data: ReportData, files: Sequence[str]) -> Card:
    """Return the card of the method, the notes of site and flight, and the columns of the files."""
    notes = list(dict.fromkeys([*data.site.notes, *data.notes]))  # notes of flight and site may be equal
    heads = {"Column": HEAD, "Unit": TEXT, "Meaning": TEXT}
    tables = [
        Table(caption=f"Columns of {name}.", columns=heads, rows=described(columns))
        for name, columns in (("rss.csv", RSS), ("rank.csv", RANK))
    ]
    pictures = "The command writes every figure as a picture with --figures svg, png, pdf or all."
    beside = [f"{', '.join(files)}. {'' if 'figures/' in files else pictures}"]
    return Card(
        title="Method and files", id="method", link="Method", fold=True, text=[Markup(rendered("method"))],
        parts=[Card(text=[Markup("<h3>Notes</h3>"), notes] if notes else []),
               Card(title="Files of this report and their columns", fold=True, text=beside, tables=tables)],
    )  # fmt: skip


# Cards in the order of the page. A new card is another function here.
CARDS = (
    result_card, channels_card, referee_card, models_card, serving_card, engine_card,
    inputs_card,
)  # fmt: skip


def page(data: ReportData, files: Sequence[str]) -> str:
    """Return the page.

    Parameters
    ----------
    data : ReportData
    files : sequence of str
        Names of the other files of the report.
    """
    charts = charts_of(data)
    linked = payload(data, charts) if data.rss or data.rank else None
    made = f"Made {minute(data.generated)} · site {data.site.name}"
    if data.engine:
        replayed = f"{number(data.engine.links, 0)} links replayed in {duration(data.engine.seconds)}"
        made += f" · {replayed}"
    settings = [data.settings, {"engine": data.engine.settings} if data.engine else {}]
    return Page(
        kind="report", title=data.title, tag="synthetic flight" if data.synthetic else "",
        verdict=words.paragraph(data), cautions=words.cautions(data), about=[" · ".join([made, *data.antennas])],
        numbers=words.headlines(data), charts=charts,
        first=[Card(positions=Positions(view="explorer", data=linked))] if linked else [],
        cards=[*(card(data) for card in CARDS), settings_card(data, *settings, fold=True), method_card(data, files)],
    ).html()  # fmt: skip


# --- the folder -----------------------------------------------------------------------------------------------------


def write_report(
    data: ReportData,
    folder: str | Path,
    *,
    drawn: str = "none",
    kmz: bool = False,
    netcdf: bool = False,
    stages: Stages | None = None,
) -> tuple[list[Path], ReportData]:
    """Write the files of a report.

    Parameters
    ----------
    data : ReportData
    folder : path
        An empty folder, such as the result of :meth:`aerpaw_cmp.common.outputs.OutputFolder.filling`.
    drawn : str
        A value of :data:`~aerpaw_cmp.report.page.FIGURES`.
    kmz : bool
        Also write ``samples.kmz``.
    netcdf : bool
        Also write ``rss.nc`` and ``rank.nc``.
    stages : Stages, optional
        Receives the time of the stage "report", which is also stored in the data.

    Returns
    -------
    files : list of Path
        ``report.html``, the CSV files (with only a header if there are no rows), the figures, ``metrics.json``.
    data : ReportData
        The data with the seconds of all stages.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    folder, stages = Path(folder), stages or Stages(seconds=dict(data.stages_s))
    written: list[Path] = []
    with stages("report"):
        for name, text in (("rss.csv", csv_text(RSS, data.rss)), ("rank.csv", csv_text(RANK, data.rank))):
            # also write a table without rows, so that every report has the same files
            written.append(write_file(folder / name, text))
        pictures = write_figures(partial(figure_specs, data), folder / "figures", drawn, stages.progress)
    written += pictures
    if kmz:
        from .kmz import write_kmz

        with stages("kmz"):
            written.append(write_kmz(data, folder))
    if netcdf:
        from .samples_netcdf import write_netcdf

        with stages("netcdf"):
            written += write_netcdf(data, folder)
    data = dataclasses.replace(data, stages_s=dict(stages.seconds))
    files = ["metrics.json", *(path.name for path in written if path.parent == folder)]
    # the page lists the folder of figures only if there are any
    if pictures:
        files.append("figures/")
    with stages("report"):
        html = write_file(folder / "report.html", page(data, files))
    data = dataclasses.replace(data, stages_s=dict(stages.seconds))
    numbers = write_file(folder / "metrics.json", json_text(metrics(data)))
    return [html, *written, numbers], data

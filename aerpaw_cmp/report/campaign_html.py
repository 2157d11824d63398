"""campaign.html, campaign.json and campaign.csv, with the figures beside them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from ..common.cells import guarded
from ..common.jsonable import json_safe
from ..common.stages import Progress, silent
from ..compare.result import Repeated
from ..compare.rss import LEARNED_HERE
from . import campaign_figures, canvas
from .campaign_data import CampaignData, RankHeldOutFold, RankRow, RssRow
from .campaign_explorer import payload
from .campaign_pairs import TABLE as PAIR_TABLE
from .campaign_pairs import by_link, pair_frame, telling, telling_ranks
from .canvas import Picture
from .explorer import as_json
from .export import write_file
from .exports.points import of_campaign
from .exports.write import write_exports
from .first_screen import most_telling, pooled_db
from .html import by_section, environment, policy, script
from .names import k_key
from .words import Judged, first_sentence, pretty, ranking_sentence

FEW, MANY = 8, 200
"""Warnings that stand open, and that stand on the page at all."""

FEW_SETTINGS = 4
"""Settings that a sentence names."""

FEW_FLIGHTS = 20
"""Flights of a table that has a column or a heading for each."""

ROWS_SHOWN, FOLD_ROWS = 300, 60
"""Rows of a table on the page; the files beside it hold all."""

COMPACT_ROWS = 2000
"""From so many rows on campaign.json is written without indentation."""

FEW_PAIRS = 0.25
"""Below this share of samples with a pair, a repeatability floor is that of a few places."""

ARRAYS = ("time_s", "measured_db", "simulated_dbm", "position_m", "distance_m", "heading_deg")
"""Fields of a row that are samples, not numbers of a table."""


def _entries(items: Iterable[Any], without: Sequence[str] = ()) -> list[dict[str, Any]]:
    return [{f.name: getattr(x, f.name) for f in dataclasses.fields(x) if f.name not in without} for x in items]


def rss_flights(data: CampaignData) -> list[str]:
    """Flights that have RSS, and those that failed: a flight with rank alone has no RMSE to miss."""
    ranked = {row.flight for row in data.rank} - {row.flight for row in data.rss}
    return [name for name in data.flights if name not in ranked]


def mean_rmse(data: CampaignData) -> dict[str, dict[str, float]]:
    """Mean RMSE over the links of each setting and flight [dB]; NaN where there is none."""
    known: dict[tuple[str, str], list[float]] = {}
    for row in data.rss:
        if np.isfinite(row.rmse_db):
            known.setdefault((row.setting, row.flight), []).append(row.rmse_db)
    flights, nan = rss_flights(data), float("nan")
    table = {
        setting: {name: float(np.mean(known[setting, name])) if (setting, name) in known else nan for name in flights}
        for setting in data.settings
    }
    return table


def campaign_metrics(data: CampaignData) -> dict[str, Any]:
    """The numbers of the page under stable names; what does not exist is None."""
    failed = {f.flight for f in data.failures}
    result = {
        "campaign": data.name,
        "title": data.title,
        "generated": data.generated,
        "versions": dict(sorted(data.versions.items())),
        "flights": [
            {"flight": name, "ok": name not in failed, "synthetic": name in data.synthetic} for name in data.flights
        ],
        "settings": data.settings,
        "reference": data.reference,
        "failures": _entries(data.failures, ("traceback",)),
        "mean_rmse_db": mean_rmse(data),
        "rss": _entries(data.rss, (*ARRAYS, "difference")),
        "rank": _entries(data.rank),
        "rank_transfers": _entries(data.rank_transfers),
        "calibration": {"per": data.calibration, "groups": _entries(data.pooled)},
        "repeatability": {
            "radius_m": data.radius_m,
            "heading_within_deg": data.heading_within_deg,
            "cell_m": data.cell_m,
            "pairs_total": len(data.repeats),
            "links": by_link(data.repeats),
            "pairs": _entries(telling(data.repeats)),
            "rank_pairs_total": len(data.rank_repeats),
            "rank_pairs": _entries(telling_ranks(data.rank_repeats)),
            "table": f"{PAIR_TABLE}.csv" if data.repeats or data.rank_repeats else None,
        },
        "held_out": {
            "failure": data.held_out_failure or None,
            "folds": [
                {**_entries([fold], ("rows", "curves"))[0], "scores": _entries(fold.rows)} for fold in data.held_out
            ],
            "rank": [{**_entries([fold], ("rows",))[0], "scores": _entries(fold.rows)} for fold in data.held_out_rank],
        },
        "season": {
            "held_out": data.season.held_out,
            "started": data.season.started,
            "ranking": _entries(data.season.ranking),
            "drift": _entries(data.season.drift),
            "places": [{"tower": p.tower, "channel": p.channel, "cells": len(p.n)} for p in data.season.places],
        },
        "workers": data.workers,
        "stages": {f"{name}_s": seconds for name, seconds in data.stages_s.items()},
    }
    safe: dict[str, Any] = json_safe(result)
    return safe


def campaign_frame(data: CampaignData) -> pd.DataFrame:
    """One row per flight, setting, tower and channel (``kind`` rss) or K (``kind`` rank), and per failure."""
    rows: list[dict[str, Any]] = [_rss_line(row) for row in data.rss]
    rows += [_rank_line(row) for row in data.rank]
    rows += [
        {"kind": "failed", "flight": f.flight, "setting": f.setting, "message": f.message} for f in data.failures
    ]  # fmt: skip
    frame: pd.DataFrame = pd.DataFrame(rows, columns=CSV_COLUMNS)
    return frame


CSV_COLUMNS = [
    "kind", "flight", "setting", "tower", "channel", "k", "offset_db", "offset_low_db", "offset_high_db", "rmse_db",
    "rmse_low_db", "rmse_high_db", "free_space_rmse_db", "two_ray_rmse_db", "pooled_offset_db", "pooled_rmse_db", "n",
    "n_out_of_coverage", "held_out_offset_db", "held_out_rmse_db", "correlation", "correlation_low", "correlation_high",
    "at_search_edge", "lag_s", "lag_verdict",
    "fitted", "total_variation", "total_variation_low", "total_variation_high", "agreement", "agreement_low",
    "agreement_high", "kappa", "wasserstein", "best_k", "message",
]  # fmt: skip


def _bounds(name: str, value: tuple[float, float] | None, end: str = "") -> dict[str, float]:
    low, high = value or (float("nan"), float("nan"))
    return {f"{name}_low{end}": low, f"{name}_high{end}": high}


def _rss_line(row: RssRow) -> dict[str, Any]:
    names = (
        "flight", "setting", "tower", "channel", "offset_db", "rmse_db", "pooled_offset_db", "pooled_rmse_db",
        "held_out_offset_db", "held_out_rmse_db", "n", "n_out_of_coverage", "correlation", "at_search_edge", "lag_s",
        "lag_verdict",
    )  # fmt: skip
    return {
        "kind": "rss",
        **{name: getattr(row, name) for name in names},
        **_bounds("offset", row.offset_ci95_db, "_db"),
        **_bounds("rmse", row.rmse_ci95_db, "_db"),
        **_bounds("correlation", row.correlation_ci95),
        **{f"{name}_rmse_db": value for name, value in row.baselines.items()},
        "fitted": " ".join(row.fitted),
    }


def _rank_line(row: RankRow) -> dict[str, Any]:
    names = (
        "flight", "setting", "tower", "k", "n", "n_out_of_coverage", "total_variation", "agreement", "kappa",
        "wasserstein", "best_k",
    )  # fmt: skip
    return {
        "kind": "rank",
        **{name: getattr(row, name) for name in names},
        **_bounds("total_variation", row.total_variation_ci95),
        **_bounds("agreement", row.agreement_ci95),
    }


def repeatability_beside(data: CampaignData) -> list[tuple[Any, float, float]]:
    """Each pair of flights with the RMSE of both under the reference setting."""
    rmse = {row.key: row.rmse_db for row in data.reference_rows}
    return [
        (
            pair,
            rmse.get((pair.first, pair.tower, pair.channel), float("nan")),
            rmse.get((pair.second, pair.tower, pair.channel), float("nan")),
        )
        for pair in data.repeats
    ]


def halves(data: CampaignData) -> list[tuple[RssRow, Repeated | None, Repeated]]:
    """Rows whose first and second half pass the same places: with like headings, and with any."""
    rows = []
    for row in data.reference_rows:
        every = row.within.get("any_heading")
        if every is not None and every.n:
            rows.append((row, row.within.get("same_heading"), every))
    return rows


def headline(data: CampaignData) -> list[str]:
    """The result in a few sentences."""
    out = []
    table = mean_rmse(data)
    means = {s: np.array([v for v in by.values() if np.isfinite(v)]) for s, by in table.items()}
    means = {s: v for s, v in means.items() if len(v)}
    if means:
        best = min(means, key=lambda s: float(means[s].mean()))
        spread = np.ptp([v.mean() for v in means.values()])
        shown = means if len(means) <= FEW_SETTINGS else {best: means[best], data.reference: means.get(data.reference)}
        out.append(
            ("Mean RMSE over flights and links" + ("" if shown is means else f", {len(means)} settings") + ": ")
            + "; ".join(f"{s}: {v.mean():.2f} dB" for s, v in shown.items() if v is not None)
            + (f". Least: {best}." if spread > 0.005 else ".")
        )
    out += _ranked_words(data)
    for setting in data.settings:
        moved = [t for t in data.rank_transfers if t.setting == setting]
        if moved:
            out.append(
                f"Rank, {setting}: at the K that the other flights choose, the total variation is "
                + ", ".join(f"{t.total_variation:.3f} on {t.flight} (K = {k_key(t.k)})" for t in moved)
                + "."
            )
    if data.repeats:
        pairs = [p for p in data.repeats if p.n > 0]
        if pairs:
            mean = float(np.mean([p.rmse_db for p in pairs]))
            share = 100 * float(np.mean([p.share for p in pairs]))
            out.append(
                f"Two flights at the same places differ by {mean:.1f} dB RMS after one constant "
                f"({sum(p.n for p in pairs):,} pairs, {share:.0f} % of the samples)."
            )
        else:
            out.append("No two flights pass the same places within the radius, so there is no repeatability floor.")
    for fold in data.held_out:
        held = [r for r in fold.rows if not r.fitted_here]
        if held:
            out.append(
                f"Fitted on {', '.join(fold.fitted_on)}: on {', '.join(fold.applied_to)} the mean RMSE goes from "
                f"{np.mean([r.start_rmse_db for r in held]):.2f} to {np.mean([r.rmse_db for r in held]):.2f} dB."
            )
    return out + [_rank_fold_words(fold) for fold in data.held_out_rank if fold.applied_to]


def _rank_fold_words(fold: RankHeldOutFold) -> str:
    """What a fit of rank is worth on flights that had no say."""
    held = [r for r in fold.rows if not r.fitted_here]
    kappa = [np.mean([getattr(r, f"{label}_kappa") for r in held]) for label in ("start", "fit")]
    agree = [np.mean([getattr(r, name) for r in held]) for name in ("fit_agreement", "majority_agreement")]
    ties = f"; {len(fold.ties)} other values fit as well" if fold.ties else ""
    return (
        f"Rank fitted on {', '.join(fold.fitted_on)}: on {', '.join(fold.applied_to)} kappa goes from {kappa[0]:.2f} "
        f"to {kappa[1]:.2f}, {100 * agree[0]:.0f} % of the reports agree (always the commonest rank: "
        f"{100 * agree[1]:.0f} %){ties}."
    )


def _ranked_words(data: CampaignData) -> list[str]:
    """What the ranking by held-out error shows, and what it does not."""
    ranking = data.season.over_all()
    if len(ranking) < 2 or not data.season.held_out:
        return []
    first = (
        f"With the offset of the other flights, {ranking[0].setting} has the smallest error "
        f"({ranking[0].mean_db:.2f} dB over {ranking[0].n_flights} flights). "
    )
    return [first + ranking_sentence({entry.setting: entry.verdict for entry in ranking[1:]}, FEW_SETTINGS)]


def warnings(data: CampaignData) -> list[str]:
    """What must be known before the numbers are believed."""
    out = [f"{f.flight} ({f.setting}): {f.message}" for f in data.failures[:FEW]]
    if len(data.failures) > FEW:
        out = [f"{len(data.failures)} flights or settings gave no numbers: they stand under Failures."]
    if data.held_out_failure:
        out.append(f"Held-out fit: {data.held_out_failure}")
    for fold in data.held_out:
        on = ", ".join(fold.fitted_on)
        out += [f"Fitted on {on}: {name} ended at a bound of its values." for name in fold.at_bounds]
        out += [f"Fitted on {on}: {name} has no effect; its value means nothing." for name in fold.without_effect]
        if not fold.applied_to:
            out.append(f"Fitted on {on}: no flight was held out, so every number of the fit is scored on its own data.")
    out += [
        f"{row.flight}, {row.setting}, {row.link}: its antennas were learned from this very log, so it is not scored."
        for row in data.rss
        if LEARNED_HERE in row.fitted
    ]
    out += [
        f"{row.flight}, {row.setting}, {row.link}: the best offset lies at the edge of the searched span."
        for row in data.rss
        if row.at_search_edge
    ]
    out += [
        f"{pair.tower} {pair.channel}: only {100 * pair.share:.0f} % of the samples of {pair.first} have a pair on "
        f"{pair.second}; their repeatability speaks for those places, not for the flights."
        for pair in data.repeats
        if 0 < pair.share < FEW_PAIRS
    ]
    out += [
        f"Pooled offset {group.group}: its members are in different units ({', '.join(group.units)})."
        for group in data.pooled
        if len(group.units) > 1
    ]
    if data.synthetic:
        out.append("Synthetic flights, made by simulation, that measure nothing: " + ", ".join(data.synthetic) + ".")
    return list(dict.fromkeys(out))


def worst_flights(data: CampaignData) -> list[tuple[str, float, str]]:
    """Flights under the first-ranked setting, largest error first: name, mean error over links [dB], worst link."""
    order = data.season.over_all()
    by: dict[str, list[tuple[float, str]]] = {}
    for row in data.rss if order else ():
        error = row.held_out_rmse_db if np.isfinite(row.held_out_rmse_db) else row.rmse_db
        if row.setting == order[0].setting and np.isfinite(error):
            by.setdefault(row.flight, []).append((error, row.link))
    flights = [(name, float(np.mean([e for e, _ in of])), max(of)[1]) for name, of in by.items()]
    return sorted(flights, key=lambda entry: -entry[1])


def verdict(data: CampaignData) -> list[str]:
    """Ray tracing against the baselines under the first setting, and what each mean error is for."""
    rows = [row for row in data.rss if row.setting == next(iter(data.settings)) and np.isfinite(row.rmse_db) and row.n]
    if not rows:
        return []
    total = pooled_db([row.rmse_db for row in rows], [row.n for row in rows])
    every = []
    for name in dict.fromkeys(name for row in rows for name in row.baselines):
        errors = [row.baselines.get(name, np.nan) for row in rows]
        if np.isfinite(errors).all():
            said = [row.verdicts[name] for row in rows if row.verdicts.get(name, "no interval") != "no interval"]
            every.append(
                Judged(ray_db=total, channels=len(rows), name=name, other_db=pooled_db(errors, [row.n for row in rows]),
                       judged=len(said), better=said.count("better"), worse=said.count("worse"),
                       unit="flights x channels")
            )  # fmt: skip
    out = [first_sentence(most_telling(every) if every else Judged(ray_db=total, channels=len(rows)))]
    held = [row.held_out_rmse_db for row in rows if np.isfinite(row.held_out_rmse_db)]
    own = float(np.mean([row.rmse_db for row in rows]))
    if held:
        out.append(
            f"Mean RMSE over flights and links: {own:.2f} dB with each flight's own offset, {np.mean(held):.2f} dB "
            "with the offset of the other flights. Expect the second on a new flight."
        )
    return out


def beside_baselines(row: RssRow) -> str:
    """Baselines that the ray tracing is significantly better and worse than, in one cell."""
    parts = [
        f"{word} than " + ", ".join(pretty(name) for name, said in row.verdicts.items() if said == word)
        for word in ("worse", "better")
        if word in row.verdicts.values()
    ]
    return "; ".join(parts) or ("not significant" if row.verdicts else "\u2013")


def campaign_page(data: CampaignData, pictures: Sequence[Picture], files: Sequence[str]) -> str:
    """The whole page."""
    template = environment().get_template("campaign.html.jinja")
    linked = payload(data)
    code = script("common.js", "campaign_explorer.js") if linked else ""
    text: str = template.render(
        data=data,
        sections=by_section(pictures),
        mean_rmse=mean_rmse(data),
        beside=repeatability_beside(data),
        halves=halves(data),
        headline=headline(data),
        verdict=verdict(data),
        beside_baselines=beside_baselines,
        warnings=warnings(data),
        baselines=list(dict.fromkeys(name for row in data.rss for name in row.baselines)),
        rss_flights=rss_flights(data),
        pretty=pretty,
        files=files,
        season=data.season.over_all(),
        worst=worst_flights(data),
        worst_rows=sorted(data.rss, key=lambda r: -np.nan_to_num(r.rmse_db, nan=-1.0))[:ROWS_SHOWN]
        if len(data.rss) > ROWS_SHOWN
        else data.rss,
        few=FEW,
        many=MANY,
        few_flights=FEW_FLIGHTS,
        rows_shown=ROWS_SHOWN,
        fold_rows=FOLD_ROWS,
        explorer=Markup(as_json(linked)) if linked else "",
        script=Markup(code),
        content_policy=policy(code),
    )
    return text


def write_campaign(
    data: CampaignData, folder: str | Path, *, exports: Sequence[str] = (), progress: Progress = silent
) -> list[Path]:
    """Write ``campaign.html``, ``campaign.json``, ``campaign.csv`` and ``figures/``; gives the files, page first.

    Pairs of flights at the same places stand in ``pairs.csv``, all of them; campaign.json has the telling ones.

    With ``exports`` also the samples of the first setting in those formats
    (:data:`aerpaw_cmp.report.exports.formats.FORMATS`).

    Parameters
    ----------
    data : CampaignData
    folder : str or Path
    exports : sequence of str
        Formats.
    progress : Progress
        Figures done.

    Returns
    -------
    list of Path
    """
    folder = Path(folder)
    indent = 2 if len(data.rss) + len(data.rank) < COMPACT_ROWS else None
    numbers = json.dumps(campaign_metrics(data), indent=indent, ensure_ascii=False, allow_nan=False) + "\n"
    table = campaign_frame(data)
    written = [
        write_file(folder / "campaign.json", numbers),
        write_file(folder / "campaign.csv", guarded(table).to_csv(index=False, lineterminator="\n")),
    ]
    if data.repeats or data.rank_repeats:
        pairs = pair_frame(data)
        written.append(
            write_file(folder / f"{PAIR_TABLE}.csv", guarded(pairs).to_csv(index=False, lineterminator="\n"))
        )
    tables = [path.name for path in written]
    drawn, pictures = canvas.write_figures(campaign_figures.figure_specs(data), folder / "figures")
    written += pictures
    samples = of_campaign(data) if exports else None
    exported = [] if samples is None else write_exports(samples, folder, exports, progress)
    files = [*tables, *(path.relative_to(folder).as_posix() for path in exported)]
    written += exported
    page = write_file(folder / "campaign.html", campaign_page(data, drawn, files))
    return [page, *written]

"""Values that arXiv 2502.10324 states about its maps, beside the same quantity of a run.

Every row quotes the paper on one side; the other side is computed here from the run's own maps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from ...common.units import power_from_db
from ...maps.job import Antennas
from ...maps.study import Study, rank_fields
from ...maps.variogram import PAPER_BIEXPONENTIAL
from ...report.maps_data import PaperRow
from ...report.names import k_key, safe_name
from .coverage_map import MapOutcome

TABLE_II = "Table II"
NEAR_M = 150.0
"""Horizontal distance of "near the tower" in the rows about rank 2."""


def paper_rows(outcome: MapOutcome) -> Iterator[PaperRow]:
    """All rows, in the order of the paper; those of the study only when it was made."""
    yield from _setup(outcome)
    yield from _rss(outcome)
    yield from _rank(outcome)
    if outcome.studies:
        yield from _correlation(outcome)
        yield from _interpolation(outcome)


def _setup(outcome: MapOutcome) -> Iterator[PaperRow]:
    s, site, grid = outcome.settings, outcome.site, outcome.shown.grid
    west, east, south, north = site.area_m
    heights = sorted({tower.antenna_height_m for tower in site.towers.values()})
    watts = power_from_db(s.transmit_power_dbm - 30.0)
    columns, rows = len(grid.east_m), len(grid.north_m)
    ours = {
        "carrier frequency": ("3.4 GHz", f"{s.carrier_hz / 1e9:g} GHz"),
        "height of base stations": ("10 m", ", ".join(f"{h:g} m" for h in heights)),
        "target area": ("1080 m x 2130 m", f"{east - west:g} m x {north - south:g} m"),
        "maximum number of reflections": ("2", str(s.max_depth)),
        "antenna elements": ("4 (TX and RX)", f"{s.elements} (TX and RX)"),
        "element spacing": ("0.5 wavelengths", f"{s.element_spacing:g} wavelengths"),
        "transmit power": ("10 W", f"{float(watts):g} W"),
        "horizontal interval of the UAV": ("30 m", f"{s.spacing_m:g} m"),
        "UAV locations": ("36 x 71 = 2556", f"{columns} x {rows} = {columns * rows}"),
    }
    for what, (paper, here) in ours.items():
        yield PaperRow(where="section VII" if what == "UAV locations" else TABLE_II, what=what, paper=paper, ours=here)
    buildings = sorted({building.material for building in site.buildings}) or ["none"]
    yield PaperRow(
        where="section IV",
        what="materials of buildings and ground",
        paper="itu_concrete, itu_medium_dry_ground",
        ours=f"{', '.join(buildings)}, {site.ground_material} (ITU-R P.2040)",
    )
    tree = site.trees
    yield PaperRow(
        where="section IV",
        what="trees: height and largest diameter",
        paper="20 m and 10 m",
        ours=f"{_spans(tree.height_m)} and {_spans(tree.crown_diameter_m)}, {len(tree)} trees",
    )


def _spans(values: Any) -> str:
    if not len(values):
        return "none"
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:g} m" if low == high else f"{low:g} to {high:g} m"


def _rss_figure(outcome: MapOutcome, antennas: str, height: float) -> str:
    return f"rss_map_{safe_name(f'{antennas}, foliage {outcome.settings.shown}, {height:g} m')}"


def _rss(outcome: MapOutcome) -> Iterator[PaperRow]:
    result, s = outcome.shown, outcome.settings
    if not result.rss_altitudes_m:
        return
    low, high = result.rss_altitudes_m[0], result.rss_altitudes_m[-1]
    figure = _rss_figure(outcome, "MIMO", low)
    blocked = {tower: 1.0 - float(result.coverage("siso", tower)[0]) for tower in result.tower_names}
    worst, best = max(blocked, key=blocked.__getitem__), min(blocked, key=blocked.__getitem__)
    shares = ", ".join(f"{tower} {_percent(share)}" for tower, share in blocked.items())
    yield PaperRow(
        where="Fig. 10", what=f"tower with the largest blocked area ({low:g} m, Z of each tower)", paper="LW3",
        ours=f"{worst} ({shares})", figure=figure,
    )  # fmt: skip
    yield PaperRow(
        where="Fig. 10", what="tower with the least blockage", paper="LW1",
        ours=f"{best}", figure=figure,
    )  # fmt: skip
    alone = [float(np.mean([1.0 - result.coverage("siso", t)[i] for t in result.tower_names])) for i in _rows(result)]
    yield PaperRow(
        where="Fig. 10", what="blockage against height (mean Z of the towers)", paper="falls as the height grows",
        ours=_by_height(result.rss_altitudes_m, alone), figure=f"rss_cdf_{safe_name(f'SISO, foliage {s.shown}')}",
    )  # fmt: skip
    joint = [1.0 - float(share) for share in result.coverage("siso")]
    yield PaperRow(
        where="Fig. 10", what="blockage with joint coverage (Z)",
        paper="significantly reduced at 30 m, none at 70 m and 110 m",
        ours=_by_height(result.rss_altitudes_m, joint), figure=_rss_figure(outcome, "SISO", low),
    )  # fmt: skip
    strong = [_spread(result.rss("siso")[i], 99.0) for i in _rows(result)]
    yield PaperRow(
        where="Fig. 10", what="higher values of joint RSS (99th percentile, SISO)",
        paper="slightly degraded at higher altitudes",
        ours=_by_height(result.rss_altitudes_m, strong, "{:.1f} dBm"), figure=_rss_figure(outcome, "SISO", high),
    )  # fmt: skip
    kinds: tuple[Antennas, Antennas] = ("mimo", "siso")
    widths = [[_spread(result.rss(a)[i], 95.0) - _spread(result.rss(a)[i], 5.0) for i in _rows(result)] for a in kinds]
    yield PaperRow(
        where="Fig. 10", what="range of joint RSS (5th to 95th percentile), MIMO against SISO", paper="wider with MIMO",
        ours="; ".join(
            f"{a.upper()} {_by_height(result.rss_altitudes_m, w, '{:.1f} dB')}"
            for a, w in zip(kinds, widths, strict=True)
        ),
        figure=f"rss_cdf_{safe_name(f'MIMO, foliage {s.shown}')}",
    )  # fmt: skip


def _rows(result: Any) -> range:
    return range(len(result.rss_altitudes_m))


def _spread(values: Any, percentile: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percentile)) if finite.size else float("nan")


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _by_height(heights: Any, values: Any, form: str = "") -> str:
    text = [form.format(v) if form else _percent(v) for v in values]
    return ", ".join(f"{h:g} m: {t}" for h, t in zip(heights, text, strict=True))


def _rank(outcome: MapOutcome) -> Iterator[PaperRow]:
    result = outcome.shown
    if not result.rank_altitudes_m:
        return
    shares = result.rank_shares()
    figure = f"rank_share_{safe_name(f'foliage {outcome.settings.shown}')}"
    if 3.0 in result.rank_altitudes_m:
        row = result.rank_altitudes_m.index(3.0)
        yield PaperRow(
            where="Fig. 12", what="out of coverage at 3 m", paper="more than 60 %", ours=_percent(shares[row, 0, 0]),
            figure=figure,
        )  # fmt: skip
    covered = shares[:, :, 1:].sum(axis=(0, 2))
    one = shares[:, :, 1].sum(axis=0) / np.maximum(covered, 1e-300)
    low = shares[:, :, 1:3].sum(axis=(0, 2)) / np.maximum(covered, 1e-300)
    yield PaperRow(
        where="Fig. 12", what="share of rank 1 among covered positions, all heights", paper="falls as K grows",
        ours=_by_k(result.ks, one), figure=figure,
    )  # fmt: skip
    yield PaperRow(
        where="Fig. 12", what="share of rank 1 or 2 among covered positions", paper="most receiver sites",
        ours=_by_k(result.ks, low), figure=figure,
    )  # fmt: skip
    towers = result.towers_m[result.serving, :2]
    near = np.hypot(*(result.grid.points_m - towers).T) <= NEAR_M
    ranks = result.ranks()
    inside, outside = (
        [_share_above_one(ranks[:, k][:, some]) for k in range(len(result.ks))] for some in (near, ~near)
    )
    yield PaperRow(
        where="Fig. 11", what=f"share of rank 2 or more within {NEAR_M:g} m of the serving tower",
        paper="rank 2 near the tower, an area that widens from K1 to K3",
        ours=f"{_by_k(result.ks, inside)}; beyond: {_by_k(result.ks, outside)}",
        figure=f"rank_map_{safe_name(f'K = {k_key(result.ks[0])}, foliage {outcome.settings.shown}')}",
    )  # fmt: skip


def _share_above_one(ranks: Any) -> float:
    covered = ranks > 0
    return float((ranks > 1).sum() / max(int(covered.sum()), 1))


def _by_k(ks: Any, values: Any) -> str:
    return ", ".join(f"K = {k_key(k)}: {_percent(v)}" for k, v in zip(ks, values, strict=True))


def _correlation(outcome: MapOutcome) -> Iterator[PaperRow]:
    paper = PAPER_BIEXPONENTIAL
    fits = {"zero": "Z as rank 0", "missing": "Z left out"}
    for name in ("c1", "c2", "c3", "c4", "rmse"):
        digits = 4 if name in ("c1", "c3", "rmse") else 5
        yield PaperRow(
            where="Fig. 13",
            what={"rmse": "RMSE of the bi-exponential model"}.get(name, f"{name} of the bi-exponential model"),
            paper=f"{getattr(paper, name):g}",
            ours="; ".join(f"{getattr(outcome.studies[k].fit, name):.{digits}f} ({w})" for k, w in fits.items()),
            figure="correlation",
        )
    at = np.array([30.0, 150.0, 500.0])
    yield PaperRow(
        where="Fig. 13", what="the model at 30 m, 150 m, 500 m", paper=_values(paper(at)),
        ours="; ".join(f"{_values(outcome.studies[k].fit(at))} ({w})" for k, w in fits.items()), figure="correlation",
    )  # fmt: skip


def _values(values: Any) -> str:
    return ", ".join(f"{v:.3f}" for v in values)


def _mean(values: Any) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float("nan")


def _interpolation(outcome: MapOutcome) -> Iterator[PaperRow]:
    s, heights = outcome.settings, rank_fields(outcome.shown)[0]
    study: Study = outcome.studies["random"]
    figure = "mae_leave_one_out_Z_as_rank_0_random_samples"
    yield PaperRow(
        where="section VII-C",
        what="samples M and radius r0",
        paper="20, 150 m",
        ours=f"{s.neighbours}, {s.reach_m:g} m",
    )
    for key, samples, where in (
        ("random", "M random samples within r0", "mae_leave_one_out_Z_as_rank_0_random_samples"),
        ("zero", "the M nearest samples", "mae_leave_one_out_Z_as_rank_0"),
    ):
        scores = outcome.studies[key].scores
        for measure in ("mae", "rmse"):
            means = {name: _mean(getattr(scores[name], measure)) for name in ("Kriging", "makima", "spline")}
            yield PaperRow(
                where="Fig. 14",
                what=f"{measure.upper()} of Kriging, makima, spline, mean over heights and K, {samples}",
                paper="Kriging below both" if measure == "mae" else "not stated",
                ours=", ".join(f"{n} {m:.3f}" for n, m in means.items()), figure=where,
            )  # fmt: skip
        kriging, makima, spline = (scores[name].mae for name in ("Kriging", "makima", "spline"))
        wins = int(((kriging <= makima) & (kriging <= spline)).sum())
        yield PaperRow(
            where="Fig. 14", what=f"combinations of height and K at which Kriging has the least MAE, {samples}",
            paper="all", ours=f"{wins} of {kriging.size}", figure=where,
        )  # fmt: skip
    kriging = study.scores["Kriging"].mae
    by_k = [_mean(column) for column in kriging.T]
    yield PaperRow(
        where="Fig. 14", what="MAE of Kriging by K, M random samples", paper="lowest for K1",
        ours=", ".join(f"K = {k_key(k)}: {m:.3f}" for k, m in zip(outcome.shown.ks, by_k, strict=True)), figure=figure,
    )  # fmt: skip
    worst = [heights[int(np.nan_to_num(kriging[:, column], nan=-1.0).argmax())] for column in range(kriging.shape[1])]
    yield PaperRow(
        where="Fig. 14", what="height with the largest MAE of Kriging, M random samples", paper="30 m for every K",
        ours=", ".join(f"K = {k_key(k)}: {h:g} m" for k, h in zip(outcome.shown.ks, worst, strict=True)), figure=figure,
    )  # fmt: skip


def paper_markdown(rows: Iterable[PaperRow]) -> str:
    """The rows as a Markdown table."""
    lines = ["| where | what | paper | here | figure |", "| --- | --- | --- | --- | --- |"]
    for row in rows:
        figure = f"`figures/{row.figure}.svg`" if row.figure else ""
        lines.append(f"| {row.where} | {row.what} | {row.paper} | {row.ours} | {figure} |")
    return "\n".join(lines) + "\n"

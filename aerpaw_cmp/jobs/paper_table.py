"""Values of the maps in arXiv 2502.10324 compared with the same quantities of a run.

The paper's values are in ``paper_numbers.yaml``. The values of the run are computed here from its maps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from importlib import resources
from typing import Any

import numpy as np
import yaml

from ..common.text import counted
from ..common.units import finite_mean, power_from_db
from ..maps.evaluate import TREATMENTS, kriging_wins, rank_fields
from ..maps.grid import ANTENNAS, PAPER_BUDGET
from ..report.maps import PaperRow
from ..report.texts import k_key
from .coverage_map import INTERPOLATORS, MapOutcome

# Horizontal distance of "near the tower" in the rows about rank 2.
NEAR_M = 150.0


def paper_rows(outcome: MapOutcome) -> Iterator[PaperRow]:
    """Yield all rows in the order of the paper, if the map has the towers and the link budget of the paper.

    Rows of the interpolation study are included only if the study was made.
    """
    if not {f"LW{n}" for n in range(1, 6)} <= set(outcome.site.towers) or outcome.settings.budget != PAPER_BUDGET:
        return
    result = outcome.shown
    heights = result.rss_altitudes_m or (0.0,)
    facts = {"low": f"{heights[0]:g}", "high": f"{heights[-1]:g}", "mode": outcome.settings.shown}
    facts |= {"k": k_key(result.ks[0]), "near": f"{NEAR_M:g}"}
    ours = _setup(outcome)
    if result.rss_altitudes_m:
        ours |= _rss(result)
    if result.rank_altitudes_m:
        ours |= _rank(result)
    if outcome.studies:
        ours |= _correlation(outcome) | _interpolation(outcome)
    stated = yaml.safe_load(resources.files(__package__).joinpath("paper_numbers.yaml").read_text(encoding="utf-8"))
    for key, where, what, paper, *figure in stated:
        if key in ours:
            drawn = "".join(figure).format(**facts)
            yield PaperRow(where=where, what=what.format(**facts), paper=paper, ours=ours[key], figure=drawn)


def _setup(outcome: MapOutcome) -> dict[str, str]:
    s, site, grid = outcome.settings, outcome.site, outcome.shown.grid
    west, east, south, north = site.area_m
    columns, rows = len(grid.east_m), len(grid.north_m)
    buildings = sorted({building.material for building in site.buildings}) or ["none"]
    tree = site.under("opaque").trees
    return {
        "carrier": f"{s.carrier_hz / 1e9:g} GHz",
        "base_height": ", ".join(f"{h:g} m" for h in sorted({t.antenna_height_m for t in site.towers.values()})),
        "area": f"{east - west:g} m x {north - south:g} m",
        "depth": str(s.max_depth),
        "elements": f"{s.elements} (TX and RX)",
        "element_spacing": f"{s.element_spacing:g} wavelengths",
        "power": f"{float(power_from_db(s.budget.tx_power_dbm - 30.0)):g} W",
        "interval": f"{s.spacing_m:g} m",
        "locations": f"{columns} x {rows} = {columns * rows}",
        "materials": f"{', '.join(buildings)}, {site.ground_material} (ITU-R P.2040)",
        "trees": f"{_spans(tree.height_m)} and {_spans(tree.crown_diameter_m)}, {counted(len(tree), 'tree')}",
    }


def _spans(values: Any) -> str:
    if not len(values):
        return "none"
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:g} m" if low == high else f"{low:g} to {high:g} m"


def _rss(result: Any) -> dict[str, str]:
    heights, rows = result.rss_altitudes_m, range(len(result.rss_altitudes_m))
    z_at = {tower: 1.0 - np.asarray(result.coverage("siso", tower), dtype=np.float64) for tower in result.tower_names}
    lowest = {tower: float(shares[0]) for tower, shares in z_at.items()}
    shares = ", ".join(f"{tower} {_percent(share)}" for tower, share in lowest.items())
    widths = {a: [_spread(result.rss(a)[i], 95.0) - _spread(result.rss(a)[i], 5.0) for i in rows] for a in ANTENNAS}
    return {
        "most_blocked": f"{max(lowest, key=lowest.__getitem__)} ({shares})",
        "least_blocked": min(lowest, key=lowest.__getitem__),
        "blockage": _by_height(heights, np.mean(list(z_at.values()), axis=0)),
        "joint_blockage": _by_height(heights, [1.0 - float(share) for share in result.coverage("siso")]),
        "strong": _by_height(heights, [_spread(result.rss("siso")[i], 99.0) for i in rows], "{:.1f} dBm"),
        "widths": "; ".join(f"{a.upper()} {_by_height(heights, w, '{:.1f} dB')}" for a, w in widths.items()),
    }


def _spread(values: Any, percentile: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percentile)) if finite.size else float("nan")


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _by_height(heights: Any, values: Any, form: str = "") -> str:
    return _each((f"{h:g} m" for h in heights), values, form)


def _rank(result: Any) -> dict[str, str]:
    shares = result.rank_shares()
    covered = np.maximum(shares[:, :, 1:].sum(axis=(0, 2)), 1e-300)
    towers = result.towers_m[result.serving, :2]
    near = np.hypot(*(result.grid.points_m - towers).T) <= NEAR_M
    ranks = result.ranks()
    # the share of ranks above 1 among the covered positions
    parts = ([ranks[:, k][:, some] for k in range(len(result.ks))] for some in (near, ~near))
    inside, outside = (_by_k(result.ks, [(r > 1).sum() / max((r > 0).sum(), 1) for r in part]) for part in parts)
    ours = {
        "rank_1": _by_k(result.ks, shares[:, :, 1].sum(axis=0) / covered),
        "rank_1_or_2": _by_k(result.ks, shares[:, :, 1:3].sum(axis=(0, 2)) / covered),
        "rank_2_near": f"{inside}; beyond: {outside}",
    }
    if 3.0 in result.rank_altitudes_m:
        ours["uncovered_3m"] = _percent(shares[result.rank_altitudes_m.index(3.0), 0, 0])
    return ours


def _by_k(ks: Any, values: Any, form: str = "") -> str:
    return _each((f"K = {k_key(k)}" for k in ks), values, form)


def _each(names: Iterable[str], values: Any, form: str) -> str:
    return ", ".join(
        f"{name}: {form.format(v) if form else _percent(v)}" for name, v in zip(names, values, strict=True)
    )


def _correlation(outcome: MapOutcome) -> dict[str, str]:
    at = np.array([30.0, 150.0, 500.0])

    def each(text: Any) -> str:
        return "; ".join(f"{text(outcome.studies[key].fit)} ({words})" for key, words in TREATMENTS.items())

    digits = {"c1": 4, "c2": 5, "c3": 4, "c4": 5, "rmse": 4}
    ours = {name: each(lambda fit, name=name, d=d: f"{getattr(fit, name):.{d}f}") for name, d in digits.items()}
    return ours | {"model": each(lambda fit: ", ".join(f"{v:.3f}" for v in fit(at)))}


def _interpolation(outcome: MapOutcome) -> dict[str, str]:
    s, (heights, _), ks = outcome.settings, rank_fields(outcome.shown), outcome.shown.ks
    names = INTERPOLATORS
    ours = {"samples": f"{s.neighbours}, {s.reach_m:g} m"}
    for key in ("random", "zero"):
        scores = outcome.studies[key].scores
        for measure in ("mae", "rmse"):
            means = [f"{name} {finite_mean(getattr(scores[name], measure)):.3f}" for name in names]
            ours[f"{measure}_{key}"] = ", ".join(means)
    mae = outcome.studies["random"].scores["Kriging"].mae
    ours["wins_zero"] = f"{kriging_wins(outcome.studies['zero'].scores)} of {mae.size}"
    wins = sorted(map(kriging_wins, outcome.draws))
    many = f"{wins[0]} to {wins[-1]}" if wins[0] < wins[-1] else f"{wins[0]}"
    ours["wins_random"] = f"{many} of {mae.size} in {len(wins)} draws"
    worst = np.nan_to_num(mae, nan=-1.0).argmax(axis=0)
    ours["mae_by_k"] = _by_k(ks, [finite_mean(column) for column in mae.T], "{:.3f}")
    ours["worst_height"] = _by_k(ks, [heights[i] for i in worst], "{:g} m")
    return ours

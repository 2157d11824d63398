"""Measure the effect of each part of Lake Wheeler's map and ground on the levels and ranks of every field flight.

Each part is added alone to flat ground without buildings and woods, at one reflection. For levels, the RMSE without the
part is subtracted from the RMSE with it. Each has its own offset, and the comparison is paired (95 %). For ranks,
agreement and total variation are paired, with each eighth of the flight held out in turn (jackknife, 95 %, Student's t
of 7). At the end, the woods' specific attenuation and height are fitted on the four towers of AADM.

Run: AERPAW_CMP_FIELD_DATA=DIR python benchmarks/real_ground.py [--only NAME ...] [--no-fit] [-o FILE]
"""

import argparse
import dataclasses
import os
import sys
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path

import numpy as np
from scipy.stats import t as student

import aerpaw_cmp
from aerpaw_cmp.compare.statistics import paired_difference
from aerpaw_cmp.flight.data import FlightData
from aerpaw_cmp.flight.replay import replay_flight

FLIGHTS = Path(__file__).parents[1] / "tests" / "field"
NAMES = (
    "dataset12_40m", "learned/ds12_40m_fs5MHz", "dataset12_70m", "calibrations/lte50", "calibrations/lte90",
    "nr_rank_flight1", "nr_rank_flight3", "aadm",
    *(f"calibrations/afar{run}" for run in (
        "288_loc_1", "300_loc_1", "300_loc_2", "309_loc_2", "328_loc_1", "328_loc_3",
    )),
)  # fmt: skip

_BARE = {"site.without_buildings": True, "rt.foliage": "none", "rt.max_depth": 1, "rss.field": "power"}
PARTS: dict[str, dict[str, object]] = {
    "buildings": {"site.without_buildings": False},
    "woods as trees": {"rt.foliage": "opaque"},
    "woods as media": {"rt.foliage": "attenuating"},
    "ground heights (offsets)": {"site.tower_ground": "offsets"},
    "ground heights (surface)": {"site.tower_ground": "surface"},
}
EIGHTHS = 8
GAMMAS_DB_PER_M, HEIGHTS_M = (0.1, 0.2, 0.3, 0.47, 0.7, 1.0), (10.0, 15.0, 20.0, 25.0, 30.0)


def flight(name: str) -> aerpaw_cmp.Flight:
    """A field flight as its file has it."""
    return aerpaw_cmp.open_flight(FLIGHTS / f"{name}.yaml", logs_root=os.environ["AERPAW_CMP_FIELD_DATA"])


def variation(measured: np.ndarray, rank: np.ndarray) -> float:
    """Total variation of two samples of ranks."""
    known = np.isfinite(measured) & (rank > 0)
    shares = [np.bincount(x[known].astype(int), minlength=5)[1:5] / max(known.sum(), 1) for x in (measured, rank)]
    return float(np.abs(shares[0] - shares[1]).sum() / 2)


def by_eighths(change: Callable[[np.ndarray], float], rows: int) -> str:
    """A change of rows of a flight and its 95 % interval by the jackknife: each eighth left out in turn."""
    parts = np.array_split(np.arange(rows), EIGHTHS)
    without = np.array([change(np.setdiff1d(np.arange(rows), part)) for part in parts])
    half = student.ppf(0.975, EIGHTHS - 1) * np.sqrt((EIGHTHS - 1) / EIGHTHS * np.sum((without - without.mean()) ** 2))
    middle = change(np.arange(rows))
    return f"{middle:+.3f} [{middle - half:+.3f}, {middle + half:+.3f}]"


def rows_of(name: str) -> Iterator[list[str]]:
    """Rows of the table for a flight."""
    opened, short = flight(name), Path(name).name
    bare = opened.compare(**_BARE).result
    for part, keys in PARTS.items():
        added = opened.compare(**{**_BARE, **keys}).result
        for a, b in zip(bare.rss, added.rss, strict=True):
            errors = [x.measured_db - x.simulated_dbm for x in (b, a)]
            level = paired_difference(*errors)
            low, high = level.difference_ci95_db
            lost = int(np.isnan(errors[0]).sum() - np.isnan(errors[1]).sum())
            change = f"{level.difference_db:+.2f} [{low:+.2f}, {high:+.2f}]"
            yield [short, f"{a.tower} {a.channel}", part, f"{level.other_rmse_db:.2f}", change, str(lost), "", ""]
        for before, after in zip(bare.rank, added.rank, strict=True):
            known = np.isfinite(before.measured)
            for k in (10.0, 100.0):
                seen = before.measured[known]
                first, second = (x.rank[k][known] for x in (before, after))
                agreement = by_eighths(
                    lambda i, s=seen, a=first, b=second: np.mean(b[i] == s[i]) - np.mean(a[i] == s[i]), len(seen)
                )
                shift = by_eighths(
                    lambda i, s=seen, a=first, b=second: variation(s[i], b[i]) - variation(s[i], a[i]), len(seen)
                )
                what = f"{before.tower} rank, K = {k:g}"
                yield [short, what, part, f"{np.mean(first == seen):.3f}", "", "", agreement, shift]


def fit_woods() -> Iterator[str]:
    """Fit attenuation and height of the woods to AADM's towers, with each eighth of the flight held out in turn."""
    data = flight("aadm").replay(**{**_BARE, "rt.foliage": "attenuating"}).data
    rt = data.settings.rt
    errors: dict[str, dict[tuple[float, float], np.ndarray]] = {s.tower: {} for s in data.rss}
    for gamma, height in product(GAMMAS_DB_PER_M, HEIGHTS_M):
        advanced = rt.advanced.model_copy(update={"gamma_db_per_m": gamma})
        settings = data.settings.model_copy(update={"rt": rt.model_copy(update={"advanced": advanced})})
        woods = tuple(dataclasses.replace(wood, height_m=height) for wood in data.site.forests)
        changed: FlightData = dataclasses.replace(
            data, settings=settings, site=dataclasses.replace(data.site, forests=woods)
        )
        for series, replayed in zip(changed.rss, replay_flight(changed).rss, strict=True):
            simulated = np.full(len(series.time), np.nan)
            simulated[replayed.valid] = replayed.replay.rss_power_dbm[:, 0]
            up = replayed.spread(replayed.poses.position_m)[:, 2]
            with np.errstate(invalid="ignore"):
                errors[series.tower][gamma, height] = np.where(up >= 5, series.measured_db - simulated, np.nan)
    yield "| tower | fitted on | RMSE at 0.47, 20 | RMSE left out | gamma [dB/m] by eighth | height [m] by eighth |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for tower, fitted_on in [*((t, (t,)) for t in errors), ("LW3", ("LW4",)), ("LW4", ("LW3",))]:
        left_out, usual, chosen = [], [], []
        parts = np.array_split(np.arange(len(next(iter(errors[tower].values())))), EIGHTHS)
        for part in parts:
            rest = np.setdiff1d(np.arange(sum(map(len, parts))), part)
            best = min(errors[tower], key=lambda size: sum(np.nanvar(errors[t][size][rest]) for t in fitted_on))
            chosen.append(best)
            for sizes, squares in ((best, left_out), ((0.47, 20.0), usual)):
                error = errors[tower][sizes]
                squares.append((error[part] - np.nanmean(error[rest])) ** 2)
        rmse = [float(np.sqrt(np.nanmean(np.concatenate(s)))) for s in (usual, left_out)]
        spread = np.ptp([np.nanvar(error) for error in errors[fitted_on[0]].values()])
        free = spread < 1e-3  # no wood between them
        gammas, heights = ("any" if free else " ".join(f"{size[k]:g}" for size in chosen) for k in (0, 1))
        yield f"| {tower} | {', '.join(fitted_on)} | {rmse[0]:.2f} | {rmse[1]:.2f} | {gammas} | {heights} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=NAMES, choices=NAMES)
    parser.add_argument("--no-fit", action="store_true")
    parser.add_argument("-o", "--out", type=Path)
    options = parser.parse_args()
    lines = [
        "| flight | series | part | without [dB or share] | RMSE [dB] | samples lost | agreement | total variation |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name in options.only:
        for row in rows_of(name):
            lines.append("| " + " | ".join(row) + " |")
            print(lines[-1], file=sys.stderr, flush=True)
    if not options.no_fit:
        lines += ["", *fit_woods()]
    text = "\n".join(lines) + "\n"
    print(text)
    if options.out is not None:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()

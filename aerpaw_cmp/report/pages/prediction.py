"""prediction.html with metrics.json, prediction.csv and prediction.nc."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from ...common.cells import guarded
from ...common.cf import Dataset, file_attributes, netcdf_bytes
from ...common.errors import UsageError
from ...common.jsonable import json_object, named
from ...site.site import Site
from ..content.flight import RANKS
from ..content.made import Made, about
from ..kit.files import write_file
from ..kit.page import write_page
from ..words.prediction import FLAGS
from .places import BAND, LIKELIEST, Places, payload


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictionPage(Made):
    """Content of a page of ``predict``; ``table`` as prediction.csv has it, ``rows`` of candidates and their errors."""

    name: str
    kind: str
    site: Site
    table: pd.DataFrame
    units: Mapping[str, str]
    shape: tuple[int, int] | None
    heights_m: tuple[float, ...]
    verdict: str
    candidates: Sequence[Mapping[str, Any]]
    model: Mapping[str, float]
    chosen: Mapping[str, Any]
    flown: Mapping[str, Any]
    flights: Sequence[str]
    trained_on: Sequence[str]
    marks: Sequence[str]
    warnings: Sequence[str]

    @property
    def series(self) -> list[tuple[str, pd.DataFrame]]:
        """Rows of each tower and channel that has levels."""
        levels = self.table[self.table["channel"] != "rank"]
        each = levels.groupby(["tower", "channel"], sort=False, observed=True)
        return [(f"{t} {c}", part) for (t, c), part in each]


def outside_share(table: pd.DataFrame) -> float:
    """Share of the levels with a position that are flagged as outside the flown places."""
    flag = table["flag"][(table["channel"] != "rank") & (table["flag"] != "no_position")]
    return float((flag == "outside_flown").mean())


def prediction_metrics(data: PredictionPage) -> dict[str, Any]:
    """The numbers of the page under stable names."""
    series = {
        name: {
            "unit": data.units.get(name, ""),
            "points": len(part),
            "mean_level_db": part["level_db"].mean(),
            "mean_sd_db": part["sd_db"].mean(),
            "mean_p_lock": part["p_lock"].mean() if "p_lock" in part else None,
            "share_outside_flown": outside_share(part),
            **{f"share_{flag}": float((part["flag"] == flag).mean()) for flag in FLAGS if flag != "outside_flown"},
        }
        for name, part in data.series
    }
    ranks = data.table[data.table["channel"] == "rank"]
    return json_object(
        prediction=data.name,
        **named(data, "kind flights trained_on marks chosen candidates warnings"),
        sentence=data.verdict,
        field=data.model,
        series=series,
        ranks={
            tower: {k: part[f"p_rank{k}"].mean() for k in "1234"}
            for tower, part in ranks.groupby("tower", observed=True)
        },
        **about(data),
    )


# Rows of prediction.csv that are rounded and written together: bounds the memory.
_ROWS_AT_ONCE = 100_000


def write_prediction(data: PredictionPage, folder: Path) -> tuple[list[Path], list[str]]:
    """Write the page and all files beside it; also what could not be written, and why.

    Parameters
    ----------
    data : PredictionPage
    folder : Path

    Returns
    -------
    files : list of Path
        The page first.
    said : list of str
    """
    numbers = prediction_metrics(data)
    shown = payload(list(_groups(data)), data.site, lines=[np.asarray(line).T for line in data.flown.values()])
    written = write_page(folder, "prediction", numbers, shown, data=data, metrics=numbers, flags=FLAGS)
    digits = {c: 3 for c in data.table.columns if c.endswith(("_db", "_m", "_deg", "_s"))}
    digits |= {c: 4 for c in data.table.columns if c.startswith("p_")}
    with (folder / "prediction.csv").open("w", encoding="utf-8", newline="") as book:
        for start in range(0, len(data.table), _ROWS_AT_ONCE):
            part = guarded(data.table.iloc[start : start + _ROWS_AT_ONCE].round(digits))
            part.to_csv(book, index=False, header=not start, lineterminator="\n")
    written.append(folder / "prediction.csv")
    try:
        written.append(write_file(folder / "prediction.nc", bytes(netcdf_bytes(_dataset(data)))))
    except UsageError as missing:
        return written, [str(missing)]
    return written, []


def _dataset(data: PredictionPage) -> Dataset:
    """Points along one dimension, towers and channels along another."""
    series = data.series
    names, first = [name for name, _ in series], series[0][1]
    variables: dict[str, Any] = {"series": ("series", np.array(names), {"long_name": "tower and channel"})}
    for name, unit in (("time_s", "s"), ("east_m", "m"), ("north_m", "m"), ("height_m", "m"), ("yaw_deg", "degree")):
        variables[name] = ("point", first[name].to_numpy(np.float64), {"units": unit})
    ends = ("level_db", "sd_db", "slow_sd_db", "q05_db", "q95_db")
    for name in (*ends, "p_serving", "p_lock", "locked_db", "locked_sd_db", "lost_db", "lost_sd_db"):
        if name in first:
            values = np.stack([part[name].to_numpy(np.float32) for _, part in series])
            variables[name] = (("series", "point"), values, {"units": "dB" if name.endswith("_db") else "1"})
    variables["level_db"][2]["comment"] = ", ".join(f"{name}: {unit}" for name, unit in data.units.items())
    about = file_attributes(
        f"Predicted levels, {data.name}",
        f"{data.chosen['title']}, learned from {', '.join(data.flights)}",
        data.verdict,
    )
    return Dataset(variables, about)


def _groups(data: PredictionPage) -> Iterator[Places]:
    """Each tower and channel, each receiver of ranks: at each height of a grid, or at all points."""
    groups: list[tuple[str, dict[str, ArrayLike], pd.DataFrame]] = []
    for name, part in data.series:
        level = {f"level [{data.units.get(name, 'dB')}]": part["level_db"], "standard deviation [dB]": part["sd_db"]}
        if "p_lock" in part and part["p_lock"].notna().any():
            level["probability of lock"] = part["p_lock"]
        groups.append((name, {**level, BAND[0]: part["q05_db"], BAND[1]: part["q95_db"]}, part))
    ranks = data.table[data.table["channel"] == "rank"]
    for tower, part in ranks.groupby("tower", sort=False, observed=True):
        chance = part[[f"p_rank{k}" for k in RANKS]].to_numpy(np.float64)
        likeliest = np.where(np.isfinite(chance).all(axis=1), 1 + chance.argmax(axis=1), np.nan)
        each = {f"probability of rank {k}": chance[:, i] for i, k in enumerate(RANKS)}
        groups.append((f"{tower} rank", {LIKELIEST: likeliest, **each}, part))
    for name, values, part in groups:
        at = part[["east_m", "north_m", "height_m"]].to_numpy(np.float64)
        size = len(part) if data.shape is None else data.shape[0] * data.shape[1]
        for k, start in enumerate(range(0, len(part), max(size, 1))):
            some = slice(start, start + size)
            yield Places(
                name=name if data.shape is None else f"{name}, {data.heights_m[k]:g} m",
                at=at[some],
                values={key: np.asarray(column)[some] for key, column in values.items()},
                cell_m=0.0 if data.shape is None else float(np.ptp(at[:size, 0])) / max(data.shape[1] - 1, 1),
                time_s=part["time_s"].to_numpy(np.float64) if data.kind == "route" else None,
            )

"""prediction.html with metrics.json, prediction.csv, prediction.nc and figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ...common.cells import guarded
from ...common.cf import dataset, file_attributes, netcdf_bytes
from ...common.errors import UsageError
from ...common.jsonable import json_object, named
from ...site.site import Site
from ..content.made import Made, about
from ..kit import canvas
from ..kit.canvas import FigureSpec
from ..kit.files import write_file
from ..kit.page import write_page
from ..names import safe_name
from ..words.prediction import FLAGS


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
    written = write_page(folder, "prediction", numbers, _figures(data), data=data, metrics=numbers, flags=FLAGS)
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


def _dataset(data: PredictionPage) -> Any:
    """Points along one dimension, towers and channels along another."""
    series = data.series
    names, first = [name for name, _ in series], series[0][1]
    variables: dict[str, Any] = {"series": ("series", np.array(names), {"long_name": "tower and channel"})}
    for name, unit in (("time_s", "s"), ("east_m", "m"), ("north_m", "m"), ("height_m", "m"), ("yaw_deg", "degree")):
        variables[name] = ("point", first[name].to_numpy(np.float64), {"units": unit})
    for name in ("level_db", "sd_db", "slow_sd_db", "q05_db", "q95_db", "p_serving", "p_lock"):
        if name in first:
            values = np.stack([part[name].to_numpy(np.float32) for _, part in series])
            variables[name] = (("series", "point"), values, {"units": "dB" if name.endswith("_db") else "1"})
    variables["level_db"][2]["comment"] = ", ".join(f"{name}: {unit}" for name, unit in data.units.items())
    about = file_attributes(
        f"Predicted levels, {data.name}",
        f"{data.chosen['title']}, learned from {', '.join(data.flights)}",
        data.generated,
        str(data.versions.get("aerpaw-cmp", "")),
        data.verdict,
    )
    return dataset(variables, about)


# --- figures -------------------------------------------------------------------------------------------------------


def _figures(data: PredictionPage) -> Iterator[FigureSpec]:
    size = 0 if data.shape is None else data.shape[0] * data.shape[1]
    for name, part in data.series:
        for k, height in enumerate(data.heights_m if size else ()):
            yield _map_spec(data, name, part.iloc[k * size : (k + 1) * size], f", {height:g} m")
        if not size:
            yield _map_spec(data, name, part)
            if data.kind == "route":
                yield FigureSpec(
                    f"route_{safe_name(name)}", "routes", f"{name} along the route",
                    "The interval holds one sample in nine of ten cases: model, field, flight, noise and fading.",
                    partial(_draw_profile, data, name, part),
                )  # fmt: skip


def _map_spec(data: PredictionPage, name: str, part: pd.DataFrame, height: str = "") -> FigureSpec:
    return FigureSpec(
        f"map_{safe_name(name + height)}", "maps", name + height,
        f"Median level [{data.units.get(name, 'dB')}] and the standard deviation of one sample [dB]. Grey lines: "
        f"flights that were learned from. Median SD {part['sd_db'].median():.1f} dB.",
        partial(_draw_map, data, part),
    )  # fmt: skip


# Points of a map that are drawn.
_MOST_DOTS = 50_000


def _draw_map(data: PredictionPage, part: pd.DataFrame) -> Figure:
    fig, axes = canvas.subplots((9.2, 5.2), 1, 2, sharex=True, sharey=True)
    east, north = part["east_m"].to_numpy(), part["north_m"].to_numpy()
    for ax, column, label, colours in (
        (axes[0], "level_db", "level [dB]", "viridis"),
        (axes[1], "sd_db", "standard deviation [dB]", "plasma"),
    ):
        values = part[column].to_numpy()
        for line in data.flown.values():
            ax.plot(line[0], line[1], color="0.7", linewidth=0.6, zorder=1)
        if data.shape is None:
            some = slice(None, None, -(-len(values) // _MOST_DOTS))
            shown = ax.scatter(east[some], north[some], c=values[some], s=7, cmap=colours, zorder=2, rasterized=True)
        else:
            grid = [v.reshape(data.shape) for v in (east, north, values)]
            shown = ax.pcolormesh(*grid, cmap=colours, shading="nearest", rasterized=True, zorder=0)
        fig.colorbar(shown, ax=ax, label=label, pad=0.02, shrink=0.85)
        for tower in data.site.towers.values():
            ax.plot(tower.position_m[0], tower.position_m[1], "^", color="black", markersize=5, zorder=3)
        canvas.plan_axes(ax)
        ax.label_outer()
    canvas.frame_around(axes[0], east, north, shape=canvas.plan_shape(east, north))
    return fig


def _draw_profile(data: PredictionPage, name: str, part: pd.DataFrame) -> Figure:
    fig, ax = canvas.subplots((9.2, 3.2))
    time = part["time_s"].to_numpy()
    ax.fill_between(time, part["q05_db"], part["q95_db"], color=canvas.SIMULATED, alpha=0.25, linewidth=0,
                    label="90 % interval of one sample")  # fmt: skip
    ax.plot(time, part["level_db"], color=canvas.SIMULATED, linewidth=1.2, label="median")
    ax.set(xlabel="time along the route [s]", ylabel=f"level [{data.units.get(name, 'dB')}]")
    if "p_lock" in part and part["p_lock"].notna().any():
        share = ax.twinx()
        share.plot(time, part["p_lock"], color="0.4", linewidth=0.9, linestyle=":")
        share.set(ylim=(0.0, 1.0), ylabel="probability of lock (dotted)")
    canvas.legend_below(ax, 2)
    return fig

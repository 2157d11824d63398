"""Maps corrected by flights: raw replay, what ``predict`` says, its standard deviation, ranks of a learned receiver.

Levels are those of the map, in dBm: the mean offset between the flights' logs and the raw replay is taken off.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...common.stages import Stages
from ...common.units import FloatArray
from ...maps.grid import Grid, Layer, class_names
from ...report import maps_data as page
from .predict import RANKS, Prediction, Source, predict
from .where import Asked


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectedLevel:
    """One tower and channel at one height, each (n,) in index order; ``raw_dbm`` with the nose to the north."""

    link: str
    height_m: float
    raw_dbm: FloatArray
    corrected_dbm: FloatArray
    sd_db: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectedMaps:
    """All corrected maps of a run; ``ranks`` by (tower, height): the most probable rank (n,), NaN where unknown."""

    levels: tuple[CorrectedLevel, ...]
    ranks: dict[tuple[str, float], FloatArray]
    flown_m: tuple[FloatArray, ...]
    sentence: str
    outside: float
    """Share of positions beyond the flown places."""
    warnings: tuple[str, ...]

    def layers(self) -> list[Layer]:
        """For the files beside the page."""
        out = []
        for item in self.levels:
            at = f"h{item.height_m:03.0f}m_{re.sub(r'[^0-9A-Za-z]', '_', item.link)}"
            for name, title, unit, values in (
                ("rss_raw", "RSS, raw replay", "dBm", item.raw_dbm),
                ("rss_corrected", "RSS, corrected by flights", "dBm", item.corrected_dbm),
                ("rss_sd", "Standard deviation of the corrected RSS", "dB", item.sd_db),
            ):
                text = f"{title}, {item.link}, {item.height_m:g} m"
                out.append(Layer(f"{name}_{at}", np.round(values, 2), unit, text))
        for (tower, height), rank in self.ranks.items():
            name = f"rank_learned_h{height:03.0f}m_{re.sub(r'[^0-9A-Za-z]', '_', tower)}"
            codes = np.nan_to_num(rank).astype(np.int64)
            out.append(Layer(name, codes, "1", f"Rank, learned receiver, {tower}, {height:g} m", class_names(4)))
        return out

    def page_layers(self, grid: Grid) -> Iterator[page.MapLayer]:
        """For the linked map: raw and corrected level, standard deviation, rank."""
        for item in self.levels:
            axes = {"Link": item.link, "Height": f"{item.height_m:g} m"}
            for version, values in (("corrected", item.corrected_dbm), ("raw", item.raw_dbm)):
                yield page.MapLayer(quantity="RSS, raw and corrected", unit="dBm", axes={"Version": version, **axes},
                                    values=grid.raster(values))  # fmt: skip
            yield page.MapLayer(
                quantity="SD of the corrected RSS", unit="dB", axes=axes, values=grid.raster(item.sd_db)
            )
        for (tower, height), rank in self.ranks.items():
            yield page.MapLayer(
                quantity="Rank, learned receiver",
                unit="",
                axes={"Link": tower, "Height": f"{height:g} m"},
                values=grid.raster(rank),
                classes=class_names(4),
            )

    def rss_maps(self, grid: Grid) -> Iterator[page.RssMap]:
        """For the figures: maps and distributions of both versions."""
        for version in ("raw", "corrected"):
            for item in self.levels:
                values = item.raw_dbm if version == "raw" else item.corrected_dbm
                yield page.RssMap(
                    tower=item.link,
                    antennas=version,
                    altitude_m=item.height_m,
                    rss_dbm=grid.raster(values),
                    coverage=float(np.isfinite(values).mean()),
                )


def corrected_maps(
    site: str,
    spacing_m: float,
    heights_m: Sequence[float],
    flights: Sequence[Path],
    logs_root: Path | None = None,
    stages: Stages | None = None,
) -> CorrectedMaps:
    """Predict a map's grid from flights, beside the raw replay of the same links.

    Parameters
    ----------
    site : str
        As ``map`` takes it.
    spacing_m : float
    heights_m : sequence of float
    flights : sequence of Path
        Flight files to learn from.
    logs_root : Path, optional
    stages : Stages, optional

    Returns
    -------
    CorrectedMaps

    Raises
    ------
    UsageError, InputError
        As :func:`.predict.predict`.
    """
    asked = Asked(heights_m=tuple(heights_m), spacing_m=spacing_m)
    said = predict(Path(site), flights, asked, logs_root=logs_root, stages=stages)
    grid = said.targets.grid
    assert grid is not None
    return CorrectedMaps(
        levels=tuple(one for source in said.sources.values() for one in _levels(said, source, len(grid))),
        ranks=dict(_ranks(said, len(grid))),
        flown_m=tuple(s.position_m[:: max(1, len(s) // 500), :2] for s in said.samples),
        sentence=said.sentence,
        outside=said.outside,
        warnings=said.warnings,
    )


def _levels(said: Prediction, source: Source, n: int) -> Iterator[CorrectedLevel]:
    table = said.table
    mine = table[(table["tower"] == source.series.tower) & (table["channel"] == source.series.channel)]
    position = said.targets.position_m
    north = source.samples(position, np.zeros(len(position)))
    raw = source.replayed_db(north) + source.free_space_db(position)
    errors = []
    for s in said.samples:
        if s.antenna == source.antenna:
            binned = s.binned(4.0)
            errors.append(np.nanmean(binned.residual_db - source.replayed_db(binned)))
    level = mine["level_db"].to_numpy() - float(np.nanmean(errors))
    for k, height in enumerate(said.targets.heights_m):
        part = slice(k * n, (k + 1) * n)
        yield CorrectedLevel(
            link=source.antenna.replace(".", " ", 1),
            height_m=height,
            raw_dbm=raw[part],
            corrected_dbm=level[part],
            sd_db=mine["sd_db"].to_numpy()[part],
        )


def _ranks(said: Prediction, n: int) -> Iterator[tuple[tuple[str, float], FloatArray]]:
    ranks = said.table[said.table["channel"] == "rank"]
    for tower, rows in ranks.groupby("tower", sort=False):
        best = np.full(len(said.targets), np.nan)
        best[rows["point"].to_numpy()] = rows[list(RANKS)].to_numpy().argmax(axis=1) + 1.0
        for k, height in enumerate(said.targets.heights_m):
            yield (str(tower), height), best[k * n : (k + 1) * n]

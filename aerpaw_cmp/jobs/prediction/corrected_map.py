"""Maps corrected by flights: raw replay, what ``predict`` says, its standard deviation, ranks of a learned receiver.

Levels are those of the map, in dBm: the mean offset between the logs and the raw replay is taken off.
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
from ...report import maps as page
from ...report.prediction import PredictionPage
from .predict import RANKS, Prediction, predict
from .sources import NamedFlight, Source
from .where import TargetOptions


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
    """All corrected maps of a run, and the page of the prediction.

    ``ranks``: probabilities (n, 4) by tower and height, NaN where unknown.
    """

    levels: tuple[CorrectedLevel, ...]
    ranks: dict[tuple[str, float], FloatArray]
    prediction: PredictionPage

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
        for (tower, height), p in self.ranks.items():
            name = f"rank_learned_h{height:03.0f}m_{re.sub(r'[^0-9A-Za-z]', '_', tower)}"
            out.append(Layer(name, likeliest(p), "1", f"Rank, learned receiver, {tower}, {height:g} m", class_names(4)))
        return out

    def page_layers(self, grid: Grid) -> Iterator[page.MapLayer]:
        """For the linked map: raw and corrected level, standard deviation."""
        for item in self.levels:
            axes = {"Link": item.link, **page.at_height(item.height_m)}
            for version, values in (("corrected", item.corrected_dbm), ("raw", item.raw_dbm)):
                yield page.MapLayer(quantity="RSS, raw and corrected", unit="dBm", axes={"Version": version, **axes},
                                    values=grid.raster(values))  # fmt: skip
            yield page.MapLayer(
                quantity="SD of the corrected RSS", unit="dB", axes=axes, values=grid.raster(item.sd_db)
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

    def rank_maps(self, grid: Grid) -> Iterator[page.RankMap]:
        """For figures and the linked map: the most probable rank, and mean probabilities as shares."""
        for (tower, height), p in self.ranks.items():
            share = np.concatenate([[np.isnan(p[:, 0]).mean()], np.nan_to_num(p).mean(axis=0)])
            rank = grid.raster(likeliest(p)).astype(np.int64)
            yield page.RankMap(k=None, altitude_m=height, rank=rank, share=share, tower=tower)


def likeliest(p: FloatArray) -> FloatArray:
    """Most probable rank (n,) by probabilities (n, 4); 0 where they are NaN."""
    return np.where(np.isnan(p[:, 0]), 0, np.nan_to_num(p).argmax(axis=1) + 1)


def corrected_maps(
    site: str,
    spacing_m: float,
    heights_m: tuple[Sequence[float], Sequence[float]],
    flights: Sequence[NamedFlight],
    logs_root: Path | None = None,
    stages: Stages | None = None,
) -> CorrectedMaps:
    """Predict a map's grid from flights, beside the raw replay of the same links.

    Parameters
    ----------
    site : str
        As ``map`` takes it.
    spacing_m : float
    heights_m : (sequence of float, sequence of float)
        Of levels, and of ranks.
    flights : sequence of NamedFlight
        To learn from.
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
    options = TargetOptions(heights_m=tuple(sorted({*heights_m[0], *heights_m[1]})), spacing_m=spacing_m)
    prediction = predict(Path(site), flights, options, logs_root=logs_root, stages=stages)
    grid = prediction.targets.grid
    assert grid is not None
    levels = (level for source in prediction.sources.values() for level in _levels(prediction, source, len(grid)))
    return CorrectedMaps(
        levels=tuple(level for level in levels if level.height_m in heights_m[0]),
        ranks={key: p for key, p in _ranks(prediction, len(grid)) if key[1] in heights_m[1]},
        prediction=prediction.page,
    )


def _levels(prediction: Prediction, source: Source, n: int) -> Iterator[CorrectedLevel]:
    table = prediction.table
    mine = table[(table["tower"] == source.tower) & (table["channel"] == source.channel)]
    position = prediction.targets.position_m
    raw = source.replayed_db(source.targets(position, np.zeros(len(position)))) + source.free_space_db(position)
    level = mine["level_db"].to_numpy() - prediction.model.offset_db(source.antenna)
    for k, height in enumerate(prediction.targets.heights_m):
        part = slice(k * n, (k + 1) * n)
        yield CorrectedLevel(
            link=source.antenna.replace(".", " ", 1),
            height_m=height,
            raw_dbm=raw[part],
            corrected_dbm=level[part],
            sd_db=mine["sd_db"].to_numpy()[part],
        )


def _ranks(prediction: Prediction, n: int) -> Iterator[tuple[tuple[str, float], FloatArray]]:
    ranks = prediction.table[prediction.table["channel"] == "rank"]
    for tower, rows in ranks.groupby("tower", sort=False, observed=True):
        p = np.full((len(prediction.targets), 4), np.nan)
        p[rows["point"].to_numpy()] = rows[list(RANKS)].to_numpy()
        for k, height in enumerate(prediction.targets.heights_m):
            yield (str(tower), height), p[k * n : (k + 1) * n]

"""The ``predict`` command as named stages: read, choose, predict, write."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from ...common.errors import UsageError
from ...common.inputs import input_files
from ...common.outputs import OutputFolder
from ...common.stages import Stages
from ...common.versions import versions
from ...flight.settings import load_flight
from ...maps import export
from ...maps.grid import Grid, Layer
from ...report.prediction_html import PredictionPage, prediction_metrics, write_prediction
from ...report.prediction_words import TITLES
from ..options import DEFAULT, JobOutcome, RunOptions
from .predict import Prediction, predict
from .where import Asked


def run_predict(
    where: Path,
    flights: Sequence[Path],
    asked: Asked,
    options: RunOptions = DEFAULT,
    *,
    threshold_db: float | None = None,
) -> JobOutcome:
    """Predict and write ``prediction.csv``, ``.nc``, ``.html`` (of a grid ``.tif``, ``.kmz``) and figures.

    Parameters
    ----------
    where : Path
        See :func:`.where.find_targets`.
    flights : sequence of Path
        Flight files to learn from.
    asked : Asked
    options : RunOptions
        ``out`` is ``reports/prediction-NAME`` by default.
    threshold_db : float, optional

    Returns
    -------
    JobOutcome

    Raises
    ------
    UsageError, InputError
        With what was found, expected, and the likely cause.
    """
    inputs = [where] if where.is_file() else []
    for path in flights:
        inputs += input_files(load_flight(path), path, options.logs_root)
    folder, stages = options.out or Path("reports") / f"prediction-{where.stem}", Stages(options.progress)
    with OutputFolder(folder, job="predict", inputs=inputs, force=options.force) as output:
        prediction = predict(
            where, flights, asked, threshold_db=threshold_db, logs_root=options.logs_root, stages=stages
        )
        record = page_of(prediction, stages.seconds)
        with output.filling() as place:
            options.progress("page")
            written, said = write_prediction(record, place)
            if prediction.targets.grid is not None:
                more, missing = write_maps(prediction, prediction.targets.grid, place)
                written, said = [*written, *more], [*said, *missing]
        for text in said:
            options.progress(text)
    files = tuple(folder / path.relative_to(place) for path in written)
    return JobOutcome(folder=folder, metrics=prediction_metrics(record), files=files)


MOST_CELLS = 50_000
"""Cells of a grid that is also written as pictures for Google Earth."""


def write_maps(prediction: Prediction, grid: Grid, folder: Path) -> tuple[list[Path], list[str]]:
    """prediction.tif and, of smaller grids, prediction.kmz: level and its standard deviation by series and height.

    Parameters
    ----------
    prediction : Prediction
    grid : Grid
        Of its targets.
    folder : Path

    Returns
    -------
    files : list of Path
    said : list of str
        What could not be written, and why.
    """
    heights, layers, n = prediction.targets.heights_m, [], len(grid)
    levels = prediction.table[prediction.table["channel"] != "rank"]
    for (tower, channel), rows in levels.groupby(["tower", "channel"], sort=False):
        for k, height in enumerate(heights):
            part = rows.iloc[k * n : (k + 1) * n]
            unit = prediction.sources[f"{tower}.{channel}"].series.unit
            for name, quantity, of in (("level_db", "Level", unit), ("sd_db", "Standard deviation of the level", "dB")):
                at = f"{name}_h{height:03.0f}m_" + re.sub(r"[^0-9A-Za-z]", "_", f"{tower}_{channel}")
                title = f"{quantity}, {tower} {channel}, {height:g} m"
                layers.append(Layer(at, part[name].to_numpy(np.float64).round(2), of, title))
    towers = {name: tower.position_m.tolist() for name, tower in prediction.site.towers.items()}
    maps = export.MapLayers(grid=grid, frame=prediction.site.frame, layers=layers, towers_m=towers)
    written, said = [], []
    if n <= MOST_CELLS:
        written.append(export.write_kmz(folder / "prediction.kmz", maps, title=prediction.targets.name))
    try:
        written.append(export.write_geotiff(folder / "prediction.tif", maps))
    except UsageError as missing:
        said.append(str(missing))
    return written, said


def page_of(prediction: Prediction, seconds: dict[str, float]) -> PredictionPage:
    """The record of the page."""
    correction, targets = prediction.correction, prediction.targets
    title, field = TITLES[correction.base], correction.title
    return PredictionPage(
        name=targets.name,
        kind=targets.kind,
        site=prediction.site,
        table=prediction.table,
        units={a.replace(".", " ", 1): s.series.unit for a, s in prediction.sources.items()},
        shape=None if targets.grid is None else targets.grid.shape,
        heights_m=targets.heights_m,
        verdict=prediction.sentence,
        candidates=[
            {"base": TITLES[base], "field": name, "rmse_db": correction.rmse_db[base, name], "crps_db": crps}
            for (base, name), crps in sorted(correction.crps_db.items(), key=lambda item: item[1])
        ],
        model=asdict(correction.model),
        chosen={
            "title": f"{title}, {field}",
            "base": correction.base,
            "corrected": correction.on,
            "field": field,
            "sd_factor": correction.sd_factor,
            "rmse_db": correction.rmse_db[prediction.key],
            "crps_db": correction.crps_db[prediction.key],
            "left_out": "flights" if len(correction.flights) > 1 else "300 m blocks",
        },
        flown={
            f"{s.flight} {s.antenna}": np.asarray(s.position_m[:: max(1, len(s) // 500), :2].T)
            for s in prediction.samples
        },
        flights=prediction.flights,
        trained_on=prediction.trained_on,
        threshold_db=prediction.threshold_db,
        warnings=prediction.warnings,
        generated=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        versions=versions(),
        stages_s=dict(seconds),
    )

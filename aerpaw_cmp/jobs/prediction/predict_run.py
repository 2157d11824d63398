"""The ``predict`` command as named stages: read, choose, predict, write."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...common.errors import UsageError
from ...common.outputs import OutputFolder
from ...common.stages import Stages
from ...maps import export
from ...maps.grid import Grid, Layer
from ...report.prediction_html import prediction_metrics, write_prediction
from ..options import DEFAULT, JobOutcome, RunOptions
from .predict import Prediction, predict
from .sources import files_of, named_flights
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
        Flight files, or calibration.yaml files that list some; none: the memory of the site.
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
    known = named_flights(flights)
    inputs = [*([where] if where.is_file() else []), *files_of(known, options.logs_root)]
    folder, stages = options.out or Path("reports") / f"prediction-{where.stem}", Stages(options.progress)
    with OutputFolder(folder, job="predict", inputs=inputs, force=options.force) as output:
        prediction = predict(where, known, asked, threshold_db=threshold_db, logs_root=options.logs_root, stages=stages)
        with output.filling() as place:
            options.progress("page")
            written, said = write_prediction(prediction.page, place)
            if prediction.targets.grid is not None:
                more, missing = write_maps(prediction, prediction.targets.grid, place)
                written, said = [*written, *more], [*said, *missing]
        for text in said:
            options.progress(text)
    files = tuple(folder / path.relative_to(place) for path in written)
    return JobOutcome(folder=folder, metrics=prediction_metrics(prediction.page), files=files)


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
    for (tower, channel), rows in levels.groupby(["tower", "channel"], sort=False, observed=True):
        for k, height in enumerate(heights):
            part = rows.iloc[k * n : (k + 1) * n]
            unit = prediction.sources[f"{tower}.{channel}"].unit
            for name, quantity, of in (("level_db", "Level", unit), ("sd_db", "Standard deviation of the level", "dB")):
                at = f"{name}_h{height:03.0f}m_" + re.sub(r"[^0-9A-Za-z]", "_", f"{tower}_{channel}")
                title = f"{quantity}, {tower} {channel}, {height:g} m"
                layers.append(Layer(at, part[name].to_numpy(np.float64).round(2), of, title))
    towers = {name: tower.position_m.tolist() for name, tower in prediction.page.site.towers.items()}
    maps = export.MapLayers(grid=grid, frame=prediction.page.site.frame, layers=layers, towers_m=towers)
    written, said = [], []
    if n <= MOST_CELLS:
        written.append(export.write_kmz(folder / "prediction.kmz", maps, title=prediction.targets.name))
    try:
        written.append(export.write_geotiff(folder / "prediction.tif", maps))
    except UsageError as missing:
        said.append(str(missing))
    return written, said

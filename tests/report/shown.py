"""The five pages as HTML, from made-up records: for the tests of words and of first screens."""

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from aerpaw_cmp.compare.calibration import Score
from aerpaw_cmp.compare.ladder import ModelRow
from aerpaw_cmp.report import calibration as calibration_html
from aerpaw_cmp.report import campaign as campaign_html
from aerpaw_cmp.report import flight as html
from aerpaw_cmp.report import maps as maps_html
from aerpaw_cmp.report import prediction as prediction_html
from aerpaw_cmp.report.calibration import CalibrationData, sentences
from aerpaw_cmp.report.prediction import cautions, first_sentences
from benchmarks import fabricated

Fixture = Callable[[str], Any]
# Largest number of words in the summary of a page.
MOST_WORDS = 60
# Words of the made-up records themselves.
DATA = (
    "made for a test", "Towers of another source differ by up to 9 m.", "repeated lines were re-expanded from",
    "Tower heights are 10 m.", "A season that was never flown", "samples (expected at least", "settings flights",
    "fields instead of", "a null of the two-ray pattern", "everything else is synthetic", "of woodland covers",
    "two-ray ground", "leave one out",
)  # fmt: skip


def _written(write: Callable[[Any, Path], Any], data: Any, name: str) -> str:
    with tempfile.TemporaryDirectory() as folder:
        write(data, Path(folder))
        return (Path(folder) / f"{name}.html").read_text(encoding="utf-8")


def report(fixture: Fixture) -> str:
    """Return the page of a flight with ten channels, whose table of models by channel is wider than a page."""
    models = (
        ModelRow(model="free space", rmse_heldout_db=9.5, difference_to_best_db=0.0,
                 difference_to_best_ci95_db=(0.0, 0.0), n=1000, seconds=1.0, recommended=True, fastest_sufficient=True, distinct=True),
    )  # fmt: skip
    ladder = tuple(
        dataclasses.replace(models[0], tower=f"LW{i // 2 + 1}", channel=f"USRP{i % 2 + 1}", rmse_heldout_db=5.0 + i)
        for i in range(10)
    )
    return html.page(dataclasses.replace(fixture("report_data"), models=models, ladder=ladder), ["metrics.json"])


def site_map(fixture: Fixture) -> str:
    return maps_html.maps_page(fixture("maps_data"), ["metrics.json"])


def campaign(_: Fixture) -> str:
    return campaign_html.campaign_page(fabricated.season(30, 6, 2, 2), ["campaign.json"])


def calibration(_: Fixture) -> str:
    """Four flights, two channels: 3.5 dB with learned antennas, 6 dB without."""
    scatter = np.random.default_rng(4).normal(0.0, 0.2, (5, 8))

    def scores(learned_db: float, free_db: float, row: int) -> list[Score]:
        return [
            Score(flight=f"F{i // 2}", tower="LW1", channel=f"USRP{i % 2 + 1}", rmse_db=learned_db + scatter[row, i],
                  rmse_4s_db=learned_db - 0.7, free_space_rmse_db=free_db + scatter[4, i],
                  constant_rmse_db=free_db + 2.0, log_distance_rmse_db=free_db + 0.5, n=4000)
            for i in range(8)
        ]  # fmt: skip

    left = {"flight_left_out": scores(3.5, 6.0, 0), "sector_left_out": scores(4.2, 6.3, 1), "heading_left_out": []}
    controls = {
        "body frame, no patterns": scores(3.6, 6.0, 0),
        "world frame at the UAV": scores(5.1, 6.0, 2),
        "heading turned the wrong way": scores(5.6, 6.0, 3),
    }
    as_dicts = [{k: [dataclasses.asdict(s) for s in v] for k, v in part.items()} for part in (left, controls)]
    data = CalibrationData(
        name="lake_wheeler_july", generated="2026-11-21T00:00:00+00:00", flights=["F0", "F1", "F2", "F3"],
        trained_on=["ab" * 32], marks=[], words=sentences(left, controls), warnings=[], scores=as_dicts[0],
        controls=as_dicts[1], mounts={}, strengths={}, antennas=[],
        settings_text="link: {" + ", ".join(f"setting_{i}: {i}" for i in range(200)) + "}",
    )  # fmt: skip
    return _written(calibration_html.write_calibration, data, "calibration")


def prediction(fixture: Fixture) -> str:
    """A route of 400 points under one tower, a third of them outside the flown area."""
    from tests.report.test_prediction_words import FREE, LEARNED, WITH_FIELD, correction

    chosen = correction(LEARNED, {FREE: 6.0, LEARNED: 3.0, WITH_FIELD: 3.1}, 3.0)
    along = np.linspace(0.0, 1.0, 400)
    table = pd.DataFrame(
        {"point": np.arange(400), "time_s": 300 * along, "east_m": 400 * along, "north_m": 100 * along, "height_m": 40.0,
         "yaw_deg": 90.0, "tower": "LW1", "channel": "USRP1", "level_db": -60 - 20 * along, "sd_db": 3.0,
         "slow_sd_db": 2.0, "q05_db": -65 - 20 * along, "q95_db": -55 - 20 * along, "p_serving": 1.0,
         "flag": np.where(along > 0.66, "outside_flown", "")}
    )  # fmt: skip
    data = prediction_html.PredictionPage(
        name="route", kind="route", site=fixture("maps_data").site, table=table, units={"LW1 USRP1": "dBm"}, shape=None,
        heights_m=(40.0,), verdict=first_sentences(chosen, 0.34, 2.0, 5.0), candidates=[], model={"noise_sd_db": 1.0},
        chosen={"title": "antennas learned from the named flights, no correction", "sd_factor": 1.0, "left_out": "flights"},
        flown={}, flights=("F0", "F1"), trained_on=(), marks=(), warnings=cautions(chosen, 0.34),
        generated="2026-11-21T00:00:00+00:00", versions={}, stages_s={},
    )  # fmt: skip
    return _written(prediction_html.write_prediction, data, "prediction")


PAGES: dict[str, Callable[[Fixture], str]] = {
    "report": report, "map": site_map, "campaign": campaign, "calibration": calibration, "prediction": prediction,
}  # fmt: skip

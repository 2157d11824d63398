"""Cells of a phone's log: flight.yaml gives them to towers, the others are left out, and who serves is compared."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from aerpaw_cmp.common.yamlfile import parse_yaml
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.drafting.draft import DraftOptions, draft
from aerpaw_cmp.flight.settings import FlightFile, load_flight
from aerpaw_cmp.jobs.compare_flight import serving_of
from aerpaw_cmp.jobs.flight_run import run_flight
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.report import flight as html
from aerpaw_cmp.report.charts import shown_confusion
from aerpaw_cmp.report.flight import metrics
from aerpaw_cmp.report.flight_data import report_data
from aerpaw_cmp.site.siteyaml import load_site

SAMPLE = Path(__file__).parents[2] / "sample_logs"
ZONE = "America/New_York"


@pytest.fixture
def phone(tmp_path: Path) -> Path:
    """The sample telemetry and a phone that hears three cells, changing from the first to the second half-way."""
    shutil.copy(next((SAMPLE / "UAV").glob("*vehicleOut.txt")), tmp_path / "x_vehicleOut.txt")
    (track,) = ingest(tmp_path, options=ReadOptions(timezone=ZONE))
    time_ms = track.result.streams[0].frame["time"].to_numpy().astype(np.int64)[50:150] / 1e6
    lines = []
    for i, now in enumerate(time_ms.tolist()):
        cells = [
            {
                "technology": "4G_LTE",
                "rsrp": -70 - i,
                "pci": pci,
                "earfcn": 66911,
                "is_connected": str(pci == 1 + i // 50),
            }
            for pci in (1, 2, 7)
        ]
        lines.append(
            json.dumps({"abs_time": now, "companion_abs_time": now, "connected_pci": 1 + i // 50, "cells": cells})
        )
    (tmp_path / "phone.jsonl").write_text("\n".join(lines) + "\n")
    return tmp_path


def flight(folder: Path, cells: str) -> Path:
    path = folder / "flight.yaml"
    path.write_text(
        f"flight: phone\nsite: lake_wheeler\ntimezone: {ZONE}\nlogs:\n  - {{path: x_vehicleOut.txt}}\n"
        f"  - {{path: phone.jsonl, {cells}}}\nlink:\n  rss: {{carrier_hz: 3.4e9, transmit_power_dbm: 40}}\n"
    )
    return path


def test_cells_go_to_the_towers_that_the_flight_file_names(phone: Path) -> None:
    data = load_data(load_flight(flight(phone, "cells: {1: LW1, lte_pci2: LW2, cell 9: LW3}")), phone)
    assert any("no stream is named cell 9: its streams are " in text for text in data.warnings)
    assert [(series.tower, series.channel) for series in data.rss] == [("LW1", "lte_pci1"), ("LW2", "lte_pci2")]
    assert any("1 cell ignored: not listed in 'cells'" in text for text in data.warnings)
    first = data.rss[0].serving
    assert first is not None
    assert first.tolist() == [1.0] * 50 + [0.0] * 50


def test_a_draft_asks_which_tower_has_which_cell(phone: Path) -> None:
    files = ingest(phone, options=ReadOptions(timezone=ZONE))
    text, remarks = draft(files, phone, DraftOptions(timezone=ZONE))
    settings = parse_yaml(text, FlightFile)
    (cells,) = (log.cells for log in settings.logs if log.cells)
    assert set(cells) == {1, 2, 7}
    assert set(cells.values()) <= {*load_site("lake_wheeler").towers, *settings.towers}
    assert any("which PCI?" in remark for remark in remarks)


@pytest.mark.parametrize(("exchanged", "hits"), [(False, 1.0), (True, 0.0)])
def test_serving_cells_are_compared_with_the_strongest_predicted(phone: Path, exchanged: bool, hits: float) -> None:
    data = load_data(load_flight(flight(phone, "cells: {1: LW1, 2: LW2}")), phone)
    right = [np.where(np.arange(100) < 50, -60.0, -70.0), np.where(np.arange(100) < 50, -70.0, -60.0)]
    levels = right[::-1] if exchanged else right
    results = [SimpleNamespace(simulated_dbm=level) for level in levels]
    serving = serving_of(data.rss, results)  # type: ignore[arg-type]
    assert serving is not None
    assert (serving.n, serving.hit_share, serving.majority_share) == (100, hits, 0.5)
    assert serving_of(data.rss[:1], results[:1]) is None, "a single cell leaves no choice"  # type: ignore[arg-type]


def test_the_report_of_a_phone_shows_the_matrix_of_metrics_json(phone: Path) -> None:
    path = flight(phone, "cells: {1: LW1, 2: LW2}")
    outcome = run_flight(load_data(load_flight(path), phone), audit=False)
    record = report_data(outcome.data, outcome.result)
    assert record.serving is not None
    entry = metrics(record)["serving"]
    names, table = shown_confusion(record.serving)
    assert names == entry["cells"]
    assert [list(entry["confusion"][name].values()) for name in names] == table.tolist()
    assert f"<b>{100 * entry['hit_share']:.1f}\N{NARROW NO-BREAK SPACE}%</b> of" in html.page(record, [])

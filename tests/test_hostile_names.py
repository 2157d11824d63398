"""No command writes a name of a stranger's site, flight or log where a spreadsheet would run it as a formula.

Every command of the program runs once on one hostile site and flight, and every table that appears is inspected.
"""

import csv
import gzip
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.text import COMMANDS as SAID
from tests.geojson import collection, feature, polygon
from tests.simulated import simulate, write_yaml

FORMULA = "=HYPERLINK(1)"
AT = {"latitude_deg": 35.72750947, "longitude_deg": -78.69595819}
RING = [[-78.699, 35.727], [-78.6989, 35.727], [-78.6989, 35.7271], [-78.699, 35.7271], [-78.699, 35.727]]
TABLES = {".csv", ".tsv", ".txt", ".dat", ".msi", ".gz"}
# A cell that begins with a number; under another separator than its own a row of numbers is one cell.
NUMBER = re.compile(r"\s*([-+]?(\d[\d.]*([eE][-+]?\d+)?|inf|nan))?\s*([,;\t]|$)")


def raw_formulas(text: str) -> Iterator[str]:
    """Yield cells that begin as a formula and are not numbers, at any usual separator."""
    for separator in ",;\t":
        for row in csv.reader(text.splitlines(), delimiter=separator):
            for cell in row:
                if re.match(r"\s*[=+\-@]", cell) and not NUMBER.match(cell):
                    yield cell


def test_the_search_finds_what_a_spreadsheet_runs() -> None:
    assert list(raw_formulas("a,=1+1\n")) == ["=1+1"]
    assert list(raw_formulas("a;@SUM(A1)\n")) == ["@SUM(A1)"]
    assert list(raw_formulas("-2+cmd|' /C calc'!A0\n")) == ["-2+cmd|' /C calc'!A0"] * 3
    assert not list(raw_formulas("-1.5,+2e-3,'=1+1,a=b,2025-06-01\n-450.0,-450.0,40.0\n"))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site, a flight, its logs and an antenna whose names are all formulas."""
    folder = tmp_path_factory.mktemp("hostile")
    hall = {"name": "@SUM(A1)", "polygon_m": [[60, 60], [80, 60], [80, 80], [60, 80]], "height_m": 6}
    site = {"name": "=1+1", "credit": "=2+2", "origin": AT, "towers": {FORMULA: AT}, "buildings": [hall]}
    write_yaml(folder / "site.yaml", site)
    corners = [(-60, 10, 40), (60, 30, 40), (60, 90, 60), (-60, 90, 60)]
    logs = [
        {"path": "v.txt", "reader": "vehicle_out"},
        {"path": "a.txt", "reader": "sounder_log", "node": FORMULA, "channel": "+A1"},
        {"path": "b.txt", "reader": "sounder_log", "node": FORMULA, "channel": "@B1"},
        {"path": "r.csv", "reader": "quectel_ri", "node": FORMULA},
    ]
    for number in (1, 2):
        plan = {
            "start": f"2025-06-0{number}T10:00:00",
            "seed": number,
            "speed_mps": 2.5,
            "fading_db": 1.0,  # without noise the second flight would be a copy of the first
            "offsets_db": {FORMULA: {"+A1": 4.0, "@B1": 5.0}},
            "waypoints": [{"east_m": e, "north_m": n, "height_m": h, "label": "=A"} for e, n, h in corners],
        }
        content = {
            "flight": {"name": f"f{number}", "title": "=3+3", "synthetic": True, "notes": ["=4+4"], "plan": plan},
            "site": "../site.yaml",
            "timezone": "America/New_York",
            "logs": logs,
            "link": {"rss": {"carrier_hz": 3.3e9, "transmit_power_dbm": 40, "uav_transmits": True}},
            "rt": {"max_depth": 1, "audit_links": 0},
            "rss": {"lag": "off"},
        }
        (folder / f"f{number}").mkdir()
        simulate(write_yaml(folder / f"f{number}" / "flight.yaml", content))
    (folder / "campaign.yaml").write_text("campaign: c\nflights: [f1/flight.yaml, f2/flight.yaml]\n")
    area = feature(polygon(RING), building="yes", name=FORMULA, height="7")
    (folder / "map.json").write_text(json.dumps(collection(area)))
    (folder / "=antenna.csv").write_text(
        "# a, =6+6\nazimuth_deg,elevation_deg,gain_dbi\n"
        + "".join(f"{a},{e},0.0\n" for a in range(0, 360, 60) for e in range(-90, 91, 30))
    )
    return folder


# Every command that writes files, in an order in which later ones may read what earlier ones wrote; {} is the place.
COMMANDS = {
    "ingest": "ingest {}/f1 --timezone America/New_York -o {}/flight.h5 --draft {}/draft.yaml --site {}/site.yaml",
    "report": "report {}/f1/flight.yaml --audit none --kmz --netcdf -o {}/report",
    "campaign": "campaign {}/campaign.yaml -o {}/campaign",
    "calibrate": "calibrate {}/f1/flight.yaml {}/f2/flight.yaml -o {}/calibrated.yaml --into-site {}/site.yaml",
    "predict": "predict {}/site.yaml --with {}/f1/flight.yaml --spacing 200 -o {}/predicted",
    "plan": "plan {}/site.yaml --with {}/f1/flight.yaml -o {}/planned",
    "locate": "locate {}/f1/flight.yaml -o {}/located",
    "channel": "channel {}/f1/flight.yaml --format all -o {}/channel",
    "map": "map {}/site.yaml --quick --with {}/f1/flight.yaml -o {}/map",
    "simulate": "simulate {}/f1/flight.yaml -o {}/simulated",
    "sample": "sample -o {}/sample",
    "site import": "site import {}/map.json --base {}/site.yaml -o {}/imported.yaml",
    "site show": "site show {}/site.yaml -o {}/shown",
    "site export": "site export {}/site.yaml -o {}/exported",
    "antenna export": "antenna export {}/=antenna.csv --carrier 3e9 -o {}/antenna_out.msi",
}


# Commands that write no table: they print, or write JSON lines and logs of their own counters.
WITHOUT_TABLES = {"formats", "explain", "diff", "doctor", "bench", "tap", "modem-sim"}


def test_every_command_is_inspected() -> None:
    groups = {word.split()[0] for word in COMMANDS}
    assert groups | WITHOUT_TABLES == set(SAID)
    assert not {word for word in COMMANDS if word in WITHOUT_TABLES}


@pytest.mark.usefixtures("few_pictures")
def test_no_file_of_any_command_has_a_raw_formula(place: Path) -> None:
    written = {path for path in place.rglob("*") if path.is_file()}
    inspected = dict[str, int]()
    for name, words in COMMANDS.items():
        assert main([word.replace("{}", str(place)) for word in words.split()]) == 0, name
        new = {path for path in place.rglob("*") if path.is_file()} - written
        assert new, name
        for path in (path for path in new if path.suffix in TABLES):
            data = path.read_bytes()
            text = (gzip.decompress(data) if path.suffix == ".gz" else data).decode()
            assert not list(raw_formulas(text)), path
            inspected[name] = inspected.get(name, 0) + 1
        written |= new
    assert set(inspected) >= {"report", "campaign", "calibrate", "predict", "plan", "channel", "map", "simulate"}
    for table in ("report/rss.csv", "channel/channel.csv", "predicted/prediction.csv", "campaign/campaign.csv"):
        assert f"'{FORMULA}" in (place / table).read_text(), f"{table} names the tower"

"""The first report knows the site: drafts use what flights taught, on real logs, and say where they were learned."""

from __future__ import annotations

import hashlib
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.site.learned import folder_of, read_learned
from aerpaw_cmp.site.sphere_pattern import read_sphere_csv

ROOT = os.environ.get("AERPAW_CMP_FIELD_DATA", "")
HERE = Path(__file__).parent / "learned"
pytestmark = [
    pytest.mark.usefixtures("few_pictures"),
    pytest.mark.field,
    pytest.mark.skipif(not ROOT or not Path(ROOT).is_dir(), reason="AERPAW_CMP_FIELD_DATA is not set: no real logs"),
]


def calibrated(name: str, folder: Path, flights: list[str]) -> Path:
    """A site in a folder that remembers the calibration of some flights."""
    content = yaml.safe_load((HERE / f"{name}.yaml").read_text(encoding="utf-8"))
    content["flights"] = [str((HERE / flight).resolve()) for flight in flights or content["flights"]]
    (folder / f"{name}.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    site = folder / "mine.yaml"
    packaged = Path(str(folder_of("lake_wheeler"))).with_suffix(".yaml")
    site.write_bytes(packaged.read_bytes())
    assert main([
        "calibrate", str(folder / f"{name}.yaml"), "--into-site", str(site), "--logs-root", ROOT,
        "-o", str(folder / "calibrated.yaml"),
    ]) == 0  # fmt: skip
    return site


def first_words(folder: Path, site: Path, log: str) -> tuple[str, dict]:
    """First sentences and numbers of a log that is drafted and reported, not a line edited."""
    draft = folder / f"{Path(log).stem}.yaml"
    zone = ["--timezone", "America/New_York"]
    assert main(["ingest", str(Path(ROOT) / log), *zone, "--site", str(site), "--draft", str(draft), "--force"]) == 0
    out = folder / draft.stem
    assert main(["report", str(draft), "-o", str(out), "--audit", "none", "--figures", "none"]) == 0
    page = (out / "report.html").read_text(encoding="utf-8")
    begin = page.index('class="verdict">') + len('class="verdict">')
    return page[begin : page.index("</p>", begin)], json.loads((out / "metrics.json").read_text(encoding="utf-8"))


def test_a_drafted_flight_opens_with_what_other_flights_taught(tmp_path: Path) -> None:
    site = calibrated("dataset12", tmp_path, ["ds12_40m_fs10MHz.yaml", "ds12_40m_fs5MHz.yaml"])
    words, metrics = first_words(tmp_path, site, "dataset12/70m_fs20MHz.mat")
    said = re.search(r"(\d\.\d)(?:\N{NARROW NO-BREAK SPACE}| )dB", words)
    assert said is not None
    assert 3.4 <= float(said[1]) <= 3.9
    for channel in metrics["rss"]["LW1"].values():
        assert 0.8 < channel["error_bars"]["inside_90"] < 0.98
    words, metrics = first_words(tmp_path, site, "dataset12/40m_fs5MHz.mat")
    assert words.startswith("Training flight: ")
    assert {channel["rmse_db"] for channel in metrics["rss"]["LW1"].values()} == {None}


@pytest.mark.parametrize("name", ["dataset12", "lte"])
def test_packaged_numbers_are_what_the_command_gives(name: str, tmp_path: Path) -> None:
    site = calibrated(name, tmp_path, [])
    packaged, made = (read_learned(place).entries[name] for place in ("lake_wheeler", site))
    assert made.trained_on == packaged.trained_on
    assert made.errors is not None
    assert packaged.errors is not None
    for field, value in packaged.errors.model_dump().items():
        assert getattr(made.errors, field) == pytest.approx(value, abs=0.02), field
    assert len(made.series) == len(packaged.series) >= 1
    for one, other in zip(made.series, packaged.series, strict=True):
        for file in ("tower_file", "uav_file"):
            tables = [
                read_sphere_csv(folder_of(place) / getattr(series, file))
                for place, series in ((site, one), ("lake_wheeler", other))
            ]
            theta, phi = np.meshgrid(np.radians(np.arange(5.0, 180.0, 10.0)), np.radians(np.arange(0.0, 360.0, 15.0)))
            gains = [table.gain_dbi(theta, phi) for table in tables]
            assert np.abs(gains[0] - gains[1]).max() < 0.05


@pytest.mark.parametrize("name", ["afar", "nr_rank"])
def test_packaged_entries_name_the_logs_of_the_field_folder(name: str) -> None:
    """Their commands take minutes (``make learned``): here only that they are of these very logs."""
    known = {hashlib.sha256(path.read_bytes()).hexdigest() for path in Path(ROOT).rglob("*") if path.is_file()}
    entry = read_learned("lake_wheeler").entries[name]
    assert len(entry.trained_on) >= 2
    assert set(entry.trained_on) <= known

"""Every file that a report was made from is named with its SHA-256."""

from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import yaml

from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs.tasks import other_inputs

SITE = Path(__file__).parents[2] / "aerpaw_cmp" / "site" / "data" / "lake_wheeler.yaml"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "own").mkdir()
    site = yaml.safe_load(SITE.read_text())
    site["dem"] = {"path": "dem.tif"}
    (tmp_path / "own" / "site.yaml").write_text(yaml.safe_dump(site))
    (tmp_path / "own" / "dem.tif").write_bytes(b"heights")
    azimuth, elevation = np.meshgrid(np.arange(0, 360, 30.0), np.arange(-90, 91, 30.0))
    rows = [f"{a},{e},0" for a, e in zip(azimuth.ravel(), elevation.ravel(), strict=True)]
    (tmp_path / "antenna.csv").write_text("azimuth_deg,elevation_deg,gain_dbi\n" + "\n".join(rows))
    (tmp_path / "flight.yaml").write_text(
        """
flight: test
site: own/site.yaml
logs: [{path: log.txt}]
link: {rss: {carrier_hz: 3.3e9, uav: {antenna: {model: file, file: antenna.csv}}}}
"""
    )
    (tmp_path / "log.txt").write_text("x")
    return tmp_path


def test_every_named_file_is_there_once_with_its_digest(folder: Path) -> None:
    entries = {entry.path: entry for entry in other_inputs(load_flight(folder / "flight.yaml"), folder / "flight.yaml")}
    assert set(entries) == {"flight.yaml", "own/site.yaml", "dem.tif", "antenna.csv"}
    for name, entry in entries.items():
        place = folder / ("own/dem.tif" if name == "dem.tif" else name)
        assert entry.sha256 == sha256(place.read_bytes()).hexdigest()
        assert entry.lines == entry.accepted + entry.rejected + entry.blank == 0
    assert entries["antenna.csv"].role == "link.rss.uav.antenna.file"
    assert entries["dem.tif"].role == "site: dem.path"


def test_a_packaged_site_counts(folder: Path) -> None:
    text = (folder / "flight.yaml").read_text().replace("own/site.yaml", "lake_wheeler")
    (folder / "flight.yaml").write_text(text)
    entries = {entry.path: entry for entry in other_inputs(load_flight(folder / "flight.yaml"), folder / "flight.yaml")}
    packaged = entries["aerpaw_cmp/site/data/lake_wheeler.yaml"]
    assert packaged.sha256 == sha256(SITE.read_bytes()).hexdigest()


def test_a_changed_antenna_changes_the_manifest(folder: Path) -> None:
    def digest() -> str:
        entries = other_inputs(load_flight(folder / "flight.yaml"), folder / "flight.yaml")
        return next(entry.sha256 for entry in entries if entry.path == "antenna.csv")

    before = digest()
    (folder / "antenna.csv").write_text("other")
    assert digest() != before

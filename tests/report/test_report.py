import dataclasses
import json
import subprocess
import sys

import pytest

from aerpaw_cmp.common.stages import Stages
from aerpaw_cmp.report import flight as write
from aerpaw_cmp.report.flight_figures import figure_specs


def test_whole_report(small_report, tmp_path):
    files = write.write_report(small_report, tmp_path)[0]
    assert files[0] == tmp_path / "report.html"
    assert all(f.stat().st_size > 0 for f in files)
    assert (
        json.loads((tmp_path / "metrics.json").read_text())["rss"]["LW4"]["USRP1"]["n"] == small_report.rss[0].score.n
    )
    assert {p.name for p in tmp_path.iterdir()} == {"report.html", "metrics.json", "rss.csv", "rank.csv"}
    assert (tmp_path / "report.html").stat().st_size < 4e6


@pytest.mark.parametrize(("drawn", "suffixes"), [("none", set()), ("svg", {".svg"}), ("all", {".svg", ".png", ".pdf"})])
def test_figures_are_drawn_as_asked(small_report, tmp_path, drawn, suffixes):
    data = dataclasses.replace(small_report, rss=(), pairs=(), rank=())
    files = write.write_report(data, tmp_path, drawn=drawn)[0]
    figures = [f for f in files if f.parent.name == "figures"]
    assert {f.suffix for f in figures} == suffixes
    assert len(figures) == len(suffixes) * len(figure_specs(data))
    assert max((f.stat().st_size for f in figures if f.suffix == ".svg"), default=0) < 900_000


def test_the_seconds_of_the_writing_are_told(small_report, tmp_path):
    stages = Stages()
    with stages("replay"):
        pass
    _, written = write.write_report(small_report, tmp_path, drawn="none", stages=stages)
    numbers = json.loads((tmp_path / "metrics.json").read_text())["stages"]
    assert numbers["report_s"] == written.stages_s["report"] > 0
    assert "replay_s" in numbers


def test_importing_the_room_draws_nothing():
    code = (
        "import sys, aerpaw_cmp.report.columns, aerpaw_cmp.report.flight_figures, aerpaw_cmp.report.flight,"
        " aerpaw_cmp.report.maps, aerpaw_cmp.report.site;"
        "print([m for m in ('matplotlib', 'pandas', 'jinja2', 'sionna') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("drawn", ["none", "svg"])
def test_a_page_names_the_folder_of_pictures_only_if_it_was_written(small_report, tmp_path, drawn):
    data = dataclasses.replace(small_report, rss=(), pairs=(), rank=())
    write.write_report(data, tmp_path, drawn=drawn)
    text = (tmp_path / "report.html").read_text()
    assert ("figures/" in text) == (tmp_path / "figures").is_dir() == (drawn == "svg")
    assert ("with --figures svg" in text) == (drawn == "none")

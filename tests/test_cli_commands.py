"""The commands as a user types them, small: what they print with --json, and what they leave on disk."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.cli.commands.reports import _print_campaign_summary
from aerpaw_cmp.jobs import bench
from tests.geojson import collection, feature, polygon

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "sample_logs"


def out_of(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> str:
    capsys.readouterr()
    assert main([str(a) for a in arguments]) == code, capsys.readouterr().err
    return capsys.readouterr().out


def test_ingest_takes_the_sample_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = tmp_path / "flight.h5"
    options = ("--timezone", "America/New_York", "-o", flight)
    summary = json.loads(out_of(capsys, "ingest", SAMPLE, *options, "--json"))
    assert len(summary["files"]) == 12
    for file in summary["files"]:
        assert file["lines"] == file["accepted"] + file["rejected"] + file["blank"]
        assert set(file["streams"][0]) == {"kind", "name", "rows", "start", "end", "rate_hz", "attributes"}
    assert {Path(s["path"]).name for s in summary["skipped"]} == {"flight.yaml", "truth.json"}
    from aerpaw_cmp.logs.flight_file import read_flight

    stored = {Path(f.path).as_posix(): f for f in read_flight(flight)}
    for file in summary["files"]:
        assert len(stored[file["path"]].result.rejected) == file["rejected"] > 0, "bad lines were planted in each log"
    table = out_of(capsys, "ingest", SAMPLE, *options)
    assert "quectel_ri" in table
    assert "rejected" in table


def test_formats_shows_every_reader(capsys: pytest.CaptureFixture[str]) -> None:
    from aerpaw_cmp.logs.readers import catalogue

    listed = json.loads(out_of(capsys, "formats", "--json"))["readers"]
    assert {r["name"] for r in listed} == {r.name for r in catalogue()}
    logs = [r for r in listed if r["kinds"]]  # the others name files that are not logs
    assert all(r["sample"] for r in logs)
    assert len(logs) >= 29


def test_site_import_and_show(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    barn = [[-78.6975, 35.7280], [-78.6972, 35.7280], [-78.6972, 35.7282], [-78.6975, 35.7282], [-78.6975, 35.7280]]
    wood = [[-78.6990, 35.7290], [-78.6980, 35.7290], [-78.6980, 35.7298], [-78.6990, 35.7298], [-78.6990, 35.7290]]
    features = feature(polygon(barn), building="yes", height="7"), feature(polygon(wood), natural="wood")
    source = tmp_path / "map.geojson"
    source.write_text(json.dumps(collection(*features)))
    site = tmp_path / "site.yaml"
    out_of(capsys, "site", "import", source, "-o", site)
    from aerpaw_cmp.site.siteyaml import load_site

    loaded = load_site(site)
    assert [b.height_m for b in loaded.buildings] == [7.0]
    assert len(loaded.forests) == 1
    assert [wood.height_m for wood in loaded.forests] == [20.0]
    assert len(loaded.trees) == 0
    assert (site.with_suffix(".learned") / "learned.yaml").is_file()  # what its base learned goes with it
    written = out_of(capsys, "site", "show", site, "-o", tmp_path / "show").split()
    assert all(Path(path).stat().st_size > 100 for path in written)
    assert {Path(path).suffix for path in written} >= {".html", ".png", ".svg"}


@pytest.mark.sionna
def test_bench_json(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """``--quick`` requests two numbers of samples, and one is run. The rows are of the same kinds."""
    real = bench.run_bench

    def one_of_them(*, samples: tuple[int, ...], **asked: Any) -> dict[str, Any]:
        assert samples == (1_000, 10_000)
        return real(samples=samples[1:], **asked)

    monkeypatch.setattr(bench, "run_bench", one_of_them)
    result = json.loads(out_of(capsys, "bench", "--quick", "--poses", "6", "--json"))
    wanted = {"engine", "samples", "arrays", "depth", "seconds", "links_per_s", "peak_mib", "missing_paths"}
    wanted |= {"extra_paths", "rss_max_error_db", "rss_rms_error_db", "rank_disagreement"}
    rows = result["replay"]["rows"]
    assert all(wanted <= set(row) for row in rows)
    reference = next(row for row in rows if row["engine"] == "image" and row["depth"] == 2)
    assert reference["rss_max_error_db"] == 0.0
    assert any(row["engine"] == "sionna" and row["rss_max_error_db"] < 1.0 for row in rows)


def test_a_table_too_wide_for_the_terminal_is_text_without_broken_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    from aerpaw_cmp.cli.commands.logs import ACCOUNT
    from aerpaw_cmp.cli.shown import table

    file = "a_rather_long_name_of_a_power_log.txt"
    row = [file, "sounder_log", "rss: power 123456", "123456", "123450", "6", "0", "30.5"]
    row += ["2025-06-01 14:00:00", "711.5"]
    for width in (40, 80, 100, 160):
        table(list(ACCOUNT), [row, row], "files below x", width=width)
        shown = capsys.readouterr().out
        assert max(map(len, shown.splitlines())) <= width
        assert all(shown.count(cell) == 2 for cell in (file, "sounder_log", "123450"))
        assert shown.count("2025-06-01 14:00:00") == 2
    table(["Bias [dB]"], [["[1, 2]"]], "log score [nat]")
    shown = capsys.readouterr().out
    assert all(text in " ".join(shown.split()) for text in ("Bias [dB]", "[1, 2]", "[nat]"))


@pytest.mark.parametrize(("error_db", "explained"), [(3.25, False), (None, True)])
def test_a_campaign_explains_the_dash_of_a_flight_without_a_score(error_db, explained, capsys) -> None:
    metrics = {"mean_rmse_db": {"as written": {"one": 2.5, "two": error_db}}, "rank": [], "season": {"steps": []}}
    _print_campaign_summary(SimpleNamespace(metrics=metrics, folder=Path("reports")))
    printed = " ".join(capsys.readouterr().out.split())
    assert "2.50" in printed
    assert ("dash: not scored, the page states why" in printed) == explained

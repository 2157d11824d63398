"""Outputs of the commands: inputs are unchanged, a set is of one run, a bad ``-o`` is reported first."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
import yaml

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.outputs import SUMS, changed_files, read_sums, sealed
from aerpaw_cmp.flight.settings import load_flight
from tests.geojson import collection, feature, polygon
from tests.simulated import simulate

pytestmark = pytest.mark.usefixtures("few_pictures")

SAMPLE = Path(__file__).parents[2] / "sample_logs"
ZONE = ["--timezone", "America/New_York"]
RING = [[-78.7, 35.727], [-78.6999, 35.727], [-78.6999, 35.7271], [-78.7, 35.727]]
MAP = json.dumps(collection(feature(polygon(RING), building="yes")))


def digests(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """The sample logs, as if they were real: nothing says that they are synthetic."""
    shutil.copytree(SAMPLE, tmp_path / "logs", ignore=shutil.ignore_patterns("truth.json"))
    return tmp_path / "logs"


def refused(capsys: pytest.CaptureFixture[str], folder: Path, *arguments: str | Path, code: int = 2) -> str:
    """Run a command that must fail with one message and leave every file below ``folder`` as it was."""
    before = digests(folder)
    assert main([str(a) for a in arguments]) == code
    error = [line for line in capsys.readouterr().err.splitlines() if line.startswith("aerpaw-cmp: ")]
    assert len(error) == 1, error
    assert digests(folder) == before
    return error[0]


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_ingest_never_replaces_a_log(logs: Path, capsys: pytest.CaptureFixture[str], force: list[str]) -> None:
    log = next(logs.glob("UAV/*vehicleOut.txt"))
    (logs.parent / "soft").symlink_to(log)
    (logs.parent / "hard").hardlink_to(log)
    for target in (log, logs.parent / "soft", logs.parent / "hard"):
        for option in ("-o", "--draft"):
            said = refused(capsys, logs.parent, "ingest", log, *ZONE, option, target, *force)
            assert "would replace an input" in said
    other = next(logs.glob("LW1/USRP1*"))
    assert "would replace an input" in refused(capsys, logs.parent, "ingest", log, other, *ZONE, "-o", other, *force)
    assert "would replace an input" in refused(capsys, logs.parent, "ingest", logs, *ZONE, "-o", other, *force)


def test_ingest_replaces_its_own_flight_file_only(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, target = next(logs.glob("UAV/*vehicleOut.txt")), logs / "flight.h5"
    target.write_text("my notes")
    assert "--force" in refused(capsys, logs, "ingest", log, *ZONE, "-o", target)
    assert main(["ingest", str(log), *ZONE, "-o", str(target), "--force"]) == 0
    assert main(["ingest", str(logs), *ZONE, "-o", str(target)]) == 0  # in the folder of its logs
    both = str(logs.parent / "both")
    assert "two names" in refused(capsys, logs.parent, "ingest", logs, *ZONE, "-o", both, "--draft", both)


def test_site_import_never_replaces_the_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place, site = tmp_path / "g.json", tmp_path / "site.yaml"
    place.write_text(MAP)
    assert "would replace an input" in refused(capsys, tmp_path, "site", "import", place, "-o", place, "--force")
    assert main(["site", "import", str(place), "-o", str(site)]) == 0
    assert main(["site", "import", str(place), "-o", str(site)]) == 0
    assert "input" in refused(capsys, tmp_path, "site", "import", place, "--base", site, "-o", site, "--force")
    site.write_text(site.read_text() + "# checked by me\n")
    assert "--force" in refused(capsys, tmp_path, "site", "import", place, "-o", site)


def test_simulate_replaces_its_own_folder_only(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With real logs in the flight's folder, a folder of simulated logs is a flight that a report accepts."""
    out = logs.parent / "out"
    content = yaml.safe_load((logs / "flight.yaml").read_text())
    del content["flight"]["plan"]["waypoints"][2:]  # 20 s of flight
    (logs / "flight.yaml").write_text(yaml.safe_dump(content))
    assert "contains an input" in refused(capsys, logs, "simulate", logs / "flight.yaml", "-o", logs)
    shutil.copytree(logs / "UAV", out / "UAV")
    said = refused(capsys, out, "simulate", logs / "flight.yaml", "-o", out, "--force")
    assert "did not write" in said
    shutil.rmtree(out)
    for _ in range(2):
        assert main(["simulate", str(logs / "flight.yaml"), "-o", str(out)]) == 0
    assert changed_files(out) == []
    made, given = (load_flight(folder / "flight.yaml") for folder in (out, logs))
    assert made == given
    assert all((out / log.path).is_file() for log in made.logs)
    log = next(out.glob("UAV/*vehicleOut.txt"))
    log.write_bytes(log.read_bytes() + b"\n")
    assert "was changed after" in refused(capsys, out, "simulate", logs / "flight.yaml", "-o", out)


def test_simulate_writes_nothing_outside_its_folder(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (logs / "flight.yaml").read_text()
    log = next(logs.glob("LW1/USRP1*")).relative_to(logs).as_posix()
    for name in (f"../{log}", str(logs / log)):
        (logs / "away.yaml").write_text(text.replace(log, name))
        said = refused(capsys, logs.parent, "simulate", logs / "away.yaml", "-o", logs.parent / "out", "--force")
        assert "no file of its folder" in said


@pytest.fixture
def commands(logs: Path) -> dict[str, list[str]]:
    """Return the arguments of every command that writes a folder, without the folder."""
    (logs / "campaign.yaml").write_text("campaign: c\nflights: [flight.yaml]\n")
    site = logs.parent / "site.yaml"
    place = logs.parent / "g.json"
    place.write_text(MAP)
    assert main(["site", "import", str(place), "-o", str(site)]) == 0
    return {
        "report": ["report", str(logs / "flight.yaml"), "--audit", "none"],
        "campaign": ["campaign", str(logs / "campaign.yaml")],
        "map": ["map", str(site), "--quick"],
        "site show": ["site", "show", str(site)],
    }


@pytest.mark.parametrize("job", ["report", "campaign", "map", "site show"])
def test_a_bad_folder_is_told_before_the_computation(
    job: str, logs: Path, commands: dict[str, Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("the computation began")

    for name in (
        "jobs.campaign.run",
        "jobs.coverage_map.make_maps",
        "report.site.plan",
        "flight.data.gather",  # last: a module that is imported afterwards would keep this function for all later tests
    ):
        monkeypatch.setattr(f"aerpaw_cmp.{name}", never)
    command = commands[job]
    taken, mine = logs.parent / "taken", logs.parent / "mine"
    taken.write_text("a file")
    mine.mkdir()
    (mine / "thesis.tex").write_text("mine")
    capsys.readouterr()
    for target, said in (
        (taken, "in the way"),
        (taken / "below", "in the way"),
        (mine, "did not write"),
        (Path.cwd(), "a folder inside it"),
        (Path(command[1 if job != "site show" else 2]).parent, "input"),
    ):
        assert said in refused(capsys, logs.parent, *command, "-o", target)
    monkeypatch.undo()


def tiny_flight(folder: Path) -> Path:
    """Eight seconds of flight, one log of levels, one of ranks: a report of a few seconds."""
    content = yaml.safe_load((SAMPLE / "flight.yaml").read_text())
    content["flight"]["plan"] |= {
        "waypoints": [{"east_m": -40, "north_m": 10, "height_m": 40}, {"east_m": 40, "north_m": 10, "height_m": 40}],
        "bad_lines": 0,
        "rss_interval_s": 0.2,
        "clock_shift_s": {},
        "offsets_db": {"LW1": {"USRP1": content["flight"]["plan"]["offsets_db"]["LW1"]["USRP1"]}},
    }
    content["logs"] = [
        log for log in content["logs"] if "USRP" not in log["path"] or log["path"].startswith("LW1/USRP1")
    ]
    del content["link"]["channels"]["USRP2"]
    content |= {"rt": {"engine": "image", "max_depth": 1, "audit_links": 0}, "rss": {"lag": "off"}}
    (folder / "flight.yaml").write_text(yaml.safe_dump(content))
    simulate(folder / "flight.yaml")
    return folder / "flight.yaml"


def test_a_tower_inside_a_building_is_named_by_each_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A tower of the site and a node of the flight are inside one building. No path reaches either."""
    flight, site = tiny_flight(tmp_path), tmp_path / "site.yaml"
    content = yaml.safe_load(flight.read_text())
    hall = {"name": "hall", "polygon_m": [[-20, -20], [20, -20], [20, 20], [-20, 20]], "height_m": 30}
    at = {"latitude_deg": 35.72750947, "longitude_deg": -78.69595819}
    site.write_text(yaml.safe_dump({"name": "s", "origin": at, "towers": {"LW1": at}, "buildings": [hall]}))
    flight.write_text(yaml.safe_dump(content | {"site": "site.yaml"}))
    for command in (
        ["report", flight, "--audit", "none"],
        ["channel", flight],
        ["map", site, "--quick"],
        ["site", "show", site],
    ):
        capsys.readouterr()
        main([str(word) for word in (*command, "-o", tmp_path / command[0])])
        said = " ".join(capsys.readouterr().err.split())
        assert "antenna of tower LW1 (10.0 m up) is inside building 'hall' (roof at 30.0 m)" in said, command
    own = yaml.safe_load(flight.read_text().replace("LW1\n", "MINE\n"))
    site.write_text(
        yaml.safe_dump(
            {"name": "s", "origin": at, "towers": {"LW5": {**at, "latitude_deg": 35.73}}, "buildings": [hall]}
        )
    )
    flight.write_text(yaml.safe_dump(own | {"towers": {"MINE": {**at, "antenna_height_m": 5}}}))
    capsys.readouterr()
    main(["report", str(flight), "--audit", "none", "-o", str(tmp_path / "own")])
    assert "antenna of tower MINE (5.0 m up) is inside building 'hall'" in " ".join(capsys.readouterr().err.split())


def test_a_report_is_replaced_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error inside the writing leaves the old set whole."""
    from aerpaw_cmp.report import flight as html

    out = tmp_path / "reports" / "r"
    command = ["report", str(tiny_flight(tmp_path)), "-o", str(out)]
    assert main(command) == 0
    before = digests(out)
    assert set(read_sums(out) or ()) == set(before) - {SUMS}
    assert changed_files(out) == []

    def fail(*_: Any) -> str:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patched:
        patched.setattr(html, "page", fail)  # the last file of the set
        assert main(command) == 3
    assert digests(out) == before
    assert [path.name for path in out.parent.iterdir()] == ["r"]


def test_a_limit_on_the_size_of_files_is_one_message(logs: Path) -> None:
    """HDF5 ended the process here, without a word and with its part left."""
    out = logs.parent / "out"
    out.mkdir()
    script = 'ulimit -f 20; exec "$@"'
    command = [sys.executable, "-m", "aerpaw_cmp", "ingest", str(logs), *ZONE, "-o", str(out / "flight.h5")]
    environ = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}  # Python would keep the bytecode that it could not write
    done = subprocess.run(
        ["bash", "-c", script, "bash", *command], env=environ, capture_output=True, text=True, check=False
    )
    assert done.returncode == 3, done
    assert [line for line in done.stderr.splitlines() if line.startswith("aerpaw-cmp: ")] == done.stderr.splitlines()[
        -1:
    ]
    assert f"{out}/flight.h5: cannot be written (File too large)" in done.stderr
    assert "ulimit -f" in done.stderr
    assert list(out.iterdir()) == []


def test_a_map_that_fails_in_its_exports_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exports were written in place, so a truncated maps.kmz had its final name."""
    out = tmp_path / "map"
    small = ["--spacing", "500", "--rss-altitude", "30", "--rank-altitude", "30", "-k", "10", "--foliage", "none"]
    command = ["map", *small, "--max-depth", "0", "--no-study", "-o", str(out)]
    assert main(command) == 0
    before = digests(out)
    assert zipfile.is_zipfile(out / "maps.kmz")

    def cut(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(zipfile.ZipFile, "writestr", cut)
        assert main(command) == 3
    assert digests(out) == before
    assert [path.name for path in tmp_path.iterdir()] == ["map"]


@pytest.fixture(scope="module")
def own_folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of this tool that later commands read: ``scene`` of ``site.yaml``, ``flown`` with logs of ``away.yaml``."""
    folder = tmp_path_factory.mktemp("own")
    scene, site, small = folder / "scene", folder / "site.yaml", folder / "small.yaml"
    (folder / "g.json").write_text(MAP)
    assert main(["site", "import", str(folder / "g.json"), "-o", str(small)]) == 0
    assert main(["site", "export", str(small), "-o", str(scene)]) == 0
    assert main(["site", "import", str(scene / "scene.xml"), "--base", str(small), "-o", str(site)]) == 0
    assert main(["simulate", str(SAMPLE / "flight.yaml"), "-o", str(folder / "flown")]) == 0
    content = yaml.safe_load((SAMPLE / "flight.yaml").read_text())
    for log in content["logs"]:
        log["path"] = f"flown/{log['path']}"
    (folder / "away.yaml").write_text(yaml.safe_dump(content))
    content["site"] = "site.yaml"
    (folder / "in_scene.yaml").write_bytes(sealed(yaml.safe_dump(content)))
    (folder / "calibration.yaml").write_text("calibration: c\nflights: [away.yaml]\n")
    return folder


@pytest.mark.parametrize(
    "words",
    [
        "predict away.yaml -o flown",
        "calibrate calibration.yaml --score away.yaml -o flown.yaml",
        "calibrate calibration.yaml --score in_scene.yaml -o in_scene.yaml",
        "map site.yaml -o scene",
        "site show site.yaml -o scene",
        "site export site.yaml -o scene",
        "report in_scene.yaml -o scene",
        "simulate in_scene.yaml -o scene",
        "predict site.yaml -o scene",
        "predict lake_wheeler --site site.yaml -o scene",
        "plan site.yaml -o scene",
        "ingest flown/UAV --site site.yaml --timezone UTC --draft site.yaml",
    ],
)
def test_what_a_site_or_a_flight_names_is_never_replaced(
    own_folders: Path, words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Folders that an earlier command wrote are its own and may be replaced, but not by what is made from them."""
    monkeypatch.chdir(own_folders)
    capsys.readouterr()
    assert "input" in refused(capsys, own_folders, *words.split())

"""Recipes of CONTRIBUTING are followed in a copy of the tree: the files that they name suffice."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("## To add\n")[2].partition("\n## ")[0]
RECIPES = dict(re.findall(r"^- \*\*([^*]+)\*\*: (.*?)(?=\n- |\n*\Z)", TEXT, re.MULTILINE | re.DOTALL))

# Text that each file of a recipe receives, after an anchor that it contains.
RAIN = {
    "aerpaw_cmp/flight/settings.py": (
        "    reflection_loss_db: Annotated[float, Field(ge=0)] = 0.0\n",
        "    rain_db_per_km: Annotated[float, Field(ge=0)] = 0.0\n",
    ),
    "aerpaw_cmp/flight/gains.py": (
        "LOSSES: tuple[PathLoss, ...] = (\n",
        "    PathLoss(\n"
        "        name='rain', off={'rain_db_per_km': 0.0},\n"
        "        of=lambda site, rt, hz: lambda paths, sources_m, targets_m: 1e-3 * rt.rain_db_per_km * np.linalg.norm(\n"
        "            targets_m[paths.pose] - sources_m[paths.tower], axis=1),\n"
        "        expected=lambda rt: {'rain_db_per_km': rt.rain_db_per_km},\n"
        "    ),\n",
    ),
    "aerpaw_cmp/propagation/check/reference.py": (
        "    reflection_db: float = 0.0\n",
        "    rain_db_per_km: float = 0.0\n",
    ),
    "aerpaw_cmp/propagation/check/reference.py: Reference.loss_db": (
        "        total = self.loss.reflection_db * len(sequence)\n",
        "        total += 1e-3 * self.loss.rain_db_per_km * math.dist(self.source, target)\n",
    ),
}
# Prints the levels without and with rain, the terms of explain, the second way, and a model of the comparison.
RAIN_SCRIPT = """
import json, sys
import numpy as np
from pathlib import Path
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.gains import load_with_learned, path_loss, without_losses
from aerpaw_cmp.flight.replay import replay_flight
from aerpaw_cmp.jobs.audit_flight import expectations
from aerpaw_cmp.jobs.flight_run import Model
from aerpaw_cmp.propagation.check.reference import Reference
import aerpaw_cmp.jobs.explain as explain
flight = Path("flight.yaml").resolve()
levels = []
for rain in (0.0, 10.0):
    settings = load_with_learned(flight, overrides={"rt.rain_db_per_km": rain, "rt.max_depth": 0, "rt.audit_links": 0})
    data = load_data(settings, flight.parent, None)
    replays = replay_flight(data)
    one = replays.rss[0]
    levels.append(one.replay.rss_dbm[:, 0])
site, rt, expected = data.site, settings.rt, expectations(data, replays.all)[0]
source, target = one.source_m(site)[0], one.poses.position_m[0]
losses = explain.path_losses(site, rt, one.link.carrier_hz)
further = {name: loss(one.replay.paths, source[None], one.poses.position_m) for name, loss in losses.items()}
paths = explain.explain_paths(one.replay.paths, one.replay.faces, source, one.poses, one.link, further)
reference = Reference(site, one.replay.towers[0], expected.link, expected.loss)
print(json.dumps({
    "km": float(np.linalg.norm(target - source)) / 1000, "lost_db": float((levels[0] - levels[1])[0]),
    "terms": list(paths[0].terms_db), "second_db": reference.loss_db((), tuple(map(float, target))),
    "model": rt.model_copy(update=without_losses() | Model().settings(1)["rt"]).rain_db_per_km,
}))
"""

# A command that prints the number of lines of a file.
COUNT = {
    "aerpaw_cmp/common/text.py": ("COMMANDS: dict[str, str] = {\n", '    "count": "Count the lines of a file.",\n'),
    "aerpaw_cmp/cli/commands/logs.py": (
        "\n\n@command(\n",
        '    "count", examples=["aerpaw-cmp count power.txt"]\n)\n'
        "def count(file: Annotated[Path, Argument(metavar='FILE')]) -> int:\n"
        '    """Count lines."""\n'
        "    from ...jobs.count import count_lines\n\n"
        "    lines = count_lines(file)\n"
        "    if not answered({'lines': lines}):\n"
        "        say(f'{lines} lines')\n"
        "    return 0\n\n\n@command(\n",
    ),
}
JOB = '''
from pathlib import Path

from ..common.errors import InputError


def count_lines(file: Path) -> int:
    """Return the number of lines of a file."""
    try:
        return len(file.read_text(encoding="utf-8").splitlines())
    except OSError as error:
        raise InputError("the file cannot be read", cause=str(error.strerror), path=file) from None
'''


def named(recipe: str) -> set[str]:
    """Return the files that a recipe names, and the files in the folders that it names."""
    paths = re.findall(r"`([\w./]+)`", RECIPES[recipe])
    folders = [path for path in paths if (ROOT / path).is_dir()]
    names = [path for path in paths if path.endswith((".py", ".md"))]
    inside = {f"{folder}/{name}" for folder in folders for name in names if (ROOT / folder / name).is_file()}
    return {name for name in names if (ROOT / name).is_file()} | inside


def copy_with(patches: dict[str, tuple[str, str]], recipe: str, folder: Path) -> Path:
    """Copy the packages, and add a text to files that the recipe names."""
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "aerpaw_cmp", folder / "aerpaw_cmp", ignore=ignored)
    shutil.copytree(ROOT / "parsers", folder / "parsers", ignore=ignored)
    for place, (anchor, text) in patches.items():
        name = place.partition(":")[0]
        assert name in named(recipe), f"CONTRIBUTING does not name {name} for {recipe}"
        content = (folder / name).read_text(encoding="utf-8")
        assert anchor in content, place
        (folder / name).write_text(content.replace(anchor, anchor + text, 1), encoding="utf-8")
    return folder


def run(tree: Path, *arguments: str, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join((str(tree), str(tree / "parsers")))
    environment = os.environ | {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder or tree, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("recipe", RECIPES)
def test_each_recipe_names_files_that_exist(recipe: str) -> None:
    assert set(RECIPES) >= {"A reader", "A path loss", "A kind of path", "A command"}
    paths = [path for path in re.findall(r"`([\w/]+/[\w./]+)`", RECIPES[recipe]) if "." in path or path.count("/") > 1]
    assert paths, recipe
    for path in paths:
        assert (ROOT / path).exists(), path


def test_a_path_loss_is_declared_once(tmp_path: Path) -> None:
    """Replay, explain, audit and model comparison know a loss that is in the files of the recipe only."""
    assert {"docs/flight_yaml.md", "docs/equations.md"} <= named("A path loss")
    tree = copy_with(RAIN, "A path loss", tmp_path)
    done = run(tree, "-c", RAIN_SCRIPT, folder=ROOT / "sample_logs")
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert seen["lost_db"] == pytest.approx(10.0 * seen["km"], abs=1e-6)
    assert "rain" in seen["terms"]
    assert seen["second_db"] == pytest.approx(seen["lost_db"], abs=1e-6)
    assert seen["model"] == 0.0


def test_a_command_is_a_line_a_function_and_a_job(tmp_path: Path) -> None:
    assert {"docs/architecture.md", "tests/test_cli_conventions.py"} <= named("A command")
    tree = copy_with(COUNT, "A command", tmp_path)
    (tree / "aerpaw_cmp" / "jobs" / "count.py").write_text(JOB)
    (tmp_path / "log.txt").write_text("a\nb\n")
    assert re.search(r"^  count +Count the lines of a file.$", run(tree, "-m", "aerpaw_cmp", "--help").stdout, re.M)
    done = run(tree, "-m", "aerpaw_cmp", "count", str(tmp_path / "log.txt"), "--json")
    assert (done.returncode, json.loads(done.stdout)) == (0, {"schema": 1, "lines": 2}), done.stderr
    missing = run(tree, "-m", "aerpaw_cmp", "count", str(tmp_path / "nope.txt"))
    assert (missing.returncode, "the file cannot be read" in missing.stderr) == (3, True)

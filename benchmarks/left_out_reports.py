"""Reports of real flights that the site has not seen: each is drafted as it comes, with what the others taught.

Each flight that the packaged site learned from is left out of its entry, the entry is learned anew from the others, the
flight's log is drafted and reported with no line edited, and the page's first sentence and its numbers are printed:
RMSE as logged and over 4 s, share inside the 90 % interval, all samples with the receiver's floor, P(locked), rank.
With ``--thirds`` the flights at LW1 are cut in three, and each third is drafted and reported alone.
Goals, means over series: dataset 12 3.4 dB as logged, 2.8 over 4 s; LTE 5.8 and 3.4; thirds as with their tower named
by hand (3.41, 5.76), none with an invented node; AFAR 8.3 with the floor, CRPS 6.5; 90 % intervals hold 87-93 %; NR
kappa .35, log score 15 % below the constant.

    python benchmarks/left_out_reports.py FIELD [--only TEXT] [--keep FOLDER] [--thirds]
"""

import argparse
import contextlib
import html
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from scipy.io import loadmat, savemat

from aerpaw_cmp.compare.calibration import SPLITS, Learned, Score, flight_left_out, flights_of, learn
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs.calibrate import (
    Calibration,
    GroundFit,
    learned_locks,
    load_calibration,
    observe,
    read_flights,
    recipe_of,
)
from aerpaw_cmp.jobs.calibrate_rank import fit_rank, samples_by_tower
from aerpaw_cmp.jobs.calibration_files import Calibrated, site_entry
from aerpaw_cmp.site.learned import folder_of, remember

RECIPES = Path(__file__).parents[1] / "tests" / "field" / "learned"
TIMEZONE = "America/New_York"
_NO_RAY = GroundFit(roughness_m=(float("inf"),), log_likelihood=(0.0,))  # drafts have none
NAMES = ("dataset12", "lte", "afar", "nr_rank")


def site_without(recipe: Path, flight: str, field: Path, folder: Path) -> Path:
    """A copy of the packaged site in a folder whose entry of a calibration was learned without one of its flights."""
    content = yaml.safe_load(recipe.read_text(encoding="utf-8"))
    content["flights"] = [str((recipe.parent / name).resolve()) for name in content["flights"] if name != flight]
    path = folder / f"{recipe.stem}.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    packaged, site = folder_of("lake_wheeler"), folder / "site.yaml"
    shutil.copytree(packaged, folder_of(site), dirs_exist_ok=True)
    shutil.copyfile(packaged.with_suffix(".yaml"), site)
    settings = load_calibration(path)
    flights, _ = read_flights(settings, path.parent, field)
    ranked = fit_rank(samples_by_tower(flights)) if settings.rank else None
    observed, _ = observe(flights)
    chosen = recipe_of(settings, observed, field)
    scores: dict[str, tuple[Score, ...]] = dict.fromkeys(SPLITS, ())
    learned: dict[str, Learned] = {}
    if len(flights_of(observed)) > 1:  # the errors to expect; the other splits and the controls are not read
        scores["flight_left_out"] = flight_left_out(observed, chosen, learned)
    calibration = Calibration(
        settings=settings, flights=tuple(flights), observed=tuple(observed), scores=scores, controls={},
        learned=learn([o.samples for o in observed], chosen), curve=(), ground=_NO_RAY, warnings=(), words=(),
        locks=learned_locks(observed, chosen, learned),
    )  # fmt: skip
    calibrated = Calibrated(settings, tuple(flights), (), calibration, ranked, "left out")
    remember(site, recipe.stem, *site_entry(calibrated))
    return site


def reported(log: Path, site: Path, folder: Path) -> tuple[str, dict[str, Any]]:
    """First sentence of a report of the draft, and its metrics."""
    flight, out = folder / "flight.yaml", folder / "report"
    draft = ["ingest", log, "--timezone", TIMEZONE, "--site", site, "--draft", flight, "--force"]
    for words in (draft, ["report", flight, "-o", out, "--figures", "none", "--audit", "none", "--force"]):
        done = subprocess.run([sys.executable, "-m", "aerpaw_cmp", *map(str, words)], capture_output=True, text=True)
        if done.returncode:
            return f"{words[0]}: exit {done.returncode}: {done.stderr.strip()[-300:]}", {}
    page = (out / "report.html").read_text(encoding="utf-8")
    first = re.search(r'class="verdict">(.*?)</p>', page, re.DOTALL)
    return html.unescape(first[1]) if first else "no sentence", json.loads((out / "metrics.json").read_text())


def thirds(log: Path, folder: Path) -> Iterator[Path]:
    """The three parts of a merged table; each column is cut by its own length."""
    columns = {name: value.ravel() for name, value in loadmat(log).items() if not name.startswith("__")}
    for part in range(3):
        cut = {name: v[part * v.size // 3 : (part + 1) * v.size // 3] for name, v in columns.items()}
        savemat(out := folder / f"{log.stem}_part{part + 1}.mat", cut)
        yield out


def rows(metrics: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, float]]]:
    """Numbers of each series of a report."""
    for tower, channels in metrics.get("rss", {}).items():
        for channel, entry in channels.items():
            numbers = {"RMSE": entry["rmse_db"], "free space": entry["baselines"]["free_space"]["rmse_db"]}
            with contextlib.suppress(KeyError):
                numbers["4 s"] = entry["averaged"]["power_sum"]["4 s"]["rmse_db"]
            bars = entry.get("error_bars") or {}
            numbers |= {"inside 90 %": bars.get("inside_90"), "CRPS": bars.get("crps_db")}
            if lock := entry.get("detection"):
                numbers |= {"floor": lock["rmse_db"], "floor, free space": lock["free_space_rmse_db"]}
                numbers |= {f"P(detected) {name}": lock[name] for name in
                            ("brier", "constant_brier", "log_score", "constant_log_score")}  # fmt: skip
            yield f"{tower} {channel}", {name: value for name, value in numbers.items() if value is not None}
    for tower, entry in metrics.get("rank", {}).items():
        score = entry.get("receiver") or {}
        names = ("kappa", "log_score", "constant_log_score", "total_variation_expected")
        yield f"rank {tower}", {name: score[name] for name in names if score.get(name) is not None}


def show(log: Path, sentence: str, metrics: Mapping[str, Any], means: dict[str, list[float]]) -> None:
    """Print a report's first sentence and its numbers, and add these to the lists of which the means are taken."""
    print(f"{log.parent.name}/{log.name}: {sentence}", flush=True)
    for name, numbers in rows(metrics):
        print(f"    {name}: " + ", ".join(f"{key} {value:.3g}" for key, value in numbers.items()))
        for key, value in numbers.items():
            means.setdefault(key, []).append(value)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = os.environ.get("AERPAW_CMP_FIELD_DATA")
    parser.add_argument("field", type=Path, nargs="?" if known else None, default=known, help="folder of real logs")
    parser.add_argument("--only", default="", help="flight files whose path holds this")
    parser.add_argument("--keep", type=Path, help="folder that holds what was learned, for the next run")
    parser.add_argument("--thirds", action="store_true", help="of the flights at LW1, each third alone")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        for name in NAMES[: 2 if asked.thirds else None]:
            recipe, means = RECIPES / f"{name}.yaml", dict[str, list[float]]()
            for flight in yaml.safe_load(recipe.read_text(encoding="utf-8"))["flights"]:
                if asked.only not in f"{name}/{flight}":
                    continue
                folder = (asked.keep or Path(scratch)) / name / Path(flight).stem
                site = folder / "site.yaml"
                if not site.is_file():
                    folder.mkdir(parents=True, exist_ok=True)
                    site_without(recipe, flight, asked.field, folder)
                log = asked.field / load_flight(recipe.parent / flight).logs[0].path
                for part in thirds(log, folder) if asked.thirds else [log]:
                    show(part, *reported(part, site, folder), means)
            if means:
                text = ", ".join(f"{key} {sum(each) / len(each):.3f}" for key, each in means.items())
                print(f"{name}, means over series: {text}", flush=True)


if __name__ == "__main__":
    main()

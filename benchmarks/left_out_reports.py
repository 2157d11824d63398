"""Reports of real flights that the site has not seen, and the joint calibration on held-out flights and campaigns.

Each training flight of the packaged site is held out, and the site is learned again from the others. The flight's log
is then drafted and reported without editing the draft. The script prints the first sentence of the page and its
numbers: RMSE as logged and over 4 s, share inside the 90 % interval, RMSE of all samples with the receiver's floor,
P(lock), rank.

With ``--thirds`` the flights at LW1 are cut in three, and each third is drafted and reported alone. With ``--raw`` the
flights of dataset 12 are written as AERPAW writes them: a power log per channel, and a vehicle log. With ``--locate``
the rover of each AFAR flight is located by its levels, without learned antennas and with those of the other flights.
With ``--teachers`` a site learns from one campaign only, and the script prints the antennas that it proposes for the
flights of the others. NR and AFAR are controls: their antennas must not be proposed, nor other antennas for NR.

At the end, or alone with ``--joint``, the calibration of all campaigns of one airframe is scored on held-out campaigns,
flights, heights, sectors and headings. This is done with and without the one flight of AADM, and with rotated copies as
a control. The goals are printed, too.

    python benchmarks/left_out_reports.py FIELD [--only TEXT] [--keep FOLDER]
        [--thirds | --joint | --raw | --locate | --teachers]
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
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.io import loadmat, savemat

import aerpaw_cmp
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.compare.calibration import (
    SPLITS,
    Learned,
    Score,
    altitude_parts,
    campaign_left_out,
    flight_left_out,
    flights_of,
    heading_parts,
    learn,
    mean_rmse,
    parts_left_out,
    sector_parts,
)
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs.calibrate import (
    Calibration,
    in_campaigns,
    learned_healths,
    learned_locks,
    load_calibration,
    observe,
    read_flights,
    recipe_of,
    teaching,
)
from aerpaw_cmp.jobs.calibrate_rank import fit_rank, samples_by_tower
from aerpaw_cmp.jobs.calibration_files import Calibrated, site_entries
from aerpaw_cmp.logs.writers import format_power_log, format_vehicle_out
from aerpaw_cmp.site.learned import folder_of, store_entry

RECIPES = Path(__file__).parents[1] / "tests" / "field" / "learned"
TIMEZONE = "America/New_York"
NAMES = ("dataset12", "lte", "afar", "nr_rank")


def recipe_of_campaign(name: str) -> Path:
    """Return the calibration that a campaign is learned with."""
    joint = RECIPES / "joint.yaml"
    return joint if name in yaml.safe_load(joint.read_text(encoding="utf-8"))["campaigns"] else RECIPES / f"{name}.yaml"


def without(recipe: Path, flights: Collection[str], folder: Path, campaigns: Collection[str] = ()) -> Path:
    """Write a calibration without some flights and campaigns, and return its path."""
    content = yaml.safe_load(recipe.read_text(encoding="utf-8"))
    left_out = {Path(flight).name for flight in flights}

    def kept(names: Sequence[str]) -> list[str]:
        return [str((recipe.parent / name).resolve()) for name in names if Path(name).name not in left_out]

    if "campaigns" in content:
        each = {
            name: campaign | {"flights": kept(campaign["flights"])} for name, campaign in content["campaigns"].items()
        }
        content["campaigns"] = {name: some for name, some in each.items() if some["flights"] and name not in campaigns}
    else:
        content["flights"] = kept(content["flights"])
    path = folder / recipe.name
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


def site_without(recipe: Path, flight: str, field: Path, folder: Path) -> Path:
    """Return a copy of the packaged site in a folder, a calibration of which was learned without one of its flights."""
    path = without(recipe, [flight], folder)
    packaged, site = folder_of("lake_wheeler"), folder / "site.yaml"
    shutil.copytree(packaged, folder_of(site), dirs_exist_ok=True)
    shutil.copyfile(packaged.with_suffix(".yaml"), site)
    settings = load_calibration(path)
    flights, _, campaigns = read_flights(settings, path.parent, field)
    ranked = fit_rank(samples_by_tower(flights)) if settings.rank else None
    observed = in_campaigns(settings, observe(flights)[0], flights, campaigns)
    chosen = recipe_of(settings, observed, field)
    scores: dict[str, tuple[Score, ...]] = dict.fromkeys(SPLITS, ())
    learned: dict[str, Learned] = {}
    if len(flights_of(observed)) > 1:  # the errors to expect; the other splits and the controls are not read
        scores["flight_left_out"] = flight_left_out(observed, chosen, learned)
    calibration = Calibration(
        settings=settings, flights=tuple(flights), campaigns=campaigns, observed=tuple(observed), scores=scores,
        controls={}, learned=learn([o.samples for o in observed], chosen), warnings=(),
        words=(), locks=learned_locks(observed, chosen, learned), health=learned_healths(observed, learned),
        teaching=teaching(observed, campaigns, learned),
    )  # fmt: skip
    calibrated = Calibrated(settings, tuple(flights), (), calibration, ranked, "left out", campaigns)
    for name, made in site_entries(calibrated).items():
        store_entry(site, name, *made)
    return site


def as_raw(log: Path, folder: Path) -> Path:
    """Write the streams of a log into a folder as raw logs of AERPAW, and return the folder."""
    streams = {
        name: frame.assign(time=frame["time"].dt.tz_localize(None))
        for name, frame in aerpaw_cmp.read(log, timezone=TIMEZONE).items()
    }
    for name, frame in streams.items():
        (folder / "LW1" / name).mkdir(parents=True, exist_ok=True)
        if name == "vehicle":
            (folder / "vehicleOut.txt").write_bytes(format_vehicle_out(frame, TIMEZONE))
        else:
            content = format_power_log(frame["time"], frame["rss_db"], TIMEZONE)
            (folder / "LW1" / name / "2024-07-15_14_47_39_power_log.txt").write_bytes(content)
    return folder


def run(words: Sequence[object]) -> subprocess.CompletedProcess[str]:
    """Run a command of the tool."""
    return subprocess.run([sys.executable, "-m", "aerpaw_cmp", *map(str, words)], capture_output=True, text=True)


# Side of a cell of region.csv.
_CELL_M = 5.0


def located(log: Path, site: Path, folder: Path, rover: tuple[float, float]) -> list[tuple[float, float, float]]:
    """Return errors and radii of ``locate`` [m], and distances of the node from the 90 % region [m], and print them.

    The first row is without learned antennas, the second with those of a site.
    """
    bare = folder / "bare.yaml"
    shutil.copyfile(site, bare)
    found = []
    for name, of in (("without learned antennas", bare), ("with those of the other flights", site)):
        flight = folder / "node.yaml"
        run(["ingest", log, "--timezone", TIMEZONE, "--site", of, "--draft", flight, "--force"])
        done = run(["locate", flight, "-o", folder / "node", "--force", "--json"])
        if done.returncode:
            raise SystemExit(f"{log.name}: {done.stderr.strip()[-300:]}")
        answer = json.loads(done.stdout)
        place = answer["position"]
        error_m = float(np.hypot(*SiteFrame(*rover).to_local(place["latitude_deg"], place["longitude_deg"])))
        cells = np.loadtxt(folder / "node" / "region.csv", delimiter=",", skiprows=1)
        beyond_m = np.hypot(*SiteFrame(*rover).to_local(*cells.T[:2])).min()
        found.append((error_m, float(answer["region90_m"]), float(beyond_m)))
        print(f"{log.name}, {name}: error {error_m:.1f} m, 90 % radius {found[-1][1]:.0f} m", flush=True)
    return found


def reported(log: Path, site: Path, folder: Path) -> tuple[str, dict[str, Any]]:
    """First sentence of a report of the draft, and its metrics."""
    flight, out = folder / "flight.yaml", folder / "report"
    draft = ["ingest", log, "--timezone", TIMEZONE, "--site", site, "--draft", flight, "--force"]
    for words in (draft, ["report", flight, "-o", out, "--figures", "none", "--audit", "none", "--force"]):
        done = run(words)
        if done.returncode:
            return f"{words[0]}: exit {done.returncode}: {done.stderr.strip()[-300:]}", {}
    page = (out / "report.html").read_text(encoding="utf-8")
    first = re.search(r'class="verdict"[^>]*>(.*?)</p>', page, re.DOTALL)
    return html.unescape(first[1]) if first else "no sentence", json.loads((out / "metrics.json").read_text())


def thirds(log: Path, folder: Path) -> Iterator[Path]:
    """Return the three parts of a merged table, with each column cut by its own length."""
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


def flights_of_campaign(name: str) -> list[Path]:
    """Return the flight files that a campaign is learned from."""
    recipe = recipe_of_campaign(name)
    content = yaml.safe_load(recipe.read_text(encoding="utf-8"))
    return [recipe.parent / flight for flight in content.get("campaigns", {}).get(name, content)["flights"]]


def teachers(field: Path, folder: Path) -> None:
    """Print the antennas that the draft of each flight proposes at a site that learned from one other campaign."""
    names, draft = (*NAMES, "aadm"), folder / "flight.yaml"
    for teacher in names:
        site = folder / f"{teacher}_site.yaml"
        shutil.copyfile(folder_of("lake_wheeler").with_suffix(".yaml"), site)
        recipe = without(recipe_of_campaign(teacher), (), folder, {*names} - {teacher})
        out = folder / f"{teacher}_calibrated.yaml"
        if (done := run(["calibrate", recipe, "--into-site", site, "--logs-root", field, "-o", out])).returncode:
            raise SystemExit(f"{teacher}: {done.stderr.strip()[-300:]}")
        for pupil in names:
            for flight in flights_of_campaign(pupil) if pupil != teacher else ():
                logs = [field / log.path for log in load_flight(flight).logs]
                run(["ingest", *logs, "--timezone", TIMEZONE, "--site", site, "--draft", draft, "--force"])
                line = re.search(r"^(# )?antennas: .*", draft.read_text(encoding="utf-8"), re.MULTILINE)
                print(f"{teacher} -> {flight.stem}: {line[0] if line else 'nothing to propose'}", flush=True)


# Split, campaign, training without AADM: today's value is the first, the goal the last.
GOALS = {
    ("campaign", "lte"): (6.93, 6.4), ("campaign", "dataset12"): (6.18, 5.6), ("campaign", "aadm"): (7.27, 6.8),
    ("flight", "dataset12"): (3.53, 3.45), ("sector", "lte"): (6.54, 6.3), ("heading", "lte"): (6.69, 6.4),
}  # fmt: skip


def pooled(scores: Sequence[Score], name: str = "rmse_db") -> float:
    """Return the root mean square over the samples of all series [dB]."""
    square = sum(getattr(s, name) ** 2 * s.n for s in scores)
    return float(np.sqrt(square / sum(s.n for s in scores)))


def joint(field: Path, folder: Path) -> None:
    """Print the scores of the joint calibration with all campaigns, and without the one flight of AADM."""
    for left in ((), ("aadm",)):
        path = without(RECIPES / "joint.yaml", (), folder, left)
        settings = load_calibration(path)
        flights, _, campaigns = read_flights(settings, path.parent, field)
        observed = in_campaigns(settings, observe(flights)[0], flights, campaigns)
        recipe, fits = recipe_of(settings, observed, field), dict[str, Learned]()
        splits = {"flight": flight_left_out(observed, recipe, fits)}
        for split, parts in (("altitude", altitude_parts), ("sector", sector_parts), ("heading", heading_parts)):
            splits[split] = parts_left_out(observed, recipe, fits, parts)
        print(f"learned from {', '.join(settings.campaigns)}")
        turned = [campaign_left_out(observed, recipe, turn) for turn in (90.0, 180.0, 270.0)]
        splits["campaign"] = campaign_left_out(observed, recipe)
        for split, scores in splits.items():
            for name in settings.campaigns:
                mine = [s for s in scores if campaigns[s.flight] == name]
                if not mine:
                    continue
                # one offset per series; the towers of one flight are pooled, flights are averaged
                of = pooled if split == "campaign" else mean_rmse
                text = f"  {split} held out, {name}: {of(mine):.2f} dB, free space {of(mine, 'free_space_rmse_db'):.2f}"
                if split == "campaign":
                    copies = [pooled([s for s in some if campaigns[s.flight] == name]) for some in turned]
                    text += ", rotated by 90, 180, 270 deg " + ", ".join(f"{value:.2f}" for value in copies)
                if goal := GOALS.get((split, name)):
                    text += f" (before {goal[0]:.2f}, goal {goal[1]:.2f})"
                print(text, flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = os.environ.get("AERPAW_CMP_FIELD_DATA")
    parser.add_argument("field", type=Path, nargs="?" if known else None, default=known, help="folder of real logs")
    parser.add_argument("--only", default="", help="flight files whose path holds this")
    parser.add_argument("--keep", type=Path, help="folder that holds what was learned, for the next run")
    parser.add_argument("--thirds", action="store_true", help="of the flights at LW1, each third alone")
    parser.add_argument("--raw", action="store_true", help="dataset 12 as raw sounder and vehicle logs")
    parser.add_argument("--locate", action="store_true", help="the rover of each AFAR flight, by its levels")
    parser.add_argument("--joint", action="store_true", help="the joint calibration alone")
    parser.add_argument("--teachers", action="store_true", help="antennas that each campaign proposes for the others")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        names = ("afar",) if asked.locate else NAMES[: 1 if asked.raw else 2 if asked.thirds else None]
        rovers, found = list[tuple[float, float]](), []
        if asked.locate:
            lines = (asked.field / "sounder" / "rover_positions.txt").read_text(encoding="utf-8").splitlines()
            rovers = [(float(a), float(b)) for a, b in (line.split(",") for line in lines[:3])]
        for name in () if asked.joint or asked.teachers else names:
            recipe, means = recipe_of_campaign(name), dict[str, list[float]]()
            for flight in flights_of_campaign(name):
                if asked.only not in f"{name}/{flight.name}":
                    continue
                folder = (asked.keep or Path(scratch)) / name / flight.stem
                site = folder / "site.yaml"
                if not site.is_file():
                    folder.mkdir(parents=True, exist_ok=True)
                    site_without(recipe, flight.name, asked.field, folder)
                log = asked.field / load_flight(flight).logs[0].path
                log = as_raw(log, folder / "raw") if asked.raw else log
                if asked.locate:
                    found.append(located(log, site, folder, rovers[int(log.stem[-1]) - 1]))
                    continue
                for part in thirds(log, folder) if asked.thirds else [log]:
                    show(part, *reported(part, site, folder), means)
            if means:
                text = ", ".join(f"{key} {sum(each) / len(each):.3f}" for key, each in means.items())
                print(f"{name}, means over series: {text}", flush=True)
        for case, values in zip(("without", "with"), np.array(found).swapaxes(0, 1) if found else (), strict=False):
            # half the diagonal of a cell
            inside = int((values[:, 2] <= _CELL_M / np.sqrt(2.0)).sum())
            text = f"mean error {values[:, 0].mean():.1f} m, {inside} of {len(values)} inside the 90 % region"
            print(f"{case} learned antennas: {text}, largest radius {values[:, 1].max():.0f} m", flush=True)
        if asked.teachers:
            teachers(asked.field, Path(scratch))
        elif not (asked.thirds or asked.raw or asked.only or asked.locate):
            joint(asked.field, Path(scratch))


if __name__ == "__main__":
    main()

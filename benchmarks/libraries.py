"""Well-kept libraries against what is written here: YAML with lines, KML, block bootstrap.

What is missing on this machine is named and left out: `pip install ruamel.yaml fastkml arch` brings all three.

    python benchmarks/libraries.py [--trees 20000] [--folders 50000] [--series 60]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel
from scipy.signal import lfilter

from aerpaw_cmp.common.yamlfile import load_yaml
from aerpaw_cmp.compare.statistics import error_intervals
from aerpaw_cmp.flight.settings import FlightFile
from aerpaw_cmp.site.mapfiles import read_map_file

SAMPLE = Path(__file__).parents[1] / "sample_logs" / "flight.yaml"


class Tree(BaseModel):
    east_m: float
    north_m: float


class Grove(BaseModel):
    trees: list[Tree]


def library(name: str) -> Any:
    """The module, or None and a line that says so."""
    try:
        return import_module(name)
    except ImportError:
        print(f"{name}: not installed, left out")
        return None


def cpu_ms(call: Callable[[], object], times: int = 1) -> float:
    """Processor time of one call [ms], after a first one that does not count where there are several."""
    if times > 1:
        call()
    begin = time.process_time()
    for _ in range(times):
        call()
    return 1e3 * (time.process_time() - begin) / times


def yaml_files(folder: Path, trees: int) -> None:
    """A flight file, a site of single trees, and what YAML 1.1 gets wrong."""
    ruamel = library("ruamel.yaml")
    text = SAMPLE.read_text(encoding="utf-8")
    large = "trees:\n" + "".join(f"  - {{east_m: {i * 0.1:.1f}, north_m: {i * 0.2:.1f}}}\n" for i in range(trees))
    path = folder / "trees.yaml"
    path.write_text(large, encoding="utf-8")
    print(f"YAML, flight file: ours, settings checked, {cpu_ms(lambda: load_yaml(SAMPLE, FlightFile), 20):.1f} ms")
    print(f"YAML, {trees} trees: ours, settings checked, {cpu_ms(lambda: load_yaml(path, Grove)):.0f} ms")
    if ruamel is None:
        return
    parser = ruamel.YAML(typ="rt")
    print(f"YAML, flight file: ruamel.yaml, unchecked, {cpu_ms(lambda: parser.load(text), 20):.1f} ms")
    print(f"YAML, {trees} trees: ruamel.yaml, unchecked, {cpu_ms(lambda: parser.load(large)):.0f} ms")
    for source in ("2024-07-02", "!!python/object:os.system x"):
        found = ruamel.YAML(typ="rt").load(f"a: {source}")["a"]
        print(f"YAML, {source!r}: ruamel.yaml gives {type(found).__name__}; ours text, and an error")
    try:
        ruamel.YAML(typ="rt").load("[" * 3000 + "]" * 3000)
    except RecursionError:
        print("YAML, 3000 nested lists: ruamel.yaml ends in RecursionError; ours in a message")


def kml_files(folder: Path, folders: int) -> None:
    """Empty tags, the slow death of a reader."""
    fastkml = library("fastkml")
    head = '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
    ring = "<Placemark><Polygon><outerBoundaryIs><LinearRing><coordinates>-78.69,35.72 -78.68,35.72 -78.68,35.73 "
    shape = ring + "-78.69,35.72</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark>"
    path = folder / "empty.kml"
    for count in (folders // 2, folders):
        text = head + shape + "<Folder></Folder>" * count + "</Document></kml>"
        path.write_text(text, encoding="utf-8")
        print(f"KML, {count} empty folders: ours {cpu_ms(lambda: read_map_file(path)):.0f} ms", end="")
        if fastkml is not None:
            whole = text
            print(f", fastkml {cpu_ms(lambda: fastkml.kml.KML.from_string(whole)):.0f} ms", end="")  # noqa: B023
        print()


def bootstrap(series: int) -> None:
    """Coverage of 95 % intervals of an RMSE over correlated residuals."""
    arch = library("arch.bootstrap")
    random = np.random.default_rng(0)
    for tau in (5, 50, 200):
        keep = np.exp(-1 / tau)
        inside, given, ours_ms, theirs, theirs_ms = 0, 0, 0.0, 0, 0.0
        for number in range(series):
            error = (
                4.0 * lfilter([np.sqrt(1 - keep**2)], [1, -keep], random.standard_normal(3000 + 10 * tau))[10 * tau :]
            )
            begin = time.process_time()
            low, high = error_intervals(error, np.zeros(3000)).rmse_db
            ours_ms += 1e3 * (time.process_time() - begin) / series
            given, inside = given + bool(np.isfinite(low)), inside + bool(low <= 4.0 <= high)
            if arch is None:
                continue
            begin = time.process_time()
            length = max(1, round(float(np.asarray(arch.optimal_block_length(error**2)["circular"])[0])))
            resampled = arch.CircularBlockBootstrap(length, error, seed=number)
            bounds = resampled.conf_int(lambda x: np.sqrt(np.mean((x - x.mean()) ** 2)), 400, method="percentile")
            theirs_ms += 1e3 * (time.process_time() - begin) / series
            theirs += bool(bounds[0, 0] <= 4.0 <= bounds[1, 0])
        words = f"RMSE over 3000 residuals of correlation time {tau}: ours holds the truth in "
        words += f"{inside} of {given} intervals ({series - given} not given), {ours_ms:.1f} ms"
        print(words + ("" if arch is None else f"; arch {theirs} of {series}, {theirs_ms:.1f} ms"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trees", type=int, default=20_000)
    parser.add_argument("--folders", type=int, default=50_000)
    parser.add_argument("--series", type=int, default=60)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        yaml_files(Path(name), arguments.trees)
        kml_files(Path(name), arguments.folders)
    bootstrap(arguments.series)


if __name__ == "__main__":
    main()

"""Runs of the benchmark: our entrants, one table, one page; a stranger's file scored; data fetched."""

from __future__ import annotations

import csv
import hashlib
import http.client
import json
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

from ... import __version__
from ...common.cells import guarded
from ...common.errors import InputError, OutputError, UsageError
from ...common.files import atomic_path
from ...common.jsonable import json_object, named
from ...common.outputs import OutputFile, OutputFolder, is_sealed
from ...common.stages import Progress, begin_peak, peak_mib, silent
from ...common.versions import utc_now
from . import benchmark, entrants

# By task and entrant.
Scores = dict[str, dict[str, dict[str, Any]]]


@dataclass(frozen=True, slots=True)
class BenchmarkResult:
    """Scores by task and entrant, and what could not be run, with the sources of the files that lack."""

    scores: Scores
    skipped: dict[str, list[str]]
    folder: Path | None = None

    def as_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return json_object(scores=self.scores, skipped=self.skipped)


def open_bench(data: Path, manifest: Path | None = None) -> benchmark.Bench:
    """The benchmark with the logs below a folder."""
    return benchmark.Bench(benchmark.load_manifest(manifest), data)


def _chosen_tasks(manifest: benchmark.Manifest, names: Sequence[str]) -> list[str]:
    """The named tasks, or all; UsageError for an unknown one."""
    for name in names:
        if name not in manifest.tasks:
            raise UsageError(f"unknown task {name!r}", expected=", ".join(manifest.tasks))
    return list(names or manifest.tasks)


def run_benchmark(
    data: Path,
    out: Path,
    *,
    tasks: Sequence[str] = (),
    only: Sequence[str] = (),
    manifest: Path | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> BenchmarkResult:
    """Predict by our own entrants, score the files they write, make the page.

    Parameters
    ----------
    data : Path
        Folder of the published logs.
    out : Path
        Output folder: benchmark.html, scores.csv, leaderboard.json, predictions/ENTRANT.csv.
    tasks, only : sequence of str
        Tasks and entrants; empty for all (without those that take minutes per flight).
    manifest : Path, optional
    force : bool
    progress : Progress

    Returns
    -------
    BenchmarkResult
    """
    bench = open_bench(data, manifest)
    known = {**entrants.LEVEL, **entrants.RANK}
    for name in only:
        if name not in known:
            raise UsageError(f"unknown entrant {name!r}", expected=", ".join(known))
    names = list(only) or [name for name in known if name not in entrants.ONLY_ON_DEMAND]
    chosen = _chosen_tasks(bench.manifest, tasks)
    skipped = {task: lack for task in chosen if (lack := bench.skipped(task, training=True))}
    with OutputFolder(out, job="benchmark", inputs=list(bench.places.values()), force=force) as output:
        cost: dict[tuple[str, str], dict[str, float]] = {}
        written: dict[str, list[Any]] = {name: [] for name in names}
        runnable = [t for t in chosen if t not in skipped and bench.tests(t)]
        for task, name in ((task, name) for task in runnable for name in names):
            progress(f"{task}: {name}")
            begin_peak()
            started = time.process_time()
            frame = _predicted(bench, task, name)
            cost[task, name] = {"seconds": time.process_time() - started, "peak_mib": peak_mib()}
            if frame is not None:
                written[name].append(frame)
        with output.filling() as folder:
            (folder / "predictions").mkdir()
            entries = {}
            for name in [name for name in names if written[name]]:
                path = folder / "predictions" / f"{name}.csv"
                path.write_text(_entry_text(name, written[name]), encoding="utf-8")
                entries[name] = benchmark.read_entry(path)
            scores = _score_all(bench, entries, cost)
            rows = [benchmark.leaderboard_row(bench, e, _scores_of(scores, n), __version__) for n, e in entries.items()]
            (folder / "leaderboard.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
            (folder / "scores.csv").write_text(_scores_csv(scores), encoding="utf-8")
            (folder / "benchmark.html").write_text(_page(bench, scores), encoding="utf-8")
    return BenchmarkResult(scores, skipped, out)


def _predicted(bench: benchmark.Bench, task: str, name: str) -> Any:
    try:
        return entrants.predict(bench, task, name)
    except ImportError as error:
        raise UsageError(
            f"{name} needs {error.name}", expected="pip install scikit-learn", cause="it is an optional extra"
        ) from None


def _entry_text(name: str, frames: Sequence[Any]) -> str:
    import pandas as pd

    text = guarded(pd.concat(frames)).to_csv(index=False, float_format="%.4f", lineterminator="\n")
    return f"# entrant: {name}\n# who: aerpaw-cmp {__version__}\n{text}"


def _score_all(
    bench: benchmark.Bench, entries: dict[str, benchmark.Entry], cost: dict[tuple[str, str], dict[str, float]]
) -> Scores:
    scores: Scores = {}
    for task in bench.manifest.tasks:
        mine = {n: e for n, e in entries.items() if (e.frame["task"] == task).any()}
        baselines = {n: mine[n] for n in benchmark.BASELINES if n in mine}
        for name, entry in mine.items():
            row = benchmark.score_task(bench, task, entry, baselines, accept_levels=True)
            scores.setdefault(task, {})[name] = row | cost.get((task, name), {})
    return scores


def _scores_of(scores: Scores, entrant: str) -> dict[str, dict[str, Any]]:
    return {task: rows[entrant] for task, rows in scores.items() if entrant in rows}


def _scores_csv(scores: Scores) -> str:
    keys = list(dict.fromkeys(k for rows in scores.values() for row in rows.values() for k in row))
    table = StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["task", "entrant", *keys])
    for task, rows in scores.items():
        for entrant, row in rows.items():
            writer.writerow([task, entrant, *(_cell(row.get(key)) for key in keys)])
    return table.getvalue()


def _cell(value: Any) -> str:
    if isinstance(value, (tuple, list)):
        return " ".join(_cell(v) for v in value)
    return "" if value is None else repr(float(value)) if isinstance(value, float) else str(value)


def _page(bench: benchmark.Bench, scores: Scores) -> str:
    from ...report.benchmark_html import benchmark_page, task_table

    tables = []
    for task, rows in scores.items():
        spec = bench.manifest.tasks[task]
        about = {**named(spec, "title rule kind"), "flights": bench.tests(task)}
        tables.append(task_table(task, {**about, "skipped": bench.skipped(task, training=False)}, rows))
    lacking = dict.fromkeys(text for task in bench.manifest.tasks for text in bench.skipped(task, training=True))
    return benchmark_page(tables, list(lacking), utc_now(), __version__)


def score_predictions(
    predictions: Path,
    data: Path,
    *,
    tasks: Sequence[str] = (),
    manifest: Path | None = None,
    leaderboard: Path | None = None,
    accept_levels: bool = False,
) -> BenchmarkResult:
    """Score a stranger's predictions.csv on every task it answers.

    Parameters
    ----------
    predictions, data : Path
    tasks : sequence of str
        Empty: those in the file whose test files are at hand.
    manifest : Path, optional
    leaderboard : Path, optional
        leaderboard.json to which a row is added.
    accept_levels : bool
        Skip the test of sign and unit.

    Returns
    -------
    BenchmarkResult
        One entrant.
    """
    bench = open_bench(data, manifest)
    entry = benchmark.read_entry(predictions)
    answered = list(dict.fromkeys(entry.frame["task"]))
    _chosen_tasks(bench.manifest, answered)
    chosen = [task for task in _chosen_tasks(bench.manifest, tasks) if task in answered]
    skipped = {task: bench.skipped(task, training=False) for task in chosen}
    benchmark.check_training(bench, entry, chosen)
    scores: Scores = {}
    name = entry.head.get("entrant", predictions.stem)
    for task in chosen:
        if not bench.tests(task):
            continue
        baselines = {}
        if bench.manifest.tasks[task].kind == "level" and not bench.skipped(task, training=True):
            frames = {b: entrants.predict(bench, task, b) for b in benchmark.BASELINES}
            baselines = {b: benchmark.Entry(frame, {}, "") for b, frame in frames.items() if frame is not None}
        scores[task] = {name: benchmark.score_task(bench, task, entry, baselines, accept_levels=accept_levels)}
    if not scores:
        lacking = "; ".join(text for texts in skipped.values() for text in texts)
        raise InputError(
            "nothing could be scored",
            expected=f"rows of {', '.join(bench.manifest.tasks)}" + (f"; missing: {lacking}" if lacking else ""),
            path=predictions,
        )
    if leaderboard is not None:
        rows = [
            *benchmark.read_leaderboard(leaderboard),
            benchmark.leaderboard_row(bench, entry, _scores_of(scores, name), __version__),
        ]
        with OutputFile(leaderboard, own=_is_leaderboard, inputs=[predictions]) as output:
            output.write((json.dumps(rows, indent=1) + "\n").encode())
    return BenchmarkResult(scores, {task: texts for task, texts in skipped.items() if texts})


def _is_leaderboard(path: Path) -> bool:
    try:
        return bool(benchmark.read_leaderboard(path)) or is_sealed(path)
    except InputError:
        return False


def write_template(
    data: Path, out: Path, *, tasks: Sequence[str] = (), manifest: Path | None = None, force: bool = False
) -> list[Path]:
    """Write the table to fill and, beside it, what is known.

    Parameters
    ----------
    data : Path
        Folder of the published logs.
    out : Path
        The table to fill: time, position, attitude, directions, an empty ``level_db`` (or rank probabilities) of each
        test sample, and no measured level of a test flight. Beside it ``NAME_train.csv`` holds the training flights.
    tasks : sequence of str
    manifest : Path, optional
    force : bool

    Returns
    -------
    list of Path
        Both files.
    """
    import pandas as pd

    bench = open_bench(data, manifest)
    chosen = _chosen_tasks(bench.manifest, tasks)
    test_parts = [benchmark.truth(bench, task) for task in chosen]
    train_parts = [benchmark.truth(bench, task, training=True) for task in chosen]
    test = pd.concat(test_parts, ignore_index=True).drop(columns="measured")
    if test.empty:
        first = bench.skipped(chosen[0], training=False)[0]
        expected = f"--data with published logs ('aerpaw-cmp benchmark fetch' gets them), such as {first}"
        raise InputError("no test flight is at hand", expected=expected, path=data)
    test["level_db"], test["sd_db"] = "", ""
    if any(bench.manifest.tasks[task].kind == "rank" for task in chosen):
        test = test.assign(p_rank1="", p_rank2="", p_rank3="", p_rank4="")
    train = pd.concat(train_parts, ignore_index=True)
    train_file = out.with_name(f"{out.stem}_train{out.suffix}")
    for path, frame in ((out, test), (train_file, train)):
        with OutputFile(path, own=is_sealed, inputs=list(bench.places.values()), force=force) as output:
            output.write(frame.to_csv(index=False, lineterminator="\n").encode())
    return [out, train_file]


def fetch(out: Path, *, manifest: Path | None = None, progress: Progress = silent) -> list[Path]:
    """Download the published files that a folder lacks; a file is kept where its SHA-256 is right.

    Proxies are taken from the environment.

    Raises
    ------
    OutputError
        No network, or the server refuses; what was fetched before stays.
    InputError
        A file whose content is not the published one.
    """
    listing = benchmark.load_manifest(manifest)
    out.mkdir(parents=True, exist_ok=True)
    fetched = []
    for name, entry in listing.files.items():
        path = out / f"{name}{Path(entry.path).suffix}"
        if path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == entry.sha256:
            continue
        progress(f"{name}: {entry.bytes / 1e6:.1f} MB from {entry.repository}")
        try:
            with urllib.request.urlopen(entry.url, timeout=60) as answer:
                content = answer.read(entry.bytes)
        except (urllib.error.URLError, http.client.IncompleteRead, OSError) as error:
            raise OutputError(
                f"{entry.url} could not be fetched: {error}",
                expected="a network, or the files copied by hand into the folder (docs/benchmark.md names them)",
                path=path,
            ) from None
        digest = hashlib.sha256(content).hexdigest()
        if digest != entry.sha256:
            cause = f"the answer was cut, or {entry.repository} changed the file"
            raise InputError(f"SHA-256 {digest} of {len(content)} bytes", expected=entry.sha256, cause=cause, path=path)
        with atomic_path(path) as part:
            part.write_bytes(content)
        fetched.append(path)
    return fetched

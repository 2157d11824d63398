"""``benchmark``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from ..common.errors import UsageError
from .app import Force, Json, command, output
from .shown import number, print_files, print_json, say, table

ACTIONS = ("run", "score", "template", "fetch", "tasks")


@command(
    "benchmark",
    examples=[
        "aerpaw-cmp benchmark --data logs -o reports/benchmark",
        "aerpaw-cmp benchmark score predictions.csv --data logs --leaderboard leaderboard.json",
        "aerpaw-cmp benchmark template --data logs -o predictions.csv --task level_dataset12",
        "aerpaw-cmp benchmark fetch -o logs",
    ],
)
def benchmark(
    words: Annotated[
        list[str] | None,
        Argument(
            metavar="[run|tasks|template|fetch|score PREDICTIONS]",
            help="run: our own models; tasks: the rules; template: the table to fill; score: a predictions.csv.",
        ),
    ] = None,
    data: Annotated[Path, Option(help="Folder of the published logs, whatever the files are called.")] = Path(),
    out: Annotated[
        Path | None,
        output("Output folder; of template a CSV  [default: reports/benchmark, predictions.csv; of fetch --data]"),
    ] = None,
    task: Annotated[list[str] | None, Option(help="Only this task; repeatable.")] = None,
    entrant: Annotated[list[str] | None, Option(help="Only this model of ours; repeatable.")] = None,
    leaderboard: Annotated[Path | None, Option(help="leaderboard.json that gets a row for the scored file.")] = None,
    manifest: Annotated[Path | None, Option(help="Another manifest [default: the packaged one]")] = None,
    accept_levels: Annotated[
        bool, Option("--accept-levels", help="Score levels whose sign or unit looks wrong.")
    ] = False,
    force: Force = False,
    as_json: Json = False,
) -> int:
    """Score channel models on published flights with frozen splits."""
    from ..jobs.benchmarks import benchmark_run as job

    action, *entries = words or ["run"]
    if action not in ACTIONS or len(entries) != (1 if action == "score" else 0):
        raise UsageError(
            f"benchmark {' '.join(words or [])}", expected=f"one of {', '.join(ACTIONS)}; score takes a file"
        )
    tasks = task or ()
    if action == "tasks":
        _print_tasks(job.open_bench(data, manifest), as_json)
        return 0
    if action == "fetch":
        fetched = job.fetch(out or data, manifest=manifest, progress=say)
        print_json({"files": [str(p) for p in fetched]}) if as_json else print(f"{len(fetched)} files in {out or data}")
        return 0
    if action == "template":
        files = job.write_template(data, out or Path("predictions.csv"), tasks=tasks, manifest=manifest, force=force)
        print_files(files, as_json)
        return 0
    if action == "score":
        result = job.score_predictions(
            Path(entries[0]), data, tasks=tasks, manifest=manifest, leaderboard=leaderboard, accept_levels=accept_levels
        )
    else:
        result = job.run_benchmark(
            data,
            out or Path("reports/benchmark"),
            tasks=tasks,
            only=entrant or (),
            manifest=manifest,
            force=force,
            progress=say,
        )
    print_json(result.as_dict()) if as_json else _print_scores(result)
    return 0 if result.scores else 3


def _print_tasks(bench: Any, as_json: bool) -> None:
    rows = {
        name: {"title": entry.title, "rule": entry.rule, "missing": bench.skipped(name, training=True)}
        for name, entry in bench.manifest.tasks.items()
    }
    if as_json:
        print_json({"tasks": rows})
        return
    for name, entry in rows.items():
        print(f"{name}: {entry['title']}\n  {entry['rule']}")
        for text in entry["missing"]:
            print(f"  not at hand: {text}")


def _print_scores(result: Any) -> None:
    for task, rows in result.scores.items():
        rank = "kappa" in next(iter(rows.values()))
        keys = (
            ["log_score", "kappa", "agreement"]
            if rank
            else ["rmse_db", "rmse_4s_db", "bias_db", "crps_db", "coverage_90"]
        )
        order = sorted(rows, key=lambda name: rows[name][keys[0]])
        table(["entrant", *keys], [[n, *(number(rows[n][k], "{:.2f}") for k in keys)] for n in order], task)
    for task, texts in result.skipped.items():
        for text in texts:
            say.warn(f"{task}: not at hand: {text}")
    if result.folder is not None:
        print(f"page: {result.folder / 'benchmark.html'}")

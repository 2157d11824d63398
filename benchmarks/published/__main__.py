"""Score channel models on published AERPAW flights: python -m benchmarks.published VERB (see README.md in this folder).

tasks: what is known and what is scored; template: the table to fill; score: a predictions.csv; enter: our own models.
Logs are looked for below --data and known by their SHA-256; nothing is fetched.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import pandas as pd

from aerpaw_cmp.common.errors import AerpawCmpError, InputError, UsageError
from aerpaw_cmp.common.jsonable import json_safe
from aerpaw_cmp.common.outputs import OutputFile, is_sealed

from . import entrants
from .score import Entry, check_training, read_entry, score_task
from .tasks import KEY, MANIFEST, RANKS, Bench

BASELINES = ("free_space", "log_distance")


def predicted(bench: Bench, task: str, entrant: str) -> pd.DataFrame | None:
    """Return one of our entrants' answers to a task, as in a predictions.csv.

    Return None if it answers another kind of task.
    """
    rank = bench.manifest.tasks[task].kind == "rank"
    model: Any = (entrants.RANK if rank else entrants.LEVEL).get(entrant)
    if model is None:
        return None
    parts = []
    for question in (q for flight in bench.tests(task) for q in bench.questions(task, flight)):
        answer = model(question.known, question.asked, bench.flight)
        columns = (
            dict(zip(RANKS, answer.T, strict=True)) if rank else dict(zip(("level_db", "sd_db"), answer, strict=True))
        )
        parts.append(question.asked[KEY].assign(**columns))
    return pd.concat(parts, ignore_index=True)


def entry_of(bench: Bench, name: str, tasks: list[str]) -> Entry | None:
    """Return one of our entrants' answers to the tasks whose files exist. Return None if it answers none of them."""
    runnable = [task for task in tasks if not bench.skipped(task, training=True)]
    frames = [frame for task in runnable if (frame := predicted(bench, task, name)) is not None]
    return Entry(pd.concat(frames, ignore_index=True), {"entrant": name}) if frames else None


def score(bench: Bench, path: Path, tasks: list[str], *, accept_levels: bool = False) -> dict[str, Any]:
    """Return the scores of a third-party CSV on every task that it answers.

    Raises
    ------
    UsageError, InputError
        What :func:`~.score.read_entry` and :func:`~.score.score_task` refuse; nothing that can be scored.
    """
    chosen = bench.chosen(tasks)
    entry = read_entry(path, bench, chosen)
    bench.chosen(list(dict.fromkeys(entry.frame["task"])))
    check_training(bench, entry, chosen)
    answered = [task for task in chosen if (entry.frame["task"] == task).any() and bench.tests(task)]
    peers = {name: peer for name in BASELINES if (peer := entry_of(bench, name, answered))}
    scores = {task: score_task(bench, task, entry, peers, accept_levels=accept_levels) for task in answered}
    if not scores:
        raise InputError("nothing could be scored", expected=f"rows of {', '.join(bench.manifest.tasks)}", path=path)
    return scores


def template(bench: Bench, out: Path, tasks: list[str], *, force: bool = False) -> list[Path]:
    """Write the table to fill, without levels of test flights, and NAME_train.csv with the training data."""
    chosen = bench.chosen(tasks)
    test = pd.concat([bench.rows(task) for task in chosen], ignore_index=True).drop(columns="measured")
    if test.empty:
        first = bench.skipped(chosen[0], training=False)[0]
        raise InputError("no test flight is at hand", expected=f"published logs, such as {first}", path=bench.folder)
    kinds = {bench.manifest.tasks[task].kind for task in chosen}
    blank = ([*("level_db", "sd_db")] if "level" in kinds else []) + (RANKS if "rank" in kinds else [])
    train = pd.concat([bench.rows(task, training=True) for task in chosen], ignore_index=True)
    files = {out: test.assign(**dict.fromkeys(blank, "")), out.with_name(f"{out.stem}_train{out.suffix}"): train}
    for path, frame in files.items():
        with OutputFile(path, own=is_sealed, inputs=list(bench.places.values()), force=force) as output:
            output.write(frame.to_csv(index=False, lineterminator="\n").encode())
    return list(files)


def enter(bench: Bench, tasks: list[str], names: list[str], out: Path | None = None) -> dict[str, Any]:
    """Return the scores of our entrants by task and entrant. ``out`` is a folder for their predictions.

    Raises
    ------
    UsageError
        An unknown task or entrant.
    """
    known = {**entrants.LEVEL, **entrants.RANK}
    for name in names:
        if name not in known:
            raise UsageError(f"unknown entrant {name!r}", expected=", ".join(known))
    chosen = bench.chosen(tasks)
    asked = names or [name for name in known if name not in entrants.ONLY_ON_DEMAND]
    entries = {name: entry for name in asked if (entry := entry_of(bench, name, chosen))}
    peers = {name: entries[name] for name in BASELINES if name in entries}
    scores: dict[str, dict[str, Any]] = {}
    for name, entry in entries.items():
        for task in dict.fromkeys(entry.frame["task"]):
            scores.setdefault(task, {})[name] = score_task(bench, task, entry, peers, accept_levels=True)
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            text = entry.frame.to_csv(index=False, float_format="%.4f", lineterminator="\n")
            (out / f"{name}.csv").write_text(f"# entrant: {name}\n{text}", encoding="utf-8")
    return scores


def main(arguments: list[str] | None = None) -> int:
    """Run one subcommand, and print its result as JSON."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--data", type=Path, default=Path(), help="folder of the published logs")
    common.add_argument("--manifest", type=Path, default=MANIFEST)
    common.add_argument("--task", action="append", default=[], help="only this task; repeatable")
    common.add_argument("-o", "--out", type=Path, help="of template a CSV, of enter a folder for its predictions")
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.published", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("tasks", parents=[common])
    verbs.add_parser("template", parents=[common]).add_argument("--force", action="store_true")
    scoring = verbs.add_parser("score", parents=[common])
    scoring.add_argument("predictions", type=Path)
    scoring.add_argument("--accept-levels", action="store_true", help="levels whose sign or unit looks wrong")
    verbs.add_parser("enter", parents=[common]).add_argument("--entrant", action="append", default=[])
    asked = parser.parse_args(arguments)
    try:
        bench = Bench(asked.data, asked.manifest)
        result: Any
        if asked.verb == "tasks":
            tasks = {name: bench.manifest.tasks[name] for name in bench.chosen(asked.task)}
            result = {
                name: {"title": task.title, "rule": task.rule, "missing": bench.skipped(name, training=True)}
                for name, task in tasks.items()
            }
        elif asked.verb == "template":
            result = {"files": template(bench, asked.out or Path("predictions.csv"), asked.task, force=asked.force)}
        elif asked.verb == "score":
            result = {"scores": score(bench, asked.predictions, asked.task, accept_levels=asked.accept_levels)}
        else:
            result = {"scores": enter(bench, asked.task, asked.entrant, asked.out)}
    except AerpawCmpError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    print(json.dumps(json_safe(result), indent=1, default=str))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Write docs/performance.md and its figures from the history of benchmark runs. ``--measure`` runs them first.

    python benchmarks/performance.py [--measure] [--history FILE] [--docs FOLDER]

The page shows the last run of the history that measured everything it was asked for. Earlier runs are used for the
table of the peers' ratios over time. Each extrapolation is one line with the largest measured size, the fitted power,
the requested size, and how far it is beyond the largest measured size.
"""

import argparse
import json
import math
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
HISTORY = ROOT / "benchmarks" / "history.jsonl"
FIGURE = "performance_scaling.png"
# Title and what was done, by axis of benchmarks/scaling.py.
AXES = {
    "poses": ("Poses", "replay of 5 towers, 4 x 4 elements, 12 buildings, depth 2"),
    "towers": ("Towers", "replay of 10 000 poses, 4 x 4 elements, 12 buildings, depth 2"),
    "faces": (
        "Faces of buildings",
        "paths and fields of 100 poses of one tower, depth 2, the area grows with the number of buildings",
    ),
    "samples": ("Samples of one channel", "comparison with all intervals, without replay"),
    "report": ("Samples of a flight", "complete report, two channels, without audit"),
    "flights": ("Flights", "campaign: one tower, two channels, two settings, 130 s each, one worker"),
    "workers": ("Workers", "the campaign with most flights"),
}

SEARCH_NOTE = (
    "The path search is that of the bench scene (61 faces, 1000 positions, depth 2). From 2026-11-23 on, small "
    "searches run in NumPy instead of compiled code, and PathSolver is called with smaller tables. This lowers the "
    "ratios."
)
SEASON = {"flights": 200, "towers": 5, "settings": 20}
CITY = {"faces": 50_000}


WHEN = {"cold": "first report, all caches empty", "warm": "the next"}


def runs(history: Path) -> list[dict[str, Any]]:
    """Every run of the history, oldest first."""
    lines = history.read_text(encoding="utf-8").splitlines() if history.is_file() else []
    return [json.loads(line) for line in lines if line.strip()]


def last_whole(history: list[dict[str, Any]]) -> dict[str, Any]:
    """The last run that has the scaling of at least one axis.

    Raises
    ------
    SystemExit
        None has.
    """
    with_scaling = [run for run in history if run["benchmarks"].get("scaling", {}).get("result")]
    if not with_scaling:
        raise SystemExit("no run with scaling in the history: python benchmarks/all.py first")
    return with_scaling[-1]


def size_of(row: dict[str, Any]) -> float:
    """Return the label of the axis of sizes."""
    return float(row.get("samples", row.get("faces", row["size"])))


def number(value: float) -> str:
    """Three digits that count, thousands set apart."""
    if value >= 100:
        return f"{value:,.0f}".replace(",", " ")
    return f"{value:.3g}"


def power(value: float | None) -> str:
    """A fitted power, or a dash."""
    return "-" if value is None else f"{value:.2f}"


def scaling_tables(scaling: dict[str, Any]) -> list[str]:
    """A table per axis."""
    out = []
    for axis, result in scaling.items():
        title, what = AXES[axis]
        cpu, memory = power(result["power_cpu"]), power(result["power_memory"])
        fitted = "" if axis == "workers" else f" Time grows with the size to the power of {cpu}, memory with {memory}."
        out += [f"### {title}", "", f"{what[0].upper()}{what[1:]}.{fitted}", ""]
        out += ["| size | processor s | wall s | peak MiB |", "| ---: | ---: | ---: | ---: |"]
        for row in result["rows"]:
            if "refused" in row:
                out.append(f"| {number(row['size'])} | {row['refused']} | | |")
            else:
                cells = (size_of(row), row["cpu_s"], row["wall_s"], row["peak_mib"])
                out.append("| " + " | ".join(map(number, cells)) + " |")
        out.append("")
    return out


def measured(scaling: dict[str, Any], axis: str) -> list[dict[str, Any]]:
    """Rows of an axis that were not refused."""
    return [r for r in scaling.get(axis, {}).get("rows", []) if "refused" not in r]


def extrapolated(scaling: dict[str, Any], axis: str, size: float) -> tuple[float, float] | None:
    """Processor seconds at a size, and how many times beyond the largest measured one it is."""
    rows, result = measured(scaling, axis), scaling.get(axis, {})
    if not rows or (result.get("power_cpu") or 0.0) <= 0.0:  # no growth was measured: nothing to extrapolate
        return None
    last = size_of(rows[-1])
    return rows[-1]["cpu_s"] * (size / last) ** result["power_cpu"], size / last


def season(scaling: dict[str, Any]) -> list[str]:
    """Extrapolate a campaign from the cost of one more task."""
    rows = measured(scaling, "flights")
    if len(rows) < 2:
        return []
    task_s = (rows[-1]["cpu_s"] - rows[0]["cpu_s"]) / (rows[-1]["size"] - rows[0]["size"]) / 2.0  # two settings
    tasks = SEASON["flights"] * SEASON["settings"]
    hours = task_s * SEASON["towers"] * tasks / 3600.0
    first, later, *_ = (*measured(scaling, "workers"), None, None)
    shared = f" Two workers took {later['wall_s'] / first['wall_s']:.2f} times the wall time of one." if later else ""
    return [
        f"- **A campaign**: {SEASON['flights']} flights x {SEASON['settings']} settings = {number(tasks)} tasks. A "
        f"task of one tower (two channels, 130 s, 260 samples each) costs {task_s:.2f} s of processor time. "
        f"With {SEASON['towers']} towers at the same cost, this is {hours:.1f} h of one core, if tasks cost the "
        f"same (the campaign grew with power {power(scaling['flights']['power_cpu'])} in flights).{shared}"
    ]


def city(scaling: dict[str, Any]) -> list[str]:
    """A city by the growth with faces."""
    estimate = extrapolated(scaling, "faces", CITY["faces"])
    if estimate is None:
        return []
    seconds, beyond = estimate
    return [
        f"- **A city**: {number(CITY['faces'])} faces (10 000 buildings), 100 poses of one tower, depth 2: "
        f"{number(seconds)} s of processor time, if the power {power(scaling['faces']['power_cpu'])} is valid "
        f"{beyond:.0f} times beyond the largest scene that was measured. This is only an order of magnitude."
    ]


def long_flight(scaling: dict[str, Any]) -> list[str]:
    """A day by the growth of a report with samples."""
    estimate = extrapolated(scaling, "report", 2_000_000)
    if estimate is None:
        return []
    seconds, beyond = estimate
    return [
        f"- **A flight of ten hours** (1 000 000 samples of two channels): {number(seconds)} s of processor time, "
        f"{beyond:.0f} times beyond the largest measured flight. "
        "`python benchmarks/scaling.py --axes report --large --seconds 3600` measures it."
    ]


def peers(history: list[dict[str, Any]]) -> list[str]:
    """Ratios to the peers in every run of the history that has them."""
    results = {run["date"]: run["benchmarks"].get("peers", {}).get("result") for run in history}
    having = [run for run in history if results[run["date"]]][-8:]
    if not having:
        return []
    # until 2026-11-23 only the ratios were stored
    ratios = [results[run["date"]].get("ratios", results[run["date"]]) for run in having]
    names = list(dict.fromkeys(name for some in ratios for name in some))
    head = "| times faster than | " + " | ".join(f"{r['date'][:10]}, {r['version']}" for r in having) + " |"
    out = [
        "## Against peers",
        "",
        "Each row compares this tool with another program in one process, by the ratio of processor times. Above 1, "
        "this tool is faster.",
        SEARCH_NOTE,
        "",
        head,
    ]
    out.append("| --- |" + " ---: |" * len(having))
    for name in names:
        values = [some.get(name) for some in ratios]
        out.append(f"| {name} | " + " | ".join("-" if v is None else number(v) for v in values) + " |")
    last = results[having[-1]["date"]]
    if ranks := last.get("ranks"):
        out += [
            "",
            f"Ranks of {number(ranks['links'])} links of 4 x 4 elements: {ranks['seconds_ours']:.3f} processor "
            f"seconds, {ranks['differ']} differ from those of the SVD.",
        ]
    return [*out, ""]


def last_result(history: list[dict[str, Any]], name: str) -> tuple[str, dict[str, Any]]:
    """Return the last result of a benchmark, with the time and load of its measurement.

    It is empty if there is no result.
    """
    for run in reversed(history):
        entry = run["benchmarks"].get(name, {})
        if result := entry.get("result"):
            return f"{run['date'][:10]}, {run['version']}, load {entry['load_before']} before", result
    return "", {}


def town(history: list[dict[str, Any]]) -> list[str]:
    """Compare the path search in a town with that in the bench scene, and with PathSolver on the same triangles."""
    when, result = last_result(history, "town")
    rows = [row for row in result.get("rows", []) if "failed" not in row]
    ours = {row["depth"]: row["search_s"][1] for row in rows if row["kind"] == "image"}
    if not rows:
        return []
    out = [
        f"Sionna RT's scene of Munich ({number(rows[0]['faces'])} faces, {rows[0]['receivers']} receivers, one tower; "
        f"{when}). PathSolver's time includes the compilation of kernels that are not in its cache:", "",
        "| search | depth | processor s | relative to the image engine | missing paths |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]  # fmt: skip
    for row in rows:
        cpu = row["search_s"][1]
        name = "image engine" if row["kind"] == "image" else f"PathSolver, {number(row['samples'])} rays"
        ratio = "1" if row["kind"] == "image" else number(cpu / ours[row["depth"]])
        lacks = "none known" if row["kind"] == "image" else f"{row['extra']} of {sum(row['exact'])}"
        out.append(f"| {name} | {row['depth']} | {number(cpu)} | {ratio} | {lacks} |")
    if str(when) < "2026-11-29":
        out += [
            "", "From 2026-11-29 on, the search also follows first faces that another face hides. It finds the same "
            "paths with less code, in 1.85 s at depth 2 and 60.1 s at depth 3 (on a machine with other work).",
        ]  # fmt: skip
    return [*out, ""]


COUNTRY = (
    "receivers", "tiles", "wall_s", "cpu_s", "receivers_per_s", "worker_mib", "first_mib", "store_mib", "files",
)  # fmt: skip


def country(history: list[dict[str, Any]]) -> list[str]:
    """A map in tiles by its receivers, and what larger ones would take."""
    when, result = last_result(history, "country")
    if not result:
        return []
    out = [
        "## A map of a country", "",
        f"Villages on 32 x 32 km: 3 towers, 3 000 buildings, one height of 3 m, one reflection, 4 x 4 elements, "
        f"{result['workers']} workers, tiles of {result['cells']} x {result['cells']} positions ({when}). Wall-clock "
        "seconds include imports, store and page. `python benchmarks/country.py --receivers 1e7` measures it.", "",
        "| receivers | tiles | wall s | processor s | receivers per second | largest worker MiB | first process MiB "
        "| store MiB | files |",
        "| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
        *("| " + " | ".join(number(row[key]) for key in COUNTRY) + " |" for row in result["rows"]),
        "",
    ]  # fmt: skip
    for row in result["extrapolated"]:
        out.append(
            f"- **{number(row['receivers'])} receivers**, extrapolated from the last two rows: "
            f"{row['wall_s'] / 3600:.1f} h, {row['store_mib'] / 1024:.0f} GiB in {number(row['files'])} files, first "
            f"process {number(row['first_mib'])} MiB and {number(row['first_cpu_s'])} s of processor time."
        )
    return [
        *out,
        "- **The first limit** is the number of cells. A grid has at most 10 000 per side, so the largest map has 1e8 "
        "receivers at one height, and 1e9 receivers are ten maps. The next limits are the number of files in the "
        "store, and the one process that writes it, for which many workers would wait.", "",
    ]  # fmt: skip


def kriging(history: list[dict[str, Any]]) -> list[str]:
    """Kriging in totals and by the marginal cost of a target, set-up apart."""
    when, result = last_result(history, "kriging")
    row = result.get("moving_window", {})
    if "ours_first_s" not in row:
        return []
    counts = [int(key.split("_")[1]) for key in row if key.startswith("pykrige_") and key[8:-2].isdigit()]
    sizes = {f"{number(n)}": str(n) for n in counts} | {f"{number(counts[-1])}, first call of a process": "first"}
    return [
        f"Kriging of one field, 20 neighbours ({when}), processor seconds, the smallest of five alternating runs. "
        "Totals include the set-up of each program. The first call of a process also includes its imports, and the "
        "last row includes neither:",
        "",
        "| targets | ours | PyKrige's C back end | times faster |",
        "| ---: | ---: | ---: | ---: |",
        *(
            f"| {name} | {row[f'ours_{n}_s']:.3f} | {row[f'pykrige_{n}_s']:.3f} | {row[f'ratio_total_{n}']:.2f} |"
            for name, n in sizes.items()
        ),
        f"| one more target [us] | {row['ours_marginal_us']:.1f} | {row['pykrige_marginal_us']:.1f} "
        f"| {row['ratio_marginal']:.2f} |",
        "", f"27 fields at {number(counts[0])} targets: {row[f'ratio_total_{counts[0]}_27_fields']:.0f} "
        "times faster than 27 runs of PyKrige.", "",
        "From 2026-11-29 on, semivariances are computed for each target, even if it shares samples with its "
        "neighbours. On a machine with other work, 100 000 scattered targets then take 0.83 s instead of 0.48 s. The "
        "time of maps on a grid does not change.", "",
    ]  # fmt: skip


def imports_of(row: dict[str, Any]) -> str:
    """The seconds of the imports with and without Sionna, where the run kept them."""
    if "imports_cpu_s" not in row:
        return ""
    both = [sorted(row[key]) for key in ("imports_cpu_s", "imports_light_cpu_s")]
    text = "; ".join(f"{statistics.median(s):.2f} s, from {s[0]:.2f} to {s[-1]:.2f}" for s in both)
    return f" of {len(both[0])} times each: {text}"


def reports(run: dict[str, Any]) -> list[str]:
    """Compare reports with and without the audit with the imports that they need."""
    result = run["benchmarks"].get("report", {}).get("result")
    if not result or "later" not in result:
        return []
    rows = [("with `--audit none`, " + name, result["later"][key]) for key, name in WHEN.items()]
    rows = [("with the audit, " + name, result["now"][key]) for key, name in WHEN.items() if "now" in result] + rows
    short = result["two_channels"]
    return [
        "## A report", "",
        f"Processor time of a report of two channels ({short['flight']}). The table also compares it with the time of "
        f"`import sionna.rt, matplotlib.pyplot, pandas` alone, and of these imports without Sionna (medians"
        f"{imports_of(short)}). For the first report, all caches on the disk are empty (kernels, paths, fonts, LLVM "
        "test):", "",
        "| | seconds | times the imports | times the imports without Sionna | peak MiB |",
        "| --- | ---: | ---: | ---: | ---: |",
        *(
            f"| {name} | {row['cpu_s']:.1f} | {row['ratio']:.2f} | {row['ratio_light']:.2f} | {row['peak_mib']:.0f} |"
            for name, row in rows
        ),
        "",
    ]  # fmt: skip


def waits(run: dict[str, Any]) -> list[str]:
    """Commands that a user waits for: before, asked for, reached."""
    result = run["benchmarks"].get("waits", {}).get("result")
    if not result:
        return []
    return [
        "## Commands", "",
        "Processor time of complete processes whose caches were filled by an earlier run:", "",
        "| command | an earlier version [s] | goal [s] | now [s] | peak MiB |", "| --- | ---: | ---: | ---: | ---: |",
        *(
            f"| {row['command']} | {row['before_s']:g} | {row['asked_s']:g} | {row['cpu_s']:.1f} | "
            f"{row['peak_mib']:.0f} |"
            for row in result["rows"]
        ), "",
    ]  # fmt: skip


def page(history: list[dict[str, Any]]) -> str:
    """The text of docs/performance.md."""
    run = last_whole(history)
    machine, scaling = run["machine"], run["benchmarks"]["scaling"]["result"]
    unmeasured = [f"{name}: {entry['failed']}" for name, entry in run["benchmarks"].items() if "failed" in entry]
    lines = [
        "# Performance", "",
        "How long does a command take, how much memory does it need, and how does this grow with the size? Read this",
        "page before a large run. To measure your own machine:", "",
        "```", "aerpaw-cmp bench      # speed against error of the replay, about a minute", "```", "",
        "`make bench-all` makes this page: `python benchmarks/all.py` measures and appends to",
        "`benchmarks/history.jsonl`, and `python benchmarks/performance.py` writes the page from it. The numbers come",
        "from one run on one machine. Processor seconds are summed over all threads and processes. Other work on the",
        "machine increases them, so the load (the average number of running processes) is stated, too.", "",
        f"Last run: {run['date']}, version {run['version']}, {machine['processor']}, {machine['cpus']} processors, "
        f"{machine['memory_gib']} GiB, {machine['system']}, Python {machine['python']}; load {run['load_before']} "
        f"before, {run.get('load_after', '-')} after (the run causes 1 to 2), {run['seconds'] / 60:.1f} min in "
        f"all.{' Kernels of replays were compiled before the first row.' * ('load_after' in run)}", "",
        *([f"Not measured: {'; '.join(unmeasured)}.", ""] if unmeasured else []),
        *waits(run),
        *reports(run),
        "## Cost against size", "",
        f"![Processor time and memory against size](images/{FIGURE})", "",
        *scaling_tables(scaling),
        "## Extrapolated", "",
        *long_flight(scaling), *season(scaling), *city(scaling), "",
        *country(history), *peers(history), *town(history), *kriging(history),
    ]  # fmt: skip
    return "\n".join(lines).rstrip() + "\n"


def draw(scaling: dict[str, Any], path: Path) -> None:
    """Processor time (filled) and peak memory (open) against size, an axis each."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    axes = [axis for axis in scaling if axis != "workers" and measured(scaling, axis)]
    columns = 3
    fig = Figure(figsize=(10, 3.1 * math.ceil(len(axes) / columns)), layout="constrained")
    for number_, axis in enumerate(axes):
        ax = fig.add_subplot(math.ceil(len(axes) / columns), columns, number_ + 1)
        rows, title = measured(scaling, axis), AXES[axis][0]
        sizes = [size_of(row) for row in rows]
        ax.loglog(sizes, [r["cpu_s"] for r in rows], "o-", color="#0072B2", label="processor [s]")
        ax.loglog(sizes, [r["peak_mib"] for r in rows], "s--", color="#D55E00", fillstyle="none", label="peak [MiB]")
        ax.loglog(sizes, [rows[-1]["cpu_s"] * s / sizes[-1] for s in sizes], ":", color="#888888", label="linear")
        ax.set_xticks(sizes, [number(s) for s in sizes])
        ax.minorticks_off()
        ax.set_xlabel(title)
        ax.set_title(f"power {power(scaling[axis]['power_cpu'])}", loc="left", fontsize=9)
        ax.grid(visible=True, color="#E2E2E2")
        if number_ == 0:
            ax.legend(fontsize=8)
    canvas = FigureCanvasAgg(fig)
    fig.set_dpi(110)
    with path.open("wb") as file:
        canvas.print_png(file, metadata={"Software": None})


def main() -> None:
    """Write the page and its figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--history", type=Path, default=HISTORY)
    parser.add_argument("--docs", type=Path, default=ROOT / "docs")
    parser.add_argument("--measure", action="store_true", help="run benchmarks/all.py first, some nine minutes")
    arguments = parser.parse_args()
    if arguments.measure:
        subprocess.run([sys.executable, ROOT / "benchmarks" / "all.py"], check=False)  # a failed one is named
    history = runs(arguments.history)
    text = page(history)
    (arguments.docs / "images").mkdir(parents=True, exist_ok=True)
    draw(last_whole(history)["benchmarks"]["scaling"]["result"], arguments.docs / "images" / FIGURE)
    (arguments.docs / "performance.md").write_text(text, encoding="utf-8")
    print(*reports(last_whole(history)), *peers(history), *town(history), *kriging(history), sep="\n")
    print(arguments.docs / "performance.md")


if __name__ == "__main__":
    main()

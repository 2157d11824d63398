"""Scale test of campaigns: a season on a Dask cluster with lost workers and a lost scheduler, against the serial run.

    python benchmarks/season.py [--flights 100] [--towers 5] [--settings 3] [--samples 300] [--trivial 4000] [--part P]

Parts (all by default):

chaos     a campaign process on a scheduler with two workers; a worker is killed twice, the scheduler is killed and
          started again, the campaign itself is killed (SIGKILL) and run again: all rows, equal to the serial run
overhead  CPU of everything around a task (keys, store, scheduler, workers) against the CPU of a task, also of a real
          flight's size, which has to hold
memory    the scheduler's memory while real orders with trivial work go through
speed     two workers against one, 20 flights, taken in turn

Flights are simulated (10 different ones, the others fly on their logs with settings of their own); the audit, the
ladder and the figures are off. Everything lies in a temporary folder.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import dask
import numpy as np
import psutil
from distributed.security import Security
from season_flights import write_season

from aerpaw_cmp.jobs import campaign as job
from aerpaw_cmp.jobs.campaign_plan import batched, kept_outcomes, run_tasks
from aerpaw_cmp.jobs.campaign_tasks import Done, Order, carry_out
from aerpaw_cmp.jobs.workers import Here, open_workers

SECURITY = Security.temporary()
for _role in ("client", "scheduler", "worker"):
    for _kind in ("cert", "key"):
        _name = f"DASK_DISTRIBUTED__COMM__TLS__{_role}__{_kind}".upper()
        os.environ.setdefault(_name, getattr(SECURITY, f"tls_{_role}_{_kind}"))
os.environ.setdefault("DASK_DISTRIBUTED__COMM__TLS__CA_FILE", SECURITY.tls_ca_file)
dask.config.refresh()

# --- what the campaign gave -----------------------------------------------------------------------------------------


def flat(value: Any) -> Any:
    """Records and arrays as comparable text and bytes, to the last digit."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return tuple(flat(getattr(value, one.name)) for one in dataclasses.fields(value))
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, dict):
        return tuple((key, flat(one)) for key, one in value.items())
    return tuple(map(flat, value)) if isinstance(value, (list, tuple)) else repr(value)


def result(campaign: Path, keep: Path | None, **where: Any) -> Any:
    return job.run(job.load_campaign(campaign), campaign.parent, keep=keep, **where)


def stamps(keep: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in keep.glob("*.npz")}


# --- a cluster that can be hurt -------------------------------------------------------------------------------------


class Cluster:
    """A scheduler and workers as processes of their own."""

    def __init__(self, workers: int) -> None:
        with socket.socket() as one:
            one.bind(("127.0.0.1", 0))
            self.port = one.getsockname()[1]
        self.address = f"tls://127.0.0.1:{self.port}"
        self.count = workers
        self.start()

    def start(self) -> None:
        dask = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.scheduler = subprocess.Popen(
            [*dask, "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard", "--protocol", "tls"], **quiet
        )
        self.workers = [self._worker() for _ in range(self.count)]

    def _worker(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_worker", self.address, "--nthreads", "1", "--no-dashboard",
             "--death-timeout", "300", "--local-directory", tempfile.gettempdir()],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def kill_worker(self) -> None:
        """Kill the process that computes; its nanny starts another."""
        children = psutil.Process(self.workers[0].pid).children(recursive=True)
        heavy = max(children, key=lambda one: one.memory_info().rss)
        heavy.kill()

    def restart(self) -> None:
        self.scheduler.kill()
        self.scheduler.wait()
        for one in self.workers:
            self._end(one)
        self.start()

    @staticmethod
    def _end(one: subprocess.Popen[bytes]) -> None:
        for child in psutil.Process(one.pid).children(recursive=True):
            child.kill()
        one.kill()
        one.wait()

    def close(self) -> None:
        for one in self.workers:
            self._end(one)
        self.scheduler.kill()
        self.scheduler.wait()

    def cpu_s(self) -> float:
        """CPU of scheduler and workers so far."""
        found = 0.0
        for one in (self.scheduler, *self.workers):
            process = psutil.Process(one.pid)
            for each in (process, *process.children(recursive=True)):
                times = each.cpu_times()
                found += times.user + times.system
        return found


# --- parts ----------------------------------------------------------------------------------------------------------


def chaos(campaign: Path, folder: Path) -> bool:
    tasks, _, _ = job.campaign_tasks(job.load_campaign(campaign), campaign.parent)
    start = time.perf_counter()
    serial = result(campaign, folder / "serial")
    print(f"serial: {len(tasks)} tasks, {len(serial.rss)} rows, {time.perf_counter() - start:.0f} s")
    keep, cluster = folder / "chaos", Cluster(2)
    keep.mkdir()
    child = [sys.executable, __file__, "--child", str(campaign), str(keep), cluster.address]
    running = subprocess.Popen(child)
    done = [
        (0.15, "a worker is killed", cluster.kill_worker),
        (0.35, "a worker is killed again", cluster.kill_worker),
        (0.55, "the scheduler is killed and started again", cluster.restart),
        (0.75, "the campaign is killed", lambda: running.send_signal(signal.SIGKILL)),
    ]
    for share, words, action in done:
        while len(stamps(keep)) < share * len(tasks) and running.poll() is None:
            time.sleep(0.1)
        print(f"{len(stamps(keep))} of {len(tasks)} kept: {words}")
        action()
    running.wait()
    before = stamps(keep)
    print(f"run again: {len(before)} of {len(tasks)} are kept")
    again = subprocess.run(child, check=False).returncode
    after = stamps(keep)
    recomputed = sum(after.get(name) != stamp for name, stamp in before.items())
    cluster.close()
    end = result(campaign, keep)
    equal = flat(end.rss) == flat(serial.rss) and flat(end.repeats) == flat(serial.repeats)
    print(f"exit code {again}, {len(end.failures)} failures, finished tasks recomputed on resume: {recomputed}")
    print(f"{len(end.rss)} of {len(serial.rss)} rows, equal to the serial run to the last digit: {equal}")
    return equal and not recomputed and not end.failures and len(end.rss) == len(serial.rss)


def run_child(campaign: Path, keep: Path, address: str) -> None:
    result(campaign, keep, scheduler=address, progress=lambda text, share=None: None if share else print(f"  {text}"))


def nothing(orders: tuple[Order, ...]) -> list[Done]:
    """The shape of a batch of tasks without its work."""
    return [Done(outcome=None, host=order.task.flight) for order in orders]


def as_sent(orders: dict[int, Order], count: int) -> list[tuple[Order, ...]]:
    """So many orders in batches, as a campaign of that size sends them to two workers."""
    some = list(orders.values())
    many = dict(enumerate((some * -(-count // len(some)))[:count]))
    return [tuple(many[number] for number in batch) for batch in batched(many, 2)]


def overhead(campaign: Path, folder: Path) -> bool:
    tasks, _, _ = job.campaign_tasks(job.load_campaign(campaign), campaign.parent)
    some = tasks[: min(len(tasks), 30)]
    _, orders = kept_outcomes(some, str(folder / "overhead"), lambda *_: None)
    inner, outer = [], []
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # as a worker, which shares its work with no fork
    for order in orders.values():
        start = time.process_time()
        done = carry_out(order)
        outer.append(time.process_time() - start)
        inner.append(done.cpu_s)
    start = time.process_time()
    run_tasks(some, Here(), keep=str(folder / "overhead"))
    taking = (time.process_time() - start) / len(some)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    task = statistics.mean(inner[1:])
    around = statistics.mean(outer[1:]) - task
    cluster = Cluster(2)
    with open_workers(2, cluster.address) as crew:
        crew.run(nothing, as_sent(orders, 100), lambda *_: None)  # warm
        count, before, start = 1000, cluster.cpu_s(), time.process_time()
        crew.run(nothing, as_sent(orders, count), lambda *_: None)
        here, there = (time.process_time() - start) / count, (cluster.cpu_s() - before) / count
    cluster.close()
    whole = around + taking + here + there
    sent = as_sent(orders, count)
    print(f"{count / len(sent):.1f} tasks an order. ", end="")
    print(f"a task: {1e3 * task:.0f} CPU ms. Around it: key and store {1e3 * around:.1f} ms, taking it from the store")
    print(
        f"{1e3 * taking:.1f} ms, this process {1e3 * here:.1f} ms, scheduler and worker {1e3 * there:.1f} ms: ", end=""
    )
    print(f"{100 * whole / task:.1f} % of this task, {100 * whole:.1f} % of one of 1 CPU s")
    return whole / task < 0.05


def memory(campaign: Path, folder: Path, count: int) -> bool:
    tasks, _, _ = job.campaign_tasks(job.load_campaign(campaign), campaign.parent)
    _, orders = kept_outcomes(tasks[:30], str(folder / "none"), lambda *_: None)
    cluster = Cluster(2)
    process = psutil.Process(cluster.scheduler.pid)
    seen: dict[int, float] = {}

    def done(_number: int, _result: Any) -> None:
        seen[len(seen) + 1] = process.memory_info().rss / 2**20 if len(seen) % 100 == 0 else np.nan

    with open_workers(2, cluster.address) as crew:
        crew.run(nothing, as_sent(orders, count), done)
    cluster.close()
    known = {number: size for number, size in seen.items() if np.isfinite(size)}
    sizes = list(known.values())
    early, late = float(np.mean(sizes[: max(1, len(sizes) // 4)])), float(np.mean(sizes[-max(1, len(sizes) // 4) :]))
    print(f"scheduler over {count} tasks: {sizes[0]:.0f} MiB at the first, {early:.0f} in the first quarter, ", end="")
    print(f"{late:.0f} in the last, {max(sizes):.0f} at the most")
    return late < 1.1 * early


def speed(campaign: Path, folder: Path) -> bool:
    """Two clusters; the campaign goes to the one and the other in turn, so that both see the same load.

    (In pieces of five tasks, as it once was, two workers need three rounds: 1.67 times one worker at best.)
    """
    tasks, _, _ = job.campaign_tasks(job.load_campaign(campaign), campaign.parent)
    _, by_number = kept_outcomes(tasks, str(folder / "speed"), lambda *_: None)
    orders = [dataclasses.replace(order, keep=None) for order in by_number.values()]
    pieces = [orders, orders]
    spent: dict[int, list[float]] = {1: [], 2: []}
    cpu: dict[int, list[float]] = {1: [], 2: []}
    clusters = {1: Cluster(1), 2: Cluster(2)}
    with open_workers(2, clusters[1].address) as one, open_workers(2, clusters[2].address) as two:
        for crew in (one, two):
            crew.run(carry_out, orders[:4], lambda *_: None)  # imports
        for turn, piece in enumerate(pieces):
            for count, crew in ((1, one), (2, two)) if turn % 2 else ((2, two), (1, one)):
                before, start = clusters[count].cpu_s(), time.perf_counter()
                crew.run(carry_out, piece, lambda *_: None)
                spent[count].append(time.perf_counter() - start)
                cpu[count].append(clusters[count].cpu_s() - before)
    for cluster in clusters.values():
        cluster.close()
    ratio = sum(spent[1]) / sum(spent[2])
    print(
        f"{len(orders)} tasks, twice: one worker {sum(spent[1]):.1f} s, two {sum(spent[2]):.1f} s: {ratio:.2f} x",
        end=" ",
    )
    print(f"(CPU of scheduler and workers {sum(cpu[1]):.1f} and {sum(cpu[2]):.1f} s, {os.cpu_count()} cores, ", end="")
    print(f"load {os.getloadavg()[0]:.1f}: only an idle machine shows what two workers do)")
    return ratio >= 1.7


def main() -> int:
    if "--child" in sys.argv:
        run_child(Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4])
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("flights", 100), ("towers", 5), ("settings", 3), ("samples", 300), ("trivial", 4000)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--bootstrap", type=int, default=100)
    parser.add_argument("--part", action="append", choices=["chaos", "overhead", "memory", "speed"])
    asked = parser.parse_args()
    parts = asked.part or ["chaos", "overhead", "memory", "speed"]
    common = {"towers": asked.towers, "samples": asked.samples, "bootstrap": asked.bootstrap, "distinct": 10}
    good = []
    with tempfile.TemporaryDirectory(prefix="season-") as name:
        folder = Path(name)
        campaign = write_season(folder / "flights", asked.flights, settings=asked.settings, **common)
        few = write_season(folder / "flights", min(20, asked.flights), settings=1, **common)
        print(
            f"{vars(asked)}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, {threading.active_count()} thread"
        )
        for part in parts:
            print(f"--- {part}", flush=True)
            if part == "chaos":
                good.append(chaos(campaign, folder))
            elif part == "overhead":
                size = {"towers": 2, "samples": 3200, "bootstrap": 1000}  # of a real flight
                real = write_season(folder / "real", 2, settings=3, **size)
                print("of this season: ", end="", flush=True)
                overhead(campaign, folder)
                print(f"of a flight of a real size {size}: ", end="", flush=True)
                good.append(overhead(real, folder / "real"))
            elif part == "memory":
                good.append(memory(campaign, folder, asked.trivial))
            else:
                good.append(speed(few, folder))
    print(
        "every line holds"
        if all(good)
        else "NOT HELD: " + ", ".join(p for p, g in zip(parts, good, strict=True) if not g)
    )
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())

"""Run the scenarios of test_workers.py on real Dask clusters in a separate process, and print one JSON object.

A process of its own, since killed workers leave open sockets to the collector, which would warn in somebody else's test.
"""

import json
import socket
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import dask
import distributed
from distributed.security import Security
from worker_tasks import message, scenarios  # in the same folder

from aerpaw_cmp.jobs import workers
from aerpaw_cmp.jobs.workers import check_workers, open_workers

SECURITY = Security.temporary()
# as a user's configuration names them, there by files
dask.config.set(
    {
        "distributed.scheduler.allowed-failures": 0,  # each try is a new process, which takes seconds
        "distributed.comm.tls.ca-file": SECURITY.tls_ca_file,
        **{
            f"distributed.comm.tls.{role}.{kind}": getattr(SECURITY, f"tls_{role}_{kind}")
            for role in ("client", "scheduler", "worker")
            for kind in ("cert", "key")
        },
    }
)


def slow(number: int) -> int:
    time.sleep(0.05)
    return number * number


def on_a_cluster(folder: Path) -> dict[str, Any]:
    messages: list[str] = []
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, security=SECURITY, dashboard_address=None, silence_logs=50
    )
    plain = f"tcp://127.0.0.1:{_port()}"
    with cluster, open_workers(1, cluster.scheduler_address, progress=lambda text, *_: messages.append(text)) as crew:
        out = {
            "told": messages,
            "good": message(lambda: check_workers(crew._client, [folder])),
            "unseen": message(lambda: check_workers(crew._client, [folder / "nowhere"])),
            "plain": message(lambda: open_workers(1, plain).__enter__()),
        }
        real, workers.code_digest = workers.code_digest, lambda: "another"
        out["other"] = message(lambda: check_workers(crew._client, []))
        workers.code_digest = real
        out |= scenarios(crew, folder)
        # Dask cannot close a cluster while it restarts a worker ("can only join a started process")
        crew._client.wait_for_workers(2, timeout=60)
    return out


def _port() -> int:
    with socket.socket() as door:
        door.bind(("127.0.0.1", 0))
        return int(door.getsockname()[1])


def _scheduler(port: int) -> Any:
    """A scheduler and one worker in threads of this process."""
    return distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, scheduler_port=port, dashboard_address=None,
        silence_logs=50, protocol="tls://", security=SECURITY,
    )  # fmt: skip


def gone() -> str:
    """The scheduler ends in the middle."""
    port = _port()
    cluster = _scheduler(port)
    results: dict[int, int] = {}

    def done(number: int, result: Any) -> None:
        results[number] = result
        if len(results) == 3:
            threading.Thread(target=cluster.close).start()

    def run_all() -> None:
        with open_workers(1, f"tls://127.0.0.1:{port}") as crew:
            crew.run(slow, range(200), done)

    return message(run_all)


def none_there() -> str:
    workers.CONNECT_S = 0.5

    def open_one() -> None:
        with open_workers(1, f"tls://127.0.0.1:{_port()}"):
            pass

    return message(open_one)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        result = {"cluster": on_a_cluster(Path(name)), "gone": gone(), "none": none_there()}
    sys.stdout.write(json.dumps(result))

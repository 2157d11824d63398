"""Tasks for workers of every kind, and one suite of scenarios that each kind runs."""

import contextlib
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from aerpaw_cmp.common.errors import AerpawCmpError, InputError
from aerpaw_cmp.jobs.workers import InProcess, Lost


def square(number: int) -> int:
    return number * number


def refuses(number: int) -> int:
    """Task that ends with a message of the package for item 3."""
    if number == 3:
        raise InputError("found 3", expected="another number", path="numbers.txt", line=3)
    return number


def generator(number: int) -> Any:
    """Task whose result cannot be sent back."""
    return (i for i in range(number))


def message(action: Callable[[], Any]) -> str:
    try:
        action()
    except AerpawCmpError as error:
        return f"{type(error).__name__}: {error}"
    return "no error"


def scenarios(crew: Any, folder: Path) -> dict[str, Any]:
    """The suite: what any kind of workers returns for the same tasks. The caller's process cannot be killed."""
    outcomes = {
        "count": crew.count,
        "squares": collected(crew, square, list(range(25))),
        "no items": collected(crew, square, []),
        "message": message(lambda: collected(crew, refuses, list(range(6)))),
        "after a message": collected(crew, square, [2, 3]),
    }
    if not isinstance(crew, InProcess):
        outcomes["killed"] = collected(crew, dies, [(i, str(folder)) for i in range(8)])
        outcomes["not picklable"] = collected(crew, generator, [1])
    return outcomes


def dies(item: tuple[int, str]) -> int:
    """The third ends its worker the first time, the fifth every time."""
    number, folder = item
    mark = Path(folder) / str(number)
    if number == 5 or (number == 3 and not mark.exists()):
        mark.touch()
        time.sleep(0.7)  # Dask gives a worker up that ends before it has seen it start
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def collected(crew: Any, function: Any, items: list[Any]) -> list[Any]:
    results: dict[int, Any] = {}

    def done(number: int, result: Any) -> None:
        assert number not in results, "no task comes twice"
        results[number] = result.message if isinstance(result, Lost) else result

    crew.run(function, items, done)
    return [results[i] for i in range(len(items))]


def listening(_number: int) -> list[str]:
    """Sockets on which this process, its parent or its siblings listen, as the kernel lists them."""
    mine = set()
    for process in (os.getpid(), *family(os.getppid())):
        for link in Path(f"/proc/{process}/fd").iterdir():
            with contextlib.suppress(OSError):
                mine.add(str(link.readlink()))
    sockets = []
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            row = line.split()
            if f"socket:[{row[9]}]" in mine and (row[3] == "0A" or table.startswith("udp")):
                sockets.append(f"{table} {row[1]}")
    for line in Path("/proc/net/unix").read_text().splitlines()[1:]:
        row = line.split()
        if f"socket:[{row[6]}]" in mine and row[3] == "00010000":  # the flag of a socket that accepts
            sockets.append(f"unix {row[-1]}")
    return sockets


def family(parent: int) -> list[int]:
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    return [parent, *map(int, children)]


def sleeps(folder: str) -> None:
    Path(folder, str(os.getpid())).touch()
    time.sleep(600)

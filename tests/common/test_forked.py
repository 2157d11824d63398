"""What several processes compute is what one computes."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import types
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common import forked
from aerpaw_cmp.report import canvas

linux = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="work is shared by forked processes on Linux only"
)


def spec(number: int) -> canvas.FigureSpec:
    def draw():
        fig = canvas.figure((3.0, 2.0))
        fig.subplots().plot(np.arange(5) * number)
        return fig

    return canvas.FigureSpec(name=f"p{number}", section="s", title="t", caption="c", alt="a", draw=draw)


@linux
def test_bytes_and_order_are_those_of_one_process() -> None:
    draws = [partial(canvas.render, spec(n), ("svg", "png")) for n in range(5)]
    alone = list(forked.in_order(draws, 1))
    shared = list(forked.in_order(draws, 2))
    assert [p.name for p in shared] == [f"p{n}" for n in range(5)]
    for one, other in zip(alone, shared, strict=True):
        assert one.formats["png"] == other.formats["png"]
        assert one.formats["svg"] == other.formats["svg"]


@linux
def test_they_run_elsewhere_and_one_that_dies_is_made_up_for() -> None:
    here = os.getpid()
    assert here not in list(forked.in_order([os.getpid] * 4, 2))

    def dies(number: int) -> int:
        if number == 2 and os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    assert list(forked.in_order([partial(dies, n) for n in range(5)], 2)) == list(range(5))


@linux
def test_processes_end_with_a_killed_parent() -> None:
    code = (
        "import os, time; from aerpaw_cmp.common.forked import in_order\n"
        "def draw():\n    os.write(1, f'{os.getpid()}\\n'.encode()); time.sleep(120)\n"
        "list(in_order([draw] * 4, 2))"
    )
    run = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert run.stdout is not None
    children = [int(run.stdout.readline()) for _ in range(2)]
    assert all(alive(child) for child in children)
    run.kill()
    run.stdout.close()
    run.wait()
    until = time.monotonic() + 20
    while any(alive(child) for child in children) and time.monotonic() < until:
        time.sleep(0.05)
    left = [child for child in children if alive(child)]
    for child in left:
        os.kill(child, signal.SIGKILL)
    assert not left


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def test_a_fault_in_a_figure_comes_through() -> None:
    with pytest.raises(ZeroDivisionError):
        list(forked.in_order([lambda: 1 / 0] * 3, 2 if sys.platform.startswith("linux") else 1))


@linux
def test_what_cannot_be_carried_and_what_is_large_arrive() -> None:
    functions = list(forked.in_order([lambda: lambda: 7] * 3, 2))  # a lambda cannot be pickled
    assert [one() for one in functions] == [7] * 3
    large = list(forked.in_order([partial(np.full, 1_000_000, float(n)) for n in range(5)], 2))
    assert [one[-1] for one in large] == [0.0, 1.0, 2.0, 3.0, 4.0]


@linux
def test_this_process_is_free_meanwhile_and_nothing_is_left_running(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forked, "usable_processes", lambda: 2)

    def slow() -> tuple[int, float]:
        begun = time.monotonic()
        time.sleep(0.3)
        return os.getpid(), begun

    with forked.beside(slow) as there:
        time.sleep(0.3)
        ended = time.monotonic()
        process, begun = there()
    assert process != os.getpid()
    assert begun < ended, "the other began while this one was at work"
    with pytest.raises(KeyError), forked.ahead([partial(time.sleep, 60)] * 2, 2):
        raise KeyError
    assert not multiprocessing.active_children()


@linux
def test_what_was_frozen_stays_frozen_and_nothing_else_is() -> None:
    before = gc.get_freeze_count()
    gc.unfreeze()
    try:
        list(forked.in_order([os.getpid] * 2, 2))
        assert gc.get_freeze_count() == 0
        gc.freeze()
        list(forked.in_order([os.getpid] * 2, 2))
        assert gc.get_freeze_count() > 0
    finally:
        if not before:
            gc.unfreeze()


@linux
def test_a_worker_among_others_makes_no_further_processes() -> None:
    assert list(forked.in_order([forked.usable_processes] * 2, 2)) == [1, 1]


def test_no_fork_where_it_is_unsafe_or_pays_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forked.os, "sched_getaffinity", lambda _: set(range(16)), raising=False)
    monkeypatch.setattr(forked.sys, "platform", "linux")
    for name in ("drjit", "mitsuba", "numba.cuda"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setattr(forked.threading, "active_count", lambda: 1)
    assert forked.usable_processes() == forked.MOST
    monkeypatch.setitem(sys.modules, "drjit", types.ModuleType("drjit"))
    assert forked.usable_processes() == 1
    assert list(forked.in_order([os.getpid] * 9)) == [os.getpid()] * 9
    monkeypatch.delitem(sys.modules, "drjit")
    assert list(forked.in_order([os.getpid] * 3, fewest=4)) == [os.getpid()] * 3
    monkeypatch.setattr(forked.threading, "active_count", lambda: 2)
    assert forked.usable_processes() == 1
    monkeypatch.undo()
    assert threading.active_count() >= 1
    monkeypatch.setattr(forked.sys, "platform", "darwin")
    assert forked.usable_processes() == 1

"""Check that swallowed or wrapped interrupts are raised again.

Interrupts that are held back are raised once, at the end.
"""

import os
import signal
import subprocess
import sys

import pytest

from aerpaw_cmp import __main__
from aerpaw_cmp.common import interrupts, outputs
from aerpaw_cmp.common.errors import InputError, add_note
from aerpaw_cmp.common.outputs import OutputFile, OutputFolder
from aerpaw_cmp.common.stages import Stages
from aerpaw_cmp.live.ports import Stop


@pytest.fixture(autouse=True)
def _default_handler():
    """A run in the background ignores interrupts, and so would the tests."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


class Finalised:
    """Interrupt code in which Python prints "Exception ignored in" and continues."""

    def __del__(self) -> None:
        interrupt()


def swallowed() -> None:
    Finalised()


def test_a_swallowed_interrupt_ends_the_job_before_its_next_stage():
    reached, before = [], sys.unraisablehook

    def job() -> None:
        with Stages()("one"):
            swallowed()
            reached.append("one")
        with Stages()("two"):
            reached.append("two")

    with pytest.raises(KeyboardInterrupt), interrupts.noted():
        job()
    assert reached == ["one"]
    with Stages()("a later job"):  # is not ended by it
        assert not interrupts.interrupted()
    assert sys.unraisablehook is before


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_a_swallowed_interrupt_leaves_the_old_output_and_says_so(tmp_path, kind):
    name = tmp_path / "out"

    def job() -> None:
        if kind == "file":
            with OutputFile(name, own=lambda _: True) as output:
                swallowed()
                output.write(b"new")
        else:
            with OutputFolder(name, job="report") as output, output.filling() as folder:
                (folder / "a.txt").write_text("new")
                swallowed()

    with pytest.raises(KeyboardInterrupt) as caught, interrupts.noted():
        job()
    assert caught.value.__notes__ == [f"{name} was not written"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("wrapped", [RuntimeError("Error calling __set_name__"), InputError("a cut pipe")])
def test_an_interrupt_that_became_another_error_is_told_as_one(wrapped, monkeypatch, capsys):
    def job(_arguments: list[str]) -> int:
        try:
            interrupt()
            raise AssertionError("not interrupted")
        except KeyboardInterrupt:
            add_note(wrapped, "out is as it was before")
            raise wrapped from None

    monkeypatch.setattr("aerpaw_cmp.cli.main", job)
    assert __main__.main(["ingest"]) == 130
    assert capsys.readouterr().err == "aerpaw-cmp: interrupted; out is as it was before\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_without_an_interrupt_an_error_stays_what_it_is():
    with pytest.raises(RuntimeError), interrupts.noted():
        raise RuntimeError


def test_held_interrupts_come_once_and_at_the_end():
    done = []

    def block() -> None:
        interrupt()
        interrupt()
        done.append("the whole block")

    with pytest.raises(KeyboardInterrupt), interrupts.held():
        block()
    assert done == ["the whole block"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_error_inside_goes_before_a_held_interrupt():
    def block() -> None:
        interrupt()
        raise ValueError("first")

    with pytest.raises(ValueError, match="first"), interrupts.held():
        block()


def test_a_process_that_ignores_interrupts_goes_on_ignoring_them():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interrupts.noted(), interrupts.held():
        interrupt()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    assert not interrupts.interrupted()


@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGHUP", 129), ("SIGINT", 130)])
def test_each_signal_is_told_and_ends_with_its_code(name, code, monkeypatch, capsys, tmp_path):
    def job(_arguments: list[str]) -> int:
        with OutputFile(tmp_path / "out", own=lambda _: True):
            os.kill(os.getpid(), getattr(signal, name))
        raise AssertionError("not interrupted")

    monkeypatch.setattr("aerpaw_cmp.cli.main", job)
    before = signal.getsignal(signal.SIGTERM)
    assert __main__.main(["ingest"]) == code
    word = "interrupted" if name == "SIGINT" else f"ended by {name}"
    assert capsys.readouterr().err == f"aerpaw-cmp: {word}; {tmp_path / 'out'} was not written\n"
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) == before


# A signal comes during a call of compiled code that lasts ten minutes; ``held`` lets the one of a second go on.
LONG_CALL = """
import contextlib, hashlib, os, signal, sys, threading
from pathlib import Path
from aerpaw_cmp.common import interrupts
from aerpaw_cmp.common.outputs import OutputFile

signal.signal(signal.SIGINT, signal.default_int_handler)
rounds, hold = int(sys.argv[1]), interrupts.held if sys.argv[2] == "held" else contextlib.nullcontext
threading.Timer(0.1, os.kill, [os.getpid(), signal.SIGTERM]).start()
with interrupts.noted(), OutputFile(Path("out"), own=lambda _: True), hold():
    hashlib.pbkdf2_hmac("sha256", b"", b"", rounds)
    print("not interrupted", flush=True)
"""


@pytest.mark.parametrize(("rounds", "how"), [(10**9, "plain"), (2 * 10**6, "held")])
def test_a_signal_is_heard_in_the_middle_of_compiled_code(rounds, how, tmp_path):
    words = [sys.executable, "-c", LONG_CALL, str(rounds), how]
    run = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, timeout=300, check=False)
    if how == "plain":
        assert (run.returncode, run.stdout) == (128 + signal.SIGTERM, "")
        assert run.stderr == "aerpaw-cmp: ended by SIGTERM in a long calculation; its output was not written\n"
    else:
        assert run.stdout == "not interrupted\n"
        assert "KeyboardInterrupt" in run.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_an_interrupt_while_the_hidden_place_is_made_leaves_none(tmp_path, kind, monkeypatch, capsys):
    plain = outputs._lock

    def locked(descriptor: int) -> bool:
        os.kill(os.getpid(), signal.SIGTERM)
        return plain(descriptor)

    def job(_arguments: list[str]) -> int:
        name = tmp_path / "out"
        with OutputFile(name, own=lambda _: True) if kind == "file" else OutputFolder(name, job="report"):
            raise AssertionError("not interrupted")

    monkeypatch.setattr(outputs, "_lock", locked)
    monkeypatch.setattr("aerpaw_cmp.cli.main", job)
    assert __main__.main(["ingest"]) == 143
    assert list(tmp_path.iterdir()) == []


def test_a_hang_up_that_nohup_ignores_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupts.noted(), interrupts.held():
            os.kill(os.getpid(), signal.SIGHUP)
        with Stop():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_an_interrupt_that_met_an_exec_ends_with_its_exit_code(tmp_path):
    """An interrupt in exec(), which makes dataclasses, ends ``-m`` with exit code 130, not by the signal."""
    (tmp_path / "program.py").write_text(
        "import sys\n"
        "from aerpaw_cmp import __main__ as program, cli\n"
        "cli.main = lambda _: exec('raise KeyboardInterrupt')\n"
        "sys.exit(program.main(['ingest']))\n"
    )
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    command = [sys.executable, "-m", "program"]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": paths}, check=False, timeout=60)
    assert done.returncode == 130

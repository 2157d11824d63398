"""The way into the program: light help, one message per failure, exit codes."""

import os
import subprocess
import sys
import types
from pathlib import Path

import pytest

import aerpaw_cmp
from aerpaw_cmp import __main__ as program
from aerpaw_cmp.common.errors import CheckError, InputError, UsageError, next_step, typed
from aerpaw_cmp.common.text import COMMANDS
from aerpaw_cmp.common.versions import tool_version

pytestmark = pytest.mark.usefixtures("few_pictures")

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {"sionna", "mitsuba", "drjit", "matplotlib", "pandas", "numpy", "scipy", "h5py"}
HEAVY |= {"typer", "click", "rich", "pydantic"}


def python(*arguments: str, **environ: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env={**os.environ, **environ},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    "statement", ["import aerpaw_cmp", "main(['--help'])", "main(['--version'])", "main([])", "main(['x'])"]
)
def test_nothing_heavy_is_loaded(statement: str) -> None:
    done = python(
        "-c", f"from aerpaw_cmp.__main__ import main; import sys; {statement}; print(*sys.modules, file=sys.stderr)"
    )
    loaded = {name.partition(".")[0] for name in done.stderr.split()}
    assert "aerpaw_cmp" in loaded
    assert loaded.isdisjoint(HEAVY), loaded.intersection(HEAVY)


@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_help_names_every_command(flag: str) -> None:
    done = python("-m", "aerpaw_cmp", flag)
    assert done.returncode == 0
    assert done.stderr == ""
    for name, line in COMMANDS.items():
        assert f"  {name} " in done.stdout
        assert line in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 100


def test_version() -> None:
    assert python("-m", "aerpaw_cmp", "--version").stdout == f"aerpaw-cmp {tool_version()}\n"


def test_no_arguments_is_help_and_wrong_usage() -> None:
    done = python("-m", "aerpaw_cmp")
    assert done.returncode == 2
    assert done.stdout.startswith("Usage:")


def test_unknown_command_names_the_nearest() -> None:
    done = python("-m", "aerpaw_cmp", "reprot", "x.yaml")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == "aerpaw-cmp: there is no command 'reprot'; did you mean 'report'?\n"


@pytest.fixture
def command_line(monkeypatch: pytest.MonkeyPatch):
    """Put a function in the place of ``aerpaw_cmp.cli.main``."""

    def put(function) -> None:
        module = types.ModuleType("aerpaw_cmp.cli")
        module.main = function  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "aerpaw_cmp.cli", module)
        monkeypatch.setattr(aerpaw_cmp, "cli", module, raising=False)

    monkeypatch.delenv("AERPAW_CMP_DEBUG", raising=False)
    return put


def raising(error: BaseException):
    def main(arguments: list[str]) -> int:
        raise error

    return main


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (CheckError("RMSE 7 dB", expected="at most 5 dB"), 1, "aerpaw-cmp: RMSE 7 dB; expected at most 5 dB. Next: "),
        (
            UsageError("unknown key 'sight'", path="f.yaml", line=3),
            2,
            "aerpaw-cmp: f.yaml, line 3: unknown key 'sight'. Next: 'aerpaw-cmp report --help' lists the options\n",
        ),
        (UsageError("spacing 0 m"), 2, ": spacing 0 m. Next: correct the options and run the same command ('aer"),
        (UsageError("Got unexpected extra argument(s) (b.yaml)"), 2, "Next: the same command without b.yaml\n"),
        (InputError("the file is empty", path="a.txt"), 3, "aerpaw-cmp: a.txt: the file is empty. Next: 'ls "),
        (UsageError("LW1 has no positions and there is no telemetry log"), 2, "'aerpaw-cmp ingest LOG TELEMETRY"),
        (KeyboardInterrupt(), 130, "aerpaw-cmp: interrupted\n"),
        (ModuleNotFoundError("x", name="distributed"), 1, "the Python package 'distributed' is not installed"),
    ],
)
def test_one_message_and_the_exit_code(error: BaseException, code: int, said: str, command_line, capsys) -> None:
    command_line(raising(error))
    assert program.main(["report"]) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("name", ["a.txt", "a b.txt", "März", "it's", "a'\"$(date)`", "a\\b !"])
def test_a_typed_path_is_one_word_of_the_shell(name: str) -> None:
    assert (
        subprocess.run(["sh", "-c", f"printf %s {typed(name)}"], capture_output=True, check=True).stdout
        == name.encode()
    )


@pytest.mark.parametrize(
    ("error", "arguments", "step"),
    [
        (InputError("there is no such log", path="LW1/lo.txt"), "report my.yaml", "replace lo.txt by log.txt in my.yaml and run"),
        (InputError("the file does not exist", path="LW1/lo.txt"), "ingest LW1/lo.txt", "the same command with LW1/log.txt"),
        (UsageError("a folder", expected="a YAML file", path="LW1"), "report my.yaml --with LW1", "the same command with LW1.yaml"),
        (UsageError("not YAML", path="LW1/log.txt"), "report LW1/log.txt", "correct log.txt or name another file"),
        (UsageError("named twice", path="my.yaml"), "calibrate my.yaml my.yaml", "the same command with my.yaml once"),
        (UsageError("unknown key", path="my.yaml", line=3), "report my.yaml", "fix my.yaml, line 3, and run"),
        (InputError("no table", path="LW1.yaml"), "report my.yaml --against LW1.yaml", "the same command with the folder ."),
        (InputError("its own logs", path="LW1"), "report my.yaml --against LW1/", "name another prediction and run"),
        (UsageError("changed (SHA-256 in its first line)", path="my.yaml"), "report my.yaml", "copy my.yaml again"),
    ],
)  # fmt: skip
def test_a_next_step_can_be_typed(error, arguments: str, step: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "LW1").mkdir()
    for name in ("my.yaml", "LW1.yaml", "LW1/log.txt"):
        (tmp_path / name).touch()
    assert next_step(error, arguments.split()).startswith(step)


def test_a_fault_of_ours_is_called_one(command_line, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    command_line(raising(ZeroDivisionError("division by zero")))
    assert program.main(["report"]) == 70
    err = capsys.readouterr().err
    assert "internal error, ZeroDivisionError: division by zero" in err
    assert "Traceback" not in err
    assert program.main(["report", "--debug"]) == 70
    assert "Traceback" in capsys.readouterr().err
    monkeypatch.setenv("AERPAW_CMP_DEBUG", "1")
    assert program.main(["report"]) == 70
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["report"], 2, "aerpaw-cmp report: Missing argument 'flight'; 'aerpaw-cmp report --help' lists the options"),
        (["report", "f.yaml", "--nope"], 2, "aerpaw-cmp report: No such option: --nope"),
        (["report", "f.yaml", "--batch", "many"], 2, "aerpaw-cmp report: "),
        (["report", "f.yaml", "--batch", "3"], 3, ""),
        (["report", "f.yaml"], 0, ""),
    ],
)
def test_wrong_options_are_one_line_whatever_copy_of_click_typer_uses(
    arguments: list[str], code: int, said: str, command_line, capsys
) -> None:
    import typer

    app = typer.Typer(add_completion=False)

    @app.command("report")
    def report(flight: str, batch: int = 0) -> None:
        raise typer.Exit(batch)

    @app.command("formats")
    def formats() -> None: ...

    command_line(lambda words: app(args=words, prog_name="aerpaw-cmp", standalone_mode=False) or 0)
    assert program.main(arguments) == code
    err = capsys.readouterr().err
    assert err.startswith(said)
    assert err.count("\n") == bool(said)


def test_debug_is_taken_out_of_the_arguments_but_not_after_two_dashes(command_line) -> None:
    seen: list[list[str]] = []
    command_line(lambda arguments: seen.append(arguments) or 0)
    assert program.main(["report", "--debug", "f.yaml"]) == 0
    assert program.main(["report", "--", "--debug"]) == 0
    assert seen == [["report", "f.yaml"], ["report", "--", "--debug"]]


def test_a_reader_that_goes_away_is_no_fault() -> None:
    """The pipe's far end is closed before the first line is written."""
    code = (
        "import sys, types, aerpaw_cmp; module = types.ModuleType('aerpaw_cmp.cli');"
        "module.main = lambda arguments: print('line' * 100000) or 0;"
        "sys.modules['aerpaw_cmp.cli'] = aerpaw_cmp.cli = module;"
        "from aerpaw_cmp.__main__ import main; sys.exit(main(['formats']))"
    )
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, stdout=write, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


FULL = Path("/dev/full")


@pytest.mark.skipif(not FULL.exists(), reason="Linux has a disk that is always full")
@pytest.mark.parametrize(
    ("line", "redirect", "code", "said"),
    [
        ("--help", ">/dev/full", 3, "the results cannot be written to standard output (No space left on device)"),
        ("formats", ">/dev/full", 3, "the results cannot be written to standard output (No space left on device)"),
        ("formats --json", ">&-", 3, "the results cannot be written to standard output (Bad file descriptor)"),
        ("formats", "<&-", 0, ""),
        ("reprot", "2>&- >&-", 2, ""),
        ("reprot", "2>/dev/full >/dev/full", 2, ""),
        ("formats", ">/dev/full 2>/dev/full", 3, ""),
    ],
)
def test_a_standard_stream_that_is_full_or_closed_is_no_fault_of_the_program(
    line: str, redirect: str, code: int, said: str
) -> None:
    command = ["sh", "-c", f'"$0" -m aerpaw_cmp {line} {redirect}', sys.executable]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == code, done.stderr
    assert said in done.stderr
    assert done.stderr.count("\n") == bool(said)


def test_an_output_does_not_take_the_place_of_a_closed_stream(tmp_path: Path) -> None:
    """Else the first file that is opened would be standard output, and get what is printed."""
    command = ["sh", "-c", '"$0" -m aerpaw_cmp ingest sample_logs/UAV/modem_ri.csv --timezone UTC -o "$1" >&- 2>&- <&-']
    done = subprocess.run([*command, sys.executable, str(tmp_path / "f.h5")], cwd=ROOT, check=False, timeout=60)
    assert done.returncode == 3  # the table could not be shown
    from aerpaw_cmp.logs.flight_file import is_flight_file

    assert is_flight_file(tmp_path / "f.h5")


@pytest.mark.parametrize(("given", "used"), [(None, "1"), ("3", "3")])
def test_blas_uses_one_thread_unless_the_user_says_otherwise(given: str | None, used: str) -> None:
    environ = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environ |= {} if given is None else {"OPENBLAS_NUM_THREADS": given}
    code = "import os, sys; from aerpaw_cmp.__main__ import main; sys.argv[1:] = ['--help']; main(); print(os.environ['OPENBLAS_NUM_THREADS'])"
    done = subprocess.run([sys.executable, "-c", code], env=environ, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == used

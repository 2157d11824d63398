"""Conventions of every command: -h, examples that parse, --quiet, --json, completion, messages of interrupts."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.outputs import OutputFolder
from aerpaw_cmp.common.text import COMMANDS
from tests.geojson import collection, feature, polygon
from tests.test_docs import PROGRAM, check

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "sample_logs"


def leaves(group: Any, *names: str) -> dict[tuple[str, ...], Any]:
    """Every command of the program by its words."""
    commands: dict[tuple[str, ...], Any] = {}
    for name, command in group.commands.items():
        commands |= leaves(command, *names, name) if hasattr(command, "commands") else {(*names, name): command}
    return commands


LEAVES = leaves(PROGRAM)
EACH = pytest.mark.parametrize("words", LEAVES, ids=" ".join)


def examples_of(words: tuple[str, ...]) -> list[str]:
    return [line.strip() for line in (LEAVES[words].epilog or "").splitlines() if line.startswith("  ")]


def test_the_table_of_commands_and_the_program_agree() -> None:
    assert set(PROGRAM.commands) == set(COMMANDS)


@EACH
def test_every_command_has_help_quiet_json_and_examples_that_parse(words: tuple[str, ...]) -> None:
    options = {option for parameter in LEAVES[words].params for option in parameter.opts}
    assert {"--quiet", "-q", "--json"} <= options
    lines = examples_of(words)
    assert lines
    for line in lines:
        *first, own = line.split(" && ")  # what an example needs may come before
        assert shlex.split(own)[1 : 1 + len(words)] == list(words), "an example shows its own command"
        for command in (*first, own):
            check(command, in_block=True)


@EACH
@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_help_with_both_names(words: tuple[str, ...], flag: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words, flag]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"Usage: aerpaw-cmp {' '.join(words)}")
    for line in examples_of(words):
        assert line in shown.splitlines() or f"    {line}" in shown.splitlines(), "not broken"


def cheap(tmp: Path) -> dict[str, tuple[list[str], list[str]]]:
    """Commands that are cheap to run: their line, and what puts their input there."""
    barn = [[-78.6975, 35.7280], [-78.6972, 35.7280], [-78.6972, 35.7282], [-78.6975, 35.7280]]
    (tmp / "map.geojson").write_text(json.dumps(collection(feature(polygon(barn), building="yes"))))
    return {
        "formats": [],
        "sample": ["-o", f"{tmp}/sample"],
        "ingest": [f"{SAMPLE}/LW1", "--timezone", "America/New_York", "-o", f"{tmp}/f.h5", "--draft", f"{tmp}/f.yaml"],
        "site import": [f"{tmp}/map.geojson", "-o", f"{tmp}/site.yaml"],
    }


@pytest.mark.parametrize("words", ["formats", "sample", "ingest", "site import"])
def test_json_is_one_object_and_quiet_says_nothing(
    words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = [*words.split(), *cheap(tmp_path)[words]]
    assert main(line) in (0, 1)
    loud = capsys.readouterr()
    assert main([*line, "--json", "--quiet"]) in (0, 1)
    out, err = capsys.readouterr()
    assert isinstance(json.loads(out), dict)
    assert err == ""
    assert main([*line, "-q"]) in (0, 1)
    hushed = capsys.readouterr()
    # the lines of a draft that must be checked are warnings
    checks = [text for text in hushed.err.splitlines() if "check: " in text]
    assert bool(checks) == (words == "ingest")
    assert len(checks) + (words == "ingest") == len(hushed.err.splitlines())
    assert hushed.out == loud.out, "what was asked for is still shown"
    if words == "site import":
        assert "kept from the base 'lake_wheeler': the name 'Lake Wheeler" in loud.err
        assert "LW1, LW2" in loud.err


def test_json_of_the_commands_that_only_write_files(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from aerpaw_cmp.jobs import run
    from aerpaw_cmp.jobs.options import JobOutcome

    written = JobOutcome(folder=Path(), files=(Path("a.txt"), Path("b.txt")))
    for name, line in (("run_site_show", ["site", "show"]), ("run_simulate", ["simulate", "plan.yaml"])):
        monkeypatch.setattr(run, name, lambda *_, **__: written)
        assert main([*line, "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == {"schema": 1, "files": ["a.txt", "b.txt"]}
        assert main(line) == 0
        assert capsys.readouterr().out.split() == ["a.txt", "b.txt"]


def shell(shell_name: str, words: str) -> subprocess.CompletedProcess[str]:
    environ = {**os.environ, "_AERPAW_CMP_COMPLETE": f"complete_{shell_name}", "_TYPER_COMPLETE_ARGS": words}
    environ |= {"COMP_WORDS": words, "COMP_CWORD": str(len(words.split(" ")) - 1)}
    code = (
        "import sys; from aerpaw_cmp.__main__ import main\ntry: main([])\nfinally: print(*sys.modules, file=sys.stderr)"
    )
    return subprocess.run([sys.executable, "-c", code], env=environ, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("words", "offered"),
    [("aerpaw-cmp rep", "report"), ("aerpaw-cmp site s", "show"), ("aerpaw-cmp report --qui", "--quiet"),
     ("aerpaw-cmp explain --engine s", "sionna")],
)  # fmt: skip
def test_tab_offers_commands_options_and_values_and_loads_nothing_heavy(words: str, offered: str) -> None:
    done = shell("bash", words)
    assert done.stdout.split() == [offered]
    loaded = {name.partition(".")[0] for name in done.stderr.split()}
    assert loaded.isdisjoint({"numpy", "pandas", "matplotlib", "sionna", "mitsuba", "scipy", "h5py"})


@pytest.mark.parametrize("name", ["bash", "zsh", "fish"])
def test_a_completion_script_for_each_shell(name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "aerpaw_cmp", "--show-completion", name], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0
    assert "aerpaw-cmp" in done.stdout
    assert "_AERPAW_CMP_COMPLETE" in done.stdout


def test_an_interrupted_campaign_says_where_its_outcomes_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("aerpaw_cmp.jobs.campaign.run", stop)
    file = tmp_path / "campaign.yaml"
    file.write_text(f"campaign: c\nflights: [{SAMPLE / 'flight.yaml'}]\n")
    line = ["campaign", str(file), "-o", str(tmp_path / "out")]
    for more, said in (
        (["--keep", str(tmp_path / "k")], f"finished tasks are stored in {tmp_path / 'k'}"),
        (["--fresh"], "nothing is stored"),
    ):
        assert main([*line, *more]) == 130
        err = capsys.readouterr().err
        assert said in err
        assert f"{tmp_path / 'out'} was not written" in err


def test_a_file_that_ends_too_early_is_no_interrupt(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ends(*_: Any, **__: Any) -> None:
        raise EOFError("marshal data too short")

    monkeypatch.setattr("aerpaw_cmp.jobs.run.run_ingest", ends)
    assert main(["ingest", str(SAMPLE)]) == 70
    assert "EOFError: marshal data too short" in capsys.readouterr().err


def test_an_interrupt_says_what_is_kept(tmp_path: Path) -> None:
    before = tmp_path / "r" / "a.html"
    with OutputFolder(before.parent, job="report") as output, output.filling() as folder:
        (folder / "a.html").write_text("an earlier report")
    words = f"-m aerpaw_cmp report {SAMPLE / 'flight.yaml'} --audit none -o".split()
    line = [sys.executable, *words, str(before.parent)]
    run = subprocess.Popen(
        line, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a job in the background ignores it
    )  # fmt: skip
    assert run.stderr is not None
    assert run.stderr.readline() == "read\n"
    time.sleep(0.3)
    run.send_signal(signal.SIGINT)
    out, err = run.communicate(timeout=60)
    assert (run.returncode, out) == (130, "")
    assert err.splitlines()[-1] == f"aerpaw-cmp: interrupted; {before.parent} is as it was before"
    assert before.read_text() == "an earlier report"
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


def test_words_of_strangers_are_shown_and_not_obeyed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A table, paragraphs, lines and warnings with the title of a window in a channel's name."""
    from aerpaw_cmp.cli.shown import print_files, show, table, warn_all

    name = "\x1b]0;PWN\a\x9b2J\rUSRP1\u202e"
    for width in (None, 30):
        table(["channel", f"{name} dB"], [[name, "1.0"], ["USRP1 " * 9, "2.0"]], name, width=width)
    show(f"two lines\n{name}")
    print_files([Path(name)])
    warn_all([name])
    out, err = capsys.readouterr()
    for text in (out, err):
        assert "x1b]0;PWN" in text
        assert all(character.isprintable() or character == "\n" for character in text)

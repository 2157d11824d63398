"""One timer and one progress: stages add up, a share is a number, and a terminal shows the time left."""

import sys
import time
from typing import Any

import pytest

from aerpaw_cmp.cli import shown
from aerpaw_cmp.common import stages
from aerpaw_cmp.common.stages import Stages


def test_stages_keep_their_order_and_add_up() -> None:
    calls: list[tuple[str, float | None]] = []
    stages = Stages(lambda text, fraction=None: calls.append((text, fraction)))
    for name in ("read", "replay", "read"):
        with stages(name):
            time.sleep(0.002)
    with pytest.raises(ZeroDivisionError), stages("fails"):
        _ = 1 / 0
    assert list(stages.seconds) == ["read", "replay", "fails"]
    assert stages.seconds["read"] >= 0.004 > 0.002 <= stages.seconds["replay"]
    stages.progress("maps", 0.5)
    assert calls == [("read", None), ("replay", None), ("fails", None), ("maps", 0.5)]


def test_calls_from_python_log_their_progress(
    caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    with caplog.at_level("DEBUG", logger="aerpaw_cmp"):
        stages = Stages()
        with stages("replay"):
            stages.progress("replay LW1", 0.5)
    lines = [(record.name, record.levelname, record.getMessage()) for record in caplog.records]
    assert lines == [("aerpaw_cmp", "INFO", "replay"), ("aerpaw_cmp", "DEBUG", "replay LW1 50 %")]
    assert capfd.readouterr() == ("", "")


def test_a_share_is_a_line_per_quarter_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    progress = shown.ProgressLines()
    for i in range(101):
        progress("sionna LW1", i / 100)
    progress("50 %")  # a text without a share is printed as a line, even if it ends like a share
    out = capsys.readouterr()
    assert out.out == ""
    assert out.err.splitlines() == [f"sionna LW1 {q} %" for q in (25, 50, 75, 100)] + ["50 %"]


def test_a_slow_share_is_a_line_every_half_minute(capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter(range(0, 10_000, 11))
    monkeypatch.setattr(shown.time, "monotonic", lambda: next(now))
    progress = shown.ProgressLines()
    for i in range(1, 9):
        progress("maps", i / 100)
    # each call, and each printed line, takes 11 s
    assert capsys.readouterr().err.splitlines() == ["maps 3 %", "maps 6 %"]


def test_a_terminal_gets_one_bar_with_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    progress = shown.ProgressLines()
    progress("maps", 0.25)
    bar = progress._bar
    time.sleep(0.02)
    progress("maps", 0.75)
    assert progress._bar is bar
    assert bar.tasks[0].percentage == 75
    assert bar.tasks[0].time_remaining is not None
    progress("page")
    assert progress._bar is None
    err = capsys.readouterr().err
    assert "maps" in err
    assert "page" in err


def test_a_bar_goes_on_where_the_terminal_is_hidden_behind_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """While a bar is drawn, rich replaces standard error, and up to 13.7 its replacement is not a terminal."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    progress = shown.ProgressLines()
    progress("maps", 0.25)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    progress("maps", 0.75)
    assert progress._bar.tasks[0].percentage == 75
    progress.end()
    assert "maps 75 %" not in capsys.readouterr().err


def test_quiet_leaves_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    progress = shown.ProgressLines()
    progress.quiet = True
    progress("read")
    progress("maps", 0.5)
    progress.warn("warning: a clock is off")
    assert capsys.readouterr().err == "warning: a clock is off\n"


def test_the_seconds_of_a_stage_are_of_its_work_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Giving memory back takes milliseconds: a stage that had nothing to do once seemed to have run."""
    timed = Stages()
    known: list[bool] = []
    monkeypatch.setattr(stages, "give_memory_back", lambda: known.append("work" in timed.seconds))
    with timed("work"):
        pass
    assert known == [True]

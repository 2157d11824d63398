"""``make test``: its line about skipped tests, and its behaviour without a browser."""

import shutil
import subprocess

import pytest

from aerpaw_cmp.propagation import llvm
from tests.conftest import skips
from tools import setup_browser, setup_llvm


def test_the_last_line_counts_skipped_tests_by_their_reason() -> None:
    assert skips([]) == "skipped: none"
    assert skips(["Skipped: no logs", "Skipped: no browser", "Skipped: no logs"]) == (
        "skipped: 2 tests, no logs; skipped: 1 test, no browser"
    )


@pytest.mark.parametrize(("prefix", "apt_works"), [(None, True), ([], False), ([], True)])
def test_the_browser_is_installed_or_the_line_that_does_is_said(
    prefix: list[str] | None, apt_works: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ran = []

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        ran.append(" ".join(command))
        return subprocess.CompletedProcess(command, 0 if apt_works else 100, "Unable to locate package")

    monkeypatch.setattr(setup_llvm, "root_prefix", lambda: prefix)
    monkeypatch.setattr(llvm, "os_families", lambda: {"debian"})
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(subprocess, "run", run)
    setup_browser.main()
    assert any("chromium-driver" in command for command in ran) == (prefix is not None)
    assert (setup_browser.LINE in capsys.readouterr().err) == (prefix is None or not apt_works)

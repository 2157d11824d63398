"""The version of the tree that made a number: a release has its version only, other trees also their commit."""

import shutil
import subprocess
from pathlib import Path

import pytest

from aerpaw_cmp import __version__
from aerpaw_cmp.common import versions


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """A checkout with one commit that holds a package."""
    if shutil.which("git") is None:
        pytest.skip("needs git")
    package = tmp_path / "tree" / "package" / "common"
    package.mkdir(parents=True)
    (package / "file.py").write_text("x = 1\n")
    monkeypatch.setattr(versions, "__file__", str(package / "file.py"))

    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
        done = subprocess.run(["git", *identity, *arguments], cwd=package, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    git("init", "-q", str(tmp_path / "tree"))
    git("add", "-A")
    git("commit", "-qm", "first")
    return package, git


def asked() -> tuple[str, str]:
    versions.commit.cache_clear()
    try:
        return versions.commit(), versions.tool_version()
    finally:
        versions.commit.cache_clear()


def test_a_tree_without_tags_names_its_commit(tree):
    short = tree[1]("rev-parse", "--short=7", "HEAD")
    assert asked() == (short, f"{__version__}+g{short}")


def test_a_changed_tree_is_dirty_and_a_tagged_one_a_release(tree):
    package, git = tree
    git("tag", f"v{__version__}")
    assert asked() == ("", __version__)
    (package / "file.py").write_text("x = 2\n")
    assert asked()[1].endswith(".dirty")
    git("commit", "-qam", "second")
    assert asked()[0] == git("rev-parse", "--short=7", "HEAD")


def test_a_wheel_holds_the_answer_of_its_tree(tree):
    package = tree[0]
    (package.parent / versions.COMMIT_FILE).write_text("abc1234\n")
    assert asked() == ("abc1234", f"{__version__}+gabc1234")


def test_neither_checkout_nor_wheel_is_a_release_and_a_tree_that_git_cannot_read_is_none(tree, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert asked() == (versions.UNKNOWN, f"{__version__}+unknown")
    shutil.rmtree(Path(tree[0]).parents[1] / ".git")
    assert asked() == ("", __version__)

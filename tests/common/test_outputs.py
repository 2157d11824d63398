"""Outputs replace no input and nothing of others, and are whole."""

import errno
import hashlib
import os
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from aerpaw_cmp.common import outputs
from aerpaw_cmp.common.errors import OutputError, UsageError
from aerpaw_cmp.common.outputs import SUMS, OutputFile, OutputFolder, is_sealed, sealed


def write_file(target: Path, text: str = "new\n", **keys: object) -> None:
    with OutputFile(target, own=is_sealed, **keys) as output:  # type: ignore[arg-type]
        output.write(sealed(text))


def write_folder(target: Path, files: dict[str, str], **keys: object) -> None:
    with OutputFolder(target, job="test", **keys) as output, output.filling() as folder:  # type: ignore[arg-type]
        for name, text in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)


def content(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


# --- one file ---------------------------------------------------------------------------------------------------------


def linked(real: Path, name: Path) -> Path:
    name.symlink_to(real)
    return name


def hard_linked(real: Path, name: Path) -> Path:
    name.hardlink_to(real)
    return name


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("name", [lambda real, _: real, linked, hard_linked])
def test_an_input_is_never_replaced(tmp_path: Path, name: Callable[[Path, Path], Path], force: bool) -> None:
    log = tmp_path / "log.txt"
    log.write_text("raw")
    target = name(log, tmp_path / "other")
    with pytest.raises(UsageError, match="would replace an input"):
        write_file(target, inputs=[log], force=force)
    with pytest.raises(UsageError, match="would replace an input"):
        write_file(target, inputs=[tmp_path], force=force)  # a folder that holds it
    assert log.read_text() == "raw"
    assert not list(tmp_path.glob(".*"))


def test_files_of_others_need_force_and_own_ones_do_not(tmp_path: Path) -> None:
    target = tmp_path / "site.yaml"
    target.write_text("mine: 1\n")
    with pytest.raises(UsageError, match="--force"):
        write_file(target)
    assert target.read_text() == "mine: 1\n"
    write_file(target, "a: 1\n", force=True)
    write_file(target, "a: 2\n")
    assert target.read_bytes() == sealed("a: 2\n")
    target.write_bytes(target.read_bytes() + b"b: 3\n")  # edited: no longer as it was written
    with pytest.raises(UsageError, match="not an unchanged output"):
        write_file(target)


def test_a_link_stays_and_its_file_is_written(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real" / "a.yaml")
    write_file(tmp_path / "link")
    write_file(tmp_path / "link", "again\n")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "a.yaml").read_bytes() == sealed("again\n")


def test_no_ordinary_file_is_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for target in (tmp_path / "pipe", tmp_path, Path(os.devnull)):
        with pytest.raises(UsageError, match="not a regular file"):
            write_file(target, force=True)
    with pytest.raises(UsageError, match="no such folder"):
        write_file(tmp_path / "none" / "a")


def test_what_comes_while_the_command_runs_is_not_replaced(tmp_path: Path) -> None:
    target = tmp_path / "a.yaml"
    with OutputFile(target, own=is_sealed) as output:
        target.write_text("mine")
        with pytest.raises(UsageError, match="--force"):
            output.write(sealed("a"))
    assert content(tmp_path) == {"a.yaml": b"mine"}


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_two_runs_into_one_place(tmp_path: Path, kind: str) -> None:
    def output() -> OutputFile | OutputFolder:
        if kind == "file":
            return OutputFile(tmp_path / "a", own=is_sealed)
        return OutputFolder(tmp_path / "a", job="test")

    with output(), pytest.raises(UsageError, match="another run is writing here"), output():
        pass
    with output():
        pass
    assert list(tmp_path.iterdir()) == []


# --- a folder ---------------------------------------------------------------------------------------------------------


def test_a_folder_is_replaced_as_a_whole_and_can_be_checked(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "report"
    write_folder(target, {"a.html": "1", "figures/old.svg": "1"})
    write_folder(target, {"a.html": "2", "figures/new.svg": "2"})
    assert set(content(target)) == {"a.html", "figures/new.svg", SUMS}
    assert [p.name for p in target.parent.iterdir()] == ["report"]
    done = subprocess.run(["sha256sum", "-c", "--strict", SUMS], cwd=target, capture_output=True, check=False)
    assert done.returncode == 0, done


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("name", ["mine.txt", "figures/mine.txt", "notes/", "figures/notes/", "link@", "figures@"])
def test_a_folder_with_something_of_others_is_refused_and_left_alone(tmp_path: Path, name: str, force: bool) -> None:
    target = tmp_path / "report"
    write_folder(target, {"a.html": "1", "figures/a.svg": "1"})
    place = target / name.rstrip("/@")
    if name.endswith("@"):
        if place.is_dir():
            place.rename(tmp_path / "away")
        place.symlink_to(tmp_path / "away")
    elif name.endswith("/"):
        place.mkdir()
    else:
        place.write_text("mine")
    before = sorted((path, path.lstat().st_mtime_ns) for path in tmp_path.rglob("*"))
    with pytest.raises(UsageError, match="did not write"):
        write_folder(target, {"a.html": "2", "b.html": "2"}, force=force)
    assert sorted((path, path.lstat().st_mtime_ns) for path in tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["../thesis.tex", "{folder}/thesis.tex", "link/thesis.tex", "a/../../thesis.tex"])
@pytest.mark.parametrize("force", [False, True])
def test_a_list_that_names_a_file_outside_its_folder_removes_nothing(tmp_path: Path, name: str, force: bool) -> None:
    """A third-party result folder has a list of files that this tool could have written."""
    thesis, out = tmp_path / "thesis.tex", tmp_path / "out"
    thesis.write_text("years of work")
    out.mkdir()
    if name.startswith("link"):
        (out / "link").symlink_to(tmp_path)
    digest = hashlib.sha256(thesis.read_bytes()).hexdigest()
    (out / "SHA256SUMS").write_text(f"# aerpaw-cmp: of 'x'\n{digest}  {name.format(folder=tmp_path)}\n")
    with pytest.raises(UsageError, match="did not write"):
        write_folder(out, {"a": "1"}, force=force)
    assert thesis.read_text() == "years of work"


def test_a_folder_without_a_list_is_refused(tmp_path: Path) -> None:
    target = tmp_path / "home"
    target.mkdir()
    write_folder(target, {"a.html": "0"})  # an empty folder is free
    (target / SUMS).unlink()
    with pytest.raises(UsageError, match=r"did not write: a\.html"):
        write_folder(target, {"a.html": "1"}, force=True)
    assert content(target) == {"a.html": b"0"}


def test_what_comes_between_check_and_exchange_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "report"
    write_folder(target, {"a": "1"})
    plain = outputs._exchange

    def late(part: Path, to: Path) -> None:
        (to / "mine").write_text("mine")
        plain(part, to)

    with monkeypatch.context() as patched:
        patched.setattr(outputs, "_exchange", late)
        write_folder(target, {"a": "2"})
    assert content(target)["a"] == b"2"
    (hidden,) = tmp_path.glob(".*")
    assert (hidden / "mine").read_text() == "mine"
    with pytest.raises(UsageError, match="contains files of other programs: mine"):
        write_folder(target, {"a": "3"})
    assert (hidden / "mine").read_text() == "mine"


def test_rights_that_were_taken_away_stay_so(tmp_path: Path) -> None:
    target = tmp_path / "report"
    write_folder(target, {"a.html": "1", "figures/a.svg": "1"})
    (target / "figures").chmod(0o700)
    target.chmod(0o750)
    write_folder(target, {"a.html": "2", "figures/a.svg": "2"})
    assert [stat.S_IMODE(path.stat().st_mode) for path in (target, target / "figures")] == [0o750, 0o700]


@pytest.fixture
def shared() -> Iterator[Path]:
    """A folder of an ordinary user, who obeys rights: root may write everywhere."""
    own = os.getresuid()
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o777)
        os.setresuid(*((65534, 65534, 0) if own[1] == 0 else own))
        try:
            yield Path(name)
        finally:
            os.setresuid(*own)


def test_replaced_results_of_a_colleague_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_folder(tmp_path / "report", {"a.html": "1", "figures/a.svg": "1"})
    monkeypatch.setattr(Path, "chmod", lambda *_: 1 / 0)  # only the owner can change rights
    outputs._clear(tmp_path / "report")
    assert list(tmp_path.iterdir()) == []


def test_read_only_results_are_refused_at_once_and_leave_nothing(shared: Path) -> None:
    target = shared / "report"
    write_folder(target, {"a.html": "1"})
    target.chmod(0o555)
    with pytest.raises(OutputError, match="Permission denied"), OutputFolder(target, job="test"):
        pytest.fail("the computation began")
    assert list(shared.iterdir()) == [target]
    target.chmod(0o755)
    write_folder(target, {"a.html": "2"})
    assert content(target)["a.html"] == b"2"


def test_read_only_folders_in_results_are_replaced_and_leave_nothing(shared: Path) -> None:
    target = shared / "report"
    write_folder(target, {"a.html": "1", "figures/a.svg": "1"})
    for text in ("2", "3"):
        (target / "figures").chmod(0o555)
        write_folder(target, {"a.html": text, "figures/a.svg": text})
        assert content(target)["figures/a.svg"] == text.encode()
        assert list(shared.iterdir()) == [target]


def mount(*words: object) -> bool:
    return subprocess.run(["mount", *map(str, words)], capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize("kind", ["tmpfs", "bind"])
def test_a_file_system_mounted_in_a_result_folder_keeps_its_files(tmp_path: Path, kind: str) -> None:
    """A bind mount has the device of its folder, and here even the files that the list names."""
    target, disk = tmp_path / "report", tmp_path / "disk"
    write_folder(target, {"a.html": "1", "figures/a.svg": "1"})
    disk.mkdir()
    (disk / "a.svg").write_text("1")
    point = target / "figures"
    if not mount(*(["-t", "tmpfs", "none", point] if kind == "tmpfs" else ["--bind", disk, point])):
        pytest.skip("only root can mount")
    try:
        (point / "a.svg").write_text("1")
        with pytest.raises(UsageError, match="figures, a mounted file system"):
            write_folder(target, {"a.html": "2"}, force=True)
        assert (point / "a.svg").read_text() == "1"
        hidden = outputs.hidden_name(target, "part")
        with pytest.raises(OSError, match="mounted"):
            outputs._clear(target)
        assert not hidden.exists()
    finally:
        subprocess.run(["umount", str(point)], check=True)
    assert content(target).keys() == {"a.html", "figures/a.svg", SUMS}


@pytest.mark.parametrize("kind", ["file", "folder", "old"])
def test_what_waits_in_the_hidden_place_of_another_user_is_not_adopted(kind: str, tmp_path: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root gives files to another user")
    target = tmp_path / "out"
    place = outputs.hidden_name(target, "old" if kind == "old" else "part")
    place.touch() if kind == "file" else place.mkdir()
    if kind != "file":
        (place / ".unfinished").touch()
        (place / "theirs").write_text("theirs")
    before = content(tmp_path)
    os.chown(place, 12345, 12345)
    if kind == "old":
        write_folder(target, {"a": "new"})
        assert (target / "a").read_text() == "new"
        assert not (target / "theirs").exists()
        return
    with pytest.raises(UsageError, match=r"aerpaw-part belongs to another user"):
        write_file(target) if kind == "file" else write_folder(target, {"a": "new"})
    assert content(tmp_path) == before


def test_a_changed_result_needs_force(tmp_path: Path) -> None:
    target = tmp_path / "report"
    write_folder(target, {"rss.csv": "1"})
    (target / "rss.csv").write_text("edited")
    with pytest.raises(UsageError, match=r"rss\.csv was changed"):
        write_folder(target, {"rss.csv": "2"})
    assert (target / "rss.csv").read_text() == "edited"
    write_folder(target, {"rss.csv": "2"}, force=True)
    assert (target / "rss.csv").read_text() == "2"
    assert [p.name for p in tmp_path.iterdir()] == ["report"]


def test_a_folder_with_an_input_is_refused(tmp_path: Path) -> None:
    target = tmp_path / "flight"
    target.mkdir()
    log = target / "log.txt"
    log.write_text("raw")
    (tmp_path / "hard").hardlink_to(log)
    (tmp_path / "soft").symlink_to(log)
    for path in (log, tmp_path / "hard", tmp_path / "soft"):
        with pytest.raises(UsageError, match="input"):
            write_folder(target, {"log.txt": "result"}, inputs=[path], force=True)
    assert content(target) == {"log.txt": b"raw"}


def test_folders_that_cannot_be_exchanged_are_told_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here" / "below").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here" / "below")
    for name in (".", "..", "/"):
        with pytest.raises(UsageError, match="a folder inside it"), OutputFolder(Path(name), job="report"):
            pass
    (tmp_path / "file").write_text("")
    for name in ("file", "file/report", "x" * 300):
        with pytest.raises(UsageError), OutputFolder(tmp_path / name, job="report"):
            pass


def test_a_folder_is_told_first_where_is_dir_hides_every_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From Python 3.14 on, ``Path.is_dir`` returns False for errors, like ``os.path.isdir``."""
    monkeypatch.setattr(Path, "is_dir", lambda path, **_: os.path.isdir(path))  # noqa: PTH112 - the one that is silent
    with pytest.raises(UsageError, match="name too long"), OutputFolder(tmp_path / ("x" * 300), job="report"):
        pytest.fail("the work begins")
    assert list(tmp_path.iterdir()) == []


def test_files_whose_name_cannot_be_are_told_first(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for name in ("x" * 300, "file/table.csv", "x" * 300 + "/table.csv", "missing/table.csv"):
        with pytest.raises(UsageError), OutputFile(tmp_path / name, own=lambda _: True):
            pytest.fail("the work begins")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_failure_leaves_the_old_set_and_no_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "new" / "report"
    fail = lambda *_: (_ for _ in ()).throw(OSError(errno.ENOSPC, "No space left on device"))  # noqa: E731
    with monkeypatch.context() as patched:
        patched.setattr("os.fsync", fail)
        with pytest.raises(OutputError, match=r"No space left.*free some space"):
            write_folder(target, {"a": "1"})
    assert list(tmp_path.iterdir()) == []
    write_folder(target, {"a": "1"})
    before = content(target)
    with monkeypatch.context() as patched:
        patched.setattr("os.fsync", fail)
        with pytest.raises(OutputError):
            write_folder(target, {"a": "2"})
    with pytest.raises(TypeError):
        write_folder(target, {"a": "3", "b": 3})  # type: ignore[dict-item]  # a fault while it is filled
    assert content(target) == before
    assert [p.name for p in target.parent.iterdir()] == ["report"]


def test_a_folder_removed_on_the_way(tmp_path: Path) -> None:
    target = tmp_path / "reports" / "a"

    def remove_and_write() -> None:
        with OutputFolder(target, job="test") as output:
            shutil.rmtree(target.parent)
            with output.filling() as folder:
                (folder / "a").write_text("1")

    with pytest.raises(OutputError, match="was removed during the run"):
        remove_and_write()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("step", range(3))
def test_two_renames_where_the_system_cannot_exchange(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """Killed before, between and after the two renames: the old set or the new one, at the next run at the latest."""
    monkeypatch.setattr(outputs, "_names_swapped", lambda *_: False)
    target = tmp_path / "report"
    write_folder(target, {"a": "1"})
    rename, calls = Path.rename, []

    def killed(self: Path, to: Path) -> Path:
        if len(calls) == step:
            os._exit(9)
        calls.append(to)
        return rename(self, to)

    child = os.fork()
    if child == 0:
        try:
            monkeypatch.setattr(Path, "rename", killed)
            write_folder(target, {"a": "2"})
        finally:
            os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    with OutputFolder(target, job="test"):  # the next run repairs it
        files = content(target)
    assert files["a"] == (b"2" if step == 2 else b"1")
    assert set(files) == {"a", SUMS}
    assert [p.name for p in tmp_path.iterdir()] == ["report"]

"""Choosing an LLVM: names, order, refusals, and trials that end badly. The libraries are empty files, the children real."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from aerpaw_cmp.common.errors import UsageError, next_step
from aerpaw_cmp.propagation import llvm
from tools import setup_llvm as setup

ROOT = Path(__file__).resolve().parents[2]
ABORTS = (
    "import os, sys; sys.stderr.write('x\\nLLVM ERROR: Cannot select: fmaximum\\ny\\n'); sys.stderr.flush(); os.abort()"
)
ANSWERS = "print('noise'); print('{\"right\": true, \"llvm\": [%d, 1, 7]}')"


def put(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).write_bytes(b"\x7fELF")


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, dict[str, str]]:
    return tmp_path, {llvm.FOLDERS_VARIABLE: str(tmp_path)}


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-14.so.1", (14,)),
        ("libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("libLLVM-17.so", (17,)),
        ("libLLVM.so.19.1", (19, 1)),
        ("libLLVM.dylib", ()),
        ("libLLVM.so", ()),
        ("libLLVM-C.so.19", None),
        ("libLLVM-15-rust-1.70.so", None),
        ("libclang.so.19", None),
    ],
)
def test_version_in_name(name: str, version: tuple[int, ...] | None) -> None:
    assert llvm.version_in_name(name) == version


def test_newest_first_and_each_file_once(folders: tuple[Path, dict[str, str]]) -> None:
    folder, environ = folders
    put(folder, "libLLVM-14.so.1", "libLLVM.so.19.1", "libLLVM-9.so.1", "libLLVM-C.so.19", "libLLVM-22.so")
    (folder / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    (folder / "libLLVM.so").symlink_to("libLLVM-14.so.1")
    (folder / "libLLVM-21.so").symlink_to("gone.so")
    libraries = llvm.candidates(environ)
    assert [library.version for library in libraries] == [(22,), (19, 1), (14,), (9,)]


def test_the_users_choice_stands_alone(folders: tuple[Path, dict[str, str]]) -> None:
    folder, environ = folders
    put(folder, "libLLVM.so.19.1", "libLLVM-17.so.1", "mine.so")
    for name, version in (("libLLVM-17.so.1", (17,)), ("mine.so", ())):
        chosen = folder / name
        assert llvm.candidates({**environ, llvm.LIBRARY_VARIABLE: str(chosen)}) == [llvm.Library(chosen, version)]


def test_the_users_choice_must_exist(folders: tuple[Path, dict[str, str]]) -> None:
    folder, environ = folders
    put(folder, "libLLVM.so.19.1")
    with pytest.raises(llvm.SionnaMissingError, match=r"not the file of a libLLVM.*: unset DRJIT_LIBLLVM_PATH"):
        llvm.candidates({**environ, llvm.LIBRARY_VARIABLE: str(folder)})


@pytest.mark.parametrize("major", [14, 15, 16])
def test_old_versions_are_refused_without_a_trial(major: int) -> None:
    trial = llvm.try_library(llvm.Library(Path("libLLVM.so"), (major,)), program="raise SystemExit('ran')")
    assert not trial.ok
    assert trial.reason == f"LLVM {major} is too old; 17 or newer is needed"


def test_an_unnamed_version_is_refused_by_what_the_child_says() -> None:
    library = llvm.Library(Path("libLLVM.so"), ())
    assert "LLVM 16 is too old" in llvm.try_library(library, program=ANSWERS % 16).reason
    good = llvm.try_library(library, program=ANSWERS % 19)
    assert good.ok
    assert good.library is not None
    assert good.library.version == (19, 1, 7)


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        (ABORTS, "ended by signal 6: LLVM ERROR: Cannot select: fmaximum"),
        ("raise OSError('no such thing')", "ended with 1: OSError: no such thing"),
        ("raise ImportError('the LLVM backend is inactive')", "ImportError: the LLVM backend is inactive"),
        ("print('{}')", "path lengths are wrong"),
        ('print(\'{"right": false, "found_m": [1.0]}\')', r"path lengths are wrong: \[1.0\]"),
        ("print('[1')", "answer is unreadable"),
        ("", "answer is unreadable"),
        ("import time; time.sleep(60)", "did not end within 1 s"),
    ],
)
def test_a_bad_end_is_reported_and_blames_the_library(program: str, reason: str) -> None:
    timeout_s = 1.0 if "sleep" in program else 30.0
    trial = llvm.try_library(llvm.Library(Path("libLLVM.so"), (19,)), program=program, timeout_s=timeout_s)
    assert not trial.ok
    assert trial.blames_library
    assert re.search(reason, trial.reason), trial.reason


@pytest.mark.parametrize("program", ["import no_such_engine", "from typing import no_such_name"])
def test_a_sionna_that_cannot_be_loaded_is_not_the_librarys_fault(program: str) -> None:
    """Python 3.10 had no ``typing.Self``: make installed one LLVM after the other and asked for a newer one."""
    trial = llvm.try_library(llvm.Library(Path("libLLVM.so"), (19,)), program=program)
    assert not trial.ok
    assert not trial.blames_library
    assert llvm.sionna_fails([trial])
    assert "with any LLVM" in llvm.explain([trial])
    assert "no_such" in llvm.explain([trial])


def test_what_sionna_wants_of_typing_is_there() -> None:
    import typing

    llvm.let_sionna_load()
    assert hasattr(typing, "Self")


def as_root_on_debian(monkeypatch: pytest.MonkeyPatch, libraries: Path) -> None:
    """Without a library but those of a folder."""
    monkeypatch.setenv(llvm.FOLDERS_VARIABLE, str(libraries))
    monkeypatch.delenv(llvm.LIBRARY_VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "os_families", lambda: {"debian"})
    monkeypatch.setattr(setup, "root_prefix", list)


def test_what_drjit_itself_lacks_is_named_and_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a minimal Debian, the loader's message comes first and an unrelated NameError last."""
    program = (
        "try: raise ImportError('libatomic.so.1: cannot open shared object file: No such file or directory')\n"
        "except ImportError: _drjit_ext"
    )
    (tmp_path / "libLLVM.so.19").touch()
    trial = llvm.try_library(llvm.Library(tmp_path / "libLLVM.so.19", (19,)), program=program)
    assert not trial.blames_library
    assert trial.missing == "libatomic.so.1"
    assert trial.reason == "Dr.Jit cannot be loaded, because the system has no libatomic.so.1"
    fake_tool(tmp_path, "apt-get", f'[ "$1" = install ] && touch "{tmp_path}/installed"; exit 0')
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    as_root_on_debian(monkeypatch, tmp_path)
    said: list[str] = []
    again = setup.install(said.append, lambda library: llvm.Trial(library, (tmp_path / "installed").exists()))
    assert again is not None
    assert again.ok
    assert [line.split()[-1] for line in said] == ["-qq", "libatomic1"]


def test_the_child_gets_the_library_and_an_empty_kernel_cache() -> None:
    program = (
        "import json, os; assert os.listdir(os.environ['DRJIT_CACHE_DIR']) == [];"
        "print(json.dumps({'right': os.environ['DRJIT_LIBLLVM_PATH'] == '/here/libLLVM.so', 'llvm': [19]}))"
    )
    assert llvm.try_library(llvm.Library(Path("/here/libLLVM.so"), ()), program=program).ok


def test_prepare_points_drjit_to_what_works(
    folders: tuple[Path, dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, environ = folders
    put(folder, "libLLVM.so.19.1", "libLLVM-15.so.1")
    monkeypatch.setenv("AERPAW_CMP_CACHE", str(folder / "cache"))
    monkeypatch.setenv(llvm.FOLDERS_VARIABLE, environ[llvm.FOLDERS_VARIABLE])
    monkeypatch.setenv(llvm.LIBRARY_VARIABLE, "")
    made: list[Path] = []

    def attempt(library: llvm.Library, program: str) -> llvm.Trial:
        assert "sionna" not in program
        made.append(library.path)
        return llvm.Trial(library, True)

    monkeypatch.setattr(llvm, "try_library", attempt)
    for _ in range(2):
        llvm._trials.cache_clear()
        assert llvm.prepare_llvm() == folder / "libLLVM.so.19.1"
        assert os.environ[llvm.LIBRARY_VARIABLE] == str(folder / "libLLVM.so.19.1")
        monkeypatch.setenv(llvm.LIBRARY_VARIABLE, "")
    assert len(made) == 1, "a good trial is stored"
    put(folder, "libLLVM.so.19.1")
    os.utime(folder / "libLLVM.so.19.1", ns=(1, 1))
    llvm._trials.cache_clear()
    llvm.prepare_llvm()
    assert len(made) == 2, "a new file is tried again"
    llvm._trials.cache_clear()


def test_prepare_without_any_gives_the_line_that_mends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    as_root_on_debian(monkeypatch, tmp_path)
    monkeypatch.setattr(llvm, "known_to_apt", lambda: "libllvm19 - x\n")
    llvm._trials.cache_clear()
    with pytest.raises(UsageError, match=r"no libLLVM was found.*apt-get install -y libllvm19") as caught:
        llvm.prepare_llvm()
    assert next_step(caught.value, ["report", "flight.yaml"]) == "run that line, or use the engine 'image'"
    llvm._trials.cache_clear()


def fake_tool(folder: Path, name: str, script: str) -> None:
    (folder / name).write_text(f"#!/bin/sh\n{script}\n")
    (folder / name).chmod(0o755)


def test_install_takes_the_newest_and_falls_back_when_its_trial_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """apt is a shell script that installs libraries. Version 22 fails its trial, and 19 passes."""
    tools, libraries = tmp_path / "bin", tmp_path / "lib"
    tools.mkdir()
    libraries.mkdir()
    fake_tool(tools, "apt-cache", "echo 'libllvm14 - x'; echo 'libllvm22 - x'; echo 'libllvm19 - x'")
    fake_tool(
        tools,
        "apt-get",
        f'for p in "$@"; do case $p in libllvm*) touch "{libraries}/libLLVM.so.${{p#libllvm}}";; esac; done',
    )
    monkeypatch.setenv("PATH", f"{tools}{os.pathsep}{os.environ['PATH']}")
    as_root_on_debian(monkeypatch, libraries)
    said: list[str] = []

    def attempt(library: llvm.Library) -> llvm.Trial:
        return llvm.Trial(library, library.version == (19,), "" if library.version == (19,) else "aborted")

    trial = setup.install(said.append, attempt)
    assert trial is not None
    assert trial.ok
    assert trial.library == llvm.Library(libraries / "libLLVM.so.19", (19,))
    assert [line.rpartition(" -")[2].partition(" ")[2] for line in said] == [
        "",
        "libllvm22 libatomic1",
        "libllvm19 libatomic1",
    ]


@pytest.mark.parametrize(
    ("family", "line"),
    [("fedora", "dnf install"), ("arch", "pacman"), ("darwin", "brew"), ("other", "DRJIT_LIBLLVM_PATH=")],
)
def test_every_system_gets_a_line(family: str, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "os_families", lambda: {family})
    assert line in llvm.install_line()


@pytest.mark.parametrize(
    ("known", "line"),
    [
        ("libllvm18 - x\nlibllvm19 - x\n", "install -y libllvm19 libatomic1"),
        ("libllvm14 - x\nlibllvm15 - x\n", "apt.llvm.org/llvm.sh"),  # Ubuntu 22.04
        ("", "install -y libllvm19 libatomic1"),  # no lists yet: a new container
    ],
)
def test_the_line_of_a_debian_names_what_can_be_had(known: str, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "os_families", lambda: {"ubuntu"})
    monkeypatch.setattr(llvm, "known_to_apt", lambda: known)
    assert line in llvm.install_line()
    assert ("apt.llvm.org" in llvm.install_line()) == ("apt.llvm.org" in line)


def test_a_library_that_is_called_by_its_interface_has_the_version_of_its_other_name(tmp_path: Path) -> None:
    """As in the packages of the LLVM project, libLLVM-19.so.1 is a link to libLLVM.so.1."""
    (tmp_path / "libLLVM.so.1").touch()
    for name in ("libLLVM-19.so.1", "libLLVM.so", "libLLVM-19.so"):
        (tmp_path / name).symlink_to("libLLVM.so.1")
    libraries = llvm.candidates({llvm.FOLDERS_VARIABLE: str(tmp_path)})
    assert [library.version for library in libraries] == [(19,)]


@pytest.mark.sionna
def test_this_machines_llvm_traces_two_paths() -> None:
    llvm.let_sionna_load()
    pytest.importorskip("sionna", reason="Sionna RT is not installed")
    trials = llvm.first_that_works(llvm.candidates())
    assert trials, llvm.install_line()
    assert trials[-1].ok, trials


@pytest.mark.sionna
def test_a_path_of_another_length_fails_the_trial() -> None:
    """The ground is one metre higher at one corner than what the expected lengths are of."""
    program = llvm.TRIAL_PROGRAM.replace("800.0, 0.0]", "800.0, 1.0]")
    assert program != llvm.TRIAL_PROGRAM
    trial = llvm.try_library(llvm.candidates()[0], program=program)
    assert trial.reason.startswith("the trial's path lengths are wrong: [31.62")


@pytest.mark.sionna
def test_the_trial_aborts_where_sionnas_solver_does() -> None:
    """LLVM 15 and 16 cannot compile a maximum of sixteen floats for AVX-512."""
    flags = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    old = [library for library in llvm.candidates({}) if library.version[:1] in {(15,), (16,)}]
    if "avx512" not in flags or not old:
        pytest.skip("needs AVX-512 and LLVM 15 or 16")
    trial = llvm.try_library(llvm.Library(old[0].path, ()), program=llvm.TRIAL_PROGRAM)  # its name would refuse it
    assert "Cannot select" in trial.reason


def run_setup(folder: Path, *, path: str = "", before: str = "") -> subprocess.CompletedProcess[str]:
    """The real script, for which a folder holds all the libraries that there are."""
    environ = {**os.environ, "PYTHONPATH": path, llvm.FOLDERS_VARIABLE: str(folder)}
    environ.pop(llvm.LIBRARY_VARIABLE, None)
    script = str(ROOT / "tools" / "setup_llvm.py")
    program = f"import os, runpy, shutil\n{before}\nrunpy.run_path({script!r}, run_name='__main__')"
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=ROOT, env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    return done


def test_setup_script_installs_no_llvm_where_a_package_is_what_fails(tmp_path: Path) -> None:
    """The script with a Dr.Jit that imports a missing name from typing, as Sionna RT did on Python 3.10."""
    (tmp_path / "drjit").mkdir()
    (tmp_path / "drjit/__init__.py").write_text("from typing import no_such_name\n")
    (tmp_path / "libLLVM.so.19.1").touch()
    done = run_setup(tmp_path, path=str(tmp_path))
    assert "with any LLVM" in done.stderr
    assert "no_such_name" in done.stderr
    assert "apt-get" not in done.stderr


@pytest.mark.sionna
def test_setup_script_prints_the_one_line_when_nothing_can_be_installed(tmp_path: Path) -> None:
    """There is no library anywhere, and no way to become root."""
    nobody = "os.geteuid = lambda: 1\nwhich = shutil.which\nshutil.which = lambda name: which(name) if name != 'sudo' else None"
    done = run_setup(tmp_path, before=nobody)
    assert done.stderr.splitlines()[-1].strip() == llvm.install_line()

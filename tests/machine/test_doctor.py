"""The checks of the machine, each seen well and unwell."""

import json
import os
import sys
from pathlib import Path

import pytest

from aerpaw_cmp.common.files import cache_folder
from aerpaw_cmp.machine import doctor
from aerpaw_cmp.propagation import llvm


def test_every_unwell_check_has_a_remedy_and_the_whole_is_json(monkeypatch: pytest.MonkeyPatch) -> None:
    library = llvm.Library(Path("/x/libLLVM.so.19.1"), (19, 1))
    monkeypatch.setattr(llvm, "candidates", lambda: [library])
    monkeypatch.setattr(llvm, "try_library", lambda candidate: llvm.Trial(candidate, True))
    checks = doctor.checks()
    asked = [
        "Python", "Sionna RT", "Mitsuba", "Dr.Jit", "LLVM", "GPU", "CPU", "Memory", "Disk", "Cache", "Readers",
        "Serial",
    ]  # fmt: skip
    assert set(asked) <= {check.name for check in checks}
    for check in checks:
        assert check.status in ("ok", "warn", "fail")
        assert bool(check.remedy) == (check.status != "ok"), check
    assert json.loads(json.dumps(doctor.as_dict(checks)))["checks"][0]["name"] == "Python"


def with_trials(monkeypatch: pytest.MonkeyPatch, *trials: llvm.Trial) -> list[doctor.Check]:
    monkeypatch.setattr(llvm, "candidates", list)
    monkeypatch.setattr(llvm, "first_that_works", lambda _: list(trials))
    monkeypatch.setattr(llvm, "install_line", lambda: "the line")
    monkeypatch.delenv(llvm.LIBRARY_VARIABLE, raising=False)
    return list(doctor.llvm_checks())


def test_llvm_found_and_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    old = llvm.Trial(llvm.Library(Path("a"), (22,)), False, "aborted")
    good = llvm.Trial(llvm.Library(Path("b"), (19,)), True)
    lost = llvm.Trial(llvm.Library(Path("b"), (19,)), False, "No module named 'sionna'", blames_library=False)
    assert [check.status for check in with_trials(monkeypatch, good)] == ["ok"]
    assert [check.status for check in with_trials(monkeypatch, old, good)] == ["warn", "ok"]
    assert [(check.status, check.remedy) for check in with_trials(monkeypatch, old)] == [("fail", "the line")]
    assert [(check.status, check.remedy) for check in with_trials(monkeypatch, lost)] == [("fail", "make setup")]
    assert [(check.status, check.remedy) for check in with_trials(monkeypatch)] == [("fail", "the line")]


def test_a_gpu_that_works_needs_no_llvm(monkeypatch: pytest.MonkeyPatch) -> None:
    with_trials(monkeypatch)
    monkeypatch.setattr(doctor.shutil, "which", lambda name: f"/usr/bin/{name}")
    for works, status in ((True, "warn"), (False, "fail")):
        trial = llvm.Trial(None, works, "" if works else "the trial ended with 1: no CUDA device")
        monkeypatch.setattr(llvm, "try_variant", lambda _, trial=trial: trial)
        checks = {check.name: check for check in doctor.checks()}
        assert checks["LLVM"].status == status
        assert checks["GPU"].status == ("ok" if works else "warn")
        assert ("cuda_ad_mono_polarized" in checks["GPU"].found) == works


def test_a_child_that_aborts_is_a_row_not_a_crash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "libLLVM.so.19.1").touch()
    monkeypatch.setenv(llvm.FOLDERS_VARIABLE, str(tmp_path))
    monkeypatch.delenv(llvm.LIBRARY_VARIABLE, raising=False)
    attempt = llvm.try_library
    abort = lambda library: attempt(library, program="import os; os.abort()")  # noqa: E731
    monkeypatch.setattr(llvm, "try_library", abort)
    (check,) = [check for check in doctor.llvm_checks() if check.name == "LLVM"]
    assert check.status == "fail"
    assert "ended by signal 6" in check.found


def test_a_library_variable_that_names_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(llvm.LIBRARY_VARIABLE, "/no/such/libLLVM.so")
    (check,) = list(doctor.llvm_checks())
    assert (check.status, check.remedy) == ("fail", "unset DRJIT_LIBLLVM_PATH")


def test_versions_that_do_not_belong_together(monkeypatch: pytest.MonkeyPatch) -> None:
    installed = {"sionna-rt": "2.2.0", "mitsuba": "3.8.0"}
    monkeypatch.setattr(doctor.versions, "version", lambda name: installed.get(name, "not installed"))
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: ["mitsuba==3.9.1", "drjit==1.5.0", "numpy>=1.26"])
    checks = {check.name: check for check in doctor.package_checks()}
    assert checks["Sionna RT"].status == "ok"
    assert checks["Mitsuba"].remedy == "pip install 'mitsuba==3.9.1'"
    assert (checks["Dr.Jit"].found[:13], checks["Dr.Jit"].status) == ("not installed", "fail")


def test_an_environment_without_sionna_is_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    """docs/howto/install.md describes it: the audit and the engine sionna are missing, and nothing else."""
    known = doctor.versions.version
    absent = {"sionna-rt", "mitsuba", "drjit"}
    monkeypatch.setattr(doctor.versions, "version", lambda name: "not installed" if name in absent else known(name))
    checks = doctor.checks()
    assert doctor.ready(checks)
    assert [check.name for check in checks if check.status == "warn"][:3] == ["Sionna RT", "Mitsuba", "Dr.Jit"]
    assert "LLVM" not in {check.name for check in checks}


def test_memory_is_the_lower_of_machine_and_control_group(tmp_path: Path) -> None:
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/meminfo").write_text("MemTotal: 9 kB\nMemAvailable:    4194304 kB\n")
    assert doctor.available_memory_bytes(tmp_path) == 4 * 1024**3
    group = tmp_path / "sys/fs/cgroup"
    group.mkdir(parents=True)
    (group / "memory.current").write_text("1073741824\n")
    (group / "memory.max").write_text("max\n")
    assert doctor.available_memory_bytes(tmp_path) == 4 * 1024**3
    (group / "memory.max").write_text("2147483648\n")
    assert doctor.available_memory_bytes(tmp_path) == 1024**3
    assert doctor.available_memory_bytes(tmp_path / "nothing") is None
    assert doctor.memory_check(1024**3).status == "warn"
    assert doctor.memory_check(3 * 1024**3).status == "ok"


def test_cache_folder_that_cannot_be(tmp_path: Path) -> None:
    assert doctor.cache_check(tmp_path / "new/deep").status == "ok"
    (tmp_path / "file").touch()
    assert doctor.cache_check(tmp_path / "file/cache").status == "warn"


@pytest.mark.parametrize(
    ("chosen", "user", "expected"), [("/a", "/b", "/a"), ("", "/b", "/b/aerpaw-cmp"), ("", "", "~")]
)
def test_one_place_for_all_caches(monkeypatch: pytest.MonkeyPatch, chosen: str, user: str, expected: str) -> None:
    monkeypatch.setenv("AERPAW_CMP_CACHE", chosen)
    monkeypatch.setenv("XDG_CACHE_HOME", user)
    place = Path.home() / ".cache/aerpaw-cmp" if expected == "~" else Path(expected)
    assert cache_folder("outcomes") == place / "outcomes"


def test_readers_that_raise_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise RuntimeError("a bad plug-in")

    monkeypatch.setattr("aerpaw_cmp.logs.readers.catalogue", broken)
    check = doctor.readers_check()
    assert check.status == "fail"
    assert "a bad plug-in" in check.found


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_holder_of_a_port_is_named() -> None:
    controller, terminal = os.openpty()
    try:
        device = os.ttyname(terminal)
        check = doctor.serial_check(device)
        assert f"({os.getpid()})" in check.found
        assert (check.status, check.remedy) == ("warn", "stop it")
        os.close(terminal)
        terminal = -1
        assert doctor.serial_check(device).status == "ok"
    finally:
        os.close(controller)
        if terminal >= 0:
            os.close(terminal)


def test_a_port_that_is_not_ours_names_the_group(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.os, "access", lambda *_: False)
    check = doctor.serial_check("/dev/ttyUSB77")
    assert check.status == "warn"
    assert check.remedy == "sudo usermod -aG dialout $USER, then log in again"


def test_without_fcntl_nothing_is_said_about_pyserial(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fcntl", None)
    (check,) = doctor.serial_checks()
    assert check.status == "warn"
    assert "no fcntl: 'tap' and 'modem-sim' need Linux" in check.found
    assert "pyserial" not in check.found


def test_a_missing_pyserial_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("serial", "serial.tools", "serial.tools.list_ports"):
        monkeypatch.setitem(sys.modules, name, None)
    (check,) = doctor.serial_checks()
    assert (check.status, check.found) == ("fail", "pyserial is not installed")

"""Checks whether this machine can run this program. Each check reports what it found, and how to fix a problem.

The checks do not change the machine. ``tools/setup_llvm.py``, which ``make setup`` runs, can install LLVM.
"""

from __future__ import annotations

import os
import platform
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from ..common import versions
from ..common.errors import AerpawCmpError
from ..common.files import cache_folder
from ..common.text import counted
from ..propagation import llvm
from ..propagation.compiled import thread_count

Status = Literal["ok", "warn", "fail"]

# Memory that a report needs. A report of 10 000 poses and 5 towers uses less than this.
_MEMORY_NEEDED_BYTES = 2 * 1024**3

# Disk space for the reports, flight files and cached paths of one day in the field.
_DISK_NEEDED_BYTES = 1024**3


@dataclass(frozen=True, slots=True)
class Check:
    """The result of one check of this machine.

    Parameters
    ----------
    name : str
        Name of the check.
    status : {"ok", "warn", "fail"}
        ``warn``: commands that need this part are slow or refused, and all other commands run. ``fail``: a command
        cannot run.
    found : str
        What the check found.
    remedy : str
        How to fix the problem. Empty if ``ok``.
    """

    name: str
    status: Status
    found: str
    remedy: str = ""


def checks() -> list[Check]:
    """Return all checks, in the order in which a new user needs them. The test of LLVM takes some seconds."""
    gpu = _gpu_check()
    # check LLVM only if Dr.Jit is installed, which comes with Sionna RT, because only Dr.Jit uses LLVM
    compilers = list(llvm_checks()) if versions.version("drjit") != versions.NOT_INSTALLED else []
    if "tested" in gpu.found and gpu.status == "ok":  # failures of LLVM are warnings if a GPU works
        compilers = [replace(check, status="warn") if check.status == "fail" else check for check in compilers]
    return [
        Check("Python", "ok", f"{platform.python_version()} ({sys.executable})"),
        *package_checks(),
        *compilers,
        gpu,
        Check("CPU", "ok", f"{counted(thread_count(), 'core')}, {platform.machine()}"),
        memory_check(),
        _disk_check(Path.cwd()),
        cache_check(cache_folder()),
        readers_check(),
        *serial_checks(),
    ]


def as_dict(checks: Sequence[Check]) -> dict[str, Any]:
    """Return the JSON object of ``doctor``: ``{"ready": bool, "checks": [{name, status, found, remedy}]}``."""
    return {"ready": ready(checks), "checks": [asdict(check) for check in checks]}


def ready(checks: Sequence[Check]) -> bool:
    """Return True if no check failed. Warnings are allowed."""
    return all(check.status != "fail" for check in checks)


def package_checks() -> Iterator[Check]:
    """Check that Sionna RT, Mitsuba and Dr.Jit are installed, in the versions that Sionna RT pins.

    An environment without Sionna RT is a warning, because only the audit and the engine ``sionna`` need it.
    """
    pins: dict[str, str] = {}
    missing: Status = "warn" if versions.version("sionna-rt") == versions.NOT_INSTALLED else "fail"
    with suppress(metadata.PackageNotFoundError):
        # read the pins of the installed sionna-rt, because its versions pin different versions of Mitsuba and Dr.Jit
        for requirement in metadata.requires("sionna-rt") or []:
            # a requirement without an exact version results in an empty pin, which every version satisfies
            name, _, exact = requirement.partition("==")
            pins[name.strip()] = exact.strip()
    for title, name in (("Sionna RT", "sionna-rt"), ("Mitsuba", "mitsuba"), ("Dr.Jit", "drjit")):
        version, pin = versions.version(name), pins.get(name)
        if version == versions.NOT_INSTALLED:
            yield Check(
                title, missing, f"{version}; only needed for audit and rt.engine: sionna", "pip install sionna-rt"
            )
        elif pin and version != pin:
            yield Check(title, "fail", f"{version}, but Sionna RT needs {pin}", f"pip install '{name}=={pin}'")
        else:
            yield Check(title, "ok", version)


def llvm_checks() -> Iterator[Check]:
    """Test LLVM libraries in child processes until one works, and yield one check per library."""
    try:
        trials = llvm.first_that_works(llvm.candidates())
    except AerpawCmpError as error:
        yield Check("LLVM", "fail", str(error), f"unset {llvm.LIBRARY_VARIABLE}")
        return
    works = bool(trials) and trials[-1].ok
    if not trials:
        yield Check("LLVM", "fail", "no libLLVM found", llvm.install_line())
    for trial in trials:
        name = trial.library.label if trial.library else "LLVM"
        if trial.ok:
            yield Check("LLVM", "ok", f"{name}, tested: a child process traced two paths with the right lengths")
        elif not trial.blames_library:
            remedy = llvm.install_line() if trial.missing else "make setup"
            yield Check("LLVM", "fail", f"{name} could not be tried: {trial.reason}", remedy)
        else:
            remedy = "not needed, because another library works" if works else llvm.remedy(trials)
            yield Check("LLVM", "warn" if works else "fail", f"{name}: {trial.reason}", remedy)


def _gpu_check() -> Check:
    """Check which Mitsuba variant Sionna RT would use. A GPU is tested in a child process, like LLVM."""
    # also look for the driver itself, because a container may have the driver without its command-line tool
    if shutil.which("nvidia-smi") is None and not Path("/proc/driver/nvidia").exists():
        return Check("GPU", "ok", "none found: Sionna RT uses llvm_ad_mono_polarized")
    trial = llvm.try_variant("cuda_ad_mono_polarized")
    if trial.ok:
        return Check("GPU", "ok", "tested: Sionna RT uses cuda_ad_mono_polarized")
    remedy = "update the NVIDIA driver ('nvidia-smi' must list the GPU); Sionna RT uses LLVM until then"
    return Check("GPU", "warn", f"an NVIDIA driver is installed, but {trial.reason}", remedy)


def available_memory_bytes(root: Path = Path("/")) -> int | None:
    """Return the available memory: the kernel's estimate, or the limit of the control group if it is lower."""
    try:
        lines = (root / "proc/meminfo").read_text().splitlines()
        # do not use MemFree, because the kernel also frees memory of its file cache on demand
        available = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError, IndexError):
        return None
    group = root / "sys/fs/cgroup"
    with suppress(OSError, ValueError):  # without a control group, the memory of the machine is the limit
        # files of control groups of version 2; control groups of version 1 are not read
        limit, used = ((group / name).read_text().strip() for name in ("memory.max", "memory.current"))
        if limit != "max":
            available = min(available, int(limit) - int(used))
    return available


def memory_check(available: int | None = None) -> Check:
    """Check whether there is enough memory for a report."""
    available = available_memory_bytes() if available is None else available
    if available is None:
        return Check("Memory", "warn", "unknown on this system", "have 2 GiB free for a report")
    free = f"{available / 1024**3:.1f} GiB free"
    if available < _MEMORY_NEEDED_BYTES:
        return Check("Memory", "warn", free, "a report needs up to 2 GiB: close other programs")
    return Check("Memory", "ok", free)


def _disk_check(folder: Path) -> Check:
    """Check whether there is enough disk space where reports are written."""
    free = shutil.disk_usage(folder).free
    room = f"{free / 1024**3:.1f} GiB free in {folder}"
    if free < _DISK_NEEDED_BYTES:
        return Check("Disk", "warn", room, "free some space, or write reports elsewhere with '-o FOLDER'")
    return Check("Disk", "ok", room)


def cache_check(folder: Path) -> Check:
    """Check whether the folder of cached paths and kernels can be written to."""
    remedy = "set AERPAW_CMP_CACHE to a folder that you may write to"
    # check the nearest existing parent, because the folder does not exist before the first run
    existing = next((place for place in (folder, *folder.parents) if place.exists()), folder)
    if not existing.is_dir():
        return Check("Cache", "warn", f"{existing} is not a folder", remedy)
    # also check the right to enter the folder, because files cannot be created without it
    if not os.access(existing, os.W_OK | os.X_OK):
        return Check("Cache", "warn", f"{folder} cannot be written to", remedy)
    return Check("Cache", "ok", str(folder))


def readers_check() -> Check:
    """List the log formats that this installation reads."""
    from ..logs.readers import catalogue

    try:
        names = [reader.name for reader in catalogue()]
    except AerpawCmpError as error:
        return Check("Readers", "fail", str(error), "make setup")
    except Exception as error:  # the import of a third-party reader may raise any exception
        return Check("Readers", "fail", f"{type(error).__name__} while loading them: {error}", "make setup")
    return Check("Readers", "ok", f"{len(names)}: {', '.join(names)}")


def serial_checks() -> Iterator[Check]:
    """Check serial ports: whether this user may open them, and which processes use them. No port is opened."""
    try:
        import fcntl  # noqa: F401
        import termios  # noqa: F401

        from serial.tools import list_ports
    except ImportError as error:
        if error.name in ("fcntl", "termios"):
            found = f"this system has no {error.name}: 'tap' and 'modem-sim' need Linux, the rest works"
            yield Check("Serial", "warn", found, "run the tap on Linux")
        else:
            found = "is not installed" if isinstance(error, ModuleNotFoundError) else f"cannot be loaded ({error})"
            yield Check("Serial", "fail", f"pyserial {found}", "make setup")
        return
    # ignore ttyS*, because these ports of the main board are listed even if no device is plugged in
    ports = sorted(port for port in list_ports.comports() if port.vid is not None or "ttyS" not in port.device)
    if not ports:
        yield Check("Serial", "ok", "no USB serial port: plug the modem in to use 'aerpaw-cmp tap'")
    for port in ports:
        yield serial_check(port.device, port.description or "")


def serial_check(device: str, description: str = "") -> Check:
    """Check whether this user may open a port, and whether it is in use. Only root sees the programs of other users."""
    from ..live.ports import holders  # needs termios

    port = f"{device} {description}".strip()
    if not os.access(device, os.R_OK | os.W_OK):
        # the remedy includes a login, because membership of a group starts with the next login
        group = "dialout"
        with suppress(OSError, KeyError, NotImplementedError):
            group = Path(device).group()  # dialout on Debian, uucp on Arch
        remedy = f"sudo usermod -aG {group} $USER, then log in again"
        return Check("Serial", "warn", f"{port}: not allowed", remedy)
    if busy := [f"{holder.name} ({holder.pid})" for holder in holders(Path(device), others_only=False)]:
        # ModemManager opens every port of a new modem automatically, and would read the answers to our commands
        stop = "sudo systemctl stop ModemManager" if any("ModemManager" in name for name in busy) else "stop it"
        return Check("Serial", "warn", f"{port}: held by {', '.join(busy)}", stop)
    return Check("Serial", "ok", port)

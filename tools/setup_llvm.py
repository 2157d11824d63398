"""Make sure that Dr.Jit has an LLVM that works: find one, else install one, else print the line that does.

Run by ``make setup`` with the Python that has Sionna RT. Exit code 0 when an LLVM works, 1 otherwise.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from aerpaw_cmp.common.errors import AerpawCmpError
from aerpaw_cmp.propagation import llvm


def say(text: str) -> None:
    """To standard error, so that what make prints stays in order."""
    print(text, file=sys.stderr)


def root_prefix() -> list[str] | None:
    """Prefix of a command that needs root: nothing, sudo, or None when it may not be run."""
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        return []
    sudo = shutil.which("sudo")
    if sudo is None:
        return None
    silent = subprocess.run([sudo, "-n", "true"], capture_output=True, check=False).returncode == 0
    if silent:
        return [sudo, "-n"]
    return [sudo] if sys.stdin is not None and sys.stdin.isatty() else None


def apt(say: Callable[[str], None]) -> Callable[..., bool] | None:
    """apt-get of this machine, which tells ``say`` each command and answers whether it did it; None where it cannot."""
    prefix = root_prefix()
    if prefix is None or not llvm.os_families() & {"debian", "ubuntu"} or shutil.which("apt-get") is None:
        return None

    def apt_get(*arguments: str) -> bool:
        command = [*prefix, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", *arguments]
        say(" ".join(command))
        # a person may have to answer sudo; apt itself asks nothing
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
        if done.returncode:
            say(done.stdout.strip()[-1000:])
        return done.returncode == 0

    return apt_get


def install(
    say: Callable[[str], None], attempt: Callable[[llvm.Library], llvm.Trial] | None = None
) -> llvm.Trial | None:
    """Install the distribution's newest LLVM runtime with apt, trying older ones if its trial fails.

    Parameters
    ----------
    say : callable
        Told each command before it runs.
    attempt : callable, optional
        The trial; ``llvm.try_library`` by default.

    Returns
    -------
    Trial or None
        The trial of what was installed; None if nothing could be (not Debian or Ubuntu, no root, no package).
    """
    apt_get = apt(say)
    if apt_get is None:
        return None

    def apt_install(*packages: str) -> llvm.Trial | None:
        if not apt_get("install", "-y", "-qq", "--no-install-recommends", *packages):
            return None
        trials = llvm.first_that_works(llvm.candidates(), attempt)
        return trials[-1] if trials else None

    apt_get("update", "-qq")  # old lists name packages that the mirror no longer has
    # an LLVM is there and only Dr.Jit's own need is missing, or else the distribution's LLVMs, newest first
    wanted: list[tuple[str, ...]] = [(llvm.APT_RUNTIME,)] if llvm.candidates() else []
    wanted += [(package, llvm.APT_RUNTIME) for package in llvm.apt_packages(llvm.known_to_apt())]
    last: llvm.Trial | None = None
    for packages in wanted:
        last = apt_install(*packages) or last
        if last is not None and last.ok:
            break
    return last


def main() -> int:
    """Find, try, install, explain."""
    try:
        trials = llvm.first_that_works(llvm.candidates())
    except AerpawCmpError as error:
        say(str(error))
        return 1
    for trial in trials:
        say(f"{trial.library.label if trial.library else ''}: {trial.reason or 'works'}")
    if trials and trials[-1].ok:
        return 0
    if llvm.sionna_fails(trials):
        say(f"{llvm.explain(trials)}. Please remove .venv and run the same make command again, if need be with another")
        say("Python: make PYTHON=python3.12 report")
        return 1
    if not trials or trials[-1].blames_library or trials[-1].missing:
        say(f"{llvm.explain(trials)}. Installing what is missing, if this user may.")
        installed = install(say)
        if installed is not None and installed.ok and installed.library is not None:
            say(f"{installed.library.label}: works")
            return 0
        if installed is not None:
            say(llvm.explain([installed]))
    say(f"No usable LLVM of version {llvm.MINIMUM_MAJOR} or newer. Please run this line, then the same make command:")
    say(f"    {llvm.install_line()}")
    return 1


if __name__ == "__main__":
    sys.exit(main())

"""Find an LLVM that works for Dr.Jit, or install one, or print the command that installs one.

``make setup`` runs it with the Python that has Sionna RT. The exit code is 0 if an LLVM works, else 1.
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
    """Print to standard error, so that the lines are in order with those of make."""
    print(text, file=sys.stderr)


def root_prefix() -> list[str] | None:
    """Return the prefix of a command that needs root: empty, sudo, or None if this user may not run it."""
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
    """Return a function that runs apt-get and returns success, or None without apt. ``say`` receives each command."""
    prefix = root_prefix()
    if prefix is None or not llvm.os_families() & {"debian", "ubuntu"} or shutil.which("apt-get") is None:
        return None

    def apt_get(*arguments: str) -> bool:
        command = [*prefix, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", *arguments]
        say(" ".join(command))
        # sudo may request a password, so standard input stays connected; apt does not ask
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
        Receives each command before it runs.
    attempt : callable, optional
        Tests a library. Default: ``llvm.try_library``.

    Returns
    -------
    Trial or None
        The test of the installed library. None if none can be installed (other system, no root, no package).
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
    # if there is an LLVM, first only install the library that Dr.Jit needs; then try LLVM packages, newest first
    wanted: list[tuple[str, ...]] = [(llvm.APT_RUNTIME,)] if llvm.candidates() else []
    wanted += [(package, llvm.APT_RUNTIME) for package in llvm.apt_packages(llvm.known_to_apt())]
    last: llvm.Trial | None = None
    for packages in wanted:
        last = apt_install(*packages) or last
        if last is not None and last.ok:
            break
    return last


def main() -> int:
    """Find and test an LLVM, install one if none works, and report the result."""
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
        say(f"{llvm.explain(trials)}. Please remove .venv and run the same make command again, if necessary with")
        say("another Python: make PYTHON=python3.12 report")
        return 1
    if not trials or trials[-1].blames_library or trials[-1].missing:
        say(f"{llvm.explain(trials)}. Installing the missing packages, if this user has the permission.")
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

"""Make sure that Dr.Jit has an LLVM that works: find one, else install one, else print the line that does.

Run by ``make setup`` with the Python that has Sionna RT. Exit code 0 when an LLVM works, 1 otherwise.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from aerpaw_cmp.common.errors import AerpawCmpError
from aerpaw_cmp.machine import llvm


def say(text: str) -> None:
    """To standard error, so that what make prints stays in order."""
    print(text, file=sys.stderr)


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
        installed = llvm.install(say)
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

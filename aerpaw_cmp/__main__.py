"""Entry point of the command line. It prints ``--help`` itself, and :mod:`aerpaw_cmp.cli` runs all commands.

Only this module turns exceptions into messages and exit codes:

====  ==========================================================
0     done
1     the job ran, but a stated check failed
2     wrong usage or configuration
3     an input could not be read, or an output not written
70    an error in the program itself (``--debug`` shows where)
130   interrupted; 143 by SIGTERM, 129 by SIGHUP
141   the reader of the output has closed it (``aerpaw-cmp ... | head``)
====  ==========================================================
"""

from __future__ import annotations

import errno
import gc
import os
import signal
import sys

from .common import interrupts
from .common.interrupts import SIGNALLED

INTERNAL_ERROR = 70
OUTPUT_FAULT = 3
BROKEN_PIPE = 141
# A shell sets this variable to request completions of the command line.
_COMPLETE = "_AERPAW_CMP_COMPLETE"
# With this variable, Typer reads the name of the shell from the command line instead of from the parent process, which
# may not exist.
_SHELL_IS_NAMED = "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION"
ISSUES = "the project's issue tracker"
# Variables that limit the threads of BLAS. The program solves many small systems, for which several threads would wait
# for each other: the sample report would take 3.6 times the processor time. Values that the user has set are not
# changed.
BLAS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

# Errors that methods of pathlib, such as ``is_dir``, raise for paths that cannot be used.
_UNUSABLE = (errno.ENAMETOOLONG, errno.EACCES, errno.EPERM, errno.ELOOP, errno.ENOTDIR, errno.EIO, errno.ESTALE)
LONGEST_NAME = 120

# Number of new objects after which Python searches for reference cycles. With the default of 700, Python would search
# often and find little, because a report creates a million objects and keeps most of them.
NEW_OBJECTS = 10_000


def help_text() -> str:
    """Return the text that ``aerpaw-cmp --help`` prints."""
    from .common.text import COMMANDS

    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {line}" for name, line in COMMANDS.items()]
    return "\n".join(
        [
            "Usage: aerpaw-cmp COMMAND [OPTIONS] [ARGUMENTS]",
            "",
            "AERPAW field logs in, a ray-tracing comparison out.",
            "",
            "Commands:",
            *lines,
            "",
            "Options:",
            "  -h, --help  Show this help; 'aerpaw-cmp COMMAND --help' describes one command.",
            "  --version   Show the version.",
            "  --debug     Show the traceback of a failure (also AERPAW_CMP_DEBUG=1).",
            "  --install-completion, --show-completion [bash|zsh|fish]   What the Tab key completes.",
            "",
            "Exit codes: 0 done, 1 a stated check failed, 2 wrong usage or configuration,",
            "3 an input cannot be read or an output not written.",
        ]
    )


def _unknown_command(name: str) -> str:
    from difflib import get_close_matches

    from .common.text import COMMANDS

    near = get_close_matches(name, COMMANDS, n=1)
    hint = f"; did you mean '{near[0]}'?" if near else "; 'aerpaw-cmp --help' lists the commands"
    return f"aerpaw-cmp: there is no command '{name}'{hint}"


def _quick_answer(arguments: list[str]) -> int | None:
    """Handle a command line that needs no library. Return None if the application has to run."""
    from .common.text import COMMANDS

    if _COMPLETE in os.environ:
        return None
    first = arguments[0] if arguments else ""
    if first in ("", "-h", "--help"):
        print(help_text())
        return 0 if first else 2
    if first == "--version":
        from .common.versions import tool_version

        print(f"aerpaw-cmp {tool_version()}")
        return 0
    if not first.startswith("-") and first not in COMMANDS:
        from .common.errors import printable

        print(printable(_unknown_command(first)), file=sys.stderr)
        return 2
    return None


def _message(error: BaseException, arguments: list[str]) -> tuple[str, int]:
    """Return the message to the user about an exception that nothing else caught, and the exit code."""
    from .common.errors import AerpawCmpError

    if isinstance(error, AerpawCmpError):
        from .common.errors import next_step

        text = f"aerpaw-cmp: {error}".rstrip(".")
        gap = "\n  " if "\n" in text else " " if text.endswith("?") else ". "
        step = next_step(error, arguments)
        return f"{text}{gap}Next: {step}" if step else text, error.exit_code
    if callable(wording := getattr(error, "format_message", None)):
        # a wrong option or argument. Recognise it by its method, because typer may contain its own copy of click.
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "aerpaw-cmp"
        return f"{command}: {wording().rstrip('.')}; '{command} --help' lists the options", 2
    if isinstance(error, ModuleNotFoundError) and error.name and not error.name.startswith("aerpaw_cmp"):
        return f"aerpaw-cmp: the Python package '{error.name}' is not installed; 'make setup' installs everything", 1
    if isinstance(error, FileNotFoundError) and _has_no_folder():
        return "aerpaw-cmp: the working folder was removed; expected a folder that exists ('cd' to one)", 2
    if isinstance(error, OSError) and error.errno in _UNUSABLE and error.filename:
        shown = os.fsdecode(error.filename)
        shown = shown if len(shown) <= LONGEST_NAME else f"{shown[:LONGEST_NAME]}..."
        return f"aerpaw-cmp: {shown}: cannot be used ({error.strerror}); expected an accessible file or folder", 3
    kind = type(error).__name__
    return (
        f"aerpaw-cmp: internal error, {kind}: {str(error).strip() or 'no message'}\n"
        f"This is a fault of the program, not of your input. Run the same command with --debug and send what it shows, "
        f"and the output of 'aerpaw-cmp doctor', to {ISSUES}.",
        INTERNAL_ERROR,
    )


def _has_no_folder() -> bool:
    try:
        os.getcwd()  # noqa: PTH109  pathlib is not loaded for --help
    except OSError:
        return True
    return False


def _notes(error: BaseException | None) -> list[str]:
    """Return the notes about stored results of an exception and of its causes."""
    notes: list[str] = []
    while error is not None:
        notes += [note for note in getattr(error, "__notes__", ()) if note not in notes]
        error = error.__cause__ or error.__context__
    return notes


def main(arguments: list[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : list of str, optional
        Arguments without the program's name. By default, the arguments of this process are used.

    Returns
    -------
    int
        The exit code. Exceptions are caught here.
    """
    own_process = arguments is None  # NumPy is not loaded yet, so its threads can still be limited
    if own_process:
        for name in BLAS:
            os.environ.setdefault(name, "1")
        gc.set_threshold(NEW_OBJECTS)
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    interrupts.guard()
    before_dashes = arguments[: arguments.index("--")] if "--" in arguments else arguments
    debug = "--debug" in before_dashes or os.environ.get("AERPAW_CMP_DEBUG", "0") not in ("", "0")
    if "--debug" in before_dashes:
        arguments.remove("--debug")
    if arguments[:1] in (["--install-completion"], ["--show-completion"]) and len(arguments) > 1:
        os.environ.setdefault(_SHELL_IS_NAMED, "1")
    try:
        code = _quick_answer(arguments)
        if code is None:
            with interrupts.noted():
                from . import cli

                code = cli.main(arguments)
                if code == SIGNALLED + signal.SIGINT:
                    interrupts.raise_interrupt()  # typer returns this code if it was interrupted while parsing
    except KeyboardInterrupt as interrupt:
        exec("")  # otherwise, after an interrupt in exec(), CPython would end by the signal instead of with code 130
        code = _interrupted(interrupt)
    except Exception as error:
        code = _failed(error, debug, arguments)
    if own_process:
        gc.freeze()  # skip the last garbage collection, which takes 0.3 s; the memory is freed when the process ends
    return _code_of_output(code)


def _interrupted(interrupt: KeyboardInterrupt) -> int:
    """Report which results were stored, and return 128 plus the number of the signal."""
    from .common.errors import one_line

    by = interrupts.last()
    print(one_line("; ".join([f"aerpaw-cmp: {interrupts.cause(by)}", *_notes(interrupt)])), file=sys.stderr)
    return SIGNALLED + by


def _failed(error: Exception, debug: bool, arguments: list[str]) -> int:
    if type(error).__name__ == "Abort":  # click raises Abort for Ctrl-C at a prompt
        return SIGNALLED + signal.SIGINT
    if debug:
        import traceback

        traceback.print_exc()
    from .common.errors import printable

    text, code = _message(error, arguments)
    print(printable(text), file=sys.stderr)
    return code


def _code_of_output(code: int) -> int:
    """Return the exit code after flushing standard output.

    Without this flush, a failed write would be noticed only when the process exits.
    """
    fault = interrupts.output_fault()
    if fault is None or code:
        return code
    if isinstance(fault, BrokenPipeError):
        return BROKEN_PIPE
    cause = "closed, or not open for writing" if fault.errno == errno.EBADF else "a full disk"
    print(
        f"aerpaw-cmp: the results cannot be written to standard output ({fault.strerror}). Likely cause: {cause}",
        file=sys.stderr,
    )
    return OUTPUT_FAULT


if __name__ == "__main__":
    sys.exit(main())

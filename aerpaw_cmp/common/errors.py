"""Exceptions, sorted by whose fault it is: one class per answer, each with its exit code.

======================  =========  =====================================
class                   exit code  meaning
======================  =========  =====================================
:class:`CheckError`     1          the job ran, a stated check failed
:class:`UsageError`     2          wrong usage or configuration
:class:`InputError`     3          an input could not be read
:class:`OutputError`    3          an output could not be written
======================  =========  =====================================

A message says what was found, what was expected, the likely cause and the place.
Any other exception that reaches a user is a bug of ours.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from types import FunctionType
from typing import Any, ParamSpec, TypeVar, cast

_P = ParamSpec("_P")
_T = TypeVar("_T")


def one_line(text: str) -> str:
    r"""Text for one line of a message: line breaks, control characters and bytes that are no UTF-8 as escapes.

    The narrow space within numbers (6 550) stays: Python calls it unprintable.

    Examples
    --------
    >>> print(one_line("two\nlines"))
    two\nlines
    """
    return "".join(c if c.isprintable() or c == "\u202f" else c.encode("unicode_escape").decode("ascii") for c in text)


def printable(text: str) -> str:
    r"""Text that may have lines and holds nothing that a terminal takes for a command: a file's words may be in it.

    All that is printed passes through here or through :func:`one_line`.

    Examples
    --------
    >>> print(printable("red: \x1b[31m"))
    red: \x1b[31m
    """
    return "\n".join(one_line(line) for line in text.split("\n"))


def add_note(error: BaseException, text: str) -> None:
    """Add a sentence to an exception that goes on: what is kept when a run is interrupted.

    Notes
    -----
    What ``BaseException.add_note`` of Python 3.11 does.
    """
    error.__notes__ = [*getattr(error, "__notes__", ()), text]  # type: ignore[attr-defined]


@contextmanager
def noting_interrupts(text: str) -> Iterator[None]:
    """An interrupt inside says ``text`` when it is told."""
    try:
        yield
    except KeyboardInterrupt as error:
        add_note(error, text)
        raise


class AerpawCmpError(Exception):
    """A message for the user; never shown with a traceback.

    Parameters
    ----------
    found : str
        What was found, as a sentence without a full stop.
    expected : str, optional
        What was expected instead.
    cause : str, optional
        The likely cause, or the line that mends it.
    path : str or Path, optional
        The file.
    line : int, optional
        1-based line of the file.

    Examples
    --------
    >>> print(InputError("the file is empty", expected="log lines", path="a.txt"))
    a.txt: the file is empty; expected log lines
    >>> print(UsageError("unknown key 'sight'", cause="did you mean 'site'?", path="f.yaml", line=3))
    f.yaml, line 3: unknown key 'sight'. Likely cause: did you mean 'site'?
    """

    exit_code = 1

    def __init__(
        self,
        found: str,
        *,
        expected: str | None = None,
        cause: str | None = None,
        path: str | Path | None = None,
        line: int | None = None,
    ) -> None:
        self.found = found
        self.expected = expected
        self.cause = cause
        self.path = None if path is None else str(path)
        self.line = line
        super().__init__(str(self))

    def __str__(self) -> str:
        place = one_line(self.path or "")
        if self.line is not None:
            place += f", line {self.line}" if place else f"line {self.line}"
        text = f"{place}: {self.found}" if place else self.found
        if self.expected:
            text += f"; expected {self.expected}"
        if self.cause:
            text += f". Likely cause: {self.cause}"
        return printable(text)


@contextmanager
def about_file(path: str | Path) -> Iterator[None]:
    """Errors from inside that name no file are about this one."""
    try:
        yield
    except AerpawCmpError as error:
        if error.path is not None:
            raise
        raise type(error)(
            error.found, expected=error.expected, cause=error.cause, path=path, line=error.line
        ) from error


_IN_WORDS: dict[Any, str] = {
    RecursionError: "it is nested too deep",
    MemoryError: "it does not fit into the memory",
    UnicodeError: "it is no UTF-8 text",
}


# Raised by a line of this package, these are its own faults and not those of a file.
_FAULTS = (TypeError, AttributeError, NameError, AssertionError, NotImplementedError, ImportError)


@contextmanager
def parsing(
    path: str | Path, expected: str | None = None, cause: str = "a damaged file", *, any_shape: bool = False
) -> Iterator[None]:
    """Whatever a file's content makes its parser raise is an :class:`InputError` about the file.

    The one place for it, since libraries raise two dozen kinds on damage (RecursionError of a nested JSON, csv.Error of
    a long cell, struct.error, MemoryError of a forged length, ...). Only reading stands inside, no computation.

    Parameters
    ----------
    path : str or Path
    expected, cause : str, optional
        Of the message, for what the parser does not foresee itself.
    any_shape : bool
        Inside, JSON is walked through whose shape nobody has checked: there a TypeError is of the file, elsewhere ours.

    Yields
    ------
    None
    """
    try:
        with about_file(path):
            yield
    except AerpawCmpError:
        raise
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", expected=expected, path=path) from error
    except Exception as error:
        if isinstance(error, _FAULTS) and not any_shape and _is_raised_here(error):
            raise
        words = f"{type(error).__name__}: {one_line(str(error)[:200])}"
        # of a class by its base: UnicodeDecodeError is a UnicodeError
        words = next((text for kind, text in _IN_WORDS.items() if isinstance(error, kind)), words)
        raise InputError(
            f"cannot be read ({words})",
            expected=expected,
            cause=cause,
            path=path,
        ) from error


def _is_raised_here(error: BaseException) -> bool:
    """Check whether a line of this package or of its readers raised an error, not a library that it called."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        # the last frame is where it was raised
        trace = trace.tb_next
    name = "" if trace is None else str(trace.tb_frame.f_globals.get("__name__"))
    return name.partition(".")[0] in ("aerpaw_cmp", "aerpaw_parsers")


def parsed(expected: str) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """Decorator of a function that reads the file which its first argument names: :func:`parsing` around it."""

    def decorate(function: Callable[_P, _T]) -> Callable[_P, _T]:
        @wraps(function)
        def run(*arguments: _P.args, **more: _P.kwargs) -> _T:
            with parsing(cast("str | Path", (*arguments, *more.values())[0]), expected):
                return function(*arguments, **more)

        return run

    return decorate


# Arguments of Python that have another name than the option of the command line.
_IN_PYTHON = {"--with": "learned", "--force": "force=True"}


def _as_argument(option: re.Match[str]) -> str:
    name = _IN_PYTHON.get(option[1], option[1][2:].replace("-", "_"))
    return name if "=" in name else f"{name}="


def _as_columns(options: re.Match[str]) -> str:
    pairs = re.findall(r"--map '([^']*)'=(\w+)", options[0])
    return f"columns={ ({quantity: column for column, quantity in pairs}) }"


def from_python(public: _T) -> _T:
    """Decorator of a public function or class: errors name arguments (``timezone=``), not options (``--timezone``).

    An argument that a record of options refuses is one of the public function; what only ``fit`` knows asks for it.
    """
    if isinstance(public, type):
        for name, method in vars(public).items():
            if isinstance(method, FunctionType) and (name == "__call__" or not name.startswith("_")):
                setattr(public, name, from_python(method))
        return public
    function = cast("Callable[..., Any]", public)

    @wraps(function)
    def run(*arguments: Any, **more: Any) -> Any:
        try:
            return function(*arguments, **more)
        except AerpawCmpError as error:
            for part in ("found", "expected", "cause"):
                if text := getattr(error, part):
                    text = re.sub(r"--map '[^']*'=\w+( --map '[^']*'=\w+)*", _as_columns, text.replace(" after -o", ""))
                    setattr(error, part, re.sub(r"(?<!\S)(--[a-z][a-z-]*)( (?='))?", _as_argument, text))
            raise
        except TypeError as error:
            refused = re.fullmatch(r"\w+\.__init__(\(\) got an unexpected keyword argument .*)", str(error))
            raise TypeError(function.__name__ + refused[1]) if refused else error from None
        except AttributeError as error:
            # names that fit() makes end in an underscore: one that the object itself lacks says what to do
            if error.obj is not (arguments or (None,))[0] or not (error.name or "").endswith("_"):
                raise
            raise UsageError(f"{function.__qualname__} before fit()", expected="fit() first") from None

    return cast("_T", run)


class CheckError(AerpawCmpError):
    """The job ran, but a check that the user asked for did not hold."""

    exit_code = 1


class UsageError(AerpawCmpError):
    """The command line or a configuration file is wrong."""

    exit_code = 2
    others: Any = ()
    """Logs that were read all the same, beside the log that lacks an option."""


class InputError(AerpawCmpError):
    """An input file or device could not be read."""

    exit_code = 3


class OutputError(AerpawCmpError):
    """The disk does not take an output: it is full, fails, or may not be written."""

    exit_code = 3

"""Exceptions for users: one class per cause, each with its exit code.

======================  =========  =====================================
class                   exit code  meaning
======================  =========  =====================================
:class:`CheckError`     1          the job ran, a requested check failed
:class:`UsageError`     2          wrong usage or configuration
:class:`InputError`     3          an input could not be read
:class:`OutputError`    3          an output could not be written
======================  =========  =====================================

A message contains what was found, what was expected, the likely cause, and the file and line. Any other exception that
reaches a user is a bug in this package.

Every message ends with the next step: the command to run or the line to edit.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from functools import wraps
from itertools import pairwise
from pathlib import Path
from types import FunctionType
from typing import Any, ParamSpec, TypeVar, cast

_P = ParamSpec("_P")
_T = TypeVar("_T")


def one_line(text: str) -> str:
    r"""Return text for one line of a message, with line breaks, control characters and non-UTF-8 bytes escaped.

    The narrow space within numbers (6 550) is kept, although Python does not consider it printable.

    Examples
    --------
    >>> print(one_line("two\nlines"))
    two\nlines
    """
    return "".join(c if c.isprintable() or c == "\u202f" else c.encode("unicode_escape").decode("ascii") for c in text)


def printable(text: str) -> str:
    r"""Return text with line breaks but without terminal control sequences, because it may quote a file.

    All printed text passes through this function or :func:`one_line`.

    Examples
    --------
    >>> print(printable("red: \x1b[31m"))
    red: \x1b[31m
    """
    return "\n".join(one_line(line) for line in text.split("\n"))


def typed(path: str | Path) -> str:
    """Return a path as a user types it in a command line: in quotes if it contains spaces or special characters.

    Examples
    --------
    >>> print(typed("LW1/a.txt"), typed("Lake Wheeler/a.txt"))
    LW1/a.txt "Lake Wheeler/a.txt"
    """
    text = one_line(str(path))
    if re.fullmatch(r"[\w@%+=:,./~-]+", text):
        return text
    return shlex.quote(text) if re.search(r'["$`\\!]', text) else f'"{text}"'


def add_note(error: BaseException, text: str) -> None:
    """Add a sentence to an exception that is raised again, for example about stored results.

    Notes
    -----
    Equivalent to ``BaseException.add_note`` of Python 3.11.
    """
    error.__notes__ = [*getattr(error, "__notes__", ()), text]  # type: ignore[attr-defined]


@contextmanager
def noting_interrupts(text: str) -> Iterator[None]:
    """Add ``text`` to the message of an interrupt that occurs inside."""
    try:
        yield
    except KeyboardInterrupt as error:
        add_note(error, text)
        raise


class AerpawCmpError(Exception):
    """A message for the user, shown without a traceback.

    Parameters
    ----------
    found : str
        What was found, as a sentence without a full stop.
    expected : str, optional
        What was expected instead.
    cause : str, optional
        The likely cause, or the command or line that fixes it.
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
def about_file(path: str | Path, line: int | None = None) -> Iterator[None]:
    """Add a path to errors from inside the block that do not name a file, and a line if the error has none."""
    try:
        yield
    except AerpawCmpError as error:
        if error.path is not None:
            raise
        raise type(error)(
            error.found, expected=error.expected, cause=error.cause, path=path, line=error.line or line
        ) from error


_IN_WORDS: dict[Any, str] = {
    RecursionError: "it is nested too deeply",
    MemoryError: "it does not fit in memory",
    UnicodeError: "it is not UTF-8 text",
}


# If a line of this package raises an exception of these classes, it is a bug of this package and not an error in a
# file.
_FAULTS = (TypeError, AttributeError, NameError, AssertionError, NotImplementedError, ImportError)


@contextmanager
def parsing(
    path: str | Path, expected: str | None = None, cause: str = "a damaged file", *, any_shape: bool = False
) -> Iterator[None]:
    """Convert exceptions that a parser raises because of a file's content into :class:`InputError` about that file.

    Libraries raise two dozen kinds of exceptions for damaged files, such as RecursionError for deeply nested JSON,
    csv.Error for a long cell, struct.error, and MemoryError for a forged length. Only use this context for reading, not
    for computations.

    Parameters
    ----------
    path : str or Path
    expected, cause : str, optional
        Parts of the message for errors that the parser does not handle.
    any_shape : bool
        True if the block reads JSON whose structure was not checked. A TypeError is then an error of the file,
        otherwise a bug.

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
        words = "it has no" if isinstance(error, KeyError) else f"{type(error).__name__}:"
        words += f" {one_line(str(error)[:200])}"
        # use isinstance, because UnicodeDecodeError is a subclass of UnicodeError
        words = next((text for kind, text in _IN_WORDS.items() if isinstance(error, kind)), words)
        raise InputError(f"cannot be read ({words})", expected=expected, cause=cause, path=path) from error


def _is_raised_here(error: BaseException) -> bool:
    """Check whether a line of this package or of its readers raised an error, not a library that it called."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        # the last frame of a traceback is where the error was raised
        trace = trace.tb_next
    name = "" if trace is None else str(trace.tb_frame.f_globals.get("__name__"))
    return name.partition(".")[0] in ("aerpaw_cmp", "aerpaw_parsers")


def parsed(expected: str) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """Decorate a function that reads the file named by its first argument: run it inside :func:`parsing`."""

    def decorate(function: Callable[_P, _T]) -> Callable[_P, _T]:
        @wraps(function)
        def run(*arguments: _P.args, **more: _P.kwargs) -> _T:
            with parsing(cast("str | Path", (*arguments, *more.values())[0]), expected):
                return function(*arguments, **more)

        return run

    return decorate


# Command-line options and their Python arguments, if the names differ.
_IN_PYTHON = {"--with": "learned", "--force": "force=True"}


def _as_argument(option: re.Match[str]) -> str:
    name = _IN_PYTHON.get(option[1], option[1][2:].replace("-", "_"))
    return name if "=" in name else f"{name}="


def _as_columns(options: re.Match[str]) -> str:
    pairs = re.findall(r"--map '([^']*)'=(\w+)", options[0])
    return f"columns={ ({quantity: column for column, quantity in pairs}) }"


def from_python(public: _T) -> _T:
    """Decorate a public function or class, so that errors name arguments (``timezone=``), not options (``--timezone``).

    An argument that an options record refuses is reported for the public function. If an attribute is missing that only
    ``fit()`` creates, the message says to call ``fit()`` first.
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
            # names that fit() creates end in an underscore: report that fit() must be called first
            if error.obj is not (arguments or (None,))[0] or not (error.name or "").endswith("_"):
                raise
            raise UsageError(f"{function.__qualname__} before fit()", expected="fit() first") from None

    return cast("_T", run)


class CheckError(AerpawCmpError):
    """The error for a failed check that the user requested. The job itself ran."""

    exit_code = 1


class UsageError(AerpawCmpError):
    """The error for a wrong command line or configuration file.

    Attributes
    ----------
    others : Ingested or ()
        Logs that were read successfully, in addition to the log that requires an option.
    """

    exit_code = 2
    others: Any = ()


class InputError(AerpawCmpError):
    """The error for an input file or device that could not be read."""

    exit_code = 3


class OutputError(AerpawCmpError):
    """The error for an output that cannot be written: the disk is full, fails, or is not writable."""

    exit_code = 3


_SETTINGS = (".yaml", ".yml")
# Commands whose settings all come from a file.
_OF_SETTINGS = [["report"], ["simulate"], ["calibrate"], ["campaign"]]
_OF_LOGS = [["report"], ["explain"], ["calibrate"], ["campaign"], ["predict"], ["plan"]]


def next_step(error: AerpawCmpError, arguments: Sequence[str]) -> str:
    """Return the step that most likely fixes a failure of a command line. Empty if no step is known.

    Parameters
    ----------
    error : AerpawCmpError
    arguments : sequence of str
        The command line, without the program's name.

    Returns
    -------
    str
    """
    words = [word for word in arguments[:2] if not word.startswith("-")]
    command = " ".join(["aerpaw-cmp", *words[: 2 if words[:1] in (["site"], ["antenna"]) else 1]])
    place = None if error.path is None else Path(error.path)
    if place is not None and not _exists(place):  # the path may be relative to a settings file
        candidates = (Path(word).parent / place for word in arguments if word.endswith(_SETTINGS))
        place = next(filter(_exists, candidates), place)
    if "there is no telemetry log" in error.found:
        named = "--map COLUMN=latitude_deg --map COLUMN=longitude_deg names positions in the log"
        return f"'aerpaw-cmp ingest LOG TELEMETRY --draft flight.yaml' drafts it with telemetry; {named}"
    if again := re.search(r"(?:learn it again: |(?=pip install))(.+?)(?:, or |$)", error.expected or ""):
        return again[1]
    if " it with: " in error.found:  # a missing or damaged Sionna RT
        return "run that line, or use the engine 'image'"
    if isinstance(error, CheckError):
        return "read the page, or run without the check"
    if option := re.search(r"a new name after (--\w+)", error.expected or ""):
        return f"the same command with another name after {option[1]}"
    if isinstance(error, OutputError) or re.search(r"after -o\b|-o NAME|a new name", error.expected or ""):
        return "the same command with another name after -o"
    if place is not None and (reader := re.search(r"'(aerpaw-cmp [a-z]+) FILE' reads", error.found)):
        return f"'{reader[1]} {typed(place)}'"
    if "SHA-256 in its first line" in error.found:
        return f"copy {one_line(Path(str(place)).name)} again from the unchanged file, or calibrate again"
    if error.found == "not a regular file":
        return f"'ls -l {typed(str(place))}' shows what is there"
    predictions = [Path(last) for option, last in pairwise(arguments) if option == "--against"]
    if place is not None and place in predictions and _exists(place):
        if place.suffix in _SETTINGS:
            return f"the same command with the folder {typed(place.parent)}"
        other = f"correct {one_line(place.name)} (docs/referee.md lists the columns)"
        return f"{'name another prediction' if place.is_dir() else other} and run the same command"
    if place is not None and [Path(word) for word in arguments].count(place) > 1:
        return f"the same command with {typed(place)} once"
    if place is not None and place.suffix in _SETTINGS and _exists(place) and words[:1] != ["ingest"]:
        line = "" if error.line is None else f", line {error.line},"
        return f"fix {one_line(place.name)}{line} and run the same command"
    if place is not None and error.expected == "a YAML file" and _exists(place) and place.is_dir():
        # the user may have named a folder of 'calibrate' instead of the settings file next to it
        beside = [path for path in (place.parent / f"{place.name}.yaml",) if _exists(path)]
        settings = beside or sorted(path for path in place.iterdir() if path.suffix in _SETTINGS)
        if len(settings) == 1:
            return f"the same command with {typed(settings[0])}"
        if not settings and words[:1] in _OF_LOGS:
            return f"'aerpaw-cmp ingest {typed(place)} --draft flight.yaml' writes one from its logs"
    if extra := re.match(r"Got unexpected extra argument\S* \((.+)\)", error.found):
        return f"the same command without {one_line(extra[1])}"
    settings_files = [word for word in arguments if word.endswith(_SETTINGS)]
    # if a log has no time zone, name the settings file, because the key must be added there
    in_file = place is None or "timezone:" in (error.expected or "")
    if in_file and settings_files and words[:1] in _OF_SETTINGS and "--" not in error.found:
        # do not name the first of several files, because another may be wrong: the message already names the flights
        wrong = one_line(Path(settings_files[0]).name) if len(settings_files) == 1 else "the flight files"
        return f"fix {wrong} and run the same command"
    if words[:1] == ["tap"] and isinstance(error, InputError):
        return "'aerpaw-cmp doctor' lists the serial ports"
    if re.match("Missing|No such option", error.found):
        return f"'{command} --help' lists the options"
    if place is None:
        return f"correct the options and run the same command ('{command} --help' describes them)"
    return _step_for(place, error, command, arguments)


def _step_for(place: Path, error: AerpawCmpError, command: str, arguments: Sequence[str]) -> str:
    """Return the step for an error that is about a file or folder."""
    words = command.split()[1:]
    if not isinstance(error, InputError) and (not _exists(place) or "--" in f"{error.expected} {error.cause}"):
        return f"'{command} --help' lists the options"
    if not _exists(place):
        return _nearest(place, arguments)
    if not place.is_file():
        return f"'ls -l {typed(place)}' shows what is there"
    if words[:1] == ["ingest"]:
        # return no step if the file is recognised or the cause explains --map: the message then contains the next step
        unknown = "no reader recognises" in error.found and "--map" not in (error.cause or "")
        return "'aerpaw-cmp formats' lists what can be read" if unknown else ""
    if "--tower NAME=" in (error.expected or ""):
        return "the same command with --tower NAME=LATITUDE,LONGITUDE,HEIGHT"
    if words[:1] in _OF_LOGS and re.search(r"\blogs?\b|\breaders?\b", f"{error.found} {error.expected} {error.cause}"):
        return f"'aerpaw-cmp ingest {typed(place)}' shows what the file contains"
    return f"correct {one_line(place.name)} or name another file, and run the same command"


def _exists(place: Path) -> bool:
    try:
        return place.exists()
    except (OSError, ValueError):
        return False


def _nearest(place: Path, arguments: Sequence[str]) -> str:
    """Return a hint: a file with a similar name, or the nearest existing folder."""
    words = {Path(word).absolute(): word for word in arguments}
    folder = place.parent
    while not _exists(folder) and folder != folder.parent:
        folder = folder.parent
    try:
        names = [item.name for item in folder.iterdir() if item.name != place.name and item.absolute() not in words]
    except OSError:
        names = []
    # suggest only a very similar name, because a less similar name could be another flight's file
    near = get_close_matches(place.name, names, n=1, cutoff=0.8) if folder == place.parent else []
    settings = [path.name for path, word in words.items() if word.endswith(_SETTINGS) and _exists(path)]
    if near and settings and place.absolute() not in words:
        where = settings[0] if len(settings) == 1 else "the file that names it"
        return f"replace {one_line(place.name)} by {one_line(near[0])} in {one_line(where)} and run the same command"
    if near:
        return f"the same command with {typed(folder / near[0])}"
    return f"'ls {typed(folder)}' shows the names there"

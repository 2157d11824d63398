"""The command-line application, and the options that its commands share.

A command is a function in a module of this package::

    @command("diff", examples=["aerpaw-cmp diff reports/a reports/b"])
    def diff(first: Annotated[Path, Argument(help="...")], strict: bool = False) -> int:
        from ..jobs.diff_reports import run_diff  # here, so that help and completion do not load the job

and a line of help in :data:`aerpaw_cmp.common.text.COMMANDS`. The function returns the exit code, or None for 0. The
decorator adds ``-h``, ``--json``, ``--quiet`` and the examples below the options. :func:`.answered` prints the JSON
object.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import typer
from typer import Option
from typer.core import TyperCommand

from ..common.errors import UsageError
from ..common.stages import NotRun
from ..common.text import COMMANDS
from ..jobs.options import DEFAULT, RunOptions
from .shown import print_plan, say

_Function = TypeVar("_Function", bound=Callable[..., Any])

_SETTINGS = {"help_option_names": ["-h", "--help"]}
# no rich markup, which would hide "[default: ...]"; no pretty exceptions, as __main__ turns exceptions into messages
app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False, context_settings=_SETTINGS
)
site_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)
app.add_typer(site_app, name="site", help=COMMANDS["site"])
antenna_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)
app.add_typer(antenna_app, name="antenna", help=COMMANDS["antenna"])

Json = Annotated[bool, Option("--json", help="Print only one JSON object on standard output.")]
Force = Annotated[
    bool, Option("--force", help="Also replace edited results, and an output file even if another program wrote it.")
]
LogsRoot = Annotated[Path | None, Option("--logs-root", help="Folder to which the paths of the logs are relative.")]
Flights = Annotated[
    list[Path] | None,
    Option(
        "--with",
        metavar="FLIGHT",
        help="flight.yaml of a flight to learn from, or a calibration.yaml that lists flights; repeatable.",
    ),
]
Figures = Annotated[
    Literal["none", "svg", "png", "pdf", "all"],
    Option(help="Format of figures as separate files: none, one format, or all formats."),
]
Quiet = Annotated[bool, Option("-q", "--quiet", help="Print only results, warnings and failures.")]


def output(text: str, metavar: str = "DIR") -> Any:
    """Return the option for the output folder or file. ``text`` is its help, which states the default."""
    return Option("-o", "--out", metavar=metavar, help=text)


# Options that several commands share, by the name of the field of :class:`~aerpaw_cmp.jobs.options.RunOptions` that
# each option sets.
_OF_RUN = {
    "logs_root": LogsRoot,
    "workers": Annotated[int, Option(min=1, help="Number of local workers that share the tasks.")],
    "scheduler": Annotated[
        str | None,
        Option("--scheduler", "--cluster", help="Address of a Dask scheduler to use instead of local workers."),
    ],
    "dry": Annotated[bool, Option("--dry-run", help="Check all inputs, print the stages, and write no files.")],
    "force": Force,
}


def of_run(out: str, *names: str, metavar: str = "DIR") -> dict[str, Any]:
    """Return the options that fill the :class:`RunOptions` of a command: ``--out`` and the named options."""
    return {"out": Annotated[Path | None, output(out, metavar)]} | {name: _OF_RUN[name] for name in names}


def command(
    name: str,
    *,
    examples: Sequence[str],
    of: typer.Typer = app,
    text: str | None = None,
    kind: type[TyperCommand] | None = None,
    options: Mapping[str, Any] | None = None,
) -> Callable[[_Function], _Function]:
    """Register a function as a command.

    Parameters
    ----------
    name : str
    examples : sequence of str
        Complete command lines, which are shown below the options. A test checks that they can be parsed.
    of : typer.Typer
        The application to which the command is added: the program, or a group such as ``site_app``.
    text : str, optional
        One line of help. The default is the line in :data:`aerpaw_cmp.common.text.COMMANDS`.
    kind : type, optional
        Class that parses the arguments. The default is typer's class.
    options : mapping, optional
        Options of the command, from :func:`of_run`. Their values are passed to the function as its argument
        ``options``.
    """
    epilog = "\b\nExamples:\n" + "\n".join(f"  {line}" for line in examples)
    register = of.command(name, cls=kind, help=COMMANDS[name] if text is None else text, epilog=epilog)

    def take(function: _Function) -> _Function:
        register(_with_common_options(function, options or {}))
        return function

    return take


class Interrupted(BaseException):
    """An interrupt of a command. Its ``error`` contains the message about stored results."""

    def __init__(self, error: KeyboardInterrupt) -> None:
        super().__init__(str(error))
        self.error = error


def _bare(hint: Any) -> Any:
    """Return a type hint without the ``Optional`` that Python 3.10 adds to parameters whose default is None."""
    inner = get_args(hint)[:1]
    return inner[0] if get_origin(hint) is Union and get_origin(inner[0]) is Annotated else hint


def _with_common_options(function: Callable[..., Any], of_run: Mapping[str, Any]) -> Callable[..., Any]:
    """Add ``--json``, ``--quiet`` and the options of :func:`of_run` to a command. Pass interrupts to ``cli.main``."""

    @functools.wraps(function)
    def run(*, as_json: bool = False, quiet: bool = False, **arguments: Any) -> Any:
        say.as_json, say.quiet = as_json, quiet
        for option, value in arguments.items():
            for number in value if isinstance(value, (list, tuple)) else (value,):
                # refuse nan here: click accepts it, because nan is neither below a minimum nor above a maximum
                if isinstance(number, float) and not math.isfinite(number):
                    raise UsageError(f"--{option.replace('_', '-')} {number}", expected="a finite number")
        if of_run:
            values = {name: arguments.pop(name) for name in of_run}
            arguments["options"] = RunOptions(progress=say, **values)
        try:
            return function(**arguments)
        except NotRun as ended:
            print_plan(ended.plan)
            return 0
        except KeyboardInterrupt as error:
            raise Interrupted(error) from None  # typer would turn a KeyboardInterrupt into a silent exit code

    # resolve annotations, which are texts, here, because typer would evaluate them in its own module
    hints = {name: _bare(hint) for name, hint in get_type_hints(function, include_extras=True).items()}
    added = {**of_run, "as_json": Json, "quiet": Quiet}
    hints |= added
    kind = inspect.Parameter.KEYWORD_ONLY
    parameters = [
        *(parameter for name, parameter in inspect.signature(function).parameters.items() if name != "options"),
        *(inspect.Parameter(name, kind, default=getattr(DEFAULT, name, False)) for name in added),
    ]
    typed = [parameter.replace(kind=kind, annotation=hints[parameter.name]) for parameter in parameters]
    run.__signature__ = inspect.Signature(typed)  # type: ignore[attr-defined]  # typer reads the options here
    run.__annotations__ = hints
    return run

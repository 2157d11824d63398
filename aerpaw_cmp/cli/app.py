"""The command line itself and what its commands have in common.

A command is a function in a module of this package::

    @command("diff", examples=["aerpaw-cmp diff reports/a reports/b"])
    def diff(first: Annotated[Path, typer.Argument(help="...")], as_json: Json = False) -> int:
        from ..jobs.diff import run_diff  # here, so that help and completion load nothing

and a line of :mod:`aerpaw_cmp.common.commands`. What it returns is the exit code; nothing is 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Optional, TypeVar

import typer

from ..common.commands import COMMANDS

_Function = TypeVar("_Function", bound=Callable[..., Any])

_SETTINGS = {"help_option_names": ["-h", "--help"]}
app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings=_SETTINGS,
)
site_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)
app.add_typer(site_app, name="site", help=COMMANDS["site"])

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output and nothing else there.")]
Out = Annotated[Optional[Path], typer.Option("-o", "--out", help="Where the results go.")]  # noqa: UP045  typer on 3.10
Force = Annotated[bool, typer.Option("--force", help="Replace also what this tool did not write; never an input.")]
LogsRoot = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option("--logs-root", help="Folder against which the paths of the logs resolve."),
]


def command(
    name: str, *, of: typer.Typer = app, text: str | None = None, examples: Sequence[str] = ()
) -> Callable[[_Function], _Function]:
    """Register a function as a command.

    Parameters
    ----------
    name : str
    of : typer.Typer
        The program, or a group of commands such as ``site_app``.
    text : str, optional
        One line of help; without it that of :data:`aerpaw_cmp.common.commands.COMMANDS`.
    examples : sequence of str
        Whole command lines, shown below the options.
    """
    epilog = "\b\nExamples:\n" + "\n".join(f"  {line}" for line in examples) if examples else None
    return of.command(name, help=COMMANDS[name] if text is None else text, epilog=epilog)

"""Arguments, exit codes, progress: the only room that prints.

A module per group of commands; :mod:`aerpaw_cmp.cli.app` says how one is added.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import typer

from ..common.errors import UsageError
from .app import Interrupted, app
from .commands import flight, live, logs, machine, planning, reports, site
from .shown import say

# The modules whose commands there are: importing them registers these.
GROUPS = (logs, flight, reports, planning, live, site, machine)


@cache
def _program() -> Any:
    """The commands as click knows them, made once: 50 ms for whoever calls :func:`main` often."""
    return typer.main.get_command(app)


def _refused(error: Any) -> UsageError:
    """The usage error of a wrong option or argument, with the first example of the command."""
    text = str(error.format_message()).replace("Value error, ", "").replace("Input should be ", "expected ")
    command = getattr(getattr(error, "ctx", None), "command", None)
    _, _, examples = (getattr(command, "epilog", None) or "").partition("Examples:\n  ")
    expected = f"a line such as '{examples.partition(chr(10))[0]}'" if examples else None
    return UsageError(text.rstrip("."), expected=expected)


def main(arguments: list[str]) -> int:
    """Run the command line and give its exit code; ``__main__`` turns exceptions into messages."""
    say.quiet = say.as_json = False
    try:
        # click would print errors and exit by itself
        result = _program()(args=arguments, prog_name="aerpaw-cmp", standalone_mode=False)
    except Interrupted as interrupted:
        raise interrupted.error from None
    except typer.Abort as error:
        if isinstance(error.__cause__, EOFError):  # click's word for "no answer to a question"; none is asked here
            raise error.__cause__ from None
        raise KeyboardInterrupt from error
    except Exception as error:
        # typer may vendor click: what counts is the shape of a usage error, not its module
        if hasattr(error, "format_message") and hasattr(error, "exit_code"):
            raise _refused(error) from error
        raise
    finally:
        say.end()
    return result if isinstance(result, int) else 0

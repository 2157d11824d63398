"""The command line: arguments, exit codes and progress. No other subpackage prints.

Each group of commands has a module in :mod:`aerpaw_cmp.cli.commands`. :mod:`aerpaw_cmp.cli.app` describes how to add a
command.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import typer

from ..common.errors import UsageError
from .app import Interrupted, app
from .commands import flight, live, logs, machine, planning, reports, site
from .shown import say

# Importing these modules registers their commands.
GROUPS = (logs, flight, reports, planning, live, site, machine)


@cache
def _program() -> Any:
    """Return the commands as a click program. Cached, because creating it takes 50 ms."""
    return typer.main.get_command(app)


def _refused(error: Any) -> UsageError:
    """Return the UsageError for a wrong option or argument, with the first example of the command."""
    text = str(error.format_message()).replace("Value error, ", "").replace("Input should be ", "expected ")
    command = getattr(getattr(error, "ctx", None), "command", None)
    _, _, examples = (getattr(command, "epilog", None) or "").partition("Examples:\n  ")
    expected = f"a line such as '{examples.partition(chr(10))[0]}'" if examples else None
    return UsageError(text.rstrip("."), expected=expected)


def main(arguments: list[str]) -> int:
    """Run the command line and return its exit code.

    ``__main__`` turns exceptions into messages.
    """
    say.quiet = say.as_json = False
    try:
        # do not use standalone mode, which would print errors and exit
        result = _program()(args=arguments, prog_name="aerpaw-cmp", standalone_mode=False)
    except Interrupted as interrupted:
        raise interrupted.error from None
    except typer.Abort as error:
        if isinstance(error.__cause__, EOFError):  # raised by a command, because no command has a prompt
            raise error.__cause__ from None
        raise KeyboardInterrupt from error
    except Exception as error:
        # test the attributes of a usage error instead of its class, because typer may contain its own copy of click
        if hasattr(error, "format_message") and hasattr(error, "exit_code"):
            raise _refused(error) from error
        raise
    finally:
        say.end()
    return result if isinstance(result, int) else 0

"""Standard streams that are closed, full or gone: none of that is a fault of the program.

The streams of a command note the first error of their descriptor and take no more; :func:`output_fault` says which.
"""

from __future__ import annotations

import io
import os
import sys
from typing import Any


class _Descriptor(io.FileIO):
    """A standard descriptor whose errors are kept for the end."""

    fault: OSError | None = None

    def write(self, data: Any) -> int:
        if self.fault is None:
            try:
                return super().write(data)
            except OSError as error:
                self.fault = error
        # as if all were written: a caller that gets less writes again, for ever
        return memoryview(data).nbytes


def guard() -> None:
    """Put such streams in place of this process's own, not of those that a test or another program put there.

    Descriptors that are closed are filled first: else the first files that a command opens would take their numbers,
    and with them what is printed. Writing to them fails as it does without a descriptor.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        closed = _is_closed(number)
        if closed:
            os.open(os.devnull, os.O_RDONLY)  # the lowest free number: this one
        stream = getattr(sys, name)
        buffer = getattr(stream, "buffer", None)
        raw = getattr(buffer, "raw", buffer)  # the same where PYTHONUNBUFFERED is set
        if number and (closed or stream is None or (type(raw) is io.FileIO and raw.fileno() == number)):
            encoding = getattr(stream, "encoding", None) or "utf-8"
            setattr(sys, name, _stream(number, encoding, buffered=buffer is None or buffer is not raw))


def _is_closed(number: int) -> bool:
    try:
        os.fstat(number)
    except OSError:
        return True
    return False


def _stream(number: int, encoding: str, *, buffered: bool) -> io.TextIOWrapper:
    raw = _Descriptor(number, "w", closefd=False)
    # a name that the terminal cannot show is no reason to fail
    return io.TextIOWrapper(
        io.BufferedWriter(raw) if buffered else raw,  # type: ignore[arg-type]
        encoding=encoding,
        errors="backslashreplace",
        line_buffering=number == 2 or os.isatty(number),
        write_through=not buffered,
    )


def output_fault() -> OSError | None:
    """Bring what was printed out of the process; the error where standard output did not take it."""
    try:
        sys.stdout.flush()
    except OSError as error:
        return error
    # what a test or a notebook put there has no descriptor of ours
    buffer = getattr(sys.stdout, "buffer", None)
    raw = getattr(buffer, "raw", buffer)
    return raw.fault if isinstance(raw, _Descriptor) else None

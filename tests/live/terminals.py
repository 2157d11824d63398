"""Pseudo-terminals that can be closed without a hang-up of other readers, and waiting for their data."""

import os
import time
from collections.abc import Callable
from io import RawIOBase
from pathlib import Path


def held(port: Path) -> RawIOBase:
    """Open the port for reading. It does not become the controlling terminal of a session leader."""
    return open(port, "rb", buffering=0, opener=lambda path, flags: os.open(path, flags | os.O_NOCTTY))


def until(condition: Callable[[], object], limit_s: float = 15.0) -> None:
    """Wait for a condition, and fail the test if it never becomes true."""
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)

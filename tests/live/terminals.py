"""Pseudo-terminals opened so that closing them hangs up nobody, and waiting for what they bring."""

import os
import time
from collections.abc import Callable
from io import RawIOBase
from pathlib import Path


def held(port: Path) -> RawIOBase:
    """The port, open for reading; of a session leader (a suite in a container) it does not become the terminal."""
    return open(port, "rb", buffering=0, opener=lambda path, flags: os.open(path, flags | os.O_NOCTTY))


def until(condition: Callable[[], object], limit_s: float = 15.0) -> None:
    """Wait for a condition; fails the test where it never comes."""
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)

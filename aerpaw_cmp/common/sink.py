"""A stream that HDF5 may write to."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, BinaryIO


class Sink:
    """A stream that never fails towards HDF5, which ends the process where a disk is full.

    The first failure, an interrupt included, is kept for :meth:`raise_spared`; what comes after it is lost.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._failure: BaseException | None = None

    def raise_spared(self) -> None:
        """Raise what HDF5 was spared."""
        if self._failure is not None:
            raise self._failure

    def _spared(self, action: Callable[..., Any], *given: Any, instead: Any = 0) -> Any:
        if self._failure is None:
            try:
                return action(*given)
            # an interrupt, too: HDF5 would be left in the middle of a write
            except BaseException as failure:
                self._failure = failure
        return instead

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a place."""
        return int(self._spared(self._stream.seek, offset, whence))

    def tell(self) -> int:
        """Place in the stream."""
        return int(self._spared(self._stream.tell))

    def write(self, block: Any) -> int:
        """Write a block."""
        return int(self._spared(self._stream.write, block, instead=len(block)))

    def read(self, size: int = -1) -> bytes:
        """Read bytes, zeros after a failure or the end."""
        block = self._spared(self._stream.read, size, instead=b"")
        return bytes(block.ljust(max(size, 0), b"\0"))

    def truncate(self, size: int | None = None) -> int:
        """Cut or lengthen."""
        return int(self._spared(self._stream.truncate, size))

    def flush(self) -> None:
        """Hand all to the system."""
        self._spared(self._stream.flush)

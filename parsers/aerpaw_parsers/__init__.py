"""One module per log format; ``READERS`` is the catalogue that aerpaw-cmp finds by its entry point."""

from __future__ import annotations

from aerpaw_cmp.readers import Reader

READERS: tuple[Reader, ...] = ()

"""Read AERPAW field logs, replay the flight by ray tracing, and compare measured and replayed levels and ranks.

The public names below are stable (docs/api.md). All other names may change. Importing this package is fast, because
each name is imported when it is first used.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.4.0"

# Module of each public name.
_HOME = {
    "Array": "propagation.geometry",
    "BiExponential": "maps.variogram",
    "Comparison": "jobs.notebook",
    "Flight": "jobs.notebook",
    "HalfWaveDipole": "site.antennas",
    "Isotropic": "site.antennas",
    "Link": "propagation.geometry",
    "Logs": "logs.frames",
    "OrdinaryKriging": "maps.kriging",
    "Poses": "propagation.geometry",
    "Replay": "propagation.replay",
    "ReplayedFlight": "jobs.notebook",
    "Site": "site.site",
    "TrendKriging": "maps.kriging",
    "Variogram": "maps.variogram",
    "channel_rank": "compare.rank",
    "grid_offset": "compare.offset",
    "linear_array": "propagation.geometry",
    "load_site": "site.siteyaml",
    "open_flight": "jobs.notebook",
    "read": "logs.frames",
    "single_element": "propagation.geometry",
    "trace": "propagation.replay",
}

# The types are in __init__.pyi.
__all__ = [*_HOME, "__version__"]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return only the public names, because a notebook would otherwise also list the internals of this file."""
    return list(__all__)

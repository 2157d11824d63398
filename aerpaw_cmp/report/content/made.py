"""Instant and programs of the making of a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ...common.versions import commit, utc_now, versions


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """Instant (UTC, ISO 8601), versions and seconds of the stages: what every page and its metrics.json end with."""

    generated: str = field(default_factory=utc_now)
    versions: Mapping[str, str] = field(default_factory=versions)
    stages_s: Mapping[str, float] = field(default_factory=dict)


def about(page: Any) -> dict[str, Any]:
    """The entries of metrics.json on when and how a page was made; ``page`` has the fields of :class:`Made`."""
    return {
        "generated": page.generated,
        "commit": commit(),
        "versions": dict(sorted(page.versions.items())),
        "stages": {f"{name}_s": seconds for name, seconds in page.stages_s.items()},
    }

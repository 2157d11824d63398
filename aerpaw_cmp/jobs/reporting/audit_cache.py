"""Audits that this machine made before, by the content of all that they look at."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...common.content import content_digest
from ...common.files import cache_folder, read_sealed, write_sealed
from ...common.versions import library_versions, utc_now
from ...compare.level.field_difference import FieldAudit
from ...compare.result import AuditResult
from ...flight.data import FlightData
from ...flight.replay import Replayed
from ...propagation.replay import PER_LINK
from ..tasks.outcomes import code_digest

# Stands behind the entry, before its SHA-256.
_SEAL = b"AERPAWAU"

# Keys of flight.yaml that an audit reads.
_SETTINGS = {"rt", "link", "rank", "antennas", "towers"}


def entry_of(data: FlightData, replays: Sequence[Replayed]) -> Path:
    """Place of the audit of these replays: the SHA-256 of libraries, code, site, logs, settings and replays."""
    settings = data.settings.model_dump(mode="json", include=_SETTINGS)
    seen = [
        (r.poses, r.tower_m, *(getattr(r.replay, name) for name in ("towers", "faces", "contributions", *PER_LINK)))
        for r in replays
    ]
    logs = [file.sha256 for file in data.files]
    digest = content_digest(library_versions(), code_digest(), settings, data.site, logs, seen)
    return cache_folder("audits", f"{digest}.json")


def read_audit(entry: Path) -> AuditResult | None:
    """The audit that an entry holds; None where there is none, or where it is damaged."""
    try:
        content = read_sealed(entry, _SEAL)
    except ValueError:
        return None
    if content is None:
        return None
    record = json.loads(content)
    if record["fields"] is not None:
        lists: dict[str, Any] = {name: tuple(x) if isinstance(x, list) else x for name, x in record["fields"].items()}
        record["fields"] = FieldAudit(**lists)
    record["rank_disagreement"] = {float(k): share for k, share in record["rank_disagreement"].items()}
    return AuditResult(**record)


def write_audit(entry: Path, audit: AuditResult) -> None:
    """Write an audit with the day on which it was made."""
    record = dataclasses.asdict(audit) | {"read_from_cache_of": utc_now()[:10]}
    write_sealed(entry, json.dumps(record).encode(), _SEAL)

"""Speed against error on the flight's own poses, for the report; kept on disk, since it costs more than the report.

A row's numbers depend on the machine, the versions, the site, the link and the poses: these make the key.
"""

from __future__ import annotations

import dataclasses
import json
import os
import platform
from contextlib import suppress
from hashlib import sha256
from typing import Any

import numpy as np

from ..common.errors import OutputError
from ..common.files import write_whole
from ..common.stages import Progress, silent
from ..common.versions import versions
from ..flight.data import FlightData
from ..flight.replay import Replayed
from ..machine import llvm
from ..propagation.arrays import Isotropic, Poses
from ..propagation.bench import Row, speed_against_error
from ..report.data import SpeedRow

POSES = 40
"""Evenly spread poses of the flight that the table is made on."""

EXPLICIT_POSES = 10
SAMPLES = (1_000, 10_000, 100_000)


def speed_rows(data: FlightData, replayed: Replayed, progress: Progress = silent) -> tuple[SpeedRow, ...]:
    """Rows of speed against error for one replayed series.

    Sionna's own arrays know isotropic elements only; with other patterns their rows are left out.
    """
    count = len(replayed.poses)
    if count < 2:
        return ()
    chosen = np.unique(np.linspace(0, count - 1, min(POSES, count)).astype(np.int64))
    poses = Poses(replayed.poses.position_m[chosen], np.ascontiguousarray(replayed.poses.rotation[chosen]))
    key = _key(data, replayed, poses)
    kept = _load(key)
    if kept is None:
        progress("speed against error (once per flight and machine)")
        arrays = [*replayed.link.tower_arrays.values(), replayed.link.uav_array]
        plain = all(isinstance(pattern, Isotropic) for array in arrays for pattern in array.patterns)
        rows = speed_against_error(
            data.site,
            replayed.link,
            poses,
            samples=SAMPLES,
            arrays=("synthetic", "explicit", "float64") if plain else ("float64",),
            explicit_poses=EXPLICIT_POSES,
            depth=data.settings.rt.max_depth,
            depths=range(min(data.settings.rt.max_depth + 2, 4)),
            ks=data.settings.rank.k,
        )
        kept = [row.as_dict() for row in rows]
        _save(key, kept)
    return tuple(_as_report(row, data.settings.rt.max_depth) for row in kept)


def _key(data: FlightData, replayed: Replayed, poses: Poses) -> str:
    link = data.settings.link.model_dump_json()
    buildings = [b.footprint.wkt + repr((b.height_m, b.base_m, b.material)) for b in data.site.buildings]
    machine = [platform.node(), platform.processor(), os.cpu_count(), versions()]
    settings = [data.settings.site.model_dump(), link, data.settings.rt.max_depth, list(data.settings.rank.k)]
    content = json.dumps([machine, settings, list(replayed.link.tower_arrays), SAMPLES, buildings])
    return sha256(content.encode() + poses.position_m.tobytes() + poses.rotation.tobytes()).hexdigest()[:32]


def _load(key: str) -> list[dict[str, Any]] | None:
    try:
        kept = json.loads((llvm.cache_folder() / f"speed-{key}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return kept if isinstance(kept, list) else None


def _save(key: str, rows: list[dict[str, Any]]) -> None:
    with suppress(OSError, OutputError):  # a read-only home costs the next report the time, not this one its result
        llvm.cache_folder().mkdir(parents=True, exist_ok=True)
        write_whole(llvm.cache_folder() / f"speed-{key}.json", json.dumps(rows))


def _as_report(row: dict[str, Any], depth: int) -> SpeedRow:
    names = {field.name for field in dataclasses.fields(Row)} & {field.name for field in dataclasses.fields(SpeedRow)}
    values = {name: row[name] for name in names}
    for name in ("rss_max_error_db", "rss_rms_error_db", "peak_mib"):
        values[name] = float("nan") if values.get(name) is None else values[name]
    values["rank_disagreement"] = {float(k): share for k, share in row["rank_disagreement"].items()}
    reference = row["engine"] == "image" and row["depth"] == depth and row["thinning"] == 1
    return SpeedRow(**values, reference=reference)

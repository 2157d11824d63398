"""Every key of flight.yaml changes a result, is refused or is reported."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from pydantic import BaseModel

from aerpaw_cmp.common.errors import AerpawCmpError
from aerpaw_cmp.common.yamlfile import _models_in
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.gains import load_with_learned
from aerpaw_cmp.flight.replay import replay_flight
from aerpaw_cmp.flight.settings import FlightFile
from aerpaw_cmp.jobs.compare_flight import compare_flight

SAMPLE = Path(__file__).parents[2] / "sample_logs"
RANK_LINK = {
    "carrier_hz": 3.4e9, "uav_transmits": False, "bandwidth_hz": 20e6,
    "tower": {"layout": "tower_comparison", "slant_deg": [45, -45, 45, -45]},
    "uav": {"layout": "uav_comparison", "slant_deg": [45, -45, 45, -45]},
}  # fmt: skip
BASE: dict[str, Any] = {
    "flight": {"name": "f"}, "site": {"file": "lake_wheeler"}, "timezone": "America/New_York",
    "logs": [
        {"path": str(SAMPLE / "UAV/2025-06-01_10_00_00_vehicleOut.txt")},
        {"path": str(SAMPLE / "LW3/USRP1_power_log.txt"), "node": "LW3", "channel": "A"},
        {"path": str(SAMPLE / "UAV/modem_ri.csv"), "node": "LW1"},
    ],
    "link": {"rss": {"carrier_hz": 3.3e9}, "rank": RANK_LINK},
    "rt": {"audit_links": 0},
    "rss": {"lag": "off"},
}  # fmt: skip

ARRAY = {
    "layout": "linear", "elements": 3, "positions_m": [[0, 0, 0]], "antenna.model": "dipole", "antenna.file": "x",
    "antenna.variable": "x", "antenna.elevation": "x", "slant_deg": 30.0, "yaw_deg": 30.0, "pitch_deg": 30.0,
    "roll_deg": 30.0,
}  # fmt: skip
LOG = {
    "reader": "generic_csv", "node": "LW9", "channel": "Q", "frequency_hz": 2e9, "unit": "dBm", "floor_db": -50.0,
    "ri_base": "zero", "columns": {"time": "x"}, "kind": "rss", "time_origin": "2024-06-01T10:00:00Z", "clock": "utc",
    "timezone": "America/Chicago", "cells": {5: "LW1"}, "height_m": 30.0, "skip": ["none"], "path": "none.txt",
    "gps_rollovers": 1,
}  # fmt: skip
ENDS = ("uav", "tower", "towers")
# Values that differ from those of BASE, by key; LINE and END stand for one log and one end of a link.
VALUES: dict[str, Any] = {
    **{f"logs.{line}.{key}": value for line in (0, 1) for key, value in LOG.items()},
    **{f"link.rss.{end}.{key}": value for end in (*ENDS[:2], "towers.LW3") for key, value in ARRAY.items()},
    "site.file": "none.yaml", "site.coordinates": "Z", "site.antenna_height_m": 15.0, "site.without_buildings": True,
    "site.tower_ground": "offsets", "towers": {"LW1": {"latitude_deg": 35.7, "longitude_deg": -78.7}},
    "timezone": "America/Chicago", "antennas": {"uav": "lake_wheeler/dataset12_uav"},
    "link.rss.carrier_hz": 3.4e9, "link.rss.transmit_power_dbm": 30.0, "link.rss.bandwidth_hz": 20e12,
    "link.rss.noise_figure_db": 5.0, "link.channels": {"A": {"carrier_hz": 3.4e9}},
    "link.rank.carrier_hz": 3.3e9, "link.rank.transmit_power_dbm": -60.0, "link.rank.bandwidth_hz": 20e12,
    "link.rank.noise_figure_db": 90.0, "link.rank.uav": {"layout": "linear"}, "link.rank.tower": {"layout": "linear"},
    "link.rank.towers": {"LW1": {"layout": "linear"}},
    "rt.max_depth": 0, "rt.diffraction": "edges", "rt.attitude": "logged", "rt.foliage": "attenuating",
    "rt.leaves": "out", "rt.reflection_loss_db": 3.0,
    "rt.advanced.samples": 100, "rt.advanced.gamma_db_per_m": 0.1, "rt.advanced.maximum_loss_db": 3.0,
    "rt.advanced.maximum_gap_s": 0.5,
    "rss.span_db": [-10.0, 10.0], "rss.lag": 1.0, "rss.field": "power", "rss.minimum_height_m": 20.0,
    "rss.advanced.lag_window_s": 3.0,
    "rank.tower": "LW2", "rank.k": [20.0], "rank.minimum_height_m": 20.0, "rank.receiver": "lake_wheeler/dataset12",
}  # fmt: skip
# Keys that change no number of this flight, with the place that they act in.
ELSEWHERE = {
    "flight": "names, notes and the plan of 'simulate': pages and simulated logs",
    "trained_on": "nothing is scored on these logs", "marks": "the same, for copies",
    "link.rss.uav_transmits": "the level is reciprocal: exports of 'channel'",
    "link.rank.uav_transmits": "the rank is reciprocal: exports of 'channel'",
    "rt.engine": "both engines find the same paths here", "rt.audit_links": "the audit",
    "report": "figures", "logs.receiver": "which learned antennas of the site fit",
    **{f"link.rss.{end}.antenna.learned": "what 'calibrate' writes beside a learned file" for end in ENDS},
}  # fmt: skip


def leaves(model: type[BaseModel], above: str = "") -> Iterator[str]:
    """Yield the dotted keys of a model. If several models are possible, the first is used."""
    for name, info in model.model_fields.items():
        inner = _models_in(info.annotation)[:1]
        yield from leaves(inner[0], f"{above}{name}.") if inner else [f"{above}{name}"]


def test_every_key_has_a_value_or_a_reason() -> None:
    """A new key of flight.yaml needs a row above."""
    known = {key.replace(".0.", ".").replace(".1.", ".").replace(".LW3.", ".") for key in VALUES}
    missing = [
        key
        for key in leaves(FlightFile)
        if not any(
            key == k or key.startswith(f"{k}.") or key.startswith("link.channels.") for k in {*known, *ELSEWHERE}
        )
    ]
    assert missing == []


def changed(key: str, value: Any) -> dict[str, Any]:
    """Return BASE with another value at a dotted key."""
    content: Any = copy.deepcopy(BASE)
    *above, name = key.split(".")
    part = content
    for step in above:
        part = part[int(step)] if isinstance(part, list) else part.setdefault(step, {})
    part[name] = value
    return content


def outcome(folder: Path, content: dict[str, Any], *, compared: bool) -> str:
    """Return what a run shows: the message of a refusal, or warnings and a digest of levels, ranks and scores."""
    path = folder / "flight.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    try:
        data = load_data(load_with_learned(path), folder)
        replays = replay_flight(data)
        result = compare_flight(data, replays) if compared else None
    except AerpawCmpError as error:
        return str(error)
    digest = hashlib.sha256(json.dumps(data.warnings).encode())
    for _, series in data.series:
        digest.update(f"{series.tower} {series.channel} {getattr(series, 'unit', '')}".encode() + series.time.tobytes())
    for rss in data.rss:
        digest.update(rss.measured_db.tobytes())
    for replayed in replays.all:
        for values in (replayed.level_dbm(data.settings.rss.field), replayed.replay.h, replayed.poses.rotation):
            digest.update(np.ascontiguousarray(values).tobytes())
    if result is not None:
        digest.update(repr([r.score for r in (*result.rss, *result.rank)]).encode())
    return digest.hexdigest()


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, str]:
    folder = tmp_path_factory.mktemp("base")
    first, again = ({c: outcome(folder, BASE, compared=c) for c in (False, True)} for _ in range(2))
    assert first == again  # else the test below could not fail
    return first


@pytest.mark.parametrize("key", VALUES)
def test_a_key_changes_a_result_or_is_refused_or_reported(key: str, tmp_path: Path, unchanged: dict[bool, str]) -> None:
    compared = key.startswith(("rss.", "rank."))
    assert outcome(tmp_path, changed(key, VALUES[key]), compared=compared) != unchanged[compared]

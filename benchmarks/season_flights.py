"""A season of simulated flights, for benchmarks: flight files, their logs, and a campaign over them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from aerpaw_cmp.jobs.run import run_simulate

TOWERS = ("LW1", "LW2", "LW3", "LW4", "LW5")
SETTINGS: dict[str, dict[str, Any]] = {
    "as written": {},
    "line of sight": {"rt.max_depth": 0},
    "power": {"rss.field": "power"},
}


def flight_settings(name: str, seed: int, towers: tuple[str, ...], samples: int, bootstrap: int) -> dict[str, Any]:
    """One flight.yaml: a random walk around LW1, a channel per tower."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform([-250.0, -100.0, 30.0], [150.0, 260.0, 60.0], (5, 3)).round(1)
    length = float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
    return {
        "flight": {
            "name": name,
            "synthetic": True,
            "plan": {
                "start": f"2025-06-{1 + seed % 28:02d}T10:00:00",
                "seed": seed,
                "speed_mps": 10.0,
                "rss_interval_s": round(length / 10.0 / samples, 3),
                "fading_db": 2.0,
                "fading_correlation_s": 0.5,
                "offsets_db": {tower: {"USRP1": round(float(rng.normal(10.0, 1.0)), 1)} for tower in towers},
                "waypoints": [{"east_m": float(e), "north_m": float(n), "height_m": float(h)} for e, n, h in corners],
            },
        },
        "site": {"file": "lake_wheeler"},
        "timezone": "America/New_York",
        "logs": [
            {"path": f"{name}/vehicle.txt", "reader": "vehicle_out"},
            *(
                {"path": f"{name}/{t}.txt", "reader": "sounder_log", "node": t, "channel": "USRP1"} for t in towers
            ),
        ],
        "rt": {"audit_links": 0, "cache": False},
        "rss": {"bootstrap": bootstrap, "lag": "off"},
    }  # fmt: skip


def write_season(
    folder: Path,
    flights: int,
    *,
    towers: int = 5,
    settings: int = 3,
    samples: int = 300,
    bootstrap: int = 100,
    distinct: int | None = None,
) -> Path:
    """Write flights and campaign.yaml; logs that are there stay.

    Only the first ``distinct`` flights are simulated; the others fly on copies of their logs, under names and with
    offsets of their own.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"flight_{i:03d}" for i in range(flights)]
    for seed, name in enumerate(names):
        file = folder / f"{name}.yaml"
        if file.exists():
            continue
        of = seed % (distinct or flights)
        content = flight_settings(names[of], of, TOWERS[:towers], samples, bootstrap)
        if of == seed:
            file.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
            run_simulate(file)
            continue
        content["flight"]["name"] = name
        content["rss"]["minimum_height_m"] = 1.0 + 0.001 * seed  # another digest
        file.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    campaign = folder / f"campaign_{flights}x{settings}.yaml"
    chosen = dict(list(SETTINGS.items())[:settings])
    content = {"campaign": f"season_{flights}x{settings}", "flights": [f"{n}.yaml" for n in names], "settings": chosen}
    campaign.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return campaign

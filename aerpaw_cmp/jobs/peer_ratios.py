"""How many times faster than a peer, both sides in this one run; ``None`` where the peer is not installed."""

from __future__ import annotations

import io
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

LINES = 20_523
"""Lines of a real channel-sounder flight."""


def median_seconds(action: Callable[[], Any], repeats: int = 5) -> float:
    """Median processor time after one warm-up: other work on the machine does not count."""
    action()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return statistics.median(times)


def ingest_vs_pandas(lines: int = LINES) -> dict[str, Any]:
    """Reading a synthetic power log, against ``pandas.read_csv(engine="c")`` on the same bytes.

    Ours gives UTC times, levels, flags and the account of every line; pandas columns of text and numbers.
    """
    import pandas as pd

    from ..logs.readers import ReadOptions, by_name
    from ..logs.writers import format_power_log

    zone = "America/New_York"
    generator = np.random.default_rng(1)
    times = np.datetime64("2025-03-02T15:00:00", "ns") + np.arange(lines) * np.timedelta64(32_760_000, "ns")
    data = format_power_log(times, generator.normal(-40, 12, lines), zone)
    reader, options = by_name("sounder_log"), ReadOptions(timezone=zone)
    ours = median_seconds(lambda: reader.read(data, options))
    theirs = median_seconds(lambda: pd.read_csv(io.BytesIO(data), engine="c", header=None, sep=r"\s+"))
    return {"ratio": theirs / ours, "seconds_ours": ours, "seconds_pandas": theirs, "lines": lines}


def kriging_vs_pykrige(pairs: int = 150) -> dict[str, Any] | None:
    """Leave-one-out of 2556 positions x 27 fields with 20 neighbours, against PyKrige with the same neighbours.

    PyKrige runs ``pairs`` of the 69 012 systems and its time is scaled per system (the whole takes most of an hour).
    """
    try:
        from pykrige.ok import OrdinaryKriging as Peer
    except ImportError:
        return None
    from ..maps.grid import Grid
    from ..maps.kriging import OrdinaryKriging
    from ..maps.variogram import PAPER_BIEXPONENTIAL

    generator = np.random.default_rng(1)
    grid = Grid.over_area((-540.0, 540.0, -1065.0, 1065.0))
    points = grid.points_m + generator.uniform(-1, 1, (len(grid), 2))  # untied: both sides choose alike
    values = generator.integers(1, 5, (len(grid), 27)).astype(np.float64)
    model = OrdinaryKriging(PAPER_BIEXPONENTIAL, neighbours=20, radius_m=150.0).fit(points, values)
    ours = median_seconds(model.leave_one_out, 3)
    estimate, _ = model.leave_one_out()
    chosen = generator.choice(len(points), pairs, replace=False)
    worst, start = 0.0, time.process_time()
    for target in chosen:
        field = int(target) % 27
        distance = np.hypot(*(points - points[target]).T)
        near = np.argsort(distance)[1:21]
        peer = Peer(
            *points[near].T,
            values[near, field],
            variogram_model="custom",
            variogram_parameters=[0.0],
            variogram_function=lambda _p, d: 1.0 - PAPER_BIEXPONENTIAL(d),
        )
        theirs_value = float(peer.execute("points", *points[target][:, None])[0][0])
        worst = max(worst, abs(theirs_value - float(estimate[target, field])))
    theirs = (time.process_time() - start) * values.size / pairs
    return {
        "ratio": theirs / ours,
        "seconds_ours": ours,
        "seconds_pykrige_scaled": theirs,
        "pairs_run": pairs,
        "largest_difference": worst,
    }

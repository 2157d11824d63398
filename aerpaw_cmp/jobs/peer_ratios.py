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
    """Median processor time after a warm-up (none for a single run): other work on the machine does not count."""
    if repeats > 1:
        action()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return statistics.median(times)


def path_search_ratios(
    poses: int = 1000, samples: tuple[int, ...] = (1_000, 10_000, 100_000, 1_000_000)
) -> dict[str, Any]:
    """Path search of the image engine against PathSolver with ``samples`` (increasing), and at equal error.

    Returns
    -------
    dict
        ``at`` maps samples to the numbers of :func:`~aerpaw_cmp.jobs.bench.path_search`; ``equal_error``
        is the entry of the fewest samples with which PathSolver finds as many of the paths as with the most: more
        samples than that buy it nothing, so a ratio to more of them flatters us.
    """
    from .bench import path_search

    most = path_search(poses, samples[-1])
    at = {samples[-1]: most}
    for count in samples[:-1]:
        at[count] = path_search(poses, count, repeats=3)
        if at[count]["extra_paths"] <= most["extra_paths"]:
            break
    enough = min(n for n, measured in at.items() if measured["extra_paths"] <= most["extra_paths"])
    return {"at": {f"{n:.0e}": measured for n, measured in sorted(at.items())}, "equal_error": at[enough]}


def kriging_shared_weights(fields: int = 27, neighbours: int = 20) -> dict[str, Any] | None:
    """Prediction at 2556 targets with one set of weights for all fields on our side and PyKrige's compiled back end.

    Both have the same neighbours and the same exponential variogram. PyKrige has no several fields: one run is timed,
    which for ``ratio`` counts as many times as there are fields; ``ratio_one_field`` gives us one field, too.
    """
    try:
        from pykrige.ok import OrdinaryKriging as Peer
    except ImportError:
        return None
    from ..maps.grid import Grid
    from ..maps.kriging import OrdinaryKriging

    generator = np.random.default_rng(2)
    grid = Grid.over_area((-540.0, 540.0, -1065.0, 1065.0))
    points = grid.points_m + generator.uniform(-5, 5, (len(grid), 2))
    targets = points + generator.uniform(5, 10, points.shape)
    values = generator.integers(1, 5, (len(grid), fields)).astype(np.float64)

    def correlation(distance: Any) -> Any:
        return 0.9 * np.exp(-3.0 * distance / 900.0)

    def ours(count: int) -> float:
        model = OrdinaryKriging(correlation, neighbours=neighbours, radius_m=np.inf).fit(points, values[:, :count])
        return median_seconds(lambda: model.predict(targets), 3)

    def peer() -> Any:
        model = Peer(*points.T, values[:, 0], "exponential", {"psill": 0.9, "range": 900.0, "nugget": 0.1})
        return model.execute("points", *targets.T, backend="C", n_closest_points=neighbours)

    theirs, one, every = median_seconds(peer, 3), ours(1), ours(fields)
    return {
        "ratio": fields * theirs / every,
        "ratio_one_field": theirs / one,
        "seconds_pykrige_one_field": theirs,
        "seconds_ours_one_field": one,
        "seconds_ours_all_fields": every,
        "fields": fields,
    }


def ingest_at_sizes(sizes: tuple[int, ...] = (LINES, 1_000_000, 5_000_000)) -> dict[int, dict[str, Any]]:
    """:func:`ingest_vs_pandas` for logs of several sizes: a flight, a day, a week."""
    return {lines: ingest_vs_pandas(lines, 5 if lines < 100_000 else 1) for lines in sizes}


def ingest_vs_pandas(lines: int = LINES, repeats: int = 5) -> dict[str, Any]:
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
    ours = median_seconds(lambda: reader.read(data, options), repeats)
    theirs = median_seconds(lambda: pd.read_csv(io.BytesIO(data), engine="c", header=None, sep=r"\s+"), repeats)
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

"""Results of a season that was never flown: the records of a campaign, and of a map, made up in numbers.

Nothing is replayed. What is put in is known (offsets that drift, settings that differ, a hill of residuals), so that a
page made from it can be checked against it; the size is a season's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from aerpaw_cmp.jobs.season import with_season
from aerpaw_cmp.report.campaign_data import CampaignData, Failure, FlownTrack, RssRow
from aerpaw_cmp.report.data import Baseline, ReportData, RssPanel, Track
from aerpaw_cmp.site.siteyaml import load_site

DRIFT_DB_PER_30_DAYS = 0.4
HILL_DB = 3.0
SAMPLES = 120


def setting_error_db(number: int) -> float:
    """Noise of a setting [dB]: the third is the best, each further one a little worse."""
    return 3.0 + 0.15 * abs(number - 2)


def season(flights: int = 200, settings: int = 20, towers: int = 5, channels: int = 2, seed: int = 0) -> CampaignData:
    """A season at Lake Wheeler: one flight a day or two, every tower and channel in each, some tasks failed.

    Every flight has one true offset per link: a constant, a drift over the dates, and noise of 0.5 dB; residuals are
    noise of :func:`setting_error_db` and a hill of 3 dB around (200 m, 300 m).
    """
    rng = np.random.default_rng(seed)
    site = load_site("lake_wheeler")
    names, labels = [f"flight_{i:03d}" for i in range(flights)], [f"setting {i:02d}" for i in range(settings)]
    rows: list[RssRow] = []
    failures, tracks = [], []
    some = flights // 10 + 1
    broken = set(zip(rng.integers(0, flights, some).tolist(), rng.integers(0, settings, some).tolist(), strict=True))
    for f, name in enumerate(names):
        start = int(np.datetime64("2025-03-01T14:00:00", "ns").astype(np.int64)) + f * int(86_400e9)
        turn = np.linspace(0, 2 * np.pi * (1 + f % 3), SAMPLES) + rng.uniform(0, 6)
        reach = 250 + 150 * rng.random()
        position = np.column_stack([100 + reach * np.cos(turn), 150 + reach * np.sin(turn), np.full(SAMPLES, 40.0)])
        hill = HILL_DB * np.exp(-((position[:, 0] - 200) ** 2 + (position[:, 1] - 300) ** 2) / 2 / 120**2)
        tracks.append(FlownTrack(flight=name, time_s=np.arange(SAMPLES) * 5.0, position_m=position))
        drift = -20 + DRIFT_DB_PER_30_DAYS * f / 30
        links = {
            (tower, f"USRP{channel + 1}"): drift + 2 * channel + rng.normal(0, 0.5)
            for tower in list(site.towers)[:towers]
            for channel in range(channels)
        }
        for s, label in enumerate(labels):
            if (f, s) in broken:
                failures.append(Failure(flight=name, setting=label, message="rss: 3 samples (expected at least 10)"))
                continue
            for (tower, channel), offset in links.items():
                level = -70 - 10 * rng.random(SAMPLES)
                noise = rng.normal(0, setting_error_db(s) * (1 + f % 7 / 10), SAMPLES)
                measured, kept = level - offset + noise + hill, s == 0
                rows.append(_row((name, label, tower, channel), start, level, measured, position, kept))
    data = CampaignData(
        name="season", title=f"A season that was never flown: {flights} flights, {settings} settings",
        generated="2026-11-21T00:00:00+00:00", versions={"numpy": np.__version__}, calibration="channel",
        flights=tuple(names), settings={label: {"rt.max_depth": i % 4} for i, label in enumerate(labels)},
        rss=tuple(rows), failures=tuple(failures), tracks=tuple(tracks), site=site, synthetic=(),
    )  # fmt: skip
    return with_season(data, {name: f"../{name}/report.html" for name in names[:3]})


def _row(
    of: tuple[str, str, str, str], start: int, simulated: Any, measured: Any, position: Any, reference: bool
) -> RssRow:
    flight, setting, tower, channel = of
    mean = float((simulated - measured).mean())
    offset = round(mean, 1)
    residual = measured + offset - simulated
    empty: Any = np.zeros(0)
    return RssRow(
        flight=flight, setting=setting, tower=tower, channel=channel, unit="dBm", offset_db=offset,
        rmse_db=float(np.sqrt((residual**2).mean())), correlation=float(np.corrcoef(measured, simulated)[0, 1]),
        n=len(measured), n_out_of_coverage=0, at_search_edge=False, rmse_ci95_db=None, offset_ci95_db=None,
        correlation_ci95=None, n_effective=float(len(measured)), lag_s=0.0, lag_verdict="", fitted=("offset_db",),
        baselines={"free_space": 7.0}, step_db=0.1, span_db=(-50.0, 50.0),
        time_s=np.arange(len(measured)) * 5.0 if reference else empty, measured_db=measured, simulated_dbm=simulated,
        position_m=position if reference else np.zeros((0, 3)),
        distance_m=np.hypot(*position[:, :2].T) if reference else empty,
        start_ns=start,
    )  # fmt: skip


def long_flight(samples: int = 50_000, channels: int = 10) -> ReportData:
    """A report of ten channels with so many samples together: levels of free space, noise, and nothing else."""
    rng = np.random.default_rng(2)
    site = load_site("lake_wheeler")
    n = samples // channels
    seconds = np.arange(n) * 0.1
    time = np.datetime64("2025-03-01T14:00:00", "ns") + (seconds * 1e9).astype("timedelta64[ns]")
    turn = seconds / 40.0
    east, north, up = 300 * np.cos(turn), 300 * np.sin(turn), 40 + 10 * np.sin(turn / 7)
    towers = list(site.towers.values())
    panels = []
    for number in range(channels):
        tower = towers[number % len(towers)]
        distance = np.sqrt((east - tower.east_m) ** 2 + (north - tower.north_m) ** 2 + up**2)
        level = -30 - 20 * np.log10(distance)
        measured = level + 10.0 + rng.normal(0, 4, n)
        residual = measured - 10.0 - level
        panels.append(
            RssPanel(
                tower=tower.name, channel=f"USRP{number // len(towers) + 1}", unit="dBm", time=time,
                measured_db=measured, simulated_dbm=level, measured_out_of_coverage=np.zeros(n, bool),
                simulated_out_of_coverage=np.zeros(n, bool), offset_db=-10.0,
                rmse_db=float(np.sqrt((residual**2).mean())), correlation=0.5, n=n, n_out_of_coverage=0,
                east_m=east, north_m=north, up_m=up, geometry={"distance_m": distance},
                baselines=(Baseline(name="free_space", level_dbm=level - 1, offset_db=-11.0, rmse_db=4.0),),
            )
        )  # fmt: skip
    track = Track(time=time, east_m=east, north_m=north, up_m=up)
    return ReportData(
        title="A flight that was never flown", flight="long", site=site, generated="2026-11-21T00:00:00+00:00",
        rss=tuple(panels), track=track, synthetic=True,
    )  # fmt: skip

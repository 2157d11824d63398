"""Invented results of a campaign and of a flight, without any replay.

The input is known (offsets that drift, settings that differ, an area with larger residuals), so a page can be checked
against it. The size is that of a long measurement campaign.
"""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.compare.level import compare_rss, error_spans
from aerpaw_cmp.compare.rank import channel_rank, commonest_rank, compare_rank, singular_values
from aerpaw_cmp.compare.result import ModelLevel, RankFurther, RankResult, RssFurther, RssResult
from aerpaw_cmp.compare.verdict import flight_verdict
from aerpaw_cmp.jobs.campaign import with_season
from aerpaw_cmp.report.campaign import CampaignData, Failure, RssRow
from aerpaw_cmp.report.flight_data import DrawnTrack, ReportData
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
    failures = []
    some = flights // 10 + 1
    broken = set(zip(rng.integers(0, flights, some).tolist(), rng.integers(0, settings, some).tolist(), strict=True))
    for f, name in enumerate(names):
        start = int(np.datetime64("2025-03-01T14:00:00", "ns").astype(np.int64)) + f * int(86_400e9)
        turn = np.linspace(0, 2 * np.pi * (1 + f % 3), SAMPLES) + rng.uniform(0, 6)
        reach = 250 + 150 * rng.random()
        position = np.column_stack([100 + reach * np.cos(turn), 150 + reach * np.sin(turn), np.full(SAMPLES, 40.0)])
        hill = HILL_DB * np.exp(-((position[:, 0] - 200) ** 2 + (position[:, 1] - 300) ** 2) / 2 / 120**2)
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
                measured, with_samples = level - offset + noise + hill, s == 0
                rows.append(_row((name, label, tower, channel), start, level, measured, position, with_samples))
    data = CampaignData(
        name="season", title=f"A season that was never flown: {flights} flights, {settings} settings",
        generated="2026-11-21T00:00:00+00:00", versions={"numpy": np.__version__},
        flights=tuple(names), settings={label: {"rt.max_depth": i % 4} for i, label in enumerate(labels)},
        rss=tuple(rows), failures=tuple(failures), site=site, synthetic=(),
    )  # fmt: skip
    return with_season(data, {name: f"../{name}/report.html" for name in names[:3]})


def _row(
    of: tuple[str, str, str, str], start: int, simulated: Any, measured: Any, position: Any, reference: bool
) -> RssRow:
    flight, setting, tower, channel = of
    mean = float((simulated - measured).mean())
    offset = round(mean, 1)
    residual = measured + offset - simulated
    return RssRow(
        flight=flight, setting=setting, tower=tower, channel=channel, unit="dBm", offset_db=offset,
        rmse_db=float(np.sqrt((residual**2).mean())), correlation=float(np.corrcoef(measured, simulated)[0, 1]),
        n=len(measured), n_out_of_coverage=0, at_search_edge=False, rmse_ci95_db=None, offset_ci95_db=None,
        correlation_ci95=None, n_effective=float(len(measured)), lag_s=0.0, lag_verdict="", fitted=("offset_db",),
        baselines={"free_space": 7.0}, span_db=(-50.0, 50.0),
        measured_db=measured, simulated_dbm=simulated,
        position_m=position if reference else np.zeros((0, 3)),
        start_ns=start,
    )  # fmt: skip


def rss_result(
    tower: str, channel: str, time: Any, position_m: FloatArray, levels: Mapping[str, FloatArray], **more: Any
) -> RssResult:
    """Compare the levels ``measured`` and ``simulated`` (n,), with the other levels as baselines.

    Parameters
    ----------
    tower, channel : str
    time : (n,) datetime64[ns]
    position_m : (n, 3)
    levels : mapping of str to (n,)
    more
        Further fields of the record.

    Returns
    -------
    RssResult
    """
    baselines = {name: level for name, level in levels.items() if name not in ("measured", "simulated")}
    measured, simulated = levels["measured"], levels["simulated"]
    score = compare_rss(time, measured, simulated, baselines=baselines)
    further = RssFurther(
        n_measured_out=score.n_measured_out, n_simulated_out=score.n_simulated_out,
        n_too_low=0, n_no_pose=0, n_outliers=0, rmse_without_outliers_db=score.rmse_db, n_flagged={}, clock=None,
        baseline_rmse_ci95_db=score.baseline_intervals, compared_with={}, averaged={},
    )  # fmt: skip
    given: dict[str, Any] = {
        "unit": "dB re full scale", "posed": np.ones(len(time), bool), "line_of_sight": np.ones(len(time)),
        "geometry": {}, "further": further,
        "spans": tuple(error_spans(time, score.residual_db, position_m=position_m, largest=1)),
    }  # fmt: skip
    return RssResult(
        tower=tower, channel=channel, time=time, measured_db=measured, simulated_dbm=simulated, position_m=position_m,
        score=score,
        baselines={
            name: ModelLevel(level_dbm=level, offset_db=score.baselines[name].offset_db,
                             rmse_db=score.baselines[name].rmse_db, rmse_ci95_db=score.baseline_intervals[name])
            for name, level in baselines.items()
        },
        **(given | more),
    )  # fmt: skip


def rank_result(tower: str, time: Any, position_m: FloatArray, measured: FloatArray, h: Any, **more: Any) -> RankResult:
    """Comparison of reported ranks (n,) with channels ``h`` (n, n_rx, n_tx), for K of 10, 100 and 1000.

    Parameters
    ----------
    tower : str
    time : (n,) datetime64[ns]
    position_m : (n, 3)
    measured : (n,)
    h : (n, n_rx, n_tx)
    more
        Further fields of the record.

    Returns
    -------
    RankResult
    """
    seconds = (time - time[:1]) / np.timedelta64(1, "s")
    score = compare_rank(measured, h, time_s=seconds)
    further = RankFurther(
        n_flagged={}, kappa_ci95={f"{k:g}": fit.kappa_ci95 for k, fit in score.simulated.items()},
        commonest=commonest_rank(measured), repeat={},
    )  # fmt: skip
    given: dict[str, Any] = {"sinr_db": None, "level_dbm": np.full(len(time), -80.25)}
    return RankResult(
        tower=tower, n_samples=len(time), time=time, position_m=position_m, measured=measured, sigma=singular_values(h),
        rank={k: channel_rank(h, k) for k in score.simulated}, score=score, further=further, **(given | more),
    )  # fmt: skip


def with_numbers(result: Any, **values: Any) -> Any:
    """A result with other values of its fields, or of those of its score and of its further numbers, by name."""
    own = {field.name: values.pop(field.name) for field in fields(result) if field.name in values}
    for name in ("score", "further"):
        part = own.get(name, getattr(result, name))
        own[name] = replace(
            part, **{field.name: values.pop(field.name) for field in fields(part) if field.name in values}
        )
    return replace(result, **own, **values)


def long_flight(samples: int = 50_000, channels: int = 10) -> ReportData:
    """Return a report of ten channels with this total number of samples: free space and noise."""
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
        levels = {"measured": measured, "simulated": level, "free_space": level - 1}
        place = np.column_stack([east, north, up])
        channel_name = f"USRP{number // len(towers) + 1}"
        panels.append(
            rss_result(tower.name, channel_name, time, place, levels, unit="dBm", geometry={"distance_m": distance})
        )
    track = DrawnTrack(time=time, position_m=np.column_stack([east, north, up]))
    return ReportData(
        title="A flight that was never flown", flight="long", site=site, generated="2026-11-21T00:00:00+00:00",
        rss=tuple(panels), verdict=flight_verdict(panels), track=track, synthetic=True,
    )  # fmt: skip

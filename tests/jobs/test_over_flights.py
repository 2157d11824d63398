"""What is said of several flights: which pairs are searched, and what a campaign holds in memory."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.jobs.campaigns.campaign_plan import Outcomes
from aerpaw_cmp.jobs.campaigns.campaign_tasks import Outcome, Task
from aerpaw_cmp.jobs.campaigns.over_flights import pool_offsets
from aerpaw_cmp.report.content.campaign import FlownTrack, RssRow


def rows(flights: int = 6, links: int = 2, samples: int = 120) -> list[RssRow]:
    rng = np.random.default_rng(0)
    share = np.linspace(0.0, 1.0, samples)
    out = []
    for flight in range(flights):
        place = np.column_stack([share * 200.0, 5.0 * np.sin(9.0 * share), np.full(samples, 30.0)])
        place = place + rng.normal(0.0, 0.7, place.shape)
        for link in range(links):
            simulated = -60.0 - 0.05 * place[:, 0]
            out.append(
                RssRow(
                    flight=f"f{flight}", setting="s", tower="LW1", channel=f"USRP{link}", unit="dBm", offset_db=0.0,
                    rmse_db=2.0, correlation=1.0, n=samples, n_out_of_coverage=0, at_search_edge=False,
                    rmse_ci95_db=None, offset_ci95_db=None, correlation_ci95=None, n_effective=1.0, lag_s=0.0,
                    lag_verdict="", fitted=(), baselines={}, span_db=(-50.0, 50.0),
                    distance_m=np.zeros(samples), position_m=place, simulated_dbm=simulated,
                    measured_db=np.where(rng.random(samples) < 0.1, np.nan, simulated + rng.normal(0, 2, samples)),
                    heading_deg=None if flight == 2 else rng.normal(90.0, 5.0, samples),
                )
            )  # fmt: skip
    return out


def test_many_settings_are_held_in_the_memory_of_one() -> None:
    """Series of samples stay for the first setting; shared offsets of the others come from their moments."""
    rng, settings = np.random.default_rng(3), [f"s{i}" for i in range(40)]
    tasks = [Task(Path("f.yaml"), "f", name, {}, None, reference=name == "s0") for name in settings]
    outcomes, every = Outcomes(tasks), []
    for number, name in enumerate(settings):
        row = dataclasses.replace(
            rows(1, 1, 5000)[0],
            flight="f",
            setting=name,
            measured_db=rng.normal(-60, 3, 5000),
            simulated_dbm=rng.normal(-58, 3, 5000),
        )
        row.simulated_dbm[::7] = np.nan
        track = FlownTrack(flight="f", time_s=np.arange(5000.0), position_m=np.full((5000, 3), np.nan))
        outcomes.put(number, Outcome(rss=(row,), track=track))
        every.append(row)
    held = [outcomes[number] for number in range(40)]
    arrays = {
        id(value): value.nbytes
        for outcome in held
        for record in (*outcome.rss, outcome.track)
        for value in (getattr(record, field.name) for field in dataclasses.fields(record))  # type: ignore[arg-type]
        if isinstance(value, np.ndarray)
    }
    assert sum(arrays.values()) < 16 * 8 * 5000  # of one setting: at most sixteen numbers a sample
    done, groups = pool_offsets([outcome.rss[0] for outcome in held], "tower")
    pooled, same = pool_offsets(every, "tower")
    for a, b in zip(done, pooled, strict=True):
        assert (a.pooled_offset_db, a.pooled_rmse_db) == (b.pooled_offset_db, b.pooled_rmse_db)
        difference = b.simulated_dbm - b.measured_db
        assert a.pooled_rmse_db == pytest.approx(np.sqrt(np.nanmean((difference - a.pooled_offset_db) ** 2)), rel=1e-12)
    assert repr(groups) == repr(same)

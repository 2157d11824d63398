"""What is held of several flights in memory, and that shared offsets need no more."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.jobs.campaigns.campaign import pool_offsets
from aerpaw_cmp.jobs.campaigns.campaign_tasks import Outcome, Task, fitted_to
from tests.jobs.campaign_rows import rss_row


def test_many_settings_are_held_in_the_memory_of_one() -> None:
    """Series of samples stay for the first setting; shared offsets of the others come from their moments."""
    rng, n = np.random.default_rng(3), 5000
    every, held = [], []
    for number in range(40):
        simulated = np.where(np.arange(n) % 7, rng.normal(-58, 3, n), np.nan)
        row = rss_row("f", "USRP0", rng.normal(-60, 3, n), simulated, heading_deg=rng.normal(90.0, 5.0, n))
        every.append(dataclasses.replace(row, setting=f"s{number}"))
        task = Task(Path("f.yaml"), "f", f"s{number}", {}, None, reference=number == 0)
        held.append(fitted_to(task, Outcome(rss=(row,))).rss[0])
    values = [getattr(row, field.name) for row in held for field in dataclasses.fields(row)]
    arrays = {id(value): value.nbytes for value in values if isinstance(value, np.ndarray)}
    assert sum(arrays.values()) < 16 * 8 * n  # of one setting: at most sixteen numbers a sample
    done, groups = pool_offsets(held, "tower")
    pooled, same = pool_offsets(every, "tower")
    for a, b in zip(done, pooled, strict=True):
        assert (a.pooled_offset_db, a.pooled_rmse_db) == (b.pooled_offset_db, b.pooled_rmse_db)
        difference = b.simulated_dbm - b.measured_db
        assert a.pooled_rmse_db == pytest.approx(np.sqrt(np.nanmean((difference - a.pooled_offset_db) ** 2)), rel=1e-12)
    assert repr(groups) == repr(same)

"""An audit of the same inputs is read from this machine's cache, and repeated if an input differs."""

import dataclasses

import numpy as np
import pytest
import shapely

from aerpaw_cmp.common import versions
from aerpaw_cmp.common.files import cache_folder
from aerpaw_cmp.compare.level import FieldAudit
from aerpaw_cmp.compare.result import AuditResult
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.replay import replay_flight
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs import audit_flight
from aerpaw_cmp.report.flight_words import audit_summary
from aerpaw_cmp.site.site import Building
from tests.simulated import write_yaml
from tests.tables import eastwards, rss_log

FIELDS = FieldAudit(paths=3, phase_max_rad=0.1, failures=("a wall",), not_covered=("rain",))
MADE = AuditResult(
    reference="sionna", links=4, missing_paths=0, extra_paths=1, rss_max_error_db=0.25, seconds=1.0, reference_seconds=2.0,
    rank_disagreement={10.0: 0.5}, fields=FIELDS,
)  # fmt: skip


@pytest.fixture
def flight(tmp_path, monkeypatch):
    """Loaded flight with a hall, and a function that audits it: True where the audit was made, not read."""
    t = np.arange(0.0, 21.0)
    path = write_yaml(tmp_path / "flight.yaml", {
        "flight": "short", "site": "lake_wheeler", "rss": {"lag": "off"}, "rt": {"max_depth": 1, "audit_links": 4},
        "logs": [eastwards(tmp_path, t, 5.0 * t), rss_log(tmp_path, "A", t, -60.0 - t / 9.0)],
    })  # fmt: skip
    monkeypatch.setenv("AERPAW_CMP_CACHE", str(tmp_path / "cache"))
    calls = []
    monkeypatch.setattr(audit_flight, "_audit", lambda *_: calls.append(1) or MADE)

    def made(data, replays=None, fresh=False):
        calls.clear()
        audit_flight.audit_replays(data, replays or replay_flight(data).all, fresh=fresh)
        return bool(calls)

    return load_data(load_flight(path), tmp_path), made


def test_the_second_audit_of_the_same_is_read_and_says_its_day(flight):
    data, made = flight
    assert made(data)
    assert not made(data)
    assert made(data, fresh=True)
    again = audit_flight.audit_replays(data, replay_flight(data).all, fresh=False).audit
    assert dataclasses.replace(again, read_from_cache_of="") == MADE
    assert f"Read from the cache of {again.read_from_cache_of}" in audit_summary(again)
    assert "cache" not in audit_summary(MADE)


def test_a_commit_that_changes_no_code_audits_nothing_anew(flight, monkeypatch):
    data, made = flight
    assert made(data)
    monkeypatch.setattr(versions, "commit", lambda: "abc1234.dirty")
    assert not made(data)
    monkeypatch.setattr(versions, "version", lambda name: f"{name} of tomorrow")
    assert made(data), "another library"


def test_a_changed_input_audits_anew(flight):
    data, made = flight
    assert made(data)
    hall = Building("hall", shapely.box(900, 900, 910, 910), 6.0)  # out of every path's way
    with_hall = dataclasses.replace(data, site=dataclasses.replace(data.site, buildings=(*data.site.buildings, hall)))
    assert made(with_hall)
    higher = dataclasses.replace(hall, height_m=6.1)
    assert made(
        dataclasses.replace(data, site=dataclasses.replace(data.site, buildings=(*data.site.buildings, higher)))
    )
    rt = data.settings.rt.model_copy(update={"audit_links": 5})
    assert made(dataclasses.replace(data, settings=data.settings.model_copy(update={"rt": rt})))
    (replayed,) = replay_flight(data).all
    h = replayed.replay.h.copy()
    h[0] *= 1.0 + 1e-12
    assert made(data, [dataclasses.replace(replayed, replay=dataclasses.replace(replayed.replay, h=h))])
    assert not made(data)


def test_a_damaged_entry_is_made_anew(flight):
    data, made = flight
    assert made(data)
    (entry,) = cache_folder("audits").iterdir()
    entry.write_bytes(entry.read_bytes().replace(b"sionna", b"sionNa"))
    assert made(data)
    assert not made(data)

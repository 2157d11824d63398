"""Real flights recomputed from the bytes of their logs, by code that shares nothing with the package's readers."""

from pathlib import Path

import pytest

from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.replay import replay_flight
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs.audit_flight import expectations
from tests.raw_checks import raw_checked
from tests.real_logs import REAL

pytestmark = pytest.mark.field
FLIGHTS = sorted(Path(__file__).parent.glob("*.yaml"))


@pytest.mark.parametrize("path", FLIGHTS, ids=lambda path: path.stem)
def test_times_levels_and_positions_are_those_of_the_bytes(path: Path) -> None:
    data = load_data(load_flight(path), REAL)
    replays = replay_flight(data).all
    audit = raw_checked(data, replays, expectations(data, replays))
    assert audit.failures == []
    assert sum(audit.count.get(kind, 0) for kind in ("measured level", "rotation")) > 40 or "nr_rank" in path.stem


def test_there_are_flights() -> None:
    assert len(FLIGHTS) == 5

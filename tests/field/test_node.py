"""The surveyed rover of real flights, by their levels alone."""

import numpy as np
import pytest

from aerpaw_cmp.compare.locate import NodeEstimate, locate
from aerpaw_cmp.flight.drafting import proposals
from aerpaw_cmp.flight.drafting.proposals import ListedPlace, NodeFinder, listed_places
from aerpaw_cmp.flight.rows import LOCK_FLOOR_DB
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.site.siteyaml import load_site
from tests.real_logs import REAL

pytestmark = pytest.mark.field
FLIGHTS = ("sounder/*_288_loc_1.mat", "afar/*_300_loc_1.mat", "afar/*_300_loc_2.mat", "afar/*_309_loc_2.mat",
           "afar/*_328_loc_1.mat", "afar/*_328_loc_3.mat")  # fmt: skip


def test_the_rover_is_found_within_its_region(monkeypatch: pytest.MonkeyPatch) -> None:
    estimates: list[NodeEstimate] = []
    monkeypatch.setattr(proposals, "locate", lambda *track: estimates.append(locate(*track)) or estimates[-1])
    site = load_site("lake_wheeler")
    listed = listed_places([REAL / "sounder"])
    assert [place.line for place in listed[:3]] == [1, 2, 3]
    errors, inside, right = [], 0, 0
    for name in FLIGHTS:
        (path,) = REAL.glob(name)
        (file,) = ingest([path], options=ReadOptions(timezone="America/New_York"))
        vehicle, power = (next(s for s in file.result.streams if s.name == n) for n in ("vehicle", "power"))
        finder = NodeFinder(site, vehicle, listed[:3])
        track = finder.levels(power, LOCK_FLOOR_DB)
        rover: ListedPlace = listed[int(path.stem[-1]) - 1]
        east, north = site.frame.to_local(np.array([rover.latitude_deg]), np.array([rover.longitude_deg]))
        proposal = finder.propose(track)
        estimate = estimates[-1]
        errors.append(float(np.hypot(estimate.place_m[0] - east[0], estimate.place_m[1] - north[0])))
        regions = estimate.regions
        cell = np.abs(regions.east_m - east[0]).argmin(), np.abs(regions.north_m - north[0]).argmin()
        inside += regions.likelier()[cell] < 0.9
        assert proposal is not None
        assert f"line {rover.line}" in proposal.question
        right += f"line {rover.line} of" in proposal.question
    assert sum(error <= 50.0 for error in errors) >= 5, errors
    assert inside == 6
    assert right >= 5  # the sixth is said to be line 2 or line 3
    proposal = NodeFinder(site, vehicle).propose(track)
    assert proposal is not None
    assert proposal.node == "NODE"  # and no tower

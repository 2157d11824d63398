"""Heights of real flights, of which only a part was logged."""

from dataclasses import replace

import pytest

from aerpaw_cmp.flight.cross_checks import check_heights
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.site.siteyaml import load_site
from tests.real_logs import REAL

pytestmark = pytest.mark.field


@pytest.mark.parametrize(("name", "height_m"), [("dataset12/70m_fs20MHz.mat", 70), ("lte/plotdata4.mat", 90)])
def test_the_middle_third_of_a_flight_is_accepted_with_a_question(name: str, height_m: int) -> None:
    """Its lowest height is within 50 m of Lake Wheeler's ground above the sea, but it neither rests nor takes off."""
    (file,) = ingest([REAL / name], options=ReadOptions(timezone="America/New_York"))
    (vehicle,) = (stream for stream in file.result.streams if stream.kind == "telemetry")
    third = len(vehicle.frame) // 3
    aloft = replace(vehicle, frame=vehicle.frame.iloc[third : 2 * third])
    (clause,) = check_heights(load_site("lake_wheeler"), name, aloft)
    assert f"the lowest height above take-off is {height_m} m" in clause
    assert not check_heights(load_site("lake_wheeler"), name, vehicle)

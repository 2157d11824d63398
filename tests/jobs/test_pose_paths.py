"""Paths that the report's 3-D view draws."""

from types import SimpleNamespace

import numpy as np
import pytest
from shapely.geometry import box

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.propagation.edges import over_edges
from aerpaw_cmp.propagation.geometry import Link, Poses, single_element
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.report.flight_data import FURTHER, SHORTEST, pose_paths
from aerpaw_cmp.site.site import Building, Site, Tower


@pytest.mark.parametrize("asked", [{}, {"further": (over_edges,)}])
def test_bent_paths_are_drawn_from_tower_to_uav_where_they_were_asked_for(asked: dict[str, object]) -> None:
    house = Building("house", box(40.0, -10.0, 60.0, 10.0), 12.0, material="brick")
    site = Site("s", SiteFrame(35.7, -78.7), {"T": Tower("T", 35.7, -78.7, 0.0, 0.0)}, buildings=(house,))
    link = Link(3.4e9, {"T": single_element()}, single_element())
    poses = Poses(np.array([[100.0, 14.0, 5.0], [100.0, 20.0, 40.0]]), np.tile(np.eye(3), (2, 1, 1)))
    replayed = SimpleNamespace(
        replay=replay(site, link, poses, Search(**asked)), poses=poses, valid=np.ones(2, dtype=bool),
        source_m=lambda _: np.array([0.0, 0.0, 10.0]),
    )  # fmt: skip
    series = SimpleNamespace(tower="T", time=np.arange(2).astype("datetime64[s]"))
    data, replays = SimpleNamespace(site=site, series=[("RSS", series)]), SimpleNamespace(all=[replayed])
    (paths,) = pose_paths(data, replays)  # type: ignore[arg-type]
    kinds = [[kind for _, kind in lines] for lines in paths.lines]
    behind = set(kinds[0])
    if not asked:
        assert behind <= {0, 1, 2}
        return
    assert 0 < kinds[0].count(FURTHER) <= SHORTEST
    for lines, place in zip(paths.lines, poses.position_m, strict=True):
        for line, _ in lines:
            assert np.isfinite(line).all()
            assert line[0].tolist() == [0.0, 0.0, 10.0]
            assert line[-1].tolist() == place.tolist()

import numpy as np
import pytest
from shapely.geometry import box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.propagation.arrays import Isotropic, rotation_from_aircraft, single_element, uav_comparison_array
from aerpaw_cmp.propagation.audit import audit
from aerpaw_cmp.propagation.relevance import PATTERN_MARGIN, largest_amplitude
from aerpaw_cmp.propagation.tracer import replay
from aerpaw_cmp.site.site import Building

NEAR = Building("near", box(25, -10, 30, 10), 12.0)
FAR = Building("far", box(-9010, -8, -9000, 8), 9.0)


def flight(scenes, count=150):
    rng = np.random.default_rng(51)
    position = np.column_stack([rng.uniform(-60, 20, count), rng.uniform(-60, 60, count), rng.uniform(5, 40, count)])
    angles = rng.uniform(-10, 10, (3, count))
    return scenes.poses(position, rotation_from_aircraft(angles[0], angles[1], 18 * angles[2]))


@pytest.mark.parametrize("relevance_db", [0.05, 0.5, 3.0])
def test_no_link_moves_by_more_than_stated(scenes, relevance_db):
    site = scenes.site([NEAR, FAR, *scenes.buildings(np.random.default_rng(52), 5, spread_m=120.0)])
    poses = flight(scenes)
    link = scenes.link(site, uav_array=uav_comparison_array(0.0882))
    whole = replay(site, link, poses)
    reduced = replay(site, link, poses, relevance_db=relevance_db)
    assert len(reduced.paths) <= len(whole.paths)
    assert (np.isfinite(reduced.rss_dbm) == np.isfinite(whole.rss_dbm)).all()
    assert np.nanmax(np.abs(reduced.rss_dbm - whole.rss_dbm)) <= relevance_db


def test_a_far_barn_is_left_out_by_name_and_the_near_one_is_not(scenes):
    site = scenes.site([NEAR, FAR])
    poses = flight(scenes)
    link = scenes.link(site)
    reduced = replay(site, link, poses, relevance_db=1.0)
    text = "\n".join(reduced.left_out)
    assert "far: reflects nothing that matters" in text
    assert "near:" not in text
    assert "face sequences" in text
    whole = replay(site, link, poses)
    assert len(reduced.paths) < len(whole.paths)
    report = audit(site, link, poses, reduced, reference="image", links=None)
    assert report.missing_paths == len(whole.paths) - len(reduced.paths)
    assert report.extra_paths == 0
    assert report.rss_max_error_db <= 1.0


def test_what_is_left_out_still_hides(scenes):
    site = scenes.site([FAR])
    behind = scenes.poses([[-9050.0, 0.0, 3.0], [-50.0, 0.0, 30.0]])
    assert replay(site, scenes.link(site), behind, relevance_db=3.0).has_path[:, 0].tolist() == [False, True]


def test_poses_in_fades_are_searched_again(scenes):
    tall = Building("far", FAR.footprint, 60.0)
    site = scenes.site([tall], ground_material="metal")  # deep fades
    poses = scenes.poses(np.column_stack([np.linspace(100, 200, 150), np.zeros(150), np.full(150, 30.0)]))
    link = scenes.link(site)
    reduced = replay(site, link, poses, relevance_db=3.0)
    again = int(reduced.left_out[-1].split()[0])
    assert 0 < again < 150
    assert "far: reflects nothing" in "".join(reduced.left_out)
    assert np.abs(reduced.rss_dbm - replay(site, link, poses).rss_dbm).max() <= 3.0


def test_largest_amplitude_covers_every_element():
    class Loud:
        name = "loud"

        def field(self, theta_rad, phi_rad):
            return 3.0 * np.sin(theta_rad) + 0j * phi_rad, 0j * theta_rad * phi_rad

    two = uav_comparison_array(0.0882)
    mixed = type(two)(two.positions_m[:2], two.slant_rad[:2], (Isotropic(), Loud()))
    assert largest_amplitude(single_element()) == pytest.approx(PATTERN_MARGIN)
    assert largest_amplitude(mixed) == pytest.approx(3.0 * PATTERN_MARGIN)


def test_usage(scenes):
    site = scenes.site()
    link, poses = scenes.link(site), scenes.poses([[30.0, 0.0, 20.0]])
    with pytest.raises(UsageError, match="positive"):
        replay(site, link, poses, relevance_db=0.0)
    with pytest.raises(UsageError, match="engine 'image'"):
        replay(site, link, poses, "sionna", relevance_db=1.0)

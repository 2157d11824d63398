from dataclasses import replace

import numpy as np
import pytest
from shapely.geometry import box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.propagation.arrays import rotation_from_aircraft, uav_comparison_array
from aerpaw_cmp.propagation.field.relevance import idle_objects
from aerpaw_cmp.propagation.field.sum import channel_matrices, mean_pair_power
from aerpaw_cmp.propagation.options import Field
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.site import Building

NEAR = Building("near", box(25, -10, 30, 10), 12.0)
FAR = Building("far", box(-9010, -8, -9000, 8), 9.0)


def flight(scenes, count=150):
    rng = np.random.default_rng(51)
    position = np.column_stack([rng.uniform(-60, 20, count), rng.uniform(-60, 60, count), rng.uniform(5, 40, count)])
    angles = rng.uniform(-10, 10, (3, count))
    return scenes.poses(position, rotation_from_aircraft(angles[0], angles[1], 18 * angles[2]))


def without(site, names):
    return replace(site, buildings=tuple(b for b in site.buildings if b.name not in names))


@pytest.mark.parametrize("relevance_db", [0.05, 0.5, 3.0])
def test_no_link_moves_by_more_than_stated_without_the_reflections_of_those_named(scenes, relevance_db):
    site = scenes.site([NEAR, FAR, *scenes.buildings(np.random.default_rng(52), 5, spread_m=120.0)])
    poses = flight(scenes)
    link = scenes.link(site, uav_array=uav_comparison_array(0.0882))
    whole = replay(site, link, poses, field=Field(relevance_db=relevance_db))
    assert np.array_equal(whole.rss_dbm, replay(site, link, poses).rss_dbm)
    sources = np.array([t.position_m for t in site.towers.values()])
    fields = channel_matrices(whole.paths, whole.faces, sources, poses, link)
    power = mean_pair_power(fields.h)
    labels, share = idle_objects(whole.paths, whole.faces, fields.path_power, power, relevance_db)
    assert "far" in labels
    assert 0.0 < share <= 1.0
    solids = [int(whole.faces.solid[whole.faces.label.index(f"{name} roof")]) for name in labels]
    touches = np.isin(np.append(whole.faces.solid, -1)[whole.paths.faces], solids).any(axis=1)
    rest = channel_matrices(whole.paths.select(~touches), whole.faces, sources, poses, link)
    moved = np.abs(10 * np.log10(mean_pair_power(rest.h) / power))
    assert 0.0 < moved.max() <= relevance_db


def test_a_far_barn_is_named_and_the_near_one_is_not(scenes):
    site = scenes.site([NEAR, FAR])
    reduced = replay(site, scenes.link(site), flight(scenes), field=Field(relevance_db=1.0))
    (line,) = [text for text in reduced.left_out if "no RSS would move" in text]
    assert line.startswith("far: ")
    site = scenes.site([NEAR])
    (line,) = replay(site, scenes.link(site), flight(scenes), field=Field(relevance_db=0.001)).left_out
    assert line == "every building moves the RSS of some link by more than 0.001 dB"


def test_usage(scenes):
    site = scenes.site()
    link, poses = scenes.link(site), scenes.poses([[30.0, 0.0, 20.0]])
    with pytest.raises(UsageError, match="positive"):
        replay(site, link, poses, field=Field(relevance_db=0.0))

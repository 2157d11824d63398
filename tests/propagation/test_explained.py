"""Why a sequence of faces makes no path."""

from __future__ import annotations

import numpy as np
from shapely.geometry import Polygon, box

from aerpaw_cmp.propagation.check.explain import why_not
from aerpaw_cmp.propagation.faces import site_faces
from aerpaw_cmp.propagation.paths import Links
from aerpaw_cmp.propagation.search.mirror import find_paths
from aerpaw_cmp.site.site import Building


def test_reasons_of_geometry(scenes):
    buildings = (
        Building("barn", box(20, -10, 30, 10), 15.0),
        Building("shed", Polygon([(-30, 20), (-10, 20), (-10, 30), (-20, 30), (-20, 40), (-30, 40)]), 6.0),
    )
    faces = site_faces(scenes.site(buildings))
    source, target = np.array([0.0, 0, 10]), np.array([60.0, 0, 10])
    assert why_not(faces, source, target, np.zeros(0, int)) == "occluded by barn"
    wall = next(i for i, label in enumerate(faces.label) if label == "barn wall 4" or faces.normal[i, 0] < -0.9)
    assert "behind a face" in why_not(faces, source, target, np.array([wall]))
    beside = np.array([0.0, 60, 10])
    assert "outside barn" in why_not(faces, source, beside, np.array([wall]))
    high = np.array([60.0, 0, 60])
    assert why_not(faces, source, high, np.zeros(0, int)) == ""
    assert why_not(faces, source, high, np.array([0])) == "occluded by barn"
    # every path that is found has no reason not to be there, and every one that is not has one
    rng = np.random.default_rng(3)
    targets = np.column_stack([rng.uniform(-80, 80, (40, 2)), rng.uniform(2, 40, 40)])
    found = find_paths(faces, Links(source[None], targets), max_depth=1)
    for pose, place in enumerate(targets):
        there = set(found.faces[(found.pose == pose) & (found.depth == 1), 0].tolist())
        for face in range(len(faces)):
            assert (why_not(faces, source, place, np.array([face])) == "") == (face in there)


def test_a_scene_of_triangles_is_no_error(scenes):
    """Faces without a roof, and finite ones without a building: nothing is said that was not tested."""
    faces = site_faces(scenes.site((Building("barn", box(20, -10, 30, 10), 15.0),)))
    walls = faces.select(np.arange(5))  # the roof is left out
    assert "triangles" in why_not(walls, np.array([0.0, 0, 10]), np.array([60.0, 0, 10]), np.zeros(0, int))

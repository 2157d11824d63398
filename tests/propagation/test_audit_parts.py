"""Parts of the audit: what counts as a missing path, and how explanations say lengths and faces."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from aerpaw_cmp.propagation.arrays import Isotropic, Link, Poses, single_element
from aerpaw_cmp.propagation.check import explain
from aerpaw_cmp.propagation.check.field_audit import Expected, _lacking
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.search.merging import _labels
from aerpaw_cmp.site.siteyaml import load_site

SITE = load_site("lake_wheeler")
LINK = Link(3.3e9, {"LW1": single_element(Isotropic())}, single_element(Isotropic()))
POSES = Poses(np.array([[120.0, 60.0, 40.0]]), np.eye(3)[None])


def test_a_path_that_the_other_engine_alone_has_is_missing_only_where_it_exists() -> None:
    found = replay(SITE, LINK, POSES, Search("image", max_depth=1))
    known = found.paths
    assert len(known) >= 2
    every = np.arange(len(known))
    missing = _lacking(SITE, found, known, found.faces, every, POSES, Expected.of(LINK))
    assert (missing.missing_paths, missing.doubtful) == (len(known), 0)
    assert missing.failures == (f"{len(known)} paths that Sionna has are missing",)
    # the same paths off walls that look away from the tower: none can exist
    source = SITE.towers["LW1"].position_m
    away = np.flatnonzero((found.faces.solid >= 0) & (found.faces.normal @ source < found.faces.offset_m - 1.0))
    bounced = known.select(np.flatnonzero(known.depth == 1)[:1])
    for face in away[:5]:
        phantom = dataclasses.replace(bounced, faces=np.full_like(bounced.faces, face))
        judged = _lacking(SITE, found, phantom, found.faces, np.array([0]), POSES, Expected.of(LINK))
        assert (judged.missing_paths, judged.doubtful, judged.failures) == (0, 1, ())
    assert len(away) > 5


@pytest.mark.parametrize(
    ("length", "text"),
    [(12.345, "12.35 m"), (0.5, "0.50 m"), (0.01, "0.01 m"), (0.0099, "9.9e-03 m"), (0.0, "0.0e+00 m")],
)
def test_lengths_below_a_centimetre_keep_their_digits(length: float, text: str) -> None:
    assert explain._metres(length) == text


def test_faces_are_counted_within_their_shape() -> None:
    labels = _labels(("hall", "shed"), np.array([0, 0, 1, 0, 1]))
    assert labels == ("hall face 1", "hall face 2", "shed face 1", "hall face 3", "shed face 2")

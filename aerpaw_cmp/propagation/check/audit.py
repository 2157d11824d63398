"""One engine checked against the other on a spread of links, and its fields against two references."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from ...common.units import ComplexArray, FloatArray, IntArray, spread_out
from ...compare.level.field_difference import FieldAudit
from ...site.site import Site
from ..geometry.arrays import Link, Poses
from ..geometry.paths import joined
from ..options import Engine, Field, Run, Search
from ..replay import Replay
from ..replay import replay as run_replay
from ..search.mirror import plane_keys, planes_of
from .field_audit import (
    REFERENCE_LINKS,
    Expected,
    against_reference,
    against_sionna,
    impossible,
    spread_over_paths,
)

# Rays of the solve that gives Sionna's own coefficients: which paths there are is asked before, with all of them.
_FIELD_SAMPLES = 100_000

# Singular-value ratios of the paper.
RANK_K = (10.0, 100.0, 1000.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """Differences between two replays of the same poses.

    Parameters
    ----------
    missing_paths, extra_paths : int
        Paths of the reference that the engine lacks; paths of the engine that the reference lacks.
    reference_paths : int
    rss_max_error_db, rss_rms_error_db : float
        Of the coherent RSS, over links that both cover; NaN when there is none.
    coverage_differs : int
        Links that only one of the two covers.
    rank_disagreement : dict of float to float
        Share of links whose rank differs, for each K; a link without a path has rank 0.
    """

    missing_paths: int
    extra_paths: int
    reference_paths: int
    rss_max_error_db: float
    rss_rms_error_db: float
    coverage_differs: int
    rank_disagreement: dict[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Audit(Difference):
    """A replay checked by the other engine: how it differs on the checked links, and what that took.

    Parameters
    ----------
    engine, reference : str
    links : int
        Pose-tower pairs checked.
    seconds, reference_seconds : float
        Time of the replay (all its links) and of the reference on the checked links; a reference whose paths came
        from the cache counts with the time its search once took.
    samples : int
        Rays per tower that PathSolver shot, in the replay or the reference.
    samples_reason : str
        Why so many.
    field : FieldAudit or None
        Of the fields, where one was asked for.
    """

    engine: str
    reference: str
    links: int
    seconds: float
    reference_seconds: float
    samples: int = 0
    samples_reason: str = ""
    field: FieldAudit | None = None


@dataclass(frozen=True, slots=True)
class Second:
    """Settings of an audit: the part that is checked, and the reference it is checked against.

    Parameters
    ----------
    reference : {"image", "sionna"}, optional
        Default: the engine that the replay did not take.
    links : int or None
        About this many pose-tower pairs, poses evenly spread over the flight; None checks all.
    expected : Expected, optional
        What the settings say. With it fields are checked too (:mod:`aerpaw_cmp.propagation.check.field_audit`).
    ks : sequence of float
        Singular-value ratios of the rank comparison.
    reference_links : int
        Poses that the second implementation computes.
    known : dict
        Sionna's own coefficients by what they depend on: channels with one tower and track share them.
    """

    reference: Engine | None = None
    links: int | None = 200
    expected: Expected | None = None
    ks: Sequence[float] = RANK_K
    reference_links: int = REFERENCE_LINKS
    known: dict[str, Any] = field(default_factory=dict)


def audit(
    site: Site, link: Link, poses: Poses, replay: Replay,
    search: Search = Search(), field: Field = Field(), run: Run = Run(), second: Second = Second(),
) -> Audit:  # fmt: skip
    """Check a replay by another engine, on the whole scene (nothing left out).

    Parameters
    ----------
    site, link, poses
        As given to the replay.
    replay : Replay
        The result to check.
    search, field, run
        As given to the replay.
    second : Second
        The other engine, how many links, and what the second implementation checks.

    Returns
    -------
    Audit
    """
    chosen = _spread(poses, None if second.links is None else -(-second.links // max(1, len(replay.towers))))
    engine: Engine = second.reference or ("image" if replay.engine == "sionna" else "sionna")
    search = replace(search, engine=engine)
    # on few poses, for the other engine is some hundred times slower
    few = poses[chosen]
    checked = run_replay(site, link, few, search, Field(field.loss), run)
    rays = checked.samples or (_FIELD_SAMPLES if search.samples == "auto" else search.samples)
    fields, ks, expected = None, second.ks, second.expected
    if expected is not None:
        # open sheets need a law of their own, which the second implementation lacks
        fields = FieldAudit(not_covered=("the second implementation: it knows prisms, no scene of triangles",))
        if site.scene is None:
            few_kinds = spread_over_paths(replay, chosen, second.reference_links)
            fields = against_reference(site, poses, replay, few_kinds, expected, ks=ks, max_depth=search.max_depth)
            fields += impossible(site, poses, replay, extra_rows(replay, checked, chosen), expected)
        rayed = replace(search, samples=min(rays, _FIELD_SAMPLES))
        fields += against_sionna(site, link, poses, replay, chosen, expected, rayed, known=second.known)
    return Audit(
        field=fields,
        engine=replay.engine,
        reference=engine,
        links=len(chosen) * len(replay.towers),
        **asdict(compare(replay, checked, chosen, ks)),
        seconds=replay.seconds,
        samples=max(checked.samples, replay.samples),
        samples_reason=checked.samples_reason or replay.samples_reason,
        # read from the cache it took no time: what its search once took is the honest number
        reference_seconds=checked.seconds + (checked.search_seconds if checked.from_cache else 0.0),
    )


def _spread(poses: Poses, count: int | None) -> IntArray:
    """Indices of poses with a position, evenly spread."""
    good = np.flatnonzero(np.isfinite(poses.position_m).all(axis=1))
    return good if count is None else np.asarray(good[spread_out(len(good), count)])


def compare(replay: Replay, reference: Replay, chosen: IntArray, ks: Sequence[float] = RANK_K) -> Difference:
    """Differences of a replay from a reference that has only the poses ``chosen``.

    Parameters
    ----------
    replay : Replay
        Of all poses.
    reference : Replay
        Of the chosen poses, by the other engine.
    chosen : (m,) int
        Rows of ``replay`` that the reference has, in its order.
    ks : sequence of float
        Singular-value ratios at which ranks are compared.

    Returns
    -------
    Difference
        Paths that one has and the other lacks, errors of the level [dB], links in coverage of one alone, and ranks
        that differ.
    """
    ours, theirs = (keys.keys() for keys in _keys_of_both(replay, reference, chosen))
    return Difference(
        missing_paths=len(theirs - ours),
        extra_paths=len(ours - theirs),
        reference_paths=len(theirs),
        **channels_differ((replay.h[chosen], replay.rss_dbm[chosen]), (reference.h, reference.rss_dbm), ks),
    )


def channels_differ(
    channels: tuple[ComplexArray, FloatArray], reference: tuple[ComplexArray, FloatArray], ks: Sequence[float]
) -> dict[str, Any]:
    """Differences of H and levels (poses, towers) [dBm] from those of a reference, as :class:`Difference` has them."""
    from ...compare.rank import channel_rank

    (h, level), (reference_h, expected) = channels, reference
    covered = np.isfinite(level) & np.isfinite(expected)
    error = np.abs(level[covered] - expected[covered])
    return {
        # NaN where nothing was compared: a zero would say that all agrees
        "rss_max_error_db": float(error.max()) if error.size else float("nan"),
        "rss_rms_error_db": float(np.sqrt((error**2).mean())) if error.size else float("nan"),
        "coverage_differs": int((np.isfinite(level) != np.isfinite(expected)).sum()),
        "rank_disagreement": {float(k): float(np.mean(channel_rank(h, k) != channel_rank(reference_h, k))) for k in ks},
    }


def extra_rows(replay: Replay, reference: Replay, chosen: IntArray) -> IntArray:
    """Paths of a replay that the reference, which has only the poses ``chosen``, has not."""
    ours, theirs = _keys_of_both(replay, reference, chosen)
    return np.array([row for key, row in ours.items() if key not in theirs], dtype=np.int64)


# Rows of paths by place of the pose among the chosen ones, tower and planes.
_Keys = dict[tuple[int, ...], int]


def _keys_of_both(replay: Replay, reference: Replay, chosen: IntArray) -> tuple[_Keys, _Keys]:
    """Paths of a replay and of a reference that has only the poses ``chosen``."""
    # numbered together: the planes of terrain that a replay lists depend on its poses
    plane = np.split(planes_of(joined(replay.faces, reference.faces)), [len(replay.faces)])
    return _keys(replay, plane[0], chosen), _keys(reference, plane[1], np.arange(len(chosen)))


def _keys(replay: Replay, planes: IntArray, chosen: IntArray) -> _Keys:
    """Rows of paths by (place in ``chosen``, tower, planes): coplanar faces are the same mirror."""
    place = np.full(int(max(chosen.max(initial=-1), replay.paths.pose.max(initial=-1))) + 1, -1, dtype=np.int64)
    place[chosen] = np.arange(len(chosen))
    index = np.flatnonzero(place[replay.paths.pose] >= 0)
    paths = replay.paths.select(index)
    # faces in one plane are one mirror, and engines may name either
    keys = plane_keys(replace(paths, pose=place[paths.pose]), planes)
    return dict(zip(keys, index.tolist(), strict=True))

"""The audit of a replay: one engine checks the paths of the other on a sample of links, and two references the fields.

The fields of a replay are compared with Sionna's own coefficients and with a second implementation.

1. *Sionna* traces the audited links again and returns a complex coefficient for each path. Sionna uses an element at
   each array centre with both slants, and its own materials, patterns and rotations. The results are float32: entries
   must agree within ``_ENTRY_TOLERANCE`` of the strongest entry, and phases within ``_PHASE_TOLERANCE_RAD`` on paths
   shorter than ``_PHASE_RANGE_M``.
2. :mod:`aerpaw_cmp.propagation.check.reference` computes a few links of each replay from the settings: their paths, H
   of every element pair with foliage, RSS and rank. Both implementations use float64, so only rounding may differ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...common.content import content_digest
from ...common.text import counted
from ...common.units import BoolArray, ComplexArray, FloatArray, IntArray, spread_out
from ...compare.level import FieldAudit
from ...compare.rank import channel_rank
from ...site.site import Site
from ..field.foliage import over_stands
from ..field.sum import channel_matrices
from ..geometry import Array, Faces, Isotropic, Link, PathSet, Poses, joined, legs
from ..options import Engine, Field, Run, Search
from ..replay import Replay
from ..replay import replay as run_replay
from ..scene import Scene
from ..search.mirror import plane_keys, planes_of
from ..search.terrain import TERRAIN
from .reference import MARGIN_M, ExpectedArray, ExpectedLink, ExpectedLoss, Mirror, Reference, matrix_of

if TYPE_CHECKING:
    from ..search.sionna import Coefficients


# Tolerance of an entry, relative to the strongest of the four entries of a path. The float32 errors in rotations,
# patterns and Fresnel coefficients are about 5e-4.
_ENTRY_TOLERANCE = 3e-3

# Sionna's reflection points are barycentric on large triangles, and float32 has 24 bits for a coordinate.
_FLOAT32_ULP = 2.0**-22

# Within ``_PHASE_RANGE_M``, float32 shifts a reflection point off its plane by at most 1e-4 m, which is 7e-3 rad at 3.4
# GHz.
_PHASE_TOLERANCE_RAD = 0.01

_PHASE_RANGE_M = 300.0

# Tolerance for the coherent RSS of a link whose paths are all shorter than ``_PHASE_RANGE_M`` [dB].
_LINK_TOLERANCE_DB = 0.1

# Tolerance for H against the second implementation, relative to the root of the total path power of the link. Both
# implementations use float64.
_EXACT_TOLERANCE = 1e-6

# If a shift of an edge by this distance creates or removes a path, float32 may also do so.
_SIONNA_MARGIN_M = 2e-3

# Number of poses per replay for the second implementation. Each link takes about 0.1 s, because element pairs are
# computed one after the other.
REFERENCE_LINKS = 8

# Patterns that Sionna and this package have under the same names.
_SIONNA_PATTERNS = ("iso", "hw_dipole", "tr38901")


@dataclass(frozen=True, slots=True)
class Expected:
    """The settings of a flight, for the second implementation."""

    link: ExpectedLink
    loss: ExpectedLoss = field(default_factory=ExpectedLoss)

    @classmethod
    def of(cls, link: Link, loss: ExpectedLoss | None = None) -> Expected:
        """Return the settings of a link, with its layout, slants and mounts unchanged."""
        towers = {name: expected_array(array) for name, array in link.tower_arrays.items()}
        uav = expected_array(link.uav_array)
        settings = (link.carrier_hz, link.transmit_power_dbm, link.uav_transmits)
        known = ExpectedLink(*settings, towers, uav, link.noise_floor_dbm)
        return cls(known, loss or ExpectedLoss())


def expected_array(array: Array) -> ExpectedArray:
    """Return the positions, slants, patterns and mount of an array for the second implementation."""
    # one pattern is used for all elements
    patterns = array.patterns * len(array) if len(array.patterns) == 1 else array.patterns
    return ExpectedArray(
        tuple((float(x), float(y), float(z)) for x, y, z in array.positions_m),
        tuple(float(x) for x in np.degrees(array.slant_rad)),
        tuple(scalar_pattern(pattern) for pattern in patterns),
        matrix_of(array.mount),
    )


def scalar_pattern(pattern: Any) -> Any:
    """Return a function that evaluates a pattern of this package in one direction."""

    def of(theta: float, phi: float) -> tuple[complex, complex]:
        e_theta, e_phi = pattern.field(np.array(theta), np.array(phi))
        return complex(e_theta), complex(e_phi)

    return of


# ---------------------------------------------------------------- the second implementation


def against_reference(
    site: Site,
    poses: Poses,
    replay: Replay,
    chosen: IntArray,
    expected: Expected,
    *,
    ks: Sequence[float],
    max_depth: int,
) -> FieldAudit:
    """Compute a few links of a replay with the second implementation, and compare the results.

    Parameters
    ----------
    site, poses, replay
        Inputs and result of the replay.
    chosen : (links,) int
        Pose indices. Each tower of the replay is checked at each of these poses.
    expected : Expected
    ks : sequence of float
    max_depth : int

    Returns
    -------
    FieldAudit
    """
    total, beyond = FieldAudit(reference_links=len(chosen) * len(replay.towers)), _over_terrain(replay)
    in_woods = np.zeros(len(replay.paths), dtype=np.bool_)
    if expected.loss.model != "none":
        places = np.array([site.towers[name].position_m for name in replay.towers])
        source, target = places[replay.paths.tower], poses.position_m[replay.paths.pose]
        in_woods = over_stands(site, source, replay.paths.vertices_m, target)
    for number, name in enumerate(replay.towers):
        reference = Reference(site, name, expected.link, expected.loss)
        for row in chosen:
            mine = np.flatnonzero((replay.paths.pose == row) & (replay.paths.tower == number))
            stands = in_woods[mine].any()
            # the second implementation supports only level ground and no media. Report that instead of a false failure.
            if beyond[mine].any() or stands:
                total += FieldAudit(not_covered=(_STANDS if stands else _ON_TERRAIN,))
                continue
            link = _OneLink(reference=reference, replay=replay, poses=poses, row=int(row), tower=number, mine=mine)
            total += link.paths_checked(max_depth, site.dem is None)
            try:
                total += link.field_checked(ks)
            # the second implementation's table of P.2040 does not contain the material
            except LookupError as error:
                total += FieldAudit(not_covered=(f"the material {error.args[0]} at this carrier",))
    return total


def impossible(site: Site, poses: Poses, replay: Replay, rows: IntArray, expected: Expected) -> FieldAudit:
    """Count the paths of a replay that the other engine does not have and that cannot exist.

    Parameters
    ----------
    site : Site
    poses : Poses
    replay : Replay
    rows : (m,) int
        Paths of the replay that the other engine does not have.
    expected : Expected
        Arrays and loss according to the settings, read a second time.

    Returns
    -------
    FieldAudit
        ``phantom_paths`` and their failures; all other fields are empty.
    """
    rows = rows[~_over_terrain(replay)[rows]]
    count = _verdicts(site, replay, replay.paths, replay.faces, poses, rows, expected).count(False)
    failures = (f"{counted(count, 'path')} that cannot exist",) if count else ()
    return FieldAudit(phantom_paths=count, failures=failures)


def _verdicts(
    site: Site, replay: Replay, paths: PathSet, faces: Faces, poses: Poses, rows: IntArray, expected: Expected,
    margin_m: float = MARGIN_M,
) -> list[bool | None]:  # fmt: skip
    """Check whether each path of ``rows`` exists according to the second implementation. None means doubtful."""
    references = [Reference(site, name, expected.link, expected.loss) for name in replay.towers]
    verdicts = []
    for row in rows:
        reference = references[int(paths.tower[row])]
        sequence = _mirrors_of(reference, faces, paths, row)
        east, north, up = poses.position_m[paths.pose[row]].tolist()
        verdicts.append(False if sequence is None else reference.verdict(sequence, (east, north, up), margin_m))
    return verdicts


_STANDS = "paths near forests modelled as a medium"
_ON_TERRAIN = "reflections off shaped ground"


def _over_terrain(replay: Replay) -> BoolArray:
    """Check for each path (paths,) whether it reflects off terrain that is not a level plane."""
    shaped = np.append(replay.faces.solid == TERRAIN, False)
    return np.asarray(shaped[replay.paths.faces].any(axis=1))


@dataclass(frozen=True, slots=True)
class _OneLink:
    reference: Reference
    replay: Replay
    poses: Poses
    row: int
    tower: int
    mine: IntArray

    @property
    def target(self) -> tuple[float, float, float]:
        east, north, up = self.poses.position_m[self.row].tolist()
        return east, north, up

    @property
    def name(self) -> str:
        return f"{self.replay.towers[self.tower]}, pose {self.row}"

    def sequence(self, path: int) -> tuple[Mirror, ...] | None:
        """Return the mirrors of a path of the replay, looked up in the site. None if the site has no such face."""
        return _mirrors_of(self.reference, self.replay.faces, self.replay.paths, path)

    def paths_checked(self, max_depth: int, complete: bool) -> FieldAudit:
        """Count paths that cannot exist and paths that are missing."""
        failures: list[str] = []
        keys = set()
        phantom = doubtful = missing = 0
        ground = self.reference.site.towers[self.replay.towers[self.tower]].ground_m
        gap = math.dist(self.target, self.reference.source)
        # the replay excludes a pose only if it is too far from every tower, not only from this tower
        nearest = min(math.dist(self.target, tower.position_m) for tower in self.reference.site.towers.values())
        # the replay must not have a path to a target that is buried, in the near field or out of reach
        nowhere = self.target[2] < min(ground, 0.0) or gap < 0.01 or nearest > 1e5
        for path in self.mine:
            sequence = self.sequence(path)
            keys.add(None if sequence is None else _key(sequence))
            verdict = False if sequence is None or nowhere else self.reference.verdict(sequence, self.target)
            phantom += verdict is False
            doubtful += verdict is None
        if phantom:
            failures.append(f"{self.name}: {counted(phantom, 'path')} that cannot exist")
        if complete and not nowhere:
            # with None, there are too many sequences to try, but the paths of the replay are still checked
            for sequence in self.reference.sequences(self.target, max_depth) or ():
                # count a path as missing only if it certainly exists
                if self.reference.verdict(sequence, self.target) and (key := _key(sequence)) not in keys:
                    missing += 1
                    keys.add(key)
            if missing:
                failures.append(f"{self.name}: {counted(missing, 'path is', 'paths are')} missing")
        return FieldAudit(missing_paths=missing, phantom_paths=phantom, doubtful=doubtful, failures=tuple(failures))

    def field_checked(self, ks: Sequence[float]) -> FieldAudit:
        """Compare H, RSS and rank, computed from the replay's own list of paths."""
        paths, replay = [], self.replay
        if replay.further:  # the second implementation computes only direct paths and reflections
            return FieldAudit(not_covered=tuple(f"paths {some.kind}" for some in replay.further))
        for path in self.mine:
            sequence = self.sequence(path)
            if sequence is None:
                return FieldAudit(doubtful=1)  # this was already counted as a failure
            loss = self.reference.loss_db(sequence, self.target)
            if loss is None:
                return FieldAudit(doubtful=1)
            paths.append((sequence, loss))
        h, power = self.reference.matrix(paths, self.target, matrix_of(self.poses.rotation[self.row]))
        return self._against(h.T if self.reference.link.uav_transmits else h, power, ks, len(paths))

    def _against(self, h: ComplexArray, power: float, ks: Sequence[float], paths: int) -> FieldAudit:
        """Compare H, RSS and rank of the replay with the expected ``h`` and total path ``power`` of a link."""
        link, ours, failures = self.reference.link, self.replay.h[self.row, self.tower], []
        over = _decibel(float((np.abs(h) ** 2).mean())) + link.transmit_power_dbm - link.noise_floor_dbm
        # do not judge a level this close to the noise floor, because rounding decides whether there is a channel
        if abs(over) < 1e-3:
            return FieldAudit(doubtful=1)
        if over < 0:  # below the receiver's floor: no channel
            h = np.zeros_like(h)
        if ours.shape != h.shape:
            return FieldAudit(failures=(f"{self.name}: H is {ours.shape}, expected {h.shape}",))
        # take the error relative to the path powers, not to H: in a fade, H is small, but its error is not
        size = math.sqrt(power) or 1e-30
        under = _decibel(power) + link.transmit_power_dbm < link.noise_floor_dbm
        error = float(np.abs(ours - h).max()) / size
        if not error <= _EXACT_TOLERANCE:
            failures.append(f"{self.name}: the relative error of H is {error:.2g}")
        worst, level_of_h = 0.0, float((np.abs(h) ** 2).mean())
        for level, value in ((self.replay.rss_dbm, level_of_h), (self.replay.rss_power_dbm, 0.0 if under else power)):
            # compute the coherent level from H, and the other level from the path powers
            off = _level_error(float(level[self.row, self.tower]), value, link.transmit_power_dbm, size)
            if off > 1e-3:
                failures.append(f"{self.name}: RSS differs by {off:.2g} dB")
            worst = max(worst, off)
        differs = _another_rank(ours, h, ks)
        if differs:
            failures.append(f"{self.name}: another rank")
        return FieldAudit(
            reference_paths=paths, h_max_error=error, rss_max_error_db=worst, rank_differs=int(differs),
            failures=tuple(failures),
        )  # fmt: skip


def _another_rank(ours: ComplexArray, expected: ComplexArray, ks: Sequence[float]) -> bool:
    """Check whether a rank differs for a K at which no singular value lies near the threshold."""
    sigma = np.linalg.svd(expected, compute_uv=False)
    if not sigma[0] > 0:
        return any(int(channel_rank(ours, k)) for k in ks)
    # skip thresholds at which rounding decides whether a singular value counts
    clear = [k for k in ks if not (np.abs(sigma * k / sigma[0] - 1.0) < 1e-4).any()]
    return any(int(channel_rank(ours, k)) != int((sigma > sigma[0] / k).sum()) for k in clear)


def _decibel(power: float) -> float:
    return 10 * math.log10(power) if power > 0 else -math.inf


def _level_error(level_dbm: float, power: float, transmit_dbm: float, size: float) -> float:
    """Return the error of a level [dB] beyond the rounding error, which is large in a fade.

    The error is infinite if only one of the two levels is in coverage.
    """
    if power <= (1e-9 * size) ** 2:  # there is no power, or the fade is deeper than 180 dB
        return 0.0 if not math.isfinite(level_dbm) or power > 0 else math.inf
    if not math.isfinite(level_dbm):
        return math.inf
    off = abs(level_dbm - transmit_dbm - 10 * math.log10(power))
    rounding = 20 / math.log(10) * _EXACT_TOLERANCE * size / math.sqrt(power)
    return max(0.0, off - rounding)


def _mirror_of(reference: Reference, faces: Faces, face: int, vertex: FloatArray) -> Mirror | None:
    normal, offset = faces.normal[face], float(faces.offset_m[face])
    solid = int(faces.solid[face])
    point = tuple(vertex.tolist())
    # compare plane and building, because the replay numbers faces differently
    same = [
        m
        for m in reference.mirrors
        if m.solid == solid
        and abs(m.offset_m - offset) < 1e-6
        and max(abs(a - b) for a, b in zip(m.normal, normal.tolist(), strict=True)) < 1e-9
    ]
    return max(same, key=lambda m: m.margin(point)) if same else None


def _mirrors_of(reference: Reference, faces: Faces, paths: PathSet, row: int) -> tuple[Mirror, ...] | None:
    """Return the mirrors of a path, looked up in the site. None if the site has no such face."""
    met = zip(paths.faces[row].tolist(), paths.vertices_m[row], strict=True)
    mirrors = [_mirror_of(reference, faces, face, vertex) for face, vertex in met if face >= 0]
    known = tuple(mirror for mirror in mirrors if mirror is not None)
    return known if len(known) == len(mirrors) else None


def _key(sequence: Sequence[Mirror]) -> tuple[tuple[float, ...], ...]:
    """Return the planes of a sequence. Coplanar faces are the same mirror."""
    return tuple(tuple(round(x, 6) + 0.0 for x in (*m.normal, m.offset_m)) for m in sequence)


def spread_over_paths(replay: Replay, chosen: IntArray, count: int) -> IntArray:
    """Choose ``count`` poses of ``chosen`` that together have as many different paths as possible."""
    if len(chosen) <= count:
        return chosen
    kinds: dict[int, set[tuple[int, ...]]] = {int(row): set() for row in chosen}
    for pose, tower, faces in zip(
        replay.paths.pose.tolist(), replay.paths.tower.tolist(), replay.paths.faces.tolist(), strict=True
    ):
        if pose in kinds:
            kinds[pose].add((tower, *faces))
    picked: list[int] = []
    met: set[tuple[int, ...]] = set()
    candidates = list(kinds)
    # greedy: take the pose with the most sequences of faces that are new; an optimal cover is not needed
    while len(picked) < count:
        best = max(candidates, key=lambda row: (len(kinds[row] - met), len(kinds[row])))
        picked.append(best)
        met |= kinds[best]
        candidates.remove(best)
    return np.array(sorted(picked), dtype=np.int64)


# ---------------------------------------------------------------- Sionna's own coefficients


def against_sionna(
    site: Site,
    link: Link,
    poses: Poses,
    replay: Replay,
    chosen: IntArray,
    expected: Expected,
    search: Search,
    known: dict[str, Any] | None = None,
) -> FieldAudit:
    """Compare each path's power, phase and polarisation with Sionna's own coefficient.

    Parameters
    ----------
    site : Site
    link : Link
    poses : Poses
    replay : Replay
    chosen : (m,) int
        Indices of the poses to check.
    expected : Expected
        Arrays and loss according to the settings, read a second time.
    search : Search
        Depth, rays and batch of Sionna's search.
    known : dict, optional
        Earlier results of Sionna by the digest of their inputs.

    Returns
    -------
    FieldAudit
        Counts and largest errors over the paths that both engines have.
    """
    from ..search.sionna import own_coefficients

    few = poses[chosen]
    scene = Scene.of(site, link, few)
    probe, covered = _probe(link)
    turns = (
        np.array([expected.link.towers[name].mount for name in link.tower_arrays]),
        few.rotation @ np.array(expected.link.uav.mount),
    )
    links, known = scene.links_to(few), {} if known is None else known
    patterns = [array.patterns[0].name for array in (*probe.tower_arrays.values(), probe.uav_array)]
    asked = search.max_depth, search.samples, search.batch
    key = content_digest(scene.faces, scene.surfaces, links, patterns, probe.carrier_hz, turns, asked)
    if key not in known:
        known[key] = own_coefficients(scene.faces, links, probe, turns, search, surfaces=scene.surfaces)
    theirs: Coefficients = known[key]
    rows, ours = _of_chosen(replay.paths, chosen)
    ours = ours.select(~_over_terrain(replay)[rows])
    keys, their_keys = _keyed(ours, replay.faces, theirs.paths, scene.faces)
    known_rows = {key: index for index, key in enumerate(their_keys)}
    mine = np.flatnonzero([key in known_rows for key in keys])
    matches = np.array([known_rows[keys[row]] for row in mine], dtype=np.int64)
    own = replace(
        theirs, paths=theirs.paths.select(matches), gain=theirs.gain[matches], length_m=theirs.length_m[matches]
    )
    total = _paths_against_sionna(ours.select(mine), replay, scene, few, probe, own, chosen)
    if site.dem is None and site.scene is None:
        lacking = np.setdiff1d(np.arange(len(theirs.paths)), matches)
        total += _lacking(site, replay, theirs.paths, scene.faces, lacking, few, expected)
    return replace(total, not_covered=covered)


def _probe(link: Link) -> tuple[Link, tuple[str, ...]]:
    """Return the link with two crossed elements at each array centre, and the patterns that Sionna does not have.

    The elements have the pattern of the array's first element. The vertical and the horizontal element determine the
    field of every slant.
    """
    unasked: list[str] = []

    def centre(array: Array) -> Array:
        first = array.patterns[0]
        if first.name not in _SIONNA_PATTERNS:
            unasked.append(f"the antenna pattern '{first.name}' (Sionna computes with isotropic elements instead)")
            first = Isotropic()
        return Array(np.zeros((2, 3)), np.array([0.0, np.pi / 2]), (first,), array.mount)

    towers = {name: centre(array) for name, array in link.tower_arrays.items()}
    return replace(link, tower_arrays=towers, uav_array=centre(link.uav_array), uav_transmits=False), tuple(
        dict.fromkeys(unasked)
    )


def _paths_against_sionna(
    ours: PathSet, replay: Replay, scene: Scene, few: Poses, probe: Link, theirs: Coefficients, chosen: IntArray
) -> FieldAudit:
    """Compare paths with the same rows of Sionna's ``theirs``.

    ``chosen`` (poses,) contains the numbers of the poses in the replay.
    """
    count = len(ours)
    if not count:
        return FieldAudit()
    # give each path a separate pose, because H of a pose with a single path is the coefficient of that path
    alone = replace(ours, pose=np.arange(count))
    spots = few[ours.pose]
    h = channel_matrices(alone, replay.faces, scene.sources_m, spots, probe).h[np.arange(count), ours.tower]
    turn = (h * theirs.gain.conj()).sum(axis=(1, 2))
    # a coefficient of zero has no phase, so do not rotate it
    turn = np.where(turn == 0.0, 1.0, turn)
    phase, near = np.abs(np.angle(turn)), theirs.length_m < _PHASE_RANGE_M
    # float32 has too few digits for a weak entry, so take errors relative to the strongest entry of the path
    strongest = np.abs(theirs.gain).max(axis=(1, 2))
    # remove the phase, which is compared separately, because float32 is too coarse for it beyond 1 km
    aligned = h * (turn.conj() / np.abs(turn))[:, None, None]
    share = np.abs(aligned - theirs.gain).max(axis=(1, 2)) / np.where(strongest > 0.0, strongest, 1.0)
    power = 20.0 * np.log10(1.0 + share)
    allowed = _ENTRY_TOLERANCE + _turned_by_float32(ours, replay.faces, scene, spots, probe, theirs)
    rss = _link_error(ours, h, theirs.gain, near, len(few), len(replay.towers))
    failures = []
    for error, bad, unit in (
        # negate the comparison, so that NaN counts as a failure
        (power, ~(share <= allowed), "dB"),
        (phase, near & ~(phase <= _PHASE_TOLERANCE_RAD), "rad"),
    ):
        if bad.any():
            worst = int(np.argmax(np.where(bad, error, -1.0)))
            faces = ", ".join(replay.faces.label[face] for face in ours.faces[worst] if face >= 0)
            failures.append(
                f"{counted(int(bad.sum()), 'path')} differing from Sionna by up to {error[worst]:.3g} {unit}: worst "
                f"{replay.towers[ours.tower[worst]]}, pose {chosen[ours.pose[worst]]}, {faces or 'line of sight'}"
            )
    if rss > _LINK_TOLERANCE_DB:
        failures.append(f"the RSS of a link differs from Sionna's own paths by {rss:.3g} dB")
    return FieldAudit(
        paths=count,
        power_max_db=float(np.nanmax(power)),
        power_rms_db=float(np.sqrt(np.nanmean(power**2))),
        phases=int(near.sum()),
        phase_max_rad=float(np.nanmax(phase[near], initial=0.0)),
        phase_rms_rad=float(np.sqrt((phase[near] ** 2).mean())) if near.any() else 0.0,
        link_rss_max_db=rss,
        failures=tuple(failures),
    )


def _turned_by_float32(
    ours: PathSet, faces: Faces, scene: Scene, spots: Poses, probe: Link, theirs: Coefficients
) -> FloatArray:
    """Return angles (paths,) [rad] by which the rounding of Sionna's reflection points rotates polarisations.

    A reflection point nearly above an end of the path, seen along the normal of a face or the axis of a device, is at a
    small distance from that axis. The shift of the point divided by this distance rotates the plane of incidence, or
    the basis of the pattern. Shifts larger than the rounding of float32 are not tolerated.
    """
    mounts = np.stack([array.mount for array in probe.tower_arrays.values()])
    ends = scene.sources_m[ours.tower], spots.position_m
    # use the size of the ground in search.sionna, because float32 rounds coordinates in proportion to this size
    reach = 4.0 * max(float(np.abs(np.concatenate(ends)).max()), 100.0)
    shift = np.nan_to_num(np.abs(theirs.paths.vertices_m - ours.vertices_m)).max(axis=(1, 2), initial=0.0)
    axes = [mounts[ours.tower][:, :, 2], (spots.rotation @ probe.uav_array.mount)[:, :, 2]]
    both = (list(legs(ends[0], vertices, ends[1])) for vertices in (ours.vertices_m, theirs.paths.vertices_m))
    total = np.zeros(len(ours))
    for step, ((start, end), (moved_start, moved_end)) in enumerate(zip(*both, strict=True)):
        normals = [faces.normal[ours.faces[:, k]] for k in (step - 1, step) if 0 <= k < ours.faces.shape[1]]
        for axis in (*normals, *axes):
            planes = [np.cross(axis, way) for way in (end - start, moved_end - moved_start)]
            sizes = [np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1e-12) for plane in planes]
            total += np.linalg.norm(planes[0] / sizes[0] - planes[1] / sizes[1], axis=1)
    return np.where(shift <= _FLOAT32_ULP * reach, total, 0.0)


def _link_error(
    paths: PathSet, h: ComplexArray, reference: ComplexArray, near: BoolArray, poses: int, towers: int
) -> float:
    """Return the largest difference of coherent power [dB] over near links that are not in a fade."""
    link = paths.pose * towers + paths.tower
    sums = []
    for value in (h, reference):
        total = np.zeros((poses * towers, *value.shape[1:]), dtype=np.complex128)
        np.add.at(total, link, value)
        sums.append((np.abs(total) ** 2).mean(axis=(1, 2)))
    alone = np.bincount(link, weights=(np.abs(h) ** 2).mean(axis=(1, 2)), minlength=poses * towers)
    all_near = np.bincount(link, weights=~near, minlength=poses * towers) == 0
    # exclude deep fades: in a fade of 20 dB, an error of 0.01 rad is a tenth of the remaining field
    good = all_near & (sums[1] > 0.01 * alone) & (alone > 0)
    return float(np.abs(10 * np.log10(sums[0][good] / sums[1][good])).max(initial=0.0))


def _lacking(
    site: Site, replay: Replay, theirs: PathSet, faces: Faces, rows: IntArray, few: Poses, expected: Expected
) -> FieldAudit:
    """Count paths that only Sionna has: missing if they certainly exist, otherwise doubtful (Sionna uses float32)."""
    # use a wider margin, because float32 may differ within 2 mm
    verdicts = _verdicts(site, replay, theirs, faces, few, rows, expected, _SIONNA_MARGIN_M)
    missing = verdicts.count(True)
    doubtful = len(verdicts) - missing
    failures = (f"{counted(missing, 'path of Sionna is', 'paths of Sionna are')} missing",) if missing else ()
    return FieldAudit(missing_paths=missing, doubtful=doubtful, failures=failures)


# Number of rays of the run for Sionna's own coefficients. The paths were searched before with the full number of rays.
_FIELD_SAMPLES = 100_000

# Singular-value ratios of the paper.
RANK_K = (10.0, 100.0, 1000.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """The differences between two replays of the same poses.

    Parameters
    ----------
    missing_paths, extra_paths : int
        Number of paths that only the reference has, and number of paths that only the checked engine has.
    reference_paths : int
    rss_max_error_db, rss_rms_error_db : float
        Errors of the coherent RSS over links that both engines cover. NaN if there are none.
    coverage_differs : int
        Number of links that only one of the two engines covers.
    rank_disagreement : dict of float to float
        Share of links whose rank differs, for each K. A link without a path has rank 0.
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
    """A check of a replay by the other engine: differences on the checked links, and computing time.

    Parameters
    ----------
    engine, reference : str
    links : int
        Pose-tower pairs checked.
    seconds, reference_seconds : float
        Time of the replay (all its links) and of the reference on the checked links. If the paths of the reference came
        from the cache, the time of their original search is included.
    samples : int
        Number of rays per tower that PathSolver used, in the replay or in the reference.
    samples_reason : str
        Reason for this number of rays.
    field : FieldAudit or None
        Check of the fields, if requested.
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
    """The settings of an audit: the links to check, and the reference.

    Parameters
    ----------
    reference : {"image", "sionna"}, optional
        Default: the engine that the replay did not use.
    links : int or None
        About this number of pose-tower pairs, with poses evenly spread over the flight. None checks all.
    expected : Expected, optional
        Settings, read a second time. If they are given, fields are checked, too
        (:mod:`aerpaw_cmp.propagation.check.audit`).
    ks : sequence of float
        Singular-value ratios of the rank comparison.
    reference_links : int
        Number of poses that the second implementation computes.
    known : dict
        Sionna's own coefficients by the digest of their inputs. Channels with the same tower and track share these.
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
    """Check a replay by another engine, in the complete scene.

    Parameters
    ----------
    site, link, poses
        The same as for the replay.
    replay : Replay
        The result to check.
    search, field, run
        The same as for the replay.
    second : Second
        The other engine, the number of links, and the checks of the second implementation.

    Returns
    -------
    Audit
    """
    chosen = _spread(poses, None if second.links is None else -(-second.links // max(1, len(replay.towers))))
    engine: Engine = second.reference or ("image" if replay.engine == "sionna" else "sionna")
    search = replace(search, engine=engine)
    # check only a few poses, because the other engine is some hundred times slower
    few = poses[chosen]
    checked = run_replay(site, link, few, search, field, run)
    rays = checked.samples or (_FIELD_SAMPLES if search.samples == "auto" else search.samples)
    fields, ks, expected = None, second.ks, second.expected
    if expected is not None:
        # triangles may be open sheets, for which the second implementation does not have a formula
        fields = FieldAudit(not_covered=("the second implementation, which supports only prisms, not triangles",))
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
        # if the reference comes from the cache, report the time of its original search
        reference_seconds=checked.seconds + (checked.search_seconds if checked.from_cache else 0.0),
    )


def _spread(poses: Poses, count: int | None) -> IntArray:
    """Return indices of poses with a position, evenly spread."""
    good = np.flatnonzero(np.isfinite(poses.position_m).all(axis=1))
    return good if count is None else np.asarray(good[spread_out(len(good), count)])


def compare(replay: Replay, reference: Replay, chosen: IntArray, ks: Sequence[float] = RANK_K) -> Difference:
    """Compare a replay with a reference that has only the poses ``chosen``.

    Parameters
    ----------
    replay : Replay
        The replay of all poses.
    reference : Replay
        The replay of the chosen poses, by the other engine.
    chosen : (m,) int
        Rows of ``replay`` that correspond to the rows of ``reference``.
    ks : sequence of float
        Singular-value ratios at which ranks are compared.

    Returns
    -------
    Difference
        Paths that only one replay has, errors of the level [dB], links that only one replay covers, and ranks that
        differ.
    """
    keys = _keyed(_of_chosen(replay.paths, chosen)[1], replay.faces, reference.paths, reference.faces)
    ours, theirs = map(set, keys)
    h, level = replay.h[chosen], replay.rss_dbm[chosen]
    covered = np.isfinite(level) & np.isfinite(reference.rss_dbm)
    error = np.abs(level[covered] - reference.rss_dbm[covered])
    return Difference(
        missing_paths=len(theirs - ours),
        extra_paths=len(ours - theirs),
        reference_paths=len(theirs),
        # NaN if no link was compared, because zero would mean perfect agreement
        rss_max_error_db=float(error.max()) if error.size else math.nan,
        rss_rms_error_db=float(np.sqrt((error**2).mean())) if error.size else math.nan,
        coverage_differs=int((np.isfinite(level) != np.isfinite(reference.rss_dbm)).sum()),
        rank_disagreement={float(k): float(np.mean(channel_rank(h, k) != channel_rank(reference.h, k))) for k in ks},
    )


def extra_rows(replay: Replay, reference: Replay, chosen: IntArray) -> IntArray:
    """Return the paths of a replay that the reference, which has only the poses ``chosen``, does not have."""
    rows, ours = _of_chosen(replay.paths, chosen)
    keys, theirs = _keyed(ours, replay.faces, reference.paths, reference.faces)
    known = set(theirs)
    return rows[np.array([key not in known for key in keys], dtype=np.bool_)]


def _of_chosen(paths: PathSet, chosen: IntArray) -> tuple[IntArray, PathSet]:
    """Return the rows of the paths at the poses ``chosen``, and these paths with poses numbered as in ``chosen``."""
    place = np.full(int(max(chosen.max(initial=-1), paths.pose.max(initial=-1))) + 1, -1, dtype=np.int64)
    place[chosen] = np.arange(len(chosen))
    rows = np.flatnonzero(place[paths.pose] >= 0)
    return rows, replace(paths.select(rows), pose=place[paths.pose[rows]])


def _keyed(ours: PathSet, our_faces: Faces, theirs: PathSet, their_faces: Faces) -> tuple[list[_Key], list[_Key]]:
    """Return pose, tower and planes of each path of two sets. Coplanar faces are the same mirror."""
    # number the planes of both sets together, because each replay numbers terrain planes in the order of its own poses
    plane = planes_of(joined(our_faces, their_faces))
    return plane_keys(ours, plane[: len(our_faces)]), plane_keys(theirs, plane[len(our_faces) :])


# Pose, tower and planes of a path.
_Key = tuple[int, ...]

"""The composition of the paths of one link, term by term, and reasons why other paths do not exist.

The level of a path is the mean of its power over element pairs. Each term belongs to a step (tower's antenna,
reflections, spreading, UAV's antenna, polarisation) and is the ratio [dB] of the mean power after the step to the mean
power before it. The terms therefore add up to the level for any arrays. With a single element at each end, the terms
are the gains and losses of textbooks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...common.geodesy import bearing_deg, elevation_rad
from ...common.jsonable import fields_of, json_safe
from ...common.units import (
    SPEED_OF_LIGHT_MPS,
    AnyArray,
    FloatArray,
    IntArray,
    db_from_amplitude,
    db_from_power,
    power_from_db,
    wavelength_m,
)
from ..field.fresnel import coefficients, face_table
from ..field.sum import Elements, amplitudes, geometry, pattern_ends
from ..geometry import Faces, Link, PathSet, Poses, Surfaces
from ..replay import Replay
from ..search.mirror import Occlusion, retraced, scene_tolerance_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Bounce:
    """One reflection of a path.

    ``te_db`` and ``tm_db`` are the magnitudes of the reflection coefficients, and ``loss_db`` is the loss of power.
    ``incidence_deg`` is measured from the normal.
    """

    face: str
    material: str
    east_m: float
    north_m: float
    up_m: float
    incidence_deg: float
    te_db: float
    tm_db: float
    loss_db: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ExplainedPath:
    """One path with its geometry, losses and level.

    Azimuths are clockwise from north. ``arrival`` is the direction from the UAV to the last reflection or the tower.
    ``level_dbm`` is the sum of ``terms_db`` and the transmit power. ``phase_deg`` is the phase of the first element
    pair.
    """

    depth: int
    bounces: tuple[Bounce, ...]
    segments_m: tuple[float, ...]
    length_m: float
    delay_ns: float
    departure_azimuth_deg: float
    departure_elevation_deg: float
    arrival_azimuth_deg: float
    arrival_elevation_deg: float
    terms_db: dict[str, float]
    level_dbm: float
    phase_deg: float
    planes: tuple[int, ...] = ()

    @property
    def words(self) -> str:
        """Names of the faces at which the path is reflected, from tower to UAV."""
        return ", ".join(bounce.face for bounce in self.bounces) or "line of sight"

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON. Infinite values (no field at all) become None."""
        return {"path": self.words, **json_safe({k: v for k, v in fields_of(self).items() if k != "planes"})}


def explain_paths(
    paths: PathSet, faces: Faces, source_m: FloatArray, poses: Poses, link: Link, further_db: dict[str, FloatArray]
) -> tuple[ExplainedPath, ...]:
    """Return the paths of one link, strongest first.

    Parameters
    ----------
    paths : PathSet
        The paths of one pose and one tower.
    faces : Faces
    source_m : (3,)
    poses : Poses
        The pose, as the only row.
    link : Link
        The link with only that tower.
    further_db : dict of str to (paths,)
        Positive losses [dB] by name, in addition to the losses that the field includes.

    Returns
    -------
    tuple of ExplainedPath
    """
    elements, wavelength = Elements.of(link), wavelength_m(link.carrier_hz)
    table = face_table(faces, link.carrier_hz)
    explained = []
    for row in range(len(paths)):
        recorded: list[tuple[str, AnyArray]] = []
        single = paths.select(np.array([row]))
        # the link has only this tower, so the number of the tower is 0 here
        columns = geometry(replace(single, tower=np.zeros(1, np.int64)), faces, table, source_m[None], poses, link)
        ends = pattern_ends(columns, elements, link)
        field = amplitudes(columns, elements, ends, wavelength, lambda *step: recorded.append(step))  # noqa: B023
        further = {name: float(loss[row]) for name, loss in further_db.items()}
        explained.append(_explained(single, faces, source_m, poses.position_m[0], link, recorded, field[0], further))
    return tuple(sorted(explained, key=lambda path: -path.level_dbm))


def further_path_lines(replay: Replay, source_m: FloatArray, poses: Poses, link: Link) -> list[str]:
    """Describe the further kinds of paths of one link, strongest first, with their levels before foliage.

    Parameters
    ----------
    replay : Replay
    source_m : (3,)
    poses : Poses
        The pose.
    link : Link
        Link with that tower only.

    Returns
    -------
    list of str
    """
    lines = []
    for some in replay.further:
        power = some.fields(replay.faces, source_m[None], poses, link).path_power
        level, words = link.transmit_power_dbm + db_from_power(power), some.words(replay.faces)
        lines += [f"path {some.kind} {level[row]:.2f} dBm: {words[row]}" for row in np.argsort(-level, kind="stable")]
    return lines


def _explained(
    path: PathSet,
    faces: Faces,
    source_m: FloatArray,
    target_m: FloatArray,
    link: Link,
    recorded: list[tuple[str, AnyArray]],
    field: AnyArray,
    further_db: dict[str, float],
) -> ExplainedPath:
    waves = [value for name, value in recorded if name == "wave"]
    spreading = next(value for name, value in recorded if name == "spreading") ** 2
    uav = next(value for name, value in recorded if name == "uav")
    # spreading and the UAV's pattern multiply the power. The remaining ratio to the received power is the polarisation
    # term.
    powers = [*waves, waves[-1] * spreading, waves[-1] * spreading * uav, np.abs(field) ** 2]
    mean = np.array([1.0, *(float(power.mean()) for power in powers)])
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = db_from_power(mean[1:]) - db_from_power(mean[:-1])
    # after a step to zero power, later steps are 0 dB, where 0 / 0 would be NaN
    steps = np.where(mean[1:] > 0.0, steps, np.where(mean[:-1] > 0.0, -np.inf, 0.0))
    depth = int(path.depth[0])
    names = [
        "tower antenna",
        *(f"reflection {i + 1}" for i in range(depth)),
        "spreading",
        "UAV antenna",
        "polarisation",
    ]
    terms = {name: float(step) + 0.0 for name, step in zip(names, np.round(steps, 12), strict=True)}  # avoid -0.0
    terms |= {name: 0.0 - loss for name, loss in further_db.items()}
    corners = np.concatenate([source_m[None], path.vertices_m[0, :depth], target_m[None]])
    legs = np.diff(corners, axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    # both directions point away from the ends
    departure, arrival = legs[0], -legs[-1]
    bounces = tuple(
        _bounce(faces, int(path.faces[0, i]), corners[i + 1], legs[i], link, terms[f"reflection {i + 1}"])
        for i in range(depth)
    )
    return ExplainedPath(
        depth=depth,
        bounces=bounces,
        segments_m=tuple(lengths.tolist()),
        length_m=float(lengths.sum()),
        delay_ns=1e9 * float(lengths.sum()) / SPEED_OF_LIGHT_MPS,
        departure_azimuth_deg=float(bearing_deg(departure) % 360.0),
        departure_elevation_deg=float(np.degrees(elevation_rad(departure))),
        arrival_azimuth_deg=float(bearing_deg(arrival) % 360.0),
        arrival_elevation_deg=float(np.degrees(elevation_rad(arrival))),
        terms_db=terms,
        level_dbm=link.transmit_power_dbm + sum(terms.values()),
        phase_deg=float(np.degrees(np.angle(field[0]))),
        planes=tuple(path.faces[0, :depth].tolist()),
    )


def _bounce(faces: Faces, face: int, point: FloatArray, leg: FloatArray, link: Link, loss_db: float) -> Bounce:
    cosine = float(abs(faces.normal[face] @ leg) / np.linalg.norm(leg))
    te, tm = coefficients(np.array(cosine), face_table(faces, link.carrier_hz)[face])
    return Bounce(
        face=faces.label[face],
        material=faces.material[face],
        east_m=float(point[0]),
        north_m=float(point[1]),
        up_m=float(point[2]),
        # rounding can make the cosine at normal incidence larger than 1
        incidence_deg=float(np.degrees(np.arccos(min(cosine, 1.0)))),
        te_db=float(db_from_amplitude(abs(te))),
        tm_db=float(db_from_amplitude(abs(tm))),
        loss_db=-loss_db,
    )


def power_sum_dbm(paths: tuple[ExplainedPath, ...]) -> float:
    """Return the level of the sum of the paths' powers [dBm]."""
    return float(db_from_power(sum(float(power_from_db(path.level_dbm)) for path in paths)))


# ---------------------------------------------------------------- why not


def why_not(
    faces: Faces, source_m: FloatArray, target_m: FloatArray, sequence: IntArray, surfaces: Surfaces | None = None
) -> str:
    """Return the reason why there is no path over faces (depth,) between two points, or "" if there is a path.

    Parameters
    ----------
    faces : Faces
    source_m, target_m : (3,)
        The two points [m].
    sequence : (depth,) int
        Faces in order from the source. -1 is an empty entry.
    surfaces : Surfaces, optional
        The triangles, if the site is a scene of triangles.

    Returns
    -------
    str
        The reason, for the first condition of a path that is not met.
    """
    if surfaces is not None:
        return _why_not_there(surfaces, source_m, target_m, sequence)
    sequence = sequence[sequence >= 0]
    tolerance = scene_tolerance_m(faces, source_m[None], target_m[None])
    # reflect at unbounded planes, so that the message can state by how many metres a point misses its face
    planes = Faces(faces.normal, faces.offset_m, faces.material, faces.label)
    points, ahead = retraced(planes, sequence[None], source_m[None], target_m[None], tolerance)
    if not ahead[0]:
        return "an end or an image lies behind a face: it has no reflection point"
    for step, face in enumerate(sequence):
        far = _outside_m(faces, int(face), points[0, step])
        # stop at the first missed face, because later points follow from this point and would mislead
        if far > tolerance:
            return f"its reflection point lies {_metres(far)} outside {faces.label[face]}"
    corners = np.concatenate([source_m[None], points[0], target_m[None]])
    # test building by building, to name the building that blocks the path
    for solid in np.unique(faces.solid[faces.solid >= 0]):
        members = np.flatnonzero(faces.solid == solid)
        if Occlusion(faces.select(members), tolerance).segments(corners[:-1], corners[1:]).any():
            return f"occluded by {faces.label[members[0]].rsplit(' wall', 1)[0].rsplit(' roof', 1)[0]}"
    if Occlusion(faces, tolerance).segments(corners[:-1], corners[1:]).any():
        return "occluded by buildings that touch"
    return ""


def _why_not_there(surfaces: Surfaces, source_m: FloatArray, target_m: FloatArray, sequence: IntArray) -> str:
    """Return the same as :func:`why_not` for a scene of triangles, by the rules of its search."""
    # this is compiled code, which is loaded only for a scene of triangles
    from ..search.beams import EDGE_M, obstacle, reflection_points

    sequence = sequence[sequence >= 0]
    points = np.zeros((0, 3))
    if len(sequence):
        ends = source_m[None], target_m[None]
        # first check the sides, with faces of any size. Then check whether the points are in their faces.
        _, _, ahead = reflection_points(surfaces, sequence[None], *ends, edge_m=1e9)
        if not ahead[0]:
            return "the ends of a reflection are on different sides of its face"
        _, vertices, good = reflection_points(surfaces, sequence[None], *ends, edge_m=EDGE_M)
        if not good[0]:
            return f"a reflection point lies outside {surfaces.faces.label[int(sequence[0])]} or a later face"
        points = vertices[0]
    face = obstacle(surfaces, np.concatenate([source_m[None], points, target_m[None]]), sequence)
    return "" if face is None else f"occluded by {surfaces.faces.label[face]}"


def _metres(length: float) -> str:
    # a miss below a centimetre must not be shown as 0.00 m
    return f"{length:.2f} m" if length >= 0.01 else f"{length:.1e} m"


def _outside_m(faces: Faces, face: int, point: FloatArray) -> float:
    """Return the distance of a point from a face, in the face's plane [m]. 0 if it lies inside."""
    import shapely

    place = np.array([faces.along[face] @ point, faces.across[face] @ point])
    polygon = faces.polygon[face]
    if polygon is not None:
        return float(polygon.distance(shapely.Point(*place)))
    return float(np.linalg.norm(place - np.clip(place, faces.lower[face], faces.upper[face])))


def simple_paths(replay: Replay) -> list[tuple[str, IntArray]]:
    """Return the simplest paths by name: the line of sight and the reflection at each ground of the scene."""
    # use only infinite planes, because planes of terrain are bounded and valid only for one link
    grounds = np.flatnonzero((replay.faces.solid < 0) & np.isinf(replay.faces.lower).all(axis=1))
    return [
        ("line of sight", np.zeros(0, dtype=np.int64)),
        *((f"reflection at the {replay.faces.label[g]}", np.array([g])) for g in grounds),
    ]

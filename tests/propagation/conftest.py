import itertools
from dataclasses import dataclass

import numpy as np
import pytest
import shapely
from shapely import affinity
from shapely.geometry import LineString, box

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.propagation.geometry import Link, Poses, single_element
from aerpaw_cmp.site.site import Building, Site, Tower

CARRIER_HZ = 3.4e9


def make_site(buildings=(), towers=((0.0, 0.0, 10.0),), **settings):
    named = {f"LW{i + 1}": Tower(f"LW{i + 1}", 35.7, -78.7, *t) for i, t in enumerate(towers)}
    return Site("test site", SiteFrame(35.7275, -78.696), named, tuple(buildings), **settings)


def random_buildings(rng, count, *, spread_m=150.0, clear_m=20.0, holes=False):
    buildings = []
    while len(buildings) < count:
        east, north = rng.uniform(-spread_m, spread_m, 2)
        half = rng.uniform(5, 15, 2)
        shape = box(east - half[0], north - half[1], east + half[0], north + half[1])
        if holes and rng.random() < 0.5:
            shape = shape.difference(
                box(east - half[0] / 2, north - half[1] / 2, east + half[0] / 3, north + half[1] / 3)
            )
        elif rng.random() < 0.4:  # L shape
            shape = shape.difference(box(east, north, east + 99, north + 99))
        shape = affinity.rotate(shape, rng.uniform(0, 180))
        if shape.distance(shapely.Point(0, 0)) < clear_m or any(shape.distance(b.footprint) < 2 for b in buildings):
            continue
        buildings.append(Building(f"b{len(buildings)}", shape, float(rng.uniform(4, 14))))
    return tuple(buildings)


def make_poses(position_m, rotation=None):
    position = np.atleast_2d(np.asarray(position_m, dtype=float))
    turn = np.tile(np.eye(3), (len(position), 1, 1)) if rotation is None else rotation
    return Poses(position, turn)


def make_link(site, tower_array=None, uav_array=None, **settings):
    tower = tower_array or single_element()
    return Link(CARRIER_HZ, dict.fromkeys(site.towers, tower), uav_array or single_element(), **settings)


def path_keys(paths):
    return {tuple(row) for row in np.column_stack([paths.pose, paths.tower, paths.faces]).tolist()}


def _covered(site, start, end, tolerance=1e-7):
    """Check whether a segment passes through a building, by 2-D intersection of its shadow instead of faces."""
    start, end = np.asarray(start), np.asarray(end)
    shadow = LineString([start[:2], end[:2]])
    length = shadow.length
    for building in site.buildings:
        if length < 1e-12:
            if building.footprint.contains(shapely.Point(start[:2])) and min(start[2], end[2]) < building.height_m:
                return True
            continue
        pieces = shapely.get_parts(shadow.intersection(building.footprint.buffer(-tolerance)))
        for piece in pieces:
            if piece.geom_type != "LineString" or piece.length < tolerance:
                continue
            shares = [shadow.project(shapely.Point(c)) / length for c in piece.coords]
            heights = [start[2] + s * (end[2] - start[2]) for s in shares]
            if min(heights) < building.base_m + building.height_m - tolerance:
                return True
    return False


def _on_face(faces, index, point):
    a, b = faces.along[index] @ point, faces.across[index] @ point
    polygon = faces.polygon[index]
    if polygon is not None:
        return bool(polygon.covers(shapely.Point(a, b)))
    (la, lb), (ha, hb) = faces.lower[index], faces.upper[index]
    return bool(la <= a <= ha and lb <= b <= hb)


def brute_force(site, faces, source, target, max_depth):
    """Try every face sequence of one link, and return the valid sequences as tuples."""
    sequences = set()
    for depth in range(max_depth + 1):
        for sequence in itertools.product(range(len(faces)), repeat=depth):
            if any(a == b for a, b in itertools.pairwise(sequence)):
                continue
            images = [np.asarray(source, dtype=float)]
            for face in sequence:
                n, d = faces.normal[face], faces.offset_m[face]
                images.append(images[-1] - 2 * (n @ images[-1] - d) * n)
            points = [np.asarray(target, dtype=float)]
            for face, image in zip(sequence[::-1], images[:0:-1], strict=True):
                n, d = faces.normal[face], faces.offset_m[face]
                step = points[0] - image
                if abs(n @ step) < 1e-12:
                    break
                share = (d - n @ image) / (n @ step)
                point = image + share * step
                if not 0 < share < 1 or not _on_face(faces, face, point):
                    break
                points.insert(0, point)
            else:
                points.insert(0, images[0])
                # both neighbours of a reflection point lie in front of its face
                sides = [
                    faces.normal[f] @ p - faces.offset_m[f] > 1e-9
                    for k, f in enumerate(sequence)
                    for p in (points[k], points[k + 2])
                ]
                if all(sides) and not any(_covered(site, a, b) for a, b in itertools.pairwise(points)):
                    sequences.add(sequence + (-1,) * (max_depth - depth))
    return sequences


@dataclass(frozen=True)
class Helpers:
    site = staticmethod(make_site)
    buildings = staticmethod(random_buildings)
    poses = staticmethod(make_poses)
    link = staticmethod(make_link)
    keys = staticmethod(path_keys)
    brute_force = staticmethod(brute_force)
    covered = staticmethod(_covered)
    on_face = staticmethod(_on_face)
    carrier_hz = CARRIER_HZ


@pytest.fixture(scope="session")
def scenes():
    return Helpers()

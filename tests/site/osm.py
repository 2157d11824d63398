"""Squares on the ground, and a small writer of OpenStreetMap data."""

from collections.abc import Sequence

import numpy as np

from aerpaw_cmp.common.geodesy import SiteFrame

FRAME = SiteFrame(35.7275, -78.696)
Ring = Sequence[Sequence[float]]


def square(east: float, north: float, size: float = 20.0) -> Ring:
    return [(east, north), (east + size, north), (east + size, north + size), (east, north + size)]


def lonlat(ring: Ring, frame: SiteFrame = FRAME) -> Ring:
    latitude, longitude = frame.to_geographic(*np.array([*ring, ring[0]]).T)
    return [[float(x), float(y)] for x, y in zip(longitude, latitude, strict=True)]


class Osm:
    """Nodes, ways and relations, of which XML is written."""

    def __init__(self) -> None:
        self.nodes: list[tuple[int, float, float, dict[str, str]]] = []
        self.ways: list[tuple[int, list[int], dict[str, str]]] = []
        self.relations: list[tuple[list[tuple[int, str]], dict[str, str]]] = []

    def node(self, lon: float, lat: float, **tags: str) -> int:
        self.nodes.append((len(self.nodes) + 1, lat, lon, tags))
        return len(self.nodes)

    def way(self, ring: Ring, **tags: str) -> int:
        ids = [self.node(*point) for point in ring[:-1]]
        return self.line([*ids, ids[0]], **tags)

    def line(self, nodes: list[int], **tags: str) -> int:
        self.ways.append((100 + len(self.ways), nodes, tags))
        return self.ways[-1][0]

    def relation(self, members: list[tuple[int, str]], **tags: str) -> None:
        self.relations.append((members, tags))

    def xml(self, *, drop: tuple[int, ...] = (), root: str = '<osm version="0.6">') -> str:
        def words(tags: dict[str, str]) -> str:
            return "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())

        lines = ['<?xml version="1.0"?>', root]
        for i, lat, lon, tags in self.nodes:
            if i not in drop:
                lines.append(f'<node id="{i}" lat="{lat!r}" lon="{lon!r}">{words(tags)}</node>')
        for i, refs, tags in self.ways:
            lines.append(f'<way id="{i}">' + "".join(f'<nd ref="{r}"/>' for r in refs) + words(tags) + "</way>")
        for n, (members, tags) in enumerate(self.relations):
            listed = "".join(f'<member type="way" ref="{r}" role="{role}"/>' for r, role in members)
            lines.append(f'<relation id="{n}">{listed}{words(tags)}</relation>')
        return "\n".join([*lines, "</osm>"])

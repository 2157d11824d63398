"""The flown lines and the towers as GPX 1.1."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...site.heights import HeightReference
from .samples import Export, Line, iso_text, latitude_longitude, xml_text

_HEAD = (
    '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="aerpaw-cmp" '
    'xmlns="http://www.topografix.com/GPX/1/1" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
    'xsi:schemaLocation="http://www.topografix.com/GPX/1/1 http://www.topografix.com/GPX/1/1/gpx.xsd">\n'
)


def write_gpx(export: Export, folder: Path) -> list[Path]:
    """``track.gpx``: one track per flight, broken where the position is unknown; towers as waypoints."""
    base_m, words = _elevation(export)
    said = " ".join([words, *export.remarks])
    path = folder / "track.gpx"
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(_HEAD)
        stream.write(f"<metadata><name>{xml_text(export.title)}</name><desc>{xml_text(said)}</desc></metadata>\n")
        for tower in export.site.towers.values():
            latitude, longitude = latitude_longitude(
                export.site.frame, np.array([tower.east_m]), np.array([tower.north_m])
            )
            stream.write(
                f'<wpt lat="{latitude[0]:.8f}" lon="{longitude[0]:.8f}"><ele>{base_m + tower.position_m[2]:.3f}</ele>'
                f"<name>{xml_text(tower.name)}</name></wpt>\n"
            )
        for line in export.lines:
            stream.write(f"<trk><name>{xml_text(line.flight)}</name><desc>{xml_text(words)}</desc>\n")
            stream.writelines(_segments(export, line, base_m))
            stream.write("</trk>\n")
        stream.write("</gpx>\n")
    return [path]


def _elevation(export: Export) -> tuple[float, str]:
    """What is added to up for ``ele``, and what ``ele`` then is."""
    ground = export.site.datum.origin_ground
    if ground is not None and ground.reference is HeightReference.ORTHOMETRIC:
        return ground.value_m, "ele is metres above mean sea level."
    return 0.0, "ele is metres above the ground at the site origin: the site does not say how high that lies."


def _segments(export: Export, line: Line, base_m: float) -> list[str]:
    known = np.isfinite(line.east_m) & np.isfinite(line.north_m)
    latitude, longitude = latitude_longitude(export.site.frame, line.east_m, line.north_m)
    times = iso_text(line.time) if export.clock else [""] * len(line.time)
    out, inside = [], False
    for i in range(len(known)):
        if bool(known[i]) != inside:
            out.append("</trkseg>\n" if inside else "<trkseg>\n")
            inside = not inside
        if known[i]:
            up = line.up_m[i]
            height = f"<ele>{base_m + up:.3f}</ele>" if np.isfinite(up) else ""
            time = f"<time>{times[i]}</time>" if times[i] else ""
            out.append(f'<trkpt lat="{latitude[i]:.8f}" lon="{longitude[i]:.8f}">{height}{time}</trkpt>\n')
    if inside:
        out.append("</trkseg>\n")
    return out

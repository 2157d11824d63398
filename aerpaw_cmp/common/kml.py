"""Reading of third-party KML and writing of KMZ: coordinates, placemarks, lines, legends and the archive.

Logs in KML are read line by line with regular expressions (:data:`DATA`, :data:`POINT`), because each line has to be
counted, even in a truncated file. Maps and routes are read as XML.

Third-party XML files are refused if parsing them could use unlimited memory or read other files.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Iterator, Mapping
from html import escape  # the escape function of xml.sax would load OpenSSL
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from .errors import InputError, one_line
from .units import FloatArray


def xml_root(data: bytes, path: Path | None, expected: str) -> ElementTree.Element:
    """Return the root element of an XML text. Tags keep their prefix, which :func:`plain_tag` removes.

    Raises
    ------
    InputError
        If the text is not XML (the message contains the line), contains entities, or is not UTF-8.
    """
    # UTF-16 would hide entities from this check
    if data[:2] in (b"\xff\xfe", b"\xfe\xff") or b"<!DOCTYPE" in data or b"<!ENTITY" in data or b"\0" in data:
        raise InputError("the XML declares entities, or is not UTF-8", expected=expected, path=path)
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()  # accepts the common gx:Track without xmlns:gx
    # request the text of an element in one piece, because expat otherwise returns it line by line
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler, parser.CharacterDataHandler = builder.end, builder.data
    try:
        parser.Parse(data, True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError) as error:
        line = error.lineno if isinstance(error, expat.ExpatError) else None
        why = str(error).split(": line")[0]
        cut = "unclosed" in why or "no element" in why
        cause = "the file was cut off" if cut else "characters that are not UTF-8, or a '<' or '&' that is not escaped"
        raise InputError(f"not XML: {why}", cause=cause, path=path, line=line) from None


def plain_tag(tag: str) -> str:
    """Return a tag without its namespace prefix."""
    return tag.rpartition(":")[2]


def named(root: ElementTree.Element, name: str) -> Iterator[ElementTree.Element]:
    """Yield all elements with a name, in document order."""
    return (element for element in root.iter() if plain_tag(element.tag) == name)


def outermost(root: ElementTree.Element, names: set[str]) -> Iterator[ElementTree.Element]:
    """Yield elements below a root with one of the names, in order. Do not search inside these elements.

    Map formats do not nest these elements. If a file nested them, the inner elements would otherwise be searched again
    at each level.
    """
    walk = list(reversed(root))
    while walk:
        element = walk.pop()
        if plain_tag(element.tag) in names:
            yield element
        else:
            walk += reversed(element)


# Resolution of legends [dots per inch].
_DPI = 110

# --- reading -------------------------------------------------------------------------------------------------------

# A named value and the first position of a shape, on a line of a log. The numbers of repetitions are bounded: a
# third-party line may be megabytes long, and unbounded repetitions would search the complete line from each possible
# start.
DATA = re.compile(rb'<Data name="([A-Za-z][A-Za-z0-9 _-]{0,39})">\s{0,40}<value>([^<]{0,200})</value>')
_DECIMAL = rb"([-+]?[\d.]{1,20})"
POINT = re.compile(rb"<coordinates>\s{0,40}%b,\s?%b(?:,\s?%b)?" % (_DECIMAL, _DECIMAL, _DECIMAL))


def is_kml(head: bytes) -> bool:
    """Check whether a file begins with KML."""
    # search the beginning, because an XML declaration, comments and a licence may come before the tag
    return b"<kml" in head[:2048]


def data_of(parts: Iterator[ElementTree.Element]) -> dict[str, str]:
    """Return names and values of ``Data`` and ``SimpleData`` among elements."""
    tags = {}
    for part in parts:
        if plain_tag(part.tag) == "Data":
            tags[part.get("name", "")] = next((str(v.text or "") for v in named(part, "value")), "")
        elif plain_tag(part.tag) == "SimpleData":
            tags[part.get("name", "")] = str(part.text or "")
    return tags


def modes_of(shape: ElementTree.Element) -> set[str]:
    """Return the altitude modes below an element: ``relativeToGround``, ``absolute``, ``clampToGround``."""
    return {str(mode.text or "").strip() for mode in named(shape, "altitudeMode")}


def places_of(shape: ElementTree.Element) -> list[tuple[float, ...]]:
    """Return longitude, latitude [deg] and, if present, height [m] of each position below an element.

    Numbers separated only by commas are read as triples, as in Google Earth.

    Raises
    ------
    InputError
        If a coordinate is not a number or has no partner, or numbers separated by commas are not triples of one area.
    """
    if plain_tag(shape.tag) == "Track":
        cells = [str(place.text or "").split() for place in named(shape, "coord")]
    else:
        texts = " ".join(str(places.text or "") for places in named(shape, "coordinates"))
        # accept a space after the comma in 'longitude, latitude', which is common and not ambiguous
        cells = [place.split(",") for place in re.sub(r"\s*,\s*", ",", texts).split()]
    try:
        places = [tuple(float(cell) for cell in place) for place in cells]
    except ValueError as error:
        raise InputError(
            f"a coordinate that is not a number ({error})", expected="longitude,latitude,altitude"
        ) from error
    if any(len(place) < 2 for place in places):
        raise InputError("a coordinate without latitude", expected="longitude,latitude,altitude")
    return [part for place in places for part in ([place] if len(place) <= 3 else _triples(place))]


# Largest difference of longitudes, and of latitudes, within one area [deg]. A longitude and a latitude usually differ
# by more, which shows that numbers are grouped wrongly.
_AREA_DEG = 5.0


def _triples(numbers: tuple[float, ...]) -> list[tuple[float, ...]]:
    """Return positions from numbers that are separated by commas only."""
    threes = [numbers[i : i + 3] for i in range(0, len(numbers), 3)]
    if len(numbers) % 3 or any(max(column) - min(column) > _AREA_DEG for column in list(zip(*threes, strict=True))[:2]):
        raise InputError(
            f"{len(numbers)} numbers separated only by commas, which are not triples longitude,latitude,altitude",
            expected="a space between positions",
        )
    return threes


# --- writing -------------------------------------------------------------------------------------------------------

# Colours of the classes: grey for out of coverage, then ranks 1 to 4 from dark to light (viridis), then spare colours.
CLASS_COLOURS = ("#9e9e9e", "#440154", "#31688e", "#35b779", "#fde725", "#e66101", "#b2182b")
# Date of all entries of an archive. The date is fixed, so that the same content always produces the same bytes.
_DATE = (1980, 1, 1, 0, 0, 0)


def xml_text(text: str) -> str:
    """Return text for an XML element or attribute. Characters that XML does not allow are escaped."""
    return escape(one_line(text), quote=False).replace('"', "&quot;")


def coordinates(longitude: FloatArray, latitude: FloatArray, up_m: FloatArray | float = 0.0) -> list[str]:
    """Return positions (n,) in KML format. Negative or unknown heights become 0."""
    up = np.broadcast_to(np.maximum(np.nan_to_num(up_m), 0.0), np.shape(longitude))
    # seven decimals, because 1e-7 degree is a centimetre
    return [f"{a:.7f},{b:.7f},{h:.1f}" for a, b, h in zip(longitude, latitude, up, strict=True)]


def mark(name: str, at: str, *, in_the_air: bool = False) -> str:
    """Return a placemark with a name. A point in the air is drawn at its height, with a line down to the ground."""
    height = "<extrude>1</extrude><altitudeMode>relativeToGround</altitudeMode>" if in_the_air else ""
    point = f"<Point>{height}<coordinates>{at}</coordinates></Point>"
    return f"<Placemark><name>{xml_text(name)}</name>{point}</Placemark>"


def line(name: str, at: list[str], shape: str, *, style: str = "", head: str = "") -> str:
    """Return a named line through positions.

    Parameters
    ----------
    name : str
    at : list of str
        Positions in the format of :func:`coordinates`.
    shape : str
        KML before the coordinates.
    style, head : str
        KML before the line.

    Returns
    -------
    str
        KML.
    """
    return (
        f"<Placemark><name>{xml_text(name)}</name>{head}{style}<LineString>{shape}"
        f"<coordinates>{' '.join(at)}</coordinates></LineString></Placemark>"
    )


def line_style(colour: str, width: int) -> str:
    """Return a line style. KML writes a colour as alpha, blue, green, red."""
    return f"<Style><LineStyle><color>{colour}</color><width>{width}</width></LineStyle></Style>"


def folder(name: str, legend: str, content: str, *, visible: bool) -> str:
    """Return a folder that can be switched on and off, with a legend in a corner of the screen.

    Parameters
    ----------
    name : str
    legend : str
        Name of the picture in the archive.
    content : str
        KML elements.
    visible : bool
        True if the folder is switched on when the file is opened.

    Returns
    -------
    str
        KML.
    """
    shown = int(visible)
    return (
        f"<Folder><name>{xml_text(name)}</name><visibility>{shown}</visibility>"
        f"<ScreenOverlay><name>legend</name><visibility>{shown}</visibility><Icon><href>{legend}</href></Icon>"
        '<overlayXY x="0" y="1" xunits="fraction" yunits="fraction"/>'
        '<screenXY x="0.01" y="0.97" xunits="fraction" yunits="fraction"/>'
        f'<size x="0" y="0" xunits="pixels" yunits="pixels"/></ScreenOverlay>{content}</Folder>'
    )


def write_archive(path: Path, title: str, description: str, body: str, pictures: Mapping[str, bytes]) -> Path:
    """Write a KMZ file: the document and its pictures by name.

    Parameters
    ----------
    path : Path
    title, description : str
        Title and description of the document.
    body : str
        KML elements.
    pictures : mapping of str to bytes

    Returns
    -------
    Path
        The file.
    """
    described = f"<description>{xml_text(description)}</description>" if description else ""
    document = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2" '
        'xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>'
        f"<name>{xml_text(title)}</name><open>1</open>{described}{body}</Document></kml>\n"
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {"doc.kml": document.encode(), **pictures}.items():
            # create the entry here, because writestr would add the current time
            entry = zipfile.ZipInfo(name, _DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, content)
    return path


def list_legend(title: str, colours: Mapping[str, str], width: float = 2.6) -> bytes:
    """Return a legend of labelled colours as a PNG image, ``width`` inches wide."""
    import matplotlib
    from PIL import Image, ImageDraw, ImageFont

    # draw with PIL, because a matplotlib figure would take 0.1 s; the background is partly transparent, so that the map
    # stays visible
    size = round(width * _DPI), round((0.38 + 0.155 * len(colours)) * _DPI)
    picture = Image.new("RGBA", size, (255, 255, 255, 230))
    pen = ImageDraw.Draw(picture)
    font = ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", 12)
    pen.text((picture.width / 2, 4), title, fill="black", font=font, anchor="ma")
    for number, (label, colour) in enumerate(colours.items()):
        top = round((0.28 + 0.155 * number) * _DPI)
        pen.rectangle((6, top + 3, 28, top + 12), fill=colour)
        pen.text((38, top), label, fill="black", font=font)
    buffer = io.BytesIO()
    picture.save(buffer, "PNG")
    return buffer.getvalue()

"""Meaning of the tags of map data: what stands there, how high, of what. OpenStreetMap's words."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Literal

from ..materials import MATERIALS

_FOOT_M = 0.3048

Kind = Literal["building", "forest", "geofence"]

_FOREST_TAGS = (("landuse", "forest"), ("natural", "wood"), ("landcover", "trees"))
_NOT = ("no", "", "none", "false", "0")
_UNITS_M = {"m": 1.0, "cm": 0.01, "km": 1000.0, "ft": _FOOT_M}
_UNIT_WORDS = {"metre": "m", "meter": "m", "foot": "ft", "feet": "ft"}
# OSM's words for what P.2040 has under another name, or nearly.
_MATERIAL_WORDS = {
    "steel": "metal",
    "aluminium": "metal",
    "sheet": "metal",
    "stone": "marble",
    "timber_framing": "wood",
}


def kind_of(tags: Mapping[str, str]) -> Kind | None:
    """Kind of an area, or None when its tags do not say.

    Examples
    --------
    >>> kind_of({"building": "barn"}), kind_of({"landuse": "forest"}), kind_of({"building": "no"})
    ('building', 'forest', None)
    """
    tags = {key.lower(): value.lower() for key, value in tags.items()}
    if is_part(tags) or tags.get("building", "no") not in _NOT:
        return "building"
    if any(tags.get(key) == value for key, value in _FOREST_TAGS):
        return "forest"
    # not OSM's: keys of our own exports and of hand-made GeoJSON
    word = tags.get("kind", tags.get("type", ""))
    for kind in ("building", "forest", "geofence"):
        if word == kind or (kind == "geofence" and kind in tags):
            return kind  # type: ignore[return-value]
    return None


def is_part(tags: Mapping[str, str]) -> bool:
    """Check whether an area is a part of a building that has its own outline."""
    return tags.get("building:part", "no").lower() not in _NOT


def below_ground(tags: Mapping[str, str]) -> bool:
    """Check whether nothing of a building stands above the ground.

    Examples
    --------
    >>> below_ground({"building": "yes", "location": "underground"})
    True
    >>> below_ground({"building": "yes", "building:levels": "0", "building:levels:underground": "3"})
    True
    """
    if "underground" in (tags.get("location", "").lower(), tags.get("parking", "").lower()):
        return True
    # below zero things lie under others
    layer = _number(tags.get("layer", ""))
    if tags.get("tunnel", "no").lower() not in _NOT or (layer is not None and layer < 0):
        return True
    levels, cellars = (_number(tags.get(f"building:levels{what}", "")) for what in ("", ":underground"))
    return levels is not None and levels <= 0 and bool(cellars) and not tags.get("height")


def main_tag(tags: Mapping[str, str]) -> str:
    """The tag that tells most about an area of no known kind; ``untagged`` where none says what it is.

    Examples
    --------
    >>> main_tag({"natural": "scrub"}), main_tag({"demolished:building": "yes"}), main_tag({"name": "A"})
    ('natural=scrub', 'demolished:building=yes', 'untagged')
    """
    said = [key for key in _TELLING if key in tags] + [key for key in tags if key.endswith(":building")]
    said += ["building"] if tags.get("building", "").lower() == "no" else []
    return f"{said[0]}={tags[said[0]]}" if said else "untagged"


_TELLING = ("highway", "landuse", "natural", "waterway", "leisure", "amenity", "barrier", "boundary", "man_made",
            "power", "aeroway")  # fmt: skip


def material_of(tags: Mapping[str, str]) -> str:
    """Material of the walls, by name in ``materials``."""
    word = tags.get("building:material", "").lower()
    return _MATERIAL_WORDS.get(word, word if word in MATERIALS else "concrete")


def metres(text: str) -> float | None:
    r"""Length of a tag [m], or None: ``12``, ``12 m``, ``350 cm``, ``40 ft``, ``40'``, ``39'4"``, ``12,5``.

    ``1,200`` is None: a thousand or a comma?

    Examples
    --------
    >>> metres("12 m"), round(metres("12'6\""), 2), metres("tall")
    (12.0, 3.81, None)
    """
    text = text.strip().lower()
    for typed, plain in (("\u2019", "'"), ("\u2032", "'"), ("\u201d", '"'), ("\u2033", '"'), ("''", '"')):
        text = text.replace(typed, plain)
    if re.search(r"\d,\d{3}(?!\d)", text):
        return None
    # a decimal comma, now that thousands are refused
    text = text.replace(",", ".")
    if match := re.fullmatch(r"(-?\d+(?:\.\d+)?)\s*(m|cm|km|ft|metre|meter|foot|feet)?s?\.?", text):
        unit = match.group(2) or "m"
        return float(match.group(1)) * _UNITS_M[_UNIT_WORDS.get(unit, unit)]
    if match := re.fullmatch(r"(\d+(?:\.\d+)?)\s*(?:'|ft)\s*(?:(\d+(?:\.\d+)?)\s*(?:\"|in))?", text):
        return (float(match.group(1)) + float(match.group(2) or 0) / 12) * _FOOT_M
    return None


def positive_metres(tags: Mapping[str, str], keys: tuple[str, ...], notes: list[str]) -> float | None:
    """The first usable length among some tags; a value that cannot be used is one sentence in ``notes``.

    Of several values (``8;12``) the largest holds; ``~12`` is 12.
    """
    for key in keys:
        written = tags.get(key, "").strip()
        if not written:
            continue
        # OSM joins several values by semicolons
        parts = [metres(part.strip().lstrip("~")) for part in written.split(";")]
        lengths = [value for value in parts if value is not None]
        if len(lengths) < len(parts):
            notes.append(f"the {key} '{written}' is not a length")
            continue
        # exports of databases write 0 or -1 for "unknown"
        if max(lengths) <= 0:
            notes.append(f"the {key} '{written}' is not above 0, as where nobody knows it")
            continue
        if len(lengths) > 1 or written.startswith("~"):
            notes.append(f"the {key} '{written}' is taken as {max(lengths):g} m")
        return max(lengths)
    return None


# OSM's ``roof:height`` is that of the roof alone.
_OTHER_HEIGHTS = re.compile(
    "roof:|min|base|ground|eave|ceil|level|floor|stor|sourc|method|accura|confid|varian|std|tree|canopy|veg|antenna|unit|elev"
)
_UNIT_AT_END = re.compile(
    r"(?:[^a-z]|(?<=height)|(?<=hgt)|(?<=hght)|(?<=ht))(ft|feet|foot|cm|m|met(?:er|re)s?)[^a-z]*$"
)
_FEET = re.compile(r"feet|foot|[^a-z]ft([^a-z]|$)")
_STOREYS = re.compile(r"(building)?levels|(n|num|no|noof|numberof)?(floors|stor(ey|ie|y)s)|(floor|stor(ey|y))(count|s)")


def height_of(tags: Mapping[str, str], notes: list[str]) -> float | None:
    """Height of a building [m] by any of the names that programs give it, in the unit of the name or of the value.

    Examples
    --------
    >>> [height_of({name: "40"}, []) for name in ("height", "HEIGHT_FT", "Bldg Hgt (m)", "ground_height")]
    [40.0, 12.192, 40.0, None]
    """
    names = [name for name in tags if re.search("height|hgt|hght", name.lower())]
    names = [name for name in names if not _OTHER_HEIGHTS.search(name.lower())]
    first = ("height", "building:height", "height_m", "est_height")
    # OSM's own key first; foreign columns after it, in the file's order
    for name in sorted(names, key=lambda n: first.index(n) if n in first else len(first)):
        named = _UNIT_AT_END.search(name.lower())
        unit = named[1] if named else "ft" if _FEET.search(name.lower()) else tags.get(f"{name}_unit", "")
        value = tags[name].strip()
        if unit and re.fullmatch(r"-?\d+(?:[.,]\d+)?", value):
            value = f"{value} {unit.lower()}"
        if (height := positive_metres({name: value}, (name,), notes)) is not None:
            return height
    return None


def levels_of(tags: Mapping[str, str], notes: list[str]) -> float | None:
    """Number of levels; of several (``2;3``) the largest."""
    named = (value.strip() for name, value in tags.items() if _STOREYS.fullmatch(re.sub(r"[^a-z]", "", name.lower())))
    written = next(filter(None, named), "")
    if not written:
        return None
    parts = [_number(part) for part in written.split(";")]
    numbers = [value for value in parts if value is not None]
    if len(numbers) < len(parts) or max(numbers) <= 0:
        if written != "0":  # a ground floor that some mappers do not count
            notes.append(f"the number of levels '{written}' is no positive number")
        return None
    if len(numbers) > 1:
        notes.append(f"of the levels '{written}' the largest holds")
    return max(numbers)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None

"""XML files of others, refused where they could explode or read other files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

from .errors import InputError


def xml_root(data: bytes, path: Path | None, expected: str) -> ElementTree.Element:
    """The root element of an XML text; tags keep their prefix, declared or not (:func:`plain` cuts it).

    Raises
    ------
    InputError
        No XML, with the line; entities, or another encoding than UTF-8.
    """
    # UTF-16 would hide entities from this look
    if data[:2] in (b"\xff\xfe", b"\xfe\xff") or b"<!DOCTYPE" in data or b"<!ENTITY" in data or b"\0" in data:
        raise InputError("the XML declares entities, or is not UTF-8", expected=expected, path=path)
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()  # a KML with gx:Track and no xmlns:gx is common
    # one piece of text for an element: expat hands it on line by line else
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler, parser.CharacterDataHandler = builder.end, builder.data
    try:
        parser.Parse(data, True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError) as error:
        line = error.lineno if isinstance(error, expat.ExpatError) else None
        why = str(error).split(": line")[0]
        raise InputError(f"not XML: {why}", cause="the file was cut off?", path=path, line=line) from None


def plain(tag: str) -> str:
    """A tag without its namespace's prefix."""
    return tag.rpartition(":")[2]


def named(root: ElementTree.Element, name: str) -> Iterator[ElementTree.Element]:
    """All elements of a name, in order."""
    return (element for element in root.iter() if plain(element.tag) == name)


def outermost(root: ElementTree.Element, names: set[str]) -> Iterator[ElementTree.Element]:
    """Elements below a root with one of the names, in order; nothing inside of them is looked at.

    Map formats nest none of them in itself: a file that does would be walked through once per level.
    """
    walk = list(reversed(root))
    while walk:
        element = walk.pop()
        if plain(element.tag) in names:
            yield element
        else:
            walk += reversed(element)

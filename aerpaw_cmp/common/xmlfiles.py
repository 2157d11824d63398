"""XML files of others, refused where they could explode or read other files."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from .errors import InputError


def xml_root(data: bytes, path: Path, expected: str) -> ElementTree.Element:
    """The root element of an XML text.

    Raises
    ------
    InputError
        No XML, with the line; entities, or another encoding than UTF-8.
    """
    # UTF-16 would hide entities from this look
    if data[:2] in (b"\xff\xfe", b"\xfe\xff") or b"<!DOCTYPE" in data or b"<!ENTITY" in data or b"\0" in data:
        raise InputError("the XML declares entities, or is not UTF-8", expected=expected, path=path)
    try:
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        line = error.position[0] if isinstance(error, ElementTree.ParseError) else None
        why = str(error).split(": line")[0]
        raise InputError(f"not XML: {why}", cause="the file was cut off?", path=path, line=line) from None

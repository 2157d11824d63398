"""Checked flight settings with single keys changed, in dotted form: ``rt.max_depth``, ``link.rss.tower.yaw_deg``."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

from pydantic import ValidationError

from ..common.errors import UsageError
from ..common.yamlfile import nearest
from .settings import FlightFile

Overrides = Mapping[str, Any]


def overridden(settings: FlightFile, overrides: Overrides) -> FlightFile:
    """Checked flight settings with dotted keys changed.

    A channel that ``link.channels`` does not name starts as a copy of ``link.rss``; a tower that ``towers`` does not
    name as a copy of ``tower``.

    Raises
    ------
    UsageError
        A key that flight files do not have (the nearest one is named), a value of the wrong kind.
    """
    if not overrides:
        return settings
    plain = settings.model_dump(mode="python")
    # what copies are made of comes first, so that they have it, too
    for key in sorted(overrides, key=lambda key: (key.startswith("link.channels."), ".towers." in key)):
        _set(plain, key, overrides[key])
    try:
        other = FlightFile.model_validate(plain)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        # the message names what was typed, also where the mistake is found above or below it
        key = next((k for k in overrides if k.startswith(where) or where.startswith(k)), where)
        message = str(first["msg"]).removeprefix("Value error, ")
        raise UsageError(f"the override {key!r}: found {first['input']!r} at {where}", expected=message) from None
    # a campaign changes a channel that some of its flights do not have
    return other.changed({}, lent={*settings.lent, *(other.link.channels.keys() - settings.link.channels.keys())})


def _set(plain: dict[str, Any], key: str, value: Any) -> None:
    level: Any = plain
    holder, parts = plain, key.split(".")
    for depth, part in enumerate(parts):
        if not isinstance(level, dict):
            raise UsageError(f"the override {key!r} goes below {'.'.join(parts[:depth])!r}, which is no group of keys")
        if part not in level:
            _add(plain, level, parts[:depth], part, key)
        holder, level = level, level[part]
    holder[parts[-1]] = value


def _add(plain: dict[str, Any], level: dict[str, Any], above: list[str], part: str, key: str) -> None:
    """Make an entry of a mapping with free names; every other unknown key is a mistake."""
    if above == ["link", "channels"]:
        level[part] = deepcopy(plain["link"]["rss"])
        return
    if above[-1:] == ["towers"] and above[0] == "link":
        parent: Any = plain
        for name in above[:-1]:
            parent = parent[name]
        level[part] = deepcopy(parent["tower"])
        return
    near = nearest(part, level)
    raise UsageError(
        f"the override {key!r}: there is no key {part!r}" + (f" below {'.'.join(above)!r}" if above else ""),
        expected="a key of flight.yaml in dotted form",
        cause=f"did you mean {near!r}?" if near else None,
    )

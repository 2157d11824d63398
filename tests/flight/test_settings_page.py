"""docs/flight_yaml.md lists every key of flight.yaml with the type and default of the code.

python -m tests.flight.test_settings_page        writes the tables; the meanings are taken from the page
"""

import re
import types
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from aerpaw_cmp.flight import settings

PAGE = Path(__file__).parents[2] / "docs" / "flight_yaml.md"
TABLE = re.compile(r"<!-- keys: (\w+) -->\n(.*?)<!-- end -->", re.DOTALL)
UNITS = {"hz": "Hz", "dbm": "dBm", "db": "dB", "deg": "deg", "m": "m", "s": "s", "mps": "m/s", "db_per_m": "dB/m"}
SIMPLE = {
    str: "text", bool: "`true`, `false`", float: "number", int: "whole number", type(None): "", Any: "any",
}  # fmt: skip
LIMITS = {"gt": "above {}", "ge": "from {}", "lt": "below {}", "le": "to {}"}


def kind(annotation: Any, metadata: tuple[Any, ...] | list[Any] = ()) -> str:
    """Return the type of a key in words."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return kind(arguments[0], arguments[1:])
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in arguments)
    if origin in (Union, types.UnionType):
        return "; ".join(filter(None, map(kind, arguments)))
    if origin is dict:
        return f"mapping to {kind(arguments[1])}"
    if origin in (list, tuple):
        return f"list of {kind(arguments[0])}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "keys below" if annotation.__name__ in dict(tables()) else "written by `calibrate`"
    text = SIMPLE.get(annotation, "date and time")
    # limits are attributes of annotated_types, alone or within a FieldInfo
    parts = [part for item in metadata for part in (item.metadata if isinstance(item, FieldInfo) else [item])]
    limits = [LIMITS[key].format(f"{getattr(part, key):g}") for key in LIMITS for part in parts if hasattr(part, key)]
    return " ".join([text, *limits])


def default(field: FieldInfo) -> str:
    """Return the default of a key as YAML writes it."""
    value = field.default
    if field.is_required():
        return "required"
    if isinstance(value, BaseModel):
        return ""
    if value is None or value in ("", {}, []):
        return "none"
    if isinstance(value, bool):
        return f"`{value}`".lower()
    if isinstance(value, (tuple, list)):
        return f"`[{', '.join(f'{item:g}' for item in value)}]`"
    return f"`{value:g}`" if isinstance(value, (int, float)) else f"`{value}`"


def unit(name: str) -> str:
    """Return the unit that the end of a key's name states."""
    return next((UNITS[end] for end in sorted(UNITS, key=len, reverse=True) if name.endswith(f"_{end}")), "")


def rows(model: type[BaseModel], meanings: dict[str, str]) -> str:
    lines = ["| key | type | unit | default | meaning |", "| --- | --- | --- | --- | --- |"]
    for name, field in model.model_fields.items():
        cells = f"`{name}`", kind(field.annotation, field.metadata), unit(name), default(field), meanings.get(name, "")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def tables() -> list[tuple[str, str]]:
    """Return model and text of each table of the page."""
    return TABLE.findall(PAGE.read_text(encoding="utf-8"))


def meanings(table: str) -> dict[str, str]:
    return {name: text.strip() for name, text in re.findall(r"^\| `(\w+)` \|.*\| ([^|]*)\|$", table, re.MULTILINE)}


@pytest.mark.parametrize(("name", "shown"), tables())
def test_a_table_has_the_keys_of_the_code(name: str, shown: str) -> None:
    assert shown == rows(getattr(settings, name), meanings(shown)), "run python -m tests.flight.test_settings_page"
    assert all(meanings(shown).values()), "a key without a meaning"


def test_every_section_of_a_flight_file_has_a_table() -> None:
    def below(model: type[BaseModel]) -> set[str]:
        inner = {part for field in model.model_fields.values() for part in _models(field.annotation)}
        return {model.__name__}.union(*map(below, inner))

    def _models(annotation: Any) -> set[type[BaseModel]]:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            return {annotation} if annotation.__module__ == settings.__name__ else set()
        return set().union(*map(_models, get_args(annotation)))

    assert below(settings.FlightFile) == set(dict(tables()))


if __name__ == "__main__":
    PAGE.write_text(
        TABLE.sub(
            lambda match: (
                f"<!-- keys: {match[1]} -->\n{rows(getattr(settings, match[1]), meanings(match[2]))}<!-- end -->"
            ),
            PAGE.read_text(encoding="utf-8"),
        ),
        encoding="utf-8",
    )

"""Reading of YAML files as checked settings. The message about each mistake contains its line and how to fix it.

``load_yaml(path, Model)`` is the only entry point. A model is a pydantic class, usually a :class:`StrictModel`.

Values are read by the core schema of YAML 1.2, because YAML 1.1 (PyYAML's default) turns ``11:48:16`` into the number
42496 and ``no`` into False, and reads ``1e6`` as text. Tags cannot create objects. Duplicate keys, several documents,
aliases that expand to more than :data:`_MAX_NODES` nodes and nesting deeper than :data:`_MAX_DEPTH` are refused.

The values of some keys can be edited in a YAML file: all other lines, the comments and the order stay unchanged.

The module also lists the files that a settings file names. Such files are inputs, which no output may replace.

Every text that names an existing file counts as such a file. There is no list of keys, because a new key could be
forgotten in it.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, ClassVar, NoReturn, TypeVar
from zoneinfo import available_timezones

import pydantic
import yaml
from pydantic import BaseModel

from .errors import InputError, UsageError
from .files import read_bounded

# Larger files [bytes] are refused without reading them. A site with 100 000 single trees has about 6 MB.
MAX_BYTES = 32 * 1024 * 1024

# Largest number of scalars, lists and mappings, with aliases expanded, as a limit against alias bombs.
_MAX_NODES = 4_000_000

# Largest nesting depth of lists and mappings.
_MAX_DEPTH = 64

_TAG = "tag:yaml.org,2002:"
# The loader is used for events only, so that PyYAML does not construct objects.
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_INT = re.compile(r"[-+]?[0-9]+\Z")
_HEX = re.compile(r"0x[0-9a-fA-F]+\Z")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?\Z")
_WORDS: dict[str, Any] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".inf", ".Inf", "+.inf"), math.inf),
    "-.inf": -math.inf,
    **dict.fromkeys((".nan", ".NaN", ".NAN"), math.nan),
}

Location = tuple[Any, ...]
LineOf = Callable[[Location], "int | None"]
ModelT = TypeVar("ModelT", bound=pydantic.BaseModel)


class StrictModel(pydantic.BaseModel):
    """The base class of all settings: no unknown keys, only finite numbers, and no change after loading."""

    # Refuse NaN and infinity, because range checks by comparison accept NaN, and JSON has neither. Defer the build, so
    # that the validators of all parts are built together on first use.
    model_config: ClassVar[pydantic.ConfigDict] = pydantic.ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True
    )


def nearest(name: object, choices: Iterable[str]) -> str | None:
    """Return the choice most similar to ``name``, or None if there is no close match.

    Examples
    --------
    >>> nearest("sight", ["flight", "site", "rank"])
    'flight'
    >>> nearest("zzz", ["flight"]) is None
    True
    """
    # ignore case, because wrong case is the most common mistake
    by_lower = {choice.lower(): choice for choice in choices}
    matches = difflib.get_close_matches(str(name).lower(), by_lower, n=1, cutoff=0.5)
    return by_lower[matches[0]] if matches else None


def nearest_zone(name: str) -> str | None:
    """Return the IANA time zone most similar to a wrong name. A name without a region is compared with cities.

    Examples
    --------
    >>> nearest_zone("America/NewYork"), nearest_zone("new york"), nearest_zone("EDT")
    ('America/New_York', 'America/New_York', None)
    """
    zones = available_timezones() if len(name) > 4 else ()  # not for abbreviations, which are similar to too many names
    if "/" in name:
        return nearest(name, zones)
    cities = {zone.rpartition("/")[2]: zone for zone in sorted(zones)}
    return cities.get(nearest(name.replace(" ", "_"), cities) or "")


def load_yaml(path: str | Path, model: type[ModelT]) -> ModelT:
    """Read a YAML file and return it as a checked model.

    Parameters
    ----------
    path : str or Path
        UTF-8 file.
    model : type of pydantic.BaseModel
        Model of the settings. With ``extra="forbid"`` (:class:`StrictModel`), unknown keys are errors.

    Returns
    -------
    model instance

    Raises
    ------
    InputError
        If there is no such file, or it cannot be read.
    UsageError
        With path and line, if the file is not text or YAML, has duplicate or unknown keys (with the nearest valid key),
        or wrong or missing values.
    """
    return parse_yaml(_read_text(Path(path)), model, path)


def load_yaml_and_lines(path: str | Path, model: type[ModelT]) -> tuple[ModelT, LineOf]:
    """Return the settings of :func:`load_yaml`, and a function that returns the line of a key as ``("towers", "LW1")``.

    Use this function for checks that need more than the file and whose messages contain the line of a key.
    """
    settings: tuple[ModelT, LineOf] = _known(_read_text(Path(path)), str(path), model)
    return settings


# the text is an argument of the cached function, so that an edited file is parsed again
@lru_cache(maxsize=16)
def _known(text: str, path: str, model: type[Any]) -> tuple[Any, LineOf]:
    """Return settings and lines of a text. Cached, because a command and each task of a campaign request them again."""
    document = _parse(text, path)
    return _checked(document, model, path), document.line


def dump_yaml(content: Mapping[str, Any]) -> str:
    """Return settings as YAML text that :func:`load_yaml` reads back to the same values.

    PyYAML writes YAML 1.1, where ``1e3`` is text. Text that YAML 1.2 reads as another type is therefore quoted here.
    """
    return str(
        yaml.dump(content, Dumper=_dumper(), sort_keys=False, allow_unicode=True, default_flow_style=None, width=118)
    )


@cache
def _dumper() -> Any:
    base: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

    class Dumper(base):  # type: ignore[misc]
        """A dumper that quotes words which this reader would read as another type."""

        def ignore_aliases(self, _: Any) -> bool:
            return True  # write equal lists in full, because an anchor such as '&id001' does not help a reader

    def word(dumper: Any, text: str) -> Any:
        quoted = not isinstance(_plain_value(text), str)
        return dumper.represent_scalar(_TAG + "str", text, style="'" if quoted else None)

    Dumper.add_representer(str, word)
    return Dumper


def parse_yaml(text: str, model: type[ModelT], path: str | Path | None = None) -> ModelT:
    """Parse YAML text into a checked model. ``path`` is only for the messages."""
    return _checked(_parse(text, path), model, path)


def _checked(document: _Document, model: type[ModelT], path: str | Path | None) -> ModelT:
    if document.value is None:
        raise UsageError("the file contains no settings", expected=_keys_of(model), path=path)
    if not isinstance(document.value, dict):
        found, cause = "the file is not a list of 'key: value' settings", "another kind of file"
        raise UsageError(found, expected=_keys_of(model), cause=cause, path=path, line=1)
    try:
        return model.model_validate(document.value)
    except pydantic.ValidationError as error:
        raise _explain(error, model, document, path) from None


def _read_text(path: Path) -> str:
    try:
        if path.is_dir():
            raise UsageError("a folder was named", expected="a YAML file", path=path)
        data = read_bounded(path, MAX_BYTES, "a YAML file")
    except InputError as error:
        raise UsageError(error.found, expected=error.expected, cause=error.cause, path=path) from None
    except FileNotFoundError:
        raise InputError("no such file", expected="a YAML file", cause="a misspelt path", path=path) from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", path=path) from None
    try:
        # Windows editors begin UTF-8 files with a byte order mark
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise UsageError("not UTF-8 text", expected="a YAML file", path=path, line=line) from None


# ---------------------------------------------------------------- YAML events to plain values, with their lines


@dataclass(slots=True)
class _Document:
    value: Any = None
    lines: dict[Location, int] = field(default_factory=dict)

    def line(self, location: Location) -> int | None:
        """Return the line of a location. Unknown parts are ignored, because pydantic inserts names of union members."""
        known: Location = ()
        for part in location:
            if (*known, part) in self.lines:
                known = (*known, part)
        return self.lines.get(known)


def _keys_of(model: type[pydantic.BaseModel]) -> str:
    return f"keys such as {_listed(_field_names(model)[:4])}"


def _parse(text: str, path: str | Path | None) -> _Document:
    try:
        return _Builder(path).build(yaml.parse(text, Loader=_LOADER))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        cause = "tabs cannot indent in YAML; use spaces" if _tab_indents(text, mark) else None
        # PyYAML calls control characters unacceptable
        if "unacceptable" in problem:
            cause = "a log or another binary file instead of the settings"
        raise UsageError(
            f"not YAML: {problem}",
            expected="'key: value' lines",
            cause=cause,
            path=path,
            line=None if mark is None else mark.line + 1,
        ) from None


def _tab_indents(text: str, mark: Any) -> bool:
    line = [] if mark is None else text.splitlines()[mark.line : mark.line + 1]
    return any("\t" in part[: len(part) - len(part.lstrip())] for part in line)


class _Builder:
    """A builder of values from parser events. :data:`_MAX_DEPTH` limits the recursion."""

    def __init__(self, path: str | Path | None) -> None:
        self.path = path
        self.document = _Document()
        self.anchors: dict[str, tuple[Any, int]] = {}
        self.nodes = 0

    def build(self, events: Iterator[Any]) -> _Document:
        self.events = events
        documents = 0
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    self._fail(event, "a second document begins here ('---'); expected one document")
                root = next(events)
                self.document.lines[()] = root.start_mark.line + 1
                self.document.value = self._value(root, ())
        return self.document

    def _fail(self, event: Any, problem: str) -> NoReturn:
        raise UsageError(problem, path=self.path, line=event.start_mark.line + 1)

    def _count(self, nodes: int, event: Any) -> None:
        self.nodes += nodes
        if self.nodes > _MAX_NODES:
            self._fail(event, f"the file expands to more than {_MAX_NODES} values (aliases of aliases?)")

    def _value(self, event: Any, location: Location) -> Any:
        """Return the scalar, list or mapping that begins with an event. Its anchor is known only after its end."""
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self.anchors:
                self._fail(event, f"the alias '*{event.anchor}' names no anchor above it, or contains itself")
            value, nodes = self.anchors[event.anchor]
            self._count(nodes, event)
            return value
        before = self.nodes
        self._count(1, event)
        value = self._scalar(event) if isinstance(event, yaml.ScalarEvent) else self._collection(event, location)
        if event.anchor:
            self.anchors[event.anchor] = (value, self.nodes - before)
        return value

    def _collection(self, event: Any, location: Location) -> list[Any] | dict[str, Any]:
        if len(location) >= _MAX_DEPTH:
            self._fail(event, f"nested deeper than {_MAX_DEPTH} levels")
        is_map = isinstance(event, yaml.MappingStartEvent)
        if event.tag not in (None, "!", _TAG + ("map" if is_map else "seq")):
            self._fail(event, f"the tag '{event.tag}' is not allowed here")
        if is_map:
            return self._mapping(location)
        items: list[Any] = []
        while not isinstance(item := next(self.events), yaml.SequenceEndEvent):
            place = (*location, len(items))
            self.document.lines[place] = item.start_mark.line + 1
            items.append(self._value(item, place))
        return items

    def _mapping(self, location: Location) -> dict[str, Any]:
        content: dict[str, Any] = {}
        while not isinstance(event := next(self.events), yaml.MappingEndEvent):
            key = self._key(event)
            place = (*location, key)
            if key in content:
                first = self.document.lines.get(place)
                self._fail(event, f"duplicate key '{key}' (first on line {first})")
            self.document.lines[place] = event.start_mark.line + 1
            content[key] = self._value(next(self.events), place)
        return content

    def _key(self, event: Any) -> str:
        """Return a key as text. 'on', 1 or 1.5 is returned as written, because pydantic requires text."""
        if isinstance(event, yaml.CollectionStartEvent):
            self._fail(event, "a list or mapping is used as a key")
        if isinstance(event, yaml.ScalarEvent) and event.value == "<<" and event.implicit[0]:
            self._fail(
                event, "the merge key '<<' is not supported: write the keys, or an alias in place of the whole value"
            )
        key = self._value(event, ())
        if key is None or isinstance(key, list | dict):
            self._fail(event, "a key is empty or not a word")
        return str(event.value if isinstance(event, yaml.ScalarEvent) else key)

    def _scalar(self, event: Any) -> Any:
        if event.tag not in (None, "!", _TAG + "str"):
            self._fail(event, f"the tag '{event.tag.replace(_TAG, '!!')}' is not allowed")
        # a scalar is text if it has the tag !!str, is in quotes or is a block
        is_text = event.tag is not None or not event.implicit[0]
        return event.value if is_text else _plain_value(event.value)


def _plain_value(text: str) -> Any:
    """Return the value of an unquoted scalar by the core schema of YAML 1.2."""
    if text in _WORDS:
        return _WORDS[text]
    # read long integers as floats, because Python takes quadratic time for them and refuses them from 4 300 digits on
    if _INT.match(text) and len(text) < 40:
        return int(text)
    if _HEX.match(text) and len(text) < 40:
        return int(text, 16)
    if _FLOAT.match(text):
        return float(text)
    return text


# ---------------------------------------------------------------- errors of pydantic as messages


def _explain(
    error: pydantic.ValidationError, model: type[pydantic.BaseModel], document: _Document, path: str | Path | None
) -> UsageError:
    if (kind := _kind(document.value)) and kind != _kind(_field_names(model)):
        # do not suggest similar names, because all names are those of another kind of file
        return UsageError(f"these are the settings of a {kind}", expected=_keys_of(model), path=path)
    findings: list[tuple[int | None, str, str | None]] = []
    for item in error.errors(include_url=False):
        problem, cause = _finding(item, model)
        findings.append((document.line(item["loc"]), problem, cause))
    # sort by line, because pydantic reports errors in the order of the model
    findings.sort(key=lambda finding: finding[0] or 0)
    if len(findings) == 1:
        line, problem, cause = findings[0]
        return UsageError(problem, cause=cause, path=path, line=line)
    lines = [
        f"line {line}: {problem}" + (f" ({cause})" if cause else "") if line else problem
        for line, problem, cause in findings
    ]
    # limit the list, because a file of another kind has hundreds of mistakes
    shown = lines[:20] + ([f"and {len(lines) - 20} more"] if len(lines) > 20 else [])
    return UsageError(f"{len(findings)} problems\n  " + "\n  ".join(shown), path=path)


# Kinds of settings files and the keys that identify them. A campaign may also specify a shared calibration.
_SIGNS = {
    "campaign, which 'aerpaw-cmp campaign FILE' reads": {"campaign"},
    "calibration, which 'aerpaw-cmp calibrate FILE' reads": {"calibration", "flights"},
    "site, which 'aerpaw-cmp map FILE' reads": {"origin", "towers"},
    "flight, which 'aerpaw-cmp report FILE' reads": {"flight", "logs"},
}


def _kind(keys: Iterable[str]) -> str | None:
    return next((kind for kind, signs in _SIGNS.items() if signs.issubset(keys)), None)


# Parts of a location that name the member of a union that pydantic tried. No key of this package has such a name.
_MEMBER = re.compile(r"literal\[.*\]|(constrained-)?float|int|str|bool")

# The expected value in words, by pydantic's name of the error.
_KINDS = {
    "float_(type|parsing)": "a number",
    "int_(type|parsing|from_float)": "a whole number",
    "bool_(type|parsing)": "true or false",
    "string_type": "text (write a number or yes/no in quotes)",
    "(list|tuple)_type": "a list, [a, b]",
    "dict_type|model_type|model_attributes_type|mapping_type": "keys with values",
    "too_short": "at least {min_length} in the list",
    "too_long": "at most {max_length} in the list",
    "string_pattern_mismatch": "text of the form {pattern}",
}


def expectation(item: Any) -> str:
    """Return the value that an error of pydantic expects, as text that can follow "expected"."""
    message = str(item["msg"]).removeprefix("Value error, ").removeprefix("Input should be ")
    for kind, words in _KINDS.items():
        message = words.format(**item.get("ctx", {})) if re.fullmatch(kind, item["type"]) else message
    return re.sub(r"<\w+\.\w+: ('[^']*')>", r"\1", message)  # write members of an Enum as they are written in the file


def _finding(item: Any, model: type[pydantic.BaseModel]) -> tuple[str, str | None]:
    location: Location = item["loc"]
    where = ".".join(str(part) for part in location if not _MEMBER.fullmatch(str(part)))
    if item["type"] == "extra_forbidden":
        names = _field_names(*_models_at(model, location[:-1]))
        near = nearest(location[-1], names)
        homes = sorted(_homes(model, location[-1]), key=lambda home: home.count("."))
        cause = f"did you mean '{near}'?" if near else f"valid keys are {_listed(names)}"
        return f"unknown key '{where}'", f"'{location[-1]}' belongs in {' or '.join(homes[:3])}" if homes else cause
    if item["type"] == "missing" and isinstance(location[-1], int):
        return f"{'.'.join(map(str, location[:-1]))}: entry {location[-1] + 1} of the list is missing", None
    if item["type"] == "missing":
        fields = [at.model_fields.get(str(location[-1])) for at in _models_at(model, location[:-1])]
        return f"the key '{where}' is missing", next((field.description for field in fields if field), None)
    message = expectation(item)
    if item["type"] in ("value_error", "assertion_error"):
        return (f"{where}: {message}" if where else message), None
    shown = repr(item["input"])
    shown = shown if len(shown) <= 60 else shown[:57] + "..."
    return f"{where}: found {shown}; expected {message}", None


def _homes(model: type[pydantic.BaseModel], key: object, above: str = "") -> Iterator[str]:
    """Yield a description of each part of a settings file that can contain a key of this name."""
    for name, info in model.model_fields.items():
        path, kind = f"{above}{name}", typing.get_origin(info.annotation)
        inner = {list: "a line of '{}:'", dict: "an entry of '{}:'"}.get(kind, "'{}:'") if kind else "'{}:'"
        for part in _models_in(info.annotation):
            if key in _field_names(part):
                yield inner.format(path)
            yield from _homes(part, key, f"{path}.")


def _listed(names: Iterable[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)


def _field_names(*models: type[pydantic.BaseModel]) -> list[str]:
    names = [info.alias or name for model in models for name, info in model.model_fields.items()]
    return list(dict.fromkeys(names))


def _models_at(model: type[pydantic.BaseModel], location: Location) -> list[type[pydantic.BaseModel]]:
    """Return models that are possible at a location. Parts that are not fields are indices, keys or union members."""
    models: list[type[pydantic.BaseModel]] = [model]
    for part in location:
        fields = [field for candidate in models for field in candidate.model_fields.items()]
        inside = [model for name, info in fields if part in (name, info.alias) for model in _models_in(info.annotation)]
        named = [candidate for candidate in models if candidate.__name__ == part]
        models = inside or named or models
    return models


def _models_in(annotation: Any) -> list[type[pydantic.BaseModel]]:
    if isinstance(annotation, type) and typing.get_origin(annotation) is None:  # in Python 3.10 list[int] is a type
        return [annotation] if issubclass(annotation, pydantic.BaseModel) else []
    return [model for part in typing.get_args(annotation) for model in _models_in(part)]


KeyPath = tuple[str, ...]


def edited(text: str, changes: Mapping[KeyPath, Any]) -> str:
    r"""Return YAML text in which some keys have new values. The value None removes a key.

    Parameters
    ----------
    text : str
        Text of a mapping.
    changes : mapping of tuple of str to value
        New plain values, by the path of keys that leads to each of them.

    Raises
    ------
    UsageError
        If another key would change too, because several keys share a value (anchors).

    Examples
    --------
    >>> edited("a: {b: 1, c: 2}  # why\n# more\nd: 3\n", {("a", "c"): 4, ("d",): None, ("e", "f"): True})
    'a: {b: 1, c: 4}  # why\n# more\ne: {f: true}\n'
    """
    wanted, new = yaml.safe_load(text), text
    try:
        for path, value in changes.items():
            wanted = _put(wanted, path, value)
            new = _edited(new, path, value)
        alone = yaml.safe_load(new) == wanted
    except yaml.YAMLError:  # the error of an alias whose anchor was removed
        alone = False
    if not alone:
        keys = ", ".join(".".join(path) for path in changes)
        raise UsageError(f"{keys} cannot be changed alone", expected="keys without anchors and aliases")
    return new


def _put(content: Mapping[str, Any], path: KeyPath, value: Any) -> dict[str, Any]:
    key, *rest = path
    if rest:
        value = _put(content.get(key) or {}, tuple(rest), value) if key in content or value is not None else None
    return {name: old for name, old in content.items() if name != key} | ({} if value is None else {key: value})


def _edited(text: str, path: KeyPath, value: Any) -> str:
    node: Any = yaml.compose(text, Loader=yaml.SafeLoader)
    for depth, key in enumerate(path):
        keys = [name.value for name, _ in node.value]
        if key not in keys:
            for inner in reversed(path[depth + 1 :]):
                value = {inner: value}
            return text if value is None else _with_key(text, node, f"{key}: {_flow(value)}", top=not depth)
        at = keys.index(key)
        if depth < len(path) - 1:
            node = node.value[at][1]
    # write {} for a mapping that loses its last key, because an empty block would be read as null
    if value is None and len(keys) == 1 and depth:
        return _edited(text, path[:-1], {})
    if value is None:
        return _without(text, node, at)
    start, end = _span(text, node.value[at][1])
    return text[:start] + _flow(value) + text[end:]


def _flow(value: Any) -> str:
    """Return a value as YAML on one line."""
    # use a width that no line reaches, because wrapped lines would need an indent. Remove the "..." that PyYAML writes
    # after a plain scalar.
    line: str = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, allow_unicode=True, width=10**6)
    return line.removesuffix("\n").removesuffix("\n...")


def _span(text: str, node: Any) -> tuple[int, int]:
    """Return the range of characters of a value. A block ends with its last line that is not a comment."""
    start, end = node.start_mark.index, node.end_mark.index
    lines = text[start:end].splitlines(keepends=True)
    while len(lines) > 1 and (not lines[-1].strip() or lines[-1].lstrip().startswith("#")):
        lines.pop()
    return start, start + len("".join(lines).rstrip())


def _with_key(text: str, node: Any, pair: str, *, top: bool) -> str:
    if node.flow_style:
        end = node.end_mark.index - 1
        return f"{text[:end].rstrip()}{', ' if node.value else ''}{pair}{text[end:]}"
    line_end = "\r\n" if "\r\n" in text else "\n"
    if top:
        return text + ("" if text.endswith("\n") else line_end) + pair + line_end
    at = node.start_mark.index
    return f"{text[:at]}{pair}{line_end}{' ' * node.start_mark.column}{text[at:]}"


def _without(text: str, node: Any, at: int) -> str:
    (name, value), pairs = node.value[at], node.value
    start, end = name.start_mark.index, _span(text, value)[1]
    if not node.flow_style:
        last = text.find("\n", end)
        return text[: text.rfind("\n", 0, start) + 1] + ("" if last < 0 else text[last + 1 :])
    if at + 1 < len(pairs):
        return text[:start] + text[pairs[at + 1][0].start_mark.index :]
    start = _span(text, pairs[at - 1][1])[1] if at else start
    return text[:start] + text[end:]


def input_files(settings: BaseModel, path: Path, logs_root: Path | None = None) -> list[Path]:
    """Return a settings file and every file that its values name, relative to its folder or ``logs_root``."""
    roots = [path.parent] if logs_root is None else [logs_root, path.parent]
    return [path, *(place for _, _, place in named_files(settings.model_dump(), roots))]


def named_files(content: Any, roots: Sequence[Path]) -> Iterator[tuple[str, str, Path]]:
    """Yield dotted key, text and path of every value that names a file."""
    for key, text in _texts(content, ""):
        for root in roots:
            # do not create a Path first, because this is slow and most texts do not name a file
            if os.path.isfile(os.path.join(root, text)):  # noqa: PTH113, PTH118  never raises
                yield key, text, root / text
                break


def _texts(value: Any, key: str) -> Iterator[tuple[str, str]]:
    """Yield every text in nested settings with its dotted key."""
    if isinstance(value, (str, Path)):
        yield key, str(value)
    elif isinstance(value, dict):
        for name, item in value.items():
            yield from _texts(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, (list, tuple)):
        for index, item in enumerate(value):
            yield from _texts(item, f"{key}.{index}" if key else str(index))

"""YAML files with other values at some keys: every other line, its comments and its order stay as they were written."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml

from .errors import UsageError

KeyPath = tuple[str, ...]


def edited(text: str, changes: Mapping[KeyPath, Any]) -> str:
    r"""Text with other values at some keys; the value None takes a key away.

    Parameters
    ----------
    text : str
        A mapping.
    changes : mapping of tuple of str to value
        Plain values by the keys that lead to them.

    Raises
    ------
    UsageError
        If another key would change, too: of values that several keys share (anchors).

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
    except yaml.YAMLError:  # an anchor went, its alias stayed
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
    # a block that loses its last key would read as null
    if value is None and len(keys) == 1 and depth:
        return _edited(text, path[:-1], {})
    if value is None:
        return _without(text, node, at)
    start, end = _span(text, node.value[at][1])
    return text[:start] + _flow(value) + text[end:]


def _flow(value: Any) -> str:
    """A value on one line."""
    # a width that nothing reaches: a broken line would need the indent of its place; a bare word ends in "..." there
    line: str = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, allow_unicode=True, width=10**6)
    return line.removesuffix("\n").removesuffix("\n...")


def _span(text: str, node: Any) -> tuple[int, int]:
    """First and last character of a value; a block ends with its last line that is no comment."""
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

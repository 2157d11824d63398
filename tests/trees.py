"""Syntax trees of the package, which several laws of the project look through: each file is parsed once a process."""

import ast
import functools
from pathlib import Path


@functools.cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))

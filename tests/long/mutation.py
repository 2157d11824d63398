"""Mutation testing of the product.

Each mutant changes one place of one module: an operator, a comparison, a sign, a constant, a condition. The tests that
reach the changed statement run in a forked child, where nothing else is changed, and end at the first failure. A mutant
that passes every test has survived. `mutation_equivalent.txt` in the same folder lists the mutants that change nothing
visible, each with its reason. Mutants are drawn at random over all modules, with a seed, because all
of them would take weeks.

    python -m tests.long.mutation record MAP [--tests tests/compare]   # which test reaches which line (some minutes)
    python -m tests.long.mutation draw MAP --count 60 --seed 7 [--account FILE] [--only compare/ maps/]

If hundreds of tests reach a line, the shortest case of each test runs first, then further cases, up to `--budget`
seconds of processor time. A mutant that only a longer test would detect counts as survived, so the score is a lower
bound.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import functools
import importlib.abc
import importlib.machinery
import importlib.util
import io
import json
import os
import random
import select
import signal
import sys
import threading
import time
import types
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
EQUIVALENT = Path(__file__).with_name("mutation_equivalent.txt")

_GROWTH, _ALIKE = (f"tests/propagation/test_{name}.py::test_" for name in ("growth", "compiled"))
_BEAMS = (
    *(f"{_GROWTH}a_mirror_is_seen_past_a_face_with_hollows[{name}]" for name in ("an L", "a frame")),
    f"{_GROWTH}a_mirror_works_on_both_sides_and_hides_from_both", f"{_GROWTH}coincident_faces_give_one_path",
    f"{_GROWTH}triangles_within_the_tolerance_are_one_face_and_others_are_not",
    f"{_GROWTH}flipped_and_degenerate_triangles_change_nothing",
    f"{_GROWTH}tilted_overlapping_open_quads_against_enumeration[0]",
    f"{_GROWTH}tilted_overlapping_open_quads_against_enumeration[1]",
    f"{_GROWTH}paths_can_be_recomputed_from_their_faces",
    f"{_ALIKE}the_same_paths_at_any_depth_and_with_links_left_out[3]",
    f"{_ALIKE}the_same_paths_among_aligned_and_touching_buildings[0]",
    f"{_GROWTH}a_site_of_prisms_as_a_scene_has_the_paths_of_the_prism_engine",
    f"{_GROWTH}prisms_by_beams_have_the_paths_of_the_image_engine[True]",
)  # fmt: skip
# Lines of compiled code cannot be traced: these tests call it, and it is interpreted for each mutant.
COMPILED = {f"aerpaw_cmp/propagation/search/{name}.py": _BEAMS for name in ("beams", "merging")}

PRELOADED = (
    "numpy", "scipy.linalg", "scipy.signal", "scipy.spatial", "scipy.optimize", "scipy.stats", "pandas", "pytest",
    "hypothesis", "pydantic", "yaml", "shapely", "pyproj", "h5py", "mpmath", "numba",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: the file, its line, the old and the new text, and the numbers of node and change."""

    path: str
    line: int
    was: str
    now: str
    node: int
    change: int

    @property
    def name(self) -> str:
        """Return the text that distinguishes the mutant from all others of the file."""
        return f"{self.path}:{self.line}: {self.was} -> {self.now}"

    @property
    def source(self) -> str:
        """The whole changed source."""
        tree = ast.parse((ROOT / self.path).read_text(encoding="utf-8"))
        target = of_code(tree)[self.node]
        _replace(tree, target, list(changes(target))[self.change])
        return ast.unparse(ast.fix_missing_locations(tree))


# --- the changes ----------------------------------------------------------------------------------------------------

_OPERATORS: dict[type, tuple[type, ...]] = {
    ast.Add: (ast.Sub,), ast.Sub: (ast.Add,), ast.Mult: (ast.Div,), ast.Div: (ast.Mult,), ast.Pow: (ast.Mult,),
    ast.FloorDiv: (ast.Mult,), ast.Mod: (ast.Mult,), ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,),
    ast.MatMult: (),
}  # fmt: skip
_COMPARISONS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}  # fmt: skip


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield each node that may replace this node."""
    if isinstance(node, ast.BinOp):
        for other in _OPERATORS.get(type(node.op), ()):
            yield ast.BinOp(node.left, other(), node.right)
    elif isinstance(node, ast.AugAssign):
        for other in _OPERATORS.get(type(node.op), ()):
            yield ast.AugAssign(node.target, other(), node.value)
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        for other in _COMPARISONS.get(type(node.ops[0]), ()):
            yield ast.Compare(node.left, [other()], node.comparators)
    elif isinstance(node, ast.UnaryOp):
        if isinstance(node.op, (ast.USub, ast.Not, ast.Invert)):
            yield node.operand
    elif isinstance(node, ast.BoolOp):
        yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
    elif isinstance(node, ast.IfExp):
        yield ast.IfExp(ast.UnaryOp(ast.Not(), node.test), node.body, node.orelse)
    elif isinstance(node, ast.If):
        yield ast.If(ast.UnaryOp(ast.Not(), node.test), node.body, node.orelse)
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        yield ast.Constant(node.value + 1)
        if node.value not in (0, -1):
            yield ast.UnaryOp(ast.USub(), ast.Constant(node.value))
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield ast.Constant(not node.value)
    elif isinstance(node, (ast.Break, ast.Continue)):
        yield ast.Continue() if isinstance(node, ast.Break) else ast.Break()


def of_code(tree: ast.Module) -> list[ast.AST]:
    """Nodes that run when a function is called, or make a constant: no annotations, messages, decorators."""
    nodes: list[ast.AST] = []

    def visit(node: ast.AST) -> None:
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "type_params", "names"):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST) and not isinstance(child, (ast.Raise, ast.JoinedStr, ast.Assert)):
                    nodes.append(child)
                    visit(child)

    visit(tree)
    return nodes


def mutants(path: str) -> list[Mutant]:
    """All mutants of a module."""
    every = []
    for position, node in enumerate(of_code(ast.parse((ROOT / path).read_text(encoding="utf-8")))):
        for number, other in enumerate(changes(node)):
            was, now = (_short(n) for n in (node, other))
            if was != now:
                every.append(Mutant(path, getattr(node, "lineno", 0), was, now, position, number))
    return every


def _replace(tree: ast.Module, target: ast.AST, other: ast.AST) -> None:
    for parent in ast.walk(tree):
        for name, value in ast.iter_fields(parent):
            if value is target:
                setattr(parent, name, other)
                return
            if isinstance(value, list) and any(item is target for item in value):
                value[next(i for i, item in enumerate(value) if item is target)] = other
                return


def _short(node: ast.AST) -> str:
    text = ast.unparse(node).splitlines()[0] if not isinstance(node, ast.If) else "if " + ast.unparse(node.test)
    return text[:100]


# --- one mutant -----------------------------------------------------------------------------------------------------


class Planted(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from the changed source."""

    def __init__(self, name: str, path: Path, source: str) -> None:
        self.name, self.path, self.source = name, path, source

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> Any:
        """Return the name of the module alone."""
        del path, target
        if fullname != self.name:
            return None
        return importlib.util.spec_from_file_location(fullname, self.path, loader=self)

    def create_module(self, spec: Any) -> None:
        """Run as usual."""

    def exec_module(self, module: Any) -> None:
        """The changed source in place of the file."""
        exec(compile(self.source, str(self.path), "exec"), module.__dict__)


def module_name(path: str) -> str:
    """Dotted, of a path below the source roots."""
    return path.removeprefix("parsers/").removesuffix(".py").replace("/", ".")


OPTIONS = ("-q", "-x", "--no-header", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:randomly", "--tb=no")
QUIET = ("-W", "ignore::pytest.PytestAssertRewriteWarning")


def pytest_on(tests: tuple[str, ...], plugins: list[Any], options: tuple[str, ...] = OPTIONS) -> int:
    """Pytest in this process, silent."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return int(pytest.main([*options, *QUIET, *tests], plugins=plugins))


def own_folders() -> None:
    """Clear caches, so that a mutant cannot change the results of the next."""
    import tempfile

    os.environ["AERPAW_CMP_CACHE"] = tempfile.mkdtemp(prefix="aerpaw-cmp-mutant-")
    forget("aerpaw")


def in_child(work: Callable[[], str], limit_s: float) -> str:
    """Run the work in a forked child, and return ``killed by`` the test that it names.

    Without a name, the reason is the time limit or a crash.
    """
    import resource

    here, there = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s) + 1, int(limit_s) + 3))
            os.setpgid(0, 0)
            own_folders()
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 1)
            os.dup2(null, 2)
            test = work()
            os.write(there, f"killed by {test}".encode() if test else b"survived")
        except Exception as error:  # a line of this script does not count a mutant
            os.write(there, f"broken: {error!r}".encode())
        finally:
            os._exit(0)
    os.close(there)
    ready, _, _ = select.select([here], [], [], 20 * limit_s)
    answer = os.read(here, 4096).decode() if ready else ""
    os.close(here)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)  # with what its tests started
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return answer or "killed by time or crash"


# --- which test reaches which line -----------------------------------------------------------------------------------

# By test: ``seconds`` of processor time, ``lines`` by module.
Reach = dict[str, dict[str, Any]]


class Recorder:
    """A plug-in of pytest that records the lines of the packages that each test and its fixtures reach."""

    def __init__(self) -> None:
        self.reach: Reach = {}
        self.failed: list[str] = []
        self.paths = {str(ROOT / path): path for path in modules()}
        self.kept_of_tests: set[str] = set()
        self._lines: set[tuple[str, int]] = set()
        self._left: dict[types.CodeType, set[int]] = {}
        self._fixtures: dict[Any, set[tuple[str, int]]] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Iterator[Any]:
        """A fixture of a module runs once, for all tests that ask for it."""
        del request
        outer, left, self._lines, self._left = self._lines, self._left, set(), {}
        try:
            return (yield)
        finally:
            self._fixtures.setdefault(fixturedef, set()).update(self._lines)
            outer |= self._lines
            self._lines, self._left = outer, left

    def pytest_runtest_protocol(self, item: Any, nextitem: Any) -> bool:
        """Replace pytest's own function."""
        from _pytest.runner import runtestprotocol

        forget("aerpaw")
        if any(isinstance(value, functools._lru_cache_wrapper) for value in vars(item.module or item).values()):
            self.kept_of_tests.add(str(item.path))
        self._lines, self._left = set(), {}
        begin = time.process_time()
        sys.settrace(self._call)
        threading.settrace(self._call)
        try:
            reports = runtestprotocol(item, log=False, nextitem=nextitem)
        finally:
            sys.settrace(None)
            threading.settrace(None)  # type: ignore[arg-type]
        seconds = time.process_time() - begin
        if any(r.failed for r in reports):
            self.failed.append(item.nodeid)
        if all(r.passed for r in reports):
            mine = getattr(getattr(item, "_fixtureinfo", None), "name2fixturedefs", {}).values()
            lines = self._lines.union(*(self._fixtures.get(fixture, set()) for those in mine for fixture in those))
            self.reach[item.nodeid] = {"seconds": round(seconds, 2), "file": str(item.path), "lines": lines}
        return True

    def _call(self, frame: Any, event: str, argument: Any) -> Any:
        """Trace a function until each of its lines was met: what is traced takes many times as long."""
        del argument
        code = frame.f_code
        path = self.paths.get(code.co_filename)
        if path is None or event != "call":
            return None
        lines, left = self._lines, self._left.get(code)
        if left is None:
            left = self._left[code] = {number for _, _, number in code.co_lines() if number} - {code.co_firstlineno}
            lines.add((path, code.co_firstlineno))

        def line(frame: Any, event: str, argument: Any) -> Any:
            del event, argument
            if frame.f_lineno in left:
                left.discard(frame.f_lineno)
                lines.add((path, frame.f_lineno))
            frame.f_trace_lines = bool(left)
            return line

        return line if left else None

    def result(self) -> Reach:
        """The tests of a file that keeps what its helpers gave share what they reached."""
        for file in self.kept_of_tests:
            together = [reached for reached in self.reach.values() if reached["file"] == file]
            lines = set().union(*(reached["lines"] for reached in together))
            for reached in together:
                reached["lines"] = lines
        out: Reach = {}
        for name, reached in self.reach.items():
            by_module: dict[str, list[int]] = {}
            for path, number in sorted(reached["lines"]):
                by_module.setdefault(path, []).append(number)
            out[name] = {"seconds": reached["seconds"], "lines": by_module}
        return out


def forget(begin: str) -> None:
    """Return the caches of modules whose names have this prefix."""
    for name, module in list(sys.modules.items()):
        if name.startswith(begin):
            for value in list(vars(module).values()):
                if isinstance(value, functools._lru_cache_wrapper):
                    value.cache_clear()


class Trials:
    """A plug-in of pytest that tries mutants on the tests that reach them, the shortest first, none in this process.

    What is no body of a function (constants, defaults, fields), and what is compiled, is planted by a new import.
    """

    def __init__(
        self, chosen: list[Mutant], reach: Reach, answer: Callable[[Mutant, str, float], None], budget_s: float
    ) -> None:
        self.chosen, self.reach, self.answer, self.budget_s = chosen, reach, answer, budget_s

    def pytest_runtestloop(self, session: Any) -> bool:
        """Replace pytest's own function."""
        items = {item.nodeid: item for item in session.items}
        controls: dict[tuple[str, ...], bool] = {}
        for mutant in self.chosen:
            begin = time.monotonic()
            tree = ast.parse((ROOT / mutant.path).read_text(encoding="utf-8"))
            place = place_of(tree, of_code(tree)[mutant.node])
            near = within(self.budget_s, self.reach, mutant.path, None if place is None else place.lines)
            limit = 30 + 10 * sum(self.reach[name]["seconds"] for name in near)
            if place is None or not near or mutant.path in COMPILED:
                tests = COMPILED.get(mutant.path) or tuple(near_tests(self.reach, mutant.path, None)[:MOST_ANEW])
                kind = in_child(lambda change=mutant, those=tests: planted(change, change.source, those), limit + 300)
                source = (ROOT / mutant.path).read_text(encoding="utf-8")
                control, what = partial(planted, mutant, source, tests), (mutant.path, *tests)
            else:
                those = [items[name] for name in near if name in items]
                kind = in_child(lambda change=mutant, at=place, tests=those: self._fails(tests, change, at), limit)
                what = tuple(name for name in near if kind == f"killed by {name}")
                control = partial(self._fails, [items[name] for name in what])
            if kind.startswith("killed by") and not kind.endswith(("crash", "import")):
                if what not in controls:
                    controls[what] = in_child(control, limit + 300) == "survived"
                if not controls[what]:
                    kind = f"unclear: {kind}, and so it is without the change"
            self.answer(mutant, kind, time.monotonic() - begin)
        return True

    def _fails(self, items: list[Any], mutant: Mutant | None = None, place: Place | None = None) -> str:
        from _pytest.runner import runtestprotocol

        if mutant is not None and place is not None:
            swap(mutant, place)
        for number, item in enumerate(items):
            after = items[number + 1] if number + 1 < len(items) else None
            if any(report.failed for report in runtestprotocol(item, log=False, nextitem=after)):
                return str(item.nodeid)
        return ""


# Unclear: the test fails without the change too, where it runs alone; such mutants do not count.
KINDS = ("killed", "survived", "equivalent", "unclear")

# Tests that a change outside functions is tried on, the shortest case of each first.
MOST_ANEW = 120


def near_tests(reach: Reach, path: str, lines: tuple[int, int] | None) -> list[str]:
    """Tests that reach lines of a module (None: any): the shortest case of each test first, then the second ..."""
    met = []
    for name, entry in reach.items():
        reached = entry["lines"].get(path, ())
        if any(lines is None or lines[0] <= number <= lines[1] for number in reached):
            met.append((entry["seconds"], name))
    cases: Counter[str] = Counter()
    order = []
    for seconds, name in sorted(met):
        test = name.partition("[")[0]
        order.append((cases[test], seconds, name))
        cases[test] += 1
    return [name for _, _, name in sorted(order)]


def within(budget_s: float, reach: Reach, path: str, lines: tuple[int, int] | None) -> list[str]:
    """Return tests that reach lines of a module and fit into a time, in the order of :func:`near_tests`.

    At least one is returned.
    """
    near, out, left = near_tests(reach, path, lines), [], budget_s
    for name in near:
        if reach[name]["seconds"] <= left:
            out.append(name)
            left -= reach[name]["seconds"]
    return out or sorted(near, key=lambda name: reach[name]["seconds"])[:1]


def planted(mutant: Mutant, source: str, tests: tuple[str, ...]) -> str:
    """Check in a child process whether a test fails after the module and its importers are imported from a source."""
    if mutant.path in COMPILED:
        numba = importlib.import_module("numba")
        numba.config.DISABLE_JIT = True  # its cache would not see the change
    for name in [n for n in sys.modules if n.split(".")[0] in ("aerpaw_cmp", "aerpaw_parsers", "tests", "conftest")]:
        del sys.modules[name]
    sys.meta_path.insert(0, Planted(module_name(mutant.path), ROOT / mutant.path, source))
    try:
        importlib.import_module(module_name(mutant.path))  # before pytest, which would load the file for its doctests
    except Exception:
        return "the import"
    return "a test, imported anew" if tests and pytest_on(tests, []) == 1 else ""


@dataclass(frozen=True, slots=True)
class Place:
    """Return the location of a change: the function with its classes, and the lines of the statement."""

    names: tuple[str, ...]
    begin: int
    lines: tuple[int, int]


def place_of(tree: ast.Module, node: ast.AST) -> Place | None:
    """Return the function of a node in its body. None elsewhere."""
    body: list[ast.stmt] = tree.body
    names: list[str] = []
    while True:
        within = next((s for s in body if any(n is node for n in ast.walk(s))), None)
        if not isinstance(within, (ast.ClassDef, ast.FunctionDef)):
            return None
        names.append(within.name)
        if isinstance(within, ast.FunctionDef):
            break
        body = within.body
    if not any(n is node for s in within.body for n in ast.walk(s)):
        return None
    begin = min([within.lineno, *(d.lineno for d in within.decorator_list)])
    return Place(tuple(names), begin, _lines_of(within.body, node))


def _lines_of(body: list[ast.stmt], node: ast.AST) -> tuple[int, int]:
    """First and last line of the innermost simple statement, or of the head of a compound one."""
    statement = next(s for s in body if any(n is node for n in ast.walk(s)))
    for name in ("body", "orelse", "finalbody", "handlers"):
        inner = getattr(statement, name, None)
        if isinstance(inner, list) and any(n is node for s in inner for n in ast.walk(s)):
            return _lines_of(inner, node)
    blocks = getattr(statement, "body", None)
    last = blocks[0].lineno - 1 if blocks and statement is not node else statement.end_lineno
    return statement.lineno, max(last or statement.lineno, statement.lineno)


def swap(mutant: Mutant, place: Place) -> None:
    """Give the imported function the changed code."""
    tree = ast.parse((ROOT / mutant.path).read_text(encoding="utf-8"))
    target = of_code(tree)[mutant.node]
    other = list(changes(target))[mutant.change]
    _replace(tree, target, ast.copy_location(other, target))
    code = compile(ast.fix_missing_locations(tree), str(ROOT / mutant.path), "exec")
    for name in place.names[:-1]:
        code = next(c for c in code.co_consts if isinstance(c, types.CodeType) and c.co_name == name)
    code = next(
        c
        for c in code.co_consts
        if isinstance(c, types.CodeType) and (c.co_name, c.co_firstlineno) == (place.names[-1], place.begin)
    )
    holder: Any = importlib.import_module(module_name(mutant.path))
    for name in place.names:
        holder = vars(holder)[name]
        for inner in ("fget", "__func__", "func", "__wrapped__"):
            holder = getattr(holder, inner, holder)
    holder.__code__ = code


# --- all of them ----------------------------------------------------------------------------------------------------


def equivalents() -> dict[str, str]:
    """Mutants that change nothing that can be seen, as :func:`change_of` names them, with the reason."""
    out = {}
    for row in EQUIVALENT.read_text(encoding="utf-8").splitlines() if EQUIVALENT.is_file() else ():
        if row.strip() and not row.startswith("#"):
            change, _, reason = row.partition(" ## ")
            out[change.strip()] = reason.strip()
    return out


def change_of(mutant: Mutant) -> str:
    """The name with the text of its line in place of the number, which moves."""
    text = (ROOT / mutant.path).read_text(encoding="utf-8").splitlines()[mutant.line - 1].strip()
    return f"{mutant.path}: {mutant.was} -> {mutant.now} @ {text}"


def modules() -> list[str]:
    """Return the files of the packages."""
    files = [path for base in ("aerpaw_cmp", "parsers") for path in sorted((ROOT / base).rglob("*.py"))]
    return [path.relative_to(ROOT).as_posix() for path in files if not path.name.startswith("__")]


def record(target: Path, tests: tuple[str, ...]) -> None:
    """Add the lines that each test reaches to a map. A test file that is recorded again replaces its former entries."""
    recorder = Recorder()
    pytest_on(tests, [recorder], OPTIONS[:1] + OPTIONS[2:])
    known: Reach = json.loads(target.read_text(encoding="utf-8")) if target.is_file() else {}
    new = recorder.result()
    files = {name.partition("::")[0] for name in new}
    known = {name: entry for name, entry in known.items() if name.partition("::")[0] not in files}
    target.write_text(json.dumps(known | new), encoding="utf-8")
    print(f"{len(new)} tests recorded, {sum(entry['seconds'] for entry in new.values()):.0f} CPU s")
    for name in recorder.failed:
        print(f"fails without any change: {name}")


def drawn(count: int, seed: int, only: list[str]) -> list[Mutant]:
    """Mutants at random over the modules, each mutant as likely as any other."""
    every = [mutant for path in modules() if any(some in path for some in only) for mutant in mutants(path)]
    return random.Random(seed).sample(every, min(count, len(every)))


def draw(chosen: list[Mutant], reach: Reach, account: Path | None, budget_s: float) -> None:
    """Try mutants, and print one line for each and the shares."""
    known = equivalents()
    counts: dict[str, dict[str, int]] = {}

    def answer(mutant: Mutant, outcome: str, took: float) -> None:
        kind = next((name for name in ("killed", "survived") if outcome.startswith(name)), "unclear")
        if kind == "survived" and change_of(mutant) in known:
            kind = "equivalent"
        room = counts.setdefault(mutant.path.split("/")[1], dict.fromkeys(KINDS, 0))
        room[kind] += 1
        print(f"{kind:10s} {took:6.1f} s  {mutant.name}  [{outcome}]", file=sys.__stdout__, flush=True)
        if account is not None:
            row = {"mutant": mutant.name, "change": change_of(mutant), "outcome": outcome, "as": kind}
            with account.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")

    tests = tuple(sorted({name.partition("::")[0] for name in reach}))
    pytest_on(tests, [Trials(chosen, reach, answer, budget_s)])
    counts["all"] = {kind: sum(row[kind] for row in counts.values()) for kind in KINDS}
    for name, row in counts.items():
        tried = max(row["killed"] + row["survived"], 1)
        share = f"{row['killed']} of {tried} ({row['killed'] / tried:.1%})"
        print(f"{name:12s} killed {share}, {row['equivalent']} equivalent, {row['unclear']} unclear")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    of_map = commands.add_parser("record", help="which test reaches which line")
    of_map.add_argument("--tests", nargs="+", default=("tests",))
    of_draw = commands.add_parser("draw", help="try mutants")
    of_draw.add_argument("--count", type=int, default=60)
    of_draw.add_argument("--seed", type=int, default=1)
    of_draw.add_argument("--only", nargs="+", default=["/"], help="modules whose path holds one of these")
    of_draw.add_argument("--budget", type=float, default=40.0, help="of tests for one mutant [s of the processor]")
    of_draw.add_argument("--account", type=Path, help="a line of JSON per mutant is added here")
    for command in (of_map, of_draw):
        command.add_argument("map", type=Path)
    arguments = parser.parse_args()
    os.chdir(ROOT)
    os.environ["CI"] = "1"  # hypothesis draws the same examples every time
    sys.path[:0] = [str(ROOT), str(ROOT / "parsers")]
    for name in PRELOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    for path in modules():  # before pytest, which would load each file for its doctests
        with contextlib.suppress(ImportError):
            importlib.import_module(module_name(path))
    if arguments.command == "record":
        record(arguments.map, tuple(arguments.tests))
        return
    reach = json.loads(arguments.map.read_text(encoding="utf-8"))
    chosen = drawn(arguments.count, arguments.seed, arguments.only)
    draw(chosen, reach, arguments.account, arguments.budget)


if __name__ == "__main__":
    main()

"""Mutation testing of the modules that hold the physics and the readers.

Each mutant changes one place of one module: an operator, a comparison, a sign, a constant, a condition. Of the tests
named for the module, those that reach the changed statement run on it in a forked child, where nothing else is changed,
and end at the first failure.
A mutant that every test passes has survived; `mutation_equivalent.txt` beside this file lists, with the reason, those
that change nothing that can be seen. Mutants are drawn at random, with a seed, since all of them would take days.

    python benchmarks/mutation.py [--each 30] [--seed 1] [--only compare/offset.py] [--account FILE] [--all]
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import functools
import gc
import importlib.abc
import importlib.machinery
import importlib.util
import io
import json
import multiprocessing
import os
import random
import select
import signal
import sys
import time
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
EQUIVALENT = Path(__file__).with_name("mutation_equivalent.txt")
_PHYSICS = "tests/propagation/"
TARGETS: dict[str, tuple[str, ...]] = {
    "aerpaw_cmp/common/units.py": ("aerpaw_cmp/common/units.py", "tests/common/test_units.py"),
    "aerpaw_cmp/propagation/arrays.py": (
        "aerpaw_cmp/propagation/arrays.py", _PHYSICS + "test_channel.py", _PHYSICS + "test_attitude_chain.py",
        _PHYSICS + "test_reference.py", _PHYSICS + "test_rank_field.py",
    ),
    "aerpaw_cmp/propagation/channel.py": (
        _PHYSICS + "test_channel.py", _PHYSICS + "test_reference.py", _PHYSICS + "test_rank_field.py",
        _PHYSICS + "test_compiled.py",
    ),
    "aerpaw_cmp/propagation/field/foliage.py": (
        _PHYSICS + "test_foliage.py", _PHYSICS + "test_reference.py", _PHYSICS + "test_hard_cases.py",
        _PHYSICS + "test_crowns.py", _PHYSICS + "test_foliage_by_hand.py",
    ),
    "aerpaw_cmp/compare/offset.py": (
        "aerpaw_cmp/compare/offset.py", "tests/compare/test_offset.py", "tests/compare/test_offset_by_hand.py"
    ),
    "aerpaw_cmp/compare/rank.py": (
        "aerpaw_cmp/compare/rank.py", "tests/compare/test_rank.py", "tests/compare/test_rank_by_hand.py"
    ),
    "aerpaw_cmp/flight/clock.py": ("tests/flight/test_clock.py", "tests/flight/test_clock_by_hand.py"),
    "aerpaw_cmp/flight/lag.py": (
        "tests/flight/test_lag_by_hand.py", "tests/flight/test_lag.py", "tests/flight/test_clock.py",
        "tests/flight/test_clock_by_hand.py",
    ),
    "aerpaw_cmp/maps/kriging.py": ("tests/maps/test_kriging.py", "tests/maps/test_kriging_by_hand.py"),
    "parsers/aerpaw_parsers/_lines.py": (
        "tests/parsers/test_law.py", "tests/parsers/test_formats.py",
        "tests/parsers/test_rows.py", "tests/parsers/test_lines.py", "parsers/aerpaw_parsers/_lines.py",
    ),
    "parsers/aerpaw_parsers/_rows.py": (
        "tests/parsers/test_rows.py", "tests/parsers/test_formats.py", "tests/parsers/test_base_stations.py",
        "tests/parsers/test_phones.py",
    ),
    "parsers/aerpaw_parsers/_time.py": ("tests/parsers/test_time.py", "tests/parsers/test_formats.py"),
    "parsers/aerpaw_parsers/vehicle_out.py": (
        "tests/parsers/test_formats.py", "tests/parsers/test_law.py",
    ),
    "parsers/aerpaw_parsers/sounder_log.py": (
        "tests/parsers/test_formats.py", "tests/parsers/test_sounder.py", "tests/parsers/test_law.py"
    ),
}  # fmt: skip
PRELOADED = (
    "numpy", "scipy.linalg", "scipy.signal", "scipy.spatial", "scipy.optimize", "scipy.stats", "pandas", "pytest",
    "hypothesis", "pydantic", "yaml", "shapely", "pyproj", "h5py", "mpmath", "numba",
)  # fmt: skip
TIMEOUT_S = 300.0
"""Of processor time; a mutant that loops is killed."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: the file, its line, what stood there and what stands there now; the how-manieth node and change."""

    path: str
    line: int
    was: str
    now: str
    node: int
    change: int

    @property
    def name(self) -> str:
        """Told apart from every other mutant of the file by its words."""
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
    """Every node that may stand in place of this one."""
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
    kept: list[ast.AST] = []

    def visit(node: ast.AST) -> None:
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "type_params", "names"):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST) and not isinstance(child, (ast.Raise, ast.JoinedStr, ast.Assert)):
                    kept.append(child)
                    visit(child)

    visit(tree)
    return kept


def mutants(path: str) -> list[Mutant]:
    """All mutants of a module."""
    found = []
    for position, node in enumerate(of_code(ast.parse((ROOT / path).read_text(encoding="utf-8")))):
        for number, other in enumerate(changes(node)):
            was, now = (_short(n) for n in (node, other))
            if was != now:
                found.append(Mutant(path, getattr(node, "lineno", 0), was, now, position, number))
    return found


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
        """Of the module alone."""
        del path, target
        if fullname != self.name:
            return None
        return importlib.util.spec_from_file_location(fullname, self.path, loader=self)

    def create_module(self, spec: Any) -> None:
        """As usual."""

    def exec_module(self, module: Any) -> None:
        """The changed source in place of the file."""
        exec(compile(self.source, str(self.path), "exec"), module.__dict__)


def module_name(path: str) -> str:
    """Dotted, of a path below the source roots."""
    return path.removeprefix("parsers/").removesuffix(".py").replace("/", ".")


OPTIONS = ("-q", "-x", "--no-header", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:randomly", "--tb=no")
QUIET = ("-W", "ignore::pytest.PytestAssertRewriteWarning")


def pytest_on(tests: tuple[str, ...], plugins: list[Any]) -> int:
    """Pytest in this process, silent."""
    import pytest

    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return int(pytest.main([*OPTIONS, *QUIET, *(t for t in tests if (ROOT / t).exists())], plugins=plugins))


def own_folders() -> None:
    """Nothing that one mutant leaves in a cache reaches the next."""
    import tempfile

    os.environ["AERPAW_CMP_CACHE"] = tempfile.mkdtemp(prefix="aerpaw-cmp-mutant-")
    for one in gc.get_objects():
        if isinstance(one, functools._lru_cache_wrapper) and str(getattr(one, "__module__", "")).startswith("aerpaw"):
            one.cache_clear()


def in_child(work: Callable[[], str], limit_s: float) -> str:
    """``killed by`` the test that the work, in a forked child, names; by time or crash where it says nothing."""
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
        except Exception as error:  # of this script: no mutant is counted by it
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


class Trials:
    """A plug-in of pytest: runs every test once, noting which lines of the module it reaches; then tries the mutants.

    A mutant is tried on the tests that reach its statement, the shortest first, in a forked child whose function has
    got the changed code. What is no body of a function (constants, defaults, fields) is planted by a new import.
    """

    def __init__(self, path: str, chosen: list[Mutant], pipe: Any) -> None:
        self.path, self.chosen, self.pipe = path, chosen, pipe
        self.done = 0
        self.fault = ""

    def pytest_runtestloop(self, session: Any) -> bool:
        """In place of pytest's own."""
        items = session.items
        reach = [self._reached(item, after) for item, after in zip(items, [*items[1:], None], strict=True)]
        if self.fault:
            return True
        tree = ast.parse((ROOT / self.path).read_text(encoding="utf-8"))
        for mutant in self.chosen:
            begin = time.monotonic()
            place = place_of(tree, of_code(tree)[mutant.node])
            if place is None:
                kind = in_child(lambda one=mutant: planted(self.path, one.source, TARGETS[self.path]), TIMEOUT_S)
            else:
                first, last = place.lines
                near = sorted((s, k) for k, (s, lines) in enumerate(reach) if any(first <= n <= last for n in lines))
                limit = min(TIMEOUT_S, 20 + 10 * sum(s for s, _ in near))
                tests = [items[k] for _, k in near]
                kind = in_child(lambda one=mutant, at=place, those=tests: self._fails(one, at, those), limit)
            self.pipe.send((mutant, kind, time.monotonic() - begin))
            self.done += 1
        return True

    def _reached(self, item: Any, after: Any) -> tuple[float, set[int]]:
        from _pytest.runner import runtestprotocol

        lines: set[int] = set()
        own = str(ROOT / self.path)

        def local(frame: Any, event: str, argument: Any) -> Any:
            del event, argument
            lines.add(frame.f_lineno)
            return local

        def every(frame: Any, event: str, argument: Any) -> Any:
            del argument
            if frame.f_code.co_filename != own or event != "call":
                return None
            return local

        begin = time.process_time()
        sys.settrace(every)
        try:
            reports = runtestprotocol(item, log=False, nextitem=after)
        finally:
            sys.settrace(None)
        if any(r.failed for r in reports):
            self.fault = item.nodeid
        return time.process_time() - begin, lines

    def _fails(self, mutant: Mutant, place: Place, items: list[Any]) -> str:
        from _pytest.runner import runtestprotocol

        swap(self.path, mutant, place)
        for number, item in enumerate(items):
            after = items[number + 1] if number + 1 < len(items) else None
            if any(report.failed for report in runtestprotocol(item, log=False, nextitem=after)):
                return str(item.nodeid)
        return ""


def planted(path: str, source: str, tests: tuple[str, ...]) -> str:
    """In a child: whether a test fails when the module, and all that imports it, is imported anew from a source."""
    for name in [n for n in sys.modules if n.split(".")[0] in ("aerpaw_cmp", "aerpaw_parsers", "tests", "conftest")]:
        del sys.modules[name]
    sys.meta_path.insert(0, Planted(module_name(path), ROOT / path, source))
    try:
        importlib.import_module(module_name(path))  # before pytest, which would load the file for its doctests
    except Exception:
        return "the import"
    return "a test, imported anew" if pytest_on(tests, []) == 1 else ""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a change stands: the names of the function (with its classes) and the lines of its statement."""

    names: tuple[str, ...]
    begin: int
    lines: tuple[int, int]


def place_of(tree: ast.Module, node: ast.AST) -> Place | None:
    """Of a node in the body of a function; None elsewhere."""
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


def swap(path: str, mutant: Mutant, place: Place) -> None:
    """Give the imported function the changed code."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    target = of_code(tree)[mutant.node]
    other = list(changes(target))[mutant.change]
    _replace(tree, target, ast.copy_location(other, target))
    code = compile(ast.fix_missing_locations(tree), str(ROOT / path), "exec")
    for name in place.names[:-1]:
        code = next(c for c in code.co_consts if isinstance(c, types.CodeType) and c.co_name == name)
    code = next(
        c
        for c in code.co_consts
        if isinstance(c, types.CodeType) and (c.co_name, c.co_firstlineno) == (place.names[-1], place.begin)
    )
    holder: Any = sys.modules[module_name(path)]
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


def drawn(path: str, each: int, seed: int) -> list[Mutant]:
    """Some of the mutants of a module."""
    every = mutants(path)
    return random.Random(f"{seed} {path}").sample(every, min(each, len(every)))


def run(path: str, chosen: list[Mutant], account: Path | None, known: dict[str, str]) -> dict[str, Any]:
    """Try each mutant, in a process of its own; one line of the account for each."""
    here, there = multiprocessing.get_context("fork").Pipe(duplex=False)
    child = multiprocessing.get_context("fork").Process(target=_tried, args=(path, chosen, there))
    child.start()
    there.close()
    counts = {"killed": 0, "survived": 0, "equivalent": 0}
    survivors = []
    with contextlib.suppress(EOFError):
        while True:
            mutant, result, took = here.recv()
            if mutant is None or result.startswith("broken"):
                raise SystemExit(f"{path if mutant is None else mutant.name}: {result}")
            kind = "killed" if result.startswith("killed") else "survived"
            if kind == "survived" and change_of(mutant) in known:
                kind = "equivalent"
            counts[kind] += 1
            if kind == "survived":
                survivors.append(f"{mutant.line}: {change_of(mutant)}")
            row = {"mutant": mutant.name, "outcome": result, "as": kind, "seconds": round(took, 1)}
            if account is not None:
                with account.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
    child.join()
    return {"path": path, **counts, "survivors": survivors}


def _tried(path: str, chosen: list[Mutant], pipe: Any) -> None:
    os.chdir(ROOT)
    sys.path[:0] = [str(ROOT), str(ROOT / "parsers")]
    importlib.import_module(module_name(path))  # before pytest, which would load the file for its doctests
    trials = Trials(path, chosen, pipe)
    code = pytest_on(TARGETS[path], [trials])
    if trials.fault or trials.done < len(chosen):
        pipe.send((None, f"its tests fail without any change: {trials.fault or f'pytest ended with {code}'}", 0.0))
    pipe.close()
    os._exit(0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--each", type=int, default=30, help="mutants per module")
    parser.add_argument("--all", action="store_true", help="every mutant")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=[], help="modules whose path ends so")
    parser.add_argument("--account", type=Path, help="a line of JSON per mutant is added here")
    arguments = parser.parse_args()
    for name in PRELOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    known, total = equivalents(), {"killed": 0, "survived": 0, "equivalent": 0}
    print(f"{'module':42s} {'mutants':>8} {'killed':>7} {'equiv.':>7} {'left':>5} {'share':>6}")
    for path in TARGETS:
        if arguments.only and not any(path.endswith(one) for one in arguments.only):
            continue
        chosen = drawn(path, 10**9 if arguments.all else arguments.each, arguments.seed)
        row = run(path, chosen, arguments.account, known)
        total = {kind: total[kind] + row[kind] for kind in total}
        share = row["killed"] / max(row["killed"] + row["survived"], 1)
        counts = f"{len(chosen):8d} {row['killed']:7d} {row['equivalent']:7d} {row['survived']:5d}"
        print(f"{path:42s} {counts} {share:6.1%}", flush=True)
        for name in row["survivors"]:
            print(f"    survived: {name}", flush=True)
    share = total["killed"] / max(total["killed"] + total["survived"], 1)
    print(f"killed {total['killed']} of {total['killed'] + total['survived']} that are not equivalent: {share:.1%}")


if __name__ == "__main__":
    main()

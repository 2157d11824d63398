"""Statements of the project about itself are true: documents against code."""

import ast
import email
import importlib
import itertools
import re
import runpy
import shutil
import stat
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

import aerpaw_cmp
from aerpaw_cmp import propagation
from aerpaw_cmp.common.text import COMMANDS
from tests.test_words import FILES, faults, parsed, texts_of

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])


def test_every_dependency_has_its_reason() -> None:
    extras = [*PROJECT["optional-dependencies"].values(), *PYPROJECT["dependency-groups"].values()]
    needed = {re.split(r"[^\w.-]", line)[0].lower() for group in [PROJECT["dependencies"], *extras] for line in group}
    rows = [line for line in (ROOT / "docs/dependencies.md").read_text().splitlines() if line.startswith("| ")]
    named = {re.split(r"[^\w.-]", name)[0].lower() for row in rows for name in row.split("|")[1].strip().split(", ")}
    assert needed <= named, needed - named
    assert named - {"package", "---", "hatchling"} <= needed, "a reason for something that is not there"


def test_classifiers_are_known_and_name_every_python_that_set_up_looks_for() -> None:
    known = pytest.importorskip("trove_classifiers", reason="it comes with hatchling").classifiers
    given = PROJECT["classifiers"]
    assert set(given) <= known
    versions = [line.rsplit(" ", 1)[1] for line in given if re.search(r":: 3\.\d+$", line)]
    searched = re.findall(
        r"python(3\.\d+)", (ROOT / "tools/setup_venv").read_text().partition("for name in")[2].partition("do")[0]
    )
    assert versions == sorted(searched, key=lambda version: int(version[2:]))
    assert PROJECT["requires-python"] == f">={versions[0]}"
    assert (ROOT / "aerpaw_cmp/py.typed").is_file()


@pytest.mark.parametrize("owner", ["<owner>", "lab"], ids=["no owner", "an owner"])
def test_the_readme_of_a_package_index_needs_no_file_of_ours(owner: str, tmp_path: Path) -> None:
    """Without an owner, the README is unchanged. With an owner, no link is broken."""
    pytest.importorskip("hatchling", reason="hatchling is not installed")
    for name in ("README.md", "LICENSE", "aerpaw_cmp/__init__.py", "tools/readme_links.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    source, text = f"https://github.com/{owner}/aerpaw-cmp", (ROOT / "pyproject.toml").read_text()
    (tmp_path / "pyproject.toml").write_text(text.replace("/<owner>/", f"/{owner}/"))
    code = "from hatchling.build import prepare_metadata_for_build_wheel as make; print(make('.'))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    metadata = email.message_from_bytes((tmp_path / done.stdout.strip() / "METADATA").read_bytes())
    assert metadata["Description-Content-Type"] == "text/markdown"
    addresses = dict(line.split(", ") for line in metadata.get_all("Project-URL"))
    assert addresses.pop("Paper") == "https://arxiv.org/abs/2502.10324"
    assert addresses.keys() == {"Source", "Documentation", "Issues", "Changelog"}
    assert all(address.startswith(source) for address in addresses.values())
    readme, shown = (ROOT / "README.md").read_text(), metadata.get_payload()
    if owner == "<owner>":
        assert shown.strip() == readme.strip()
        return
    links = re.findall(r"(!?)\[[^\]\[]*\]\(([^)]+)\)", readme)
    seen = re.findall(r"(!?)\[[^\]\[]*\]\(([^)]+)\)", shown)
    tag = f"v{metadata['Version']}"
    for (image, target), (also, address) in zip(links, seen, strict=True):
        kind = "raw" if image else "blob"
        own = f"{source}/{kind}/{tag}/{target}"
        assert (also, address) == (image, target if "://" in target else own)
    assert sum(bool(image) for image, _ in links) == 2


def test_every_dependency_has_a_lowest_version() -> None:
    lowest = runpy.run_path(str(ROOT / "tools/lowest_versions.py"))["lowest"](PROJECT["dependencies"])
    assert len(lowest) == len(PROJECT["dependencies"])
    assert [line for line in lowest if not re.fullmatch(r"[\w.-]+==\d[\w.]*", line)] == []


def test_the_conda_recipe_asks_for_what_the_package_asks_for() -> None:
    """All dependencies except Sionna RT, which has no conda package, are listed, with conda's names."""
    recipe = yaml.safe_load((ROOT / "packaging/conda-forge/recipe.yaml").read_text())
    assert recipe["context"]["version"] == aerpaw_cmp.__version__
    assert PROJECT["requires-python"] == f">={recipe['context']['python_min']}"
    spelled = {"matplotlib": "matplotlib-base", "PyYAML": "pyyaml"}
    wanted = {re.sub(r"^[\w-]+", lambda name: spelled.get(name[0], name[0]), line) for line in PROJECT["dependencies"]}
    lines = {line.replace(" ", "") for line in recipe["requirements"]["run"][1:]}
    assert wanted - lines == {line for line in wanted if line.startswith("sionna-rt")}
    assert lines <= wanted
    (script,) = recipe["build"]["python"]["entry_points"]
    name, target = script.split(" = ")
    assert PROJECT["scripts"] == {name: target}


def test_the_readme_names_commands_that_exist() -> None:
    text = (ROOT / "README.md").read_text()
    named = set(re.findall(r"`aerpaw-cmp ([a-z][\w-]*)", text)) | set(re.findall(r"\[`([a-z][\w-]*)[ `]", text))
    assert len(named) >= 10
    assert named <= {*COMMANDS}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_between_documents_lead_somewhere(document: Path) -> None:
    prose = re.sub(r"`[^`]*`", "", document.read_text())  # brackets in code are not links
    targets = re.findall(r"\]\(([^)#\s]+)", prose)
    missing = [target for target in targets if "://" not in target and not (document.parent / target).exists()]
    assert missing == []


@pytest.mark.parametrize("script", ["tools/setup_venv", ".ci/run"])
def test_scripts_can_run(script: str) -> None:
    path = ROOT / script
    assert path.stat().st_mode & stat.S_IXUSR
    assert subprocess.run(["bash", "-n", str(path)], check=False).returncode == 0


def test_setup_says_what_to_do_without_python(tmp_path: Path) -> None:
    """A machine on which no Python is new enough: one message with one line, exit code 1."""
    for tool in ("bash", "dirname", "id"):
        (tmp_path / tool).symlink_to(Path("/usr/bin") / tool)
    done = subprocess.run(
        ["/usr/bin/bash", str(ROOT / "tools/setup_venv"), str(tmp_path / "venv")],
        env={"PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].strip() == "sudo apt-get update && sudo apt-get install -y python3 python3-venv"
    assert not (tmp_path / "venv").exists()


def test_citation_changelog_and_package_state_one_version_and_date() -> None:
    from aerpaw_cmp import __version__

    (number, day), *_ = re.findall(r"^## (\S+) - (\d{4}-\d\d-\d\d)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.findall(r"^(?:version|date-released): (.*)$", citation, re.MULTILINE) == [number, day]
    assert number == __version__
    for page in ("README.md", "docs/paper.md", "docs/howto/questions.md", "CITATION.cff"):
        assert "10.1109/OJVT.2025.3585537" in (ROOT / page).read_text(), page


def test_no_setting_is_without_effect() -> None:
    """Every key that a flight file may hold is read somewhere: a key that does nothing would be a promise not kept."""
    from aerpaw_cmp.flight import settings as config

    code = "\n".join(path.read_text() for path in (ROOT / "aerpaw_cmp").rglob("*.py"))
    models = [
        value
        for value in vars(config).values()
        if isinstance(value, type) and issubclass(value, config.StrictModel) and value is not config.StrictModel
    ]
    assert len(models) > 8
    for model in models:
        for name in model.model_fields:
            assert re.search(rf"\.{name}\b", code), f"{model.__name__}.{name} is never read"


def test_the_architecture_page_shows_the_rooms_that_are_there() -> None:
    """Table and picture have one line per subpackage, in the order of import-linter.

    No module is outside a subpackage.
    """
    package = ROOT / "aerpaw_cmp"
    rooms = {path.parent.name for path in package.glob("*/__init__.py")}
    loose = {path.stem for path in package.glob("*.py")} - {"__init__"}
    assert loose == {"__main__", "readers"}, "the public face for readers"
    text = (ROOT / "docs" / "architecture.md").read_text()
    table = re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)
    assert set(table) == rooms
    layers = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]["layers"]
    order = [layer.removeprefix("aerpaw_cmp.") for layer in layers if layer.removeprefix("aerpaw_cmp.") in rooms]
    assert set(order) == rooms
    assert table == order
    picture = re.search(r"```\n(.*?)```", text, re.DOTALL)
    assert picture is not None
    assert [name for name in re.findall(r"^ *(\w+)", picture[1], re.MULTILINE) if name in rooms] == order


def test_layers_stand_one_above_the_other() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    assert not [layer for layer in contracts[0]["layers"] if ":" in layer or "|" in layer]
    assert [contract["type"] for contract in contracts][:2] == ["layers", "acyclic_siblings"]
    assert "ignore_imports" not in contracts[0]
    assert "ignore_imports" not in contracts[1]


def modules() -> list[Path]:
    return sorted([*(ROOT / "aerpaw_cmp").rglob("*.py"), *(ROOT / "parsers" / "aerpaw_parsers").rglob("*.py")])


def sections(docstring: str) -> dict[str, list[str]]:
    """Lines of each section of a NumPy docstring."""
    by_title: dict[str, list[str]] = {}
    lines = docstring.splitlines()
    for title, line in itertools.pairwise([*lines, ""]):
        if re.fullmatch(r"-{3,}", line) and title[:1].strip():
            if by_title:
                by_title[list(by_title)[-1]].pop()  # the title of this section
            by_title[title] = []
        elif by_title:
            by_title[list(by_title)[-1]].append(line)
    return by_title


def public_functions(body: list[ast.stmt], home: str) -> Iterator[tuple[str, ast.FunctionDef]]:
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_functions(node.body, f"{home}.{node.name}")
        elif isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield f"{home}.{node.name}", node


def lacking(function: ast.FunctionDef) -> list[str]:
    """Parameters that the docstring does not describe, and what it returns, where there are four or more."""
    a = function.args
    arguments = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
    names = [argument.arg for argument in arguments if argument.arg not in ("self", "cls")]
    if len(names) < 4:
        return []
    parts = sections(ast.get_docstring(function) or "")
    heads = [line.split(" : ")[0] for line in parts.get("Parameters", []) if line[:1].strip()]
    described = {name.strip().lstrip("*") for head in heads for name in head.split(",")}
    gives = function.returns is None or ast.unparse(function.returns) != "None"
    unsaid = ["Returns"] if gives and not {"Returns", "Yields"} & set(parts) else []
    return [name for name in names if name not in described] + unsaid


def test_functions_of_four_parameters_describe_each_and_what_they_return() -> None:
    """Check every public function of a public module.

    Functions of the command line describe themselves in ``--help``.
    """
    undescribed, seen = {}, 0
    for path in modules():
        inside = path.relative_to(ROOT)
        if inside.parts[1] == "cli" or inside.stem.startswith("_"):
            continue
        for name, function in public_functions(parsed(path).body, inside.as_posix()):
            seen += 1
            if missing := lacking(function):
                undescribed[name] = missing
    assert undescribed == {}
    assert seen > 1000


def texts_below(tree: ast.AST) -> list[int]:
    """Lines of strings that follow an assignment, as descriptions of a field or a constant."""
    return [
        after.lineno
        for node in ast.walk(tree)
        if isinstance(node, (ast.Module, ast.ClassDef))
        for before, after in itertools.pairwise(node.body)
        if isinstance(before, (ast.Assign, ast.AnnAssign))
        and isinstance(after, ast.Expr)
        and isinstance(after.value, ast.Constant)
    ]


def unknown_fields(record: ast.ClassDef, known: dict[str, ast.ClassDef]) -> set[str]:
    """Names that the section Parameters of a record describes, and that are not fields of it or of its bases."""
    fields: set[str] = set()
    waiting = [record]
    while waiting:
        node = waiting.pop()
        fields |= {ast.unparse(each.target) for each in node.body if isinstance(each, ast.AnnAssign)}
        waiting += [known[base.id] for base in node.bases if isinstance(base, ast.Name) and base.id in known]
    parts = sections(ast.get_docstring(record) or "")
    heads = [line.split(" : ")[0] for line in parts.get("Parameters", []) if line[:1].strip()]
    return {name.strip() for head in heads for name in head.split(",")} - fields


def test_fields_are_described_in_the_docstring_of_their_class() -> None:
    """A field is described under Parameters of its class, not by a string below it, and no field is left behind."""
    trees = {path: parsed(path) for path in modules()}
    assert {path.name: lines for path, tree in trees.items() if (lines := texts_below(tree))} == {}
    assert texts_below(ast.parse('class A:\n    """A."""\n\n    b: int\n    """B."""')) == [5]
    classes = [node for tree in trees.values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    known = {node.name: node for node in classes}
    records = [
        node
        for node in classes
        if any(isinstance(each, ast.AnnAssign) for each in node.body)
        and not any(isinstance(each, ast.FunctionDef) and each.name == "__init__" for each in node.body)
    ]
    assert len(records) > 350
    assert {node.name: names for node in records if (names := unknown_fields(node, known))} == {}
    (stale,) = ast.parse(
        'class A:\n    """A.\n\n    Parameters\n    ----------\n    b, c : int\n    """\n\n    c: int'
    ).body
    assert isinstance(stale, ast.ClassDef)
    assert unknown_fields(stale, {}) == {"b"}


def built_by_position(tree: ast.AST, classes: set[str], most: int) -> list[tuple[int, str]]:
    """Lines that build one of ``classes`` of more than ``most`` positional values."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and len(node.args) > most]
    names = [(call.lineno, ast.unparse(call.func).split(".")[-1]) for call in calls]
    return [(line, name) for line, name in names if name in classes]


def test_records_of_many_fields_are_built_by_keyword() -> None:
    """Six values of like types, one of them in the wrong place, make a record that nothing refuses."""
    trees = {path: parsed(path) for path in modules()}
    classes = {node.name for tree in trees.values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    assert len(classes) > 300
    by_position = {
        p.name: lines for p, tree in trees.items() if (lines := built_by_position(tree, {*classes, "cls"}, 5))
    }
    assert by_position == {}
    assert built_by_position(ast.parse("x = m.Link(1, 2, 3)\ny = Link(1, 2, c=3)"), {"Link"}, 2) == [(1, "Link")]


def private_imports(tree: ast.AST) -> list[str]:
    """Names with one underscore in front that a module takes from another."""
    taken = [alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names]
    return [name for name in taken if name.startswith("_") and not name.startswith("__")]


def test_no_module_takes_a_private_name_of_another() -> None:
    """A private module of a package may be imported, because parsers share some.

    A private name of a module may not be imported.
    """
    imports = {path.name: names for path in modules() if (names := private_imports(parsed(path)))}
    own = {path.stem for path in (ROOT / "parsers" / "aerpaw_parsers").glob("_*.py")}
    assert {name: left for name, names in imports.items() if (left := set(names) - own)} == {}
    assert private_imports(ast.parse("from .replay import Replay, _poses\nfrom . import __version__")) == ["_poses"]


def test_the_files_that_run_first_are_there() -> None:
    tree = parsed(ROOT / "tests" / "conftest.py")
    (named,) = [
        node for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "DEAREST"
    ]
    assert all((ROOT / "tests" / name).is_file() for name in ast.literal_eval(named.value))


def test_docstrings_begin_with_the_thing_or_a_verb() -> None:
    """Docstrings do not begin with What, Whether and similar words, which delay the verb."""
    asked = {"What", "Whether", "How", "Where", "Why", "Which", "Whose", "Who", "When"}
    for path in [*(ROOT / "aerpaw_cmp").rglob("*.py"), *(ROOT / "parsers").rglob("*.py")]:
        for node in ast.walk(parsed(path)):
            if isinstance(node, (ast.FunctionDef, ast.ClassDef, ast.Module)):
                first = (ast.get_docstring(node) or "").split(" ")[0]
                assert first not in asked, f"{path.name}: {getattr(node, 'name', 'module')} begins with {first!r}"


def test_no_user_reads_a_banned_word() -> None:
    by_line = {
        f"{path.relative_to(ROOT)}:{line}": wrong
        for path in FILES
        if path.name != "uplot.min.js"
        for line, text in texts_of(path)
        if (wrong := faults(text))
    }
    assert by_line == {}
    assert len(FILES) > 200


def test_the_tree_of_the_architecture_page_is_the_one_on_disk() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    tree = page.partition("## The tree")[2].partition("```\n")[2].partition("```")[0]
    shown = set(re.findall(r"[\w]+", tree))
    files = [*(ROOT / "aerpaw_cmp").glob("*/**/*.py"), *(ROOT / "parsers" / "aerpaw_parsers").glob("*.py")]
    assert len(files) > 150
    assert {file.stem for file in files} - {"__init__"} <= shown
    folders = {file.parent.name for file in files}
    assert shown <= {file.stem for file in files} | folders | {"parsers"}


def test_the_table_of_formulas_names_code_that_exists() -> None:
    named = re.findall(r"``([\w.]+)``", (propagation.__doc__ or "").partition("=====")[2].rpartition("=====")[0])
    assert len(named) > 12
    for name in named:
        place: object = propagation
        # half_space and slab are in the module of the name before them
        for part in (f"field.fresnel.{name}" if name in ("half_space", "slab") else name).split("."):
            if isinstance(place, types.ModuleType) and hasattr(place, "__path__"):
                importlib.import_module(f"{place.__name__}.{part}")
            assert hasattr(place, part), name
            place = getattr(place, part)

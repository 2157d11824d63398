"""Installed packages are locked, workflows run fixed versions, and only Dask connects to other machines."""

import ast
import re
from pathlib import Path

import pytest

from tests.test_project import PROJECT, PYPROJECT

ROOT = Path(__file__).parents[1]
LOCKS = {path.stem: path.read_text(encoding="utf-8") for path in (ROOT / "requirements").glob("*.txt")}
NEEDED = {"run": PROJECT["dependencies"], **PYPROJECT["dependency-groups"]}


def entries(text: str) -> list[tuple[str, str, str]]:
    """Name with version, marker and hashes of each entry of a list."""
    listed = re.findall(r"(?m)^(\S+)(?: ; ([^\\\n]*?))? \\\n((?: +--hash=\S+(?: \\)?\n?)+)", text)
    assert len(listed) == len(re.findall(r"(?m)^\S+==", text)), "an entry without a hash"
    return listed


@pytest.mark.parametrize("group", NEEDED)
def test_every_package_is_locked_with_the_sha_256_of_its_files(group: str) -> None:
    known = {name.partition("==")[0] for part in {"run", group} for name, _, _ in entries(LOCKS[part])}
    wanted = {re.split(r"[^\w.-]", line)[0].lower().replace("_", "-") for line in NEEDED[group]}
    assert wanted <= known, wanted - known
    assert all(
        re.fullmatch(r"( +--hash=sha256:[0-9a-f]{64}( \\)?\n?)+", hashes) for *_, hashes in entries(LOCKS[group])
    )
    assert not re.search(r"(?m)^-|@|://", LOCKS[group]), "no address, no option"


def test_lists_hold_for_every_python() -> None:
    markers = pytest.importorskip("packaging.markers")
    for python in ("3.10", "3.11", "3.12", "3.13", "3.14"):
        here = {"python_version": python, "python_full_version": f"{python}.1", "sys_platform": "linux"}
        for group in NEEDED:
            chosen = {
                name for part in {"run", group} for name, marker, _ in entries(LOCKS[part])
                if not marker or markers.Marker(marker).evaluate(here)
            }  # fmt: skip
            versions = dict(name.split("==") for name in chosen)
            assert len(chosen) == len(versions), f"two versions of one package on {python}"
            assert {"numpy", "hatchling", "editables", "sionna-rt"} <= set(versions)


def test_set_up_installs_nothing_without_a_hash() -> None:
    script = (ROOT / "tools/setup_venv").read_text(encoding="utf-8")
    calls = re.findall(r"(?m)^\s*install (.*)", script)
    assert len(calls) == 2
    assert "pip install --quiet --no-deps" in script
    assert script.count("pip install") == 1
    assert "--require-hashes" in calls[0]
    assert calls[1].startswith("--no-build-isolation --editable .")


@pytest.mark.parametrize("path", sorted((ROOT / ".github/workflows").glob("*.yml")), ids=lambda path: path.stem)
def test_workflows_use_actions_by_their_commit(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    used = re.findall(r"uses: (\S+)", text)
    assert used
    assert all(re.fullmatch(r"[\w./-]+@[0-9a-f]{40}", action) for action in used)
    assert "id-token: write" not in text or "if: github.ref_type == 'tag'" in text


def test_dashboards_of_dask_stay_on_this_machine() -> None:
    texts = [
        path.read_text(encoding="utf-8") for path in (*ROOT.glob("docs/**/*.md"), *ROOT.glob("docs/examples/*.py"))
    ]
    addresses = [a for text in texts for a in re.findall(r"dashboard[-_]address\"?[:=,]? \"?([\w.:]+)", text)]
    assert len(addresses) >= 3
    assert all(address.startswith("127.0.0.1:") for address in addresses)
    commands = [line for text in texts for line in re.findall(r"(?m)^dask (?:scheduler|worker).*", text)]
    assert commands
    assert all("--dashboard-address" in line for line in commands)


# Modules with which a program reaches other machines, and the files that may: one serves, one speaks TLS with Dask.
REACHING = {
    "socket", "ssl", "http", "urllib.request", "requests", "httpx", "aiohttp", "ftplib", "smtplib", "poplib", "imaplib",
    "telnetlib", "xmlrpc", "asyncio", "socketserver", "webbrowser", "distributed", "dask", "paramiko",
}  # fmt: skip
MAY = {"live/web.py": {"socket", "http"}, "jobs/workers.py": {"distributed"}}


def test_nothing_opens_a_socket_to_another_machine_but_dask() -> None:
    seen: dict[str, set[str]] = {}
    for room in (ROOT / "aerpaw_cmp", ROOT / "parsers"):
        for path in room.rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            # parsed only where the text names one: the tree of every file takes seconds
            for node in ast.walk(ast.parse(text if any(name in text for name in REACHING) else "")):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
                hit = {known for known in REACHING for name in names if f"{name}.".startswith(f"{known}.")}
                if hit:
                    seen.setdefault(path.relative_to(room).as_posix(), set()).update(hit)
    assert seen == MAY
    web = ast.parse((ROOT / "aerpaw_cmp/live/web.py").read_text(encoding="utf-8"))
    calls = [ast.unparse(node) for node in ast.walk(web) if isinstance(node, ast.Call)]
    # a datagram socket: "connect" looks up a route, and no packet goes out
    assert [call for call in calls if ".connect(" in call] == ["probe.connect(('192.0.2.1', 9))"]

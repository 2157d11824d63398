"""Any exception of a parser because of a file's content becomes one message about that file."""

import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

import aerpaw_cmp
from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import InputError, UsageError, parsed, parsing
from tests.long.fuzz_inputs import PLY, SMALL_FILES

ROOM = Path(aerpaw_cmp.__file__).parent


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (RecursionError(), "it is nested too deeply"),
        (ValueError("\x1b[2J" * 99), r"ValueError: \\x1b"),
        (MemoryError(), "it does not fit in memory"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "x"), "it is not UTF-8 text"),
        (KeyError("x"), "it has no 'x'"),
        (EOFError(), "EOFError"),
    ],
)
def test_any_fault_of_a_parser_is_about_the_file(error: Exception, words: str, tmp_path: Path) -> None:
    @parsed("a log")
    def read(path: Path) -> None:
        raise error

    with pytest.raises(InputError, match=rf"a.log: cannot be read \({words}.*expected a log") as caught:
        read(tmp_path / "a.log")
    assert len(str(caught.value)) < 1500
    assert caught.value.exit_code == 3


def test_messages_of_our_own_and_interrupts_pass_through() -> None:
    for own in (UsageError("a wrong key", path="b.yaml"), InputError("found", path="b.yaml", line=3)):
        with pytest.raises(type(own), match=str(own)), parsing("a.yaml"):
            raise own
    with pytest.raises(KeyboardInterrupt), parsing("a.yaml"):
        raise KeyboardInterrupt
    with pytest.raises(InputError, match=r"a\.log: cut"), parsing("a.log"):
        raise InputError("cut")


def line_of(module: str) -> Callable[..., int]:
    """Return a line of a module of this package that adds a number to its argument."""
    scope: dict[str, Any] = {"__name__": module}
    exec("def add(cell, *_, **__): return cell + 1", scope)
    return cast("Callable[..., int]", scope["add"])


def test_a_fault_of_our_own_is_not_blamed_on_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in ("aerpaw_cmp.flight.route_files", "aerpaw_parsers.nemo"):
        with pytest.raises(TypeError), parsing("a.log"):
            line_of(module)("text")
        with pytest.raises(InputError, match="TypeError"), parsing("a.log", any_shape=True):
            line_of(module)("text")
    with pytest.raises(InputError, match="TypeError"), parsing("a.log"):
        line_of("scipy.io")("text")
    with pytest.raises(InputError, match="it has no"), parsing("a.log"):
        line_of("aerpaw_cmp.flight.route_files")({}["x"])
    (tmp_path / "route.csv").write_bytes(SMALL_FILES["route:csv"][0])
    monkeypatch.setattr("aerpaw_cmp.flight.route_files._table", line_of("aerpaw_cmp.flight.route_files"))
    words = ["predict", str(tmp_path / "route.csv"), "--site", "lake_wheeler", "-o", str(tmp_path / "p"), "-q"]
    assert main(words) == 70
    assert "This is a fault of the program, not of your input" in capsys.readouterr().err


def nested(text: str) -> bytes:
    return text.encode() * 100_000


HOSTILE = {
    "route:csv": b"latitude,longitude,altitude\n" + b"1" * 200_000 + b"\n",
    "route:plan": b'{"fileType": "Plan", "mission": ' + nested("["),
    "report:json": nested("["),
    "receiver:json": nested('{"a":'),
    "mesh:ply": PLY[:-16] + b"\xff" * 16,
    "scene:xml": b"<scene>" + b"<shape>" * 20_000,
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_one_message(name: str, tmp_path: Path) -> None:
    place, read = tmp_path / name.replace(":", "."), SMALL_FILES[name][1]
    place.write_bytes(HOSTILE[name])
    with pytest.raises(InputError) as caught:
        read(place)
    assert caught.value.path is not None


@pytest.mark.usefixtures("few_pictures")
def test_through_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    route, metrics = tmp_path / "route.csv", tmp_path / "against" / "metrics.json"
    route.write_bytes(HOSTILE["route:csv"])
    metrics.parent.mkdir()
    metrics.write_bytes(HOSTILE["report:json"])
    (tmp_path / "scene.xml").write_text(
        '<scene><shape type="ply"><string name="filename" value="m.ply"/></shape></scene>'
    )
    (tmp_path / "m.ply").write_bytes(HOSTILE["mesh:ply"])
    for words, named in (
        (["predict", str(route), "--site", "lake_wheeler", "-o", str(tmp_path / "p")], "route.csv"),
        (["diff", str(metrics.parent), str(metrics.parent)], "metrics.json"),
        (["site", "import", str(tmp_path / "scene.xml"), "--origin", "local", "-o", str(tmp_path / "s.yaml")], "m.ply"),
    ):
        assert main([*words, "-q"]) == 3
        assert named in capsys.readouterr().err


PARSERS = {
    "json.loads", "json.load", "csv.reader", "csv.DictReader", "yaml.load", "yaml.parse", "np.load", "np.loadtxt",
    "np.frombuffer", "gzip.open", "gzip.decompress", "pd.read_csv", "struct.unpack", "struct.unpack_from",
    "zipfile.ZipFile", "tarfile.open", "ElementTree.fromstring", "h5py.File",
}  # fmt: skip
# Files that parse what this program wrote itself or ships, or that every caller of theirs reads inside ``parsing``.
OWN = {
    "common/kml.py": "writes; reads inside routes and map files",
    "common/native.py": "the child, whose every exception becomes a message",
    "common/yamlfile.py": "settings: errors of their own, at the line",
    "compare/gains.py": "bytes of its own keys",
    "jobs/bench.py": "lines that it wrote itself",
    "compare/statistics.py": "a packaged table",
    "flight/training.py": "text that is compared, never parsed; any file is asked for its head; what cannot be read names no log",
    "logs/dictionary.py": "a packaged table",
    "logs/files.py": "inside ingest and map files; its own list of what archives raise; inside ingest",
    "logs/text.py": "inside ingest",
    "logs/matfile.py": "inside ingest",
    "propagation/llvm.py": "the answer of a child",
    "propagation/engines.py": "sealed by this user",
    "maps/kriging.py": "bytes of its own arguments",
    "maps/store.py": "tiles that it wrote itself, checked by their SHA-256",
}


def test_every_reader_of_files_passes_through_the_same_place() -> None:
    seen = {}
    for path in ROOM.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text if any(f"{name}(" in text for name in PARSERS) else "")
        called = {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
        if called & PARSERS:
            seen[path.relative_to(ROOM).as_posix()] = bool(called & {"parsing", "parsed"})
    assert len(seen) > 20
    assert {name for name, safe in seen.items() if not safe} == set(OWN)

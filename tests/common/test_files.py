"""Atomic writing of files."""

import os
import socket
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from aerpaw_cmp.common.errors import InputError, UsageError, next_step
from aerpaw_cmp.common.files import atomic_path, inside, read_bounded
from aerpaw_cmp.common.geodesy import SiteFrame


def test_the_new_content_takes_the_name(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with atomic_path(target) as part:
        part.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")

    def half() -> None:
        with atomic_path(target) as part:
            part.write_text("half of the n")
            raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        half()
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_rights_follow_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        with atomic_path(tmp_path / "a") as part:
            part.write_bytes(b"")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


def test_a_missing_folder_is_an_oserror(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No such file"), atomic_path(tmp_path / "none" / "a") as part:
        part.write_bytes(b"")


def test_what_a_killed_run_left_is_removed_after_an_hour(tmp_path: Path) -> None:
    old, new, other = (tmp_path / name for name in (".a.x1.part", ".a.x2.part", ".b.x3.part"))
    for part in (old, new, other):
        part.write_text("half")
    os.utime(old, (0, 0))
    os.utime(other, (0, 0))
    with atomic_path(tmp_path / "a") as part:
        part.write_text("whole")
    assert {p.name for p in tmp_path.iterdir()} == {"a", new.name, other.name}


# Functions that read a complete file, by module, with the arguments that they need besides its path.
READERS_OF_WHOLE_FILES: dict[str, dict[str, Any]] = {
    "flight.settings.load_flight": {},
    "site.mapfiles.read_map_file": {},
    "site.mitsuba._root": {},
    "site.mitsuba.read_mesh": {},
    "site.antennas.read_pattern_text": {},
    "site.relief.read_dem": {"frame": SiteFrame(35.7, -78.7), "crs": "EPSG:4326"},
    "site.learned.read_sphere_csv": {},
    "site.antennas.read_gain_grid": {"variable": "rad_pat"},
    "jobs.calibrate_rank.read_receiver": {},
}


# Functions that read files of any size, or their first bytes.
READERS_OF_BEGINNINGS = ("logs.ingest.read_bytes", "jobs.sources._local_points", "jobs.site_scene.is_scene")


def read_by(name: str, path: Path) -> Any:
    module, _, function = name.rpartition(".")
    return getattr(import_module(f"aerpaw_cmp.{module}"), function)(path, **READERS_OF_WHOLE_FILES.get(name, {}))


@pytest.mark.parametrize("name", READERS_OF_WHOLE_FILES)
def test_a_file_that_is_far_too_large_is_not_read(name: str, tmp_path: Path) -> None:
    """A log named by mistake may be larger than the memory."""
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # a hole: takes no room
    with pytest.raises((InputError, UsageError), match=f"the file has {1 << 40} bytes.*at most"):
        read_by(name, path)


@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
@pytest.mark.parametrize("name", [*READERS_OF_WHOLE_FILES, *READERS_OF_BEGINNINGS])
def test_a_file_without_an_end_is_not_opened(
    name: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pipe without a writer blocks the program that opens it."""
    monkeypatch.chdir(tmp_path)  # the path of a socket has at most 107 bytes, and a blank in a path is quoted
    path = Path("special.csv")
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        with socket.socket(socket.AF_UNIX) as address:
            address.bind(path.name)
    with pytest.raises((InputError, UsageError), match=r"not a regular file; expected .*: a pipe") as caught:
        read_by(name, path)
    assert next_step(caught.value, ["report", "flight.yaml"]) == f"'ls -l {path}' shows what is there"


@pytest.mark.parametrize("size", [0, 1, (1 << 20) - 1, 1 << 20, (1 << 20) + 1])
def test_a_bounded_file_is_read_to_the_last_byte(size, tmp_path):
    content = bytes(i % 251 for i in range(size))
    (tmp_path / "a").write_bytes(content)
    assert read_bounded(tmp_path / "a", size) == content
    if size:
        with pytest.raises(
            InputError, match=f"the file has {size} bytes; expected a table of at most {size - 1} bytes"
        ):
            read_bounded(tmp_path / "a", size - 1, "a table")


@pytest.mark.parametrize(
    "name",
    ["", ".", "/etc/passwd", "../a", "b/../../a", "b/../a", "..\\a", "C:/a", "C:a", "\\a", "a\0b", "link", "up/a"],
)
def test_a_name_from_a_file_leads_to_no_place_outside_its_folder(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (tmp_path / "a").write_text("of others")
    (folder / "link").symlink_to(tmp_path / "a")
    (folder / "up").symlink_to(tmp_path)
    for plain in (False, True):
        with pytest.raises(InputError, match=r"leaves its folder|no file of its folder") as refused:
            inside(folder, name, tmp_path / "index.yaml", plain=plain)
        assert "\0" not in str(refused.value)


def test_names_inside_a_folder_are_places_below_it(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "reached").symlink_to(tmp_path / "real")  # a folder that is itself a link may be used
    source = tmp_path / "index"
    assert inside(tmp_path / "reached", "a.csv", source, plain=True) == tmp_path / "reached" / "a.csv"
    assert inside(tmp_path, "meshes\\x.ply", source) == inside(tmp_path, "meshes/x.ply", source)
    with pytest.raises(UsageError, match="no file of its folder"):
        inside(tmp_path, "meshes/x.ply", source, plain=True, error=UsageError)

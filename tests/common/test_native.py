"""Hostile files of native formats: none makes the reader open, or show, anything but the file itself."""

import ctypes
import io
import os
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from aerpaw_cmp.common import native
from aerpaw_cmp.common.errors import AerpawCmpError, InputError
from aerpaw_cmp.logs import matfile
from aerpaw_cmp.logs.flight_file import read_flight
from aerpaw_cmp.logs.matfile import read_arrays
from aerpaw_cmp.site.relief import read_dem

SECRET = b"PRIVATE-KEY-" + bytes(range(65, 91)) * 8 + b"-END"
HEAD = b"MATLAB 7.3 MAT-file".ljust(508) + b"\0\2IM"
ROWS = len(SECRET) // 8


def hdf5(fill: Callable[[h5py.File], object], user_block: bytes = b"") -> bytes:
    """Return the bytes of an HDF5 file. With a user block of 512 bytes it is a MATLAB 7.3 file."""
    file = io.BytesIO()
    with h5py.File(file, "w", userblock_size=len(user_block)) as book:
        fill(book)
    return user_block + file.getvalue()[len(user_block) :]


def flight(book: h5py.File) -> h5py.Group:
    book.attrs["format"], book.attrs["version"] = "aerpaw-cmp flight", 1
    return book.create_group("files/00000/streams/00000")


def external(book: h5py.Group, name: str, path: object, kind: str = "f8") -> None:
    book.create_dataset(name, (ROWS,), kind, external=[(str(path), 0, h5py.h5f.UNLIMITED)])


def virtual(book: h5py.Group, name: str, path: object) -> None:
    layout = h5py.VirtualLayout((ROWS,), "f8")
    layout[:] = h5py.VirtualSource(str(path), "key", (ROWS,))
    book.create_virtual_dataset(name, layout)


def names(folder: Path) -> list[str]:
    """Private files, named as a hostile file might name them."""
    here = Path("x.mat").absolute().parent
    return [str(folder / "key"), os.path.relpath(folder / "key", here), str(folder / "fifo"), str(folder / "key.h5"),
            "/dev/zero"]  # fmt: skip


def hostile(folder: Path) -> dict[str, bytes]:
    """Files by what they try."""
    made: dict[str, bytes] = {}
    for number, path in enumerate(names(folder)):
        made[f"external_{number}.mat"] = hdf5(lambda book, path=path: external(book, "RSRP", path), HEAD)
        made[f"external_{number}.h5"] = hdf5(lambda book, path=path: external(flight(book), "C00000", path))
        made[f"virtual_{number}.mat"] = hdf5(lambda book, path=path: virtual(book, "RSRP", path), HEAD)
        made[f"link_{number}.mat"] = hdf5(
            lambda book, path=path: book.__setitem__("RSRP", h5py.ExternalLink(path, "/key")), HEAD
        )
        made[f"link_{number}.h5"] = hdf5(
            lambda book, path=path: flight(book).__setitem__("C00000", h5py.ExternalLink(path, "/key"))
        )
        source = f"<SourceFilename>{path}</SourceFilename><SourceBand>1</SourceBand>"
        vrt = f'<VRTDataset rasterXSize="4" rasterYSize="4"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>{source}'
        made[f"vrt_{number}.tif"] = f"{vrt}</SimpleSource></VRTRasterBand></VRTDataset>".encode()
    made["soft.mat"] = hdf5(
        lambda book: (
            book.__setitem__("away", h5py.ExternalLink(names(folder)[3], "/")),
            book.__setitem__("RSRP", h5py.SoftLink("/away/key")),
        ),
        HEAD,
    )
    made["soft_to_itself.mat"] = hdf5(lambda book: book.__setitem__("RSRP", h5py.SoftLink("/RSRP")), HEAD)
    made["many_large.mat"] = hdf5(
        lambda book: [book.create_dataset(f"v{i}", (1 << 27,), "f8", chunks=(1 << 20,)) for i in range(40)], HEAD
    )
    made["one_large.h5"] = hdf5(lambda book: flight(book).create_dataset("C00000", (1 << 40,), "f8", chunks=(1 << 20,)))
    made["circle.h5"] = hdf5(lambda book: flight(book).__setitem__("again", book["files"]))
    body = zlib.compress(struct.pack("<II", 14, 1 << 30) + bytes(1 << 24), 1)
    made["level_5_bomb.mat"] = (
        b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + (struct.pack("<II", 15, len(body)) + body) * 40
    )
    made["wide.tif"] = b"II*\0" + struct.pack("<IH", 8, 3) + b"".join(
        struct.pack("<HHII", tag, 4, 1, 2**31 - 1) for tag in (256, 257, 258)
    ) + bytes(4)  # fmt: skip
    made["no_tiff.tif"] = b"II*\0" + b"\xff" * 64
    return made


def read(path: Path) -> object:
    """Run the command that reads a file of this name."""
    if path.suffix == ".tif":
        from aerpaw_cmp.common.geodesy import SiteFrame

        return read_dem(path, SiteFrame(35.7, -78.7))
    if path.suffix == ".h5":
        return read_flight(path)
    return read_arrays(path.read_bytes(), None)


class Watch:
    """Opened files below a folder, seen by the kernel (inotify), whoever opens them."""

    OPENED = 0x20

    def __init__(self, folder: Path) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._descriptor = self._libc.inotify_init1(os.O_NONBLOCK)
        assert self._descriptor >= 0
        assert self._libc.inotify_add_watch(self._descriptor, os.fsencode(folder), self.OPENED) >= 0

    def opened(self) -> list[str]:
        """Names of what was opened since the last call."""
        try:
            content = os.read(self._descriptor, 1 << 16)
        except BlockingIOError:
            return []
        entries, at = [], 0
        while at < len(content):
            size = struct.unpack_from("iIII", content, at)[3]
            entries.append(content[at + 16 : at + 16 + size].rstrip(b"\0").decode())
            at += 16 + size
        return entries


@pytest.fixture
def private(tmp_path: Path) -> Path:
    folder = tmp_path / "private"
    folder.mkdir()
    (folder / "key").write_bytes(SECRET)
    os.mkfifo(folder / "fifo")
    with h5py.File(folder / "key.h5", "w") as book:
        book["key"] = np.frombuffer(SECRET, dtype="f8")
    return folder


SAID = {
    "external_0.mat": "the data of 'RSRP' are in other files",
    "virtual_0.mat": "the data of 'RSRP' are in other files",
    "link_0.mat": "'RSRP' is a link, not data",
    "soft.mat": "is a link, not data",
    "external_0.h5": "the data of 'files/00000/streams/00000/C00000' are in other files",
    "link_0.h5": "'files/00000/streams/00000/C00000' is a link, not data",
    "many_large.mat": "declares 42949672960 bytes of data",
    "vrt_0.tif": "an ASCII grid names no coordinate system",
}


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="inotify sees what is opened")
def test_no_hostile_file_opens_or_shows_anything_but_itself(private: Path, tmp_path: Path) -> None:
    watch = Watch(private)
    (private / "key").read_bytes()
    assert watch.opened() == ["key"], "the watch sees what is opened"
    files = hostile(private)
    assert len(files) == 38
    for name, content in files.items():
        path = tmp_path / name
        path.write_bytes(content)
        begun = time.process_time()
        try:
            shown = repr(read(path))
        except AerpawCmpError as error:
            shown = str(error)
        assert SAID.get(name, "") in shown
        assert watch.opened() == [], name
        assert "root:" not in shown, name
        assert SECRET[:12].decode() not in shown, name
        assert time.process_time() - begun < 30, name


def test_variables_of_an_older_file_are_bounded_together(monkeypatch: pytest.MonkeyPatch) -> None:
    file = io.BytesIO()
    savemat(file, {f"v{i}": np.zeros(100_000) for i in range(20)}, do_compression=True)
    assert len(read_arrays(file.getvalue(), None)) == 20
    monkeypatch.setattr(matfile, "FREE_BYTES", 1 << 20)
    with pytest.raises(InputError, match="unpack to more than"):
        read_arrays(file.getvalue(), None)


def test_what_the_checks_would_miss_the_kernel_refuses(private: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reader without its own checks, in the child: the file is there, and cannot be opened."""
    script = (
        "import sys, os, socket; from aerpaw_cmp.common import native\n"
        "reader = native.READERS['hdf5']()\n"
        "native._refuse_elsewhere = lambda place, item: None\n"
        "data = sys.stdin.buffer.read(); native.give_up_rights()\n"
        "print(native.answer(reader, data)[2])\n"
        "for attempt in (lambda: open('/etc/passwd'), os.pipe, lambda: os.dup(0), socket.socket):\n"
        "    try:\n        attempt()\n        print('opened')\n    except OSError as error: print(error.errno)\n"
    )
    content = hostile(private)["external_0.h5"]
    done = subprocess.run([sys.executable, "-c", script], input=content, capture_output=True, check=True)
    said = done.stdout.decode()
    assert said.endswith("24\n24\n22\n24\n")  # EMFILE; dup calls it EINVAL
    assert "opened" not in said
    assert "unable to open external raw data file" in said or "Can't" in said


def test_variables_named_as_arguments_are_variables() -> None:
    content = hdf5(lambda book: [book.__setitem__(name, np.eye(2)) for name in ("file", "allow_pickle", "args")], HEAD)
    assert set(read_arrays(content, None)) == {"file", "allow_pickle", "args"}


def test_a_module_in_the_working_folder_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A third-party folder of logs may contain a numpy.py."""
    for name in ("numpy", "h5py", "aerpaw_cmp"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    assert set(native.read("matlab", hdf5(lambda book: book.__setitem__("x", np.eye(2)), HEAD))[0]) == {"x"}
    assert not (tmp_path / "ran").exists()


def test_a_child_that_dies_is_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "_CHILD", "import os; os.abort()")
    with pytest.raises(InputError, match="not an HDF5 file, or a damaged one \\(its library ended with code -6\\)"):
        native.read("hdf5", b"x")

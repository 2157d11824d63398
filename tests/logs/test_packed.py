"""Logs packed by gzip, bzip2 or xz are what they are unpacked, large or small, or one message."""

import bz2
import gzip
import hashlib
import io
import lzma
import subprocess
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.errors import AerpawCmpError, InputError
from aerpaw_cmp.logs import files
from aerpaw_cmp.logs.ingest import ingest, sniffers_of
from aerpaw_cmp.logs.readers import ReadOptions
from tests.frames import assert_same_result
from tests.parsers.samples import sounder_log

OPTIONS = ReadOptions(timezone="America/New_York")
LOG = sounder_log(2000)
Pack = Callable[[bytes], bytes]
PACKERS = pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress], ids=["gzip", "bzip2", "xz"])


def in_streams(pack: Pack, data: bytes) -> bytes:
    """Several streams behind each other, as parallel packers write them."""
    return b"".join(pack(data[i : i + 5000]) for i in range(0, len(data), 5000))


@PACKERS
@pytest.mark.parametrize("piece", [700, 2 << 20])
def test_a_packed_log_is_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pack: Pack, piece: int) -> None:
    (tmp_path / "a_power_log.txt").write_bytes(LOG)
    (plain,) = ingest(tmp_path, options=OPTIONS)
    monkeypatch.setattr(files, "_PIECE", piece)
    for i, content in enumerate((pack(LOG), in_streams(pack, LOG))):
        place = tmp_path / f"b{i}_power_log.txt.packed"
        place.write_bytes(content)
        (file,) = ingest(place, options=OPTIONS)
        assert_same_result(file.result, plain.result)
        assert file.sha256 == plain.sha256 == hashlib.sha256(LOG).hexdigest()
        assert sniffers_of(place) == ["sounder_log"]


@PACKERS
def test_a_packed_tar_is_a_folder(tmp_path: Path, pack: Pack) -> None:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as book:
        for name, data in (("LW1/a_power_log.txt", LOG), ("LW2/b_power_log.txt.x", pack(LOG))):
            member = tarfile.TarInfo(name)
            member.size = len(data)
            book.addfile(member, io.BytesIO(data))
    (tmp_path / "set.tar.packed").write_bytes(pack(out.getvalue()))
    ingested = ingest(tmp_path / "set.tar.packed", options=OPTIONS)
    assert [file.result.reader for file in ingested] == ["sounder_log"] * 2
    assert_same_result(ingested[0].result, ingested[1].result)


@PACKERS
def test_what_is_cut_damaged_or_a_bomb_is_one_message(tmp_path: Path, pack: Pack) -> None:
    intact = pack(LOG)
    place = tmp_path / "a_power_log.txt.packed"
    bomb = pack(b"0" * 3_000_000)
    rng = np.random.default_rng(2)
    damaged = []
    for at in rng.integers(12, len(intact), 8).tolist():
        damaged.append(intact[:at] + bytes([intact[at] ^ 0x55]) + intact[at + 1 :])
    for content in (intact[:-9], intact[: len(intact) // 2], intact[:20], pack(b""), bomb, *damaged):
        place.write_bytes(content)
        with pytest.raises(AerpawCmpError):
            ingest(place, options=OPTIONS)
    place.write_bytes(bomb)
    # deflate cannot compress by this ratio: the claimed size of a gzip file is checked, and it is not a log
    with pytest.raises(InputError, match="no record" if pack is gzip.compress else "times its size"):
        ingest(place, options=OPTIONS, reader="sounder_log")
    place.write_bytes(intact[:-9])
    with pytest.raises(InputError, match="ends too early"):
        ingest(place, options=OPTIONS, reader="sounder_log")


def test_words_that_begin_as_a_packed_file_does_are_text() -> None:
    assert files.packed_form(b"BZh, a word\n") is None
    assert files.packed_form(bz2.compress(b"a")) == "bzip2"
    assert files.packed_form(lzma.compress(b"a")) == "xz"


def test_logs_are_read_by_a_python_without_lzma() -> None:
    """pyenv builds Python without it if its headers are missing."""
    code = "import sys; sys.modules['lzma'] = None; import aerpaw_cmp.logs.files"
    subprocess.run([sys.executable, "-c", code], check=True)

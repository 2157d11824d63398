"""Check that large logs read in pieces of any size give the same records as in one piece.

The stored rejected lines are limited.
"""

import hashlib
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.logs import files
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import by_name
from aerpaw_cmp.logs.records import KEPT_REJECTED
from tests.frames import assert_same_result
from tests.parsers.samples import OPTIONS, sounder_log


@given(cuts=st.lists(st.floats(0, 1), max_size=12), damage=st.lists(st.tuples(st.floats(0, 1), st.binary(max_size=3))))
@settings(max_examples=60, deadline=None)
def test_pieces_of_any_size_are_one_piece(cuts: list[float], damage: list[tuple[float, bytes]]) -> None:
    log = bytearray(sounder_log(300))
    for at, new in damage[:5]:
        log[int(at * len(log)) : int(at * len(log)) + 2] = new
    ends = sorted({0, len(log), *(int(cut * len(log)) for cut in cuts)})
    pieces = [bytes(log[a:b]) for a, b in pairwise(ends)]
    reader = by_name("sounder_log")
    assert reader.read_pieces is not None
    assert_same_result(reader.read_pieces(files.whole_lines(pieces), OPTIONS), reader.read(bytes(log), OPTIONS))


def test_a_file_is_read_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = b"\xef\xbb\xbf" + sounder_log(2000)
    (tmp_path / "x_power_log.txt").write_bytes(data)
    (at_once,) = ingest(tmp_path, options=OPTIONS)
    monkeypatch.setattr(files, "PIECE_BYTES", 999)
    (file,) = ingest(tmp_path, options=OPTIONS)
    assert_same_result(file.result, at_once.result)
    assert file.sha256 == hashlib.sha256(data).hexdigest()


def test_of_many_rejected_lines_the_first_are_kept_and_all_are_counted() -> None:
    good = b"".join(line for line in sounder_log(50).splitlines(keepends=True) if b"*" not in line)
    bad = good.replace(b"] 0", b"] 9") * 60 + b"talk\n" * 5
    result = by_name("sounder_log").read(good + bad, OPTIONS)
    lines = good.count(b"\n")
    assert result.rejected_count == bad.count(b"\n")
    assert [line.number for line in result.rejected] == list(range(lines + 1, lines + 1 + KEPT_REJECTED))
    octal, talk = result.reasons
    assert (octal.count, octal.first, octal.last) == (60 * lines, lines + 1, 61 * lines)
    assert (talk.count, talk.first, talk.last) == (5, 61 * lines + 1, 61 * lines + 5)
    table = by_name("aadm_snr").read(b"time,snr_lw1\n" + b"talk,x,y\n" * 5000, OPTIONS)
    assert (len(table.rejected), table.rejected_count) == (KEPT_REJECTED, 5000)

"""The MATLAB reader gives what SciPy gives on whole files, and a message on damaged ones."""

import contextlib
import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.logs.matfile import read_arrays
from tests.real_logs import REAL

KINDS = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")


def saved(compressed: bool, **variables: object) -> bytes:
    from scipy.io import savemat

    file = io.BytesIO()
    savemat(file, variables, do_compression=compressed)
    return file.getvalue()


@settings(max_examples=60, deadline=None)
@given(
    array=st.sampled_from(KINDS).flatmap(
        lambda kind: hnp.arrays(kind, hnp.array_shapes(min_dims=2, max_dims=3, min_side=0, max_side=6))
    ),
    compressed=st.booleans(),
)
def test_numeric_arrays_come_back(array: np.ndarray, compressed: bool) -> None:
    arrays = read_arrays(saved(compressed, values=array, other=np.eye(2)), ["values"])
    assert list(arrays) == ["values"]
    assert arrays["values"].dtype == array.dtype
    np.testing.assert_array_equal(arrays["values"], array)


@pytest.mark.parametrize("compressed", [False, True])
def test_text_and_what_is_left_out(compressed: bool) -> None:
    rows = np.array(["2024-07-15 11:48:16.776", "2024-07-15 11:48:17.1  "])
    left_out = {"pair": {"a": 1.0}, "cells": np.array([[1, "x"]], dtype=object)}
    arrays = read_arrays(saved(compressed, clock=rows, column=rows[:, None], z=np.array([[1j]]), **left_out), None)
    assert set(arrays) == {"clock", "column", "z"}, "structures and cells are left out"
    assert arrays["column"].tolist() == arrays["clock"].tolist()
    assert arrays["z"].tolist() == [[1j]]
    assert arrays["clock"].tolist() == ["2024-07-15 11:48:16.776", "2024-07-15 11:48:17.1"]


def test_matlab_stores_small_integers_for_doubles_and_small_elements() -> None:
    """MATLAB writes whole-numbered doubles as bytes, and short data inside the tag.

    Both are written by hand from the specification.
    """
    import struct

    flags = struct.pack("<IIII", 6, 8, 6, 0)
    dims = struct.pack("<IIii", 5, 8, 1, 3)
    name = struct.pack("<I4s", (1 << 16) | 1, b"v")
    values = struct.pack("<I4s", (3 << 16) | 2, bytes([7, 8, 250]))
    body = flags + dims + name + values
    data = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 14, len(body)) + body
    assert read_arrays(data, ["v"])["v"].tolist() == [[7.0, 8.0, 250.0]]
    from scipy.io import loadmat

    assert loadmat(io.BytesIO(data))["v"].tolist() == [[7.0, 8.0, 250.0]]


@settings(max_examples=300, deadline=None)
@given(data=st.data(), compressed=st.booleans())
def test_damaged_files_are_a_message(data: st.DataObject, compressed: bool) -> None:
    content = bytearray(saved(compressed, theta=np.linspace(0, 1, 40), clock=np.array(["12:00:00", "12:00:01"])))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    with contextlib.suppress(InputError):
        read_arrays(bytes(content), None)


def test_a_huge_claim_is_refused_before_memory_is_taken() -> None:
    content = bytearray(saved(False, v=np.zeros((2, 2))))
    at = content.index(np.array([2, 2], dtype="<i4").tobytes())
    content[at : at + 8] = np.array([2**31 - 1, 2**31 - 1], dtype="<i4").tobytes()
    with pytest.raises(InputError, match="32 bytes for"):
        read_arrays(bytes(content), None)


@pytest.mark.field
def test_real_files_equal_scipy() -> None:
    from scipy.io import loadmat

    files = sorted(REAL.rglob("*.mat"))
    assert len(files) >= 4
    for path in files:
        ours = read_arrays(path.read_bytes(), None)
        theirs = {name: value for name, value in loadmat(path).items() if not name.startswith("__")}
        assert set(ours) == set(theirs), path.name
        for name, value in theirs.items():
            if value.dtype.kind == "U":
                assert [str(row).strip() for row in ours[name]] == [str(row).strip() for row in value]
            else:
                np.testing.assert_array_equal(ours[name], value)

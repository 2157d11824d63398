"""Numeric and character arrays of MATLAB level-5 files, read so that a damaged file only causes a message.

SciPy's reader is compiled code that trusts the file: a single wrong byte can end the process with a segmentation fault.
Here every size is checked before it is used. Full numeric arrays and character matrices, plain or compressed, are read,
because merged flights and gain grids consist of these. Variables of other classes are ignored. Layout: "MAT-File
Format" (MathWorks), chapter 1, level 5.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import islice
from typing import NamedTuple

import numpy as np

from ..common.errors import InputError
from ..common.units import AnyArray

MAGIC = b"MATLAB 5.0 MAT-file"
# First bytes of a version 7.3 file: HDF5 after a block of 512 bytes.
MAGIC_73 = b"MATLAB 7.3 MAT-file"
# Largest size of a variable after decompression.
MOST_BYTES = 1 << 30
MOST_RATIO = 100
# All compressed variables together unpack to at most these bytes plus ``MOST_RATIO`` times the size of the file.
FREE_BYTES = 1 << 28

_COMPRESSED, _MATRIX, _INT8, _INT32, _UINT32 = 15, 14, 1, 5, 6
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_CHARACTERS = 4
_ENCODINGS = {2: "utf-8", 16: "utf-8", 4: "utf-16", 17: "utf-16", 18: "utf-32"}


class _Element(NamedTuple):
    kind: int
    body: bytes


def _damaged(what: str) -> InputError:
    return InputError(f"the MATLAB file is damaged ({what})", expected="a complete file", cause="a truncated download")


def read_arrays(data: bytes, wanted: Collection[str] | None) -> dict[str, AnyArray]:
    """Return the wanted variables of a file.

    Parameters
    ----------
    data : bytes
        The file.
    wanted : collection of str or None
        Names of the variables, or None for all. The result omits variables that are missing or of another class.

    Returns
    -------
    dict of str to ndarray
        Numeric arrays in their shape; a character matrix as an array of its rows.

    Raises
    ------
    InputError
        If the file is neither a level-5 nor a version 7.3 file, or a size or type in the file is impossible.

    Notes
    -----
    Version 7.3 is HDF5: arrays are transposed, and text is stored as 16-bit codes with the attribute ``MATLAB_class``.
    """
    if data.startswith(MAGIC_73):
        return _read_hdf5(data, wanted)
    if not data.startswith(MAGIC) or len(data) < 128:
        raise InputError(
            "not a MATLAB file",
            expected="a file that begins with 'MATLAB 5.0 MAT-file' or 'MATLAB 7.3 MAT-file'",
            cause="another kind of file",
        )
    # the letters MI as a 16-bit number, in the order of the machine that wrote them
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise _damaged("no byte order")
    arrays: dict[str, AnyArray] = {}
    allowance = FREE_BYTES + MOST_RATIO * len(data)
    for element in _elements(data, 128, order, padded=False):
        variable = _inflated(element, order, min(allowance, MOST_BYTES)) if element.kind == _COMPRESSED else element
        # one allowance for all variables: many small zip bombs are as bad as a large one
        allowance -= len(variable.body) if element.kind == _COMPRESSED else 0
        if variable.kind != _MATRIX:
            raise _damaged(f"element of type {variable.kind} where a variable was expected")
        name, array = _variable(variable.body, order, wanted)
        if array is not None:
            arrays[name] = array
    return arrays


def names_of(head: bytes) -> list[str]:
    """Return the names of the variables of a level-5 file that begin in its first bytes."""
    order, names = "<" if head[126:128] == b"IM" else ">", []
    with suppress(InputError, struct.error, zlib.error):
        for element in islice(_elements(head, 128, order, padded=False, cut=True), 64):
            body = element.body
            if element.kind == _COMPRESSED:
                # 256 bytes are enough for the tag of the matrix, flags, dimensions and a name
                body = zlib.decompressobj().decompress(body, 256)[8:]
            names.append(_head_of(_elements(body, 0, order, padded=True, cut=True))[2])
    return names


def _read_hdf5(data: bytes, wanted: Collection[str] | None) -> dict[str, AnyArray]:
    """Return the wanted variables of a version 7.3 file, read in a separate process."""
    from ..common.native import read

    variables, notes = read("matlab", data)
    chosen = {name: values.T for name, values in variables.items() if wanted is None or name in wanted}
    text = {name for name, kind in notes["classes"].items() if kind == "char"}
    for name in text & chosen.keys():
        if chosen[name].ndim == 2:
            chosen[name] = _texts([map(chr, row) for row in chosen[name].astype(np.uint16).tolist()])
    return chosen


def _texts(rows: Sequence[Iterable[str]]) -> AnyArray:
    """Return rows of characters as texts without trailing spaces."""
    return np.array(["".join(row).rstrip("\0").rstrip() for row in rows] or [""], dtype=np.str_)[: len(rows)]


def _elements(data: bytes, at: int, order: str, *, padded: bool, cut: bool = False) -> Iterator[_Element]:
    """Yield elements one after the other, padded to eight bytes. Inside a variable, an element may have the small form.

    The last element of data that are ``cut`` may be truncated.
    """
    while at < len(data):
        if len(data) - at < 8:
            if data[at:].strip(b"\0"):
                raise _damaged("it ends inside a tag")
            return
        kind, size = struct.unpack_from(order + "II", data, at)
        # in a small element, the first word contains size and type, and the second word the bytes
        if padded and kind >> 16:
            size, kind = kind >> 16, kind & 0xFFFF
            if size > 4:
                raise _damaged("a small element of more than 4 bytes")
            yield _Element(kind, data[at + 4 : at + 4 + size])
            at += 8
            continue
        if size > len(data) - at - 8 and not cut:
            raise _damaged(f"{size} bytes announced, {len(data) - at - 8} left")
        yield _Element(kind, data[at + 8 : at + 8 + size])
        at += 8 + (-(-size // 8) * 8 if padded else size)


def _inflated(element: _Element, order: str, most: int) -> _Element:
    machine = zlib.decompressobj()
    try:
        # at least 1, because 0 would mean that there is no limit
        plain = machine.decompress(element.body, max(most, 1))
    except zlib.error as error:
        raise _damaged(str(error)) from None
    if machine.unconsumed_tail:
        raise InputError(
            f"the variables of the MATLAB file unpack to more than {most} further bytes",
            expected=f"at most {MOST_BYTES >> 20} MiB each, in all {MOST_RATIO} times the size of the file",
            cause="a file crafted to fill the memory",
        )
    if not machine.eof:
        raise _damaged("a compressed variable is truncated")
    variable = next(_elements(plain, 0, order, padded=False), None)
    if variable is None:
        raise _damaged("an empty variable")
    return variable


def _variable(body: bytes, order: str, wanted: Collection[str] | None) -> tuple[str, AnyArray | None]:
    """Return the name and the array of a variable. The array is None if it is not wanted or of another class."""
    parts = _elements(body, 0, order, padded=True)
    flags, dimensions, title = _head_of(parts)
    # read signed sizes: a negative size means damage, and as an unsigned number it would be huge
    shape = struct.unpack(f"{order}{len(dimensions) // 4}i", dimensions)
    if min(shape) < 0:
        raise _damaged("a negative dimension")
    word = struct.unpack(order + "II", flags)[0]
    family, is_complex = word & 0xFF, bool(word & 0x0800)
    unwanted = wanted is not None and title not in wanted
    if unwanted or (family not in _CLASSES and family != _CHARACTERS):
        return title, None
    values = next(parts, None)
    if values is None:
        raise _damaged(f"variable {title!r} without values")
    if family == _CHARACTERS:
        return title, _rows(values, shape, order)
    real = _numbers(values, shape, order, _CLASSES[family])
    if not is_complex:
        return title, real
    imaginary = next(parts, None)
    if imaginary is None:
        raise _damaged(f"complex variable {title!r} without imaginary part")
    with np.errstate(all="ignore"):
        array = real.astype(np.complex128)
        array.imag = _numbers(imaginary, shape, order, _CLASSES[family])  # 1j * inf has a NaN real part
    return title, array


def _head_of(parts: Iterator[_Element]) -> tuple[bytes, bytes, str]:
    """Return flags, dimensions and name of a variable, which are its first three elements."""
    head = [*islice(parts, 3)]
    if [element.kind for element in head] != [_UINT32, _INT32, _INT8]:
        raise _damaged("a variable without flags, dimensions or name")
    flags, dimensions, name = (element.body for element in head)
    if len(flags) != 8 or len(dimensions) < 8 or len(dimensions) % 4:
        raise _damaged("dimensions that are not numbers")
    return flags, dimensions, name.decode("ascii", errors="replace")


def _numbers(values: _Element, shape: tuple[int, ...], order: str, kind: str) -> AnyArray:
    stored = _STORED.get(values.kind)
    if stored is None:
        raise _damaged(f"values of type {values.kind}")
    count = math.prod(shape)
    if len(values.body) != count * np.dtype(stored).itemsize:
        raise _damaged(f"{len(values.body)} bytes for {count} values")
    with np.errstate(all="ignore"):  # damaged bytes may be any number
        return np.frombuffer(values.body, dtype=order + stored).astype(kind).reshape(shape, order="F")


def _rows(values: _Element, shape: tuple[int, ...], order: str) -> AnyArray:
    """Return the rows of a character matrix as text, without trailing spaces."""
    encoding = _ENCODINGS.get(values.kind)
    if len(shape) > 2 and math.prod(shape) == shape[0] * shape[-1]:
        shape = shape[0], shape[-1]  # SciPy writes a column of texts with an additional dimension
    if encoding is None or len(shape) != 2:
        raise _damaged("characters of an unknown kind")
    if encoding != "utf-8":
        encoding += "-le" if order == "<" else "-be"
    text = values.body.decode(encoding, errors="replace")
    if len(text) != math.prod(shape):
        raise _damaged(f"{len(text)} characters for {shape[0]} rows of {shape[1]}")
    return _texts([text[row :: shape[0]] for row in range(shape[0])])  # MATLAB stores columns one after the other

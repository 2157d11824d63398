"""Arrays of an untrusted HDF5 file, read in a process of its own.

HDF5 takes some damage for data, ends the process on other, and never comes back from a third: none of that may
happen to the caller. ``python -m aerpaw_cmp.logs.hdf5_arrays`` reads a file from standard input and writes its
arrays as ``.npz``.
"""

from __future__ import annotations

import io
import subprocess
import sys

import numpy as np

from ..common.units import AnyArray

MOST_BYTES = 1 << 30
"""Of one array."""
SECONDS = 120.0
"""After which a file counts as damaged."""


def read(data: bytes) -> dict[str, AnyArray]:
    """Numeric arrays of the root group, and character codes as texts (MATLAB 7.3).

    Raises
    ------
    ValueError
        If the file cannot be read, with the reason.
    """
    command = [sys.executable, "-m", __spec__.name if __spec__ else "aerpaw_cmp.logs.hdf5_arrays"]
    try:
        child = subprocess.run(command, input=data, capture_output=True, timeout=SECONDS, check=False)
    except subprocess.TimeoutExpired:
        raise ValueError(f"HDF5 did not come back within {SECONDS:.0f} s") from None
    if child.returncode != 0:
        said = child.stderr.decode("utf-8", "replace").strip().splitlines()
        raise ValueError(said[-1] if said else f"HDF5 ended with code {child.returncode}")
    with np.load(io.BytesIO(child.stdout), allow_pickle=False) as book:
        return {name: book[name] for name in book.files}


def _arrays(data: bytes) -> dict[str, AnyArray]:
    import h5py

    found: dict[str, AnyArray] = {}
    with h5py.File(io.BytesIO(data), "r") as book:
        for name, item in book.items():
            if not isinstance(item, h5py.Dataset) or item.dtype.kind not in "fiu" or item.nbytes > MOST_BYTES:
                continue
            values = np.asarray(item[()]).T
            family = item.attrs.get("MATLAB_class", b"")
            text = family in (b"char", "char") and values.ndim == 2
            found[str(name)] = _letters(values) if text else values
    return found


def _letters(codes: AnyArray) -> AnyArray:
    """Rows of a matrix of character codes as text, trailing blanks removed."""
    return np.array(["".join(map(chr, row)).rstrip() for row in codes.tolist()] or [""], dtype=np.str_)[: len(codes)]


def main() -> None:
    """The child: a file in, its arrays out."""
    try:
        found = _arrays(sys.stdin.buffer.read())
    except Exception as error:  # h5py raises OSError, KeyError, RuntimeError, ... on damage, all meaning the same
        sys.exit(f"{type(error).__name__}: {error}")
    np.savez(sys.stdout.buffer, allow_pickle=False, **found)


if __name__ == "__main__":
    main()

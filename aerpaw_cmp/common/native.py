"""Reading of third-party files in native formats (HDF5, GeoTIFF), in a child process that cannot open other files.

Libraries of these formats are C code. A malicious file can make them open other files (external storage and links,
virtual data sets, VRT), run forever, or read beyond the end of a buffer. The child receives the bytes of the file,
loads the library, and then drops its privileges. After that, it cannot create a descriptor (RLIMIT_NOFILE 0: no file,
socket or process pipe), use more than ``_MOST_MEMORY``, or more than ``SECONDS`` of processor time. Only then does it
read the bytes. The result is a list of plain arrays.

Without a ``resource`` module (Windows) these limits do not apply, but the content of the file is still checked.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from .errors import InputError, one_line
from .units import AnyArray

# Limit for all arrays of a file together [bytes].
MOST_BYTES = 1 << 30
MOST_RATIO = 200
# A file may declare this many bytes of data, plus ``MOST_RATIO`` times its own size, because text compresses to a
# hundredth.
FREE_BYTES = 1 << 26
_MOST_ITEMS = 100_000
_MOST_MEMORY = 4 << 30
SECONDS = 60
_REFUSED = 3
_NAMES = {"hdf5": "an HDF5", "matlab": "a MATLAB 7.3", "netcdf": "a NetCDF-4", "geotiff": "a GeoTIFF"}

_CHILD = "import sys; sys.path[:] = sys.argv[2:]; from aerpaw_cmp.common.native import main; main(sys.argv[1])"


def read(kind: str, data: bytes) -> tuple[dict[str, AnyArray], dict[str, Any]]:
    """Return the arrays of a file, and notes about them.

    Parameters
    ----------
    kind : str
        ``hdf5`` returns numeric data sets by their path, with the notes ``attributes`` of the root and ``classes`` of
        MATLAB variables. ``matlab`` returns the same for the root group only. ``netcdf`` also returns texts, and the
        notes ``dims`` and ``units`` by variable. ``geotiff`` returns ``band``, with the notes ``transform crs unit``.
    data : bytes
        The file.

    Returns
    -------
    dict of str to ndarray, dict

    Raises
    ------
    InputError
        If the file is damaged, declares too much data, or contains data that are stored in another file.
    """
    code, out, err = _in_child(kind, data)
    if code == 0:
        return _unpacked(out)
    lines = err.decode("utf-8", "replace").strip().splitlines()
    if code == _REFUSED and lines:
        raise InputError(**json.loads(lines[-1]))
    reason = lines[-1] if lines else f"its library ended with code {code}"
    raise InputError(f"not {_NAMES[kind]} file, or a damaged one ({reason})", cause="a truncated download")


def _in_child(kind: str, data: bytes) -> tuple[int, bytes, bytes]:
    """Return exit code, standard output and standard error of the child."""
    # use Python's isolated mode with the paths of this process, because an untrusted working folder may contain a
    # numpy.py
    command = [sys.executable, "-I", "-c", _CHILD, kind, *(path for path in sys.path if path)]
    try:
        # set a timeout, because the limit of processor time does not end a child that only waits
        child = subprocess.run(command, input=data, capture_output=True, timeout=2 * SECONDS, check=False, env=_ENVIRON)
    except subprocess.TimeoutExpired:
        raise InputError(f"the file cannot be read within {2 * SECONDS} s", cause="a damaged file") from None
    return child.returncode, child.stdout, child.stderr


# The environment variables of the child process: no HDF5_PLUGIN_PATH, no GDAL_DRIVER_PATH, and one thread, because each
# thread needs memory.
_ENVIRON = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR"}


def _unpacked(content: bytes) -> tuple[dict[str, AnyArray], dict[str, Any]]:
    with np.load(io.BytesIO(content), allow_pickle=False) as book:
        head = json.loads(book["arr_0"].tobytes())
        return {name: book[f"arr_{i}"] for i, name in enumerate(head["names"], 1)}, head["notes"]


# --- the child --------------------------------------------------------------------------------------


def main(kind: str) -> None:
    """Read a file from standard input and write its arrays to standard output."""
    # load the libraries first, because they cannot be loaded after the privileges are dropped
    reader = READERS[kind]()
    data = sys.stdin.buffer.read()
    give_up_rights()
    code, out, err = answer(reader, data)
    sys.stdout.buffer.write(out)
    sys.stderr.buffer.write(err)
    sys.exit(code)


def answer(reader: Read, data: bytes) -> tuple[int, bytes, bytes]:
    """Return the exit code, the arrays of a file for standard output, and the error for standard error."""
    try:
        arrays, notes = reader(data)
    except InputError as error:
        refusal = {"found": error.found, "expected": error.expected, "cause": error.cause}
        return _REFUSED, b"", json.dumps(refusal).encode()
    except Exception as error:  # libraries raise OSError, KeyError, RuntimeError, ... for a damaged file
        return 1, b"", f"{type(error).__name__}: {one_line(str(error))}".encode()
    head = json.dumps({"names": list(arrays), "notes": notes}).encode()
    out = io.BytesIO()
    # pass arrays by position, because names such as 'file' and 'allow_pickle' are keywords of savez
    np.savez(out, np.frombuffer(head, dtype=np.uint8), *arrays.values())
    return 0, out.getvalue(), b""


def give_up_rights() -> None:
    """Limit the memory and processor time of this process, and forbid it to open files."""
    try:
        import resource
    except ImportError:
        return
    limits = (("RLIMIT_NOFILE", 0), ("RLIMIT_AS", _MOST_MEMORY), ("RLIMIT_CPU", SECONDS), ("RLIMIT_CORE", 0))
    for name, most in limits:
        resource.setrlimit(getattr(resource, name), (most, most))


Read = Callable[[bytes], tuple[dict[str, AnyArray], dict[str, Any]]]


def _hdf5(depth: int, netcdf: bool = False) -> Read:
    """Return the reader of HDF5 files, after loading all modules that it needs."""
    import encodings.ascii
    import encodings.latin_1
    import encodings.utf_16  # noqa: F401  Python loads them when a text needs them

    import h5py

    def read(data: bytes) -> tuple[dict[str, AnyArray], dict[str, Any]]:
        with h5py.File(h5py.h5f.open_file_image(data)) as book:
            items = _data_sets(book, depth, "fiubSO" if netcdf else "fiub")
            most = min(MOST_BYTES, MOST_RATIO * len(data) + FREE_BYTES)
            total = sum(item.nbytes for item in items.values())
            if total > most:
                raise InputError(
                    f"the file of {len(data)} bytes declares {total} bytes of data",
                    expected=f"at most {most}",
                    cause="a file crafted to fill the memory",
                )
            classes = {name: _text(item.attrs.get("MATLAB_class", b"")) for name, item in items.items()}
            # NetCDF stores the number of an attribute as an array of one element
            attributes = {name: _text(np.ravel(value)[0]) for name, value in book.attrs.items() if np.size(value) == 1}
            notes: dict[str, Any] = {
                "attributes": attributes,
                "classes": {name: word for name, word in classes.items() if word},
            }
            if netcdf:
                notes["dims"] = {name: _dimensions(item) for name, item in items.items()}
                notes["units"] = {n: unit for n, item in items.items() if (unit := _text(item.attrs.get("units", b"")))}
            return {name: _plain(np.asarray(item[()])) for name, item in items.items()}, notes

    with h5py.File("warm", "w", driver="core", backing_store=False) as book:
        book.create_dataset("x", data=np.arange(300.0), compression="gzip", shuffle=True)
        book["y"] = np.ones(3, dtype=np.bool_)
        if netcdf:
            book["words"] = np.array(["a", "b"], dtype=h5py.string_dtype())
            book["x"].make_scale("x")
            book["z"] = np.zeros(300)
            book["z"].dims[0].attach_scale(book["x"])
        for name, value in (("version", 1), ("text", "a"), ("MATLAB_class", np.bytes_(b"double"))):
            book["x"].attrs[name] = book.attrs[name] = value
        book.flush()
        read(book.id.get_file_image())  # let h5py and NumPy import everything, because files cannot be opened later
    # load zipfile now, because answer() needs this module when files cannot be opened
    np.savez(io.BytesIO(), np.zeros(1))
    return read


def _dimensions(item: Any) -> list[str]:
    """Return the names of the dimensions of a NetCDF variable. A coordinate variable has the name of its dimension."""
    own = item.name.lstrip("/")
    return [next((scale.name.lstrip("/") for scale in dimension.values()), own) for dimension in item.dims]


def _plain(values: AnyArray) -> AnyArray:
    """Return an array that does not require pickle: rows of characters and texts become arrays of text."""
    if values.dtype == "S1" and values.size and values.ndim:
        values = np.ascontiguousarray(values).view(f"S{values.shape[-1]}")[..., 0]
    if values.dtype.kind in "SO":
        words = [str(_text(value)).rstrip("\0 ") for value in values.ravel()]
        return np.array(words, dtype=np.str_).reshape(values.shape)
    return values


def _text(value: Any) -> str | int:
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return int(value) if isinstance(value, (int, np.integer)) else str(value)


def _data_sets(group: Any, depth: int, kinds: str, path: str = "", seen: set[Any] | None = None) -> dict[str, Any]:
    """Return data sets below a group with types in ``kinds``, by path. Data sets outside the file are refused."""
    import h5py

    seen, found = set() if seen is None else seen, dict[str, Any]()
    for name in group:
        place = f"{path}{name}"
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise _lies_elsewhere(f"{place!r} is a link, not data")
        item = group[name]
        if len(seen) > _MOST_ITEMS:
            raise InputError(f"the file has more than {_MOST_ITEMS} items", expected="a log", cause="no log")
        address = h5py.h5o.get_info(item.id).addr
        if address in seen:
            continue  # the group is linked twice, or contains itself
        seen.add(address)
        if isinstance(item, h5py.Group) and depth > 1:
            found |= _data_sets(item, depth - 1, kinds, f"{place}/", seen)
        elif isinstance(item, h5py.Dataset):
            _refuse_elsewhere(place, item)
            found |= {place: item} if item.dtype.kind in kinds else {}
    return found


def _refuse_elsewhere(place: str, item: Any) -> None:
    # a separate function, so that a test can switch it off and show that the limits of the child refuse the file as
    # well
    if item.is_virtual or item.external:
        raise _lies_elsewhere(f"the data of {place!r} are in other files")


def _lies_elsewhere(reason: str) -> InputError:
    return InputError(
        reason,
        expected="a file that contains all its data",
        cause="a file crafted to read other files of this machine, or a data set in several files: join it (h5repack)",
    )


def _geotiff() -> Read:
    """Return the reader of GeoTIFF files, after loading all modules that it needs."""
    import warnings

    import rasterio
    from rasterio.io import MemoryFile

    warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # the caller reports the cause

    def read(data: bytes) -> tuple[dict[str, AnyArray], dict[str, Any]]:
        # specify the driver, because GDAL would treat a text that begins with <VRTDataset> as a list of other files
        with MemoryFile(data) as file, file.open(driver="GTiff") as image:
            if image.count != 1:
                raise InputError(f"{image.count} bands", expected="one band of heights", cause="a picture, not heights")
            if image.width * image.height * 8 > MOST_BYTES:
                raise InputError(
                    f"{image.width} x {image.height} cells", expected=f"at most {MOST_BYTES >> 23} million cells"
                )
            band = image.read(1, masked=True).astype(np.float64).filled(np.nan)
            crs = None if image.crs is None else image.crs.to_string()
            transform = list(image.transform)[:6]
            return {"band": band}, {"transform": transform, "crs": crs, "unit": str(image.units[0] or "").lower()}

    with MemoryFile() as file:
        with file.open(driver="GTiff", width=2, height=2, count=1, dtype="float32", crs="EPSG:32617") as image:
            image.write(np.ones((1, 2, 2), dtype=np.float32))
        read(file.read())  # open the database of coordinate systems and load all late imports
    return read


READERS: dict[str, Callable[[], Read]] = {
    "hdf5": lambda: _hdf5(32),
    "matlab": lambda: _hdf5(1),
    "netcdf": lambda: _hdf5(1, netcdf=True),
    "geotiff": _geotiff,
}

"""The parts that all NetCDF files share, according to the CF conventions: units, reference systems, writing."""

from __future__ import annotations

import importlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .errors import UsageError
from .geodesy import SiteFrame
from .interrupts import held
from .outputs import Sink
from .units import AnyArray
from .versions import tool_version, utc_now

CONVENTIONS = "CF-1.11"

# Units of dBm and dB in the syntax of UDUNITS: tenths of the decimal logarithm of a power over 1 mW, or of a ratio.
DBM, DB = "0.1 lg(re 1 mW)", "0.1 lg(re 1)"


def wgs84() -> dict[str, Any]:
    """Return the attributes of the grid mapping of latitudes and longitudes."""
    from pyproj import CRS

    return dict(CRS.from_epsg(4326).to_cf()) | {"long_name": "coordinate reference system"}


def flags(meanings: Sequence[str], dtype: type[np.integer[Any]] = np.int8, first: int = 0) -> dict[str, Any]:
    """Return the attributes of integer codes ``first``, ``first`` + 1, ... with these meanings."""
    # replace characters that CF does not allow in a meaning, such as spaces, which separate the meanings
    words = [re.sub(r"[^A-Za-z0-9_.+@-]", "_", text) or "_" for text in meanings]
    return {"flag_values": np.arange(first, first + len(words), dtype=dtype), "flag_meanings": " ".join(words)}


def site_crs(frame: SiteFrame) -> Any:
    """Return the site frame as a named reference system of pyproj: azimuthal equidistant about the origin, WGS 84."""
    from pyproj.crs import GeographicCRS, ProjectedCRS
    from pyproj.crs.coordinate_operation import AzimuthalEquidistantConversion

    return ProjectedCRS(
        conversion=AzimuthalEquidistantConversion(frame.latitude_deg, frame.longitude_deg),
        name=f"Site frame, azimuthal equidistant about {frame.latitude_deg:.8f}, {frame.longitude_deg:.8f} (WGS 84)",
        geodetic_crs=GeographicCRS(name="WGS 84"),
    )


def file_attributes(title: str, source: str, comment: str) -> dict[str, str]:
    """Return the global attributes of a file: conventions, title, source, history and references.

    Parameters
    ----------
    title, source, comment : str

    Returns
    -------
    dict of str to str
    """
    version = tool_version()
    return {
        "Conventions": CONVENTIONS,
        "title": title,
        "source": f"aerpaw-cmp {version}: {source}",
        "history": f"{utc_now()} written by aerpaw-cmp {version}",
        "institution": "not stated",
        "references": "https://arxiv.org/abs/2502.10324",
        "comment": comment,
    }


@dataclass(frozen=True, slots=True)
class Variable:
    """A variable of a file. ``encoding`` may contain ``_FillValue`` and the compression options of netCDF4."""

    dims: tuple[str, ...]
    values: AnyArray
    attrs: dict[str, Any] = field(default_factory=dict)
    encoding: Mapping[str, Any] = field(default_factory=dict)


class Dataset:
    """The variables and attributes of a file, like ``xarray.Dataset``.

    A separate class, because importing xarray takes a second.

    Parameters
    ----------
    variables : mapping
        For each name: dimensions (or the name of the only one), values, attributes and encoding.
    attributes : mapping
        Attributes of the file.
    """

    def __init__(self, variables: Mapping[str, Sequence[Any]], attributes: Mapping[str, Any]) -> None:
        self.attrs, self.variables = dict(attributes), dict[str, Variable]()
        for name, (dims, values, *rest) in variables.items():
            self.variables[name] = Variable((dims,) if isinstance(dims, str) else dims, np.asarray(values), *rest)

    def to_xarray(self) -> Any:
        """Return the data as an ``xarray.Dataset``, with times since a date as ``datetime64``.

        Raises
        ------
        UsageError
            If xarray is not installed.
        """
        columns = {n: (v.dims, v.values, v.attrs, dict(v.encoding)) for n, v in self.variables.items()}
        xarray = library("xarray")
        return xarray.decode_cf(
            xarray.Dataset(columns, attrs=self.attrs),
            mask_and_scale=False,
            decode_coords=False,
            concat_characters=False,
        )


def netcdf_bytes(data: Any, grows: Sequence[str] = ()) -> Any:
    """Return the bytes of a NetCDF-4 file with a :class:`Dataset`.

    The file is created in memory, because HDF5 aborts on a full disk.

    Arrays are deflated. Text becomes characters in UTF-8, which every reader of CF files accepts. NetCDF has no complex
    numbers: ``NAME_real`` and ``NAME_imag`` are written instead of ``NAME``. The ``_FillValue`` of a variable with NaN
    is NaN. Other variables have a ``_FillValue`` only if their ``encoding`` contains one. ``grows`` are the unlimited
    dimensions. :class:`GrowingNetcdf` appends along the first of these.

    Raises
    ------
    UsageError
        If netCDF4 is not installed.
    """
    book = library("netCDF4").Dataset("data", "w", memory=1 << 20)
    book.setncatts(data.attrs)
    for name, variable in _parts(data).items():
        dims, values = variable.dims, variable.values
        for dim, size in zip(dims, values.shape, strict=True):
            if dim not in book.dimensions:
                book.createDimension(dim, None if dim in grows else size)
        encoding: dict[str, Any] = (
            # shuffling groups the bytes of numbers by significance, which has no effect on single bytes
            {"zlib": True, "complevel": 4, "shuffle": values.dtype.itemsize > 1} if values.ndim else {}
        )
        attributes = dict(variable.attrs)
        if values.dtype.kind == "S":
            encoding, attributes["_Encoding"] = {}, "utf-8"
        elif values.dtype.kind == "f" and np.isnan(values).any():
            encoding["_FillValue"] = math.nan
        encoding |= variable.encoding
        if {*dims} & {*grows}:
            encoding["chunksizes"] = (64,) * len(dims) if values.dtype.kind == "S" else _chunk(dims, values, grows)
        made = book.createVariable(name, values.dtype, dims, fill_value=encoding.pop("_FillValue", None), **encoding)
        # do not let netCDF4 scale the values, because they are already scaled as in the file
        made.set_auto_maskandscale(False)
        made.setncatts(attributes)
        made[...] = values
    return book.close()


def _chunk(dims: Sequence[str], values: AnyArray, grows: Sequence[str]) -> tuple[int, ...]:
    """Return the shape of a chunk of about 1 MiB or less.

    The length along each unlimited dimension except the first is 1.
    """
    sizes = dict(zip(dims, values.shape, strict=True))
    fixed = math.prod(size for name, size in sizes.items() if name not in grows)
    step = max(1, min(sizes.get(grows[0], 1), (1 << 20) // max(values.dtype.itemsize * fixed, 1)))
    first = 1 << (step.bit_length() - 1)
    return tuple(first if name == grows[0] else 1 if name in grows else size for name, size in sizes.items())


class GrowingNetcdf:
    """A context that appends data sets to a NetCDF-4 file, with only one data set in memory.

    Parameters
    ----------
    path : Path
    grows : sequence of str
        Unlimited dimensions. Data sets are appended along the first of these. Along the other dimensions, shorter data
        sets are filled with ``_FillValue``. Each data set overwrites the variables that do not have the first of these
        dimensions.

    Notes
    -----
    A ``_FillValue`` other than NaN fills the file, but its attribute is removed. Otherwise readers would replace valid
    values that equal it, such as a gain of 0 or a flag of -1, by NaN.
    """

    def __init__(self, path: Path, grows: Sequence[str]) -> None:
        self._path, self._grows, self._sizes = path, tuple(grows), dict.fromkeys(grows, 0)
        self._book: Any = None

    def __enter__(self) -> GrowingNetcdf:
        self._stream = self._path.open("w+b")
        self._sink = Sink(self._stream)
        return self

    def __exit__(self, *error: object) -> None:
        with held():
            try:
                if self._book is not None:
                    self._book.close()
                self._sink.raise_spared()
            finally:
                self._stream.close()

    def append(self, data: Any) -> None:
        """Write the next :class:`Dataset`, with the same variables and dimensions as the first."""
        with held():  # an interrupt inside a call of HDF5 would leave an incomplete file
            self._append(data)

    def _append(self, data: Any) -> None:
        if self._book is None:
            self._sink.write(netcdf_bytes(data, self._grows))
            # h5py continues the file that netCDF4 began, because netCDF4 cannot write to a stream
            self._book = library("h5py").File(self._sink, "r+")
            for variable in self._book.values():
                if "_FillValue" in variable.attrs and not np.isnan(variable.attrs["_FillValue"][0]):
                    del variable.attrs["_FillValue"]
        parts = _parts(data)
        sizes = {name: size for part in parts.values() for name, size in zip(part.dims, part.values.shape, strict=True)}
        along, start = self._grows[0], self._sizes[self._grows[0]]
        sizes[along] += start
        self._sizes = {name: max(size, sizes[name]) for name, size in self._sizes.items()}
        for name in self._grows:
            self._book[name].resize((self._sizes[name],))
        for name, part in parts.items():
            dims, values = part.dims, part.values
            if {*dims} & {*self._grows}:
                stored = self._book[name]
                stored.resize(tuple(self._sizes.get(dim, size) for dim, size in zip(dims, stored.shape, strict=True)))
                shift = [start if dim == along else 0 for dim in dims]
                stored[tuple(slice(first, first + n) for first, n in zip(shift, values.shape, strict=True))] = values
        self._sink.raise_spared()

    def describe(self, variable: str | None = None, **attributes: Any) -> None:
        """Replace attributes of the file, or of a variable."""
        attrs = (self._book if variable is None else self._book[variable]).attrs
        for name, value in attributes.items():
            attrs[name] = value.encode() if isinstance(value, str) else value


def _parts(data: Any) -> dict[str, Variable]:
    """Return the variables as a file stores them: text as characters, complex numbers as two variables."""
    parts = {}
    for name, variable in data.variables.items():
        dims, values, about = variable.dims, np.asarray(variable.values), dict(variable.attrs)
        if values.dtype.kind == "c":
            for half, numbers in (("real", values.real), ("imag", values.imag)):
                named = {"long_name": f"{about['long_name']} ({half})"}
                parts[f"{name}_{half}"] = Variable(dims, numbers, about | named, variable.encoding)
            continue
        if values.dtype.kind in "OU":
            text = np.char.encode(values.astype(str), "utf-8")
            dims, values = (*dims, f"{name}_length"), text.view("S1").reshape(*values.shape, text.dtype.itemsize)
        parts[name] = Variable(dims, values, about, variable.encoding)
    return parts


def library(name: str) -> Any:
    """Import a module of the extra ``geo``.

    Raises
    ------
    UsageError
        If the module is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as missing:
        raise UsageError(
            f"{missing.name} is not installed, which xarray's data sets and NetCDF need",
            expected="pip install 'aerpaw-cmp[geo]', or another format",
        ) from None

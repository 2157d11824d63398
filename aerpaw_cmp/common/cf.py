"""Common parts of NetCDF files after the CF conventions: units, reference systems, the file."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from typing import Any

from .errors import UsageError
from .geodesy import SiteFrame

CONVENTIONS = "CF-1.11"

# dBm and dB as UDUNITS has them: tenths of the decimal logarithm of a power over 1 mW, of a ratio.
DBM, DB = "0.1 lg(re 1 mW)", "0.1 lg(re 1)"

# Attributes of the grid mapping of latitudes and longitudes.
WGS84 = {
    "grid_mapping_name": "latitude_longitude",
    "geographic_crs_name": "WGS 84",
    "horizontal_datum_name": "World Geodetic System 1984",
    "reference_ellipsoid_name": "WGS 84",
    "semi_major_axis": 6378137.0,
    "inverse_flattening": 298.257223563,
    "longitude_of_prime_meridian": 0.0,
    "prime_meridian_name": "Greenwich",
    "long_name": "coordinate reference system",
}


def site_crs(frame: SiteFrame) -> Any:
    """The site frame as a named reference system (pyproj): azimuthal equidistant about the origin, WGS 84."""
    from pyproj.crs import GeographicCRS, ProjectedCRS
    from pyproj.crs.coordinate_operation import AzimuthalEquidistantConversion

    return ProjectedCRS(
        conversion=AzimuthalEquidistantConversion(frame.latitude_deg, frame.longitude_deg),
        name=f"Site frame, azimuthal equidistant about {frame.latitude_deg:.8f}, {frame.longitude_deg:.8f} (WGS 84)",
        geodetic_crs=GeographicCRS(name="WGS 84"),
    )


def file_attributes(title: str, source: str, generated: str, version: str, comment: str) -> dict[str, str]:
    """Attributes of a file: what it holds and who wrote it when.

    Parameters
    ----------
    title, source, comment : str
    generated : str
        ISO 8601.
    version : str
        Of aerpaw-cmp.

    Returns
    -------
    dict of str to str
    """
    return {
        "Conventions": CONVENTIONS,
        "title": title,
        "source": f"aerpaw-cmp {version}: {source}",
        "history": f"{generated} written by aerpaw-cmp {version}",
        "institution": "not stated",
        "references": "https://arxiv.org/abs/2502.10324",
        "comment": comment,
    }


def dataset(variables: Mapping[str, Any], attributes: Mapping[str, Any]) -> Any:
    """An ``xarray.Dataset`` of variables: (dimensions, values, attributes) by name.

    Raises
    ------
    UsageError
        If xarray is not installed.
    """
    return _library("xarray").Dataset(dict(variables), attrs=dict(attributes))


def netcdf_bytes(data: Any) -> Any:
    """A NetCDF-4 file of an ``xarray.Dataset``, made in memory: HDF5 ends the process where a disk is full.

    Arrays are deflated; text becomes characters in UTF-8, which every reader of CF takes. A variable with NaN has it as
    ``_FillValue``; another has none, unless its ``encoding`` says so.

    Raises
    ------
    UsageError
        If netCDF4 is not installed.
    """
    book = _library("netCDF4").Dataset("data", "w", memory=1 << 20)
    data = data.copy()
    for name, variable in data.variables.items():
        if variable.dtype.kind in "OU":
            variable.encoding |= {"dtype": "S1", "char_dim_name": f"{name}_length"}
            continue
        missing = variable.dtype.kind == "f" and bool(variable.isnull().any())
        deflated = {"zlib": True, "complevel": 4, "shuffle": variable.dtype.itemsize > 1} if variable.ndim else {}
        variable.encoding = {"_FillValue": math.nan if missing else None, **deflated, **variable.encoding}
    data.dump_to_store(_library("xarray.backends").NetCDF4DataStore(book))
    return book.close()


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as missing:
        raise UsageError(
            f"NetCDF needs {missing.name}, which is not installed",
            expected="pip install 'aerpaw-cmp[geo]', or another format",
        ) from None

"""What NetCDF files after the CF conventions share: units that UDUNITS reads, text, the coordinate reference system."""

from __future__ import annotations

from typing import Any

from .geodesy import SiteFrame
from .units import AnyArray

CONVENTIONS = "CF-1.11"

DBM, DB = "0.1 lg(re 1 mW)", "0.1 lg(re 1)"
"""dBm and dB as UDUNITS has them: tenths of the decimal logarithm of a power over 1 mW, of a ratio."""

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
"""Attributes of the grid mapping of latitudes and longitudes."""


def site_crs(frame: SiteFrame) -> Any:
    """The site frame as a named reference system (pyproj): azimuthal equidistant about the origin, WGS 84."""
    from pyproj.crs import GeographicCRS, ProjectedCRS
    from pyproj.crs.coordinate_operation import AzimuthalEquidistantConversion

    return ProjectedCRS(
        conversion=AzimuthalEquidistantConversion(frame.latitude_deg, frame.longitude_deg),
        name=f"Site frame, azimuthal equidistant about {frame.latitude_deg:.8f}, {frame.longitude_deg:.8f} (WGS 84)",
        geodetic_crs=GeographicCRS(name="WGS 84"),
    )


def write_text(book: Any, name: str, dimensions: tuple[str, ...], values: AnyArray, meaning: str) -> Any:
    """A variable of text as characters, which every reader of CF takes.

    Parameters
    ----------
    book : netCDF4.Dataset
    name : str
    dimensions : tuple of str
        Those of ``values``; one more is made for the characters.
    values : ndarray of str
    meaning : str
        ``long_name``.

    Returns
    -------
    netCDF4.Variable
        Of ``S1``, its last dimension ``<name>_length``.
    """
    import numpy as np

    encoded = [str(value).encode("utf-8") for value in values.ravel()]
    width = max([1, *map(len, encoded)])
    length = f"{name}_length"
    book.createDimension(length, width)
    variable = book.createVariable(name, "S1", (*dimensions, length))
    variable.setncatts({"long_name": meaning, "_Encoding": "utf-8"})
    variable.set_auto_chartostring(False)
    table = np.frombuffer(b"".join(text.ljust(width, b"\0") for text in encoded), dtype="S1")
    variable[:] = table.reshape(*values.shape, width)
    return variable

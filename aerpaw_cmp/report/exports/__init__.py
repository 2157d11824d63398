"""Samples along a flight as files that other programs open: ``write_exports(export, folder, formats)``.

An :class:`~aerpaw_cmp.report.exports.points.Export` holds one table of points per kind (``rss``, ``rank``): one row per
sample with its link, instant, place and values, and per value column its unit and meaning. Each format is one function
``write_X(export, folder)``. Maps over a grid are written by :mod:`aerpaw_cmp.maps.export`.
"""

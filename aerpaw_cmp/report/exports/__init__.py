"""Samples along flights as files that other programs open: ``write_exports(export, folder, formats)``.

An :class:`~aerpaw_cmp.report.exports.points.Export` holds one table of points per kind (``rss``, ``rank``, or any other
name): one row per sample with its link, instant, place and values, and per value column its unit and meaning
(:func:`~aerpaw_cmp.report.exports.points.points_table`). Each format is one function ``write_X(export, folder)`` and
takes any such table: a level, its corrected value and its standard deviation are three columns of it. Maps over a grid
are written by :mod:`aerpaw_cmp.maps.export`.
"""

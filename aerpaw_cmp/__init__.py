"""Ingest AERPAW field logs, replay the flight by ray tracing, compare the two.

Importing this package loads nothing heavy: no Sionna, no matplotlib, no pandas.
"""

__version__ = "0.1.0"

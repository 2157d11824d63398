"""Antennas: patterns, files of patterns, what flights taught."""

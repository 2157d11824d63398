"""Paths between towers and poses: mirror images, beams, Sionna, obstacles and terrain."""

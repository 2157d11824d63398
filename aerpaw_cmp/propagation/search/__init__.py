"""Paths between towers and poses: mirror images, beams, Sionna; what hides and what crowns reflect."""

"""Figures, named by their page."""

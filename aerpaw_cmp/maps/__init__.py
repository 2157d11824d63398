"""Grids, spatial correlation, Kriging and its baselines."""

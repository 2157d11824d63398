"""Maps: grids, spatial correlation, Kriging and its baselines."""

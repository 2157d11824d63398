"""Ground heights: elevation models, surfaces through points, datums."""

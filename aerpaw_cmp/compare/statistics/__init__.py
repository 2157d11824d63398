"""Intervals, memory of a series, passes, inertia: pure functions of arrays."""

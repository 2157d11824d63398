"""Antennas, residual fields and the next flight learned from flights: pure functions of arrays."""

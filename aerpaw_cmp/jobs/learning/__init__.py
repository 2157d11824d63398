"""Calibration: antennas, ground, lock and rank receivers learned from flights."""

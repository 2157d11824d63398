"""Offsets, RSS and rank comparison, statistics: pure functions of arrays."""

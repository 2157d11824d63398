"""Figures of a flight's report: of levels, of ranks, and the order of all."""

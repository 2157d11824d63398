"""Figures of a flight's report, a module per kind."""

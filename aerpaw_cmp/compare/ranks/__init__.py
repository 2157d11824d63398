"""Ranks that a receiver reports: forecast and receiver."""

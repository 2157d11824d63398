"""Meaning of a flight's numbers: causes, entries, model ladder, season, verdicts."""

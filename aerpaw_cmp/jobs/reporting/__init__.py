"""The report of one flight, stage by stage."""

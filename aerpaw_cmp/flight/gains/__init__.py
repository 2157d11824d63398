"""Gains and losses that a flight file names or a site remembers."""

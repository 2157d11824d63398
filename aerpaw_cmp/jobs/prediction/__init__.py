"""Levels before a flight, scored after it; which flight next."""

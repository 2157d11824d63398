"""Engines that search the paths."""

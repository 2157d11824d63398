"""Definitions shared by every subpackage: errors, units, files, geodesy and YAML."""

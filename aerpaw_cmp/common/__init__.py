"""Vocabulary shared by every room: errors, units, files, geodesy, YAML."""

"""Gains over direction and their spread; the mount of an antenna."""

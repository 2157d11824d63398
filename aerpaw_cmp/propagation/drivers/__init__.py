"""Drivers that rerun the stages of a replay: element pairs, a tower that moves, parts of a long flight."""

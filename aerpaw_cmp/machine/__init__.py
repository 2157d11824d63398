"""Checks whether this machine can run this program."""

"""Finished numbers in, figures and files out."""

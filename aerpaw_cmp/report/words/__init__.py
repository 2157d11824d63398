"""Sentences, named by their page."""

"""Levels against their prediction: RSS, detection, serving cells."""

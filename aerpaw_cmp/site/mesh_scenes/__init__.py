"""Scenes of meshes: Mitsuba files and what they hold."""

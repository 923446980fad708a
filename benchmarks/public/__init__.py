"""Measure refinements on published scenes, in the protocols in which others publish numbers."""

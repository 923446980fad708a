"""Metrics and their protocols, baselines, costs, and pictures of what was rendered."""

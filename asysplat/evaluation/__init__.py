"""Metrics and their protocols, baselines, costs, and figures."""

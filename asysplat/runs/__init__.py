"""Runs: their configurations, folders, checkpoints, stages and results; no Lightning."""

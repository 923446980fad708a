"""Prepare scenes for training."""

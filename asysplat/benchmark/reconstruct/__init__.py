"""Scenes fitted to their photographs."""

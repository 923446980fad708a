"""Photographs on disk."""
